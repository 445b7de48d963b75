"""Semi-global matching: edge-preserving smooth labelling of a cost volume (Hirschmuller 2008).

Along each of four paths, with cost C(d) at label d,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + small, min_k L(q, k) + large) - min_k L(q, k)

with q the previous pixel on the path. Each pixel gets the label with the minimum sum over the paths. OpenCV's
StereoSGBM cannot be used: it computes the costs from two rectified images and accepts no cost volume.
"""

import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage

Volume = NDArray[np.int16]
"""(labels, height, width). Sums over four paths are below 2^15 if a cost plus the large penalty is below 2^13."""


def aggregated(costs: Volume, small: int, large: int) -> Volume:
    """Return the sum of the path costs from the left, right, top and bottom, (labels, height, width).

    `small` is the penalty of a step by one label, `large` that of a longer step.
    """
    total = np.zeros_like(costs)
    for axes, inverse_axes in (((2, 0, 1), (1, 2, 0)), ((1, 0, 2), (1, 0, 2))):
        ordered = np.ascontiguousarray(costs.transpose(axes))
        sums = np.zeros_like(ordered)
        _add_path(ordered, sums, np.int16(small), np.int16(large))
        _add_path(ordered[::-1], sums[::-1], np.int16(small), np.int16(large))
        total += sums.transpose(inverse_axes)
    return total


def _add_path(costs: Volume, sums: Volume, small: np.int16, large: np.int16) -> None:
    """Add the path costs along the first axis of `costs` (length, labels, lines) to `sums`."""
    previous = costs[0].copy()
    sums[0] += previous
    for i in range(1, len(costs)):
        minimum = previous.min(axis=0)
        current = np.minimum(previous, minimum + large)
        previous += small
        np.minimum(current[1:], previous[:-1], out=current[1:])
        np.minimum(current[:-1], previous[1:], out=current[:-1])
        current -= minimum
        current += costs[i]
        sums[i] += current
        previous = current


def sub_label_minimum(costs: NDArray[np.int16] | NDArray[np.float32]) -> FloatImage:
    """Return the label of minimum cost, (height, width), refined by the parabola through its neighbours."""
    last = len(costs) - 1
    label = costs.argmin(axis=0)
    inner = np.clip(label, 1, last - 1)
    lower, centre, upper = (
        np.take_along_axis(costs, inner[None] + k, axis=0)[0].astype(np.float32) for k in (-1, 0, 1)
    )
    curvature = lower - 2 * centre + upper
    offset = np.where(curvature > 0, (lower - upper) / (2 * np.maximum(curvature, 1e-9)), 0.0)
    return np.asarray(np.where(inner == label, inner + np.clip(offset, -0.5, 0.5), label), np.float32)
