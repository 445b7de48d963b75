"""Dense matching of shifted layers with exact truth, and its semi-global aggregation by definition."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from agalign.fit import dense
from agalign.fit.dense import MAX_LARGE, DenseMatching, View, aggregated, sub_label_minimum
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Relief

from ..builders import whole
from ..conftest import textured_image

WIDTH, HEIGHT = 320, 240
BOX = slice(80, 180), slice(110, 220)
BAR = slice(40, 200), slice(150, 162)
"""12 px wide; the window of the wide search has 28 px."""
BASELINES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


def scene_of(
    baselines: Sequence[tuple[float, float]], area: tuple[slice, slice] = BOX, near_px: int = 12
) -> tuple[list[View], DenseMatching]:
    """Views of a textured area in front of a textured background, displaced by its parallax, and their matching."""

    def layers(shift: tuple[float, float]) -> Raster:
        ground, front = (np.asarray(textured_image(WIDTH, HEIGHT, seed), np.float32) for seed in (1, 2))
        dx, dy = (round(s * near_px) for s in shift)
        rows, columns = area
        ground[rows.start + dy : rows.stop + dy, columns.start + dx : columns.stop + dx] = front[area]
        return whole(ground)

    seen = [View(layers(b), PixelMapping(np.eye(3)), b) for b in baselines]
    return seen, DenseMatching(layers((0, 0)), seen, (0.0, float(near_px)))


def check(relief: Relief, area: tuple[slice, slice] = BOX, near_px: int = 12) -> None:
    """Inside and outside the area, except for its edges."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[area] = 1
    z = cv2.resize(relief.parallax_px, (WIDTH, HEIGHT))
    kernel = np.ones((25, 25), np.uint8)
    inside = cv2.erode(mask, np.ones((5, 5), np.uint8)) > 0
    outside = cv2.dilate(mask, kernel) == 0
    assert np.median(np.abs(z[inside] - near_px)) < 0.2
    assert np.median(np.abs(z[outside])) < 0.1
    assert np.mean(np.abs(z[inside] - near_px) < 1) > 0.85
    assert np.mean(np.abs(z[outside]) < 1) > 0.95


@pytest.mark.parametrize("is_sign_known", [True, False])
def test_a_near_surface_is_found_with_either_sign_of_the_baselines(is_sign_known: bool) -> None:
    """Without tags the sign is arbitrary; far behind the ground there is nothing."""
    near_px = 18  # 5.6 % of the width
    seen, matching = scene_of(BASELINES, near_px=near_px)
    opposite = [replace(view, baseline=(-view.baseline[0], -view.baseline[1])) for view in seen]
    again = DenseMatching(matching.reference, opposite, (-1.0, 1.0), is_sign_known=is_sign_known)
    assert bool(again.levels_px[0] <= -near_px) is (not is_sign_known)
    assert again.levels_px[-1] < near_px


def test_a_box_in_front_of_the_ground() -> None:
    seen, matching = scene_of(BASELINES)
    check(matching.matched(range(4)))
    for relief in matching.refined(seen, [range(4), [0, 1], [2, 3]]):
        assert relief.parallax_px.shape == (HEIGHT, WIDTH)
        check(relief)
        assert relief.confidence[BOX].mean() > 0.8


def test_a_thin_object_that_the_wide_search_smooths_away() -> None:
    seen, matching = scene_of(BASELINES, BAR, 20)
    (relief,) = matching.refined(seen, [range(4)])
    check(relief, BAR, 20)


def test_windows_outside_a_moving_image_do_not_match() -> None:
    """At the right border, two of three bands do not show the ground: only the other one determines it."""
    plane = PixelMapping(np.array([[1.0, 0, 40], [0, 1, 0], [0, 0, 1]]))
    ground = np.asarray(textured_image(WIDTH + 40, HEIGHT, 3), np.float32)
    seen = [View(whole(ground[:, 40:]), PixelMapping(np.eye(3)), (0.0, 1.0))]
    seen += [View(whole(ground[:, :-40]), plane, b) for b in ((1.0, 0.0), (-1.0, 0.0))]
    matching = DenseMatching(whole(ground[:, 40:]), seen, (-8.0, 8.0))
    (relief,) = matching.refined(seen, [range(3)])
    assert np.abs(relief.parallax_px).max() < 1.0


