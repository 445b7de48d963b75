"""Tags of aligned bands as other programs see them, and the directories of files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from PIL import Image
from PIL.ExifTags import Base

from agalign.cameras.base import Camera
from agalign.cameras.discover import discover
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.micasense import MicaSense
from agalign.cameras.parrot import Sequoia
from agalign.cameras.pix4d import NAMESPACE, GridRows, GridVignetting, vignetting_of
from agalign.cameras.tag_transfer import _without_unset_clock, band_tags
from agalign.cameras.tiff_directory import (
    EXIF,
    GPS,
    XMP,
    add_directories,
    byte_string,
    rational,
    read_directories,
    short,
    text,
)
from agalign.pixels.raster import probe
from agalign.rasters.aligned_files import _correction
from agalign.values.capture import Band
from agalign.values.image import OutputGrid
from agalign.values.pixel_units import PixelScale

from .test_vendors import DJI, DLS, MICASENSE, SIZE, VENDORS, packet, write_capture, write_file

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def band_of(path: Path, camera: Camera | None = None) -> Band:
    """The band of a file of one band, by default of a MicaSense camera."""
    (band,) = (camera or MicaSense()).bands(path, read_tags(path), probe(path))
    return band


def test_the_stack_has_the_tags_that_all_bands_share(aligned_flight: Path) -> None:
    result = read_directories(aligned_flight / "0000SET" / "000" / "IMG_0001.tif")
    assert result[GPS][1].data == b"N\0"
    assert 36867 in result[EXIF]
    assert 33434 not in result[EXIF]  # each band was exposed for a time of its own
    assert 700 not in result[0]
    assert result[0][272].data == b"RedEdge-M\0"


UNCHANGED = OutputGrid(0, 0, *SIZE)


def transferred(source: Path, reference: Band | Path, grid: OutputGrid, out: str = "out.tif", **options: Any) -> Path:
    """Write a file with the tags of the source on a grid of the reference."""
    band = Band("reference", reference, 1, *SIZE, "uint16") if isinstance(reference, Path) else reference
    tags = band_tags(replace(band, path=source), band, grid, GridVignetting((80, 60), (1e-4,), 0), **options)
    path = write_file(source.parent / out, shape=(grid.height, grid.width))
    add_directories(path, *tags)
    return path


def carried(tmp_path: Path, vendor: str, file: str, reference: str, grid: OutputGrid) -> Tags:
    """The tags of a file that got what is carried from `file`."""
    write_capture(tmp_path, VENDORS[vendor])
    return read_tags(transferred(tmp_path / file, tmp_path / reference, grid))


def test_djis_geometry_is_the_references(tmp_path: Path) -> None:
    grid = OutputGrid(20, 10, 200, 180, scale=PixelScale(2.0, 2.0))
    prefix = "DJI_20230607112233_0001_MS_"
    result = carried(tmp_path, "Mavic 3", f"{prefix}NIR.TIF", f"{prefix}G.TIF", grid)
    assert result.text(NAMESPACE, "BandName") == "NIR"
    assert result.number(DJI, "CalibratedOpticalCenterX") == 2 * 80.5 - 0.5 - 20
    assert result.number(DJI, "CalibratedOpticalCenterY") == 2 * 60.5 - 0.5 - 10
    assert result.text(DJI, "DewarpData") == "2022-09-08;340,340,3,-5,-0.1,0.05,0,0,0"
    # The pixel (80, 60) of the camera, in the plane that the bands share: 1.5 px to the right, 2 px up.
    at_px = np.reshape(result.numbers(DJI, "CalibratedHMatrix"), (3, 3)) @ [*grid.px(80.0, 60.0), 1.0]
    assert at_px[:2] / at_px[2] == pytest.approx((81.5, 58.0))


@pytest.mark.parametrize(
    ("grid", "expected_px"),
    [
        # Stored: (160 - 80, 120 - 58.67) - (30, 20); seen upright it counts from 120, 90.
        (OutputGrid(30, 20, 120, 90), (120 - (160 - 80.0 - 30), 90 - (120 - 58.667 - 20))),
        # Twice as many pixels: 2 (p + 0.5) - 0.5 in both orientations, as pixel centres are at whole numbers.
        (OutputGrid(0, 0, 320, 240, scale=PixelScale(2.0, 2.0)), (2 * (80.0 + 0.5) - 0.5, 2 * (58.667 + 0.5) - 0.5)),
    ],
)
def test_upside_down_principal_points(tmp_path: Path, grid: OutputGrid, expected_px: tuple[float, float]) -> None:
    files = "IMG_180413_080658_0000_NIR.TIF", "IMG_180413_080658_0000_GRE.TIF"
    result = carried(tmp_path, "Sequoia", *files, grid)
    point_px = [v * 266.67 * grid.scale.x for v in result.numbers(NAMESPACE, "PrincipalPoint")]
    assert point_px == pytest.approx(expected_px, abs=0.02)
    assert result.orientation == 3


def test_undistorted_pixels_have_no_distortion(tmp_path: Path) -> None:
    undistorted = replace(UNCHANGED, undistorted=True)
    result = carried(tmp_path, "RedEdge", "IMG_0007_4.tif", "IMG_0007_2.tif", undistorted)
    assert result.numbers(NAMESPACE, "PerspectiveDistortion") == (0.0,) * 5


def test_tags_of_applied_radiometry_are_removed(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["RedEdge"])
    values = {(NAMESPACE, "VignettingCenter"): ("80", "60"), (NAMESPACE, "BandName"): ("NIR",)}
    values[MICASENSE, "RadiometricCalibration"] = "1", "2", "3"
    source = tmp_path / "IMG_0007_4.tif"
    add_directories(source, {XMP: byte_string(packet(values, "sequences")), 50714: short(5)}, {}, {})
    for radiometry in (False, True):
        result = read_tags(transferred(source, tmp_path / "IMG_0007_2.tif", UNCHANGED, radiometry=radiometry))
        assert ((NAMESPACE, "VignettingCenter") in result.xmp) != radiometry
        assert ((MICASENSE, "RadiometricCalibration") in result.xmp) != radiometry
        assert (result.black_level is None) == radiometry


@pytest.mark.parametrize(
    ("grid", "expected"),
    [
        (UNCHANGED, 40),
        (OutputGrid(10, 10, 128, 96), 50),
        (OutputGrid(20, 20, 256, 192, scale=PixelScale(2.0, 2.0)), 50),
        (OutputGrid(0, 0, 320, 240, scale=PixelScale(2.0, 2.0)), 40),
    ],
)
def test_the_focal_length_in_35_mm_film_is_that_of_the_cropped_image(
    tmp_path: Path, grid: OutputGrid, expected: int
) -> None:
    """A smaller part of the sensor is as if taken with a longer focal length."""
    source = write_file(tmp_path / "a.tif")
    add_directories(source, {}, {Base.FocalLengthIn35mmFilm: short(40)}, {})
    assert read_tags(transferred(source, source, grid)).exif["FocalLengthIn35mmFilm"] == expected


def test_one_unit_is_that_of_all_irradiances(tmp_path: Path) -> None:
    """A DLS 2 counts in 0.01 W / m^2 / nm, also in the tag of the camera that it copies."""
    write_capture(tmp_path, VENDORS["RedEdge"])
    source = tmp_path / "IMG_0007_4.tif"
    written = {(NAMESPACE, "BandName"): ("NIR",), (NAMESPACE, "Irradiance"): ("62.5",)}
    written |= {(DLS, "SpectralIrradiance"): ("62.5",), (DLS, "HorizontalIrradiance"): ("67.3",)}
    add_directories(source, {271: text("MicaSense"), XMP: byte_string(packet(written, "elements"))}, {}, {})
    result = read_tags(transferred(source, tmp_path / "IMG_0007_2.tif", UNCHANGED))
    unit = result.number(NAMESPACE, "IrradianceScaleToSIUnits")
    assert result.number(NAMESPACE, "HorizontalIrradiance") * unit == pytest.approx(0.673)
    assert result.number(NAMESPACE, "Irradiance") * unit == pytest.approx(0.625)


APPLIED = [(NAMESPACE, name) for name in ("RadiometricCalibration", "IsNormalized", "BandSensitivity")]
APPLIED += [(DJI, name) for name in ("SensorGainAdjustment", "VignettingFlag")]


def test_tags_of_factors_in_the_pixels_are_removed(tmp_path: Path) -> None:
    """DJI writes its gain adjustment under two names, and that the pixels are not calibrated."""
    write_capture(tmp_path, VENDORS["Phantom 4"])
    source, reference = tmp_path / "DJI_0015.TIF", tmp_path / "DJI_0012.TIF"
    values = dict.fromkeys(APPLIED, ("0",)) | {(DJI, "SensorGain"): ("2",)}
    add_directories(source, {XMP: byte_string(packet(values, "attributes"))}, {}, {})
    for radiometry in (False, True):
        result = read_tags(transferred(source, reference, UNCHANGED, radiometry=radiometry))
        assert [name for name in APPLIED if name in result.xmp] == ([] if radiometry else APPLIED)
        assert result.number(DJI, "SensorGain") == 2


def test_the_row_gradient_is_that_of_the_new_rows(tmp_path: Path) -> None:
    """Row 10 of a file with twice as many rows, cropped, is row 45 of the band's own file."""
    write_capture(tmp_path, VENDORS["RedEdge"])
    values = {(NAMESPACE, "BandName"): ("NIR",), (MICASENSE, "RadiometricCalibration"): ("2e-4", "1e-7", "-5e-5")}
    source, exposure_s = tmp_path / "IMG_0007_4.tif", 1e-3
    tags = {XMP: byte_string(packet(values, "sequences"))}
    add_directories(source, tags, {Base.ExposureTime: rational(exposure_s)}, {})
    result = read_tags(transferred(source, tmp_path / "IMG_0007_2.tif", UNCHANGED, rows=GridRows(40.0, 0.5)))

    def gain(a1: float, a2: float, a3: float, y: float) -> float:
        return a1 / (1 + a2 * y / exposure_s - a3 * y)

    coefficients = result.numbers(MICASENSE, "RadiometricCalibration", 3)
    for row in (0, 10, 100):
        assert gain(*coefficients, row) == pytest.approx(gain(2e-4, 1e-7, -5e-5, 40 + row / 2), rel=1e-6)


