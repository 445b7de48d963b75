import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio._env import get_gdal_config

from agalign.errors import UnreadableFileError
from agalign.pixels.raster import open_raster, probe, read_for_alignment
from agalign.values.capture import Band

from ..conftest import textured_image, write_band

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_a_photograph_is_worth_refining_by_averaging(tmp_path: Path) -> None:
    scene = (128 + 30 * textured_image(640, 480)).clip(1, 254).astype(np.uint8)
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.stack([scene, scene // 2, scene // 3], axis=-1), [cv2.IMWRITE_JPEG_QUALITY, 98])
    band = Band("red", path, 3, 640, 480, "uint8")
    with rasterio.open(path) as file:
        whole = file.read(3).astype(np.float64)
    half = read_for_alignment(band, 320)
    assert half.size_px == (320, 240)
    np.testing.assert_allclose(half.pixels, whole.reshape(240, 2, 320, 2).mean((1, 3)), atol=0.51)
    # GDAL averages images with a mask; it uses the reductions of the JPEG decoder, which differ slightly.
    masked = read_for_alignment(replace(band, has_mask=True), 320)
    assert np.abs(half.pixels - masked.pixels).mean() < 1.5


@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float64"])
def test_images_of_each_type_are_reduced(tmp_path: Path, dtype: str) -> None:
    pixels = np.full((48, 64), 100, dtype)
    pixels[:, ::2] = 50
    write_band(tmp_path / "a.tif", pixels)
    (band,) = probe(tmp_path / "a.tif")
    half = read_for_alignment(band, 32)
    assert half.valid.all()
    np.testing.assert_allclose(half.pixels, 75, atol=1)


def test_metadata_of_a_file_is_read(tmp_path: Path) -> None:
    profile = {"driver": "GTiff", "width": 8, "height": 6, "count": 3, "dtype": "uint16"}
    with rasterio.open(tmp_path / "a.tif", "w", **profile) as file:
        file.update_tags(2, wavelength="0.84", wavelength_units="micrometers")
        file.update_tags(3, ns="IMAGERY", CENTRAL_WAVELENGTH_UM="0.717")
        file.set_band_description(1, "red")
    bands = probe(tmp_path / "a.tif")
    assert [(b.size_px, b.dtype, b.band_index) for b in bands] == [((8, 6), "uint16", k) for k in (1, 2, 3)]
    assert [b.name for b in bands] == ["red", "", ""]
    assert [b.wavelength_nm for b in bands] == [None, 840.0, 717.0]
    assert [b.georeference for b in bands] == [None, None, None]


def test_gdal_caches_megabytes_of_blocks_while_a_raster_is_open(tmp_path: Path) -> None:
    """GDAL_CACHEMAX as an integer is bytes: with 256 bytes GDAL decodes a block again for each line."""
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=8, height=6, count=1, dtype="uint16"):
        pass
    with open_raster(tmp_path / "a.tif"):
        assert get_gdal_config("GDAL_CACHEMAX") == 256 * 2**20


def test_a_decompression_bomb_is_refused_by_its_declared_size(tmp_path: Path) -> None:
    """GDAL decodes all pixels of a PNG before the last ones."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    path, side_px = tmp_path / "a_nir.png", 9000
    header = struct.pack(">IIBBBBB", side_px, side_px, 16, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(1000))), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    said = "declares 9000 x 9000 pixels, and a PNG of more than 67,108,864 is not decoded; convert it to TIFF"
    with pytest.raises(UnreadableFileError, match=said):
        probe(path)
