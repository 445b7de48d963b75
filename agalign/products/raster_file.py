"""One aligned raster on the reference's pixel grid, a tiled GeoTIFF or COG: written, then checked to be complete."""

import errno
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.fill import fillnodata
from rasterio.shutil import copy as copy_dataset
from rasterio.transform import Affine
from rasterio.windows import Window

from agalign.cameras.tag_transfer import TransferredTags
from agalign.cameras.tiff_directory import add_directories
from agalign.config import WriteSettings
from agalign.errors import OutputError
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import GDAL_ENVIRONMENT, open_raster, read_window, why, without_warnings
from agalign.pixels.resample import resample_tile, tiles
from agalign.products.indices import Role, role_of
from agalign.products.layout import Layer
from agalign.products.nodata import Pixels, nodata_value, with_nodata
from agalign.products.quiet_libtiff import without_libtiffs_lines
from agalign.products.raster_tags import describe, georeference_tags
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Georeference
from agalign.values.files import complete_file
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.mapping import PixelMapping

GEOTIFF = "image/tiff; application=geotiff"
COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_TILE_PX = 256
"""Side of the tiles within a TIFF: GDAL's default, which viewers read quickly."""
_WORK_TILE_PX = 2048
"""Side of the tiles in which moving bands are resampled: it bounds the memory."""
_FILL_DISTANCE_PX = 100.0
"""From which occluded pixels are interpolated: GDAL's default, wider than any occlusion."""
_COG_TILE_PX = 512
"""GDAL's default for a COG."""
_INCOMPLETE = "the file came out incomplete; is the disk full?"

_COLOURS: Mapping[Role, ColorInterp] = {
    "red": ColorInterp.red, "green": ColorInterp.green, "blue": ColorInterp.blue,
}  # fmt: skip