@pytest.mark.parametrize(("bits", "factor"), [(12, 16), (16, 1)])
def test_numbers_of_12_bits_in_a_file_of_16_bits_have_their_radiance(tmp_path: Path, bits: int, factor: int) -> None:
    """Programs divide by 2 ** BitsPerSample."""
    source = tmp_path / "IMG_0007_2.tif"
    with rasterio.open(source, "w", width=SIZE[0], height=SIZE[1], count=1, dtype="uint16", nbits=bits) as dataset:
        dataset.write(np.full((1, *SIZE[::-1]), 1000, np.uint16))
    values = {(NAMESPACE, "BandName"): ("Green",), (MICASENSE, "RadiometricCalibration"): ("2e-4", "1e-7", "-5e-5")}
    first = {271: text("MicaSense"), XMP: byte_string(packet(values, "sequences")), 50714: short(300)}
    add_directories(source, first, {Base.ExposureTime: rational(1e-3), 34855: short(100)}, {})
    result = read_tags(transferred(source, band_of(source), UNCHANGED))
    expected = 2e-4 * factor, 1e-7, -5e-5
    assert result.numbers(MICASENSE, "RadiometricCalibration", 3) == pytest.approx(expected)
    assert result.black_level == 300


def test_an_undistorted_fisheye_is_a_pinhole(tmp_path: Path) -> None:
    write_capture(tmp_path, VENDORS["Sequoia"])
    path = tmp_path / "IMG_180413_080658_0000_GRE.TIF"
    reference = band_of(path, Sequoia())
    out = transferred(path, reference, replace(UNCHANGED, undistorted=True), "out_GRE.TIF")
    result = band_of(out, Sequoia())
    assert not any(result.lens.distortion)
    assert result.lens.fx_px == pytest.approx(reference.lens.fx_px, rel=1e-6)
    assert result.lens.cx_px == pytest.approx(reference.lens.cx_px, abs=1e-3)


