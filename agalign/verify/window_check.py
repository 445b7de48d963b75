"""Check of the residual shifts of windows, which are independent of the estimation."""

from collections.abc import Iterator

import numpy as np
from scipy.sparse import identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from agalign.values.alignment import Residual
from agalign.values.geometry import Points
from agalign.values.issues import TEXTURELESS, UNLIKE, Issue, IssueKind, Remedy
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

_RELIEF = Remedy(
    "parallax (trees, buildings or terraces near the camera), or motion between the exposures",
    "fly higher or slower, and do not use --relief never; --bands omits a band",
)
FEW_WINDOWS = IssueKind("few_windows", "too little common structure to verify the result", TEXTURELESS)
COVERAGE = IssueKind("coverage", "a shift can be measured in only {value:.0%} of the windows", UNLIKE)
CLOSE_WINDOWS = IssueKind(
    "close_windows", "only {value:.0%} of the windows are aligned within {detail}", _RELIEF
)  # fmt: skip
CLUSTER = IssueKind("cluster", "an area with {value:.0%} of the windows is misaligned", _RELIEF)
RESIDUAL_PX = IssueKind("residual_px", "the median residual shift is {value:.1f} px", UNLIKE)

_MIN_WINDOWS = 4
"""Minimum number of windows with structure: fewer cannot cover all corners of the image."""
_MIN_COVERAGE = 0.6
"""Minimum share of the windows with structure that have a measured shift; it is small for unrelated images."""
_MAX_MEDIAN_PX = 1.0
"""Maximum median residual shift: beyond it, a spectral index mixes neighbouring pixels."""
_CLOSE_PX = 1.0
"""Maximum residual shift of an aligned window."""
_MIN_CLOSE_SHARE = 0.9
"""Minimum share of aligned windows among the measured ones: a few wrong peaks are normal."""
_MIN_CLUSTER, _MAX_CLUSTER_SHARE = 5, 0.04
"""Size of a cluster of adjacent misaligned windows, as a count and as a share of the measured windows, from which it is
an issue; both must be reached. Wrong peaks are scattered, windows with parallax are adjacent."""
_MAX_NEIGHBOUR_SPACINGS = 1.6
"""Maximum distance of adjacent windows in units of their spacing; includes diagonal neighbours (1.41)."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    residual = evidence.residual
    if len(residual.centres_px) < _MIN_WINDOWS:
        yield Issue(FEW_WINDOWS, len(residual.centres_px), _MIN_WINDOWS)
        return
    # The negations also reject NaN.
    if not residual.coverage >= _MIN_COVERAGE:
        yield Issue(COVERAGE, residual.coverage, _MIN_COVERAGE)
    yield from _issues_of_outliers(residual, evidence.file_px)
    median_px = residual.median_px / evidence.file_px
    if not median_px <= _MAX_MEDIAN_PX:
        yield Issue(RESIDUAL_PX, median_px, _MAX_MEDIAN_PX)


def _issues_of_outliers(residual: Residual[FixedPx], file_px: float) -> Iterator[Issue]:
    measured = np.isfinite(residual.shifts_px[:, 0])
    count = max(int(measured.sum()), 1)
    misaligned = measured & (np.linalg.norm(np.nan_to_num(residual.shifts_px), axis=1) > _CLOSE_PX * file_px)
    close = 1 - float(misaligned.sum()) / count
    if not close >= _MIN_CLOSE_SHARE:
        yield Issue(CLOSE_WINDOWS, close, _MIN_CLOSE_SHARE, f"{_CLOSE_PX:g} px")
    cluster = _largest_cluster(residual.centres_px[misaligned], residual.centres_px)
    limit = max(_MIN_CLUSTER, round(_MAX_CLUSTER_SHARE * int(measured.sum())))
    if not cluster < limit:
        yield Issue(CLUSTER, cluster / count, limit / count)


def _largest_cluster(centres_px: Points, all_px: Points) -> int:
    """Return the size of the largest group of adjacent centres (n, 2); the grid of windows is `all_px` (m, 2)."""
    if len(centres_px) == 0 or len(all_px) < 2:
        return len(centres_px)
    spacing, _ = cKDTree(all_px).query(all_px, k=2)
    radius_px = _MAX_NEIGHBOUR_SPACINGS * float(np.median(spacing[:, 1]))
    adjacent = cKDTree(centres_px).sparse_distance_matrix(cKDTree(centres_px), radius_px)
    _, labels = connected_components(adjacent.tocsr() + identity(len(centres_px)), directed=False)
    return int(np.bincount(labels).max())


CHECK = Check((FEW_WINDOWS, COVERAGE, CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX), _issues)
