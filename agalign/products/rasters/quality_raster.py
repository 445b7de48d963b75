"""Rasters of the expected alignment error and of quality flags on the grid of the aligned files."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.radiometry import to_reflectance
from agalign.pixels.raster import read_tile
from agalign.products.indices.formulas import Role, role_of_band
from agalign.products.product import GEOTIFF, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.rasters.checked_raster import WORK_TILE_PX, LayerDescription
from agalign.products.rasters.layout import Layer, is_inside
from agalign.products.rasters.raster_file import layer_pixels
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Radiometry
from agalign.values.choices import QUALITY_MEANINGS, Quality
from agalign.values.image import FloatImage, Mask, OutputGrid, Tile
from agalign.values.interpolation import source_positions, tiles
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.extrapolation import expected_error_px

_LATTICE_PX = 16
"""Distance of the nodes at which the error, which is smooth, is calculated."""
Flags = NDArray[np.uint16]


class ErrorMap(Product):
    """The expected error of each moving band that is written."""

    kind = "error_map"
    suffix = ".error.tif"
    option = "error_map"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.error.tif: float32, px of the reference's file, a layer for each moving band."""
        with_pixels, reference, grid = context.with_pixels, context.capture.reference, context.grid
        layers = [
            LayerDescription(name, tags={"units": "px of the reference", "STATUS": alignment.status})
            for name, alignment in with_pixels.items()
        ]
        blocks = ((_error_px(a, reference, grid), index, 0, 0) for index, a in enumerate(with_pixels.values(), start=1))
        return self.write_layers(context, layers, blocks, StacAsset("error", GEOTIFF, ("metadata",)))


