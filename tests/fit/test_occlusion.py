"""Occlusions, compared with the exact geometry."""

import cv2
import numpy as np
import pytest

from agalign.fit.relief import nearer_sign, occluded
from agalign.values.image import Mask
from agalign.values.parallax import Relief
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

HEIGHT, WIDTH = 60, 90
BOX = slice(20, 40), slice(30, 55)
NEAR_PX = 6


def layers(box: tuple[slice, slice] = BOX, near_px: float = NEAR_PX, far_px: float = 0.0) -> Relief:
    z = np.full((HEIGHT, WIDTH), far_px, np.float32)
    z[box] = near_px
    return Relief(z, np.ones_like(z))


def shadow(box: tuple[slice, slice], dx: int, dy: int) -> Mask:
    """The area of the box in a band, without the box itself."""
    result = np.zeros((HEIGHT + 40, WIDTH + 40), bool)
    rows, columns = box
    result[rows.start + 20 + dy : rows.stop + 20 + dy, columns.start + 20 + dx : columns.stop + 20 + dx] = True
    result = result[20:-20, 20:-20]
    result[box] = False
    return result


@pytest.mark.parametrize("baseline", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -0.5), (0.5, -1.0), (-0.5, 1 / 3)])
def test_a_nearer_box_occludes_the_ground_next_to_it(baseline: tuple[float, float]) -> None:
    dx, dy = (round(b * NEAR_PX) for b in baseline)
    np.testing.assert_array_equal(occluded(layers(), baseline), shadow(BOX, dx, dy))


def test_a_hole_is_occluded_by_its_edge() -> None:
    """The edge at which the ground occludes the hole."""
    hidden = occluded(layers(near_px=-NEAR_PX), (1.0, 0.0))
    rows, columns = BOX
    expected = np.zeros_like(hidden)
    # The bottom of the hole moves 6 px to the left, below the ground there.
    expected[rows, columns.start : columns.start + NEAR_PX] = True
    np.testing.assert_array_equal(hidden, expected)


def test_only_differences_of_parallax_matter() -> None:
    raised = layers(near_px=NEAR_PX + 4, far_px=4)
    np.testing.assert_array_equal(occluded(raised, (1.0, 0.0)), occluded(layers(), (1.0, 0.0)))


def test_low_relief_and_a_band_without_a_baseline_have_no_occlusions() -> None:
    assert not occluded(layers(), (0.0, 0.0)).any()
    slope = np.linspace(0, 20, WIDTH, dtype=np.float32)[None, :].repeat(HEIGHT, axis=0)
    for baseline in ((1.0, 0.0), (-0.7, 0.7)):
        assert not occluded(Relief(slope, np.ones_like(slope)), baseline).any()
        assert not occluded(layers(near_px=0.9), baseline).any()


BORDERS = (slice(0, 15), slice(0, 12)), (slice(45, HEIGHT), slice(80, WIDTH)), (slice(0, HEIGHT), slice(0, 8))


@pytest.mark.parametrize("box", BORDERS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_box_at_the_border_occludes_only_pixels_inside(box: tuple[slice, slice], sign: int) -> None:
    """Pixels displaced out of the image occlude nothing, neither each other nor pixels at the other side."""
    hidden = occluded(layers(box), (sign * 1.0, 0.0))
    expected = shadow(box, sign * NEAR_PX, 0)
    np.testing.assert_array_equal(hidden, expected)


def test_a_magnified_surface_has_no_gaps() -> None:
    """The displaced pixels of a steep slope are 1.5 px apart and occlude the ground below without gaps."""
    z = np.clip(np.arange(WIDTH, dtype=np.float32)[None, :].repeat(HEIGHT, axis=0) * 0.5 - 10, 0, 20)
    z[:, 60:] = 0
    hidden = occluded(Relief(z, np.ones_like(z)), (1.0, 0.0))
    # Its edge at x = 59 has z = 19.5 and is displaced to 78 or 79.
    inner = slice(2, -2)
    assert hidden[inner, 61:78].all()
    assert not hidden[:, 81:].any()
    assert not hidden[:, :60].any()


def test_a_reduced_relief() -> None:
    """A relief of half the size has its parallax in px of the image."""
    half = layers()
    full = Relief(half.parallax_px * 2, half.confidence, PixelScale(0.5, 0.5))
    np.testing.assert_array_equal(occluded(full, (1.0, 0.0)), shadow(BOX, NEAR_PX, 0))
    assert half.scale == SAME_PIXELS


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


def matched(sign: int, baselines: np.ndarray, shown: float = 0.9, behind: float = 0.2) -> Relief:
    """A relief with low correlation of occluded pixels; with sign -1 all parallax is reversed."""
    z = layers().parallax_px
    hidden = np.logical_or.reduce([occluded(layers(), (x, y)) for x, y in (sign * baselines).tolist()])
    rng = np.random.default_rng(0)
    confidence = np.where(hidden, behind, shown) + rng.normal(0, 0.05, z.shape)
    return Relief(z * np.float32(sign), confidence.astype(np.float32))


BASELINES = np.array([[1.0, 0.0], [0.0, 0.6]])


@pytest.mark.parametrize("sign", [1, -1])
def test_pixels_that_match_are_nearer(sign: int) -> None:
    assert nearer_sign(matched(sign, BASELINES), BASELINES) == sign


def test_the_sign_is_unknown_without_occlusions_or_if_occluded_pixels_match_too() -> None:
    assert nearer_sign(matched(1, BASELINES, behind=0.9), BASELINES) == 0
    assert nearer_sign(layers(near_px=0.0), BASELINES) == 0
    small = Relief(layers((slice(20, 22), slice(30, 32))).parallax_px, matched(1, BASELINES).confidence)
    assert nearer_sign(small, BASELINES / 6) == 0
