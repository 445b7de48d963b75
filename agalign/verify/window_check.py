"""Check of the residual shifts of windows, which do not depend on how the alignment was estimated."""

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
"""Windows with structure without which nothing can be verified: fewer leave a corner of the image unseen."""
_MIN_COVERAGE = 0.6
"""Share of the windows with structure in which a shift can be measured: few windows of unrelated images have a peak."""
_MAX_MEDIAN_PX = 1.0
"""Median length of the residual shifts: beyond, an index mixes neighbouring pixels everywhere."""
_CLOSE_PX = 1.0
"""Residual shift up to which a single window counts as aligned."""
_MIN_CLOSE = 0.9
"""Share of the measured windows that must be close: a few scattered wrong peaks are normal."""
_MIN_CLUSTER, _MAX_CLUSTER = 5, 0.04
"""Adjacent windows that are not close, as a count and as a share of those measured, from which a part of the image is
not aligned: wrong peaks are scattered, parallax is not. Both must be reached."""
_NEIGHBOUR = 1.6
"""Distance of adjacent windows in units of their spacing: diagonal neighbours (1.41) count."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    residual = evidence.residual
    if len(residual.centres_px) < _MIN_WINDOWS:
        yield Issue(FEW_WINDOWS, len(residual.centres_px), _MIN_WINDOWS)
        return
    # Each is written so that nan does not pass.
    if not residual.coverage >= _MIN_COVERAGE:
        yield Issue(COVERAGE, residual.coverage, _MIN_COVERAGE)
    yield from _issues_of_outliers(residual, evidence.file_px)
    median_px = residual.median_px / evidence.file_px
    if not median_px <= _MAX_MEDIAN_PX:
        yield Issue(RESIDUAL_PX, median_px, _MAX_MEDIAN_PX)


def _issues_of_outliers(residual: Residual[FixedPx], file_px: float) -> Iterator[Issue]:
    measured = np.isfinite(residual.shifts_px[:, 0])
    count = max(int(measured.sum()), 1)
    off = measured & (np.linalg.norm(np.nan_to_num(residual.shifts_px), axis=1) > _CLOSE_PX * file_px)
    close = 1 - float(off.sum()) / count
    if not close >= _MIN_CLOSE:
        yield Issue(CLOSE_WINDOWS, close, _MIN_CLOSE, f"{_CLOSE_PX:g} px")
    cluster = _largest_cluster(residual.centres_px[off], residual.centres_px)
    maximum = max(_MIN_CLUSTER, round(_MAX_CLUSTER * int(measured.sum())))
    if not cluster < maximum:
        yield Issue(CLUSTER, cluster / count, maximum / count)


def _largest_cluster(off_px: Points, all_px: Points) -> int:
    """Size of the largest group of adjacent windows (n, 2) among those of the grid of all windows (m, 2)."""
    if len(off_px) == 0 or len(all_px) < 2:
        return len(off_px)
    spacing, _ = cKDTree(all_px).query(all_px, k=2)
    reach = _NEIGHBOUR * float(np.median(spacing[:, 1]))
    adjacent = cKDTree(off_px).sparse_distance_matrix(cKDTree(off_px), reach)
    _, labels = connected_components(adjacent.tocsr() + identity(len(off_px)), directed=False)
    return int(np.bincount(labels).max())


CHECK = Check((FEW_WINDOWS, COVERAGE, CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX), _issues)
