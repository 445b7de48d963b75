"""Semi-global matching: edge-preserving smooth labelling of a cost volume (Hirschmuller 2008).

Along each of four paths, with cost C(d) at label d,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + small, min_k L(q, k) + large) - min_k L(q, k)

with q the previous pixel on the path. Each pixel gets the label with the minimum sum over the paths. OpenCV's
StereoSGBM cannot be used: it computes the costs from two rectified images and accepts no cost volume.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage

Volume = NDArray[np.uint8]
"""(labels, height, width) costs; a cost plus both penalties is at most 255."""
MAX_LARGE = 63
"""Maximum large penalty. A path adds at most this much to the cost, so the sum over four paths is at most 252."""


def aggregated(costs: Volume, small: int, large: int) -> NDArray[np.uint16]:
    """Return the sum of the path costs from the left, right, top and bottom, (labels, height, width).

    `small` is the penalty of a step by one label, `large` that of a longer step.
    """
    vertical = _path_penalties(costs, np.uint8(small), np.uint8(large))
    horizontal = _path_penalties(np.stack([cv2.transpose(plane) for plane in costs]), np.uint8(small), np.uint8(large))
    result = np.multiply(costs, 4, dtype=np.uint16)
    for plane, down, across in zip(result, vertical, horizontal, strict=True):
        plane += cv2.add(down, cv2.transpose(across))
    return result


def _path_penalties(costs: Volume, small: np.uint8, large: np.uint8) -> Volume:
    """Return L - C (labels, length, lines) of the two paths along the second axis of the costs, added."""
    result = np.zeros_like(costs)
    length = costs.shape[1]
    for path in (range(length), range(length - 1, -1, -1)):
        previous = costs[:, path[0]].copy()
        current = np.empty_like(previous)
        for i in path[1:]:
            minimum = previous.min(axis=0)
            np.minimum(previous, minimum + large, out=current)
            previous += small
            np.minimum(current[1:], previous[:-1], out=current[1:])
            np.minimum(current[:-1], previous[1:], out=current[:-1])
            current -= minimum
            result[:, i] += current
            current += costs[:, i]
            previous, current = current, previous
    return result


def sub_label_minimum(costs: NDArray[np.uint16] | NDArray[np.float32]) -> FloatImage:
    """Return the label of minimum cost, (height, width), refined by the parabola through its neighbours.

    There are at least three labels.
    """
    last = len(costs) - 1
    minimum = costs.min(axis=0)
    label = np.zeros(minimum.shape, np.uint16)
    for k in range(last, -1, -1):  # `argmin` along the first axis is several times slower.
        np.copyto(label, k, where=costs[k] == minimum)
    inner = np.clip(label, 1, last - 1)
    at = inner * np.intp(minimum.size) + np.arange(minimum.size).reshape(minimum.shape)
    lower, centre, upper = (costs.reshape(-1).take(at + k * minimum.size).astype(np.float32) for k in (-1, 0, 1))
    curvature = lower - 2 * centre + upper
    offset = np.where(curvature > 0, (lower - upper) / (2 * np.maximum(curvature, 1e-9)), 0.0)
    return np.asarray(np.where(inner == label, inner + np.clip(offset, -0.5, 0.5), label), np.float32)