def write_raster(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, path: Path, settings: WriteSettings,
    tags: TransferredTags | None = None,
) -> float | None:  # fmt: skip
    """Write layers as the bands of one file atomically; return its nodata value.

    The type is the layers' where all share it, else the smallest that holds them all; float32 after radiometry. A
    nodata value is declared only where some pixel needs it; valid moving pixels that happen to equal it change by
    the smallest step. A COG gets no tags that GDAL does not write: they would break its layout.
    Raises OutputError, or UnreadableFileError for an input.
    """
    raw = settings.radiometry == "off"
    dtype = np.result_type(*(layer.band.dtype for layer in layers)) if raw else np.dtype(np.float32)
    nodata = nodata_value(capture, layers, grid, dtype, settings)
    compression = _compression(settings, all_bands=len(layers) == len(capture.bands))
    profile = _profile(capture.reference, len(layers), grid, dtype, nodata, compression)
    try:
        with complete_file(path) as partial, without_libtiffs_lines():
            checksums = PixelChecksums()
            with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT):
                with rasterio.open(partial, "w", **profile) as dataset:
                    describe(dataset, capture, layers, settings)
                    if len(layers) > 1:
                        dataset.colorinterp = _colours(layers)
                    for index, layer in enumerate(layers, start=1):
                        _write_layer(dataset, index, layer, grid, nodata, settings, checksums)
                if capture.reference.overviews and settings.format == "gtiff":
                    with rasterio.open(partial, "r+") as dataset:
                        dataset.build_overviews(list(capture.reference.overviews), Resampling.average)
                check_complete(partial)
                if tags is not None:
                    add_directories(partial, tags.first, tags.exif, tags.gps)
                if settings.format == "cog":
                    _to_cog(partial, compression)
            check_complete(partial)
            checksums.check(partial)
    except (RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({why(error)})") from None
    return nodata


def _colours(layers: Sequence[Layer]) -> list[ColorInterp]:
    """Red, green and blue where all three are there, of the first band of each: viewers show them as such."""
    roles = [None if b.companion else role_of(b.name, b.wavelength_nm) for b in (layer.band for layer in layers)]
    result = [ColorInterp.gray, *[ColorInterp.undefined] * (len(layers) - 1)]
    if not set(_COLOURS) <= set(roles):
        return result
    result[0] = ColorInterp.undefined
    for role, colour in _COLOURS.items():
        result[roles.index(role)] = colour
    return result


def write_layers(
    path: Path, layers: Mapping[str, NDArray[np.float32]], grid: OutputGrid, georeference: Georeference | None,
    units: Mapping[str, str] | None = None, tags: Mapping[str, Mapping[str, str]] | None = None,
) -> None:  # fmt: skip
    """Write float32 layers (height, width) by name, with their units and tags atomically; nan is nodata.

    Raises OutputError.
    """
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": len(layers), "dtype": "float32",
        "tiled": True, "blockxsize": _TILE_PX, "blockysize": _TILE_PX, "compress": "deflate", "predictor": 3,
        "nodata": np.nan,
    }  # fmt: skip
    profile |= {} if georeference is None else georeferenced(georeference, grid)
    try:
        with complete_file(path) as partial, without_libtiffs_lines():
            checksums = PixelChecksums()
            with (
                without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(partial, "w", **profile) as dataset,
            ):  # fmt: skip
                dataset.update_tags(**georeference_tags(georeference))
                for index, (name, values) in enumerate(layers.items(), start=1):
                    checksums.write(dataset, values, index, Window(0, 0, grid.width, grid.height))
                    dataset.set_band_description(index, name)
                    if units is not None:
                        dataset.set_band_unit(index, units[name])
                    if tags is not None:
                        dataset.update_tags(index, **tags[name])
            check_complete(partial)
            checksums.check(partial)
    except (RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({why(error)})") from None


def write_flags(
    path: Path, names: Sequence[str], grid: OutputGrid, georeference: Georeference | None, tags: Mapping[str, str],
    flags_on: Callable[[Tile], Sequence[NDArray[np.uint16]]],
) -> None:  # fmt: skip
    """Write uint16 layers with these names atomically; `flags_on` returns them (height, width) on a tile
    of the grid. They have no nodata value: 0 is a pixel without any flag.

    Raises OutputError.
    """
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": len(names), "dtype": "uint16",
        "tiled": True, "blockxsize": _TILE_PX, "blockysize": _TILE_PX, "compress": "deflate", "interleave": "band",
        "bigtiff": "if_safer",
    }  # fmt: skip
    profile |= {} if georeference is None else georeferenced(georeference, grid)
    try:
        with complete_file(path) as partial, without_libtiffs_lines():
            checksums = PixelChecksums()
            with (
                without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(partial, "w", **profile) as dataset,
            ):  # fmt: skip
                dataset.update_tags(**tags, **georeference_tags(georeference))
                for index, name in enumerate(names, start=1):
                    dataset.set_band_description(index, name)
                for tile in tiles(grid.tile, _WORK_TILE_PX):
                    window = Window(tile.x0 - grid.x0, tile.y0 - grid.y0, tile.width, tile.height)
                    for index, flags in enumerate(flags_on(tile), start=1):
                        checksums.write(dataset, flags, index, window)
            check_complete(partial)
            checksums.check(partial)
    except (RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({why(error)})") from None


def media_type(settings: WriteSettings) -> str:
    """Return the media type of the files that `write_raster` writes."""
    return COG if settings.format == "cog" else GEOTIFF


def check_complete(path: Path) -> None:
    """Raise OSError for a TIFF in which a tile or strip is missing or cut off.

    GDAL flushes when a file is closed, and a failure then (a full disk) raises nothing.
    """
    size = path.stat().st_size
    with tifffile.TiffFile(path) as tiff:
        segments = [s for page in tiff.pages for s in zip(page.dataoffsets, page.databytecounts, strict=True)]
    if not segments or any(count == 0 or offset + count > size for offset, count in segments):
        raise OSError(errno.EIO, _INCOMPLETE)


class PixelChecksums:
    """Checksums of pixels as they are written, and the comparison with the finished file.

    GDAL keeps tiles in memory and writes the last ones when it closes a file. Where that write fails once, it reports
    no error and fills the tile with zeros.
    """

    def __init__(self) -> None:
        self._written: list[tuple[int, Window, int]] = []

    def write(self, dataset: Any, pixels: Pixels, index: int, window: Window) -> None:
        """Write the pixels of a band, from 1, into a window of an open dataset."""
        dataset.write(pixels, index, window=window)
        self._written.append((index, window, _checksum(pixels)))

    def check(self, path: Path) -> None:
        """Raise OSError where the file does not have the pixels that were written."""
        with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(path) as dataset:
            for index, window, checksum in self._written:
                if _checksum(dataset.read(index, window=window)) != checksum:
                    raise OSError(errno.EIO, _INCOMPLETE)


def _checksum(pixels: Pixels) -> int:
    return zlib.crc32(np.ascontiguousarray(pixels).data.cast("B"))


def georeferenced(georeference: Georeference, grid: OutputGrid) -> dict[str, Any]:
    """Return rasterio's `transform` and `crs` of an output grid, given the georeference of the reference's file."""
    # Only where the source has one: an identity transform would be an invented georeference.
    # Geotransforms count from corners, where a change of resolution is a mere factor.
    shrunk = np.diag([1 / grid.scale.x, 1 / grid.scale.y, 1.0])
    written = georeference.transform @ shrunk @ geometry.translation(grid.x0, grid.y0)
    return {"transform": Affine(*written[:2].ravel()), "crs": rasterio.CRS.from_wkt(georeference.crs_wkt)}


def _write_layer(
    dataset: Any, index: int, layer: Layer, grid: OutputGrid, nodata: float | None, settings: WriteSettings,
    checksums: PixelChecksums,
) -> None:  # fmt: skip
    dtype = np.dtype(dataset.dtypes[0])
    for tile in tiles(grid.tile, _WORK_TILE_PX):
        pixels, valid = _tile_of(layer, tile, settings)
        if pixels is None:
            pixels = np.full((tile.height, tile.width), 0 if nodata is None else nodata, dtype=dtype)
        elif nodata is not None and not (valid.all() and layer.is_copied):
            pixels = with_nodata(pixels.astype(dtype, copy=False), valid, nodata)
        window = Window(tile.x0 - grid.x0, tile.y0 - grid.y0, tile.width, tile.height)
        checksums.write(dataset, pixels.astype(dtype, copy=False), index, window)


def _tile_of(layer: Layer, tile: Tile, settings: WriteSettings) -> tuple[Pixels | None, Mask]:
    """A layer's pixels on a tile and their mask; no pixels for a gap."""
    if layer.is_gap:
        return None, np.zeros((tile.height, tile.width), dtype=bool)
    radiometry = None if settings.radiometry == "off" else layer.band.radiometry
    if layer.mapping is not None:
        pixels, valid = resample_tile(layer.band, layer.mapping, tile, settings.interpolation, radiometry)
        return (
            _with_occluded(pixels, valid, _fillable(layer, layer.mapping, tile))
            if settings.fill_occluded
            else (pixels, valid)
        )
    with open_raster(layer.band.path) as source:
        pixels, valid = read_window(source, layer.band, tile.x0, tile.y0, tile.width, tile.height)
    return pixels if radiometry is None else calibrated(pixels, radiometry, tile.x0, tile.y0), valid


def _fillable(layer: Layer, mapping: PixelMapping, tile: Tile) -> Mask:
    """(height, width) True for occluded pixels of a tile inside the image of the band: beyond it there is nothing."""
    positions = mapping.positions(tile)
    inside = ((positions >= 0) & (positions <= np.subtract(layer.band.size_px, 1))).all(axis=-1)
    return np.asarray(mapping.hidden(tile) & inside)


def _with_occluded(pixels: Pixels, valid: Mask, hidden: Mask) -> tuple[Pixels, Mask]:
    """Pixels and their mask with the hidden ones interpolated from valid ones around, by GDAL's inverse distances."""
    if not hidden.any() or not valid.any():
        return pixels, valid
    distance_px = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, 3)
    hidden = hidden & (distance_px < _FILL_DISTANCE_PX)
    filled = fillnodata(np.where(valid, pixels, 0).astype(np.float32), valid, _FILL_DISTANCE_PX)
    if pixels.dtype.kind in "iu":
        limits = np.iinfo(str(pixels.dtype))
        filled = np.clip(np.rint(filled), limits.min, limits.max)
    return np.where(hidden, filled, pixels).astype(pixels.dtype), valid | hidden


