"""GeoTIFFs that appear complete or not at all: each finished file is read back and compared with what was written."""

import errno
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from agalign.errors import OutputError
from agalign.pixels.raster import GDAL_ENVIRONMENT, innermost_cause, without_warnings
from agalign.products.quiet_libtiff import without_libtiff_messages
from agalign.values import geometry
from agalign.values.capture import Georeference
from agalign.values.files import complete_file
from agalign.values.image import OutputGrid

_BLOCK_PX = 256
"""Side of the blocks within a GeoTIFF: GDAL's default."""
_INCOMPLETE = "the file came out incomplete; is the disk full?"


class CheckedRaster:
    """An open rasterio dataset with the checksums of the pixels that were written to it.

    GDAL keeps blocks in memory and writes the last ones when it closes a file. Where that write fails once, GDAL
    reports no error and fills the block with zeros.
    """

    def __init__(self, dataset: Any) -> None:
        self.dataset = dataset
        self._written: list[tuple[int, Window, int]] = []

    def write(self, pixels: NDArray[Any], index: int, x0: int = 0, y0: int = 0) -> None:
        """Write pixels (height, width) into band `index`, counted from 1, with the top-left pixel at (x0, y0)."""
        window = Window(x0, y0, pixels.shape[1], pixels.shape[0])
        self.dataset.write(pixels, index, window=window)
        self._written.append((index, window, _checksum(pixels)))

    def verify(self, path: Path) -> None:
        """Raise OSError if the finished file does not contain the pixels that were written."""
        with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(path) as dataset:
            for index, window, checksum in self._written:
                if _checksum(dataset.read(index, window=window)) != checksum:
                    raise OSError(errno.EIO, _INCOMPLETE)


@contextmanager
def checked_raster(
    path: Path, profile: dict[str, Any], finish: Callable[[Path], None] | None = None
) -> Iterator[CheckedRaster]:
    """Create a GeoTIFF with a rasterio profile. After the block it is closed, changed by `finish`, verified and renamed
    to `path`.

    Raises OutputError.
    """
    try:
        with complete_file(path) as partial, without_libtiff_messages():
            with (
                without_warnings(),
                rasterio.Env(**GDAL_ENVIRONMENT),
                rasterio.open(partial, "w", **profile) as dataset,
            ):
                raster = CheckedRaster(dataset)
                yield raster
            check_complete(partial)
            if finish is not None:
                finish(partial)
                check_complete(partial)
            raster.verify(partial)
    except (RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({innermost_cause(error)})") from None


def check_complete(path: Path) -> None:
    """Raise OSError for a TIFF in which a tile or strip is missing or truncated.

    GDAL flushes when a file is closed, and a failure at that time, such as a full disk, raises nothing.
    """
    size = path.stat().st_size
    with tifffile.TiffFile(path) as tiff:
        segments = [s for page in tiff.pages for s in zip(page.dataoffsets, page.databytecounts, strict=True)]
    if not segments or any(count == 0 or offset + count > size for offset, count in segments):
        raise OSError(errno.EIO, _INCOMPLETE)


def tiled_profile(width: int, height: int, count: int, dtype: str, **options: Any) -> dict[str, Any]:
    """Return rasterio's profile of a tiled GeoTIFF with these further creation options."""
    return {
        "driver": "GTiff", "width": width, "height": height, "count": count, "dtype": dtype, "tiled": True,
        "blockxsize": _BLOCK_PX, "blockysize": _BLOCK_PX, "bigtiff": "if_safer", **options,
    }  # fmt: skip


def grid_profile(
    grid: OutputGrid, georeference: Georeference | None, count: int, dtype: str, **options: Any
) -> dict[str, Any]:
    """Return the profile of a tiled GeoTIFF on an output grid, given the georeference of the reference's file.

    A file without a georeference gets no transform: an identity transform would be read as a georeference.
    """
    profile = tiled_profile(grid.width, grid.height, count, dtype, **options)
    return profile if georeference is None else profile | georeferenced(georeference, grid)


def georeferenced(georeference: Georeference, grid: OutputGrid) -> dict[str, Any]:
    """Return rasterio's `transform` and `crs` of an output grid, given the georeference of the reference's file."""
    # Geotransforms start at the corner of a pixel, so a change of resolution only scales them.
    scale = np.diag([1 / grid.scale.x, 1 / grid.scale.y, 1.0])
    transform = georeference.transform @ scale @ geometry.translation(grid.x0, grid.y0)
    return {"transform": Affine(*transform[:2].ravel()), "crs": rasterio.CRS.from_wkt(georeference.crs_wkt)}


def _checksum(pixels: NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(pixels).data.cast("B"))
