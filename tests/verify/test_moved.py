"""Areas that moved are found where they are, and only there."""

import tracemalloc
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from agalign.pixels.structure import structure_field
from agalign.values.image import Mask, Raster
from agalign.values.moved_area import MovedArea, moved_px
from agalign.values.pixel_units import PixelScale
from agalign.verify.moved import _are_near, _groups, _refined, _Windows, moved_areas

from ..builders import texture, whole

SIZE = 640, 480
OBJECT = texture(300, 300, seed=7).pixels
GROUND = texture(*SIZE).pixels


def areas_of(fixed: np.ndarray, moving: np.ndarray, valid: Mask | None = None) -> tuple[MovedArea, ...]:
    mask = np.ones(fixed.shape, bool) if valid is None else valid
    fields = (structure_field(Raster(np.asarray(image, np.float32), mask)) for image in (fixed, moving))
    return moved_areas(*fields, mask)


def flagged(areas: tuple[MovedArea, ...]) -> Mask:
    return moved_px(areas, np.arange(SIZE[0]), np.arange(SIZE[1])[:, None]) > 0


def placed(image: np.ndarray, patch: np.ndarray, x: int, y: int) -> tuple[np.ndarray, Mask]:
    """An image with a patch at (x, y), and the mask of its pixels."""
    result, mask = image.copy(), np.zeros(image.shape, bool)
    at = np.s_[y : y + len(patch), x : x + patch.shape[1]]
    result[at], mask[at] = patch, True
    return result, mask


@pytest.mark.parametrize("shift_px", [(2, 0), (-3, 3), (9, -4), (-20, 30)])
@pytest.mark.parametrize("size_px", [40, 60, 140])
def test_an_object_is_found_where_either_image_shows_it(size_px: int, shift_px: tuple[int, int]) -> None:
    patch = OBJECT[:size_px, :size_px]
    fixed, in_fixed = placed(GROUND, patch, 205, 173)
    moving, in_moving = placed(1.5 - GROUND, 1.2 - 0.7 * patch, 205 + shift_px[0], 173 + shift_px[1])
    areas = areas_of(fixed, moving)
    assert areas
    for area in areas:
        np.testing.assert_allclose(area.shift_px, shift_px, atol=0.3)
    found, truth = flagged(areas), in_fixed | in_moving
    assert found[truth].mean() > 0.8
    near_px = 16  # of an object, half a box of agreement
    assert not found[cv2.dilate(truth.astype(np.uint8), np.ones((2 * near_px + 1,) * 2)) == 0].any()


def test_what_is_inside_of_the_edges_of_a_smooth_object_belongs_to_it() -> None:
    body = np.full((140, 200), 0.9, np.float32)
    cv2.circle(body, (60, 70), 34, 0.2, -1)
    cv2.rectangle(body, (120, 20), (180, 90), 0.4, -1)
    fixed, in_fixed = placed(GROUND, body, 205, 173)
    moving, in_moving = placed(GROUND, body, 214, 177)
    assert flagged(areas_of(fixed, moving))[in_fixed | in_moving].mean() > 0.75