def _profile(
    reference: Band, count: int, grid: OutputGrid, dtype: np.dtype[Any], nodata: float | None, compression: str
) -> dict[str, Any]:
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": count, "dtype": dtype.name,
        "interleave": "band", "photometric": "minisblack", "bigtiff": "if_safer",
        "tiled": True, "blockxsize": _TILE_PX, "blockysize": _TILE_PX,
    }  # fmt: skip
    if nodata is not None:
        profile["nodata"] = nodata
    if compression != "none":
        profile |= {"compress": compression, "predictor": 3 if dtype.kind == "f" else 2}
        profile |= {"zstd_level": 1} if compression == "zstd" else {"zlevel": 6}
    if reference.georeference is not None:
        profile |= georeferenced(reference.georeference, grid)
    return profile


def _compression(settings: WriteSettings, *, all_bands: bool) -> str:
    """Files of single bands often go on to programs without Zstandard."""
    if settings.compression != "auto":
        return settings.compression
    return "zstd" if all_bands and settings.layout != "bands" else "deflate"


def _to_cog(path: Path, compression: str) -> None:
    cog = path.with_name(f"{path.name}.cog")
    options = {} if compression == "none" else {"compress": compression, "predictor": "yes"}
    try:
        copy_dataset(path, cog, driver="COG", blocksize=_COG_TILE_PX, bigtiff="if_safer", **options)
        cog.replace(path)
    finally:
        cog.unlink(missing_ok=True)
