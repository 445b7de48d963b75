"""Writing GeoTIFFs: their profile, compression and metadata.

A file never appears incomplete: each finished one is read back and compared with what was written.
"""

import errno
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.shutil import copy as copy_dataset
from rasterio.transform import Affine
from rasterio.windows import Window

from agalign.errors import OutputError
from agalign.host.files import complete_file
from agalign.host.own_files import SOFTWARE
from agalign.pixels.gdal import gdal_name, innermost_cause, is_gdal_error, open_local
from agalign.values import geometry
from agalign.values.capture import Georeference
from agalign.values.choices import Compression
from agalign.values.image import OutputGrid

_INCOMPLETE = "the file came out incomplete; is the disk full?"
_ZSTD_LEVEL = 1
"""Higher levels take longer, and gain 2 %."""
_IMAGERY = {"wavelength": "CENTRAL_WAVELENGTH_UM", "fwhm": "FWHM_UM"}
"""Tags of GDAL's domain IMAGERY, micrometres, by the tag of a band in nanometres."""

Block = tuple[NDArray[Any], int, int, int]
"""Pixels (height, width), band of the raster from 1, and position (x, y) of their top-left pixel in the raster."""


@dataclass(frozen=True)
class LayerDescription:
    """Metadata of one band of a raster."""

    name: str
    unit: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Its wavelength and bandwidth are also written to GDAL's domain IMAGERY."""
    scale_offset: tuple[float, float] = (1.0, 0.0)
    """(scale, offset): value = scale * number in the file + offset."""
    colour: ColorInterp | None = None


def compressed(dtype: str, choice: Compression = "auto", *, is_stack: bool = False) -> dict[str, Any]:
    """Return the creation options of compressed pixels of a numpy type. With `auto`, they are zstd for a stack of all
    bands of a capture, else deflate.
    """
    # Programs that read files of single bands often lack Zstandard.
    method = choice if choice != "auto" else "zstd" if is_stack else "deflate"
    if method == "none":
        return {}
    # TIFF predictor 3 is for floating point, 2 for integers.
    options: dict[str, Any] = {"compress": method, "predictor": 3 if np.dtype(dtype).kind == "f" else 2}
    return options | ({"zstd_level": _ZSTD_LEVEL} if method == "zstd" else {})


FLOAT_OPTIONS: Mapping[str, Any] = {**compressed("float32"), "nodata": math.nan}
"""Creation options of layers of float32."""


@contextmanager
def checked_raster(
    path: Path,
    profile: dict[str, Any],
    layers: Sequence[LayerDescription],
    tags: Mapping[str, str],
    finish: Callable[[Path], None] | None = None,
) -> Iterator[tuple[Any, Callable[[NDArray[Any], int, int, int], None]]]:
    """Create a GeoTIFF with a rasterio profile; yield the dataset, and a function that writes a `Block` of pixels
    (height, width). After the `with` block it is closed, changed by `finish`, compared with what was written and
    renamed to `path`.

    GDAL keeps blocks in memory and writes the last ones when it closes a file. Where that write fails once, GDAL
    reports no error and fills the block with zeros.

    Raises OutputError.
    """
    written: list[tuple[int, Window, int]] = []
    with complete_file(path) as partial:
        try:
            with open_local(partial, "w", **profile) as file:
                _describe(file, layers, tags)

                def write(pixels: NDArray[Any], index: int, x0: int, y0: int) -> None:
                    window = Window(x0, y0, pixels.shape[1], pixels.shape[0])
                    file.write(pixels, index, window=window)
                    written.append((index, window, _checksum(pixels)))

                yield file, write
            check_complete(partial)
            if finish is not None:
                finish(partial)
                check_complete(partial)
            with open_local(partial) as file:
                if any(_checksum(file.read(index, window=window)) != known for index, window, known in written):
                    raise OSError(errno.EIO, _INCOMPLETE)
        except Exception as error:  # before `complete_file`: some errors of rasterio are OSErrors, without GDAL's cause
            if not is_gdal_error(error) and not isinstance(error, tifffile.TiffFileError):
                raise
            cause = innermost_cause(error).rstrip(".")
            is_refused = any(text in cause for text in ("not permitted", "denied", "Read-only"))
            hint = "" if is_refused else "; is the disk full?"
            raise OutputError(f"{path}: cannot be written ({cause}{hint})") from None


