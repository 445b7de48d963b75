import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from PIL import Image

from agalign.cameras.tiff_directory import (
    EXIF,
    GPS,
    add_directories,
    byte_string,
    rational,
    read_directories,
    short,
    text,
)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
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


def test_a_jpegs_exif_is_read(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[271] = "Maker"
    exif.get_ifd(GPS)[1] = "S"
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(tmp_path / "x.jpg", exif=exif, xmp=b"packet")
    result = read_directories(tmp_path / "x.jpg")
    assert result[0][271].data == b"Maker\0"
    assert result[GPS][1].data == b"S\0"
    assert result[0][700].data == b"packet"


@pytest.mark.parametrize("content", [b"", b"II*\0", b"no tiff at all", struct.pack("<2sHI", b"II", 42, 10**6)])
def test_other_data_than_tiff_raises_value_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.tif"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"TIFF|ends"):
        read_directories(path)
