"""Semi-global matching: the smooth labelling of a cost volume that keeps sharp edges (Hirschmuller 2008).

Along each of four paths, with cost C(d) at label d,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + small, min_k L(q, k) + large) - min_k L(q, k)

with q the pixel before p. The label with the least sum over the paths wins. OpenCV's StereoSGBM computes its own costs
from two rectified images and does not take a volume of several bands.
"""

import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage

Volume = NDArray[np.int16]
"""(labels, height, width). Sums over four paths stay below 2^15 where a cost and the large penalty stay below 2^13."""


def aggregated(costs: Volume, small: int, large: int) -> Volume:
    """The sum over the paths from the left, right, top and bottom: (labels, height, width).

    `small` is the penalty of a step by one label, `large` that of any longer one.
    """
    total = np.zeros_like(costs)
    for axes, back in (((2, 0, 1), (1, 2, 0)), ((1, 0, 2), (1, 0, 2))):
        along = np.ascontiguousarray(costs.transpose(axes))
        sums = np.zeros_like(along)
        _sweep(along, sums, np.int16(small), np.int16(large))
        _sweep(along[::-1], sums[::-1], np.int16(small), np.int16(large))
        total += sums.transpose(back)
    return total


def _sweep(costs: Volume, sums: Volume, small: np.int16, large: np.int16) -> None:
    """Add the path along the first axis of costs (length, labels, lines) to `sums`."""
    before = costs[0].copy()
    sums[0] += before
    for place in range(1, len(costs)):
        lowest = before.min(axis=0)
        best = np.minimum(before, lowest + large)
        before += small
        np.minimum(best[1:], before[:-1], out=best[1:])
        np.minimum(best[:-1], before[1:], out=best[:-1])
        best -= lowest
        best += costs[place]
        sums[place] += best
        before = best


def sub_label_minimum(costs: NDArray[np.int16] | NDArray[np.float32]) -> FloatImage:
    """(height, width): the label of least cost, to a fraction by the parabola through its neighbours."""
    last = len(costs) - 1
    label = costs.argmin(axis=0)
    inner = np.clip(label, 1, last - 1)
    before, at, after = (np.take_along_axis(costs, inner[None] + k, axis=0)[0].astype(np.float32) for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    offset = np.where(curvature > 0, (before - after) / (2 * np.maximum(curvature, 1e-9)), 0.0)
    return np.asarray(np.where(inner == label, inner + np.clip(offset, -0.5, 0.5), label), np.float32)
