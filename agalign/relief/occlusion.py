"""Occlusion in another band of pixels of the reference, from the relief alone."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import Mask
from agalign.values.relief import Relief

_MIN_WIDTH_PX = 1.5
"""Minimum width of an occlusion, in px of the relief: smaller differences of parallax are slopes of one surface, or
noise."""
_MIN_AREA_PX = 16
"""Minimum size of an occluded area: smaller ones are single pixels with wrong parallax."""
_MIN_OCCLUDED_SHARE = 0.002
"""Minimum share of occluded pixels: fewer may be wrong matches."""
_MIN_CORRELATION_DIFFERENCE = 0.03
"""Minimum difference of the mean correlations: smaller ones may be chance."""


def nearer_sign(relief: Relief, baselines: NDArray[np.float64]) -> int:
    """Return 1 if positive parallax is nearer to the camera, -1 if negative parallax is, 0 if unknown.

    Where two surfaces are displaced to the same position, only pixels of the nearer one match. With the wrong sign,
    pixels with a high correlation would be occluded. `baselines` (bands, 2): displacement (x, y) of each band, px, by a
    parallax of 1.
    """
    means = []
    for sign, signed_relief in ((1, relief), (-1, relief.negated)):
        hidden = np.logical_or.reduce([occluded(signed_relief, (sign * x, sign * y)) for x, y in baselines.tolist()])
        if np.count_nonzero(hidden) < _MIN_OCCLUDED_SHARE * hidden.size:
            return 0
        means.append(float(relief.confidence[hidden].mean()))
    if abs(means[0] - means[1]) < _MIN_CORRELATION_DIFFERENCE:
        return 0
    return 1 if means[0] < means[1] else -1


def occluded(relief: Relief, baseline: tuple[float, float]) -> Mask:
    """Return (height, width) True where a nearer pixel of the relief is displaced to the same position (z-buffer).

    `baseline` is t_b, undistorted px of the reference per px of parallax; positive parallax is nearer.
    """
    longest = math.hypot(baseline[0] * relief.scale.x, baseline[1] * relief.scale.y)
    min_step_px = _MIN_WIDTH_PX / max(longest, 1e-9)
    parallax_px = relief.parallax_px - relief.parallax_px.min()
    height, width = parallax_px.shape
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    moved_x = np.rint(x + np.float32(baseline[0] * relief.scale.x) * relief.parallax_px).astype(np.int32)
    moved_y = np.rint(y + np.float32(baseline[1] * relief.scale.y) * relief.parallax_px).astype(np.int32)
    inside = (moved_x >= 0) & (moved_x < width) & (moved_y >= 0) & (moved_y < height)
    cell = np.where(inside, moved_y * np.int32(width) + moved_x, np.int32(height * width))
    nearest = np.zeros(height * width + 1, np.float32)
    # The bits of floats that are not negative have their order, and `maximum.at` is much faster for integers.
    np.maximum.at(nearest.view(np.int32), cell.ravel(), parallax_px.ravel().view(np.int32))
    nearest[-1] = 0  # Pixels outside share the last cell, which is ignored.
    hidden = nearest.take(cell) > parallax_px + np.float32(min_step_px)
    # Closing fills the gaps between the pixels of a magnified nearer surface.
    closed = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    is_large = statistics[:, cv2.CC_STAT_AREA] >= _MIN_AREA_PX
    is_large[0] = False  # the background
    return np.asarray(is_large[labels])