def test_saturated_spots_of_a_band_take_no_part() -> None:
    """The other bands determine the parallax there, with their confidence."""
    seen, without_spot = scene_of(BASELINES)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[100:140, 130:190] = False
    for k in (0, 1):
        seen[k] = replace(seen[k], image=Raster(np.where(valid, seen[k].image.pixels, 0), valid))
    matching = DenseMatching(without_spot.reference, seen, (0.0, 12.0))
    check(matching.matched(range(4)))
    (relief, by_spotted) = matching.refined(seen, [range(4), [0, 1]])
    check(relief)
    assert relief.confidence[105:135, 140:180].mean() > 0.8
    assert by_spotted.confidence[110:130, 150:170].max() == 0


def test_thirty_bands_do_not_overflow() -> None:
    _, matching = scene_of([BASELINES[k % 4] for k in range(30)])
    check(matching.matched(range(30)))
    of_28, of_4 = (matching.matched(range(count)).parallax_px for count in (28, 4))
    np.testing.assert_allclose(of_28, of_4, atol=0.05)


def test_a_relief_depends_only_on_the_selected_bands() -> None:
    seen, matching = scene_of(BASELINES)
    noise = whole(np.random.default_rng(0).uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32))
    (alone,) = matching.refined(seen, [[0, 1]])
    _, other = matching.refined([*seen[:2], *(replace(v, image=noise) for v in seen[2:])], [range(4), [0, 1]])
    np.testing.assert_array_equal(other.parallax_px, alone.parallax_px)
    np.testing.assert_array_equal(other.confidence, alone.confidence)


@pytest.mark.parametrize("strip_px", [7, 1000])
def test_strips_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch, strip_px: int) -> None:
    seen, matching = scene_of(BASELINES[:2])
    (expected,) = matching.refined(seen, [range(2)])
    monkeypatch.setattr(dense, "_STRIP_PX", strip_px)
    (relief,) = DenseMatching(matching.reference, seen, (0.0, 12.0)).refined(seen, [range(2)])
    np.testing.assert_allclose(relief.parallax_px, expected.parallax_px, atol=1e-3)


# ---- semi-global matching


def by_definition(costs: np.ndarray, small: int, large: int) -> np.ndarray:
    labels, height, width = costs.shape
    total = np.zeros(costs.shape, int)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros(costs.shape, int)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                for d in range(labels):
                    path[d, y, x] = costs[d, y, x]
                    if 0 <= x - dx < width and 0 <= y - dy < height:
                        before = path[:, y - dy, x - dx]
                        steps = [before[k] + (0, small, large)[min(abs(k - d), 2)] for k in range(labels)]
                        path[d, y, x] += min(steps) - before.min()
        total += path
    return total


@pytest.mark.parametrize(
    ("labels", "small", "large"), [(5, 6, 40), (7, 3, 15), (3, 10, 10), (1, 2, 5), (6, 9, MAX_LARGE)]
)
def test_four_paths(labels: int, small: int, large: int) -> None:
    """With the highest costs that do not overflow."""
    some = np.array([0, 13, 60, 61, 255 - small - large], np.uint8)
    costs = np.random.default_rng(labels).choice(some, (labels, 6, 8))
    given = costs.copy()
    np.testing.assert_array_equal(aggregated(costs, small, large), by_definition(costs, small, large))
    np.testing.assert_array_equal(costs, given)


@pytest.mark.parametrize(
    ("costs", "label"),
    [
        ([1, 5, 9, 20], 0),
        ([20, 9, 5, 1], 3),
        ([4, 4, 4, 4], 0),  # no minimum at all
        ([9, 5, 5, 9], 1.5),  # halfway
        ([9, 2, 4, 2], 1 + 0.5 * 5 / 9),  # the first of two: (9 - 4) / (2 * (9 - 4 + 4))
    ],
)
def test_at_the_borders_there_is_no_parabola(costs: list[float], label: float) -> None:
    volume = np.array(costs, np.float32)[:, None, None]
    assert sub_label_minimum(volume)[0, 0] == pytest.approx(label, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_every_pixel_has_its_own_minimum(dtype: type) -> None:
    at = np.random.default_rng(0).uniform(0.6, 4.4, (5, 6))
    costs = np.round(1000 * (np.arange(6)[:, None, None] - at) ** 2 + 50).astype(dtype)
    np.testing.assert_allclose(sub_label_minimum(costs), at, atol=1e-3)
