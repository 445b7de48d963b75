"""Masks, conversions to grey and the texture of the sky."""

import numpy as np
import pytest

from agalign.flight.sky import relative_texture
from agalign.pixels.band_resampling import channel_mean, eight_bit, luma
from agalign.pixels.masks import data_mask, learnable, undeclared_fill
from agalign.values.image import Raster

from ..builders import whole


def test_data_mask() -> None:
    pixels = np.array([[1.0, np.nan, -9999.0, np.inf]])
    assert data_mask(pixels, -9999).tolist() == [[True, False, False, False]]
    assert data_mask(np.array([[0, 5]], np.uint8), 0).tolist() == [[False, True]]
    assert data_mask(np.array([[0, 5]], np.uint8), None).all()
    assert data_mask(np.array([[1.0, np.nan]]), float("nan")).tolist() == [[True, False]]
    assert data_mask(np.array([[2**62, -(2**63), -9999, 7]]), None).tolist() == [[False, False, False, True]]


def test_only_constant_areas_at_the_border_are_fill() -> None:
    image = np.full((60, 80), 100, np.uint8)
    image[:, :10] = 0
    image[30:34, 40:44] = 0  # shadow in the middle
    image[50:, 70:] = 255
    fill = undeclared_fill(image)
    assert fill[:, :10].all()
    assert fill[50:, 70:].all()
    assert not fill[30:34, 40:44].any()
    assert fill.sum() == 600 + 100

    few = np.full((200, 200), 100, np.uint8)
    few[0, :3] = 0
    assert not undeclared_fill(few).any()


def test_saturated_areas_and_their_neighbours_are_masked() -> None:
    pixels = np.full((30, 30), 100, np.uint16)
    pixels[5:15, 5:15] = 65520
    pixels[20:26, 5:11] = 65520  # a glint
    everywhere = np.ones((30, 30), bool)
    mask = learnable(everywhere, pixels, 65520)
    assert (~mask).sum() == 12 * 12
    assert not mask[4:16, 4:16].any()
    assert learnable(everywhere, pixels, None).all()


@pytest.mark.parametrize("fill", [-9999, -32767, -32768, -99999, 1e20, -1e20, -3.4028235e38, 9.96921e36])
def test_common_fill_values_of_floats_are_masked(fill: float) -> None:
    pixels = np.array([[0.2, fill, -3.0, 60_000.0]], np.float32)
    assert data_mask(pixels, None).tolist() == [[True, False, True, True]]
    # Fill values are only assumed for floats without a declared nodata value.
    assert data_mask(np.array([[-9999.0, 7.0]]), 7.0).tolist() == [[True, False]]
    assert data_mask(np.array([[-9999]], np.int16), None).all()


# ---- grey

RGB = np.stack([np.full((2, 3), value, np.float32) for value in (10.0, 20.0, 60.0)])


def test_luma_is_the_weighted_mean_of_red_green_and_blue() -> None:
    np.testing.assert_allclose(luma(RGB), np.full((2, 3), 0.299 * 10 + 0.587 * 20 + 0.114 * 60), rtol=1e-6)
    np.testing.assert_allclose(luma(RGB[:2]), np.full((2, 3), 15.0))
    np.testing.assert_array_equal(luma(RGB[0]), RGB[0])


def test_channel_mean_has_equal_weights() -> None:
    result = channel_mean(whole(RGB))
    np.testing.assert_allclose(result.pixels, np.full((2, 3), 30.0))
    assert result.pixels.dtype == np.float32
    one = whole(RGB[0])
    assert channel_mean(one) is one


def test_eight_bit_spans_the_valid_pixels() -> None:
    image = np.linspace(0, 100, 101, dtype=np.float32)[None]
    valid = image < 51
    result = eight_bit(image, valid)
    assert result[0, 0] == 0
    assert result[0, 50] == 255
    assert result[0, 100] == 255


# ---- texture of the sky


def test_texture_is_relative_to_the_light_above_the_black_level() -> None:
    pixels = 100 + 10 * (np.indices((48, 64)).sum(axis=0) % 2)
    plain, lifted = relative_texture(whole(pixels)), relative_texture(whole(pixels + 5000.0), black_level=5000.0)
    assert plain == pytest.approx(lifted, rel=1e-3)


def test_saturated_or_black_images_have_no_texture_value() -> None:
    assert relative_texture(Raster(np.ones((48, 64)), np.arange(48 * 64).reshape(48, 64) % 3 == 0)) is None
    assert relative_texture(whole(np.zeros((48, 64)))) is None
