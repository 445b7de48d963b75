from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from agalign.config import Settings, WriteSettings
from agalign.errors import OutputError
from agalign.products.aligned_files import BandFiles
from agalign.products.checked_raster import CheckedRaster
from agalign.products.layout import Layer
from agalign.products.product import CapturePaths, ProductContext
from agalign.products.raster_file import write_raster
from agalign.values import geometry
from agalign.values.capture import Band, CameraIdentity, Capture, Georeference
from agalign.values.image import OutputGrid
from agalign.values.mapping import PixelMapping

from ..conftest import textured_image

TRANSFORM = np.array([[0.1, 0, 500000], [0, -0.1, 5800000], [0, 0, 1.0]])


def make_capture(
    folder: Path, dtype: str = "uint16", nodata: float | None = None, georeferenced: bool = False, count: int = 3
) -> Capture:
    bands = []
    crs = rasterio.CRS.from_epsg(32631)
    for k in range(count):
        scale = 20 if dtype == "uint8" else 100
        pixels = ((textured_image(200, 150, k) + 5) * scale).clip(1).astype(dtype)
        path = folder / f"f_{k}.tif"
        profile = {"driver": "GTiff", "width": 200, "height": 150, "count": 1, "dtype": dtype, "nodata": nodata}
        if georeferenced:
            profile |= {"transform": rasterio.Affine(*TRANSFORM[:2].ravel()), "crs": crs}
        with rasterio.open(path, "w", **profile) as dataset:
            dataset.write(pixels, 1)
        georeference = Georeference(TRANSFORM, crs.to_wkt()) if georeferenced else None
        bands.append(
            Band(
                f"B{k}",
                path,
                1,
                200,
                150,
                dtype,
                nodata=nodata,
                wavelength_nm=500 + 100 * k,
                bandwidth_nm=20,
                georeference=georeference,
            )
        )
    return Capture("f", Path(), tuple(bands), 1, CameraIdentity("Make", "Model"), captured_at="2026-06-21T10:00:00.5")


pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SHIFT = PixelMapping(geometry.translation(3.25, -2.5))
CROP = OutputGrid(4, 6, 180, 130, has_gaps=False)


def layers_of(capture: Capture) -> list[Layer]:
    return [
        Layer(b, None if b is capture.reference else SHIFT, is_reference=b is capture.reference) for b in capture.bands
    ]


@pytest.mark.parametrize("compression", ["zstd", "deflate", "none"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_reference_is_bit_identical_and_the_type_kept(tmp_path: Path, dtype: str, compression: str) -> None:
    capture = make_capture(tmp_path, dtype)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), CROP, out, WriteSettings(compression=compression))
    with rasterio.open(out) as written, rasterio.open(capture.reference.path) as source:
        assert set(written.dtypes) == {dtype}
        np.testing.assert_array_equal(written.read(2), source.read(1)[6:136, 4:184])
        assert written.descriptions == ("B0", "B1", "B2")
        assert written.tags(3)["wavelength"] == "700"
        assert written.tags(3, ns="IMAGERY")["CENTRAL_WAVELENGTH_UM"] == "0.7"
        assert written.tags()["TIFFTAG_DATETIME"] == "2026:06:21 10:00:00"
        assert written.profile["tiled"]


def test_red_green_and_blue_are_shown_as_such(tmp_path: Path) -> None:
    """A viewer that goes by the bands' order would show near infra-red as red."""
    capture = make_capture(tmp_path)
    names = (("NIR", 840.0), ("Green", 560.0), ("Red", 668.0), ("Blue", 475.0))
    some = [capture.bands[k % len(capture.bands)] for k in range(4)]
    bands = [replace(b, name=n, wavelength_nm=w) for b, (n, w) in zip(some, names, strict=True)]
    layers = [Layer(b, None, is_reference=True) for b in bands]
    for chosen, colours in (
        (layers, ["undefined", "green", "red", "blue"]), (layers[:2], ["gray", "undefined"]), (layers[:1], ["gray"]),
    ):  # fmt: skip
        write_raster(capture, chosen, CROP, tmp_path / "out.tif", WriteSettings())
        with rasterio.open(tmp_path / "out.tif") as written:
            assert [c.name for c in written.colorinterp] == colours


