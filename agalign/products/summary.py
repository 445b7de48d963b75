"""OUT/summary.csv: one row per band pair of a run, and one for each band of a calibration panel or of the sky."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from agalign.products.csv_file import write_csv
from agalign.products.panels import PanelPart
from agalign.products.sidecar import BandPart, Sidecar, rounded
from agalign.products.sky import SkyPart
from agalign.values.text import without_formula

SUMMARY_COLUMNS = (
    "folder", "capture", "band", "wavelength_nm", "status", "reason", "seed", "retrieval", "corner_std_px",
    "residual_px", "residual_p95_px", "residual_coverage", "geometry", "homography_p95_px",
    "geometry_p95_px", "prediction_from", "prediction_std_px", "prediction_off_px",
    "mattes_mi_before", "mattes_mi_after", "nmi_before",
    "nmi_after", "ncc_before", "ncc_after", "gradient_correlation_before", "gradient_correlation_after",
    "structure_ssim_before", "structure_ssim_after", "seconds",
)  # fmt: skip


def summary_rows(folder: str, sidecar: Sidecar) -> list[dict[str, object]]:
    """Return a row for each band pair of a capture, by column."""
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
    """Write rows by column, where a missing column is empty. Raises OutputError."""
    write_csv(path, SUMMARY_COLUMNS, ([without_formula(row.get(name)) for name in SUMMARY_COLUMNS] for row in rows))


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
        row |= {"retrieval": rounded(band.joint.retrieval), "corner_std_px": rounded(band.joint.corner_std_px)}
    if band.geometry is not None:
        held_out = band.geometry.held_out_p95_px
        homography_px, chosen_px = rounded(held_out.get("homography")), rounded(held_out.get(band.geometry.kind))
        row |= {"geometry": band.geometry.kind, "homography_p95_px": homography_px, "geometry_p95_px": chosen_px}
    if band.prediction is not None:
        prediction = band.prediction
        std_px, off_px = rounded(prediction.std_px), rounded(prediction.off_px)
        row |= {"prediction_from": prediction.source, "prediction_std_px": std_px, "prediction_off_px": off_px}
    if band.metrics is not None:
        after = band.metrics.after
        row |= {k: rounded(getattr(after, k)) for k in ("residual_px", "residual_p95_px", "residual_coverage")}
        for name, (before_value, after_value) in band.metrics.similarity().items():
            row |= {f"{name}_before": before_value, f"{name}_after": after_value}
    return row
