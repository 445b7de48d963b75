"""The rule by which windows verify what is fitted to windows.

The windows are in folds. Each is compared with a fit to the windows that share no pixels with those of its fold, and
the result is fitted to all. A homography has two folds, as half of the windows determine it; a displacement field has
many, as it is only known near windows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.fit.windows import residual_under
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.residual import Residual


@dataclass(frozen=True)
class Folds:
    """The folds of the windows of a residual."""

    numbers: NDArray[np.int64]
    """(n,) the fold of each window, from 0; -1 for a window in no fold."""
    count: int


def chessboard(residual: Residual) -> Folds:
    """Return two folds: windows that are adjacent along an axis of their grid are in different ones."""
    return Folds(residual.cells.sum(axis=1) % 2, 2)


def every_nth(residual: Residual, n: int) -> Folds:
    """Return n^2 folds: every nth window along both axes of their grid."""
    column, row = (residual.cells % n).T
    return Folds(column + n * row, n**2)


def one_by_one(residual: Residual) -> Folds:
    """Return a fold for each measured window; the others are in none."""
    measured = residual.is_measured
    return Folds(np.where(measured, np.cumsum(measured) - 1, -1), int(measured.sum()))


def remaining(residual: Residual, folds: Folds, side_px: float) -> Iterator[Residual]:
    """Yield, for each fold, the windows that share no pixels with those of the fold.

    `side_px` is the side of the windows, px of the reference.
    """
    for fold in range(folds.count):
        yield residual.where(are_apart(residual.centres_px, residual.centres_px[folds.numbers == fold], side_px))


def are_apart(centres_px: Points, others_px: Points, distance_px: float) -> NDArray[np.bool_]:
    """Return (n,) True for centres (n, 2) that are at least a distance from all others (m, 2), in the maximum norm.

    Two windows share pixels if this distance is less than the mean of their sides.
    """
    if not len(others_px):
        return np.ones(len(centres_px), dtype=bool)
    nearest, _ = cKDTree(others_px).query(centres_px, p=np.inf)
    return np.asarray(nearest >= distance_px)


def held_out(
    residual: Residual, mapping: PixelMapping, folds: Folds, by_fold: Sequence[PixelMapping | None]
) -> Residual:
    """Return the residual, measured with `mapping`, with the shift of each window under the mapping without its fold.

    `by_fold` has the mapping that was fitted without each fold, nearly equal to `mapping`; the windows of a fold
    without one have no shift.
    """
    shifts_px = np.full_like(residual.shifts_px, np.nan)
    for fold, fitted in enumerate(by_fold):
        of_fold = folds.numbers == fold
        if fitted is not None and of_fold.any():
            shifts_px[of_fold] = residual_under(residual.where(of_fold), mapping, fitted).shifts_px
    return residual.with_shifts(shifts_px)
