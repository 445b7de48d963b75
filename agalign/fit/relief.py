"""What follows from the relief of a capture: occlusions in the other bands, its sign, and the range of the scene."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Mask
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Relief


def nearer_sign(relief: Relief, baselines: NDArray[np.float64]) -> int:
    """Return 1 if positive parallax is nearer to the camera, -1 if negative parallax is, 0 if unknown.

    Where two surfaces are displaced to the same position, only pixels of the nearer one match. With the wrong sign,
    pixels with a high correlation would be occluded. `baselines` (bands, 2): displacement (x, y) of each band, px, by a
    parallax of 1.
    """
    min_occluded_share = 0.002  # fewer pixels may be wrong matches
    min_correlation_difference = 0.03  # smaller ones may be chance
    means = []
    for sign, signed_relief in ((1, relief), (-1, relief.negated)):
        hidden = np.logical_or.reduce([occluded(signed_relief, (sign * x, sign * y)) for x, y in baselines.tolist()])
        if np.count_nonzero(hidden) < min_occluded_share * hidden.size:
            return 0
        means.append(float(relief.confidence[hidden].mean()))
    if abs(means[0] - means[1]) < min_correlation_difference:
        return 0
    return 1 if means[0] < means[1] else -1


def occluded(relief: Relief, baseline: tuple[float, float]) -> Mask:
    """Return (height, width) True where a nearer pixel of the relief is displaced to the same position (z-buffer).

    `baseline` is t_b, undistorted px of the reference per px of parallax; positive parallax is nearer.
    """
    min_width_px = 1.5  # smaller differences of parallax are slopes of one surface, or noise
    min_area_px = 16  # smaller areas are single pixels with wrong parallax
    longest = math.hypot(baseline[0] * relief.scale.x, baseline[1] * relief.scale.y)
    min_step_px = min_width_px / max(longest, 1e-9)
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
    is_large = statistics[:, cv2.CC_STAT_AREA] >= min_area_px
    is_large[0] = False  # the background
    return np.asarray(is_large[labels])


def inverse_range(
    mappings: Sequence[PixelMapping],
    at_infinity: Sequence[Matrix],
    directions_m: NDArray[np.float64],
    reference_lens: Lens,
    points_px: Points,
    parallax_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return 1 / Z (height, width), per metre, at raw pixels (height, width, 2) of the reference with a parallax.

    `mappings` are the complete mappings of the bands and `at_infinity` their fixed_to_moving at infinite range,
    undistorted px. `directions_m` (bands, 2) are the directions in which points move when the scene comes nearer: the
    negative positions of the lenses relative to the reference, metres.

    In a lens displaced by B_b (metres, right and down in the image), a point at range Z along the optical axis is
    shifted by

        d_b = -f B_b / Z

    relative to its position at infinite range (Hartley & Zisserman 2004, Eq. 9.6), in px of the reference with focal
    length f. The homography at infinite range follows from the orientations of the lenses in the tags. 1 / Z is the
    least squares solution over all bands.
    """
    focal_px = np.array([reference_lens.fx_px, reference_lens.fy_px])
    weights = directions_m * focal_px
    low, high = points_px.reshape(-1, 2).min(axis=0), points_px.reshape(-1, 2).max(axis=0)
    node_count = 33  # along both axes of the grid on which mappings are evaluated
    x, y = (np.linspace(a, max(b, a + 1), node_count) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    levels = float(parallax_px.min()), float(parallax_px.max()) + 1.0
    values = []
    for level in levels:
        total = np.zeros(nodes.shape[:2])
        for mapping, infinite, weight in zip(mappings, at_infinity, weights, strict=True):
            undistorted = mapping.of_the_plane.undistorted(nodes)
            assert mapping.parallax is not None
            moved = undistorted + level * np.array(mapping.parallax.baseline)
            observed = geometry.apply(geometry.invert(infinite), geometry.apply(mapping.fixed_to_moving, moved))
            total += (observed - lens.undistort(reference_lens, nodes)) @ weight
        values.append(total / (weights**2).sum())
    # Linear interpolation in the parallax between two levels.
    low_value, high_value = (RegularGridInterpolator((y, x), v)(points_px[..., ::-1]) for v in values)
    share = (parallax_px - levels[0]) / (levels[1] - levels[0])
    return np.asarray(low_value + share * (high_value - low_value))
