"""The Python API: arrays, one capture, a folder."""

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from operator import index
from pathlib import Path
from reprlib import repr as shortened_repr

import numpy as np
from numpy.typing import ArrayLike, NDArray  # the former in quotes: help() prints its name, not 1,000 characters

from agalign.batch.capture_report import CaptureReport, FlightReports
from agalign.batch.capture_task import Task, process_capture, quiet
from agalign.batch.index_run import index_tasks, run_indices
from agalign.batch.output_files import refuse_results_elsewhere
from agalign.batch.run import Listener, run_flight
from agalign.batch.selection import select_captures
from agalign.cameras.discover import FolderScan, discover, mosaics_onto
from agalign.capture.align_bands import align_pairs
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.metrics import with_metrics
from agalign.capture.reference import Reference
from agalign.capture.seeding import with_reduced_reference
from agalign.config import DiscoverOptions, RunOptions, Settings
from agalign.errors import InputError
from agalign.exports.programs import ExportReport
from agalign.exports.programs import export as export_run
from agalign.host.files import written_below
from agalign.host.output_folder import locked
from agalign.host.processes import end_if_reimported
from agalign.pixels.masks import raster_of
from agalign.records.sidecar_file import check_products
from agalign.spectral_indices.formulas import chosen_indices
from agalign.spectral_indices.rasters import IndexReport, check_indices
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.arguments import checked
from agalign.values.capture import Capture
from agalign.values.choices import MAX_PIXELS, ExportProgram, Interpolation, SeedKind
from agalign.values.image import Mask
from agalign.values.mapping import PixelMapping
from agalign.values.resampling import homography_of

Progress = Callable[[CaptureReport, int, int], object]
"""Called with the report of a capture, how many captures are finished, and how many there are."""
_LOG = logging.getLogger(__name__)


@checked
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
    """Estimate the mapping between two images of the same scene, also between spectral bands with reversed contrast.

    The images are aligned by learned descriptors, then by phase correlation in windows; windows that the estimate does
    not use verify it (docs/explanation/method.md). A pair that cannot be aligned raises no error.

    Parameters
    ----------
    fixed
        Reference image, (H, W), (H, W, C) or (C, H, W), of any numeric type, also a PyTorch tensor. NaN and masked
        pixels (`numpy.ma`) are ignored, and so are areas at the border with the value 0 or the largest one of an
        integer type. The largest value of 8 and 16 bit integers counts as saturated: areas of it at least 7 px wide
        are ignored everywhere. Use `fixed_valid` for other fill values.
    moving
        The other image, likewise. Its size may differ from that of `fixed`.
    seed
        Initial alignment: homography (3, 3) from pixels of `fixed` to pixels of `moving`, accurate to about 10 % of the
        image size. By default it is estimated from the images. `fixed` is reduced for a `moving` with much larger
        pixels, as of a thermal camera.
    seed_std_px
        Standard error of `seed`, px of `fixed`. It selects one of several matches in a repetitive scene, which is
        otherwise not aligned.
    fixed_valid
        (H, W), False, 0 or NaN for pixels of `fixed` that must not be used.
    moving_valid
        (H, W), False, 0 or NaN for pixels of `moving` that must not be used.
    settings
        By default `Settings()`. `settings.write` has no effect.

    Returns
    -------
    Alignment
        The mapping from pixels of `fixed` to pixels of `moving` (x right, y down, (0, 0) the centre of the top-left
        pixel), its expected error and its `status`. Only `aligned` has passed verification. With `predicted`, the
        mapping is extrapolated over a part of the image, with the expected error `prediction.std_px`. With `seed_only`
        and `failed` it is the initial alignment; `reason` explains why. examples/two_arrays.py saves it as JSON.

    Raises
    ------
    InputError
        An array is not an image, a mask has a different size from its image, `seed` has complex numbers, or
        `seed_std_px` is not a positive number or has no `seed`.
    GeometryError
        `seed` is not an invertible homography.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> scene = gaussian_filter(np.random.default_rng(0).normal(size=(208, 208)), 1.5)
    >>> green, nir = scene[8:, 8:], -scene[:-8, :-8]  # reversed contrast, offset by 8 px along both axes
    >>> result = agalign.align(green, nir)
    >>> result.status
    'aligned'
    >>> result.map([100, 60]).round()
    array([108.,  68.])
    """
    settings = settings or Settings()
    if seed_std_px is not None and seed is None:
        raise InputError("seed_std_px is the standard error of a seed; give the seed too")
    if seed_std_px is not None and not 0 < seed_std_px < math.inf:
        raise InputError(f"seed_std_px is {seed_std_px!r}, not a positive number of pixels")
    fixed_raster = raster_of(fixed, fixed_valid, "fixed")
    moving_raster = raster_of(moving, moving_valid, "moving")
    matrices: SeedMatrices = {"identity": geometry.overlay(fixed_raster.size_px, moving_raster.size_px)}
    if seed is not None:
        matrices = {"user": homography_of(seed, "seed")}
    seed_std: dict[SeedKind, float] = {} if seed_std_px is None else {"user": float(seed_std_px)}
    pair = BandPair("moving", Reference(fixed_raster), moving_raster, matrices, seed_std_px=seed_std)
    pair = with_reduced_reference(pair, settings.seed)
    between_arrays = align_pairs([pair], settings, quiet)["moving"].in_file_px(pair.scales, fixed_raster.size_px)
    return replace(with_metrics(between_arrays, pair), moving_size_px=moving_raster.size_px)


