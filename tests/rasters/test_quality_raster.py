"""Quality flags, each where the pixels are known to have it."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

import agalign
from agalign.pixels.band_resampling import resample_tile
from agalign.rasters.alignment_maps import _flags, error_map, error_shares
from agalign.rasters.output_grid import Layer
from agalign.records.captures import bands_of
from agalign.records.sidecar_file import read_checked
from agalign.spectral_indices.formulas import index_named, index_of_formula
from agalign.values import geometry, lens
from agalign.values.capture import Band
from agalign.values.choices import UNUSABLE_QUALITY, Interpolation, Quality
from agalign.values.image import OutputGrid, Tile
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import ErrorOnGrid, MappingError
from agalign.values.moved_area import MovedArea
from agalign.values.pixel_units import PixelScale

from ..builders import residual_of
from ..conftest import Shared, seeded, write_band
from ..run_outputs import aligned, index_of

GRID = OutputGrid(4, 2, 60, 40)


def band(path: Path) -> Band:
    pixels = np.full((60, 80), 1000, np.uint16)
    pixels[10:14, 20:24] = 65535
    pixels[30:33, 40:42] = 7
    write_band(path, pixels)
    return Band("NIR", path, 1, 80, 60, "uint16", nodata=7.0, saturation_value=65535.0)


def flags_of(
    layer: Layer,
    errors: dict[str, ErrorOnGrid | None] | None = None,
    interpolation: Interpolation = "bilinear",
    *,
    is_predicted: bool = False,
) -> np.ndarray:
    return _flags(layer, GRID, GRID, errors or {}, interpolation, is_predicted=is_predicted)


def test_flags_of_a_moved_band_are_where_its_pixels_are(tmp_path: Path) -> None:
    moved = Layer(band(tmp_path / "a.tif"), PixelMapping(geometry.translation(-10.5, 0.0)))
    flags = flags_of(moved)
    x = np.arange(4, 64) - 10.5  # columns of the file
    assert ((flags & Quality.OUTSIDE) > 0).all(axis=0).tolist() == (x < 0).tolist()
    rows, columns = np.nonzero(flags & Quality.SATURATED)
    # Half a pixel between two columns: both contribute.
    assert (rows.min() + 2, rows.max() + 2) == (10, 13)
    assert (x[columns.min()], x[columns.max()]) == (19.5, 23.5)
    rows, columns = np.nonzero(flags & Quality.NODATA)
    assert (rows.min() + 2, rows.max() + 2, x[columns.min()], x[columns.max()]) == (30, 32, 39.5, 41.5)
    assert np.count_nonzero(flags & ~np.uint16(Quality.OUTSIDE)) == 4 * 5 + 3 * 3


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear", "cubic", "lanczos"])
def test_every_value_that_saturated_pixels_change_is_flagged(tmp_path: Path, interpolation: Interpolation) -> None:
    """Wide kernels change values four pixels away; no others are flagged."""
    saturated = np.zeros((60, 80), bool)
    saturated[20:32, 30:42] = True
    values, mapping = [], PixelMapping(geometry.translation(-10.5, 0.3))
    for number in (65535, 10_000):
        path = tmp_path / f"{number}.tif"
        write_band(path, np.where(saturated, number, 10_000).astype(np.uint16))
        layer = Layer(Band("NIR", path, 1, 80, 60, "uint16", saturation_value=65535.0), mapping)
        values.append(resample_tile(layer.band, mapping, GRID, interpolation)[0].astype(float))
    bright = Layer(replace(layer.band, path=tmp_path / "65535.tif"), mapping)
    is_flagged = (flags_of(bright, interpolation=interpolation) & Quality.SATURATED) > 0
    is_changed = values[0] != values[1]
    assert is_flagged[is_changed].all()
    near = cv2.dilate(is_changed.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not is_flagged[~near].any()


def test_flags_of_the_reference_are_those_of_its_own_pixels(tmp_path: Path) -> None:
    flags = flags_of(Layer(band(tmp_path / "a.tif"), None, is_reference=True))
    assert (flags[8:12, 16:20] == Quality.SATURATED).all()
    assert (flags[28:31, 36:38] == Quality.NODATA).all()
    assert np.count_nonzero(flags) == 16 + 6


def test_expected_errors_and_predictions_are_flagged_and_an_unknown_error_is_a_large_one(tmp_path: Path) -> None:
    layer = Layer(band(tmp_path / "a.tif"), PixelMapping(geometry.identity()))
    size_px, nodes_px2 = (GRID.width, GRID.height), np.zeros((2, 2, 2), np.float32)
    nodes_px2[0, :, 1] = 4.0
    error = ErrorOnGrid(MappingError(size_px), size_px, nodes_px2)
    flags = flags_of(layer, {"NIR": error}, is_predicted=True)
    assert (flags & Quality.PREDICTED > 0).all()
    expected_px = np.sqrt(np.linspace(0, 4, 60))
    assert ((flags & Quality.ERROR_OVER_HALF_PX) > 0)[5].tolist() == (expected_px > 0.5).tolist()
    assert ((flags & Quality.ERROR_OVER_1_PX) > 0)[5].tolist() == (expected_px > 1).tolist()
    unknown = flags_of(layer, {"NIR": None})
    assert (unknown & Quality.ERROR_OVER_1_PX > 0).all()
    failed = flags_of(Layer(layer.band, None))
    assert (failed == Quality.MISSING).all()
    assert not UNUSABLE_QUALITY & Quality.PREDICTED
    assert UNUSABLE_QUALITY & Quality.MISSING


def area(left: int, top: int, right: int, bottom: int, shift_px: tuple[float, float]) -> MovedArea:
    """A rectangle up to and with the last column and row."""
    return MovedArea(np.array([[left, top], [right, top], [right, bottom], [left, bottom]], float), shift_px)


def test_areas_that_moved_are_flagged_and_have_their_shift_as_error_on_every_grid(tmp_path: Path) -> None:
    size_px = 80, 60
    reference = band(tmp_path / "a.tif")
    moved = area(10, 20, 29, 39, (3.0, 4.0))
    alignment = aligned(
        PixelMapping(geometry.identity()), size_px, error=MappingError(size_px, rig_std_px=0.1, moved=(moved,))
    )
    error = error_map(alignment, reference, GRID)
    flags = flags_of(Layer(reference, PixelMapping(geometry.identity())), {"NIR": error})
    expected = np.zeros((40, 60), bool)
    expected[18:38, 6:26] = True  # the grid begins at (4, 2)
    assert np.array_equal(flags & Quality.MOVED > 0, expected)
    assert np.array_equal(flags & Quality.ERROR_OVER_1_PX > 0, expected)
    np.testing.assert_allclose(error.on_tile(Tile(0, 0, 60, 40)), np.where(expected, np.hypot(5, 0.1), 0.1), rtol=1e-5)
    assert UNUSABLE_QUALITY & Quality.MOVED
    assert error_shares(alignment, reference, GRID) == (expected.mean(), expected.mean())
    double = OutputGrid(0, 0, 160, 120, PixelScale(2.0, 2.0))
    assert error_shares(alignment, reference, double)[1] == pytest.approx(400 / 4800)
    still = aligned(PixelMapping(geometry.identity()), size_px, error=MappingError(size_px))
    assert error_shares(still, reference, GRID) == (0.0, 0.0)


def test_an_area_that_moved_is_where_an_undistorted_grid_shows_it() -> None:
    size_px = 640, 480
    lens_of_reference = Lens(600, 600, 320, 240, (-0.1, 0.0, 0.0, 0.0, 0.0))
    reference = Band("Green", Path(), 1, *size_px, "uint16", lens=lens_of_reference)
    moved = area(40, 30, 99, 89, (9.0, 0.0))
    error = MappingError(size_px, moved=(moved,))
    mapping = PixelMapping(geometry.identity(), lens_of_reference, lens_of_reference)
    grid = OutputGrid(0, 0, *size_px, undistorted=True)
    flagged = error_map(aligned(mapping, size_px, error=error), reference, grid).moved_px(Tile(0, 0, *size_px)) > 0
    rows, columns = np.nonzero(flagged)
    centre_px = lens.distort(lens_of_reference, np.array([columns.mean(), rows.mean()]))
    np.testing.assert_allclose(centre_px, [69.5, 59.5], atol=0.5)
    assert np.hypot(columns.mean() - 69.5, rows.mean() - 59.5) > 5


def test_the_error_of_an_undistorted_pixel_is_that_of_its_raw_one() -> None:
    """At the corner, 12 px from it."""
    size_px = 640, 480
    lens_of_reference = Lens(600, 600, 320, 240, (-0.1, 0.0, 0.0, 0.0, 0.0))
    reference = Band("Green", Path(), 1, *size_px, "uint16", lens=lens_of_reference)
    residual = residual_of(geometry.lattice(*size_px, 8, 6), (0.1, 0.1))
    error = MappingError(size_px, np.diag(np.arange(1.0, 9.0)), residual)
    mapping = PixelMapping(geometry.identity(), lens_of_reference, lens_of_reference)
    alignment = aligned(mapping, size_px, residual=residual, error=error)
    raw, undistorted = OutputGrid(0, 0, *size_px), OutputGrid(0, 0, *size_px, undistorted=True)
    on_raw, on_undistorted = (error_map(alignment, reference, g).on_tile(g) for g in (raw, undistorted))
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in size_px)), axis=-1)
    at = lens.distort(lens_of_reference, pixels).astype(np.float32)
    inside = ((at > 20) & (at < np.subtract(size_px, 20))).all(axis=-1)
    assert np.abs(at - pixels)[inside].max() > 10
    expected = cv2.remap(on_raw, at, None, cv2.INTER_LINEAR)
    assert np.abs(on_undistorted - on_raw)[inside].max() > 0.05
    np.testing.assert_allclose(on_undistorted[inside], expected[inside], atol=0.01)


@pytest.fixture
def sidecar(flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """That of a capture with a quality raster, in a run that a test may change."""
    settings = seeded(qa=True, crop="none")
    done = shared("quality", lambda out: agalign.align_folder(flight, out, settings=settings))
    return shutil.copytree(done, tmp_path / "out") / "0000SET" / "000" / "IMG_0001.json"


@pytest.mark.slow
def test_a_run_writes_flags_with_their_meaning_for_every_band_of_the_stack(sidecar: Path) -> None:
    path = sidecar.with_suffix(".qa.tif")
    assert [p.file for p in read_checked(sidecar).without_tables().products if p.kind == "qa"] == [path.name]
    with rasterio.open(path) as raster, rasterio.open(sidecar.with_suffix(".tif")) as stack:
        assert raster.descriptions == ("all bands", *stack.descriptions)
        assert raster.shape == stack.shape
        tags, flags, pixels = raster.tags(), raster.read(), stack.read()
    masks = [int(m) for m in tags["flag_masks"].split(", ")]
    assert masks == [1, 2, 4, 8, 16, 32, 64, 256, 512]
    assert tags["flag_meanings"].split() == [str(Quality(m).name).lower() for m in masks]
    assert np.array_equal(flags[0], np.bitwise_or.reduce(flags[1:]))
    # Whatever is outside is nodata in the stack, and the reverse.
    no_value = flags[1:] & np.uint16(Quality.OUTSIDE | Quality.NODATA | Quality.OCCLUDED | Quality.MISSING) > 0
    assert no_value.any()
    assert np.array_equal(pixels == stack.nodata, no_value)


@pytest.mark.slow
def test_indices_omit_pixels_flagged_in_their_own_bands(sidecar: Path, tmp_path: Path) -> None:
    result, path = read_checked(sidecar).without_tables(), sidecar.with_suffix(".qa.tif")
    plain, masked = (
        [replace(b, problem="") for b in bands_of(result, sidecar.parent, mask_qa=mask_qa)] for mask_qa in (False, True)
    )
    saturated, predicted = np.s_[110:120, 130:150], np.s_[140:150, 130:150]
    with rasterio.open(path, "r+") as raster:
        flags = np.zeros(raster.shape, np.uint16)
        flags[saturated], flags[predicted] = Quality.SATURATED, Quality.PREDICTED
        for index, name in enumerate(raster.descriptions, start=1):
            raster.write(flags if name == "NIR" else np.zeros_like(flags), index)
    ndvi = index_of(plain, index_named("ndvi"), tmp_path / "plain")
    left = index_of(masked, index_named("ndvi"), tmp_path / "masked", overwrite=False)
    green = index_of(masked, index_of_formula("green=(G-R)/(G+R)"), tmp_path / "masked")
    values, kept, without_nir = (rasterio.open(r.path).read(1) for r in (ndvi, left, green))
    assert np.isfinite(values[saturated]).all()
    values[saturated] = np.nan
    assert np.array_equal(kept, values, equal_nan=True)
    assert left.statistics.masked_share == pytest.approx(200 / values.size, abs=1e-6)
    assert ndvi.statistics.masked_share == 0
    assert np.isfinite(without_nir[saturated]).all()
    # The same bands without the mask are another raster, which is not taken for this one.
    again = index_of(plain, index_named("ndvi"), tmp_path / "masked", overwrite=False)
    assert not again.kept
    with pytest.raises(agalign.InputError, match="--qa"):
        bands_of(result.model_copy(update={"products": []}), sidecar.parent, mask_qa=True)
