"""SIFT landmarks of two images and their homography, for images that are rotated, scaled or far apart (Lowe 2004;
square root of the descriptors: Arandjelovic & Zisserman 2012).
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.pixels.grey import channel_mean, eight_bit
from agalign.pixels.resample import shrink
from agalign.pixels.structure import gradient_magnitude
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster
from agalign.values.lens import Lens

LandmarkInput = Literal["edges", "image"]
LANDMARK_INPUTS: tuple[LandmarkInput, ...] = ("edges", "image")
"""What is looked at: the strength of the edges, which a reversed contrast leaves as it is, or the image itself."""

_LONGEST_SIDE_PX = 640
"""Larger images are reduced to this: a seed need not be exact."""
_MOST = 3000
_RATIO = 0.9
"""Nearest over second nearest distance, from which a match is ambiguous."""
_WITHIN_PX = 3.0
_MIN_AGREED = 10
"""Unrelated images reach 8."""
_EDGES_SMOOTHED_PX, _BESIDE_INVALID_PX = 1.0, 7


@dataclass(frozen=True)
class Landmarks:
    """Where they are and what they look like."""

    xy: Points
    """(n, 2) px of the image."""
    descriptors: NDArray[np.float32]
    """(n, 128), of length 1."""

    def undistorted(self, model: Lens | None) -> "Landmarks":
        """The same in the pixels of a camera without the lens's distortion."""
        return Landmarks(lens.undistort(model, self.xy), self.descriptors)


def landmarks(raster: Raster, view: LandmarkInput) -> Landmarks:
    """The strongest ones of an image, whatever its channels."""
    width, height = raster.size_px
    scale = min(1.0, _LONGEST_SIDE_PX / max(width, height))
    small = shrink(channel_mean(raster), (max(8, round(width * scale)), max(8, round(height * scale))))
    looked_at, valid = small.pixels, small.valid
    if view == "edges":
        smooth = cv2.GaussianBlur(np.where(valid, looked_at, 0).astype(np.float32), (0, 0), _EDGES_SMOOTHED_PX)
        looked_at = np.sqrt(gradient_magnitude(*(cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))))
        margin = np.ones((_BESIDE_INVALID_PX, _BESIDE_INVALID_PX), np.uint8)
        valid = cv2.erode(valid.astype(np.uint8), margin, borderValue=1) > 0
    result, described = cv2.SIFT.create(nfeatures=_MOST).detectAndCompute(eight_bit(looked_at, valid), valid.view("u1"))
    if described is None:
        return Landmarks(np.empty((0, 2)), np.empty((0, 128), np.float32))
    there = np.array([k.pt for k in result], np.float64)
    up = width / small.size_px[0], height / small.size_px[1]
    root = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-12))
    return Landmarks((there + 0.5) * up - 0.5, np.asarray(root, np.float32))


def agreed_homography(fixed: Landmarks, moving: Landmarks, size_px: tuple[int, int]) -> Matrix | None:
    """fixed_to_moving that ten or more unambiguous matches agree on, for a fixed image (width, height), or None."""
    if min(len(fixed.xy), len(moving.xy)) < _MIN_AGREED:
        return None
    alike = fixed.descriptors @ moving.descriptors.T
    best, back = alike.argmax(axis=1), alike.argmax(axis=0)
    second, first = np.sqrt(np.maximum(2 - 2 * np.partition(alike, -2, axis=1)[:, -2:], 0)).T
    rows = np.flatnonzero((first < _RATIO * second) & (back[best] == np.arange(len(best))))
    if len(rows) < _MIN_AGREED:
        return None
    within_px = _WITHIN_PX * max(1.0, max(size_px) / _LONGEST_SIDE_PX)
    result, agrees = cv2.findHomography(
        fixed.xy[rows], moving.xy[best[rows]], cv2.USAC_MAGSAC, within_px, maxIters=20_000, confidence=0.9999
    )
    if result is None or int(agrees.sum()) < _MIN_AGREED:
        return None
    try:
        return geometry.normalised(result)
    except GeometryError:
        return None