def test_a_focal_length_in_px_is_scaled_with_the_grid(tmp_path: Path) -> None:
    values = {(NAMESPACE, "PrincipalPoint"): ("2.4", "1.8"), (NAMESPACE, "PerspectiveFocalLength"): ("1451.8",)}
    first = {271: text("MicaSense"), XMP: byte_string(packet(values, "elements"))}
    path = write_file(tmp_path / "IMG_0001_2.tif", first, {37386: rational(5.45)})
    before = band_of(path)
    doubled = OutputGrid(40, 30, 200, 150, scale=PixelScale(2.0, 2.0))
    after = band_of(transferred(path, before, doubled, "IMG_0002_2.tif"))
    assert after.lens.fx_px == pytest.approx(2 * before.lens.fx_px)
    assert after.lens.cx_px == pytest.approx(2 * (before.lens.cx_px + 0.5) - 0.5 - 40, abs=1e-3)


@pytest.mark.parametrize("centre", [("1e14", "1e14"), ("nan", "0"), ("99999", "99999")])
def test_a_centre_of_vignetting_without_position_is_omitted(tmp_path: Path, centre: tuple[str, str]) -> None:
    values = {(NAMESPACE, "VignettingCenter"): centre, (NAMESPACE, "VignettingPolynomial"): ("1e-4",)}
    first = {271: text("MicaSense"), XMP: byte_string(packet(values, "elements"))}
    path = write_file(tmp_path / "IMG_0001_2.tif", first)
    assert vignetting_of(read_tags(path), SIZE) is None
    band = Band("Green", path, 1, *SIZE, "uint16")
    first, _, _ = band_tags(band, band, OutputGrid(0, 0, *SIZE), None)
    assert b"Vignetting" not in first[XMP].data


