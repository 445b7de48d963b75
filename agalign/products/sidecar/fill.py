"""The sidecar of a capture, from its alignments and the files that were written."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator

from agalign._version import __version__
from agalign.cameras.base import is_thermal
from agalign.errors import UnreadableFileError
from agalign.flight.fingerprint import fingerprint, input_samples
from agalign.products.product import ProductContext, WrittenFile
from agalign.products.rasters.aligned_files import BandFiles, Stack
from agalign.products.rasters.relief_map import ReliefMap
from agalign.products.sidecar.schema import BandPart, Sidecar, is_usable
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band
from agalign.values.choices import CaptureStatus
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedFilePx

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
        [_file(f, context) | {"nodata": _nodata(f.nodata)} for f in context.written if f.kind == kind]
        for kind in (Stack.kind, BandFiles.kind)
    )
    stack: dict[str, Any] = stacks[0] if stacks else {"file": None, "bytes": None}
    values = {part["nodata"] for part in stacks or band_files}
    grid, capture = context.grid, context.capture
    is_raw = context.settings.write.radiometry == "off"
    radiometry = {b.name: b.radiometry for b in capture.bands if b.radiometry is not None and not is_raw}
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


def _nodata(value: float | None) -> float | str | None:
    """The value, with the text "nan" for nan, which JSON does not have."""
    return "nan" if value is not None and math.isnan(value) else value


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
        is_comparable = not (is_thermal(band) or band.companion)  # companions are exposed automatically
        levels = context.reduced_bands.levels.get(band.name) if is_comparable else None
        facts["saturated"] = context.reduced_bands.saturated.get(band.name)
        facts["levels"] = [] if levels is None else levels.tolist()
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


def _metrics(alignment: Alignment[FixedFilePx]) -> dict[str, Any]:
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
