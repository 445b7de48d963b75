"""A capture's outcome as its sidecar."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from agalign._version import __version__
from agalign.config import Settings, WriteSettings
from agalign.flight.fingerprint import fingerprint
from agalign.products.sidecar import (
    BandPart,
    CameraPart,
    FilePart,
    GridPart,
    HomographyPart,
    IssuePart,
    JointPart,
    LocalPart,
    Matrix3x3,
    MetricsPart,
    OutputPart,
    PlacePart,
    PositionPart,
    PredictionPart,
    PreviewPart,
    ReferencePart,
    ResidualTile,
    SeedPart,
    Sidecar,
    SimilarityPart,
)
from agalign.products.write import Written
from agalign.values import geometry
from agalign.values.alignment import Alignment, DisplacementResult, JointResult, Prediction, Residual
from agalign.values.capture import Band, Capture
from agalign.values.choices import CaptureStatus
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping, mapping_of

_GRID = 17, 13
_FINE_GRID = 65, 49
"""Local displacements need more points, and so does a lens that the reference's own does not nearly undo."""
_MAX_BENT_PX = 0.2


def capture_status(bands: Iterable[BandPart], accept_predicted_px: float) -> CaptureStatus:
    """Ok where every moving band is delivered, failed where none is of use, else degraded."""
    moving = [b for b in bands if b.status != "reference"]
    if all(is_delivered(b, accept_predicted_px) for b in moving):
        return "ok"
    return "failed" if all(b.status == "failed" for b in moving) else "degraded"


def is_delivered(band: BandPart, accept_predicted_px: float) -> bool:
    """True for a band that is aligned, or predicted this well."""
    if band.status == "predicted" and band.prediction is not None:
        return band.prediction.std_px <= accept_predicted_px
    return band.status in ("reference", "aligned")


def sidecar_of(
    capture: Capture, alignments: dict[str, Alignment], written: Written | None, settings: Settings,
    preview: PreviewPart | None = None,
) -> Sidecar:  # fmt: skip
    """The sidecar of a capture whose moving bands have the given alignments, by band name."""
    reference = capture.reference
    parts = []
    for band in capture.bands:
        if band is reference:
            parts.append(
                BandPart(
                    band=band.name,
                    wavelength_nm=band.wavelength_nm,
                    file=band.path.name,
                    band_index=band.band_index,
                    status="reference",
                    reason=None,
                    seconds=0.0,
                )
            )
        else:
            parts.append(_band_part(reference, band, alignments[band.name]))
    if written is not None:
        parts = [p.model_copy(update={"place": _place(written, p.band)}) for p in parts]
    status = capture_status(parts, settings.check.accept_predicted_px)
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
        bands=parts,
        output=None if written is None else _output_part(capture, written, settings.write),
        preview=preview,
        settings=fingerprint(capture, settings),
    )


def _output_part(capture: Capture, written: Written, settings: WriteSettings) -> OutputPart:
    grid, stack = written.grid, written.stack
    values = {path: _nodata(value) for path, value in written.nodata.items()}
    alike = set(values.values() if stack is None else [values[stack]])
    return OutputPart(
        file=None if stack is None else stack.name,
        bytes=None if stack is None else stack.stat().st_size,
        band_files=[
            FilePart(
                file=path.relative_to(written.folder).as_posix(), bytes=path.stat().st_size, nodata=values[path],
            )
            for path in written.band_files
        ],
        radiometry=None if settings.radiometry == "off" else _radiometry(capture),
        crop=(grid.x0, grid.y0, grid.width, grid.height),
        scale=grid.scale_xy,
        nodata=alike.pop() if len(alike) == 1 else None,
    )  # fmt: skip


def _radiometry(capture: Capture) -> str | None:
    made = dict.fromkeys(f"{b.radiometry.quantity} by {b.radiometry.source}" for b in capture.bands if b.radiometry)
    return " and ".join(made) or None


def _nodata(value: float | None) -> float | str | None:
    """JSON has no nan."""
    return "nan" if value is not None and math.isnan(value) else value