def error_lattice_px(alignment: Alignment[FixedFilePx], reference: Band, grid: OutputGrid) -> NDArray[np.float32]:
    """Return the expected error (rows, columns) on a lattice over a grid, px of the reference's file; nan where it is
    unknown.
    """
    columns, rows = (max(2, -(-n // _LATTICE_PX)) for n in (grid.width, grid.height))
    points = grid.reference_positions(geometry.lattice(grid.width, grid.height, columns, rows), reference.lens)
    nodes = expected_error_px(alignment, reference.size_px, points).reshape(rows, columns)
    return np.where(np.isfinite(nodes), nodes, np.nan).astype(np.float32)


def error_on_tile(nodes: NDArray[np.float32], grid: OutputGrid, tile: Tile) -> NDArray[np.float32]:
    """Return the expected error (height, width) on a tile of a grid, linearly interpolated from `error_lattice_px`."""
    rows, columns = nodes.shape
    # Positions of the pixels of the grid, in nodes.
    x, y = (np.linspace(0, n - 1, m, dtype=np.float32) for n, m in ((columns, grid.width), (rows, grid.height)))
    x0, y0 = tile.x0 - grid.x0, tile.y0 - grid.y0
    positions = np.meshgrid(x[x0 : x0 + tile.width], y[y0 : y0 + tile.height])
    return np.asarray(cv2.remap(nodes, *positions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _error_px(alignment: Alignment[FixedFilePx], reference: Band, grid: OutputGrid) -> NDArray[np.float32]:
    """Expected error (height, width) on a grid, rounded below its accuracy: the raster compresses better."""
    result, step_px = error_on_tile(error_lattice_px(alignment, reference, grid), grid, grid.tile), 0.001
    return np.asarray(np.round(result / step_px) * step_px, np.float32)


class QualityRaster(Product):
    """The quality flags of all bands."""

    kind = "qa"
    suffix = ".qa.tif"
    option = "qa"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.qa.tif. Raises OutputError, or UnreadableFileError for an input."""
        grid, reference = context.grid, context.capture.reference
        nodes = {name: error_lattice_px(a, reference, grid) for name, a in context.with_pixels.items()}
        water = _water_bands(context.layers)
        glint = sun_glint(*(_reflectance(*band, grid.tile) for band in water)) if water else None
        predicted = {name for name, alignment in context.with_pixels.items() if alignment.status == "predicted"}

        def flags_on(tile: Tile) -> list[Flags]:
            bands = [
                _flags(layer, tile, grid, nodes, is_predicted=layer.band.name in predicted) for layer in context.layers
            ]
            if glint is not None:
                in_tile = glint[tile.y0 - grid.y0 :, tile.x0 - grid.x0 :][: tile.height, : tile.width]
                for flags in bands:
                    flags[in_tile & (flags & _bit(Quality.MISSING) == 0)] |= _bit(Quality.SUN_GLINT)
            return [np.bitwise_or.reduce(bands), *bands]

        method = "water by NDWI > 0 (McFeeters 1996), glint by the excess of near infrared (Hedley et al. 2005)"
        unknown = "not assessed: the reflectance of green and near infrared is not known"
        tags = {
            "flag_masks": ", ".join(str(int(flag)) for flag in Quality),
            "flag_meanings": QUALITY_MEANINGS,
            "SUN_GLINT": method if water else unknown,
        }
        # The first layer has the flags that are set in any band.
        layers = [LayerDescription(name) for name in ("all bands", *(layer.band.name for layer in context.layers))]
        blocks = (
            (flags, index, tile.x0 - grid.x0, tile.y0 - grid.y0)
            for tile in tiles(grid.tile, WORK_TILE_PX)
            for index, flags in enumerate(flags_on(tile), start=1)
        )
        # There is no nodata value: 0 means that no flag is set.
        options, asset = {"compress": "deflate", "interleave": "band"}, StacAsset("qa", GEOTIFF, ("metadata",))
        return self.write_layers(context, layers, blocks, asset, tags=tags, dtype="uint16", options=options)


def _bit(flag: Quality) -> np.uint16:
    return np.uint16(flag.value)


def _flags(
    layer: Layer, tile: Tile, grid: OutputGrid, nodes: Mapping[str, NDArray[np.float32]], *, is_predicted: bool
) -> Flags:
    """Flags (height, width) of a band on a tile, except sun glint; `nodes` has the expected error by band."""
    if layer.is_gap:
        return np.full((tile.height, tile.width), _bit(Quality.MISSING), np.uint16)
    result = np.full((tile.height, tile.width), _bit(Quality.PREDICTED) if is_predicted else 0, np.uint16)
    masks = _of_source(layer, tile)
    if layer.band.name in nodes:
        error_px = error_on_tile(nodes[layer.band.name], grid, tile)
        masks[Quality.ERROR_OVER_HALF_PX] = np.isnan(error_px) | (error_px > 0.5)
        masks[Quality.ERROR_OVER_1_PX] = np.isnan(error_px) | (error_px > 1.0)
    for flag, mask in masks.items():
        result[mask] |= _bit(flag)
    return result


def _of_source(layer: Layer, tile: Tile) -> dict[Quality, Mask]:
    """The flags of a band's file on a tile, each (height, width)."""
    band = layer.band
    if layer.mapping is None:
        pixels, valid = read_tile(band, tile)
        return {Quality.NODATA: ~valid, Quality.SATURATED: _saturated(pixels, valid, band.saturation_value)}
    positions, source = source_positions(layer.mapping, tile, layer.size_px, band.size_px)
    inside = is_inside(positions, band)
    if source is None:
        return {Quality.OUTSIDE: ~inside}
    pixels, valid = read_tile(band, source)
    in_window = (positions - (source.x0, source.y0)).astype(np.float32)
    saturated = _saturated(pixels, valid, band.saturation_value)
    return {
        Quality.OUTSIDE: ~inside,
        Quality.NODATA: inside & _contributes(~valid, in_window),
        Quality.SATURATED: inside & _contributes(saturated, in_window),
        Quality.OCCLUDED: inside & layer.mapping.hidden(tile),
    }


def _saturated(pixels: NDArray[np.generic], valid: Mask, saturation_value: float | None) -> Mask:
    if saturation_value is None:
        return np.zeros(pixels.shape, dtype=bool)
    return np.asarray(valid & (pixels.astype(np.float64) >= saturation_value))


def _contributes(mask: Mask, positions: NDArray[np.float32]) -> Mask:
    """True where one of the four pixels around a position is in the mask."""
    if not mask.any():
        return np.zeros(positions.shape[:2], dtype=bool)
    weight = cv2.remap(mask.astype(np.float32), positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(weight > 1e-3)  # smaller weights are rounding errors


def _water_bands(layers: Sequence[Layer]) -> list[tuple[Layer, Radiometry]]:
    """The green and the near infrared band, with their conversion to reflectance; empty if either is unknown."""
    by_role: dict[Role, tuple[Layer, Radiometry]] = {}
    for layer in layers:
        role = None if layer.is_gap else role_of_band(layer.band)
        reflectance = None if layer.band.radiometry is None else to_reflectance(layer.band.radiometry)
        if role is not None and reflectance is not None:
            by_role.setdefault(role, (layer, reflectance))
    return [by_role["green"], by_role["nir"]] if {"green", "nir"} <= by_role.keys() else []


def _reflectance(layer: Layer, radiometry: Radiometry, tile: Tile) -> FloatImage:
    """Reflectance (height, width) on a tile, nan for invalid pixels."""
    pixels, valid = layer_pixels(layer, tile, "bilinear", radiometry)
    return np.where(valid, pixels, np.nan).astype(np.float32)


# ---- sun glint on water

_BLOCK_PX = 16
"""Side of the blocks for which a dark value is computed."""
_MIN_PIXEL_NDWI = -0.2
"""Glint is as bright in green as in near infrared; vegetation and soil at a shore are not."""
_MIN_VARIATION, _MIN_AREA_SHARE = 0.1, 0.5
"""Minimum coefficient of variation of near infrared in a bright area, which covers at least this share of a block: 0.15
or more in 99 % of the glint on an estuary, below 0.08 on sand."""


def sun_glint(green: FloatImage, nir: FloatImage) -> Mask:
    """Return (height, width) True where more than half of the green light is sun glint on water.

    Water absorbs near-infrared light, so the excess of a water pixel over the darkest water nearby is light reflected
    by the surface (Hedley, Harborne & Mumby 2005, doi:10.1080/01431160500034086). This reflection is nearly independent
    of the wavelength (Kay, Hedley & Lavender 2009, doi:10.3390/rs1040697). Water has a positive NDWI (McFeeters 1996,
    doi:10.1080/01431169608948714) in the darkest pixels nearby. In the centre of a glint pattern no pixel is dark, so
    spectrally flat areas connected with water are classified as water too. Waves make glint vary from pixel to pixel,
    which dry sand, a quay or a boat do not: bright areas without variation are not glint.

    `green` and `nir` are reflectances (height, width), NaN where unknown.

        glint = nir - nir_dark,  water where (green_dark - nir_dark) / (green_dark + nir_dark) > 0

    Images with sides of fewer than two blocks have none: they have no neighbourhood to compare with.
    """
    height, width = green.shape
    if min(height, width) < 2 * _BLOCK_PX:
        return np.zeros(green.shape, dtype=bool)
    green_dark, nir_dark = (_darkest_nearby(band) for band in (green, nir))
    with np.errstate(invalid="ignore", divide="ignore"):
        ndwi = (green_dark - nir_dark) / (green_dark + nir_dark)
        is_water_block = ndwi > 0
        if not is_water_block.any():
            return np.zeros(green.shape, dtype=bool)
        # Where all pixels nearby are glint, their minimum is above the value of water.
        nir_dark = np.fmin(nir_dark, np.median(nir_dark[is_water_block]))
        # Blocks that are connected with water.
        candidates = ndwi > _MIN_PIXEL_NDWI
        _, labels = cv2.connectedComponents(candidates.astype(np.uint8))
        blocks = candidates & np.isin(labels, np.unique(labels[is_water_block]))
        of_water = np.where(blocks, nir_dark, np.nan).repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
        glint = nir - of_water[:height, :width]
        is_flat = (green - nir) / (green + nir) > _MIN_PIXEL_NDWI
        min_glint_share = 0.5  # minimum share of glint in the green light
        is_bright = np.asarray(is_flat & (glint > min_glint_share * green))
    return is_bright & ~_is_uniform(nir, is_bright)


def _is_uniform(nir: FloatImage, area: Mask) -> Mask:
    """Return True (height, width) where an area covers the surroundings, and does not vary in them as glint does."""
    share, mean, square = (
        cv2.blur(np.where(area, values, 0).astype(np.float32), (_BLOCK_PX, _BLOCK_PX)) for values in (1, nir, nir * nir)
    )
    variance = square * share - mean * mean  # times the square of the share, as the square of the mean
    return np.asarray((share >= _MIN_AREA_SHARE) & (variance < (_MIN_VARIATION * mean) ** 2))


def _darkest_nearby(band: FloatImage) -> NDArray[np.float32]:
    """Return the minimum dark value of the blocks nearby for each block, (rows, columns); NaN if all are unknown."""
    complete = np.pad(band, [(0, -n % _BLOCK_PX) for n in band.shape], constant_values=np.nan)
    rows, columns = (n // _BLOCK_PX for n in complete.shape)
    blocks = complete.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    unknown = np.float32(1e30)  # larger than any reflectance
    known = np.where(np.isfinite(blocks), blocks, unknown)
    dark = np.percentile(known, 10, axis=-1, method="lower").astype(np.float32)  # less noisy than the minimum
    nearby = np.ones((5, 5), np.uint8)  # blocks; they contain the dark faces of waves
    darkest = cv2.erode(dark, nearby)
    return np.where(darkest < unknown, darkest, np.float32(np.nan))