@checked
def warp_onto(
    moving: "ArrayLike",
    fixed_to_moving: "ArrayLike",
    fixed_size_px: tuple[int, int],
    *,
    valid: "ArrayLike | None" = None,
    interpolation: Interpolation = "lanczos",
) -> tuple[NDArray[np.generic], Mask]:
    """Resample an image to the grid of another one by a homography.

    Use `Alignment.warp` for an alignment, which may have lenses, a displacement field or a parallax map in addition.

    Parameters
    ----------
    moving
        Image, (H, W), (H, W, C) or (C, H, W), of any numeric type.
    fixed_to_moving
        Homography (3, 3) from pixels of the output to pixels of `moving`: x right, y down, (0, 0) the centre of the
        top-left pixel.
    fixed_size_px
        (width, height) of the output, px.
    valid
        (H, W), False, 0 or NaN for pixels of `moving` that must not be used.
    interpolation
        `nearest`, `bilinear`, `cubic` or `lanczos`.

    Returns
    -------
    pixels
        The resampled image, in the layout and type of `moving`; NaN or, for integers, 0 where it is unknown.
    valid
        (height, width), True where all channels of `pixels` have a value.

    Raises
    ------
    InputError
        `moving` is not an image, `valid` has a different size, `fixed_size_px` is not a size, or `fixed_to_moving` is
        an Alignment or has complex numbers.
    GeometryError
        `fixed_to_moving` is not an invertible homography.

    Examples
    --------
    >>> image = np.arange(12.0).reshape(3, 4)
    >>> pixels, valid = agalign.warp_onto(image, [[1, 0, 1], [0, 1, 0], [0, 0, 1]], (4, 3), interpolation="nearest")
    >>> pixels[0], valid[0]
    (array([ 1.,  2.,  3., nan]), array([ True,  True,  True, False]))
    """
    if isinstance(fixed_to_moving, Alignment):
        raise InputError("an alignment is more than a homography; use its method warp(moving)")
    mapping = PixelMapping(homography_of(fixed_to_moving, "fixed_to_moving"))
    by_homography = Alignment(mapping, _size_px(fixed_size_px), (), Seed("user", mapping.fixed_to_moving, 0.0))
    return by_homography.warp(moving, valid=valid, interpolation=interpolation)


def _size_px(size_px: object) -> tuple[int, int]:
    """Return (width, height) as integers. Raises InputError unless they are two positive ones of a feasible image."""
    try:
        width, height = map(index, size_px)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        width, height = 0, 0
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        limit = f"at most {MAX_PIXELS:,} px together"
        raise InputError(f"fixed_size_px is {shortened_repr(size_px)}, not a width and a height of {limit}")
    return width, height


