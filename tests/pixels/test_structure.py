"""Structure images, phase correlation of them, and stripes that all bands have in common."""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

import agalign
from agalign.pixels.band_resampling import shrink, textured
from agalign.pixels.stripes import without_common_stripes
from agalign.pixels.structure import (
    Peak,
    blur_px,
    correlation_surfaces,
    find_peak,
    gradient_magnitude,
    structure_field,
    windowed_spectra,
)
from agalign.synthetic.cameras import REDEDGE
from agalign.synthetic.flight import Shot, plan_flight, score_against_truth, write_shots
from agalign.synthetic.ground import Field
from agalign.values.image import Raster

from ..builders import texture, whole
from ..conftest import textured_image

IMAGE = texture(320, 240)


def peak(fixed: Raster, moving: Raster) -> Peak:
    return find_peak(correlation_surfaces(*(windowed_spectra(structure_field(image)) for image in (fixed, moving))), 16)


def test_contrast_reversal_does_not_change_the_field() -> None:
    np.testing.assert_allclose(structure_field(IMAGE), structure_field(whole(-IMAGE.pixels)), atol=1e-5)


@pytest.mark.parametrize("shift", [(7.0, -4.0), (-20.5, 11.25)])
def test_the_peak_is_at_the_shift(shift: tuple[float, float]) -> None:
    big = textured_image(480, 400)
    matrix = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    moved = -cv2.warpAffine(big, matrix, (480, 400), flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP)
    crop = np.s_[80:320, 80:400]
    result = peak(*(whole(image[crop]) for image in (big, moved)))
    # With cv2.WARP_INVERSE_MAP, moved(p) = big(p - shift): content at p is moved to p + shift.
    np.testing.assert_allclose(result.shift_px, shift, atol=0.15)
    assert result.sigma > 3 * result.runner_up_sigma


def test_a_runner_up_is_within_the_limit_and_apart_from_the_peak_across_the_border() -> None:
    """Shifts are circular: a peak at the border of the surface continues at the opposite one."""
    surface = np.random.default_rng(0).normal(0, 0.1, (64, 64)).astype(np.float32)
    surface[0, 0], surface[0, 20], surface[0, 32], surface[0, 31] = 10.0, 12.0, 30.0, 29.0
    near = find_peak(surface, 4, max_shift_px=10.0)
    assert np.hypot(*near.shift_px) < 1
    assert near.runner_up_sigma < 0.1 * near.sigma
    at_the_border = find_peak(surface, 4)
    assert abs(abs(at_the_border.shift_px[0]) - 32) < 1
    assert at_the_border.runner_up_sigma < 0.5 * at_the_border.sigma


def test_invalid_pixels_leave_no_edge() -> None:
    valid = np.ones((240, 320), bool)
    valid[100:140, 100:180] = False
    holed = structure_field(Raster(np.where(valid, IMAGE.pixels, np.float32(-50)), valid))
    assert np.abs(holed[~valid]).max() == 0
    far = cv2.erode(valid.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    assert np.abs(holed - structure_field(IMAGE))[far].mean() < 0.02


def test_shrinking_averages_and_keeps_invalid_pixels_out() -> None:
    pixels = np.arange(64, dtype=np.float32).reshape(8, 8)
    valid = np.ones((8, 8), bool)
    valid[0, 0] = False
    small = shrink(Raster(pixels, valid), (4, 4))
    assert not small.valid[0, 0]
    assert small.valid.sum() == 15
    assert small.pixels[1, 1] == pytest.approx(pixels[2:4, 2:4].mean())


def test_the_blur_of_an_image_with_a_masked_centre_is_that_of_its_edges() -> None:
    blurred = cv2.GaussianBlur(textured_image(400, 320), (0, 0), 3.0)
    valid = np.ones(blurred.shape, bool)
    valid[70:250, 90:310] = False
    of_edges = blur_px(Raster(np.where(valid, blurred, 0), valid))
    assert blur_px(whole(blurred)) == pytest.approx(of_edges, rel=0.15)
    assert blur_px(Raster(blurred, np.zeros_like(valid))) == 0.0


def test_textured() -> None:
    assert textured(IMAGE)
    assert not textured(whole(np.full((240, 320), 7, np.float32)))
    assert not textured(Raster(IMAGE.pixels, ~IMAGE.valid))


def at_offset(image: np.ndarray, offset: int) -> np.ndarray:
    """Return a copy of an image at an offset in bytes from a multiple of 128 in memory."""
    room = np.empty(image.nbytes + 256, np.uint8)
    start = -room.ctypes.data % 128 + offset
    placed = room[start : start + image.nbytes].view(image.dtype).reshape(image.shape)
    placed[...] = image
    return placed


def test_the_magnitude_does_not_depend_on_memory_alignment() -> None:
    gx, gy = textured_image(471, 353, 1), textured_image(471, 353, 2)
    result = {gradient_magnitude(at_offset(gx, k), at_offset(gy, (5 * k) % 128)).tobytes() for k in range(0, 128, 4)}
    assert len(result) == 1
    np.testing.assert_allclose(gradient_magnitude(gx, gy), cv2.magnitude(gx, gy), atol=1e-5)


# ---- stripes


WIDTH, HEIGHT = 400, 320
OFFSETS = ((0, 0), (13, -8), (-21, 5), (9, 17))
"""Offsets of the four bands, px."""
REGISTERED = ((0, 0),) * len(OFFSETS)


def bands(offsets: Sequence[tuple[int, int]] = OFFSETS, scene: np.ndarray | None = None) -> list[Raster]:
    """Images of one scene, every second one with reversed contrast, with different brightness and noise."""
    scene = textured_image(WIDTH + 80, HEIGHT + 80) if scene is None else scene
    rng = np.random.default_rng(1)
    result = []
    for k, (x, y) in enumerate(offsets):
        seen = scene[40 - y : 40 - y + HEIGHT, 40 - x : 40 - x + WIDTH] * (-1) ** k
        noisy = (1000 + 100 * (k + 1) * (seen + 0.05 * rng.normal(size=seen.shape))).astype(np.float32)
        result.append(whole(noisy))
    return result


def pattern(axis: int, share: float = 0.2, seed: int = 5) -> np.ndarray:
    """White stripes along columns (axis 0) or rows, relative to the range of `bands`."""
    length = WIDTH if axis == 0 else HEIGHT
    one = share * 5 * np.random.default_rng(seed).uniform(-0.5, 0.5, length).astype(np.float32)
    return np.broadcast_to(one[None] if axis == 0 else one[:, None], (HEIGHT, WIDTH))


def striped(images: Sequence[Raster], *patterns: np.ndarray) -> list[Raster]:
    """Add the same pattern to each image, scaled to its contrast."""
    total = np.sum(patterns, axis=0)
    return [Raster(i.pixels + 100 * (k + 1) * total, i.valid) for k, i in enumerate(images)]


def is_same(one: Sequence[Raster], other: Sequence[Raster]) -> bool:
    return all(a is b for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1)])
