"""The data that the report shows about each capture, compact enough for a thousand captures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

import numpy as np

from agalign.products.failures import FailureGroups
from agalign.products.index_bands import RAW
from agalign.products.index_table import IndexRow
from agalign.products.sidecar import (
    BandPart,
    BandResult,
    CaptureResult,
    GridPart,
    JointPart,
    MetricsResult,
    Sidecar,
    rounded,
)

SCHEMA = "agalign-report/1"
_SHIFT_STEP_PX = 0.01
"""Shifts of windows are written as integer multiples of this."""
_MAX_SCALE_DIFFERENCE = 0.1
"""An offset between two files is not meaningful if their scales differ by a larger share."""


@dataclass(frozen=True)
class CaptureEntry:
    """A capture, as the templates of the report use it."""

    label: str
    captured_at: str
    status: str
    camera: str
    position: tuple[float, float] | None
    """Latitude and longitude, degrees."""
    seconds: float
    """Processing time of its band pairs."""
    offsets_px: dict[str, tuple[float, float]]
    """Offset (x, y) of each delivered band from the reference, in the centre of the reference."""


@dataclass(frozen=True)
class BandRow:
    """One band over all captures."""

    name: str
    aligned: int
    """Number of captures in which it is aligned."""
    pairs: int
    """Number of captures."""
    offset_px: float | None
    """Median length of the offset between the raw files."""
    residual_px: float | None
    """Median residual after alignment."""
    worst_px: float | None
    """Largest residual of a capture."""
    seconds: float
    """Median processing time."""


@dataclass
class Facts:
    """The data of the captures below an output folder, which are added one by one."""

    out: Path
    entries: list[CaptureEntry] = field(default_factory=list)
    bands: list[BandResult] = field(default_factory=list)
    """All moving bands of all captures."""
    failures: FailureGroups = field(default_factory=FailureGroups)
    _captures: list[dict[str, Any]] = field(default_factory=list)
    _offsets_px: dict[str, list[float]] = field(default_factory=dict)
    """Median length of the offset of each band, in every capture."""
    _lattices: dict[tuple[float, ...], int] = field(default_factory=dict)
    """Centres of windows, which many pairs share, and their index in the data of the report."""

    def add(self, folder: str, sidecar: Sidecar) -> None:
        """Add a capture, given its folder relative to the output folder."""
        result = sidecar.result()
        pairs = [self._pair(b, sidecar) for b in sidecar.bands]
        moving = [b for b in result.bands if b.status != "reference"]
        position = sidecar.position
        entry = CaptureEntry(
            Path(folder, sidecar.capture).as_posix(), sidecar.captured_at, sidecar.status, _camera(result),
            None if position is None else (position.latitude, position.longitude), sum(b.seconds for b in moving),
            {p["band"]: p["offset_px"] for p in pairs if p["status"] in ("aligned", "predicted") and p["offset_px"]},
        )  # fmt: skip
        for pair in pairs:
            if pair["apart_px"] is not None:
                self._offsets_px.setdefault(pair["band"], []).append(pair["apart_px"])
        self.bands += moving
        self.failures.add(entry.label, result)
        self.entries.append(entry)
        self._captures.append(self._capture(Path(folder), sidecar, entry, pairs))

    def add_indices(self, rows: Sequence[IndexRow]) -> None:
        """Add the spectral indices of captures that were added before."""
        by_label = {c["label"]: c["indices"] for c in self._captures}
        for row in rows:
            if row.file and row.label in by_label:
                statistics = row.statistics
                by_label[row.label].append({
                    "name": row.index, "median": _finite(statistics.median), "p5": _finite(statistics.p5),
                    "p95": _finite(statistics.p95), "valid": statistics.valid_share,
                    "span": (statistics.low, statistics.high), "unit": statistics.unit, "raw": statistics.unit == RAW,
                    "file": quote(row.file), "picture": quote(Path(row.file).with_suffix(".png").as_posix()),
                })  # fmt: skip

    @property
    def residuals_px(self) -> list[float]:
        """Residuals of the aligned pairs, sorted."""
        return sorted(r for b in self.bands if (r := _residual_px(b)) is not None)

    def by_band(self) -> list[BandRow]:
        """Return a row for each band."""
        rows = []
        for name in dict.fromkeys(b.band for b in self.bands):
            pairs = [b for b in self.bands if b.band == name]
            residuals_px = [r for b in pairs if (r := _residual_px(b)) is not None]
            offsets_px = self._offsets_px.get(name)
            rows.append(
                BandRow(
                    name, sum(b.status == "aligned" for b in pairs), len(pairs),
                    median(offsets_px) if offsets_px else None, median(residuals_px) if residuals_px else None,
                    max(residuals_px, default=None), median(b.seconds for b in pairs),
                )
            )  # fmt: skip
        return rows

    def as_json(self) -> dict[str, Any]:
        """Return the data of the schema `agalign-report/1`, whose types the script of the page declares."""
        return {
            "schema": SCHEMA, "captures": self._captures, "shift_step_px": _SHIFT_STEP_PX,
            "lattices": [list(centres) for centres in self._lattices],
        }  # fmt: skip

    def _capture(
        self, folder: Path, sidecar: Sidecar, entry: CaptureEntry, pairs: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        output, preview, reference = sidecar.output, sidecar.preview, sidecar.reference
        crop = (0, 0, reference.width, reference.height) if output is None else output.crop
        picture = folder / f"{sidecar.capture}.png"
        relief = next((b.relief.file for b in sidecar.bands if b.relief is not None), None)
        return {
            "label": entry.label, "captured_at": entry.captured_at, "camera": entry.camera, "status": entry.status,
            "position": entry.position, "altitude_m": None if sidecar.position is None else sidecar.position.altitude_m,
            "missing": sidecar.missing_bands, "reference": reference.band, "seconds": round(entry.seconds, 2),
            "crop": crop, "scale": (1.0, 1.0) if output is None else output.scale,
            "radiometry": None if output is None else output.radiometry,
            "stack": _link(folder / output.file) if output is not None and output.file else None,
            "relief": None if relief is None else _link(folder / relief),
            "sidecar": _link(folder / f"{sidecar.capture}.json"),
            "picture": _link(picture) if (self.out / picture).is_file() else None,
            "preview": None if preview is None else {
                **preview.model_dump(exclude={"file"}), "file": _link(folder / preview.file),
                "detail": [round(v, 5) for v in preview.detail],
            },
            "bands": pairs, "indices": [],
        }  # fmt: skip

    def _pair(self, band: BandPart, sidecar: Sidecar) -> dict[str, Any]:
        prediction = band.prediction
        tiles = [] if band.metrics is None else band.metrics.tiles
        offset_px, distance_px = _band_offset(band.grid, sidecar)
        lattice = tuple(v for t in tiles for v in t.centre_px)
        return {
            "band": band.band, "wavelength_nm": band.wavelength_nm, "status": band.status, "reason": band.reason,
            "seed": band.seed.kind if band.seed else None, "seconds": round(band.seconds, 2),
            "written": band.place is not None, "offset_px": offset_px, "apart_px": distance_px,
            **_residual(band.metrics), **_joint(band.joint),
            "prediction": None if prediction is None else prediction.model_dump(by_alias=True),
            "geometry": None if band.geometry is None else band.geometry.model_dump(),
            "occluded": None if band.relief is None else band.relief.occluded,
            "lattice": self._lattices.setdefault(lattice, len(self._lattices)),
            "shifts": [None if v is None else round(v / _SHIFT_STEP_PX) for t in tiles for v in t.shift_px],
        }  # fmt: skip


def _link(path: Path) -> str:
    return quote(path.as_posix())


def _residual(metrics: MetricsResult | None) -> dict[str, Any]:
    """Residuals after alignment, and the similarity before and after."""
    if metrics is None:
        return dict.fromkeys(("residual_px", "residual_p95_px", "coverage", "similarity"))
    after = metrics.after
    return {
        "residual_px": rounded(after.residual_px), "residual_p95_px": rounded(after.residual_p95_px),
        "coverage": rounded(after.residual_coverage), "similarity": metrics.similarity(),
    }  # fmt: skip


def _joint(joint: JointPart | None) -> dict[str, float | None]:
    if joint is None:
        return {"retrieval": None, "corner_std_px": None}
    return {"retrieval": rounded(joint.retrieval), "corner_std_px": rounded(joint.corner_std_px)}


def _camera(result: CaptureResult) -> str:
    return f"{result.camera.make} {result.camera.model}".strip() or "unknown camera"


def _residual_px(band: BandResult) -> float | None:
    return band.metrics.after.residual_px if band.status == "aligned" and band.metrics else None


def _finite(value: float) -> float | None:
    return rounded(value) if math.isfinite(value) else None


def _band_offset(grid: GridPart | None, sidecar: Sidecar) -> tuple[tuple[float, float] | None, float | None]:
    """(offset (x, y) of a band's raw file in the centre of the reference, median length of the offset), px.

    None if the two files have different scales.
    """
    if grid is None:
        return None, None
    reference_px, moving_px = np.array(grid.reference_px), np.array(grid.moving_px)
    reference_span, moving_span = np.ptp(reference_px, axis=0), np.ptp(moving_px, axis=0)
    if not (np.abs(moving_span - reference_span) < _MAX_SCALE_DIFFERENCE * reference_span).all():
        return None, None
    offsets = moving_px - reference_px
    centre = np.array([sidecar.reference.width - 1, sidecar.reference.height - 1]) / 2
    dx, dy = offsets[np.linalg.norm(reference_px - centre, axis=1).argmin()].tolist()
    return (round(dx, 3), round(dy, 3)), round(float(np.median(np.linalg.norm(offsets, axis=1))), 3)