@checked
def align_capture(capture: Capture, out: str | Path, *, settings: Settings | None = None) -> CaptureReport:
    """Align one capture, without the network and rig of its flight, and write its rasters and sidecar.

    A band that cannot be aligned raises no error: its status and reason are in `result` of the report.

    Parameters
    ----------
    capture
        An element of `captures` of the FolderScan that `discover` returns.
    out
        Output folder. The files are written to the same subfolder as in the input folder.
    settings
        By default `Settings()`.

    Returns
    -------
    CaptureReport
        Its state is `done`.

    Raises
    ------
    UnreadableFileError
        The reference band cannot be read.
    InputError
        The capture shows a panel or the sky.
    ConfigurationError
        The capture lacks the tags or bands that a setting needs (such as those for radiance), or `out` contains the
        result of a different capture with the same name.
    OutputError
        A file cannot be written, or another run writes to `out`.

    Examples
    --------
    >>> flight = agalign.discover("flight", agalign.DiscoverOptions(bands=("Green", "NIR")))
    >>> report = agalign.align_capture(flight.captures[0], "one")
    >>> [(band.band, band.status) for band in report.sidecar.bands]
    [('Green', 'reference'), ('NIR', 'aligned')]
    """
    settings = settings or Settings()
    check_indices([capture], settings.write)
    selection = select_captures([capture], settings.write, RunOptions())
    if not selection.captures:
        what = "the sky" if selection.sky else "a calibration panel"
        raise InputError(f"{capture.label}: shows {what}; align another capture, or all with align_panels=True")
    with locked(Path(out)), written_below(Path(out)):
        refuse_results_elsewhere(selection.captures, Path(out))
        return process_capture(Task(selection.captures[0], Path(out), settings))


@checked
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
    """Align every capture below a folder, and write rasters, sidecars, summary and report.

    This is the command `agalign FOLDER -o OUT`. A network and a rig are learned for each camera and flight. Captures
    that an earlier run has finished with the same settings are kept. The logger `agalign` logs each capture at level
    INFO.

    Parameters
    ----------
    folder
        Input folder, with subfolders.
    out
        Output folder; it is created, and skipped if it is below `folder`.
    settings
        Settings that change results. By default `Settings()`.
    options
        Selection of files and bands. By default all images below `folder`; options of your own must name an output
        folder below `folder` in `skip`.
    run
        Number of processes or executor, and what to process again. With several processes the calling script must be
        importable: call this function below `if __name__ == "__main__":`.
    model
        File from the folder `models` of an earlier run with the same camera; its network and rig are reused.
    progress
        Called after each capture with its CaptureReport, the number of finished captures, and the number of captures.

    Returns
    -------
    FlightReports
        A CaptureReport for each capture, in the order in which they finished. Those of calibration panels and of the
        sky are in its attribute `excluded` instead.

    Raises
    ------
    InputError
        `folder` does not exist or contains no images, or `model` cannot be read.
    ConfigurationError
        `model` belongs to a different camera, no capture has a requested band or the tags that a setting needs, or
        `out` contains results of different captures with the same names.
    OutputError
        `out` cannot be written, another run writes to it, or the disk is full.
    WorkerError
        The worker processes cannot be started, or several end one after another.

    Examples
    --------
    >>> settings = agalign.Settings(write=agalign.WriteSettings(layout="both"))
    >>> reports = agalign.align_folder("flight", "aligned", settings=settings)
    >>> sorted((report.label, report.result.status) for report in reports)
    [('0000SET/000/IMG_0001', 'ok'), ('0000SET/000/IMG_0002', 'ok')]
    """
    end_if_reimported()
    flight = discover(Path(folder), options or DiscoverOptions(skip=(Path(out),)))
    start = None if model is None else Path(model)
    return _run(flight, Path(out), settings or Settings(), run or RunOptions(), progress, start)


@checked
def onto(
    reference: str | Path,
    moving: Sequence[str | Path],
    out: str | Path,
    *,
    band: str | None = None,
    settings: Settings | None = None,
    run: RunOptions | None = None,
) -> FlightReports:
    """Align georeferenced mosaics from other dates or sensors to the grid of a reference mosaic.

    A raster and a sidecar of each mosaic are written to `out`. The raster contains one band of the reference, then all
    bands of the mosaic. The sidecar has the status of each band.

    Parameters
    ----------
    reference
        Reference mosaic, a raster with georeference.
    moving
        Mosaics to align, rasters with georeference.
    out
        Output folder.
    band
        Name of the band of `reference` to align to. By default green.
    settings
        By default `Settings()`.
    run
        Number of processes or executor. By default `RunOptions()`.

    Returns
    -------
    FlightReports
        A CaptureReport for each mosaic, in the order in which they finished.

    Raises
    ------
    UnreadableFileError
        A mosaic does not exist or cannot be read.
    InputError
        A mosaic has no georeference, is the reference itself, or is a changed file of an earlier run.
    NoSuchBandError
        `reference` has no band `band`.
    ConfigurationError
        `out` contains results of different mosaics with the same names, or the device of `settings` cannot be used.
    OutputError
        `out` cannot be written.
    WorkerError
        The worker processes cannot be started, or several end one after another.

    Examples
    --------
    >>> (report,) = agalign.onto("june.tif", ["july.tif"], "july_on_june")
    >>> [(band.band, band.status) for band in report.sidecar.bands]
    [('june band_1', 'reference'), ('band_1', 'aligned')]
    """
    end_if_reimported()
    flight = mosaics_onto(Path(reference), [Path(path) for path in moving], band)
    check_products([Path(reference), *map(Path, moving)])
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
    reports = FlightReports()
    listener = Listener(on_again=_LOG.info, on_problem=_LOG.warning)
    with closing(run_flight(flight, out, settings, run, listener, start)) as finished:
        for report in finished:
            if report.state in ("panel", "sky"):  # before the others
                reports.excluded.append(report)
                _LOG.info("%s: %s", report.label, report.summary)
                continue
            reports.append(report)
            captures = len(flight.captures) - len(reports.excluded)
            _LOG.info("%d of %d: %s: %s", len(reports), captures, report.label, report.summary)
            if progress is not None:
                progress(report, len(reports), captures)
    return reports


