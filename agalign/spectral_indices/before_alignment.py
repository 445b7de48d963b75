"""A spectral index of the bands as they are in their files: the report shows it next to that of the aligned bands."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.host.held_sizes import WORK_TILE_PX
from agalign.rasters.aligned_files import layer_pixels
from agalign.rasters.output_grid import Layer
from agalign.rasters.product import ProductContext
from agalign.spectral_indices.formulas import Index, bands_for, compute
from agalign.values.image import Tile
from agalign.values.pixel_units import SAME_PIXELS
from agalign.values.resampling import tiles


def index_before(context: ProductContext, index: Index, span: tuple[float, float]) -> NDArray[np.uint8] | None:
    """Return an index of the unaligned bands on the grid of a capture (height, width): 0 and 255 are the ends of the
    colour scale `span`, and 0 is also where it is undefined.

    None if the bands differ in size from the reference, the grid has other pixels than it, or contains pixels outside
    it, or if the vignetting of raw numbers is corrected in the aligned bands only. Raises InputError if a band of the
    index is missing, and UnreadableFileError.
    """
    grid, (width, height) = context.grid, context.capture.reference.size_px
    layers = {layer.band.name: layer for layer in context.layers if not layer.is_gap}
    names = bands_for(index, {name: layer.band.wavelength_nm for name, layer in layers.items()})
    chosen = [layers[name] for name in names]
    is_inside = 0 <= grid.x0 <= width - grid.width and 0 <= grid.y0 <= height - grid.height
    has_same_pixels = grid.scale == SAME_PIXELS and not grid.undistorted and is_inside
    has_same_pixels &= all(la.band.size_px == (width, height) for la in chosen)
    if not has_same_pixels or any(file.is_flat for file in context.written):
        return None
    result = np.empty((grid.height, grid.width), np.uint8)
    for tile in tiles(grid, WORK_TILE_PX):
        values = compute(index, [_unaligned(context, layer, tile) for layer in chosen])
        shares = np.nan_to_num((values - span[0]) / (span[1] - span[0]), posinf=0.0, neginf=0.0)
        y, x = tile.y0 - grid.y0, tile.x0 - grid.x0
        result[y : y + tile.height, x : x + tile.width] = (shares.clip(0, 1) * 255).round()
    return result


def _unaligned(context: ProductContext, layer: Layer, tile: Tile) -> NDArray[np.float32]:
    """The values (height, width) of a band at the place of a tile in its own file, nan where it is not valid."""
    radiometry = None if context.is_raw else layer.band.radiometry
    interpolation = context.settings.write.interpolation
    pixels, valid = layer_pixels(replace(layer, mapping=None), tile, interpolation, radiometry)
    scale, offset = layer.band.scale_offset if context.is_raw else (1.0, 0.0)
    return np.where(valid, pixels.astype(np.float64) * scale + offset, np.nan).astype(np.float32)
