"""Rasters on the output grid: aligned bands as GeoTIFF or COG, layers of float32, and quality flags."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.fill import fillnodata
from rasterio.shutil import copy as copy_dataset

from agalign.cameras.tag_transfer import TransferredTags
from agalign.cameras.tiff_directory import add_directories
from agalign.config import WriteSettings
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import GDAL_ENVIRONMENT, read_tile, without_warnings
from agalign.pixels.resample import resample_tile
from agalign.products.checked_raster import CheckedRaster, checked_raster, grid_profile
from agalign.products.indices import Role, role_of
from agalign.products.layout import Layer
from agalign.products.nodata import Pixels, nodata_value, with_nodata
from agalign.products.raster_tags import describe, georeference_tags
from agalign.values.capture import Capture, Georeference
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.resample import tiles

GEOTIFF = "image/tiff; application=geotiff"
COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_WORK_TILE_PX = 2048
"""Side of the tiles that are processed one after another: it limits the memory."""
_FILL_DISTANCE_PX = 100.0
"""Search distance of the interpolation of occluded pixels: GDAL's default, wider than any occlusion."""
_COG_BLOCK_PX = 512
"""GDAL's default for a COG."""
_COLOURS: Mapping[Role, ColorInterp] = {
    "red": ColorInterp.red, "green": ColorInterp.green, "blue": ColorInterp.blue,
}  # fmt: skip


def write_raster(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, path: Path, settings: WriteSettings,
    tags: TransferredTags | None = None,
) -> float | None:  # fmt: skip
    """Write layers as the bands of one file atomically; return its nodata value.

    The type is that of the layers if all have the same, else the smallest type that represents them all; float32 after
    radiometric calibration. A nodata value is declared only if some pixel needs it; valid moving pixels that equal it
    change by the smallest step. A COG gets no `tags`: tags that GDAL does not write itself would break its layout.
    Raises OutputError, or UnreadableFileError for an input.
    """
    raw = settings.radiometry == "off"
    dtype = np.result_type(*(layer.band.dtype for layer in layers)) if raw else np.dtype(np.float32)
    nodata = nodata_value(capture, layers, grid, dtype, settings)
    compression = _compression(settings, all_bands=len(layers) == len(capture.bands))
    options: dict[str, object] = {"interleave": "band", "photometric": "minisblack"}
    if nodata is not None:
        options["nodata"] = nodata
    if compression != "none":
        options |= {"compress": compression, "predictor": predictor(dtype.kind)}
        options |= {"zstd_level": 1} if compression == "zstd" else {"zlevel": 6}

    overviews = list(capture.reference.overviews) if settings.format == "gtiff" else []

    def finish(partial: Path) -> None:
        if overviews or settings.statistics:
            with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(partial, "r+") as dataset:
                if settings.statistics:
                    dataset.stats(approx=False)  # GDAL stores in the file what it computes
                if overviews:
                    dataset.build_overviews(overviews, Resampling.average)
        if tags is not None:
            add_directories(partial, tags.first, tags.exif, tags.gps)
        if settings.format == "cog":
            _to_cog(partial, compression)

    profile = grid_profile(grid, capture.reference.georeference, len(layers), dtype.name, **options)
    with checked_raster(path, profile, finish) as raster:
        describe(raster.dataset, capture, layers, settings)
        if len(layers) > 1:
            raster.dataset.colorinterp = _colours(layers)
        for index, layer in enumerate(layers, start=1):
            _write_layer(raster, index, layer, grid, nodata, settings)
    return nodata


def write_layers(
    path: Path, layers: Mapping[str, NDArray[np.float32]], grid: OutputGrid, georeference: Georeference | None,
    units: Mapping[str, str] | None = None, tags: Mapping[str, Mapping[str, str]] | None = None,
) -> None:  # fmt: skip
    """Write float32 layers (height, width) by name, with their units and tags, atomically; nodata is nan.

    Raises OutputError.
    """
    options = {"compress": "deflate", "predictor": predictor("f"), "nodata": np.nan}
    with checked_raster(path, grid_profile(grid, georeference, len(layers), "float32", **options)) as raster:
        raster.dataset.update_tags(**georeference_tags(georeference))
        for index, (name, values) in enumerate(layers.items(), start=1):
            raster.write(values, index)
            raster.dataset.set_band_description(index, name)
            if units is not None:
                raster.dataset.set_band_unit(index, units[name])
            if tags is not None:
                raster.dataset.update_tags(index, **tags[name])


