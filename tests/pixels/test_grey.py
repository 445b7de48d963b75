import numpy as np

from agalign.pixels.grey import channel_mean, eight_bit, luma
from agalign.values.image import Raster

RGB = np.stack([np.full((2, 3), value, np.float32) for value in (10.0, 20.0, 60.0)])
VALID = np.ones((2, 3), bool)


def test_luma_is_the_weighted_mean_of_red_green_and_blue() -> None:
    np.testing.assert_allclose(luma(RGB), np.full((2, 3), 0.299 * 10 + 0.587 * 20 + 0.114 * 60), rtol=1e-6)
    np.testing.assert_allclose(luma(RGB[:2]), np.full((2, 3), 15.0))
    np.testing.assert_array_equal(luma(RGB[0]), RGB[0])


def test_channel_mean_has_equal_weights() -> None:
    result = channel_mean(Raster(RGB, VALID))
    np.testing.assert_allclose(result.pixels, np.full((2, 3), 30.0))
    assert result.pixels.dtype == np.float32
    one = Raster(RGB[0], VALID)
    assert channel_mean(one) is one


def test_eight_bit_spans_the_valid_pixels() -> None:
    image = np.linspace(0, 100, 101, dtype=np.float32)[None]
    valid = image < 51
    result = eight_bit(image, valid)
    assert result[0, 0] == 0
    assert result[0, 50] == 255
    assert result[0, 100] == 255