def test_bands_peak_at_their_offset_once_the_common_pattern_is_removed(
    axes: tuple[int, ...], caplog: pytest.LogCaptureFixture
) -> None:
    images = striped(bands(), *(pattern(axis, share=2.0) for axis in axes))
    shifts = np.array([peak(images[0], image).shift_px for image in images[1:]])
    assert np.linalg.norm(shifts - OFFSETS[1:], axis=1).min() > 0.5, "the pattern hides the offsets"
    with caplog.at_level(logging.DEBUG):
        fixed, *moving = without_common_stripes(images)
    np.testing.assert_allclose([peak(fixed, image).shift_px for image in moving], OFFSETS[1:], atol=0.1)
    assert all((word in caplog.text) == (axis in axes) for axis, word in enumerate(("columns", "rows")))


def test_without_a_common_pattern_the_images_are_the_same_objects() -> None:
    images = bands()
    assert is_same(without_common_stripes(images), images)
    one_only = [*images[:2], *striped(images[2:3], pattern(0)), images[3]]
    assert is_same(without_common_stripes(one_only), one_only)
    own = [striped([image], pattern(0, seed=k))[0] for k, image in enumerate(images)]
    assert is_same(without_common_stripes(own), own)


@pytest.mark.parametrize("offsets", [OFFSETS, REGISTERED])
def test_crop_rows_along_the_columns_are_not_removed(
    offsets: Sequence[tuple[int, int]], caplog: pytest.LogCaptureFixture
) -> None:
    rows = 2 * np.sin(2 * np.pi * np.arange(WIDTH + 80) / 17).astype(np.float32)
    images = bands(offsets, textured_image(WIDTH + 80, HEIGHT + 80) + rows)
    images = [image if k % 2 == 0 else Raster(2000 - image.pixels, image.valid) for k, image in enumerate(images)]
    with caplog.at_level(logging.DEBUG):
        assert is_same(without_common_stripes(images), images)
    assert ("co-registered" in caplog.text) == (offsets is REGISTERED)


def test_invalid_pixels_are_excluded_and_stay_0() -> None:
    clean = bands()
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, 100:160] = valid[200:230] = False
    images = [Raster(np.where(valid, i.pixels, np.float32(0)), valid) for i in striped(clean, pattern(0))]
    for before, after in zip(images, without_common_stripes(images), strict=True):
        assert (after.pixels[~valid] == 0).all()
        assert after.valid is before.valid
        assert not np.array_equal(after.pixels[valid], before.pixels[valid])
    fixed, moving, *_ = without_common_stripes(images)
    np.testing.assert_allclose(peak(fixed, moving).shift_px, OFFSETS[1], atol=0.1)


def test_images_of_another_size_or_of_several_channels_are_not_compared() -> None:
    images = striped(bands(), pattern(0))
    colour, small = whole(np.stack([images[0].pixels] * 3)), whole(images[1].pixels[:100, :100])
    alone = [images[0], colour, small]
    assert is_same(without_common_stripes(alone), alone)
    first, second, third, *others = without_common_stripes([images[0], colour, small, *images[1:]])
    assert is_same([second, third], [colour, small])
    for one, other in zip([first, *others], without_common_stripes(images), strict=True):
        np.testing.assert_array_equal(one.pixels, other.pixels)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_capture_with_common_stripes_is_aligned(tmp_path: Path) -> None:
    """White column stripes, equal in all bands, of +-20 % of the range."""

    def stripes(light: Field, _rng: np.random.Generator) -> Field:
        low, high = np.percentile(light, (1, 99))
        return np.asarray(light + (high - low) * np.random.default_rng(5).uniform(-0.2, 0.2, light.shape[1]), "f4")

    size_px, rng = (480, 360), np.random.default_rng(3)
    poses, ground = plan_flight(rng, 1, size_px)
    truth = write_shots(tmp_path, [Shot(poses[0], ground, stripes)], size_px, REDEDGE, rng)
    list(agalign.align_folder(tmp_path, tmp_path / "out"))
    scores = score_against_truth(tmp_path / "out", truth)
    assert [score.status for score in scores] == ["aligned"] * 4
    assert max(score.median_px for score in scores) < 0.3
