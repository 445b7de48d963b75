"""The choice of the nodata value of an output file, and pixels with that value."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.pixels.raster import open_raster, read_window
from agalign.products.layout import Layer
from agalign.values.capture import Band, Capture
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.resample import tiles

Pixels = NDArray[np.generic]
_TILE_PX = 2048
"""Side of the tiles in which a band's values are collected: it limits the memory."""
_MAX_CANDIDATES = 1 << 16
"""All values of a 16-bit type; for larger types the first ones are sufficient."""


def nodata_value(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any], settings: WriteSettings
) -> float | None:
    """Return the nodata value of a file with these layers; None if every pixel is valid. Raises UnreadableFileError."""
    if settings.radiometry != "off":
        return math.nan
    declared = capture.reference.nodata
    if declared is not None and _fits(declared, dtype):
        return declared
    if dtype.kind == "f":
        return math.nan  # input files may contain nan without declaring it
    return _unused_value(layers, grid, dtype) if _has_invalid_pixels(layers, grid) else None


def with_nodata(pixels: Pixels, valid: Mask, nodata: float) -> Pixels:
    """Return pixels (height, width) with nodata where they are not valid.

    Valid pixels that equal nodata change by the smallest step of their type.
    """
    if not math.isnan(nodata):
        pixels = np.where(valid & (pixels == nodata), pixels.dtype.type(_next_value(nodata, pixels.dtype)), pixels)
    return np.where(valid, pixels, pixels.dtype.type(nodata))


def _next_value(nodata: float, dtype: np.dtype[Any]) -> float:
    if dtype.kind == "f":
        return nodata + float(np.spacing(np.abs(dtype.type(nodata)) + 1))
    return nodata + 1 if nodata < np.iinfo(str(dtype)).max else nodata - 1


def _has_invalid_pixels(layers: Sequence[Layer], grid: OutputGrid) -> bool:
    masked = (layer.band.nodata is not None or layer.band.has_mask for layer in layers)
    return grid.has_gaps or any(layer.is_gap for layer in layers) or any(masked)


def _unused_value(layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any]) -> float:
    """The first of 0, the largest value of the type, 1, 2 … that no copied band contains; 0 if there is none.

    Copied pixels then keep their values.
    """
    copied = [_values_in(layer.band, grid.tile) for layer in layers if layer.is_copied]
    limits = np.iinfo(str(dtype))
    candidates = itertools.chain([0, limits.max], range(1, min(limits.max, _MAX_CANDIDATES)))
    return float(next((v for v in candidates if not any((values == v).any() for values in copied)), 0))


def _values_in(band: Band, tile: Tile) -> Pixels:
    """The different values of a band in a rectangle of its file."""
    with open_raster(band.path) as source:
        result = [np.unique(read_window(source, band, t.x0, t.y0, t.width, t.height)[0]) for t in tiles(tile, _TILE_PX)]
    return np.unique(np.concatenate(result))


def _fits(value: float, dtype: np.dtype[Any]) -> bool:
    if dtype.kind == "f":
        return True
    limits = np.iinfo(str(dtype))
    return float(value).is_integer() and limits.min <= value <= limits.max
