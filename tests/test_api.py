import math
import re
import warnings
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import agalign
from agalign.method import joint
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.mapping import PixelMapping
from agalign.verify.coverage import pixels_in_frame

from .builders import in_full_run
from .conftest import mean_error_px, textured_image, textured_pair

pytestmark = pytest.mark.slow

TRUTH = np.array([[1.004, 0.006, 9.0], [-0.005, 0.998, -7.0], [4e-6, -6e-6, 1.0]])


def as_uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(image * 35 + 128, 1, 254).astype(np.uint8)


def assert_aligned(result: agalign.Alignment, max_error_px: float = 0.15) -> None:
    assert (result.status, result.reason) == ("aligned", None)
    assert mean_error_px(result.fixed_to_moving, TRUTH, 400, 320) < max_error_px


def test_two_arrays_without_any_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes one thread, and gives the others back."""
    real, before, seen = joint.learn, torch.get_num_threads(), []

    def learn(*arguments: object, **options: object) -> object:
        seen.append(torch.get_num_threads())
        return real(*arguments, **options)

    monkeypatch.setattr(joint, "learn", learn)
    torch.set_num_threads(2)
    fixed, moving = map(as_uint8, textured_pair(TRUTH))
    result = agalign.align(fixed, moving[:300])
    assert (seen, torch.get_num_threads()) == ([1], 2)
    torch.set_num_threads(before)
    assert_aligned(result, 0.1)
    assert result.after.mattes_mi < result.before.mattes_mi
    assert result.residual.median_px < 0.2
    result.warp(moving[:300])
    with pytest.raises(agalign.InputError, match=r"400 x 320 px, .* 400 x 300 px"):
        result.warp(moving)


@pytest.mark.parametrize("is_seeded", [True, False])
def test_the_fixed_image_is_reduced_for_much_larger_pixels(is_seeded: bool) -> None:
    """As in folders: its noise and detail are not in the other. Results are in px of the whole arrays."""
    coarse_px, shift = (80, 60), geometry.translation(9.0, -7.0)
    fixed, moving = textured_pair(shift, 640, 480)
    coarse = cv2.resize(moving, coarse_px, interpolation=cv2.INTER_AREA)
    coarse += 0.5 * coarse.std() * np.random.default_rng(0).normal(size=coarse.shape).astype(np.float32)
    overlay = geometry.overlay((640, 480), coarse_px)
    result = agalign.align(fixed, coarse, **({"seed": overlay, "seed_std_px": 15.0} if is_seeded else {}))
    assert (result.status, result.size_px, result.moving_size_px) == ("aligned", (640, 480), coarse_px)
    assert mean_error_px(result.fixed_to_moving, geometry.compose(overlay, shift), 640, 480) < 0.1
    assert result.std_band_px == pytest.approx(result.std_px / 8, rel=0.01)


def test_a_small_image_that_shows_a_part_is_not_one_of_larger_pixels() -> None:
    """The reference is not reduced for it: the error is that of its pixels."""
    fixed, moving = textured_pair(geometry.translation(-150.0, -90.0), 640, 480)
    result = agalign.align(fixed, moving[:180, :240])
    assert result.status == "aligned"
    assert result.std_px < 0.1


def test_channels_are_first_or_last() -> None:
    rgb = np.dstack([as_uint8(textured_image(80, 60, seed)) for seed in range(3)])
    channels_last, channels_first = raster_of(rgb, None, "rgb"), raster_of(np.moveaxis(rgb, -1, 0), None, "rgb")
    np.testing.assert_array_equal(channels_last.pixels, channels_first.pixels)


def test_aligned_input_is_returned_unchanged() -> None:
    """A displacement field that only fits noise would resample it; a small distortion is corrected."""
    fixed = textured_image(400, 320, 1)
    noisy = fixed.max() - fixed + np.random.default_rng(1).normal(0, 0.02 * np.ptp(fixed), fixed.shape)
    result = agalign.align(fixed, noisy)
    assert (result.status, result.geometry) == ("aligned", "homography")
    np.testing.assert_array_equal(result.fixed_to_moving, np.eye(3))
    y, x = np.indices(fixed.shape, np.float32)
    bent = cv2.remap(np.float32(fixed), x + 0.15 * np.sin(x / 60), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    assert agalign.align(fixed, bent).geometry == "field"


HOPELESS: dict[str, Callable[[], np.ndarray]] = {
    "unrelated": lambda: textured_image(400, 320, 77),
    "constant": lambda: np.full((320, 400), 9, np.uint16),
    "noise": lambda: np.random.default_rng(123).normal(size=(320, 400)),
    "nan": lambda: np.full((320, 400), np.nan),
    "zeros": lambda: np.zeros((320, 400), np.uint8),
    "ten per cent of overlap": lambda: textured_image(760, 320)[:, 360:],
}


SLOW = "unrelated", "noise", "ten per cent of overlap"


@pytest.mark.parametrize("name", [in_full_run(name) if name in SLOW else name for name in HOPELESS])
def test_unaligned_pairs_have_a_reason(name: str) -> None:
    fixed = textured_image(760, 320)[:, :400]
    result = agalign.align(fixed, HOPELESS[name]())
    assert result.status in ("failed", "seed_only")
    assert result.reason


def test_the_reason_is_not_a_lack_of_contrast_where_invalid_pixels_leave_no_patch() -> None:
    """The image has contrast, but each patch contains an invalid pixel."""
    fixed, moving = textured_pair(TRUTH)
    fixed[np.random.default_rng(0).random(fixed.shape) < 0.1] = np.nan
    result = agalign.align(fixed, moving)
    assert result.issues[0].code == "no_contrast"
    assert (result.reason or "").startswith("no valid patch of the reference has enough contrast")


def test_wrong_arguments_are_named() -> None:
    image = textured_image(100, 80)
    good: dict[str, np.ndarray] = {"fixed": image, "moving": image}
    for name, wrong in (("fixed", (5,)), ("moving", (10, 10)), ("moving_valid", (3, 3))):
        with pytest.raises(agalign.InputError, match=name):
            agalign.align(**good | {name: np.ones(wrong)})
    with pytest.raises(agalign.GeometryError):
        agalign.align(image, image, seed=np.zeros((3, 3)))


@pytest.mark.parametrize(("side", "channels"), [("fixed", (1,)), ("moving", (1, 1, 1))], ids=["grey and alpha", "RGBA"])
def test_alpha_is_a_mask_and_not_a_saturated_band(side: str, channels: tuple[int, ...]) -> None:
    images = dict(zip(("fixed", "moving"), map(as_uint8, textured_pair(TRUTH)), strict=True))
    alpha = np.full_like(images[side], 255)
    alpha[:40] = 0
    images[side] = np.dstack([images[side] * k for k in channels] + [alpha])
    images[side][:40, :, :-1] = 77
    assert_aligned(agalign.align(**images, seed=TRUTH))


def test_warp_onto() -> None:
    fixed, moving = textured_pair(TRUTH)
    pixels, valid = agalign.warp_onto(moving, TRUTH, (400, 320))
    assert pixels.shape == valid.shape == (320, 400)
    assert np.corrcoef(pixels[valid], fixed[valid])[0, 1] < -0.9


def test_warp_onto_refuses_an_alignment() -> None:
    """Its homography alone would be a part of the mapping."""
    seed = agalign.Seed("user", np.eye(3), 0.0)
    alignment = agalign.Alignment(PixelMapping(np.eye(3)), (50, 50), (), seed)
    with pytest.raises(agalign.InputError, match=r"its method warp\(moving\)"):
        agalign.warp_onto(np.zeros((50, 50)), alignment, (50, 50))


@pytest.mark.parametrize("seed", [None, geometry.translation(14, -12)])
def test_undeclared_fill_and_a_border_of_zeros_cost_a_good_pair_nothing(seed: np.ndarray | None) -> None:
    fixed, moving = textured_pair(TRUTH)
    if seed is None:
        moving[60:140, 200:300] = -9999
    else:
        fixed, moving = as_uint8(fixed), as_uint8(moving)
        moving[:, :60] = 0
    assert_aligned(agalign.align(fixed, moving, seed=seed))


IMAGE = textured_image(64, 64, 1)
RAGGED = [[1, 2], [3]]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"seed": np.eye(3), "seed_std_px": -1}, "seed_std_px is -1, not a positive number"),
        ({"seed": np.eye(3), "seed_std_px": math.nan}, "seed_std_px is nan, not a positive number"),
        ({"seed_std_px": 3.0}, "give the seed too"),
        ({"seed": np.eye(3) + 0j}, "seed has complex numbers; a homography has real ones"),
        ({"seed": [[1, 0, 20j], [0, 1, 0], [0, 0, 1]]}, "seed has complex numbers"),
        ({"fixed": RAGGED}, "fixed is not an array: its rows have different lengths"),
        ({"fixed_valid": RAGGED}, "fixed_valid is not an array"),
        ({"fixed": IMAGE.astype(np.float64) * 1e300}, "fixed has only values beyond 1e"),
        ({"fixed": IMAGE[..., None][..., :0]}, "fixed is (64, 64, 0): images have 1 to 16 channels"),
        ({"moving": np.zeros((48, 32_767), np.uint8)}, "moving is (48, 32767): images have at most 32766 px a side"),
        ({"moving": IMAGE[None][:0]}, "moving is (0, 64, 64): images have 1 to 16 channels"),
    ],
)
def test_arguments_that_cannot_be_aligned_are_named(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(agalign.InputError, match=re.escape(said)):
        agalign.align(**{"fixed": IMAGE, "moving": IMAGE} | arguments)


def test_a_complex_homography_is_refused() -> None:
    with pytest.raises(agalign.InputError, match="fixed_to_moving has complex numbers"):
        agalign.warp_onto(IMAGE, np.eye(3) + 0j, (64, 64))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_nan_in_a_mask_is_not_valid(dtype: type) -> None:
    mask, expected = np.ones((64, 64), dtype), np.ones((64, 64), bool)
    mask[:, :20], expected[:, :20] = np.nan, False
    np.testing.assert_array_equal(raster_of(IMAGE, mask, "fixed").valid, expected)
    _, known = agalign.warp_onto(IMAGE, np.eye(3), (64, 64), valid=mask, interpolation="nearest")
    np.testing.assert_array_equal(known, expected)


def test_half_precision_is_an_image_like_any_other() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert raster_of(IMAGE.astype(np.float16), None, "fixed").valid.all()


@pytest.mark.parametrize("size_px", [(0, 0), (-5, 5), (10.5, 10), (10,), "ab", None, (10**6, 10**6)], ids=repr)
def test_a_grid_that_is_not_an_image_is_refused(size_px: Any) -> None:
    with pytest.raises(agalign.InputError, match="not a width and a height"):
        agalign.warp_onto(IMAGE, np.eye(3), size_px)


def test_an_unknown_interpolation_is_refused() -> None:
    with pytest.raises(agalign.InputError, match="'magic'; choose from nearest, bilinear, cubic, lanczos"):
        agalign.warp_onto(IMAGE, np.eye(3), (20, 20), interpolation="magic")


def test_the_error_at_points_is_that_of_the_error_map() -> None:
    """Where two thirds of the image are masked, the expected error rises with the distance from the windows."""
    fixed, moving = map(as_uint8, textured_pair(TRUTH))
    known = np.ones(fixed.shape, bool)
    known[:, 130:] = False
    for valid in (None, known):
        result = agalign.align(fixed, moving, fixed_valid=valid)
        error_px, (height, width) = result.error_map_px, fixed.shape
        assert (error_px.shape, error_px.dtype) == (fixed.shape, np.float32)
        rows, columns = (at.ravel() for at in np.mgrid[3:height:31, 5:width:29])
        at_points = result.error_px(np.stack([columns, rows], axis=-1))
        np.testing.assert_allclose(error_px[rows, columns], at_points, rtol=0.1)
        assert np.median(np.abs(error_px[rows, columns] / at_points - 1)) < 0.01
        assert result.error_px([[[0, 0], [399, 319]]]).shape == (1, 2)
        assert result.error_px([0, 0]) == pytest.approx(error_px[0, 0], rel=1e-4)
        inside = pixels_in_frame(result.mapping, (width, height), (width, height))
        assert result.std_px == pytest.approx(float(np.sqrt(np.square(error_px[inside]).mean())), rel=1e-5)
    assert error_px[:, 350:].mean() > 3 * error_px[:, 30:100].mean()


def test_the_error_of_a_failed_alignment_is_infinite() -> None:
    result = agalign.align(np.ones((320, 400), np.uint8), as_uint8(textured_image(400, 320)))
    assert (result.status, result.std_px) == ("failed", np.inf)
    assert np.isinf(result.error_map_px).all()
    assert np.isinf(result.error_px([[0, 0], [5, 7]])).all()
    assert not result.is_usable(np.inf)
