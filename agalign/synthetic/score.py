"""The demo: make a synthetic flight, and score an alignment of it against its exact truth."""

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
    """How far a pair is from the truth, over a lattice of known points."""

    capture: str
    band: str
    status: str
    before_px: float
    median_px: float
    p95_px: float


def score_against_truth(reports: list[CaptureReport], truth_path: Path) -> list[Score]:
    """Errors of every pair in px, read from the sidecars' grids as anyone else would."""
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