# ---- directories of TIFF files


PIXELS = np.arange(100 * 80, dtype=np.uint16).reshape(80, 100)
FIRST = {271: text("Maker"), 700: byte_string(b"<x:xmpmeta xmlns:x='adobe:ns:meta/'/>"), 50714: short(1, 2, 3, 4)}
PLACE = {1: text("N"), 2: rational(52, 30, 12.5), 3: text("E"), 4: rational(5, 0, 1.25), 6: rational(31.5)}


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_other_libraries_read_added_tags_and_pixels_are_unchanged(tmp_path: Path, order: str, big: bool) -> None:
    path = tmp_path / "x.tif"
    tifffile.imwrite(path, PIXELS, byteorder=order, bigtiff=big, metadata=None)
    add_directories(path, FIRST, {33434: rational(0.0013), 36867: text("2026:06:21 10:00:00")}, PLACE)
    np.testing.assert_array_equal(tifffile.imread(path), PIXELS)
    with tifffile.TiffFile(path) as tiff:
        tags = {tag.code: tag.value for tag in tiff.pages[0].tags.values()}
    assert tags[271] == "Maker"
    assert tags[50714] == (1, 2, 3, 4)
    assert tags[EXIF]["ExposureTime"] == (1300, 1000000)
    assert tags[GPS]["GPSLatitude"] == (52000000, 1000000, 30000000, 1000000, 12500000, 1000000)
    with rasterio.open(path) as dataset:
        np.testing.assert_array_equal(dataset.read(1), PIXELS)
        if not big:  # in a BigTIFF Pillow and GDAL take them for classic ones
            assert dataset.tags(ns="EXIF")["EXIF_ExposureTime"] == "(0.0013)"
    if not big:
        with Image.open(path) as image:
            assert image.getexif().get_ifd(GPS)[4] == (5.0, 0.0, 1.25)
    result = read_directories(path)
    assert result[GPS] == PLACE
    assert {tag: result[0][tag] for tag in FIRST} == FIRST


def test_directories_that_follow_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "pages.tif"
    with tifffile.TiffWriter(path) as writer:
        for page in (PIXELS, PIXELS + 1):
            writer.write(page, metadata=None)
    add_directories(path, FIRST, {}, PLACE)
    with tifffile.TiffFile(path) as tiff:
        assert len(tiff.pages) == 2
        np.testing.assert_array_equal(tiff.pages[1].asarray(), PIXELS + 1)


ALL_TIMES = {Base.DateTimeOriginal, Base.DateTimeDigitized, Base.SubsecTimeOriginal}


@pytest.mark.parametrize(
    ("original", "digitised", "kept"),
    [
        ("2026:06:21 10:00:01", "0000:00:00 00:00:00", {Base.DateTimeOriginal, Base.SubsecTimeOriginal}),
        ("1970:01:01 00:01:21", "1970:01:01 00:01:21", set()),
        ("2026:06:21 10:00:01", "2026:06:21 10:00:01", ALL_TIMES),
    ],
)
def test_only_dates_of_a_clock_that_was_not_set_are_removed(original: str, digitised: str, kept: set[int]) -> None:
    times = {Base.DateTimeOriginal: text(original), Base.DateTimeDigitized: text(digitised)}
    directory = {**times, Base.SubsecTimeOriginal: text("25"), Base.FNumber: text("2")}
    assert set(_without_unset_clock(directory)) == kept | {Base.FNumber}


def test_the_vignetting_of_a_resized_image_is_that_of_its_calibration(flight: Path) -> None:
    band, half = discover(flight).captures[0].bands[0], PixelScale(0.5, 0.5)
    by_file = vignetting_of(read_tags(band.path), band.size_px)
    assert any(by_file.vignetting)
    small = replace(band, width_px=band.width_px // 2, height_px=band.height_px // 2)
    small = replace(small, radiometry=band.radiometry.rescaled(half))
    for one, expected in ((band, by_file), (small, by_file.rescaled(half))):
        correction = _correction(one)
        assert correction.vignetting == pytest.approx(expected.vignetting)
        assert correction.vignetting_centre_px == pytest.approx(expected.vignetting_centre_px)
        assert (correction.black_level, correction.gain) == (by_file.black_level, 1.0)
