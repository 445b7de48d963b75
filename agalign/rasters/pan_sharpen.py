"""Bands at the resolution of the panchromatic band, or of the colour photograph, by the weighted Brovey transform:

    sharpened_b = B_b P / sum_i w_i B_i

with the bands B resampled to the pixels of the panchromatic band P, as in GDAL's pansharpening. The sum is over the
bands within the spectral range of P. The weights are the non-negative least-squares fit of these bands to P, blurred to
their resolution, times a factor with which the median of P / sum w B is 1. The transform keeps the ratios between these
bands; the radiometry of each changes by P / sum w B. Bands outside the range of P are resampled and not sharpened.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.optimize import nnls

from agalign.cameras.base import is_thermal
from agalign.errors import InputError, UnreadableFileError
from agalign.host.files import scratch_file
from agalign.pixels.masks import data_mask
from agalign.pixels.raster import OpenRaster, open_raster
from agalign.rasters.aligned_files import with_nodata, write_raster
from agalign.rasters.geotiff import Block, LayerDescription
from agalign.rasters.output_grid import SCALE_DECIMALS, output_layers
from agalign.rasters.product import Product, ProductContext, WrittenFile
from agalign.values.capture import Band, Capture
from agalign.values.image import FloatImage, Mask, OutputGrid, Tile
from agalign.values.resampling import as_type, tiles

_TILE_PX = 1024
"""Side of the tiles that are sharpened one after another, which limits the memory, and of the square in the middle of
the image from which the weights are fitted.
"""


class PanSharpened(Product):
    """The usable multispectral bands at the resolution of the panchromatic band."""

    kind = "pan_sharpened"
    suffix = ".pan.tif"
    option = "pan_sharpen"

    def check(self, capture: Capture) -> None:
        """Raise InputError for a capture without a panchromatic band or colour photograph."""
        if not panchromatic(capture):
            raise InputError(
                f"{capture.reference.path}: no panchromatic band to sharpen with; add --with-rgb where the camera "
                "takes a colour photograph, or leave --pan-sharpen out"
            )

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.pan.tif; nothing if the panchromatic band is not usable, or no band is within its range."""
        capture, usable, path = context.capture, context.usable, context.paths.file(self.suffix)
        broad = panchromatic(capture)
        if not broad or not {b.name for b in broad} <= {capture.reference.name, *usable}:
            return []
        context = _with_write(context, resolution="finest", format="gtiff", statistics=False)
        layers, grid = output_layers(capture, usable, context.settings.write, context.options.fine, context.read)
        context = replace(context, grid=grid)
        pan = [la for la in layers if la.band in broad]
        others = [
            la
            for la in layers
            if not (la.is_gap or la.band in broad or la.band.is_from_photograph or is_thermal(la.band))
        ]
        if not any(is_in_range(la.band, broad) for la in others):
            return []
        with scratch_file(path) as unsharpened:
            write_raster(_with_write(context, compression="none"), [*others, *pan], unsharpened)
            with open_raster(unsharpened) as file:
                bands, scale = [la.band for la in others], max(grid.scale)
                descriptions, blocks = sharpened(file, bands, broad, scale, is_raw=context.is_raw)
                options, dtype = {"interleave": "band", "nodata": file.nodata}, file.dtypes[0]
                return self.write_layers(context, descriptions, blocks, file.tags(), dtype=dtype, options=options)


def _with_write(context: ProductContext, **changes: object) -> ProductContext:
    """Return the input of a product with other settings for the output."""
    write = context.settings.write.model_copy(update=changes)
    return replace(context, settings=context.settings.model_copy(update={"write": write}))


def scale_of_earlier(path: Path, common: OutputGrid) -> float | None:
    """Return the pixels of an earlier pan-sharpened file per pixel of the reference, given the common grid of the
    stacks; None if it cannot be read.
    """
    with suppress(UnreadableFileError), open_raster(path) as file:
        return round(float(common.scale.x * file.width / common.width), SCALE_DECIMALS)
    return None


def panchromatic(capture: Capture) -> list[Band]:
    """Return the panchromatic band, else the three bands of the colour photograph; empty if there is neither."""
    min_pan_width_nm = 200.0  # bandwidth from which a band is panchromatic: multispectral bands have 10 to 60 nm
    broad = [
        b for b in capture.bands if b.name.lower().startswith("pan") or (b.bandwidth_nm or 0.0) >= min_pan_width_nm
    ]
    return [b for b in broad if not is_thermal(b)][:1] or [b for b in capture.bands if b.is_from_photograph]