def test_no_georeference_and_no_nodata_are_invented(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    out = tmp_path / "out.tif"
    nodata_written = write_raster(capture, layers_of(capture), CROP, out, WriteSettings())
    assert nodata_written is None
    with rasterio.open(out) as written:
        assert written.crs is None
        assert written.transform.is_identity
        assert written.nodata is None
    assert not list(tmp_path.glob("*.aux.xml"))


@pytest.mark.parametrize("file_format", ["gtiff", "cog"])
def test_the_georeference_follows_the_crop(tmp_path: Path, file_format: str) -> None:
    capture = make_capture(tmp_path, georeferenced=True)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), CROP, out, WriteSettings(format=file_format))
    with rasterio.open(out) as written:
        assert written.crs.to_epsg() == 32631
        assert tuple(written.transform)[:6] == pytest.approx((0.1, 0, 500000.4, 0, -0.1, 5799999.4))
        if file_format == "cog":
            assert written.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert written.descriptions == ("B0", "B1", "B2")


@pytest.mark.parametrize("file_format", ["gtiff", "cog"])
def test_statistics_are_those_of_the_valid_pixels(tmp_path: Path, file_format: str) -> None:
    capture, grid = make_capture(tmp_path), replace(CROP, has_gaps=True)
    moved = Layer(capture.bands[0], PixelMapping(geometry.translation(40.0, 0.0)))
    layers = [Layer(capture.bands[1], None, is_reference=True), moved]
    path = tmp_path / "out.tif"
    write_raster(capture, layers, grid, path, WriteSettings(statistics=True, format=file_format))
    with rasterio.open(path) as dataset:
        for index in dataset.indexes:
            stored, pixels = dataset.tags(index), dataset.read(index, masked=True).compressed()
            assert float(stored["STATISTICS_MINIMUM"]) == pixels.min()
            assert float(stored["STATISTICS_MAXIMUM"]) == pixels.max()
            assert float(stored["STATISTICS_MEAN"]) == pytest.approx(pixels.mean())
            assert float(stored["STATISTICS_STDDEV"]) == pytest.approx(pixels.std())


def test_a_band_without_valid_pixels_has_no_statistics(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    layers = [Layer(capture.bands[1], None, is_reference=True), Layer(capture.bands[0], None)]
    path = tmp_path / "out.tif"
    write_raster(capture, layers, replace(CROP, has_gaps=True), path, WriteSettings(statistics=True))
    with rasterio.open(path) as dataset:
        assert dataset.tags(1)["STATISTICS_VALID_PERCENT"] == "100"
        assert dataset.tags(2)["STATISTICS_VALID_PERCENT"] == "0"
        assert "STATISTICS_MEAN" not in dataset.tags(2)


def test_moving_bands_are_resampled_where_the_mapping_says(tmp_path: Path) -> None:
    capture = make_capture(tmp_path, "float32")
    whole = PixelMapping(geometry.translation(3, -2))
    layers = [
        Layer(b, None if b is capture.reference else whole, is_reference=b is capture.reference) for b in capture.bands
    ]
    out = tmp_path / "out.tif"
    write_raster(capture, layers, CROP, out, WriteSettings())
    with rasterio.open(out) as written, rasterio.open(capture.bands[0].path) as source:
        np.testing.assert_allclose(written.read(1), source.read(1)[4:134, 7:187], rtol=1e-6)


@pytest.mark.parametrize(("dtype", "nodata"), [("uint16", None), ("float32", None), ("int16", -9999), ("uint8", 255)])
def test_outside_the_moving_image_is_nodata(tmp_path: Path, dtype: str, nodata: float | None) -> None:
    capture = make_capture(tmp_path, dtype, nodata)
    frame = OutputGrid(0, 0, 200, 150)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), frame, out, WriteSettings(crop="none"))
    expected = nodata if nodata is not None else (np.nan if dtype == "float32" else 0)
    with rasterio.open(out) as written:
        np.testing.assert_equal(written.nodata, expected)
        mask = written.read_masks(1) > 0
        assert not mask[:2].any()  # rows -2.5 and -1.5 of the moving image
        assert not mask[:, 197:].any()
        assert mask[4:, :195].all()


def test_valid_pixels_that_equal_nodata_are_moved_beside_it(tmp_path: Path) -> None:
    capture = make_capture(tmp_path, "uint8")
    with rasterio.open(capture.bands[0].path, "r+") as dataset:
        dataset.write(np.zeros((150, 200), np.uint8), 1)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), OutputGrid(0, 0, 200, 150), out, WriteSettings(crop="none"))
    with rasterio.open(out) as written:
        assert set(np.unique(written.read(1))) == {0, 1}


