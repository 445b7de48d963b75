from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agalign.pixels.band_resampling import resample_tile, warped
from agalign.pixels.raster import probe
from agalign.rasters.output_grid import _largest_rectangle, common_area
from agalign.values import geometry
from agalign.values.capture import Band
from agalign.values.image import Tile
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import PixelScale
from agalign.values.radiometry import Radiometry
from agalign.values.resampling import resample

from ..builders import texture, two_views
from ..conftest import write_band

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
H = np.array([[1.002, 0.004, 6.3], [-0.003, 0.999, -4.7], [3e-6, -2e-6, 1.0]])


def band_of(path: Path, pixels: np.ndarray) -> Band:
    write_band(path, pixels)
    (band,) = probe(path)
    return band


@pytest.mark.parametrize(
    ("interpolation", "tolerance"), [("nearest", 0.8), ("bilinear", 0.02), ("lanczos", 0.05), ("cubic", 0.06)]
)
def test_a_ramp_stays_a_ramp(tmp_path: Path, interpolation: str, tolerance: float) -> None:
    x, y = np.meshgrid(np.arange(300.0), np.arange(200.0))
    band = band_of(tmp_path / "b.tif", (x + 1000 * y).astype(np.float64))
    tile = Tile(30, 30, 200, 120)
    got, valid = resample_tile(band, PixelMapping(geometry.translation(6.3, -4.0)), tile, interpolation)
    expected = (x + 6.3 + 1000 * (y - 4.0))[30:150, 30:230]
    assert valid.all()
    assert np.abs(got - expected).max() < tolerance


@pytest.mark.parametrize("interpolation", ["cubic", "lanczos"])
def test_kernels_do_not_ring_next_to_saturated_pixels(interpolation: str) -> None:
    pixels = np.random.default_rng(0).uniform(0.02, 0.03, (60, 80)).astype(np.float32)
    pixels[20:40, 30:50] = 1.0
    positions = np.stack(np.meshgrid(np.arange(5, 75) + 0.4, np.arange(5, 55) + 0.3), axis=-1)
    got, _ = resample(pixels, np.ones(pixels.shape, bool), positions, Tile(0, 0, 80, 60), (80, 60), interpolation)
    assert got.min() >= pixels.min()
    assert got.max() <= 1.0
    # Each value is in the range of the pixels under its own kernel: farther from the edge, that of the background.
    assert got[:9].max() <= 0.03
    ramp = np.arange(4800, dtype=np.float32).reshape(60, 80)
    inside = np.s_[5:-5, 5:-5]
    unclipped, _ = resample(ramp, np.ones(ramp.shape, bool), positions, Tile(0, 0, 80, 60), (80, 60), interpolation)
    np.testing.assert_allclose(unclipped[inside], (positions @ (1, 80))[inside], atol=5)


def test_nearest_neighbour_uses_the_nearest_pixel() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    positions = np.stack(np.meshgrid(np.array([-0.4, 0.4, 3.4, 3.6]), np.array([0.0])), axis=-1)
    got, valid = resample(pixels, np.ones((3, 4), bool), positions, Tile(0, 0, 4, 3), (4, 3), "nearest")
    assert got[0].tolist()[:3] == [0, 0, 3]
    assert valid[0].tolist() == [True, True, True, False]


@settings(deadline=None)
@given(arrays(bool, st.tuples(st.integers(1, 6), st.integers(1, 6))))
def test_largest_rectangle_is_the_largest(cells: np.ndarray) -> None:
    rows, columns = cells.shape
    spans = product(combinations(range(rows + 1), 2), combinations(range(columns + 1), 2))
    areas = [(b - t) * (r - left) for (t, b), (left, r) in spans if cells[t:b, left:r].all()]
    result = _largest_rectangle(cells, range(columns + 1), range(rows + 1))
    if not areas:
        assert result is None
    else:
        top, bottom, left, right = result
        assert cells[top:bottom, left:right].all()
        assert (bottom - top) * (right - left) == max(areas)


def test_the_common_area_is_inside_every_band() -> None:
    band = Band("b", Path("b"), 1, 200, 150, "uint8")
    near, away = (
        [(PixelMapping(geometry.translation(*t)), band) for t in shifts] for shifts in (((12, 0), (-5, 7)), ((500, 0),))
    )
    area = common_area(near, 200, 150)
    assert area.x0 >= 5
    assert area.x0 + area.width <= 188
    assert area.y0 + area.height <= 143
    assert area.width * area.height > 0.9 * 183 * 143
    assert common_area(away, 200, 150) is None


def test_the_moving_image_is_warped_to_the_fixed_grid() -> None:
    shifted = np.array([[1.01, 0.01, 31.0], [-0.01, 1.0, -18.0], [0, 0, 1.0]])
    fixed, moving = two_views(shifted)
    there = warped(moving, PixelMapping(shifted), fixed.size_px)
    inside = there.valid & fixed.valid
    assert np.corrcoef(fixed.pixels[inside], there.pixels[inside])[0, 1] < -0.9
    half = warped(moving, PixelMapping(shifted), (200, 160), PixelScale(0.5, 0.5))
    assert half.size_px == (200, 160)


def test_an_identity_between_grids_of_different_scales_is_warped() -> None:
    """The moving image has as many pixels as the reduced grid, but covers a quarter of the fixed image."""
    there = warped(texture(200, 160), PixelMapping(np.eye(3)), (200, 160), PixelScale(0.5, 0.5))
    assert not there.valid[100:].any()
    assert there.valid[2:78, 2:98].all()


@pytest.mark.parametrize("shift_px", [0.0, 500.0])
def test_calibrated_pixels_are_float32_inside_and_outside_the_moving_image(tmp_path: Path, shift_px: float) -> None:
    band = band_of(tmp_path / "b.tif", np.ones((100, 140), np.uint16))
    mapping, tile = PixelMapping(geometry.translation(shift_px, 0)), Tile(0, 0, 30, 20)
    pixels, valid = resample_tile(band, mapping, tile, "cubic")
    assert pixels.dtype == np.uint16
    assert (valid == (shift_px == 0)).all()
    radiometry = Radiometry("radiance", 0.0, 65536.0, 1.0)
    assert resample_tile(band, mapping, tile, "cubic", radiometry)[0].dtype == np.float32
