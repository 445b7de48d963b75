"""The sidecar of a capture, from its alignments and written files, and the mapping of a band, from the sidecar."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

from agalign._version import __version__
from agalign.errors import NoSuchBandError, SidecarError, UnreadableFileError
from agalign.flight.fingerprint import fingerprint, input_samples
from agalign.pixels.raster import read_preview
from agalign.products.product import ProductContext, WrittenFile
from agalign.products.rasters.aligned_files import BandFiles, Stack
from agalign.products.rasters.alignment_maps import ReliefMap
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import BandPart, ReliefPart, Sidecar, is_usable
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, Residual, Seed
from agalign.values.capture import Band
from agalign.values.choices import CaptureStatus
from agalign.values.geometry import Points
from agalign.values.image import OutputGrid
from agalign.values.issues import KINDS, Issue
from agalign.values.lens import Lens
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief

_GRIDS = ((17, 13), (33, 25), (65, 49), (129, 97))
"""Columns and rows of the sampled mapping, each with the points halfway between those of the one before; the first with
a small enough error is used."""
_MAX_INTERPOLATION_ERROR_PX, _INTERPOLATION_PERCENTILE = 0.02, 99
"""Maximum of this percentile of the error of cubic interpolation: less than the error of an alignment. The largest
errors are at the border, where the derivatives are estimated from one side."""


def capture_status(bands: Iterable[BandPart], accept_predicted_px: float) -> CaptureStatus:
    """Return `ok` if every moving band is usable, `failed` if all failed, else `degraded`."""
    moving = [b for b in bands if b.status != "reference"]
    if all(is_usable(b.status, b.prediction, accept_predicted_px) for b in moving):
        return "ok"
    return "failed" if all(b.status == "failed" for b in moving) else "degraded"


def sidecar_of(context: ProductContext, not_written: Sequence[str] = (), seconds: float = 0.0) -> Sidecar:
    """Return the sidecar of a capture after its products were written; `not_written` has the kinds that failed, and
    `seconds` is the processing time.

    Raises OutputError.
    """
    capture, reference = context.capture, context.capture.reference
    bands = [_band_part(context, band) for band in capture.bands]
    accept_predicted_px = context.settings.check.accept_predicted_px
    status = capture_status(bands, accept_predicted_px)
    (width, height), place = reference.size_px, reference.georeference
    is_mosaic = place is not None and place.accuracy_m is None  # else it was calculated from GPS
    facts = {
        "agalign": __version__,
        "capture": capture.name,
        **_fields(capture, "capture_id", "flight_id", "captured_at", "position", "camera", "missing_bands"),
        "status": "degraded" if status == "ok" and capture.missing_bands else status,
        "reference": _source(reference) | {"width": width, "height": height, "georeferenced": is_mosaic},
        "bands": bands,
        "output": _output(context) if context.layers else None,
        "preview": next((f.preview for f in context.written if f.preview is not None), None),
        "accept_predicted_px": accept_predicted_px,
        "products": [_file(f, context) | {"kind": f.kind, "sha256": f.sha256} for f in context.written],
        "not_written": not_written,
        "settings": fingerprint(capture, context.settings),
        "options": context.settings.model_dump(mode="json", exclude_defaults=True),
        "input_samples": input_samples(capture),
        "seconds": seconds,
    }
    return Sidecar.model_validate(facts)


def _output(context: ProductContext) -> dict[str, Any]:
    """The stack and the band files; older readers use these fields instead of `products`."""
    stacks, band_files = (
        [_file(f, context) | {"nodata": f.nodata_in_json} for f in context.written if f.kind == kind]
        for kind in (Stack.kind, BandFiles.kind)
    )
    stack: dict[str, Any] = stacks[0] if stacks else {"file": None, "bytes": None}
    values = {part["nodata"] for part in stacks or band_files}
    grid, capture = context.grid, context.capture
    radiometry = {b.name: b.radiometry for b in capture.bands if b.radiometry is not None and not context.is_raw}
    names = dict.fromkeys(f"{r.quantity} by {r.source}" for r in radiometry.values())
    return stack | {
        "band_files": band_files,
        "radiometry": " and ".join(names) or None,
        "panel_age_s": next((r.panel_age_s for r in radiometry.values() if r.panel_age_s is not None), None),
        "illumination": [
            {"band": name, "irradiance": r.irradiance, "reflectance_per_radiance": r.factor}
            for name, r in radiometry.items()
            if "reflectance" in r.quantity
        ],
        "crop": (grid.x0, grid.y0, grid.width, grid.height),
        "scale": grid.scale,
        "undistorted": grid.undistorted,
        "vignetting_corrected": any(file.is_flat for file in context.written),
        "nodata": values.pop() if len(values) == 1 else None,
    }


def _file(file: WrittenFile, context: ProductContext) -> dict[str, Any]:
    return {"file": context.paths.relative(file.path), "bytes": file.path.stat().st_size}


def _fields(record: object, *names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


def _source(band: Band) -> dict[str, Any]:
    return {"band": band.name, "file": band.path.name, "band_index": band.band_index}


def _band_part(context: ProductContext, band: Band) -> BandPart:
    place = context.places.get(band.name)  # None if all pixels are nodata
    facts = _source(band) | {
        "wavelength_nm": band.wavelength_nm,
        "place": None if place is None else {"file": context.paths.relative(place[0].path), "band_index": place[1]},
        "size_px": band.size_px,
    }
    with suppress(UnreadableFileError):  # the preview has failed with this reason
        facts["saturated"] = context.reduced_bands.saturated.get(band.name)
    if band is context.capture.reference:
        return BandPart.model_validate(facts | {"status": "reference", "reason": None, "seconds": 0.0})
    alignment = context.alignments[band.name]
    mapping, size_px = alignment.mapping, context.capture.reference.size_px
    grid_px = _grid_px(mapping.of_the_plane, size_px)
    lenses = (mapping.fixed_lens, mapping.moving_lens)
    facts |= _fields(alignment, "status", "reason", "issues", "seed", "joint", "prediction", "seconds")
    facts |= {
        "homography": alignment,
        "grid": {"reference_px": grid_px, "moving_px": mapping(grid_px)},
        "metrics": _metrics(alignment),
        "geometry": {"kind": alignment.geometry, "held_out_p95_px": alignment.candidates},
        "lenses": None if None in lenses else lenses,
        "field": mapping.field,
        "relief": _relief(context, mapping, grid_px),
    }
    part = BandPart.model_validate(facts)
    if part.joint is not None:
        part.joint.accepted = alignment.status == "aligned"
    return part


def _metrics(alignment: Alignment) -> dict[str, Any]:
    residual, before, after = alignment.residual, dict(alignment.before), dict(alignment.after)
    if residual is None:
        return {"before": before, "after": after, "tiles": []}
    after |= {"residual_px": residual.median_px, "residual_p95_px": residual.p95_px}
    after["residual_coverage"] = residual.coverage
    values = residual.centres_px, residual.shifts_px, residual.peaks_sigma, residual.cells
    names = "centre_px", "shift_px", "peak_sigma", "cell"
    tiles = [dict(zip(names, window, strict=True)) for window in zip(*(v.tolist() for v in values), strict=True)]
    return {"before": before, "after": after, "tiles": tiles}


def _relief(context: ProductContext, mapping: PixelMapping, nodes_px: Points) -> dict[str, Any] | None:
    parallax = mapping.parallax
    if parallax is None:
        return None
    # Parabolas through the value at 0 are fitted over the range of the scene: lenses and tilt bend the mapping.
    z_px = parallax.relief.parallax_px
    levels_px = np.linspace(min(-1.0, z_px.min()), max(1.0, z_px.max()), 5)
    plane_px, *others_px = (mapping.at_parallax(nodes_px, parallax.baseline, z) for z in (0, *levels_px))
    powers = np.stack([levels_px, levels_px**2], axis=-1)
    moved_px = np.reshape(others_px - plane_px, (len(levels_px), -1))
    slope, curvature = np.linalg.lstsq(powers, moved_px, rcond=None)[0].reshape(2, *plane_px.shape)
    return {
        "file": next((context.paths.relative(f.path) for f in context.written if f.kind == ReliefMap.kind), None),
        "baseline": parallax.baseline,
        "occluded": 0.0 if parallax.hidden is None else float(parallax.hidden.mean()),
        "reference_px": nodes_px,
        "plane_px": plane_px,
        "slope": slope,
        "curvature": curvature,
    }


def _grid_px(mapping: PixelMapping, size_px: tuple[int, int]) -> Points:
    """Return the points (n, 2) from which cubic interpolation reproduces a smooth mapping, or the densest grid.

    Clough-Tocher, which works on any points, is less accurate than splines on the lattice.
    """
    points_px = geometry.lattice(*size_px, *_GRIDS[0])
    if min(size_px) == 1:
        return points_px  # points on one line have no triangles
    for finer in _GRIDS[1:]:
        interpolated = CloughTocher2DInterpolator(points_px, mapping(points_px))
        finer_px = geometry.lattice(*size_px, *finer)
        error_px = np.abs(interpolated(finer_px) - mapping(finer_px))
        # Rounding moves some points at the border outside of the triangles: NaN.
        if np.nanpercentile(error_px, _INTERPOLATION_PERCENTILE) <= _MAX_INTERPOLATION_ERROR_PX:
            break
        points_px = finer_px
    return points_px


def read_alignment(sidecar: str | Path, band: str) -> Alignment:
    """Return the alignment of a moving band as a sidecar and its relief raster store it.

    Its `map`, `inverse` and `warp` are those of the run, between the raw pixels of the files; the relief, and occlusion
    by it, is known in the area that was written. `joint` and `prediction` are None, `before` and `after` empty.
    Raises SidecarError for a file that is not a sidecar or lacks the mapping, NoSuchBandError for a band that is not a
    moving band of the capture, UnreadableFileError for a relief raster that cannot be read.
    """
    path = Path(sidecar)
    content = read_sidecar(path)
    parts = {b.band: b for b in content.bands if b.status != "reference"}
    if band not in parts:
        raise NoSuchBandError(f"{path}: no moving band {band!r}; choose from {', '.join(parts)}")
    part = parts[band]
    if part.homography is None or part.seed is None:
        raise SidecarError(f"{path}: has no mapping of the band {band!r}")
    fixed, moving = (None, None) if part.lenses is None else (Lens(**dict(one)) for one in part.lenses)
    field = None if part.field is None else DisplacementField(part.field.step_px, np.array(part.field.displacements_px))
    mapping = PixelMapping(np.array(part.homography.fixed_to_moving), fixed, moving, field=field)
    if part.relief is not None:
        mapping = mapping.with_parallax(_parallax_of(path, content, part.relief, fixed))
    peaks = part.seed.peak_sigma, part.seed.runner_up_sigma
    seed = Seed(part.seed.kind, np.array(part.seed.fixed_to_moving), part.seed.peak_sigma, *peaks)
    issues = tuple(Issue(KINDS[i.kind], i.value, i.limit) for i in part.issues)
    held_out_px = {} if part.geometry is None else part.geometry.held_out_p95_px
    facts: dict[str, Any] = {"residual": _residual_of(part), "seconds": part.seconds, "moving_size_px": part.size_px}
    facts["candidates"] = {k: float(math.inf if px is None else px) for k, px in held_out_px.items()}
    return Alignment(mapping, content.reference.size_px, part.status, issues, seed, **facts)


def _residual_of(part: BandPart) -> Residual | None:
    tiles = [] if part.metrics is None else [t for t in part.metrics.tiles if t.cell is not None]
    if part.metrics is None or len(tiles) < len(part.metrics.tiles):
        return None
    centres, shifts = np.array([(t.centre_px, t.shift_px) for t in tiles], float).reshape(-1, 2, 2).swapaxes(0, 1)
    peaks, cells = np.array([t.peak_sigma for t in tiles], float), np.array([t.cell for t in tiles], np.int64)
    return Residual.of(centres, shifts, peaks, cells.reshape(-1, 2))


def _parallax_of(path: Path, content: Sidecar, part: ReliefPart, fixed: Lens | None) -> Parallax:
    """Return the parallax of a band, from the raster that was written on the output grid."""
    if part.file is None or content.output is None:
        raise SidecarError(f"{path}: its relief was not written")
    if content.output.undistorted and fixed is None:
        raise SidecarError(
            f"{path}: has a relief on a lens-corrected grid, but not the lens; run again without --undistort"
        )
    grid = content.output.grid
    values = read_preview(path.parent / part.file, 1, (0, 0, grid.width, grid.height), (grid.width, grid.height))
    parallax_px = _on_reference(values, grid, content.reference.size_px, fixed)
    relief = Relief(parallax_px, np.ones_like(parallax_px))
    return Parallax(relief, part.baseline).with_occlusions()


def _on_reference(
    values: NDArray[np.float32], grid: OutputGrid, size_px: tuple[int, int], fixed: Lens | None
) -> NDArray[np.float32]:
    """Return values (height, width) on a grid at the raw pixels of the reference; those at the edge are continued."""
    points = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in size_px)), axis=-1)
    if grid.undistorted:
        points = lens.undistort(fixed, points)
    at = (grid.scale.positions(points) - (grid.x0, grid.y0)).astype(np.float32)
    return np.asarray(cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
