"""The columns of OUT/summary.csv, which has a row for each band of each capture."""

SIMILARITY = ("mattes_mi", "nmi", "ncc", "gradient_correlation", "structure_ssim")
BAND_COLUMNS = {
    "band": "band",
    "wavelength_nm": "wavelength_nm",
    "status": "status",
    "reason": "reason",
    "seed": "seed.kind",
    "retrieval": "joint.retrieval",
    "corner_std_px": "joint.corner_std_px",
    "residual_px": "metrics.after.residual_px",
    "residual_p95_px": "metrics.after.residual_p95_px",
    "residual_coverage": "metrics.after.residual_coverage",
    "geometry": "geometry.kind",
    "homography_p95_px": "geometry.homography_p95_px",
    "geometry_p95_px": "geometry.p95_px",
    "prediction_from": "prediction.source",
    "prediction_std_px": "prediction.std_px",
    "prediction_off_px": "prediction.off_px",
    **{f"{name}_{when}": f"metrics.{when}.{name}" for name in SIMILARITY for when in ("before", "after")},
    "seconds": "seconds",
}
"""Field of a band in the sidecar by column of OUT/summary.csv."""
SUMMARY_FILE = "summary.csv"
SUMMARY_COLUMNS = ("folder", "capture", *BAND_COLUMNS, "reference", "check")
