import numpy as np

from agalign.synthetic import cameras
from agalign.values import geometry
from agalign.values.image import Tile
from agalign.values.mapping import PixelMapping, splined
from agalign.values.pixel_units import PixelScale

H = np.array([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [1e-5, -2e-5, 1.0]])


def test_a_splined_mapping_is_the_mapping_to_a_fraction_of_a_thousandth_of_a_pixel() -> None:
    mapping = PixelMapping(H, cameras.BANDS[1].lens(1280, 960), cameras.BANDS[3].lens(1280, 960))
    x, y = np.arange(700.0, 1280.0), np.arange(500.0, 960.0)
    exact = mapping(np.stack(np.meshgrid(x, y), axis=-1))
    assert np.abs(splined(mapping, x, y) - exact).max() < 2e-4
    assert np.abs(splined(mapping, x, y, dtype=np.float32) - exact).max() < 1e-3


def test_tiny_tiles() -> None:
    mapping = PixelMapping(H, cameras.BANDS[1].lens(1280, 960), None)
    np.testing.assert_allclose(mapping.positions(Tile(30, 40, 1, 1))[0, 0], mapping([30, 40]), atol=1e-3)


def test_rescaled_maps_the_same_ground() -> None:
    mapping = PixelMapping(H, cameras.BANDS[1].lens(1280, 960), cameras.BANDS[3].lens(1280, 960))
    small = mapping.rescaled(PixelScale(0.5, 0.5), PixelScale(0.25, 0.25))
    points = geometry.lattice(1280, 960, 7, 5)
    expected = (mapping(points) + 0.5) * 0.25 - 0.5
    np.testing.assert_allclose(small((points + 0.5) * 0.5 - 0.5), expected, atol=1e-6)
