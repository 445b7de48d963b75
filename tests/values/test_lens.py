import cv2
import numpy as np
from numpy.testing import assert_allclose

from agalign.values import lens
from agalign.values.lens import Lens
from agalign.values.pixel_units import PixelScale

MODEL = Lens(1453.0, 1453.0, 652.0, 489.0, (-0.109, 0.156, -0.0003, 0.0005, -0.05))
POINTS = np.random.default_rng(0).uniform((0, 0), (1279, 959), (200, 2))


def test_distort_is_opencvs_projection() -> None:
    rays = np.column_stack([(POINTS - (MODEL.cx_px, MODEL.cy_px)) / MODEL.fx_px, np.ones(len(POINTS))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MODEL.matrix, np.array(MODEL.distortion))
    assert_allclose(lens.distort(MODEL, POINTS), expected[:, 0], atol=1e-8)


def test_undistort_inverts_distort() -> None:
    assert_allclose(lens.distort(MODEL, lens.undistort(MODEL, POINTS)), POINTS, atol=1e-5)


def test_shapes_are_kept_and_no_lens_is_the_identity() -> None:
    grid = POINTS.reshape(10, 20, 2)
    assert lens.undistort(MODEL, grid).shape == grid.shape
    assert_allclose(lens.undistort(None, grid), grid)
    assert_allclose(lens.distort(Lens(1000, 1000, 5, 5), grid), grid)


def test_a_resized_image_has_a_resized_lens() -> None:
    scale = PixelScale(0.5, 0.25)
    small = lens.rescaled(MODEL, scale)
    there = (lens.distort(MODEL, POINTS) + 0.5) * scale - 0.5
    assert_allclose(lens.distort(small, (POINTS + 0.5) * scale - 0.5), there, atol=1e-9)
    assert lens.rescaled(None, scale) is None