def test_a_gap_is_all_nodata(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    layers = [Layer(capture.bands[0], None), *layers_of(capture)[1:]]
    out = tmp_path / "out.tif"
    write_raster(capture, layers, CROP, out, WriteSettings())
    with rasterio.open(out) as written:
        assert not written.read_masks(1).any()
        assert written.read_masks(3).all()


def test_undeclared_nan_stays_nan(tmp_path: Path) -> None:
    capture = make_capture(tmp_path, "float32")
    with rasterio.open(capture.bands[0].path, "r+") as dataset:
        pixels = dataset.read(1)
        pixels[50:70, 60:90] = np.nan
        dataset.write(pixels, 1)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), CROP, out, WriteSettings())
    with rasterio.open(out) as written:
        assert np.isnan(written.nodata)
        hole = np.isnan(written.read(1))
        assert hole[50:60, 60:80].all()
        assert hole.sum() < 23 * 33
        assert not np.isnan(written.read(3)).any()


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    (tmp_path / "out.tif").write_bytes(b"the earlier result")
    capture.bands[2].path.unlink()
    with pytest.raises(Exception, match=r"f_2\.tif"):
        write_raster(capture, layers_of(capture), CROP, tmp_path / "out.tif", WriteSettings())
    assert (tmp_path / "out.tif").read_bytes() == b"the earlier result"
    assert not list(tmp_path.glob(".*"))


def test_a_folder_where_the_file_should_be(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    (tmp_path / "out.tif").mkdir()
    with pytest.raises(OutputError, match=r"out\.tif"):
        write_raster(capture, layers_of(capture), CROP, tmp_path / "out.tif", WriteSettings())


def test_nodata_is_a_value_that_copied_pixels_do_not_have(tmp_path: Path) -> None:
    """The reference's zeros are measurements, and it is copied as it is."""
    capture = make_capture(tmp_path)
    reference = np.zeros((150, 200), np.uint16)
    reference[:, ::3], reference[0, 0] = 7, 65535
    with rasterio.open(capture.reference.path, "r+") as dataset:
        dataset.write(reference, 1)
    layers = [Layer(capture.bands[0], None), *layers_of(capture)[1:]]
    out = tmp_path / "out.tif"
    nodata = write_raster(capture, layers, OutputGrid(0, 0, 200, 150), out, WriteSettings())
    with rasterio.open(out) as written:
        assert written.nodata == nodata
        assert nodata not in (None, 0, 7, 65535)
        np.testing.assert_array_equal(written.read(2), reference)
        assert written.read_masks(2).all()
        assert not written.read_masks(1).any()
        assert not written.read_masks(3)[-1, -1]


def test_undeclared_fill_of_the_reference_is_nodata_in_the_stack(tmp_path: Path) -> None:
    capture = make_capture(tmp_path, "float32")
    with rasterio.open(capture.reference.path, "r+") as dataset:
        pixels = dataset.read(1)
        pixels[:, :20] = -9999
        dataset.write(pixels, 1)
    out = tmp_path / "out.tif"
    write_raster(capture, layers_of(capture), CROP, out, WriteSettings())
    with rasterio.open(out) as written:
        assert np.isnan(written.nodata)
        assert np.isnan(written.read(2)[:, :16]).all()
        np.testing.assert_array_equal(written.read(2)[:, 16:], pixels[6:136, 20:184])


def test_files_of_bands_have_each_their_own_nodata(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    (tmp_path / "floats").mkdir()
    floats = make_capture(tmp_path / "floats", "float32").bands[2]
    capture = replace(capture, bands=(*capture.bands[:2], floats))
    paths, settings = CapturePaths(tmp_path / "out", "c"), Settings(write=WriteSettings(layout="bands"))
    context = ProductContext(capture, paths, settings, {}, layers_of(capture), OutputGrid(0, 0, 200, 150), None, 0)
    by_name = {file.path.name: file.nodata for file in BandFiles().write(context)}
    assert by_name["f_0.tif"] == 0
    assert np.isnan(by_name["f_2.tif"])


def test_a_tile_that_gdal_lost_is_noticed(tmp_path: Path) -> None:
    """A write that fails once while GDAL closes a file leaves a tile of zeros and no error."""
    path = tmp_path / "a.tif"
    pixels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)
    with rasterio.open(path, "w", driver="GTiff", width=64, height=48, count=1, dtype="uint16") as dataset:
        raster = CheckedRaster(dataset)
        raster.write(pixels, 1)
    raster.verify(path)
    with rasterio.open(path, "r+") as dataset:
        dataset.write(np.zeros_like(pixels), 1)
    with pytest.raises(OSError, match="the file came out incomplete"):
        raster.verify(path)
