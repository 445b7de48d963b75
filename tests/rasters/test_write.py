import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from agalign.config import WriteSettings
from agalign.errors import OutputError
from agalign.flight.rig import CaptureFactors, Rig
from agalign.rasters.aligned_files import BandFiles, Stack, write_raster
from agalign.rasters.alignment_maps import ErrorMap, QualityRaster
from agalign.rasters.band_reader import RAW, BandReader
from agalign.rasters.geotiff import Block, LayerDescription, write_on_grid
from agalign.rasters.output_grid import Layer, common_grid, flight_limits, output_layers
from agalign.rasters.pan_sharpen import PanSharpened
from agalign.records.captures import AlignedBand
from agalign.values import geometry
from agalign.values.capture import Band, CameraIdentity, Capture, Georeference
from agalign.values.image import OutputGrid
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.radiometry import Radiometry

from ..conftest import textured_image, write_band
from ..run_outputs import aligned, context_of

TRANSFORM = np.array([[0.1, 0, 500000], [0, -0.1, 5800000], [0, 0, 1.0]])
SHIFT = PixelMapping(geometry.translation(3.25, -2.5))
FRAME = OutputGrid(0, 0, 200, 150)
CROP = OutputGrid(4, 6, 180, 130, has_gaps=False)
Output = tuple[list[Layer], OutputGrid]


def make_capture(folder: Path, dtype: str = "uint16", nodata: float | None = None) -> Capture:
    """Three bands, B1 the reference."""
    bands = []
    for k in range(3):
        pixels = (textured_image(200, 150, k) + 5) * (20 if dtype == "uint8" else 100)
        path = folder / f"f_{k}.tif"
        write_band(path, pixels.clip(1).astype(dtype), nodata=nodata)
        bands.append(Band(f"B{k}", path, 1, 200, 150, dtype, nodata, wavelength_nm=500 + 100 * k, bandwidth_nm=20))
    return Capture("f", Path(), tuple(bands), 1, CameraIdentity("Make", "Model"), captured_at="2026-06-21T10:00:00.5")


def layers_of(capture: Capture) -> list[Layer]:
    references = [band is capture.reference for band in capture.bands]
    return [Layer(b, None if r else SHIFT, is_reference=r) for b, r in zip(capture.bands, references, strict=True)]


def write(capture: Capture, grid: OutputGrid, layers: list[Layer] | None = None, **settings: Any) -> Path:
    """Write these layers, or those of `layers_of`, next to the files of the capture."""
    path = capture.reference.path.with_name("out.tif")
    write_raster(context_of(capture, {}, grid=grid, **settings), layers or layers_of(capture), path)
    return path


def change(band: Band, change: Any) -> np.ndarray:
    """Change the pixels of a band's file in place."""
    with rasterio.open(band.path, "r+") as dataset:
        pixels = dataset.read(1)
        change(pixels)
        dataset.write(pixels, 1)
    return pixels


