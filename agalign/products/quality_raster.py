"""A raster of quality flags on the grid of the aligned files: a layer for all bands together, and one for each band."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.pixels.radiometry import calibrated, to_reflectance
from agalign.pixels.raster import read_tile
from agalign.pixels.resample import resample_tile
from agalign.pixels.sun_glint import sun_glint
from agalign.products.error_map import error_lattice_px, error_on_tile
from agalign.products.indices import Role, role_of
from agalign.products.layout import Layer
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import GEOTIFF, write_flags
from agalign.values.capture import Radiometry
from agalign.values.image import FloatImage, Mask, OutputGrid, Tile
from agalign.values.quality import MEANINGS, Quality

_ALL_BANDS = "all bands"
"""Name of the first layer: flags that are set in any band."""
_MIN_WEIGHT = 1e-3
"""Bilinear weight from which a source pixel contributes: smaller ones are rounding errors."""
_ERROR_FLAGS = {0.5: Quality.ERROR_OVER_HALF_PX, 1.0: Quality.ERROR_OVER_1_PX}
"""Flags by the expected error, px of the reference, that they indicate."""
_ASSESSED = "water by NDWI > 0 (McFeeters 1996), glint by the excess of near infrared (Hedley et al. 2005)"
_NOT_ASSESSED = "not assessed: the reflectance of green and near infrared is not known"

Flags = NDArray[np.uint16]


class QualityRaster(Product):
    """The quality flags of all bands."""

    kind = "qa"
    suffix = ".qa.tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True with `--qa`."""
        return settings.qa

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.qa.tif. Raises OutputError, or UnreadableFileError for an input."""
        path, grid = context.paths.file(self.suffix), context.grid
        size_px = context.capture.reference.size_px
        nodes = {name: error_lattice_px(a, size_px, grid) for name, a in context.usable.items()}
        water = _WaterBands.of(context.layers)
        predicted = {name for name, alignment in context.usable.items() if alignment.status == "predicted"}

        def flags_on(tile: Tile) -> list[Flags]:
            bands = [
                _flags(layer, tile, grid, nodes, is_predicted=layer.band.name in predicted) for layer in context.layers
            ]
            if water is not None:
                glint = water.glint(tile)
                for flags in bands:
                    flags[glint & (flags & _bit(Quality.MISSING) == 0)] |= _bit(Quality.SUN_GLINT)
            return [np.bitwise_or.reduce(bands), *bands]

        tags = {
            "flag_masks": ", ".join(str(int(flag)) for flag in Quality), "flag_meanings": MEANINGS,
            "SUN_GLINT": _NOT_ASSESSED if water is None else _ASSESSED,
        }  # fmt: skip
        names = [_ALL_BANDS, *(layer.band.name for layer in context.layers)]
        write_flags(path, names, grid, context.capture.reference.georeference, tags, flags_on)
        return [WrittenFile(self.kind, path, StacAsset("qa", GEOTIFF, ("metadata",)))]


def _bit(flag: Quality) -> np.uint16:
    return np.uint16(flag.value)


def _flags(
    layer: Layer, tile: Tile, grid: OutputGrid, nodes: Mapping[str, NDArray[np.float32]], *, is_predicted: bool
) -> Flags:
    """Flags (height, width) of a band on a tile, except sun glint; `nodes` has the expected error by band."""
    shape = tile.height, tile.width
    if layer.is_gap:
        return np.full(shape, _bit(Quality.MISSING), np.uint16)
    result = np.zeros(shape, np.uint16)
    if is_predicted:
        result |= _bit(Quality.PREDICTED)
    outside, nodata, saturated, occluded = _of_source(layer, tile)
    for mask, flag in (
        (outside, Quality.OUTSIDE), (nodata, Quality.NODATA), (saturated, Quality.SATURATED),
        (occluded, Quality.OCCLUDED),
    ):  # fmt: skip
        result[mask] |= _bit(flag)
    if layer.band.name in nodes:
        error_px = error_on_tile(nodes[layer.band.name], grid, tile)
        for limit_px, flag in _ERROR_FLAGS.items():
            result[np.isnan(error_px) | (error_px > limit_px)] |= _bit(flag)
    return result


def _of_source(layer: Layer, tile: Tile) -> tuple[Mask, Mask, Mask, Mask]:
    """(outside, nodata, saturated, occluded) of a band's file on a tile, each (height, width)."""
    none = np.zeros((tile.height, tile.width), dtype=bool)
    band = layer.band
    if layer.mapping is None:
        pixels, valid = read_tile(band, tile)
        return none, ~valid, _saturated(pixels, valid, band.saturation_value), none
    positions = layer.mapping.positions(tile, np.float32)
    end = np.subtract(band.size_px, 1)
    with np.errstate(invalid="ignore"):
        inside: Mask = np.asarray(((positions >= 0) & (positions <= end)).all(axis=-1))
    occluded = inside & layer.mapping.hidden(tile)
    if not inside.any():
        return ~inside, none, none, none
    x0, y0 = np.floor(positions[inside].min(axis=0)).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(positions[inside].max(axis=0)).astype(int) + 1, band.size_px).tolist()
    pixels, valid = read_tile(band, Tile(x0, y0, x1 - x0, y1 - y0))
    in_window = (positions - np.array([x0, y0], np.float32)).astype(np.float32)
    nodata = inside & _contributes(~valid, in_window)
    saturated = inside & _contributes(_saturated(pixels, valid, band.saturation_value), in_window)
    return ~inside, nodata, saturated, occluded


def _saturated(pixels: NDArray[np.generic], valid: Mask, saturation_value: float | None) -> Mask:
    if saturation_value is None:
        return np.zeros(pixels.shape, dtype=bool)
    return np.asarray(valid & (pixels.astype(np.float64) >= saturation_value))


def _contributes(mask: Mask, positions: NDArray[np.float32]) -> Mask:
    """True where one of the four pixels around a position is in the mask."""
    if not mask.any():
        return np.zeros(positions.shape[:2], dtype=bool)
    weight = cv2.remap(mask.astype(np.float32), positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(weight > _MIN_WEIGHT)


@dataclass(frozen=True)
class _WaterBands:
    """The bands from which sun glint is detected, with their conversion to reflectance."""

    green: tuple[Layer, Radiometry]
    nir: tuple[Layer, Radiometry]

    @classmethod
    def of(cls, layers: Sequence[Layer]) -> "_WaterBands | None":
        by_role: dict[Role, tuple[Layer, Radiometry]] = {}
        for layer in layers:
            band = layer.band
            role = None if band.companion or layer.is_gap else role_of(band.name, band.wavelength_nm)
            reflectance = None if band.radiometry is None else to_reflectance(band.radiometry)
            if role is not None and reflectance is not None:
                by_role.setdefault(role, (layer, reflectance))
        if "green" not in by_role or "nir" not in by_role:
            return None
        return cls(by_role["green"], by_role["nir"])

    def glint(self, tile: Tile) -> Mask:
        return sun_glint(*(_reflectance(*band, tile) for band in (self.green, self.nir)))


def _reflectance(layer: Layer, radiometry: Radiometry, tile: Tile) -> FloatImage:
    """Reflectance (height, width) on a tile, nan for invalid pixels."""
    if layer.mapping is not None:
        pixels, valid = resample_tile(layer.band, layer.mapping, tile, "bilinear", radiometry)
    else:
        raw, valid = read_tile(layer.band, tile)
        pixels = calibrated(raw, radiometry, tile.x0, tile.y0)
    return np.where(valid, pixels, np.nan).astype(np.float32)