def write_flags(
    path: Path, names: Sequence[str], grid: OutputGrid, georeference: Georeference | None, tags: Mapping[str, str],
    flags_on: Callable[[Tile], Sequence[NDArray[np.uint16]]],
) -> None:  # fmt: skip
    """Write uint16 layers with these names atomically. `flags_on` returns all layers (height, width) on a tile of the
    grid. There is no nodata value: 0 means that no flag is set.

    Raises OutputError.
    """
    options = {"compress": "deflate", "interleave": "band"}
    with checked_raster(path, grid_profile(grid, georeference, len(names), "uint16", **options)) as raster:
        raster.dataset.update_tags(**tags, **georeference_tags(georeference))
        for index, name in enumerate(names, start=1):
            raster.dataset.set_band_description(index, name)
        for tile in tiles(grid.tile, _WORK_TILE_PX):
            for index, flags in enumerate(flags_on(tile), start=1):
                raster.write(flags, index, tile.x0 - grid.x0, tile.y0 - grid.y0)


def media_type(settings: WriteSettings) -> str:
    """Return the media type of the files that `write_raster` writes."""
    return COG if settings.format == "cog" else GEOTIFF


def predictor(kind: str) -> int:
    """Return the TIFF predictor for a kind of numpy type: 3 for floating point, 2 for integers."""
    return 3 if kind == "f" else 2


def _colours(layers: Sequence[Layer]) -> list[ColorInterp]:
    """The colour interpretation of each layer. If there are red, green and blue, the first band of each is displayed as
    such by viewers; else the first layer is grey.
    """
    roles = [None if b.companion else role_of(b.name, b.wavelength_nm) for b in (layer.band for layer in layers)]
    if not set(_COLOURS) <= set(roles):
        return [ColorInterp.gray, *[ColorInterp.undefined] * (len(layers) - 1)]
    result = [ColorInterp.undefined] * len(layers)
    for role, colour in _COLOURS.items():
        result[roles.index(role)] = colour
    return result


def _write_layer(
    raster: CheckedRaster, index: int, layer: Layer, grid: OutputGrid, nodata: float | None, settings: WriteSettings
) -> None:
    dtype = np.dtype(raster.dataset.dtypes[0])
    for tile in tiles(grid.tile, _WORK_TILE_PX):
        pixels, valid = _tile_of(layer, tile, settings)
        if pixels is None:
            pixels = np.full((tile.height, tile.width), 0 if nodata is None else nodata, dtype=dtype)
        elif nodata is not None and not (valid.all() and layer.is_copied):
            pixels = with_nodata(pixels.astype(dtype, copy=False), valid, nodata)
        raster.write(pixels.astype(dtype, copy=False), index, tile.x0 - grid.x0, tile.y0 - grid.y0)


def _tile_of(layer: Layer, tile: Tile, settings: WriteSettings) -> tuple[Pixels | None, Mask]:
    """A layer's pixels (height, width) on a tile and their mask; no pixels for a layer without any."""
    if layer.is_gap:
        return None, np.zeros((tile.height, tile.width), dtype=bool)
    radiometry = None if settings.radiometry == "off" else layer.band.radiometry
    if layer.mapping is None:
        pixels, valid = read_tile(layer.band, tile)
        return pixels if radiometry is None else calibrated(pixels, radiometry, tile.x0, tile.y0), valid
    pixels, valid = resample_tile(layer.band, layer.mapping, tile, settings.interpolation, radiometry)
    if settings.fill_occluded:
        return _with_occluded(pixels, valid, _fillable(layer, layer.mapping, tile))
    return pixels, valid


def _fillable(layer: Layer, mapping: PixelMapping, tile: Tile) -> Mask:
    """(height, width), True for pixels of a tile that are occluded in the band and inside its image."""
    positions = mapping.positions(tile)
    inside = ((positions >= 0) & (positions <= np.subtract(layer.band.size_px, 1))).all(axis=-1)
    return np.asarray(mapping.hidden(tile) & inside)


def _with_occluded(pixels: Pixels, valid: Mask, occluded: Mask) -> tuple[Pixels, Mask]:
    """Pixels and their mask, with occluded pixels interpolated from valid ones by GDAL's inverse distance weighting."""
    if not occluded.any() or not valid.any():
        return pixels, valid
    distance_px = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, 3)
    occluded = occluded & (distance_px < _FILL_DISTANCE_PX)
    filled = fillnodata(np.where(valid, pixels, 0).astype(np.float32), valid, _FILL_DISTANCE_PX)
    if pixels.dtype.kind in "iu":
        limits = np.iinfo(str(pixels.dtype))
        filled = np.clip(np.rint(filled), limits.min, limits.max)
    return np.where(occluded, filled, pixels).astype(pixels.dtype), valid | occluded


def _compression(settings: WriteSettings, *, all_bands: bool) -> str:
    """Deflate for files of single bands: many programs that read them do not support Zstandard."""
    if settings.compression != "auto":
        return settings.compression
    return "zstd" if all_bands and settings.layout != "bands" else "deflate"


def _to_cog(path: Path, compression: str) -> None:
    cog = path.with_name(f"{path.name}.cog")
    options = {} if compression == "none" else {"compress": compression, "predictor": "yes"}
    try:
        copy_dataset(path, cog, driver="COG", blocksize=_COG_BLOCK_PX, bigtiff="if_safer", **options)
        cog.replace(path)
    finally:
        cog.unlink(missing_ok=True)
