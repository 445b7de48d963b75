"""A spectral index of the bands as they are in their files: the report shows it next to that of the aligned bands."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.rasters.aligned_files import layer_pixels
from agalign.rasters.product import ProductContext
from agalign.spectral_indices.formulas import Index, bands_for, compute
from agalign.values.pixel_units import SAME_PIXELS


def index_before(context: ProductContext, index: Index, span: tuple[float, float]) -> NDArray[np.uint8] | None:
    """Return an index of the unaligned bands on the grid of a capture (height, width): 0 and 255 are the ends of the
    colour scale `span`, and 0 is also where it is undefined.

    None if the bands differ in size from the reference, the grid has other pixels than it, or contains pixels outside
    it. Raises InputError if a band of the index is missing, and UnreadableFileError.
    """
    grid, (width, height) = context.grid, context.capture.reference.size_px
    layers = [layer for layer in context.layers if not layer.is_gap]
    chosen = [
        layers[i] for i in bands_for(index, [la.band.name for la in layers], [la.band.wavelength_nm for la in layers])
    ]
    is_inside = 0 <= grid.x0 <= width - grid.width and 0 <= grid.y0 <= height - grid.height
    if grid.scale != SAME_PIXELS or not is_inside or any(la.band.size_px != (width, height) for la in chosen):
        return None
    planes = []
    for layer in chosen:
        radiometry = layer.vignetting if context.is_raw else layer.band.radiometry
        unaligned, interpolation = replace(layer, mapping=None), context.settings.write.interpolation
        pixels, valid = layer_pixels(unaligned, grid.tile, interpolation, radiometry)
        planes.append(np.where(valid, pixels, np.nan).astype(np.float32))
    low, high = span
    shares = np.nan_to_num((compute(index, planes) - low) / (high - low), posinf=0.0, neginf=0.0)
    return np.asarray((shares.clip(0, 1) * 255).round(), np.uint8)
