"""Whether an alignment can be believed. A wrong one called `aligned` is the worst this program could do."""

from collections.abc import Iterator

import numpy as np
from scipy.sparse import identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from agalign.config import CheckSettings
from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.choices import PairStatus
from agalign.values.geometry import Matrix, Points
from agalign.values.issues import Issue

_NEIGHBOUR = 1.6
"""Diagonal neighbours count, in distances between windows."""
_MAX_STRETCH = 4.0
"""Largest over smallest magnification within an image."""


def issues_of(
    joint: JointResult, residual: Residual, size_px: tuple[int, int], settings: CheckSettings
) -> tuple[Issue, ...]:
    """Everything that speaks against a result on an image (width, height), the plainest first."""
    return (*_of_the_result(joint, size_px, settings), *_of_the_windows(residual, settings))


def status_of(issues: tuple[Issue, ...], residual: Residual, settings: CheckSettings, *, seed: bool) -> PairStatus:
    """`aligned` where nothing speaks against it; else `seed_only`, where the `seed` is usable and what it leaves is not
    too much, or `failed`.
    """
    if not issues:
        return "aligned"
    return "seed_only" if seed and seed_fits(residual, settings) else "failed"


def seed_fits(residual: Residual, settings: CheckSettings) -> bool:
    """True where what a seed leaves is little enough for it to be used as it is."""
    return residual.coverage >= settings.min_seed_coverage and residual.median_px <= settings.max_seed_residual_px


def _of_the_result(joint: JointResult, size_px: tuple[int, int], settings: CheckSettings) -> Iterator[Issue]:
    # Each is written so that nan passes nowhere.
    scale = geometry.local_scale(joint.fixed_to_moving, *size_px)
    if not (scale.min() > 0 and scale.max() <= _MAX_STRETCH * scale.min()):
        yield Issue("folds", float(scale.max() / scale.min()), _MAX_STRETCH)
    minimum = max(settings.min_retrieval, settings.min_times_chance * joint.chance)
    if not joint.retrieval >= minimum:
        yield Issue("retrieval", joint.retrieval, minimum)
    if not joint.corner_std_px <= settings.max_corner_std_px:
        yield Issue("corner_std_px", joint.corner_std_px, settings.max_corner_std_px)


def _of_the_windows(residual: Residual, settings: CheckSettings) -> Iterator[Issue]:
    if len(residual.centres_px) < settings.min_windows:
        yield Issue("few_windows", len(residual.centres_px), settings.min_windows)
        return
    if not residual.coverage >= settings.min_coverage:
        yield Issue("coverage", residual.coverage, settings.min_coverage)
    measured = np.isfinite(residual.shifts_px[:, 0])
    off = measured & (np.linalg.norm(np.nan_to_num(residual.shifts_px), axis=1) > settings.max_residual_px)
    close = 1 - float(off.sum()) / max(int(measured.sum()), 1)
    if not close >= settings.min_close:
        within = f"{settings.max_residual_px:g} px"
        yield Issue("close_windows", close, settings.min_close, within)
    together = _largest_cluster(residual.centres_px[off], residual.centres_px)
    maximum = max(settings.min_cluster, round(settings.max_cluster * int(measured.sum())))
    if not together < maximum:
        yield Issue("cluster", together / max(int(measured.sum()), 1), maximum / max(int(measured.sum()), 1))
    if not residual.median_px <= settings.max_residual_px:
        yield Issue("residual_px", residual.median_px, settings.max_residual_px)


def _largest_cluster(off_px: Points, all_px: Points) -> int:
    """How many of some windows (n, 2) hang together, each beside the next on the grid of all (m, 2)."""
    if len(off_px) == 0 or len(all_px) < 2:
        return len(off_px)
    # Windows lie about as far apart as each one's nearest neighbour does.
    distance, _ = cKDTree(all_px).query(all_px, k=2)
    reach = _NEIGHBOUR * float(np.median(distance[:, 1]))
    beside = cKDTree(off_px).sparse_distance_matrix(cKDTree(off_px), reach)
    _, labels = connected_components(beside.tocsr() + identity(len(off_px)), directed=False)
    return int(np.bincount(labels).max())


def is_as_it_was(
    joint: JointResult, given: Matrix, size_px: tuple[int, int], settings: CheckSettings, scale: float = 1.0
) -> bool:
    """True where the result cannot be told from the mapping that the files came with: they were aligned already.

    `scale` is the size of the image relative to its file, in whose pixels the limit is.
    """
    moved_px = geometry.corner_error_px(joint.fixed_to_moving, given, *size_px)
    return moved_px <= min(settings.max_snap_px * scale, 3 * joint.corner_std_px)