def is_in_range(band: Band, pan: Sequence[Band]) -> bool:
    """True for a band within the spectral range of the panchromatic band, or if either is unknown."""
    if band.wavelength_nm is None:
        return True
    if pan[0].is_from_photograph:
        low, high = 400.0, 700.0
    else:
        centre, width = pan[0].wavelength_nm, pan[0].bandwidth_nm
        low, high = (-math.inf, math.inf) if not centre or not width else (centre - width / 2, centre + width / 2)
    return low <= band.wavelength_nm <= high


def weights_of(bands: FloatImage, pan: FloatImage, scale: float) -> NDArray[np.float64]:
    """Return the weight of each band (bands, height, width) in the panchromatic band, whose pixels are `scale` times
    smaller.

    Non-negative least squares over the pixels that are not nan, equal weights if the fit is impossible; times the
    median ratio, which differs from 1 for a photograph, whose values are not proportional to radiance.
    """
    sigma_px = max(0.5 * scale, 0.3)  # the bands may have almost the resolution of the panchromatic band
    blurred = cv2.GaussianBlur(np.nan_to_num(pan), (0, 0), sigma_px)
    known = np.isfinite(pan) & np.isfinite(bands).all(axis=0)
    weights = np.full(len(bands), 1 / len(bands))
    if known.any():
        of_known, pan_of_known = bands[:, known].astype(np.float64), blurred[known].astype(np.float64)
        result, _ = nnls(of_known.T, pan_of_known)
        weights = np.asarray(result) if result.any() else weights
        total = weights @ of_known
        if (total > 0).any():
            weights *= float(np.median(pan_of_known[total > 0] / total[total > 0]))
    return weights


def brovey_ratio(bands: FloatImage, pan: FloatImage, weights: NDArray[np.float64]) -> FloatImage:
    """Return P / sum w B (height, width) of bands (bands, height, width), limited to 1 / 5 to 5; 1 where it is
    undefined.
    """
    max_ratio = 5.0  # in dark pixels it is noise divided by noise
    weighted_sum = np.tensordot(weights, bands, axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(weighted_sum > 0, pan / weighted_sum, 1.0)
    return np.asarray(np.clip(np.nan_to_num(ratio, nan=1.0), 1 / max_ratio, max_ratio), np.float32)


def sharpened(
    file: OpenRaster, bands: Sequence[Band], pan: Sequence[Band], scale: float, *, is_raw: bool
) -> tuple[list[LayerDescription], Iterator[Block]]:
    """Return the sharpened bands, given a file of the resampled `bands` followed by the panchromatic ones, which have
    pixels `scale` times smaller. Raw numbers include the black level and the offset of the file, and Brovey ratios are
    ratios of light.
    """
    count, dtype, nodata = len(bands), np.dtype(file.dtypes[0]), file.nodata
    radiometry = [b.radiometry if is_raw else None for b in (*bands, *pan)]
    without_light = np.array([0.0 if r is None else r.black_level for r in radiometry], np.float32)
    without_light -= np.divide(file.offsets, file.scales).astype(np.float32)
    in_range = [k for k, band in enumerate(bands) if is_in_range(band, pan)]

    def read(tile: Tile) -> tuple[FloatImage, Mask]:
        """((bands, height, width) above the number without light, nan for nodata; mask of valid pixels)."""
        pixels = file.read(window=Window(tile.x0, tile.y0, tile.width, tile.height)).astype(np.float32)
        valid = data_mask(pixels, nodata)
        return np.where(valid, pixels - without_light[:, None, None], np.float32(np.nan)), valid

    width, height = min(file.width, _TILE_PX), min(file.height, _TILE_PX)
    light, _ = read(Tile((file.width - width) // 2, (file.height - height) // 2, width, height))
    weights = weights_of(light[in_range], light[count:].mean(axis=0), scale)

    def blocks() -> Iterator[Block]:
        for tile in tiles(Tile(0, 0, file.width, file.height), _TILE_PX):
            light, valid = read(tile)
            light[in_range] *= brovey_ratio(light[in_range], light[count:].mean(axis=0), weights)
            for k in range(count):
                values = light[k] + without_light[k]
                pixels = as_type(values if dtype.kind == "f" else np.nan_to_num(values), dtype)
                yield pixels if nodata is None else with_nodata(pixels, valid[k], nodata), k + 1, tile.x0, tile.y0

    source = "the colour photograph" if pan[0].is_from_photograph else pan[0].name
    weight_of, result = dict(zip(in_range, weights.tolist(), strict=True)), []
    for k, band in enumerate(bands):
        text = f"weighted Brovey by {source}, weight {weight_of[k]:.4g}" if k in weight_of else "no"
        tags, values = file.tags(k + 1) | {"PANSHARPENED": text}, (file.scales[k], file.offsets[k])
        result.append(LayerDescription(band.name, file.units[k] or "", tags, values))
    return result, blocks()
