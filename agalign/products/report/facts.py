"""Data of the page about each capture, short enough for a thousand of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

import numpy as np

from agalign.products.failures import FailureGroups
from agalign.products.index_rasters import RAW
from agalign.products.index_table import IndexRow
from agalign.products.sidecar import (
    BandPart,
    BandResult,
    CaptureResult,
    GridPart,
    JointPart,
    MetricsResult,
    Sidecar,
    SimilarityPart,
)

SCHEMA = "agalign-report/1"
_SHIFT_STEP_PX = 0.01
"""Shifts of windows are written in whole numbers of this."""
_LIKE_SCALES = 0.1
"""Displacements between bands are not meaningful if their scales differ by more than this share."""


@dataclass(frozen=True)
class CaptureEntry:
    """A capture, without what only its picture needs."""

    label: str
    captured_at: str
    status: str
    camera: str
    position: tuple[float, float] | None
    """Latitude and longitude, degrees."""
    seconds: float
    """What its alignment took."""
    offsets_px: dict[str, tuple[float, float]]
    """Offset of the centre of the reference from that of each delivered band."""


@dataclass(frozen=True)
class BandRow:
    """One band in all captures."""

    name: str
    aligned: int
    pairs: int
    apart_px: float | None
    """Medians over captures: how far the raw files lie apart,"""
    residual_px: float | None
    """Residual after alignment, with that of the worst capture."""
    worst_px: float | None
    seconds: float


@dataclass
class Facts:
    """Data about the captures below an output folder, as they are added."""

    out: Path
    entries: list[CaptureEntry] = field(default_factory=list)
    bands: list[BandResult] = field(default_factory=list)
    """All moving bands of all captures."""
    failures: FailureGroups = field(default_factory=FailureGroups)
    _captures: list[dict[str, Any]] = field(default_factory=list)
    _apart_px: dict[str, list[float]] = field(default_factory=dict)
    _lattices: dict[tuple[float, ...], int] = field(default_factory=dict)
    """Places of windows, which many pairs have in common, and their number."""

    def add(self, folder: str, sidecar: Sidecar) -> None:
        """One capture more, of a folder relative to the output folder."""
        base = "" if folder == "." else f"{folder}/"
        label, result = f"{base}{sidecar.capture}", sidecar.result()
        pairs = [self._pair(b, sidecar) for b in sidecar.bands]
        moving = [b for b in result.bands if b.status != "reference"]
        self.bands += moving
        self.failures.add(label, result)
        delivered = {"aligned", "predicted"}
        position = sidecar.position
        entry = CaptureEntry(
            label, sidecar.captured_at, sidecar.status, _camera(result),
            None if position is None else (position.latitude, position.longitude), sum(b.seconds for b in moving),
            {p["band"]: p["offset_px"] for p in pairs if p["status"] in delivered and p["offset_px"] is not None},
        )  # fmt: skip
        for pair in pairs:
            if pair["apart_px"] is not None:
                self._apart_px.setdefault(pair["band"], []).append(pair["apart_px"])
        self.entries.append(entry)
        self._captures.append(self._capture(base, sidecar, entry, pairs))

    def add_indices(self, rows: Sequence[IndexRow]) -> None:
        """Add the spectral indices of captures that were added before."""
        by_label = {c["label"]: c["indices"] for c in self._captures}
        for row in rows:
            label = row.capture if row.folder == "." else f"{row.folder}/{row.capture}"
            if row.file and label in by_label:
                known = row.statistics
                by_label[label].append({
                    "name": row.index, "median": _finite(known.median), "p5": _finite(known.p5),
                    "p95": _finite(known.p95), "valid": known.valid_share, "span": (known.low, known.high),
                    "unit": known.unit, "raw": known.unit == RAW,
                    "file": quote(row.file), "picture": quote(f"{row.file[:-4]}.png"),
                })  # fmt: skip

    @property
    def residuals_px(self) -> list[float]:
        """Of the pairs that are aligned, sorted."""
        return sorted(r for b in self.bands if (r := _residual_px(b)) is not None)

    def by_band(self) -> list[BandRow]:
        """Each band in all captures."""
        rows = []
        for name in dict.fromkeys(b.band for b in self.bands):
            mine = [b for b in self.bands if b.band == name]
            known = [r for b in mine if (r := _residual_px(b)) is not None]
            apart = self._apart_px.get(name)
            rows.append(
                BandRow(
                    name, sum(b.status == "aligned" for b in mine), len(mine), median(apart) if apart else None,
                    median(known) if known else None, max(known, default=None), median(b.seconds for b in mine),
                )
            )  # fmt: skip
        return rows

    def as_json(self) -> dict[str, Any]:
        """Schema `agalign-report/1`, as the page's script declares it."""
        return {
            "schema": SCHEMA, "captures": self._captures, "shift_step_px": _SHIFT_STEP_PX,
            "lattices": [list(centres) for centres in self._lattices],
        }  # fmt: skip

    def _capture(
        self, base: str, sidecar: Sidecar, entry: CaptureEntry, pairs: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        output, preview, reference = sidecar.output, sidecar.preview, sidecar.reference
        crop = (0, 0, reference.width, reference.height) if output is None else output.crop
        picture = f"{base}{sidecar.capture}.png"
        relief = next((b.relief.file for b in sidecar.bands if b.relief is not None), None)
        return {
            "label": entry.label, "captured_at": entry.captured_at, "camera": entry.camera, "status": entry.status,
            "position": entry.position, "altitude_m": None if sidecar.position is None else sidecar.position.altitude_m,
            "missing": sidecar.missing_bands, "reference": reference.band, "seconds": round(entry.seconds, 2),
            "crop": crop, "scale": (1.0, 1.0) if output is None else output.scale,
            "radiometry": None if output is None else output.radiometry,
            "stack": quote(f"{base}{output.file}") if output is not None and output.file else None,
            "relief": None if relief is None else quote(f"{base}{relief}"),
            "sidecar": quote(f"{base}{sidecar.capture}.json"),
            "picture": quote(picture) if (self.out / picture).is_file() else None,
            "preview": None if preview is None else {
                **preview.model_dump(exclude={"file"}), "file": quote(f"{base}{preview.file}"),
                "detail": [round(v, 5) for v in preview.detail],
            },
            "bands": pairs, "indices": [],
        }  # fmt: skip

    def _pair(self, band: BandPart, sidecar: Sidecar) -> dict[str, Any]:
        local, prediction = band.local, band.prediction
        tiles = [] if band.metrics is None else band.metrics.tiles
        offset_px, distance_px = _band_offset(band.grid, sidecar)
        lattice = tuple(v for t in tiles for v in t.centre_px)
        return {
            "band": band.band, "wavelength_nm": band.wavelength_nm, "status": band.status, "reason": band.reason,
            "seed": band.seed.kind if band.seed else None, "seconds": round(band.seconds, 2),
            "written": band.place is not None, "offset_px": offset_px, "apart_px": distance_px,
            **_residual(band.metrics), **_joint(band.joint),
            "prediction": None if prediction is None else prediction.model_dump(by_alias=True),
            "local": None if local is None else local.model_dump(),
            "occluded": None if band.relief is None else band.relief.occluded,
            "lattice": self._lattices.setdefault(lattice, len(self._lattices)),
            "shifts": [None if v is None else round(v / _SHIFT_STEP_PX) for t in tiles for v in t.shift_px],
        }  # fmt: skip


def _residual(metrics: MetricsResult | None) -> dict[str, Any]:
    """What the windows and the similarity show after alignment."""
    if metrics is None:
        return dict.fromkeys(("residual_px", "residual_p95_px", "coverage", "similarity"))
    after = metrics.after
    return {
        "residual_px": _rounded(after.residual_px), "residual_p95_px": _rounded(after.residual_p95_px),
        "coverage": _rounded(after.residual_coverage), "similarity": _similarity(metrics.before, after),
    }  # fmt: skip


def _joint(joint: JointPart | None) -> dict[str, float | None]:
    if joint is None:
        return {"retrieval": None, "corner_std_px": None}
    return {"retrieval": _rounded(joint.retrieval), "corner_std_px": _rounded(joint.corner_std_px)}


def _camera(result: CaptureResult) -> str:
    return f"{result.camera.make} {result.camera.model}".strip() or "unknown camera"


def _residual_px(band: BandResult) -> float | None:
    return band.metrics.after.residual_px if band.status == "aligned" and band.metrics else None


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _similarity(before: SimilarityPart, after: SimilarityPart) -> dict[str, tuple[float | None, float | None]]:
    names = ("mattes_mi", "nmi", "ncc", "gradient_correlation", "structure_ssim")
    return {n: (_rounded(getattr(before, n)), _rounded(getattr(after, n))) for n in names}


def _band_offset(grid: GridPart | None, sidecar: Sidecar) -> tuple[tuple[float, float] | None, float | None]:
    """(offset (x, y) of a band's raw file in the middle of the reference, median length of the offset), px.

    None where the two files have different scales.
    """
    if grid is None:
        return None, None
    reference_px, moving_px = np.array(grid.reference_px), np.array(grid.moving_px)
    reference_span, moving_span = np.ptp(reference_px, axis=0), np.ptp(moving_px, axis=0)
    if not (np.abs(moving_span - reference_span) < _LIKE_SCALES * reference_span).all():
        return None, None
    offsets = moving_px - reference_px
    middle = np.array([sidecar.reference.width - 1, sidecar.reference.height - 1]) / 2
    dx, dy = offsets[np.linalg.norm(reference_px - middle, axis=1).argmin()].tolist()
    return (round(dx, 3), round(dy, 3)), round(float(np.median(np.linalg.norm(offsets, axis=1))), 3)