@pytest.mark.parametrize("compression", ["zstd", "deflate", "none"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_reference_is_bit_identical_and_the_type_kept(tmp_path: Path, dtype: str, compression: str) -> None:
    capture = make_capture(tmp_path, dtype)
    out = write(capture, CROP, compression=compression)
    with rasterio.open(out) as written, rasterio.open(capture.reference.path) as source:
        assert set(written.dtypes) == {dtype}
        np.testing.assert_array_equal(written.read(2), source.read(1)[6:136, 4:184])
        assert written.descriptions == ("B0", "B1", "B2")
        assert written.tags(3)["wavelength"] == "700"
        assert written.tags(3, ns="IMAGERY")["CENTRAL_WAVELENGTH_UM"] == "0.7"
        assert written.tags()["TIFFTAG_DATETIME"] == "2026:06:21 10:00:00"
        assert written.profile["tiled"]
        # No georeference and no nodata value are invented; floats have NaN.
        assert (written.crs, written.transform.is_identity) == (None, True)
        np.testing.assert_equal(written.nodata, np.nan if dtype == "float32" else None)
    assert not list(tmp_path.glob("*.aux.xml"))


@pytest.mark.parametrize("layout", ["both", "bands"])
@pytest.mark.parametrize("number", [3, 2])
def test_files_of_bands_have_one_compression(tmp_path: Path, layout: str, number: int) -> None:
    """A file of the input has all bands of a capture, of which one may have failed."""
    write_band(tmp_path / "in.tif", np.ones((3, 150, 200), np.uint16))
    capture = make_capture(tmp_path)
    bands = [replace(b, path=tmp_path / "in.tif", band_index=k, one_lens=True) for k, b in enumerate(capture.bands, 1)]
    capture = replace(capture, bands=tuple(bands))
    context = context_of(capture, {}, tmp_path / "out", layers_of(capture)[:number], CROP, layout=layout)
    for product, compression in ((Stack(), "zstd"), (BandFiles(), "deflate")):
        (written,) = product.write(context)
        with rasterio.open(written.path) as file:
            assert (file.count, file.profile["compress"]) == (number, compression)


@pytest.mark.parametrize(("compression", "of_file"), [("auto", "deflate"), ("zstd", "zstd"), ("none", None)])
def test_rasters_of_a_capture_have_its_compression(tmp_path: Path, compression: str, of_file: str | None) -> None:
    capture = make_capture(tmp_path)
    pan = replace(capture.bands[2], name="Panchro", bandwidth_nm=400.0)
    capture = replace(capture, bands=(*capture.bands[:2], pan))
    alignments = {band.name: aligned(SHIFT, band.size_px) for band in capture.moving}
    context = context_of(capture, alignments, tmp_path, layers_of(capture), CROP, compression=compression)
    for product in (PanSharpened(), ErrorMap(), QualityRaster()):
        (written,) = product.write(context)
        with rasterio.open(written.path) as file:
            assert file.profile.get("compress") == of_file, product.kind
    with rasterio.open(write(capture, CROP, compression=compression, format="cog")) as file:
        assert file.profile.get("compress") == of_file
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def test_a_band_without_calibration_beside_calibrated_ones_has_raw_numbers(tmp_path: Path) -> None:
    """As the bands of a photograph: the quantity of the file is not theirs."""
    capture = make_capture(tmp_path)
    calibrated = [replace(b, radiometry=Radiometry("reflectance", 0.0, 65536.0, 2.0)) for b in capture.bands[:2]]
    mixed = replace(capture, bands=(*calibrated, capture.bands[2]))
    path = write(mixed, CROP, radiometry="auto")
    with BandReader() as reader:
        units = [reader.units(AlignedBand("", None, path, number)) for number in (1, 2, 3)]
    assert units == [["reflectance"], ["reflectance"], [RAW]]
    with rasterio.open(write(capture, CROP)) as dataset:
        assert "QUANTITY" not in dataset.tags(1)


@pytest.mark.parametrize(("declared", "written"), [(np.inf, np.nan), (-np.inf, np.nan), (-9999.0, -9999.0)])
def test_an_infinite_nodata_value_is_written_as_nan(tmp_path: Path, declared: float, written: float) -> None:
    capture = make_capture(tmp_path, "float32", nodata=declared)
    with rasterio.open(write(capture, CROP)) as dataset:
        np.testing.assert_equal(dataset.nodata, written)


def test_red_green_and_blue_are_shown_as_such(tmp_path: Path) -> None:
    """A viewer that goes by the bands' order would show near infra-red as red."""
    capture = make_capture(tmp_path)
    names = {"NIR": 840.0, "Green": 560.0, "Red": 668.0, "Blue": 475.0}
    bands = [replace(capture.bands[0], name=name, wavelength_nm=nm) for name, nm in names.items()]
    layers = [Layer(b, None, is_reference=True) for b in bands]
    for count, colours in ((4, "undefined green red blue"), (2, "gray undefined"), (1, "gray")):
        with rasterio.open(write(capture, CROP, layers[:count])) as written:
            assert [c.name for c in written.colorinterp] == colours.split()


@pytest.mark.parametrize("file_format", ["gtiff", "cog"])
def test_georeference_and_statistics_in_either_format(tmp_path: Path, file_format: str) -> None:
    capture, place = make_capture(tmp_path), Georeference(TRANSFORM, rasterio.CRS.from_epsg(32631).to_wkt())
    capture = replace(capture, bands=tuple(replace(b, georeference=place) for b in capture.bands))
    moved = Layer(capture.bands[0], PixelMapping(geometry.translation(40.0, 0.0)))
    layers = [Layer(capture.bands[1], None, is_reference=True), moved, Layer(capture.bands[2], None)]
    path = write(capture, replace(CROP, has_gaps=True), layers, statistics=True, format=file_format)
    with rasterio.open(path) as dataset:
        assert dataset.crs.to_epsg() == 32631
        assert tuple(dataset.transform)[:6] == pytest.approx((0.1, 0, 500000.4, 0, -0.1, 5799999.4))
        assert dataset.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == ("COG" if file_format == "cog" else None)
        assert dataset.descriptions == ("B1", "B0", "B2")
        for index in (1, 2):
            stored, pixels = dataset.tags(index), dataset.read(index, masked=True).compressed()
            expected = {"MINIMUM": pixels.min(), "MAXIMUM": pixels.max(), "MEAN": pixels.mean(), "STDDEV": pixels.std()}
            for name, value in expected.items():
                assert float(stored[f"STATISTICS_{name}"]) == pytest.approx(value)
        assert dataset.tags(1)["STATISTICS_VALID_PERCENT"] == "100"
        assert dataset.tags(3)["STATISTICS_VALID_PERCENT"] == "0"
        assert "STATISTICS_MEAN" not in dataset.tags(3)


@pytest.mark.parametrize(
    ("dtype", "nodata", "expected"),
    [("uint16", None, 0), ("float32", None, np.nan), ("int16", -9999, -9999), ("uint8", 255, 255)],
)
def test_outside_the_moving_image_is_nodata(tmp_path: Path, dtype: str, nodata: float | None, expected: float) -> None:
    with rasterio.open(write(make_capture(tmp_path, dtype, nodata), FRAME)) as written:
        np.testing.assert_equal(written.nodata, expected)
        mask = written.read_masks(1) > 0
    assert not mask[:2].any()  # rows -2.5 and -1.5 of the moving image
    assert not mask[:, 197:].any()
    assert mask[4:, :195].all()


def test_undeclared_nan_and_fill_are_nodata_in_the_stack(tmp_path: Path) -> None:
    capture = make_capture(tmp_path, "float32")
    change(capture.bands[0], lambda pixels: pixels[50:70, 60:90].fill(np.nan))
    reference = change(capture.reference, lambda pixels: pixels[:, :20].fill(-9999))
    with rasterio.open(write(capture, CROP)) as written:
        assert np.isnan(written.nodata)
        moved, copied, other = written.read()
    assert np.isnan(moved)[50:60, 60:80].all()
    assert np.isnan(moved).sum() < 23 * 33
    assert np.isnan(copied[:, :16]).all()
    np.testing.assert_array_equal(copied[:, 16:], reference[6:136, 20:184])
    assert not np.isnan(other).any()


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    capture, out = make_capture(tmp_path), tmp_path / "out.tif"
    out.write_bytes(b"the earlier result")
    capture.bands[2].path.unlink()
    with pytest.raises(Exception, match=r"f_2\.tif"):
        write(capture, CROP)
    assert out.read_bytes() == b"the earlier result"
    assert not list(tmp_path.glob(".*"))
    out.unlink()
    out.mkdir()
    with pytest.raises(OutputError, match=r"out\.tif"):
        write(capture, CROP, layers_of(capture)[:2])


def test_nodata_is_a_value_that_copied_pixels_do_not_have(tmp_path: Path) -> None:
    """The reference's zeros are measurements, and it is copied without a change; moving pixels that equal nodata change
    by one, and a band without a mapping is nodata.
    """
    capture, zeros = make_capture(tmp_path), np.zeros((150, 200), np.uint16)
    zeros[:, ::3], zeros[0, 0] = 7, 65535
    change(capture.reference, lambda pixels: np.copyto(pixels, zeros))
    change(capture.bands[2], lambda pixels: pixels.fill(1))
    with rasterio.open(write(capture, FRAME, [Layer(capture.bands[0], None), *layers_of(capture)[1:]])) as written:
        gap, copied, moved = written.read()
        assert written.nodata == 1
    np.testing.assert_array_equal(copied, zeros)
    assert (gap == 1).all()
    assert (moved[10:, :190] == 2).all()
    assert moved[-1, -1] == 1


def test_copied_pixels_change_where_no_value_is_left_for_nodata(tmp_path: Path) -> None:
    """All 256 values are measurements: those of 0 become 1, as the file has gaps, which are 0."""
    capture, every = make_capture(tmp_path, "uint8"), np.arange(150 * 200, dtype=np.int64).reshape(150, 200) % 256
    change(capture.reference, lambda pixels: np.copyto(pixels, every.astype(np.uint8)))
    with rasterio.open(write(capture, FRAME, [Layer(capture.bands[0], None), *layers_of(capture)[1:]])) as written:
        gap, copied, _ = written.read()
        assert written.nodata == 0
    np.testing.assert_array_equal(copied, np.maximum(every, 1))
    assert not gap.any()


def test_a_tile_that_gdal_lost_is_noticed(tmp_path: Path) -> None:
    """A write that fails once while GDAL closes a file leaves a tile of zeros and no error."""
    pixels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)

    def lose(path: Path) -> None:
        with rasterio.open(path, "r+") as dataset:
            dataset.write(np.zeros_like(pixels), 1)

    to_write = OutputGrid(0, 0, 64, 48), None, [LayerDescription("a")], [(pixels, 1, 0, 0)]
    write_on_grid(tmp_path / "a.tif", *to_write, dtype="uint16", options={})
    with pytest.raises(OutputError, match="the file came out incomplete"):
        write_on_grid(tmp_path / "b.tif", *to_write, dtype="uint16", options={}, finish=lose)
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


LENS = Lens(150.0, 150.0, 59.5, 44.5, (-0.1, 0.05))


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Two equal bands, `green` the reference."""
    bands = [Band(name, tmp_path / f"{name}.tif", 1, 120, 90, "uint16", lens=LENS) for name in ("green", "nir")]
    for band in bands:
        write_band(band.path, np.full((90, 120), 500, np.uint16))
    return Capture("c", Path(), tuple(bands), 0)


def output_of(capture: Capture, shift_px: float, common: OutputGrid | None = None, **write: Any) -> Output:
    """Layers and grid of the capture, with the moving band, if it has one, shifted to the right."""
    moving = aligned(PixelMapping(geometry.translation(shift_px, 0), LENS, LENS), (120, 90))
    return output_layers(capture, {b.name: moving for b in capture.moving}, WriteSettings(**write), common)


@pytest.mark.parametrize("undistort", [False, True])
def test_without_a_common_area_what_no_band_shows_is_nodata(capture: Capture, undistort: bool) -> None:
    layers, grid = output_of(capture, 200.0, undistort=undistort)
    assert (grid.width, grid.height, grid.has_gaps) == (120, 90, True)
    with rasterio.open(write(capture, grid, layers, undistort=undistort)) as written:
        assert not written.read_masks(2).any()


def test_where_all_bands_show_everything_no_nodata_is_declared(capture: Capture) -> None:
    for shift_px, crop, has_gaps in ((0.0, "common", False), (0.0, "none", False), (9.0, "none", True)):
        assert output_of(capture, shift_px, crop=crop)[1].has_gaps == has_gaps
    moved, cut = output_of(capture, 9.0)
    assert not cut.has_gaps
    assert cut.width < 120
    with rasterio.open(write(capture, cut, moved)) as written:
        assert written.nodata is None


def rig_between(low_px: float, high_px: float) -> Rig:
    """One band that moves to the right as the ground comes nearer."""
    middle, std_px = (low_px + high_px) / 2, {"nir": 0.1}
    factors = [(v - middle, 0.0, 0.0, 0.0, 0.0) for v in (low_px, middle, high_px)]
    captures = tuple(CaptureFactors(float(k), None, None, f) for k, f in enumerate(factors))
    mean, baselines = {"nir": geometry.translation(middle, 0)}, {"nir": (1.0, 0.0)}
    return Rig((120, 90), mean, baselines, {"nir": 0.0}, std_px, ("distance",), captures, std_px)


def test_all_captures_of_a_flight_have_one_geometry(capture: Capture) -> None:
    limits = flight_limits([([capture], rig_between(2.0, 12.0))])

    def grids_of(*shifts_px: float, crop: str = "flight") -> list[OutputGrid]:
        common = common_grid(capture.reference, WriteSettings(crop=crop), limits)
        return [output_of(capture, shift_px, common, crop=crop)[1] for shift_px in shifts_px]

    grids = grids_of(2.0, 7.0, 12.0)
    assert len(set(grids)) == 1
    assert not grids[0].has_gaps
    # The farthest band leaves 12 px at the right; two more are left for captures that the rig has not seen.
    assert 120 - (grids[0].x0 + grids[0].width) in range(13, 17)
    near, far = grids_of(2.0, 12.0, crop="common")
    assert near.width > far.width
    # A capture beyond those of the rig keeps the geometry, and declares nodata.
    (beyond,) = grids_of(30.0)
    assert beyond == replace(grids[0], has_gaps=True)


def test_flights_and_captures_without_a_band_have_the_size_of_their_camera(capture: Capture) -> None:
    """Two flights at other heights, one without a rig, captures without a band, and pixels of a finer band."""
    without = replace(capture, bands=(capture.reference,), missing_bands=("nir",))
    rigs = rig_between(2.0, 12.0), rig_between(6.0, 20.0)
    flights = [([capture, without], rigs[0]), ([without, capture], rigs[1]), ([capture], None)]
    for write in ({}, {"resolution": "finest"}):
        common = common_grid(capture.reference, WriteSettings(**write), flight_limits(flights))
        grids = [output_of(c, s, common, **write)[1] for c, s in ((capture, 3.0), (capture, 19.0), (without, 0.0))]
        assert len({(g.x0, g.y0, g.width, g.height, g.scale) for g in grids}) == 1
        assert 120 - (grids[0].x0 + grids[0].width) in range(21, 25)
    green, nir = (replace(band, lens=None) for band in capture.bands)
    finer = replace(capture, bands=(green, replace(nir, width_px=240, height_px=180)))
    limits = flight_limits([([finer], replace(rigs[0], mean={"nir": np.diag([2.0, 2.0, 1.0])}))])
    layers, grid = output_of(finer, 3.0, common_grid(green, WriteSettings(**write), limits), **write)
    assert grid.scale == (2.0, 2.0)
    assert {layer.size_px for layer in layers} == {(240, 180)}, "the output before the crop"


# ---- standard error, and a full disk


def test_standard_error_belongs_to_the_caller(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Another thread writes more than a pipe holds while a raster is written: all of it arrives, at once."""
    lines = b"".join(b"line %d\n" % k for k in range(20_000))

    def blocks() -> Iterator[Block]:
        thread = threading.Thread(target=os.write, args=(2, lines))
        thread.start()
        thread.join()
        assert capfd.readouterr().err == lines.decode()
        yield np.ones((90, 120), np.float32), 1, 0, 0

    write_on_grid(tmp_path / "a.tif", OutputGrid(0, 0, 120, 90), None, [LayerDescription("a")], blocks())


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX")
@pytest.mark.parametrize("file_format", ["gtiff", "cog"])
def test_a_full_disk_is_one_error_at_any_size(
    file_format: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """libtiff prints nothing, and no file is left."""
    import resource

    capture, out = make_capture(tmp_path), tmp_path / "out"
    context = context_of(capture, {}, grid=CROP, statistics=True, format=file_format)
    write_raster(context, layers_of(capture), out / "a.tif")
    size = (out / "a.tif").stat().st_size
    (out / "a.tif").unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (0, 1, 7, 8, 100, *range(1000, size, size // 12)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        try:
            with pytest.raises(OutputError, match=r"a\.tif: cannot be written \(.*; is the disk full\?\)|too large"):
                write_raster(context, layers_of(capture), out / "a.tif")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(out.iterdir())
    assert capfd.readouterr().err == ""
