"""Range of two planes from a rig with known positions and orientations of the lenses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agalign.fit.relief import inverse_range
from agalign.values import lens
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief

SIZE = 320, 240
REFERENCE = Lens(400.0, 402.0, 158.0, 121.0)
DISTORTED = Lens(400.0, 402.0, 158.0, 121.0, (-0.1, 0.03, 0.001, -0.0005, 0.0))
PLACES_M = np.array([[0.03, 0.0], [0.0, 0.02], [0.03, 0.021]])
"""Positions of the moving lenses, right of and below the reference."""
FOCAL_PX = (395.0, 405.0, 401.0)
ANGLES = ((0.004, -0.01, 0.02), (-0.006, 0.008, -0.01), (0.01, 0.002, 0.005))
PLANE_M, NEAR_M, SLOPE = 2.0, 1.1, 0.25
"""Range of the plane at the centre and of a box, and the slope of the plane relative to the image."""


K = np.array([[400.0, 0, 158], [0, 402, 121], [0, 0, 1]])


def tilted_plane(x: np.ndarray) -> np.ndarray:
    """Z = PLANE_M + SLOPE X with X = Z (x - cx) / f."""
    return PLANE_M / (1 - SLOPE * (x - K[0, 2]) / K[0, 0])


def truth(points: np.ndarray, reference: Lens) -> np.ndarray:
    """Range (...) at raw pixels: a tilted plane with a box parallel to the image above it."""
    x, y = np.moveaxis(lens.undistort(reference, points), -1, 0)
    return np.where((np.abs(x - 200) < 40) & (np.abs(y - 90) < 30), NEAR_M, tilted_plane(x))


@pytest.mark.parametrize("reference", [REFERENCE, DISTORTED])
@pytest.mark.parametrize("bands", [3, 1])
def test_range_of_a_plane_and_a_box(reference: Lens, bands: int) -> None:
    points = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)
    range_m = truth(points, reference)
    normal = np.array([-SLOPE, 0.0, 1.0])  # of the plane: normal . X = PLANE_M
    unit = np.linalg.norm(PLACES_M[:bands], axis=1).max() * K[0, 0]
    # Parallax is proportional to 1 / Z minus the plane's at the same pixel.
    plane_m = tilted_plane(lens.undistort(reference, points)[..., 0])
    parallax_px = unit * (1 / range_m - 1 / plane_m)
    mappings, infinite = [], []
    for place, focal_px, angles in list(zip(PLACES_M, FOCAL_PX, ANGLES, strict=True))[:bands]:
        turn = Rotation.from_euler("xyz", angles).as_matrix()
        there = np.array([[focal_px, 0, 160], [0, focal_px, 119], [0, 0, 1.0]])
        translation = np.array([*place, 0.0])
        # X' = R (X - place); on the plane 1 = normal . X / PLANE_M.
        by_plane = there @ turn @ (np.eye(3) - np.outer(translation, normal) / PLANE_M) @ np.linalg.inv(K)
        infinite.append(there @ turn @ np.linalg.inv(K))
        # With this t, H (x + t z) ~ K' R (X - place) for all points of the line of sight.
        baseline = -K[:2, :2] @ place / unit / (1 - normal @ translation / PLANE_M)
        relief = Relief(parallax_px.astype(np.float32), np.ones(SIZE[::-1], np.float32))
        mappings.append(PixelMapping(by_plane, reference, None, parallax=Parallax(relief, tuple(baseline))))
    inverse_m = inverse_range(mappings, infinite, -PLACES_M[:bands], reference, points, parallax_px)
    np.testing.assert_allclose(inverse_m * range_m, 1, atol=1e-3)
    assert np.ptp(range_m) > 0.8
