"""Dense matching of shifted layers with exact truth."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from agalign.fit import dense
from agalign.fit.dense import DenseMatching, View
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


def layers(area: tuple[slice, slice], near_px: int, shift: tuple[float, float]) -> Raster:
    """A textured area in front of a textured background, displaced by its parallax."""
    ground, front = (np.asarray(textured_image(WIDTH, HEIGHT, seed), np.float32) for seed in (1, 2))
    dx, dy = (round(s * near_px) for s in shift)
    rows, columns = area
    ground[rows.start + dy : rows.stop + dy, columns.start + dx : columns.stop + dx] = front[area]
    return whole(ground)


def views(area: tuple[slice, slice], near_px: int, baselines: Sequence[tuple[float, float]]) -> list[View]:
    return [View(layers(area, near_px, b), PixelMapping(np.eye(3)), b) for b in baselines]


def of_views(seen: Sequence[View], area: tuple[slice, slice], near_px: int) -> DenseMatching:
    return DenseMatching(layers(area, near_px, (0, 0)), seen, (0.0, float(near_px)))


def check(relief: Relief, area: tuple[slice, slice], near_px: int) -> None:
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


def test_a_box_in_front_of_the_ground() -> None:
    seen = views(BOX, 12, BASELINES)
    matching = of_views(seen, BOX, 12)
    check(matching.matched(range(4)), BOX, 12)
    for relief in matching.refined(seen, [range(4), [0, 1], [2, 3]]):
        assert relief.parallax_px.shape == (HEIGHT, WIDTH)
        check(relief, BOX, 12)
        assert relief.confidence[BOX].mean() > 0.8


def test_a_thin_object_that_the_wide_search_smooths_away() -> None:
    seen = views(BAR, 20, BASELINES)
    (relief,) = of_views(seen, BAR, 20).refined(seen, [range(4)])
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
    seen = views(BOX, 12, BASELINES)
    spot = slice(100, 140), slice(130, 190)
    for k in (0, 1):
        image = seen[k].image
        valid = np.ones((HEIGHT, WIDTH), bool)
        valid[spot] = False
        seen[k] = View(Raster(np.where(valid, image.pixels, 0), valid), seen[k].plane, seen[k].baseline)
    matching = of_views(seen, BOX, 12)
    check(matching.matched(range(4)), BOX, 12)
    (relief, by_spotted) = matching.refined(seen, [range(4), [0, 1]])
    check(relief, BOX, 12)
    assert relief.confidence[105:135, 140:180].mean() > 0.8
    assert by_spotted.confidence[110:130, 150:170].max() == 0


def test_thirty_bands_do_not_overflow() -> None:
    seen = views(BOX, 12, [BASELINES[k % 4] for k in range(30)])
    matching = of_views(seen, BOX, 12)
    check(matching.matched(range(30)), BOX, 12)
    np.testing.assert_allclose(
        matching.matched(range(28)).parallax_px, matching.matched(range(4)).parallax_px, atol=0.05
    )


def test_a_relief_depends_only_on_the_selected_bands() -> None:
    seen = views(BOX, 12, BASELINES)
    matching = of_views(seen, BOX, 12)
    noise = whole(np.random.default_rng(0).uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32))
    (alone,) = matching.refined(seen, [[0, 1]])
    _, other = matching.refined([*seen[:2], *(View(noise, v.plane, v.baseline) for v in seen[2:])], [range(4), [0, 1]])
    np.testing.assert_array_equal(other.parallax_px, alone.parallax_px)
    np.testing.assert_array_equal(other.confidence, alone.confidence)


@pytest.mark.parametrize("strip_px", [7, 1000])
def test_strips_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch, strip_px: int) -> None:
    seen = views(BOX, 12, BASELINES[:2])
    (expected,) = of_views(seen, BOX, 12).refined(seen, [range(2)])
    monkeypatch.setattr(dense, "_STRIP_PX", strip_px)
    (relief,) = of_views(seen, BOX, 12).refined(seen, [range(2)])
    np.testing.assert_allclose(relief.parallax_px, expected.parallax_px, atol=1e-3)
