import numpy as np
import pytest

from agalign.pixels.sky import MAX_SKY_TEXTURE, relative_texture
from agalign.values.image import Raster


def image(pixels: np.ndarray) -> Raster:
    return Raster(pixels.astype(np.float32), np.ones(pixels.shape, bool))


def gradient() -> np.ndarray:
    y, x = np.mgrid[-1:1:48j, -1:1:64j]
    return np.asarray(20000 * (1 + 0.4 * y - 0.2 * x * y) * (1 - 0.3 * (x**2 + y**2)))


def test_vignetting_is_not_texture_but_faint_waves_are() -> None:
    rng = np.random.default_rng(0)
    smooth = gradient() * (1 + 0.004 * rng.standard_normal((48, 64)))
    assert relative_texture(image(smooth)) == pytest.approx(0.004, rel=0.2)
    waves = gradient() * (1 + 0.05 * np.sin(np.arange(64) * 1.1))
    result = relative_texture(image(waves))
    assert result is not None
    assert result > 2 * MAX_SKY_TEXTURE


def test_texture_is_relative_to_the_light_above_the_black_level() -> None:
    pixels = 100 + 10 * (np.indices((48, 64)).sum(axis=0) % 2)
    plain, lifted = relative_texture(image(pixels)), relative_texture(image(pixels + 5000.0), black_level=5000.0)
    assert plain == pytest.approx(lifted, rel=1e-3)


def test_saturated_or_black_images_have_no_texture_value() -> None:
    bright = image(gradient())
    assert relative_texture(Raster(bright.pixels, np.arange(48 * 64).reshape(48, 64) % 3 == 0)) is None
    assert relative_texture(image(np.zeros((48, 64)))) is None
