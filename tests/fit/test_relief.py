"""What follows from a relief: occlusions by their definition, its sign, and the range by the exact geometry."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agalign.fit.dense import nearer_sign
from agalign.rasters.alignment_maps import inverse_range
from agalign.values import lens
from agalign.values.image import Mask
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale

HEIGHT, WIDTH = 60, 90


def layers(rows: slice = slice(20, 40), columns: slice = slice(30, 55), near_px: float = 6.0) -> Relief:
    z = np.zeros((HEIGHT, WIDTH), np.float32)
    z[rows, columns] = near_px
    return Relief(z, np.ones_like(z))


def occluded(relief: Relief, baseline: tuple[float, float]) -> Mask:
    return np.asarray(Parallax(relief, baseline).with_occlusions().hidden)


def test_low_relief_and_a_band_without_a_baseline_have_no_occlusions() -> None:
    assert not occluded(layers(), (0.0, 0.0)).any()
    slope = np.linspace(0, 20, WIDTH, dtype=np.float32)[None, :].repeat(HEIGHT, axis=0)
    for baseline in ((1.0, 0.0), (-0.7, 0.7)):
        assert not occluded(Relief(slope, np.ones_like(slope)), baseline).any()
        assert not occluded(layers(near_px=0.9), baseline).any()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_occlusions_of_a_relief_of_another_image_size_are_the_same(factor: float) -> None:
    parallax = Parallax(layers(), (1.0, 0.3))
    known, again = parallax.with_occlusions(), parallax.rescaled(PixelScale(factor, factor)).with_occlusions()
    assert known.hidden.any()
    np.testing.assert_array_equal(again.hidden, known.hidden)


def by_definition(relief: Relief, baseline: tuple[float, float], min_step_px: float) -> Mask:
    """The z-buffer, pixel by pixel, before the closing and the removal of small areas."""
    z = relief.parallax_px.astype(float)
    at = {(y, x): (round(y + baseline[1] * v), round(x + baseline[0] * v)) for (y, x), v in np.ndenumerate(z)}
    nearest: dict[tuple[int, int], float] = {}
    for pixel, cell in at.items():
        nearest[cell] = max(nearest.get(cell, -np.inf), z[pixel])
    hidden = [
        0 <= cell[0] < HEIGHT and 0 <= cell[1] < WIDTH and nearest[cell] > z[pixel] + min_step_px
        for pixel, cell in at.items()
    ]
    return np.array(hidden).reshape(z.shape)


@pytest.mark.parametrize("baseline", [(0.83, -0.57), (-0.41, 0.29), (0.0, 1.0), (-1.0, 0.0)])
def test_the_z_buffer_of_a_rough_relief(baseline: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    z = cv2.resize(rng.uniform(-12, 9, (6, 9)).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    z += rng.normal(0, 0.3, z.shape).astype(np.float32)
    relief = Relief(z, np.ones_like(z))
    hidden = by_definition(relief, baseline, 1.5 / np.hypot(*baseline))
    closed = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    expected = (labels > 0) & (statistics[labels, cv2.CC_STAT_AREA] >= 16)
    assert expected.mean() > 0.05
    np.testing.assert_array_equal(occluded(relief, baseline), expected)
    # A relief of half the size has its parallax in px of the image.
    half = Relief(2 * z, relief.confidence, PixelScale(0.5, 0.5))
    np.testing.assert_array_equal(occluded(half, baseline), expected)


BASELINES = np.array([[1.0, 0.0], [0.0, 0.6]])


def matched(sign: int, behind: float = 0.2) -> Relief:
    """A relief with low correlation of occluded pixels; with sign -1 all parallax is reversed."""
    z = layers().parallax_px
    hidden = np.logical_or.reduce([occluded(layers(), (x, y)) for x, y in (sign * BASELINES).tolist()])
    confidence = np.where(hidden, behind, 0.9) + np.random.default_rng(0).normal(0, 0.05, z.shape)
    return Relief(z * np.float32(sign), confidence.astype(np.float32))


@pytest.mark.parametrize("sign", [1, -1])
def test_pixels_that_match_are_nearer(sign: int) -> None:
    assert nearer_sign(matched(sign), BASELINES) == sign


def test_the_sign_is_kept_without_evidence() -> None:
    assert nearer_sign(layers(near_px=0.0), BASELINES) == 1
    small = Relief(layers(slice(20, 22), slice(30, 32)).parallax_px, matched(-1).confidence)
    assert nearer_sign(small, BASELINES / 6) == 1
    assert nearer_sign(matched(-1, behind=0.88), BASELINES) == 1


# ---- range of two planes from a rig with known positions and orientations of the lenses

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
