"""Stripes that all bands have in common."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import agalign
from agalign.pixels.stripes import without_common_stripes
from agalign.pixels.structure import Peak, correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.synthetic.cameras import REDEDGE
from agalign.synthetic.flight import Shot, plan_flight, score_against_truth, write_shots
from agalign.synthetic.ground import Field
from agalign.values.image import Raster

from ..builders import whole
from ..conftest import textured_image

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


def peak(fixed: Raster, moving: Raster) -> Peak:
    return find_peak(correlation_surfaces(*(windowed_spectra(structure_field(image)) for image in (fixed, moving))), 16)


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
