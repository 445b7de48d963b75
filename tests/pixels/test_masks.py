import numpy as np
import pytest

from agalign.pixels.masks import data_mask, learnable, undeclared_fill


def test_data_mask() -> None:
    pixels = np.array([[1.0, np.nan, -9999.0, np.inf]])
    assert data_mask(pixels, -9999).tolist() == [[True, False, False, False]]
    assert data_mask(np.array([[0, 5]], np.uint8), 0).tolist() == [[False, True]]
    assert data_mask(np.array([[0, 5]], np.uint8), None).all()
    assert data_mask(np.array([[1.0, np.nan]]), float("nan")).tolist() == [[True, False]]


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


def test_a_few_dark_pixels_at_the_border_are_content() -> None:
    image = np.full((200, 200), 100, np.uint8)
    image[0, :3] = 0
    assert not undeclared_fill(image).any()


def test_saturated_areas_and_their_neighbours_are_masked() -> None:
    pixels = np.full((30, 30), 100, np.uint16)
    pixels[5:15, 5:15] = 65520
    pixels[22, 22:27] = 65520  # a glint
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
