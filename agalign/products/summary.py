"""OUT/summary.csv: one row per band pair of a run, and one for each band of a calibration panel or of the sky."""

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path

from agalign.products.panels import PanelPart
from agalign.products.sidecar import BandPart, Sidecar
from agalign.products.sky import SkyPart
from agalign.values.files import write_text
from agalign.values.text import without_formula

SUMMARY_COLUMNS = (
    "folder", "capture", "band", "wavelength_nm", "status", "reason", "seed", "retrieval", "corner_std_px",
    "residual_px", "residual_p95_px", "residual_coverage", "local_applied", "local_p95_before_px",
    "local_p95_after_px", "prediction_from", "prediction_std_px", "prediction_off_px",
    "mattes_mi_before", "mattes_mi_after", "nmi_before",
    "nmi_after", "ncc_before", "ncc_after", "gradient_correlation_before", "gradient_correlation_after",
    "structure_ssim_before", "structure_ssim_after", "seconds",
)  # fmt: skip


def summary_rows(folder: str, sidecar: Sidecar) -> list[dict[str, object]]:
    """A row for each band pair of a capture."""
    return [_row(folder, sidecar, band) for band in sidecar.bands if band.status != "reference"]


def panel_rows(panel: PanelPart) -> list[dict[str, object]]:
    """Return a row for each band of a capture of a panel; none for a scene that contains one, which is aligned."""
    if panel.in_scene:
        return []
    facts = {"folder": panel.folder, "capture": panel.capture, "status": "panel", "reason": panel.sentence}
    return [{**facts, "band": band.band} for band in panel.bands]


def sky_rows(sky: SkyPart) -> list[dict[str, object]]:
    """Return a row for each band of a capture of the sky."""
    facts = {"folder": sky.folder, "capture": sky.capture, "status": "sky", "reason": sky.sentence}
    return [{**facts, "band": band.band} for band in sky.bands]


def write_summary(rows: Iterable[Mapping[str, object]], path: Path) -> None:
    """Raises OutputError."""
    table = io.StringIO()
    writer = csv.DictWriter(table, SUMMARY_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: without_formula(v) for k, v in row.items()} for row in rows)
    write_text(path, table.getvalue())


def _row(folder: str, sidecar: Sidecar, band: BandPart) -> dict[str, object]:
    row: dict[str, object] = {
        "folder": folder,
        "capture": sidecar.capture,
        "band": band.band,
        "wavelength_nm": band.wavelength_nm,
        "status": band.status,
        "reason": band.reason,
        "seed": band.seed.kind if band.seed else None,
        "seconds": band.seconds,
    }
    if band.joint is not None:
        row |= {"retrieval": round(band.joint.retrieval, 4), "corner_std_px": round(band.joint.corner_std_px, 4)}
    if band.local is not None:
        local = band.local
        before_px, after_px = _short(local.before_p95_px), _short(local.after_p95_px)
        row |= {"local_applied": local.applied, "local_p95_before_px": before_px, "local_p95_after_px": after_px}
    if band.prediction is not None:
        prediction = band.prediction
        std_px, off_px = _short(prediction.std_px), _short(prediction.off_px)
        row |= {"prediction_from": prediction.source, "prediction_std_px": std_px, "prediction_off_px": off_px}
    if band.metrics is not None:
        before, after = band.metrics.before.model_dump(), band.metrics.after.model_dump()
        row |= {k: _short(after[k]) for k in ("residual_px", "residual_p95_px", "residual_coverage")}
        for name in ("mattes_mi", "nmi", "ncc", "gradient_correlation", "structure_ssim"):
            row |= {f"{name}_before": _short(before[name]), f"{name}_after": _short(after[name])}
    return row


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
