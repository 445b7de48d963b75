import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from agalign.errors import GeometryError
from agalign.values import geometry, lens
from agalign.values.lens import Lens

points = np.array([[0.0, 0.0], [100.0, 0.0], [37.5, 80.0], [120.0, 90.0]])


@pytest.mark.parametrize("bad", [np.zeros((3, 3)), np.eye(2), np.full((3, 3), np.nan), np.diag([1.0, 1.0, 0.0])])
def test_other_matrices_than_homographies_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(GeometryError):
        geometry.normalised(bad)


def test_corner_error_is_the_worst_corner() -> None:
    assert geometry.corner_error_px(np.eye(3), geometry.translation(3, 4), 100, 80) == pytest.approx(5)
    stretched = np.diag([1.1, 1.0, 1.0])
    assert geometry.corner_error_px(np.eye(3), stretched, 101, 80) == pytest.approx(10)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_invertibility_does_not_depend_on_the_units(unit: float) -> None:
    """Geotransforms have centimetres per pixel and offsets of millions of metres; rays have small numbers."""
    on_map = np.array([[0.02, 0.0, 500_000.0], [0.0, -0.02, 5_800_000.0], [0.0, 0.0, 1.0]])
    scaled = np.diag([unit, unit, 1.0]) @ on_map
    np.testing.assert_allclose(geometry.apply(geometry.invert(scaled), geometry.apply(scaled, [[7.0, 9.0]])), [[7, 9]])
    flat = np.diag([unit, unit, 1.0]) @ np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]])
    with pytest.raises(GeometryError, match="singular"):
        geometry.invert(flat)


def test_corners_move_a_homography_and_all_points_with_them() -> None:
    moved_px = np.array([0.3, -0.2, 0.1, 0.4, -0.5, 0.2, 0.0, -0.1])
    change = geometry.moving_corners(moved_px, 1280, 960)
    corners = geometry.corners(1280, 960)
    for factor in (1, 10):
        large = geometry.moving_corners(factor * moved_px, 1280, 960)
        np.testing.assert_allclose((geometry.apply(large, corners) - corners).ravel(), factor * moved_px, atol=1e-4)
    points = geometry.lattice(1280, 960, 6, 5)
    there = points + geometry.over_corners(points, 1280, 960) @ moved_px
    np.testing.assert_allclose(geometry.apply(change, points), there, atol=1e-3)


def test_no_homography_is_fitted_to_degenerate_points() -> None:
    on_a_line = np.column_stack([np.arange(6.0), 2 * np.arange(6.0)])
    not_finite = np.where(np.eye(6, 2) > 0, np.nan, points[[0, 1, 2, 3, 0, 1]])
    for points_px in (on_a_line, not_finite, points[:3]):
        with pytest.raises(GeometryError):
            geometry.fit_homography(points_px, points_px)


# ---- lenses

MODEL = Lens(1453.0, 1453.0, 652.0, 489.0, (-0.109, 0.156, -0.0003, 0.0005, -0.05))
POINTS = np.random.default_rng(0).uniform((0, 0), (1279, 959), (200, 2))


def test_distort_is_opencvs_projection() -> None:
    rays = np.column_stack([(POINTS - (MODEL.cx_px, MODEL.cy_px)) / MODEL.fx_px, np.ones(len(POINTS))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MODEL.matrix, np.array(MODEL.distortion))
    assert_allclose(lens.distort(MODEL, POINTS), expected[:, 0], atol=1e-8)


def test_undistort_inverts_distort() -> None:
    assert_allclose(lens.distort(MODEL, lens.undistort(MODEL, POINTS)), POINTS, atol=1e-5)
