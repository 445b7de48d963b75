"""Score of an alignment of a synthetic flight, by its ground truth."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator

from agalign.batch import CaptureReport
from agalign.synthetic.flight import make_flight

__all__ = ["Score", "make_flight", "score_against_truth"]


@dataclass(frozen=True)
class Score:
    """Error of a band pair at the tie points of the ground truth."""

    capture: str
    band: str
    status: str
    before_px: float
    median_px: float
    p95_px: float


def score_against_truth(reports: list[CaptureReport], truth_path: Path) -> list[Score]:
    """Return the errors of every pair, px, from the grids in the sidecars."""
    truth = json.loads(truth_path.read_text(encoding="utf-8"))
    scores = []
    for report in reports:
        if report.sidecar is None:
            continue
        for band in report.sidecar.bands:
            known = truth[report.sidecar.capture]["bands"].get(band.file)
            if known is None or band.grid is None:
                continue
            ties = np.asarray(known["ties"], dtype=np.float64)
            mapping = CloughTocher2DInterpolator(np.asarray(band.grid.reference_px), np.asarray(band.grid.moving_px))
            error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
            before = np.linalg.norm(ties[:, :2] - ties[:, 2:], axis=1)
            median, p95 = np.nanpercentile(error, (50, 95))
            scores.append(
                Score(report.label, band.band, band.status, float(np.median(before)), float(median), float(p95))
            )
    return scores
