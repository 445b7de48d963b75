"""Occlusions, compared with the exact geometry."""

import cv2
import numpy as np
import pytest

from agalign.fit.relief import nearer_sign, occluded
from agalign.values.image import Mask
from agalign.values.parallax import Relief
from agalign.values.pixel_units import PixelScale

HEIGHT, WIDTH = 60, 90
BOX = slice(20, 40), slice(30, 55)
NEAR_PX = 6


def layers(box: tuple[slice, slice] = BOX, near_px: float = NEAR_PX) -> Relief:
    z = np.zeros((HEIGHT, WIDTH), np.float32)
    z[box] = near_px
    return Relief(z, np.ones_like(z))


def shadow(dx: int, dy: int) -> Mask:
    """The area of the box in a band, without the box itself."""
    result = np.zeros((HEIGHT, WIDTH), bool)
    rows, columns = BOX
    result[rows.start + dy : rows.stop + dy, columns.start + dx : columns.stop + dx] = True
    result[BOX] = False
    return result


@pytest.mark.parametrize("baseline", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -0.5), (0.5, -1.0), (-0.5, 1 / 3)])
def test_a_nearer_box_occludes_the_ground_next_to_it(baseline: tuple[float, float]) -> None:
    dx, dy = (round(b * NEAR_PX) for b in baseline)
    np.testing.assert_array_equal(occluded(layers(), baseline), shadow(dx, dy))


def test_low_relief_and_a_band_without_a_baseline_have_no_occlusions() -> None:
    assert not occluded(layers(), (0.0, 0.0)).any()
    slope = np.linspace(0, 20, WIDTH, dtype=np.float32)[None, :].repeat(HEIGHT, axis=0)
    for baseline in ((1.0, 0.0), (-0.7, 0.7)):
        assert not occluded(Relief(slope, np.ones_like(slope)), baseline).any()
        assert not occluded(layers(near_px=0.9), baseline).any()


def test_a_reduced_relief() -> None:
    """A relief of half the size has its parallax in px of the image."""
    half = layers()
    full = Relief(half.parallax_px * 2, half.confidence, PixelScale(0.5, 0.5))
    np.testing.assert_array_equal(occluded(full, (1.0, 0.0)), shadow(NEAR_PX, 0))


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


@pytest.mark.parametrize("baseline", [(0.83, -0.57), (-0.41, 0.29), (0.0, 1.0)])
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


def test_the_sign_is_unknown_without_occlusions_or_if_occluded_pixels_match_too() -> None:
    assert nearer_sign(matched(1, behind=0.9), BASELINES) == 0
    assert nearer_sign(layers(near_px=0.0), BASELINES) == 0
    small = Relief(layers((slice(20, 22), slice(30, 32))).parallax_px, matched(1).confidence)
    assert nearer_sign(small, BASELINES / 6) == 0
