"""A capture's outcome as its sidecar."""

import math
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from agalign import geometry
from agalign._version import __version__
from agalign.choices import CaptureStatus
from agalign.config import Settings
from agalign.fingerprint import fingerprint
from agalign.geometry import Matrix
from agalign.pair import mapping_of
from agalign.records import Alignment, Band, Capture, JointResult, LocalResult, Residual
from agalign.sidecar import (
    BandPart,
    CameraPart,
    FilePart,
    GridPart,
    HomographyPart,
    JointPart,
    LocalPart,
    Matrix3x3,
    MetricsPart,
    OutputPart,
    PlacePart,
    PositionPart,
    ReferencePart,
    ResidualTile,
    SeedPart,
    Sidecar,
    SimilarityPart,
)
from agalign.write import Written

_GRID = 17, 13
_LOCAL_GRID = 65, 49
"""Local displacements need more points than a lens."""


def capture_status(statuses: list[str]) -> CaptureStatus:
    """Ok where every moving band is aligned, failed where none is of use, else degraded."""
    moving = [s for s in statuses if s != "reference"]
    if all(s == "aligned" for s in moving):
        return "ok"
    return "failed" if all(s == "failed" for s in moving) else "degraded"


def describe_capture(
    capture: Capture, alignments: dict[str, Alignment], written: Written | None, settings: Settings
) -> Sidecar:
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
    status = capture_status([p.status for p in parts])
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
        output=None if written is None else _output_part(written),
        settings=fingerprint(capture, settings),
    )


def _output_part(written: Written) -> OutputPart:
    nodata: float | str | None = written.nodata
    if isinstance(nodata, float) and math.isnan(nodata):
        nodata = "nan"
    grid, stack = written.grid, written.stack
    return OutputPart(
        file=None if stack is None else stack.name,
        bytes=None if stack is None else stack.stat().st_size,
        band_files=[
            FilePart(file=path.relative_to(written.folder).as_posix(), bytes=path.stat().st_size)
            for path in written.band_files
        ],
        crop=(grid.x0, grid.y0, grid.width, grid.height),
        scale=grid.scale_xy,
        nodata=nodata,
    )


def _place(written: Written, band: str) -> PlacePart | None:
    """Not of a band that is all nodata."""
    if band not in written.places:
        return None
    path, index = written.places[band]
    return PlacePart(file=path.relative_to(written.folder).as_posix(), band_index=index)


def _band_part(reference: Band, band: Band, alignment: Alignment) -> BandPart:
    joint, residual = alignment.joint, alignment.residual
    local = alignment.local
    bent = local is not None and local.field is not None
    grid_px = geometry.lattice(reference.width_px, reference.height_px, *(_LOCAL_GRID if bent else _GRID))
    there_px = mapping_of(reference, band, alignment)(grid_px)
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
        homography=HomographyPart(fixed_to_moving=_rows(alignment.fixed_to_moving), space=alignment.space),
        seed=SeedPart(
            kind=alignment.seed.kind,
            fixed_to_moving=_rows(alignment.seed.fixed_to_moving),
            peak_sigma=alignment.seed.peak_sigma,
            runner_up_sigma=alignment.seed.runner_up_sigma,
        ),
        grid=GridPart(reference_px=_points(grid_px), moving_px=_points(there_px)),
        joint=None if joint is None else _joint_part(joint),
        metrics=MetricsPart(
            before=_similarity_part(alignment.before), after=_similarity_part(after), tiles=_tile_parts(residual)
        ),
        local=None if local is None else _local_part(local),
        seconds=round(alignment.seconds, 3),
    )


def _local_part(local: LocalResult) -> LocalPart:
    before, after = (v if math.isfinite(v) else None for v in (local.before_p95_px, local.after_p95_px))
    return LocalPart(applied=local.field is not None, before_p95_px=before, after_p95_px=after)


def _joint_part(joint: JointResult) -> JointPart:
    return JointPart(
        loss=joint.loss if math.isfinite(joint.loss) else None, retrieval=joint.retrieval, chance=joint.chance,
        iterations=joint.iterations, levels=list(joint.levels), recipe=joint.recipe, model_family=joint.model_family,
        last_step_px=joint.last_step_px, corner_std_px=joint.corner_std_px,
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
