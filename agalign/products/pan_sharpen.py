"""Bands at the resolution of the panchromatic one, or of the colour photograph, by the weighted Brovey transform:

    sharpened_b = B_b P / sum_i w_i B_i

with the bands B resampled to the pixels of the panchromatic P. That is what GDAL's pansharpening computes. The weights
are those by which the bands, of those whose light the panchromatic sees, make up P where P is as blurred as they are
(least squares, none negative). It keeps the bands' ratios and changes each one's own radiometry by P / sum w B, which
is 1 only on the mean. Other bands are resampled and not sharpened: visible light says little of near infra-red.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from scipy.optimize import nnls

from agalign.cameras.base import is_thermal
from agalign.config import WriteSettings
from agalign.errors import InputError, OutputError
from agalign.pixels.masks import data_mask
from agalign.pixels.raster import GDAL_ENVIRONMENT, open_raster, why, without_warnings
from agalign.pixels.resample import tiles
from agalign.products.layout import Layer, output_layers
from agalign.products.nodata import with_nodata
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import GEOTIFF, PixelChecksums, check_complete, write_raster
from agalign.values.capture import Band, Capture
from agalign.values.files import complete_file, scratch_file
from agalign.values.image import FloatImage, Mask, OutputGrid, Tile

_BROAD_NM = 200.0
"""Width from which a band is panchromatic."""
_COLOUR_NM = 400.0, 700.0
"""The light in a colour photograph."""
_SAMPLE_PX = 1024
"""Side of the square in the middle that the weights are fitted on."""
_MAX_RATIO = 5.0
"""In dark pixels noise is divided by noise."""
_WORK_PX = 1024
"""Side of the tiles that are sharpened at a time: it bounds the memory."""


class PanSharpened(Product):
    """The narrow bands, as far as they are aligned, at the panchromatic band's resolution."""

    kind = "pan_sharpened"
    suffix = ".pan.tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True with `--pan-sharpen`."""
        return settings.pan_sharpen

    def check(self, capture: Capture) -> None:
        """Raise InputError for a capture without a band to sharpen with."""
        if not panchromatic(capture):
            raise InputError(
                f"{capture.reference.path}: no panchromatic band to sharpen with; add --with-rgb where the camera "
                "takes a colour photograph, or leave --pan-sharpen out"
            )

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.pan.tif; nothing where the panchromatic band is not aligned."""
        fine = {"resolution": "finest", "format": "gtiff", "compression": "none"}
        settings, path = context.write_settings.model_copy(update=fine), context.paths.file(self.suffix)
        sources = _sources(context, settings)
        if sources is None:
            return []
        _write(sources, path, context, settings)
        return [WrittenFile(self.kind, path, StacAsset("pan", GEOTIFF, ("data",)))]


def panchromatic(capture: Capture) -> list[Band]:
    """The band that sees the others' light together, else the three of the colour photograph; none where there is
    neither.
    """
    broad = [b for b in capture.bands if b.name.lower().startswith("pan") or (b.bandwidth_nm or 0.0) >= _BROAD_NM]
    return [b for b in broad if not is_thermal(b)][:1] or [b for b in capture.bands if b.companion]


@dataclass(frozen=True)
class _Sources:
    """What a sharpened file is made of, all on one grid."""

    narrow: list[Layer]
    is_seen: list[bool]
    """For each narrow band: whether the panchromatic band sees its light."""
    pan: list[Layer]
    grid: OutputGrid


def _sources(context: ProductContext, settings: WriteSettings) -> _Sources | None:
    """None where the panchromatic band is not aligned, or sees the light of no narrow band."""
    pan = panchromatic(context.capture)
    placed = {n: a for n, a in context.usable.items() if a.status in ("aligned", "predicted")}
    if not pan or not {b.name for b in pan} <= {context.capture.reference.name, *placed}:
        return None
    layers, grid = output_layers(context.capture, placed, settings, context.rig)
    narrow = [layer for layer in layers if _is_narrow(layer, pan)]
    is_seen = [_is_seen(layer.band, pan) for layer in narrow]
    if not any(is_seen):
        return None
    return _Sources(narrow, is_seen, [layer for layer in layers if layer.band in pan], grid)


def _is_narrow(layer: Layer, pan: Sequence[Band]) -> bool:
    return not (layer.is_gap or layer.band in pan or layer.band.companion or is_thermal(layer.band))


def _write(sources: _Sources, path: Path, context: ProductContext, settings: WriteSettings) -> None:
    """Write the sharpened bands. Raises OutputError, or UnreadableFileError for an input."""
    layers, grid = [*sources.narrow, *sources.pan], sources.grid
    bands, pan = [layer.band for layer in sources.narrow], panchromatic(context.capture)
    try:
        with scratch_file(path) as unsharpened:
            nodata = write_raster(context.capture, layers, grid, unsharpened, settings)
            # Ratios are of light: what a sensor counts in the dark is none.
            dark = [_dark(layer.band, settings) for layer in layers]
            with complete_file(path) as partial:
                scale = max(grid.scale)
                checksums = _sharpen(unsharpened, partial, bands, pan, sources.is_seen, dark, scale, nodata)
                check_complete(partial)
                checksums.check(partial)
    except RasterioError as error:
        raise OutputError(f"{path}: cannot be written ({why(error)})") from None


def weights_of(bands: Sequence[FloatImage], pan: FloatImage, scale: float) -> NDArray[np.float64]:
    """How much of each band (height, width) makes up a panchromatic one of so many times their resolution; nan is
    left aside.
    """
    blurred = cv2.GaussianBlur(np.nan_to_num(pan), (0, 0), max(0.5 * scale, 0.3))
    known = np.isfinite(pan) & np.logical_and.reduce([np.isfinite(b) for b in bands])
    if not known.any():
        return np.full(len(bands), 1 / len(bands))
    result, _ = nnls(np.stack([b[known] for b in bands], axis=-1).astype(np.float64), blurred[known].astype(np.float64))
    return np.asarray(result) if result.any() else np.full(len(bands), 1 / len(bands))


def brovey_ratio(bands: Sequence[FloatImage], pan: FloatImage, weights: NDArray[np.float64]) -> FloatImage:
    """P / sum w B, (height, width), 1 where that says nothing."""
    made = np.tensordot(weights, np.stack(bands), axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(made > 0, pan / made, 1.0)
    return np.asarray(np.clip(np.nan_to_num(ratio, nan=1.0), 1 / _MAX_RATIO, _MAX_RATIO), np.float32)


def _sharpen(
    source: Path, target: Path, bands: Sequence[Band], pan: Sequence[Band], seen: Sequence[bool], dark: Sequence[float],
    scale: float, nodata: float | None,
) -> PixelChecksums:  # fmt: skip
    """From a file of the bands and, after them, the panchromatic's planes."""
    checksums = PixelChecksums()
    with open_raster(source) as file, without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT):
        of_light = [k for k, is_seen in enumerate(seen) if is_seen]
        side = Tile(
            max(0, (file.width - _SAMPLE_PX) // 2), max(0, (file.height - _SAMPLE_PX) // 2),
            min(file.width, _SAMPLE_PX), min(file.height, _SAMPLE_PX),
        )  # fmt: skip
        planes, _ = _read(file, side, dark, nodata)
        weights = weights_of([planes[k] for k in of_light], planes[len(bands) :].mean(axis=0), scale)
        profile = file.profile | {
            "count": len(bands), "compress": "deflate", "predictor": 3 if file.dtypes[0].startswith("f") else 2,
        }  # fmt: skip
        with rasterio.open(target, "w", **profile) as written:
            _describe(written, file, bands, pan, seen, weights)
            for tile in tiles(Tile(0, 0, file.width, file.height), _WORK_PX):
                planes, valid = _read(file, tile, dark, nodata)
                ratio = brovey_ratio([planes[k] for k in of_light], planes[len(bands) :].mean(axis=0), weights)
                for k, is_sharpened in enumerate(seen):
                    values = (planes[k] * ratio if is_sharpened else planes[k]) + np.float32(dark[k])
                    pixels = _as(values, valid[k], file.dtypes[0], nodata)
                    checksums.write(written, pixels, k + 1, _window(tile))
    return checksums


def _is_seen(band: Band, pan: Sequence[Band]) -> bool:
    """True where the panchromatic sees a band's light; of a panchromatic of which that is not known, all of it."""
    if band.wavelength_nm is None:
        return True
    if pan[0].companion:
        low, high = _COLOUR_NM
    else:
        middle, width = pan[0].wavelength_nm, pan[0].bandwidth_nm
        low, high = (-math.inf, math.inf) if not middle or not width else (middle - width / 2, middle + width / 2)
    return low <= band.wavelength_nm <= high


def _dark(band: Band, settings: WriteSettings) -> float:
    if settings.radiometry != "off" or band.radiometry is None:
        return 0.0
    return band.radiometry.black_level


def _read(file: Any, tile: Tile, dark: Sequence[float], nodata: float | None) -> tuple[FloatImage, Mask]:
    """((planes, height, width) of light, nan where there is none; where there is some)."""
    pixels = file.read(window=_window(tile)).astype(np.float32)
    valid = data_mask(pixels, nodata)
    return np.where(valid, pixels - np.array(dark, np.float32)[:, None, None], np.float32(np.nan)), valid


def _as(values: FloatImage, valid: Mask, dtype: str, nodata: float | None) -> NDArray[Any]:
    kind = np.dtype(dtype)
    if kind.kind != "f":
        limits = np.iinfo(str(kind))
        values = np.clip(np.rint(np.nan_to_num(values)), limits.min, limits.max)
    result = values.astype(kind)
    return result if nodata is None else with_nodata(result, valid, nodata)


def _describe(
    written: Any, source: Any, bands: Sequence[Band], pan: Sequence[Band], seen: Sequence[bool],
    weights: NDArray[np.float64],
) -> None:  # fmt: skip
    name = "the colour photograph" if pan[0].companion else pan[0].name
    used = iter(weights.tolist())
    said = [f"weighted Brovey by {name}, weight {next(used):.4g}" if is_seen else "no" for is_seen in seen]
    written.update_tags(**{k: v for k, v in source.tags().items() if k != "AREA_OR_POINT"})
    written.units = source.units[: len(bands)]
    for index, (band, text) in enumerate(zip(bands, said, strict=True), start=1):
        written.set_band_description(index, band.name)
        written.update_tags(index, **source.tags(index), PANSHARPENED=text)
        written.update_tags(index, ns="IMAGERY", **source.tags(index, ns="IMAGERY"))


def _window(tile: Tile) -> rasterio.windows.Window:
    return rasterio.windows.Window(tile.x0, tile.y0, tile.width, tile.height)
