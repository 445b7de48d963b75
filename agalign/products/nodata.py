"""The nodata value of an output file, and pixels that carry it."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.pixels.raster import open_raster, read_window
from agalign.pixels.resample import tiles
from agalign.products.layout import Layer
from agalign.values.capture import Band, Capture
from agalign.values.image import Mask, OutputGrid, Tile

Pixels = NDArray[np.generic]
_TILE_PX = 2048
"""Side of the tiles in which a band's values are collected: it bounds the memory."""
_MAX_VALUES_TRIED = 1 << 16
"""All values of a 16 bit type; of a larger type the first ones suffice."""


def nodata_value(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any], settings: WriteSettings
) -> float | None:
    """Return the value that a file of these layers declares; None if every pixel holds a measurement."""
    if settings.radiometry != "off":
        return math.nan
    declared = capture.reference.nodata
    if declared is not None and _fits(declared, dtype):
        return declared
    if dtype.kind == "f":
        return math.nan  # nan needs no declaration in a source
    return _unused_value(layers, grid, dtype) if _has_invalid_pixels(layers, grid) else None


def with_nodata(pixels: Pixels, valid: Mask, nodata: float) -> Pixels:
    """Return pixels (height, width) with nodata where they are not valid.

    Valid pixels that happen to equal nodata change by the smallest step of their type.
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
    """0; where copied bands contain zeros, the largest value, or else the first that they do not contain.

    Copied pixels never change, except if they contain all values of the type: then 0.
    """
    copied = [_values_in(layer.band, grid.tile) for layer in layers if layer.is_copied]
    limits = np.iinfo(str(dtype))
    candidates = itertools.chain([0, limits.max], range(1, min(limits.max, _MAX_VALUES_TRIED)))
    return float(next((v for v in candidates if not any((values == v).any() for values in copied)), 0))


def _values_in(band: Band, tile: Tile) -> Pixels:
    """All different values of a band in a rectangle of its file."""
    with open_raster(band.path) as source:
        result = [np.unique(read_window(source, band, t.x0, t.y0, t.width, t.height)[0]) for t in tiles(tile, _TILE_PX)]
    return np.unique(np.concatenate(result))


def _fits(value: float, dtype: np.dtype[Any]) -> bool:
    if dtype.kind == "f":
        return True
    limits = np.iinfo(str(dtype))
    return float(value).is_integer() and limits.min <= value <= limits.max
