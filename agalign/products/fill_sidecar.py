"""The sidecar of a capture, from its alignments and the files that were written."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

from agalign._version import __version__
from agalign.flight.fingerprint import fingerprint
from agalign.products.band_files import BandFiles
from agalign.products.product import ProductContext, WrittenFile
from agalign.products.relief_map import ReliefMap
from agalign.products.sidecar import (
    BandPart,
    CameraPart,
    FieldPart,
    FilePart,
    GeometryPart,
    GridPart,
    HomographyPart,
    IssuePart,
    JointPart,
    LensPart,
    Matrix3x3,
    MetricsPart,
    OutputPart,
    PlacePart,
    PositionPart,
    PredictionPart,
    ProductPart,
    ReferencePart,
    ReliefPart,
    ResidualTile,
    SeedPart,
    Sidecar,
    SimilarityPart,
    is_delivered,
)
from agalign.products.stack import Stack
from agalign.values import geometry
from agalign.values.alignment import JointResult, Prediction, Residual
from agalign.values.capture import Band, Capture
from agalign.values.choices import CaptureStatus
from agalign.values.displacement import DisplacementField
from agalign.values.files import file_checksum
from agalign.values.geometry import Matrix, Points
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedFilePx
from agalign.values.relief import Relief

_GRIDS = ((17, 13), (33, 25), (65, 49), (129, 97))
"""Columns and rows of the sampled mapping, each with the points halfway between those of the one before; the first with
a small enough error is used."""
_MAX_INTERPOLATION_ERROR_PX, _INTERPOLATION_PERCENTILE = 0.02, 99
"""Maximum of this percentile of the error of cubic interpolation: less than the error of an alignment. The largest
errors are at the border, where the derivatives are estimated from one side."""


def capture_status(bands: Iterable[BandPart], accept_predicted_px: float) -> CaptureStatus:
    """Return `ok` if every moving band is delivered, `failed` if all failed, else `degraded`."""
    moving = [b for b in bands if b.status != "reference"]
    predicted_px = [None if b.prediction is None else b.prediction.std_px for b in moving]
    if all(is_delivered(b.status, px, accept_predicted_px) for b, px in zip(moving, predicted_px, strict=True)):
        return "ok"
    return "failed" if all(b.status == "failed" for b in moving) else "degraded"


def sidecar_of(context: ProductContext, not_written: Sequence[str] = ()) -> Sidecar:
    """Return the sidecar of a capture after its products were written; `not_written` has the kinds that failed.

    Raises OutputError.
    """
    capture, reference = context.capture, context.capture.reference
    bands = [_band_part(context, band) for band in capture.bands]
    accept_predicted_px = context.settings.check.accept_predicted_px
    status = capture_status(bands, accept_predicted_px)
    return Sidecar(
        agalign=__version__,
        capture=capture.name,
        capture_id=capture.capture_id,
        flight_id=capture.flight_id,
        captured_at=capture.captured_at,
        position=None if capture.position is None else PositionPart(**asdict(capture.position)),
        camera=CameraPart(make=capture.camera.make, model=capture.camera.model, serial=capture.camera.serial),
        status="degraded" if status == "ok" and capture.missing_bands else status,
        missing_bands=list(capture.missing_bands),
        reference=ReferencePart(
            band=reference.name,
            file=reference.path.name,
            band_index=reference.band_index,
            width=reference.width_px,
            height=reference.height_px,
        ),
        bands=bands,
        output=_output_part(context) if context.layers else None,
        preview=next((f.preview for f in context.written if f.preview is not None), None),
        accept_predicted_px=accept_predicted_px,
        products=[_product_part(file, context) for file in context.written],
        not_written=list(not_written),
        settings=fingerprint(capture, context.settings),
    )


def _output_part(context: ProductContext) -> OutputPart:
    """The stack and the band files; older readers use these fields instead of `products`."""
    stacks, band_files = _file_parts(Stack.kind, context), _file_parts(BandFiles.kind, context)
    stack = stacks[0] if stacks else None
    values = {part.nodata for part in stacks or band_files}
    grid = context.grid
    return OutputPart(
        file=None if stack is None else stack.file,
        bytes=None if stack is None else stack.bytes,
        band_files=band_files,
        radiometry=None if context.write_settings.radiometry == "off" else _radiometry(context.capture),
        crop=(grid.x0, grid.y0, grid.width, grid.height),
        scale=(grid.scale.x, grid.scale.y),
        undistorted=grid.undistorted,
        nodata=values.pop() if len(values) == 1 else None,
    )


def _file_parts(kind: str, context: ProductContext) -> list[FilePart]:
    return [
        FilePart(file=_name(file.path, context), bytes=file.path.stat().st_size, nodata=_nodata(file.nodata))
        for file in context.written
        if file.kind == kind
    ]


def _product_part(file: WrittenFile, context: ProductContext) -> ProductPart:
    """Raises OutputError."""
    checksum, size = file_checksum(file.path), file.path.stat().st_size
    return ProductPart(kind=file.kind, file=_name(file.path, context), bytes=size, sha256=checksum)


def _name(path: Path, context: ProductContext) -> str:
    return path.relative_to(context.paths.folder).as_posix()


def _radiometry(capture: Capture) -> str | None:
    names = dict.fromkeys(f"{b.radiometry.quantity} by {b.radiometry.source}" for b in capture.bands if b.radiometry)
    return " and ".join(names) or None


def _nodata(value: float | None) -> float | str | None:
    """The value, with the text "nan" for nan, which JSON does not have."""
    return "nan" if value is not None and math.isnan(value) else value


def _place(context: ProductContext, band: Band) -> PlacePart | None:
    """The file with the aligned pixels of a band; None if all of them are nodata."""
    place = context.places.get(band.name)
    return None if place is None else PlacePart(file=_name(place[0], context), band_index=place[1])


def _band_part(context: ProductContext, band: Band) -> BandPart:
    place = _place(context, band)
    if band is not context.capture.reference:
        return _moving_part(context, band, place)
    return BandPart(
        band=band.name, wavelength_nm=band.wavelength_nm, file=band.path.name, band_index=band.band_index,
        status="reference", reason=None, place=place, seconds=0.0,
    )  # fmt: skip


def _relief_part(context: ProductContext, mapping: PixelMapping, nodes_px: Points) -> ReliefPart | None:
    parallax = mapping.parallax
    if parallax is None:
        return None
    # The mapping is linear in the parallax: its values for a parallax of 0 and of 1 px determine it.
    flat = np.zeros((1, 1), np.float32)
    at_zero, at_one = (
        replace(mapping, parallax=replace(parallax, relief=Relief(flat + parallax_px, flat)))(nodes_px)
        for parallax_px in (0, 1)
    )
    file = next((f.path for f in context.written if f.kind == ReliefMap.kind), None)
    occluded = 0.0 if parallax.hidden is None else float(parallax.hidden.mean())
    return ReliefPart(
        file=None if file is None else _name(file, context), baseline=parallax.baseline, occluded=round(occluded, 4),
        reference_px=_points(nodes_px), plane_px=_points(at_zero), slope=_points(at_one - at_zero),
    )  # fmt: skip


def _moving_part(context: ProductContext, band: Band, place: PlacePart | None) -> BandPart:
    reference, alignment = context.capture.reference, context.alignments[band.name]
    joint, residual = alignment.joint, alignment.residual
    mapping = alignment.mapping
    grid_px = _grid_px(mapping.of_the_plane, reference.size_px)
    after = dict(alignment.after) | _residual_metrics(residual)
    return BandPart(
        band=band.name,
        wavelength_nm=band.wavelength_nm,
        file=band.path.name,
        band_index=band.band_index,
        status=alignment.status,
        reason=alignment.reason,
        doubts=[IssuePart(kind=d.code, value=_finite(d.value), limit=_finite(d.limit)) for d in alignment.issues],
        homography=HomographyPart(fixed_to_moving=_rows(alignment.fixed_to_moving), space=alignment.space),
        seed=SeedPart(
            kind=alignment.seed.kind,
            fixed_to_moving=_rows(alignment.seed.fixed_to_moving),
            peak_sigma=alignment.seed.peak_sigma,
            runner_up_sigma=alignment.seed.runner_up_sigma,
        ),
        grid=GridPart(reference_px=_points(grid_px), moving_px=_points(mapping(grid_px))),
        joint=None if joint is None else _joint_part(joint, accepted=alignment.status == "aligned"),
        metrics=MetricsPart(
            before=_similarity_part(alignment.before), after=_similarity_part(after), tiles=_tile_parts(residual)
        ),
        geometry=GeometryPart(
            kind=alignment.geometry, held_out_p95_px={k: _finite(round(v, 4)) for k, v in alignment.candidates.items()}
        ),
        lenses=_lens_parts(mapping),
        field=None if mapping.local is None else _field_part(mapping.local, reference.size_px),
        relief=_relief_part(context, mapping, grid_px),
        prediction=None if alignment.prediction is None else _prediction_part(alignment.prediction),
        place=place,
        seconds=round(alignment.seconds, 3),
    )


def _residual_metrics(residual: Residual[FixedFilePx] | None) -> dict[str, float]:
    if residual is None:
        return {}
    coverage = {"residual_coverage": residual.coverage}
    if not math.isfinite(residual.median_px):
        return coverage
    return {"residual_px": residual.median_px, "residual_p95_px": residual.p95_px} | coverage


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


def _lens_parts(mapping: PixelMapping) -> tuple[LensPart, LensPart] | None:
    if mapping.fixed_lens is None or mapping.moving_lens is None:
        return None
    return _lens_part(mapping.fixed_lens), _lens_part(mapping.moving_lens)


def _lens_part(lens: Lens) -> LensPart:
    return LensPart(**(asdict(lens) | {"distortion": list(lens.distortion)}))


def _field_part(field: DisplacementField, size_px: tuple[int, int]) -> FieldPart:
    on_file = field.on_lattice(field.step_px / field.scale.mean, size_px)
    return FieldPart(step_px=on_file.step_px, displacements_px=[_points(row) for row in on_file.displacements_px])


def _prediction_part(prediction: Prediction) -> PredictionPart:
    off_px = None if prediction.off_px is None else round(prediction.off_px, 4)
    return PredictionPart(source=prediction.source, std_px=round(prediction.std_px, 4), off_px=off_px)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _joint_part(joint: JointResult[FixedFilePx], *, accepted: bool) -> JointPart:
    return JointPart(
        accepted=accepted, loss=_finite(joint.loss), retrieval=joint.retrieval, chance=joint.chance,
        iterations=joint.iterations, levels=list(joint.levels), recipe=joint.recipe, model_family=joint.model_family,
        last_step_px=joint.last_step_px, corner_std_px=round(joint.corner_std_px, 6),
        corner_std_xy_px=[(round(x, 4), round(y, 4)) for x, y in joint.corner_std_xy_px],
    )  # fmt: skip


def _similarity_part(metrics: Mapping[str, float]) -> SimilarityPart:
    # Digits beyond the sixth depend on the order in which threads add up.
    return SimilarityPart(**{k: round(v, 6) if math.isfinite(v) else None for k, v in metrics.items()})


def _tile_parts(residual: Residual[FixedFilePx] | None) -> list[ResidualTile]:
    if residual is None:
        return []
    return [
        ResidualTile(
            centre_px=(round(c[0], 2), round(c[1], 2)),
            shift_px=(round(s[0], 4), round(s[1], 4)) if math.isfinite(s[0]) else (None, None),
        )
        for c, s in zip(residual.centres_px.tolist(), residual.shifts_px.tolist(), strict=True)
    ]


def _rows(matrix: Matrix) -> Matrix3x3:
    a, b, c = (tuple(row) for row in matrix.tolist())
    return a, b, c


def _points(points_px: NDArray[np.float64]) -> list[tuple[float, float]]:
    return [(x, y) for x, y in np.round(points_px, 4).tolist()]