def _place(written: Written, band: str) -> PlacePart | None:
    """Not of a band that is all nodata."""
    if band not in written.places:
        return None
    path, index = written.places[band]
    return PlacePart(file=path.relative_to(written.folder).as_posix(), band_index=index)


def _band_part(reference: Band, band: Band, alignment: Alignment) -> BandPart:
    joint, residual = alignment.joint, alignment.residual
    local = alignment.local
    mapping = mapping_of(reference, band, alignment)
    bent = alignment.field is not None or _is_curved(mapping, reference.size_px)
    grid_px = geometry.lattice(*reference.size_px, *(_FINE_GRID if bent else _GRID))
    there_px = mapping(grid_px)
    after = dict(alignment.after)
    if residual is not None and math.isfinite(residual.median_px):
        after |= {"residual_px": residual.median_px, "residual_p95_px": residual.p95_px}
    if residual is not None:
        after["residual_coverage"] = residual.coverage
    return BandPart(
        band=band.name,
        wavelength_nm=band.wavelength_nm,
        file=band.path.name,
        band_index=band.band_index,
        status=alignment.status,
        reason=alignment.reason,
        doubts=[IssuePart(kind=d.kind, value=_finite(d.value), limit=_finite(d.limit)) for d in alignment.issues],
        homography=HomographyPart(fixed_to_moving=_rows(alignment.fixed_to_moving), space=alignment.space),
        seed=SeedPart(
            kind=alignment.seed.kind,
            fixed_to_moving=_rows(alignment.seed.fixed_to_moving),
            peak_sigma=alignment.seed.peak_sigma,
            runner_up_sigma=alignment.seed.runner_up_sigma,
        ),
        grid=GridPart(reference_px=_points(grid_px), moving_px=_points(there_px)),
        joint=None if joint is None else _joint_part(joint, accepted=alignment.status == "aligned"),
        metrics=MetricsPart(
            before=_similarity_part(alignment.before), after=_similarity_part(after), tiles=_tile_parts(residual)
        ),
        local=None if local is None else _local_part(local),
        prediction=None if alignment.prediction is None else _prediction_part(alignment.prediction),
        seconds=round(alignment.seconds, 3),
    )


def _is_curved(mapping: PixelMapping, size_px: tuple[int, int]) -> bool:
    """True where the middles between the points of a coarse grid lie aside from the straight lines between them."""
    points = geometry.lattice(*size_px, *_GRID).reshape(_GRID[1], _GRID[0], 2)
    there = mapping(points)
    straight = mapping(0.5 * (points[:, 1:] + points[:, :-1])) - 0.5 * (there[:, 1:] + there[:, :-1])
    return bool(np.abs(straight).max() > _MAX_BENT_PX)


def _prediction_part(prediction: Prediction) -> PredictionPart:
    off_px = None if prediction.off_px is None else round(prediction.off_px, 4)
    return PredictionPart(source=prediction.source, std_px=round(prediction.std_px, 4), off_px=off_px)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _local_part(local: DisplacementResult) -> LocalPart:
    before, after = _finite(local.before_p95_px), _finite(local.after_p95_px)
    return LocalPart(applied=local.field is not None, before_p95_px=before, after_p95_px=after)


def _joint_part(joint: JointResult, *, accepted: bool) -> JointPart:
    return JointPart(
        accepted=accepted, loss=_finite(joint.loss), retrieval=joint.retrieval, chance=joint.chance,
        iterations=joint.iterations, levels=list(joint.levels), recipe=joint.recipe, model_family=joint.model_family,
        last_step_px=joint.last_step_px, corner_std_px=round(joint.corner_std_px, 6),
        corner_std_xy_px=[(round(x, 4), round(y, 4)) for x, y in joint.corner_std_xy_px],
    )  # fmt: skip


def _similarity_part(metrics: Mapping[str, float]) -> SimilarityPart:
    # Digits beyond the sixth depend on how many threads added them up.
    return SimilarityPart(**{k: round(v, 6) if math.isfinite(v) else v for k, v in metrics.items()})


def _tile_parts(residual: Residual | None) -> list[ResidualTile]:
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
    return [(round(x, 4), round(y, 4)) for x, y in points_px.tolist()]
