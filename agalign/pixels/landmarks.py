"""SIFT matching of two images with a rotation, a scale or a large offset (Lowe 2004), with the RootSIFT descriptor
(Arandjelovic & Zisserman 2012).
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.pixels.band_resampling import channel_mean, eight_bit, shrink
from agalign.pixels.structure import gradient_magnitude
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster
from agalign.values.lens import Lens
from agalign.values.pixel_units import PixelScale

LandmarkInput = Literal["edges", "image"]
LANDMARK_INPUTS: tuple[LandmarkInput, ...] = ("edges", "image")
"""What keypoints are detected in: the gradient magnitude, which does not depend on the sign of contrast, or the
image."""

_LONGEST_SIDE_PX = 640
"""Larger images are reduced to this; the accuracy suffices for a seed."""
_MAX_KEYPOINTS = 3000
"""The strongest keypoints; limits the time of matching."""
_MAX_RATIO = 0.9
"""Maximum ratio of the distances of the nearest and second nearest descriptor (Lowe's ratio test)."""
_INLIER_PX = 3.0
"""Maximum residual of an inlier, px of the reduced image."""
_MIN_INLIERS = 10
"""Unrelated images have up to 8."""


@dataclass(frozen=True)
class Landmarks:
    """Keypoints of an image and their descriptors."""

    xy: Points
    """(n, 2) px of the image."""
    descriptors: NDArray[np.float32]
    """(n, 128), of length 1."""

    def undistorted(self, model: Lens | None) -> "Landmarks":
        """Return the landmarks in undistorted px."""
        return Landmarks(lens.undistort(model, self.xy), self.descriptors)


def landmarks(raster: Raster, view: LandmarkInput, longest_side_px: int = _LONGEST_SIDE_PX) -> Landmarks:
    """Detect the strongest landmarks in the mean of an image's channels; larger images are reduced."""
    width, height = raster.size_px
    scale = min(1.0, longest_side_px / max(width, height))
    small = shrink(channel_mean(raster), (max(8, round(width * scale)), max(8, round(height * scale))))
    image, valid = small.pixels, small.valid
    if view == "edges":
        smooth = cv2.GaussianBlur(np.where(valid, image, 0).astype(np.float32), (0, 0), 1.0)
        image = np.sqrt(gradient_magnitude(*(cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))))
        without_edges = np.ones((7, 7), np.uint8)  # of invalid areas, in the smoothed gradient
        valid = cv2.erode(valid.astype(np.uint8), without_edges, borderValue=1) > 0
    sift = cv2.SIFT.create(nfeatures=_MAX_KEYPOINTS)
    keypoints, descriptors = sift.detectAndCompute(eight_bit(image, valid), valid.view("u1"))
    if descriptors is None:
        return Landmarks(np.empty((0, 2)), np.empty((0, 128), np.float32))
    xy = np.array([k.pt for k in keypoints], np.float64)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    enlargement = PixelScale.between(small.size_px, raster.size_px)
    return Landmarks(enlargement.positions(xy), np.asarray(root, np.float32))


def matched_homography(fixed: Landmarks, moving: Landmarks, size_px: tuple[int, int]) -> Matrix | None:
    """Return fixed_to_moving from mutual nearest neighbours that pass the ratio test; None with too few inliers.

    `size_px` is (width, height) of the fixed image.
    """
    rows, columns = matches(fixed, moving)
    if len(rows) < _MIN_INLIERS:
        return None
    inlier_px = _INLIER_PX * max(1.0, max(size_px) / _LONGEST_SIDE_PX)
    return robust_homography(fixed.xy[rows], moving.xy[columns], inlier_px, _MIN_INLIERS)


def matches(fixed: Landmarks, moving: Landmarks) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices (n,) of mutual nearest neighbours that pass the ratio test, in `fixed` and in `moving`."""
    if min(len(fixed.xy), len(moving.xy)) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    similarity = fixed.descriptors @ moving.descriptors.T
    forward, backward = similarity.argmax(axis=1), similarity.argmax(axis=0)
    second, first = np.sqrt(np.maximum(2 - 2 * np.partition(similarity, -2, axis=1)[:, -2:], 0)).T
    rows = np.flatnonzero((first < _MAX_RATIO * second) & (backward[forward] == np.arange(len(forward))))
    return rows, forward[rows]


def robust_homography(fixed_xy: Points, moving_xy: Points, inlier_px: float, min_inliers: int) -> Matrix | None:
    """Estimate fixed_to_moving from matches (n, 2) with outliers by MAGSAC++ (Barath et al. 2020).

    None with fewer than `min_inliers` inliers, with residuals of at most `inlier_px`.
    """
    matrix, inliers = cv2.findHomography(
        fixed_xy, moving_xy, cv2.USAC_MAGSAC, inlier_px, maxIters=20_000, confidence=0.9999
    )
    if matrix is None or int(inliers.sum()) < min_inliers:
        return None
    try:
        return geometry.normalised(matrix)
    except GeometryError:
        return None
