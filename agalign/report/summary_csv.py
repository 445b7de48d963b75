"""OUT/summary.csv: its columns, and the values of a band in them. `report.facts` makes the rows, also of missing bands,
panels, the sky, and captures without a result.
"""

import math
from typing import Any

from agalign.records.sidecar import BandResult

SIMILARITY = ("mattes_mi", "nmi", "ncc", "gradient_correlation", "structure_ssim")
SHOWN_COLUMNS = {
    "band": "band",
    "wavelength_nm": "wavelength_nm",
    "status": "status",
    "reason": "reason",
    "seed": "seed.kind",
    "retrieval": "joint.retrieval",
    "corner_std_px": "joint.corner_std_px",
    "residual_px": "metrics.after.residual_px",
    "residual_p95_px": "metrics.after.residual_p95_px",
}
"""Field of a band in the sidecar by column of OUT/summary.csv, for columns that the report shows by the same names."""
BAND_COLUMNS = SHOWN_COLUMNS | {
    "residual_coverage": "metrics.after.residual_coverage",
    "geometry": "geometry.kind",
    "homography_p95_px": "geometry.homography_p95_px",
    "geometry_p95_px": "geometry.p95_px",
    "prediction_from": "prediction.source",
    "prediction_std_px": "prediction.std_px",
    "prediction_off_px": "prediction.off_px",
    **{f"{name}_{when}": f"metrics.{when}.{name}" for name in SIMILARITY for when in ("before", "after")},
    "expected_error_px": "error.std_px",
    "expected_error_band_px": "error.std_band_px",
    "share_over_1_px": "share_over_1_px",
    "moved_share": "moved_share",
    "seconds": "seconds",
}
"""Field of a band in the sidecar by column of OUT/summary.csv."""
SUMMARY_COLUMNS = ("folder", "capture", *BAND_COLUMNS, "radiometry_std_percent", "reference", "check")


def row_of(band: BandResult) -> dict[str, Any]:
    """Return the values of BAND_COLUMNS."""
    row = {column: value_at(band, path) for column, path in BAND_COLUMNS.items()}
    if band.status != "predicted":
        row["prediction_from"] = None  # its mapping has only been compared with the prediction
    return row


def value_at(part: object, path: str) -> Any:
    """Return a field of nested records, with four decimals; None if a record on the path is None."""
    for name in path.split("."):
        part = None if part is None else getattr(part, name)
    return rounded(part)


def rounded(value: Any) -> Any:
    """Return a measured value with the four decimals that tables and the report have, None if it is not finite; others
    unchanged.
    """
    if not isinstance(value, float):
        return value
    return round(value, 4) if math.isfinite(value) else None
