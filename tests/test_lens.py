import cv2
import numpy as np
from numpy.testing import assert_allclose

from agalign import lens
from agalign.records import Lens, Raster

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


def test_an_undistorted_image_shows_straight_lines_where_the_model_puts_them() -> None:
    # A raw image whose value is its own undistorted x coordinate must become a ramp.
    x, y = np.meshgrid(np.arange(1280.0), np.arange(960.0))
    raw = lens.undistort(MODEL, np.stack([x, y], axis=-1))[..., 0].astype(np.float32)
    straight = lens.undistort_raster(Raster(raw, np.ones(raw.shape, bool)), MODEL)
    inside = straight.valid.copy()
    inside[:3], inside[-3:], inside[:, :3], inside[:, -3:] = False, False, False, False
    assert inside.mean() > 0.9
    assert np.abs(straight.pixels - x)[inside].max() < 0.04  # Lanczos itself bends a ramp by 0.03
    assert abs(float((straight.pixels - x)[inside].mean())) < 0.002