@pytest.mark.parametrize("moving", [GROUND, 1 - GROUND, GROUND**3], ids=["equal", "reversed", "other contrast"])
def test_images_that_agree_have_no_areas(moving: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    assert areas_of(GROUND, moving + rng.normal(0, 0.02, moving.shape)) == ()


def test_a_part_without_common_content_did_not_move() -> None:
    fixed, _ = placed(GROUND, OBJECT[:140, :140], 205, 173)
    moving, _ = placed(GROUND, OBJECT[150:290, 150:290], 205, 173)
    assert areas_of(fixed, moving) == ()


def test_content_that_both_images_show_in_its_place_did_not_move() -> None:
    """A part of the reference equals the ground elsewhere, as one plant equals the next."""
    beside = GROUND[203:243, 265:305]
    fixed, _ = placed(GROUND, beside, 205, 173)
    moving, _ = placed(GROUND, OBJECT[:40, :40], 205, 173)
    assert areas_of(fixed, moving) == ()
    assert areas_of(fixed, placed(moving, OBJECT[:40, :40], 265, 203)[0]) == ()
    lost, _ = placed(fixed, OBJECT[:40, :40], 265, 203)
    assert areas_of(lost, moving)  # but if the reference shows something else there, it moved


def test_stripes_that_fit_at_several_shifts_did_not_move() -> None:
    x, y = np.meshgrid(np.arange(140), np.arange(140))
    stripes = (0.5 + 0.4 * np.sign(np.sin(x / 3.0))).astype(np.float32)
    spots = (0.5 + 0.4 * np.sign(np.sin(x / 3.0) * np.sin(y / 3.0))).astype(np.float32)
    for pattern in (stripes, spots):
        fixed, _ = placed(GROUND, pattern, 205, 173)
        moving, _ = placed(GROUND, pattern, 205 + 6, 173)
        assert areas_of(fixed, moving) == ()


def test_saturated_pixels_and_images_that_agree_nowhere_have_no_areas() -> None:
    patch = OBJECT[:140, :140]
    fixed, in_fixed = placed(GROUND, patch, 205, 173)
    moving, in_moving = placed(GROUND, patch, 214, 177)
    assert areas_of(fixed, moving)
    assert areas_of(fixed, moving, ~(in_fixed | in_moving)) == ()
    other = texture(*SIZE, seed=3).pixels
    assert areas_of(fixed, placed(other, patch, 214, 177)[0]) == ()
    assert areas_of(np.zeros_like(GROUND), GROUND) == ()
    tiny = whole(GROUND[:20, :25])
    assert moved_areas(structure_field(tiny), structure_field(tiny), tiny.valid) == ()


def test_the_shift_of_an_object_is_searched_up_to_80_px() -> None:
    """That of a landing leg half a metre from the lenses."""
    fixed, _ = placed(GROUND, OBJECT[:100, :100], 205, 173)
    (area, *_) = areas_of(fixed, placed(GROUND, OBJECT[:100, :100], 133, 223)[0])
    np.testing.assert_allclose(area.shift_px, (-72, 50), atol=0.3)


@pytest.mark.parametrize("start_px", [0, 3, 7])
def test_the_shift_is_refined_from_the_median_of_windows_far_from_it(start_px: int) -> None:
    def agreement(shift_px: tuple[int, int], area: object) -> np.ndarray:
        return np.full((4, 4), np.exp(-(np.hypot(shift_px[0] - 6.3, shift_px[1]) ** 2) / 50))

    windows = _Windows(np.zeros((1, 2), np.int64), np.array([[start_px, 0]]))
    shift_px, _ = _refined(SimpleNamespace(under=agreement), windows, np.s_[:, :], np.ones((4, 4), bool))
    np.testing.assert_allclose(shift_px, (6.3, 0.0), atol=0.02)


def test_the_memory_of_many_windows_is_not_that_of_all_pairs() -> None:
    rng = np.random.default_rng(0)
    origins_px = 16 * np.stack(np.divmod(np.arange(5000), 100), axis=1)
    shifts_px = 2 * rng.integers(-20, 20, (5000, 2))
    shifts_px[1000:1010] = 8, 4
    tracemalloc.start()
    groups = list(_groups(_Windows(origins_px, shifts_px)))
    assert _are_near(origins_px, origins_px[::3], 16).all()
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert any({*range(1000, 1010)} <= {*(g.origins_px @ [100, 1] // 16).tolist()} for g in groups)
    assert peak_bytes < 20e6


def test_an_area_of_a_large_mosaic_has_a_mask_of_limited_size() -> None:
    corner_px = 1e9
    area = MovedArea(np.array([[0.0, 0.0], [corner_px, 0.0], [0.0, corner_px]]), (9.0, 0.0))
    assert area.contains([0.3 * corner_px, 0.7 * corner_px], 0.5 * corner_px).tolist() == [True, False]
    with pytest.raises(ValueError, match="no corners"):
        MovedArea(np.zeros((0, 2)), (9.0, 0.0))


def test_an_area_contains_the_pixels_on_its_outline_and_keeps_them_in_a_resized_reference() -> None:
    area = MovedArea(np.array([[10.0, 10.0], [49.0, 10.0], [49.0, 29.0], [10.0, 29.0]]), (3.0, 4.0))
    inside = area.contains(np.arange(60), np.arange(40)[:, None])
    assert inside.sum() == 40 * 20
    assert inside[29, 49]
    assert not inside[30, 49]
    assert area.length_px == 5.0
    double = area.rescaled(PixelScale(2.0, 2.0))
    assert double.shift_px == (6.0, 8.0)
    assert np.array_equal(double.contains(2 * np.arange(60) + 0.5, 2 * np.arange(40)[:, None] + 0.5), inside)
