"""The Python API: arrays, one capture, a folder."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Real
from operator import index
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray  # the former in quotes: help() prints its name, not 1,000 characters

from agalign.batch.capture_task import CaptureReport, FlightReports, Task, process_capture, quiet
from agalign.batch.earlier_results import refuse_other_captures
from agalign.batch.index_run import index_tasks, run_indices
from agalign.batch.run import Listener, run_flight
from agalign.cameras.discover import FolderScan, discover, mosaics_onto
from agalign.capture.align_bands import align_pairs
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.decision import with_lens_shapes
from agalign.capture.reference import Reference
from agalign.capture.warped_pair import with_metrics
from agalign.config import DiscoverOptions, RunOptions, Settings
from agalign.errors import InputError
from agalign.pixels.masks import raster_of
from agalign.pixels.radiometry import with_radiometry
from agalign.products.exports.programs import ExportReport
from agalign.products.exports.programs import export as export_run
from agalign.products.indices.formulas import chosen_indices
from agalign.products.indices.rasters import IndexReport
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.capture import Capture
from agalign.values.choices import MAX_PIXELS, ExportProgram, Interpolation, SeedKind
from agalign.values.image import Mask
from agalign.values.mapping import PixelMapping
from agalign.values.output_folder import locked
from agalign.values.processes import end_if_reimported

Progress = Callable[[CaptureReport, int, int], object]
"""Called with the report of a capture, how many captures are finished, and how many there are."""
_LOG = logging.getLogger(__name__)


def align(
    fixed: "ArrayLike",
    moving: "ArrayLike",
    *,
    seed: "ArrayLike | None" = None,
    seed_std_px: float | None = None,
    fixed_valid: "ArrayLike | None" = None,
    moving_valid: "ArrayLike | None" = None,
    settings: Settings | None = None,
) -> Alignment:
    """Estimate the homography between two images of the same scene, which may be of different modalities.

    fixed, moving
        (H, W), (H, W, C) or (C, H, W) arrays of any numeric type; their sizes may differ. The largest value of an
        integer type counts as saturated. nan, and constant areas at the border, are ignored.
    seed
        Initial `fixed_to_moving` (3x3), accurate to about 10 % of the image size; None: estimated from the images.
    seed_std_px
        Standard error of the seed, px of `fixed`. It decides between several matches in a repetitive scene, which is
        otherwise not aligned.
    fixed_valid, moving_valid
        (H, W), False where pixels must not be used.

    settings
        By default `Settings()`; `settings.write` has no effect.

    The method is that of docs/explanation/method.md: a descriptor learned on both images while the homography is
    optimised by the same loss, then refined and verified by windows. Returns an Alignment on the grid of `fixed`; its
    matrices are float64. `warp` resamples `moving` to it, `map` maps pixels of `fixed` to pixels
    of `moving`, `inverse` maps back: x right, y down, (0, 0) the centre of the top-left pixel. Check its `status`: only
    `aligned` has passed verification. With `predicted`, the mapping is extrapolated over a part of the image without
    measurements, with the standard error `prediction.std_px`. With `seed_only` and `failed`, the mapping is that of the
    seed. `reason` explains each of the three. `before` and `after` have measures of similarity of the images as they
    are and under the mapping, `residual` the shifts of windows that remain.
    Raises InputError for arrays that are not images, GeometryError for a seed that is not a homography.
    """
    settings = settings or Settings()
    if seed_std_px is not None and seed is None:
        raise InputError("seed_std_px is the standard error of a seed; give the seed too")
    if seed_std_px is not None and not (isinstance(seed_std_px, Real) and 0 < seed_std_px < math.inf):
        raise InputError(f"seed_std_px is {seed_std_px!r}, not a positive number of pixels")
    fixed_raster = raster_of(fixed, fixed_valid, "fixed")
    moving_raster = raster_of(moving, moving_valid, "moving")
    matrices: SeedMatrices = {"identity": geometry.overlay(fixed_raster.size_px, moving_raster.size_px)}
    if seed is not None:
        matrices = {"user": geometry.normalised(seed)}
    seed_std: dict[SeedKind, float] = {} if seed_std_px is None else {"user": float(seed_std_px)}
    pair = BandPair("moving", Reference(fixed_raster), moving_raster, matrices, seed_std_px=seed_std)
    result = with_lens_shapes([pair], align_pairs([pair], settings, quiet))
    return replace(with_metrics(result["moving"], pair), moving_size_px=moving_raster.size_px)


def warp_onto(
    moving: "ArrayLike",
    fixed_to_moving: "ArrayLike",
    fixed_size_px: tuple[int, int],
    *,
    valid: "ArrayLike | None" = None,
    interpolation: Interpolation = "lanczos",
) -> tuple[NDArray[np.generic], Mask]:
    """Resample an image to a grid of (width, height) pixels by a homography (3x3) that maps its pixels to the image.

    moving, valid
        (H, W), (H, W, C) or (C, H, W) of any numeric type, and (H, W), False for pixels that must not be used.

    Returns the pixels in the layout and type of `moving`, NaN or 0 where they are unknown, and their mask (height,
    width). An alignment may have lenses, a displacement field or a relief in addition: use `Alignment.warp` for it.
    Raises InputError, also for an Alignment, and GeometryError.
    """
    if isinstance(fixed_to_moving, Alignment):
        raise InputError("an alignment is more than a homography; use its method warp(moving)")
    mapping = PixelMapping(geometry.normalised(fixed_to_moving))
    by_homography = Alignment(mapping, _size_px(fixed_size_px), (), Seed("user", mapping.fixed_to_moving, 0.0))
    return by_homography.warp(moving, valid=valid, interpolation=interpolation)


def _size_px(size_px: object) -> tuple[int, int]:
    """Return (width, height) as integers. Raises InputError unless they are two positive ones of a feasible image."""
    try:
        width, height = map(index, size_px)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        width, height = 0, 0
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise InputError(
            f"fixed_size_px is {size_px!r}, not a width and a height of at most {MAX_PIXELS:,} px together"
        )
    return width, height


def align_capture(capture: Capture, out: str | Path, *, settings: Settings | None = None) -> CaptureReport:
    """Align a capture that `discover` returned (an element of `FolderScan.captures`), and write its stack and sidecar
    below `out`.

    Returns a CaptureReport with the state `done`; bands that are not aligned are in its `result`, not raised. Raises
    UnreadableFileError if its reference band cannot be read, ConfigurationError if `out` has the result of another
    capture in its place, and OutputError.
    """
    settings = settings or Settings()
    refuse_other_captures([capture], Path(out))
    return process_capture(Task(with_radiometry(capture, settings.write.radiometry, {}), Path(out), settings))


def align_folder(
    folder: str | Path,
    out: str | Path,
    *,
    settings: Settings | None = None,
    options: DiscoverOptions | None = None,
    run: RunOptions | None = None,
    model: str | Path | None = None,
    progress: Progress | None = None,
) -> FlightReports:
    """Align every capture below `folder`, and write results, summary and report to `out`.

    `run` sets the number of processes, or the executor; with several processes the calling script must be
    importable (`if __name__ == "__main__":`). `model` is a file from the `models` folder of an earlier run.
    `progress` is called after each capture with its report, the number of finished captures and their total; the
    logger `agalign` logs each capture at the level INFO.
    Returns the reports in the order in which the captures were finished.
    Raises InputError if the folder does not exist, OutputError if `out` cannot be written, ConfigurationError
    for a model of another camera, and if `out` has results of other captures of the same name.
    """
    end_if_reimported()
    flight = discover(Path(folder), options or DiscoverOptions(skip=(Path(out),)))
    start = None if model is None else Path(model)
    return _run(flight, Path(out), settings or Settings(), run or RunOptions(), progress, start)


def onto(
    reference: str | Path,
    moving: Sequence[str | Path],
    out: str | Path,
    *,
    band: str | None = None,
    settings: Settings | None = None,
    run: RunOptions | None = None,
) -> FlightReports:
    """Align georeferenced mosaics of other dates or sensors to the grid of the mosaic `reference`, and write a raster
    and a sidecar of each to `out`: one band of the reference, then all bands of the mosaic.

    `band` is the name of the band of the reference to compare with; by default green. A mosaic is aligned if its
    windows are within a pixel of the reference. Returns a report for each mosaic, in the order in which they were
    finished. Raises UnreadableFileError, InputError for a file without georeference, NoSuchBandError, OutputError.
    """
    end_if_reimported()
    flight = mosaics_onto(Path(reference), [Path(path) for path in moving], band)
    options = replace(run or RunOptions(), align_panels=True)  # a mosaic is not a panel
    return _run(flight, Path(out), (settings or Settings()).for_mosaics, options)


def _run(
    flight: FolderScan,
    out: Path,
    settings: Settings,
    run: RunOptions,
    progress: Progress | None = None,
    start: Path | None = None,
) -> FlightReports:
    from agalign.products.report.pages import write_pages

    reports = FlightReports()
    for report in run_flight(flight, out, settings, run, Listener(on_again=_LOG.info), start):
        reports.append(report)
        _LOG.info("%d of %d: %s: %s", len(reports), len(flight.captures), report.label, report.summary)
        if progress is not None:
            progress(report, len(reports), len(flight.captures))
    write_pages(out, _LOG.warning)
    return reports


def indices(
    out: str | Path,
    names: Sequence[str] = ("ndvi",),
    *,
    formulas: Sequence[str] = (),
    target: str | Path | None = None,
    mask_qa: bool = False,
    run: RunOptions | None = None,
) -> list[IndexReport]:
    """Compute spectral indices of the aligned captures in the output folder of a run, and write a raster and a picture
    of each, and the table indices.csv, to `target` (by default `out`).

    `names` are those of `agalign indices --index`; `formulas` are texts such as "mine=(N-RE)/(N+RE)" of the bands B, G,
    R, RE and N. `mask_qa` leaves out saturated, occluded and misaligned pixels, and needs a run with quality rasters
    (`WriteSettings(qa=True)`). Returns a report for each capture and index; `problem` says why one could not be
    computed. Raises InputError if there is no run, ConfigurationError for an unknown index, OutputError.
    """
    end_if_reimported()
    folder, options = Path(out if target is None else target), run or RunOptions()
    chosen = chosen_indices(names, formulas)
    tasks = index_tasks(Path(out), chosen, folder, overwrite=options.overwrite, mask_qa=mask_qa)
    with locked(folder):
        return [report for done in run_indices(tasks, options.jobs, options.executor) for report in done]


def export(out: str | Path, target: str | Path, program: ExportProgram, *, copy: bool = False) -> ExportReport:
    """Export the captures with status `ok` in the output folder of a run into a new folder, for a photogrammetry
    program: "odm" (OpenDroneMap, WebODM), "metashape" or "pix4d".

    The captures have the same bands and quantities as most. Files are hard links if the file system allows that, and
    copies otherwise or with `copy`. Returns an ExportReport; its `notes` are instructions for the program, and
    `left_out` lists the other captures. Raises InputError if there is no run or nothing to export, ConfigurationError
    if the run wrote no band files (`WriteSettings(layout="bands")`), OutputError if `target` is not empty or cannot be
    written.
    """
    return export_run(Path(out), Path(target), program, copy=copy)