def _describe(dataset: Any, layers: Sequence[LayerDescription], tags: Mapping[str, str]) -> None:
    """Set the metadata of all bands, and the tags of the file that are not empty."""
    dataset.update_tags(**{k: v for k, v in tags.items() if v})
    if any(layer.scale_offset != (1.0, 0.0) for layer in layers):
        dataset.scales, dataset.offsets = zip(*(layer.scale_offset for layer in layers), strict=True)
    if any(layer.unit for layer in layers):
        dataset.units = [layer.unit for layer in layers]
    colours = [layer.colour for layer in layers]
    if None not in colours:
        dataset.colorinterp = colours
    for index, layer in enumerate(layers, start=1):
        dataset.set_band_description(index, layer.name)
        dataset.update_tags(index, **layer.tags)
        imagery = {um: f"{float(layer.tags[nm]) / 1000:g}" for nm, um in _IMAGERY.items() if nm in layer.tags}
        dataset.update_tags(index, ns="IMAGERY", **imagery)


def write_on_grid(
    path: Path,
    grid: OutputGrid,
    georeference: Georeference | None,
    layers: Sequence[LayerDescription],
    blocks: Iterable[Block],
    *,
    tags: Mapping[str, str] = {},
    dtype: str = "float32",
    options: Mapping[str, Any] = FLOAT_OPTIONS,
    finish: Callable[[Path], None] | None = None,
) -> None:
    """Write a tiled raster on an output grid block by block, with the georeference of the reference's file, as
    `checked_raster` does.

    A file without a georeference gets no transform: an identity transform would be read as a georeference. Tags mark
    one by the camera's pose as approximate. The tag of the software identifies the file. Raises OutputError.
    """
    profile = tiled_profile(grid.width, grid.height, len(layers), dtype, **options)
    all_tags = {"TIFFTAG_SOFTWARE": SOFTWARE, **tags}
    if georeference is not None:
        profile |= georeferenced(georeference, grid)
        if georeference.accuracy_m is not None:
            approximate = "approximate, from GPS position, altitude, yaw and focal length; no ground control"
            all_tags["GEOREFERENCE"] = approximate
            all_tags["GEOREFERENCE_ACCURACY_M"] = f"{georeference.accuracy_m:g}"
    with checked_raster(path, profile, layers, all_tags, finish) as (_, write):
        for block in blocks:
            write(*block)


def check_complete(path: Path) -> None:
    """Raise OSError for a TIFF in which a tile, a strip or the value of a tag is missing or truncated.

    GDAL flushes when a file is closed, and a failure at that time, such as a full disk, raises nothing.
    """
    size, segments, has_tags = path.stat().st_size, [], False
    with suppress(tifffile.TiffFileError, struct.error, IndexError), tifffile.TiffFile(path) as tiff:
        segments = [s for page in tiff.pages for s in zip(page.dataoffsets, page.databytecounts, strict=True)]
        tiff.filehandle.seek(tiff.pages.first.offset)
        (count,) = struct.unpack(tiff.tiff.tagnoformat, tiff.filehandle.read(tiff.tiff.tagnosize))
        has_tags = len(tiff.pages.first.tags) == count  # tifffile omits tags with values beyond the end of the file
    if not has_tags or not segments or any(count == 0 or offset + count > size for offset, count in segments):
        raise OSError(errno.EIO, _INCOMPLETE)


def tiled_profile(width: int, height: int, count: int, dtype: str, **options: Any) -> dict[str, Any]:
    """Return rasterio's profile of a tiled GeoTIFF with these further creation options."""
    size = {"width": width, "height": height, "count": count, "dtype": dtype}
    blocks = {"tiled": True, "blockxsize": 256, "blockysize": 256, "bigtiff": "if_safer"}  # GDAL's default size
    return {"driver": "GTiff"} | size | blocks | options


def georeferenced(georeference: Georeference, grid: OutputGrid) -> dict[str, Any]:
    """Return rasterio's `transform` and `crs` of an output grid, given the georeference of the reference's file."""
    # Geotransforms start at the corner of a pixel, so a change of resolution only scales them.
    scale = np.diag([1 / grid.scale.x, 1 / grid.scale.y, 1.0])
    transform = georeference.transform @ scale @ geometry.translation(grid.x0, grid.y0)
    return {"transform": Affine(*transform[:2].ravel()), "crs": rasterio.CRS.from_wkt(georeference.crs_wkt)}


def to_cog(path: Path) -> None:
    """Replace a GeoTIFF by a cloud-optimised one of its compression, with overviews. Errors are those of rasterio."""
    cog = path.with_name(f"{path.name}.cog")
    with open_local(path) as file:
        compression = file.profile.get("compress", "none")
    # GDAL's default size of blocks; its default compression is not none.
    options = {"blocksize": 512, "bigtiff": "if_safer", "compress": compression}
    if compression != "none":
        options["predictor"] = "yes"
    if compression == "zstd":
        options["level"] = _ZSTD_LEVEL
    try:
        copy_dataset(gdal_name(path), gdal_name(cog), driver="COG", **options)
        cog.replace(path)
    finally:
        cog.unlink(missing_ok=True)


def _checksum(pixels: NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(pixels).data.cast("B"))