@checked
def indices(
    out: str | Path,
    names: Sequence[str] | None = None,
    *,
    formulas: Sequence[str] = (),
    target: str | Path | None = None,
    mask_qa: bool = False,
    run: RunOptions | None = None,
) -> list[IndexReport]:
    """Compute spectral indices of the aligned captures of a run, and write a raster and a picture of each.

    The table indices.csv has a row for each capture and index. Next to the stacks of a run, its report is updated.

    Parameters
    ----------
    out
        Output folder of a run.
    names
        Names of indices, such as ndvi or ndre. By default ndvi, or none with `formulas`.
    formulas
        Further indices as "name=formula", such as "mine=(N-RE)/(N+RE)", of the bands B, G, R, RE and N.
    target
        Folder for the rasters, pictures and the table. By default `out`.
    mask_qa
        Mask saturated, occluded and misaligned pixels. The run must have written quality rasters
        (`WriteSettings(qa=True)`).
    run
        Number of processes or executor, and whether to compute existing indices again. By default `RunOptions()`.

    Returns
    -------
    list of IndexReport
        A report for each capture and index. If an index could not be computed, `problem` says why.

    Raises
    ------
    InputError
        `out` is not the output folder of a run.
    ConfigurationError
        An index is unknown, a formula is invalid, or `target` has an indices.csv that agalign did not write.
    OutputError
        `target` cannot be written.
    WorkerError
        The worker processes cannot be started, or several end one after another.

    Examples
    --------
    >>> reports = agalign.indices("aligned", ["ndvi"], formulas=["mine=(N-RE)/(N+RE)"])
    >>> [(report.index, report.path.name, report.problem) for report in reports[:2]]
    [('ndvi', 'IMG_0001_ndvi.tif', ''), ('mine', 'IMG_0001_mine.tif', '')]
    """
    end_if_reimported()
    folder, options = Path(out if target is None else target), run or RunOptions()
    chosen = chosen_indices(names, formulas)
    tasks = index_tasks(Path(out), chosen, folder, overwrite=options.overwrite, mask_qa=mask_qa)
    with locked(folder):
        done = run_indices(tasks, options.jobs, options.executor, _LOG.warning)
        return [report for of_capture in done for report in of_capture]


@checked
def export(out: str | Path, target: str | Path, program: ExportProgram, *, copy: bool = False) -> ExportReport:
    """Export the captures with status `ok` of a run to a new folder for a photogrammetry program.

    Captures whose bands or quantity differ from most others are skipped and listed.

    Parameters
    ----------
    out
        Output folder of a run that wrote band files (`WriteSettings(layout="bands")` or `"both"`).
    target
        Folder to create; it may exist if it is empty.
    program
        `odm` (OpenDroneMap, WebODM), `metashape` (Agisoft Metashape) or `pix4d` (Pix4Dmapper, Pix4Dfields).
    copy
        Copy the files. By default they are hard links if the file system supports them.

    Returns
    -------
    ExportReport
        The exported files, the skipped captures, and `notes` with instructions for the program.

    Raises
    ------
    InputError
        `out` is not the output folder of a run, or no capture has the status `ok`.
    ConfigurationError
        The run wrote no band files, or cloud-optimised ones, which lack the tags of the camera.
    OutputError
        `target` is not empty or cannot be written.

    Examples
    --------
    >>> report = agalign.export("aligned", "for_odm", "odm")
    >>> report.captures, report.files[0].as_posix(), report.left_out
    (2, 'for_odm/images/0000SET_000_IMG_0001_1.tif', [])
    """
    return export_run(Path(out), Path(target), program, copy=copy)
