"""Which pixels of the reference nearer parts of the scene occlude in another band, from the relief alone."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import Mask
from agalign.values.relief import Relief

_MIN_WIDTH_PX = 1.5
"""Width of what a step hides, in px of the relief, from which the nearer of two pixels at one place hides the other:
less is relief of one surface or its noise, which resampling shows blurred but in place."""
_MIN_AREA_PX = 16
"""Of an occluded area: smaller ones are specks of wrong parallax."""
_MIN_OCCLUDED_SHARE = 0.002
"""Of the pixels: fewer may be wrong matches."""
_MIN_DIFFERENCE = 0.03
"""Of the mean correlation: less is chance."""


def nearer_sign(relief: Relief, baselines: NDArray[np.float64]) -> int:
    """1 where positive parallax is nearer, -1 where negative parallax is; 0 without evidence.

    Where two surfaces are displaced onto the same place, the nearer one is seen: its pixels match, those behind do not.
    With the wrong sign, pixels that match would be occluded.
    """
    means = []
    for sign, either in ((1, relief), (-1, relief.negated)):
        hidden = np.logical_or.reduce([occluded(either, (sign * x, sign * y)) for x, y in baselines.tolist()])
        if np.count_nonzero(hidden) < _MIN_OCCLUDED_SHARE * hidden.size:
            return 0
        means.append(float(relief.confidence[hidden].mean()))
    if abs(means[0] - means[1]) < _MIN_DIFFERENCE:
        return 0
    return 1 if means[0] < means[1] else -1


def occluded(relief: Relief, baseline: tuple[float, float]) -> Mask:
    """(height, width) True where another pixel of the relief, plainly nearer, is displaced onto the same place: a
    z-buffer, each pixel as wide as one of the relief.
    """
    longest = math.hypot(baseline[0] * relief.scale.x, baseline[1] * relief.scale.y)
    min_step_px = _MIN_WIDTH_PX / max(longest, 1e-9)
    parallax_px = relief.parallax_px
    height, width = parallax_px.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    at_x = np.rint(x + np.float32(baseline[0] * relief.scale.x) * parallax_px).astype(np.int32)
    at_y = np.rint(y + np.float32(baseline[1] * relief.scale.y) * parallax_px).astype(np.int32)
    inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
    place = np.where(inside, at_y * width + at_x, height * width).ravel()
    # The last writer wins: in ascending order, that is the nearest. Pixels outside share a place that is not looked at.
    order = np.argsort(parallax_px, axis=None, kind="stable")
    nearest = np.full(height * width + 1, -np.inf, np.float32)
    nearest[place[order]] = parallax_px.ravel()[order]
    nearest[-1] = -np.inf
    hidden = nearest[place].reshape(height, width) > parallax_px + np.float32(min_step_px)
    # Gaps between the pixels of a nearer surface that is magnified are closed; specks are noise of the relief.
    closed = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, areas, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    large = areas[:, cv2.CC_STAT_AREA] >= _MIN_AREA_PX
    large[0] = False  # what is not hidden
    return np.asarray(large[labels])
