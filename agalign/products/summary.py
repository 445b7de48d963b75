"""One row per band pair, from the sidecars of a run."""

import csv
import io
from collections.abc import Callable, Iterable
from pathlib import Path

from agalign.errors import SidecarError
from agalign.products.panels import PanelPart, read_panels
from agalign.products.sidecar import BandPart, Sidecar, find_sidecars, read_sidecar
from agalign.values.files import write_text

SUMMARY_COLUMNS = (
    "folder", "capture", "band", "wavelength_nm", "status", "reason", "seed", "retrieval", "corner_std_px",
    "residual_px", "residual_p95_px", "residual_coverage", "local_applied", "local_p95_before_px",
    "local_p95_after_px", "prediction_from", "prediction_std_px", "prediction_off_px",
    "mattes_mi_before", "mattes_mi_after", "nmi_before",
    "nmi_after", "ncc_before", "ncc_after", "gradient_correlation_before", "gradient_correlation_after",
    "structure_ssim_before", "structure_ssim_after", "seconds",
)  # fmt: skip


def _ignore(_problem: str) -> None:
    """Unreadable sidecars are told to nobody."""


def write_summary(out: Path, on_problem: Callable[[str], None] = _ignore) -> Path:
    """OUT/summary.csv from all sidecars below OUT, a row per band pair, and then one for each band of a capture that
    shows a calibration panel; what is unreadable is told to `on_problem`.

    Raises OutputError.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, SUMMARY_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for folder, sidecar in sidecars_below(out, on_problem):
        writer.writerows(_row(folder, sidecar, band) for band in sidecar.bands if band.status != "reference")
    for panel in panels_of(out, on_problem):
        facts = {"folder": panel.folder, "capture": panel.capture, "status": "panel", "reason": panel.sentence}
        writer.writerows({**facts, "band": band.band} for band in panel.bands)
    path = out / "summary.csv"
    write_text(path, table.getvalue())
    return path


def sidecars_below(out: Path, on_problem: Callable[[str], None] = _ignore) -> Iterable[tuple[str, Sidecar]]:
    """(folder relative to OUT, sidecar) of every readable sidecar; `on_problem` is told of the others."""
    for path in find_sidecars(out):
        try:
            yield path.parent.relative_to(out).as_posix(), read_sidecar(path)
        except SidecarError as error:
            on_problem(str(error))


def panels_of(out: Path, on_problem: Callable[[str], None] = _ignore) -> list[PanelPart]:
    """The calibration panels of the run below OUT; `on_problem` is told of a file that cannot be read."""
    try:
        return read_panels(out)
    except SidecarError as error:
        on_problem(str(error))
        return []


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
