"""The homography close to the identity that the shifts of many windows speak of, by its corners."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry

Array = NDArray[np.float64]

_SPREADS = 2.0
"""A window that lies so many times farther out than most has half a vote."""
_MIN_SPREAD_PX = 0.05
_REWEIGHTINGS = 6
_NOTHING = 1e-9
"""Of all that is known: what directions get of which nothing is."""


@dataclass(frozen=True)
class CornerFit:
    """How far each corner moves, clockwise from the top left, and how well that is known."""

    mean_px: Array
    """(8,): x and y of the corners in turn."""
    covariance_px2: Array
    """(8, 8): what the windows disagree by sets it."""


def fit_corners(at_px: Array, shifts_px: Array, peaks_sigma: Array, size_px: tuple[int, int]) -> CornerFit:
    """Least squares of shifts (n, 2) at places (n, 2) of an image (width, height), weighted by the fourth power of how
    far the peaks (n,) stand out; those that lie far out have less of a vote.
    """
    design = geometry.over_corners(at_px, *size_px)
    trust, vote = (peaks_sigma / np.median(peaks_sigma)) ** 4, np.ones(len(shifts_px))
    for _ in range(_REWEIGHTINGS):
        weight = trust * vote
        normal = np.einsum("n,nki,nkj->ij", weight, design, design)
        mean = np.linalg.lstsq(normal, np.einsum("n,nki,nk->i", weight, design, shifts_px), rcond=None)[0]
        left = shifts_px - design @ mean
        off = np.linalg.norm(left, axis=1)
        vote = 1 / (1 + (off / (_SPREADS * max(1.4826 * float(np.median(off)), _MIN_SPREAD_PX))) ** 2)
    score = np.einsum("n,nki,nk->ni", weight, design, left)
    # Windows in a line agree, and say nothing of what lies beside it.
    inverse = np.linalg.inv(normal + _NOTHING * np.trace(normal) * np.eye(8))
    disagreement = inverse @ (score.T @ score) @ inverse
    return CornerFit(mean, np.asarray(disagreement + (_MIN_SPREAD_PX**2 / np.median(weight)) * inverse))
