"""Lens shapes: their size, and the error where a homography is extrapolated."""

import cv2
import numpy as np
import pytest

from agalign.values import geometry
from agalign.verify.lens_shapes import CALIBRATED, LENS_STD, lens_shapes, lens_std_px, unmodelled_std_px

SIZE = 1280, 960
CENTRES = np.stack(np.meshgrid(np.arange(56.0, 1280, 112), np.arange(56.0, 960, 112)), -1).reshape(-1, 2)
LEFT = CENTRES[CENTRES[:, 0] < 600]
EVERYWHERE = geometry.lattice(*SIZE, 17, 13)


def test_the_radial_shapes_are_those_of_opencv_and_1_long_at_the_corners() -> None:
    corners = geometry.corners(*SIZE)
    np.testing.assert_allclose(np.linalg.norm(lens_shapes(corners, SIZE)[:, :, :2], axis=1), 1.0)
    focal, centre = 1500.0, (np.array(SIZE) - 1) / 2
    half_diagonal = float(np.linalg.norm(centre))
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    rays = np.column_stack([(EVERYWHERE - centre) / focal, np.ones(len(EVERYWHERE))])
    # k1, k2, p1, p2 that displace a corner by 1 px each
    k = [focal**2 / half_diagonal**3, focal**4 / half_diagonal**5, focal / half_diagonal**2 / 3]
    for shape, coefficients in enumerate([(k[0], 0, 0, 0), (0, k[1], 0, 0), (0, 0, 0, k[2]), (0, 0, k[2], 0)]):
        moved = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera, np.array(coefficients))[0][:, 0]
        np.testing.assert_allclose(moved - EVERYWHERE, lens_shapes(EVERYWHERE, SIZE)[:, :, shape], atol=1e-9)


def test_unmodelled_distortion_grows_with_extrapolation_and_shrinks_with_calibration() -> None:
    whole, half = (unmodelled_std_px(c, SIZE, calibrated=False) for c in (CENTRES, LEFT))
    assert 0.1 < whole < 0.25
    assert 0.5 < half < 1.0
    assert unmodelled_std_px(LEFT, SIZE, calibrated=True) == pytest.approx(CALIBRATED * half)
    np.testing.assert_allclose(lens_std_px(SIZE, calibrated=False), 800 * np.array(LENS_STD))
