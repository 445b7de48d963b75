"""A raster of the relief of a capture on the output grid: parallax and, on request, its confidence and the range."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from agalign.cameras import rig_seed
from agalign.cameras.pix4d import rig_unit_m
from agalign.errors import GeometryError
from agalign.fit.relief import inverse_range
from agalign.products.product import GEOTIFF, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.rasters.checked_raster import LayerDescription
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid
from agalign.values.parallax import Relief, rounded
from agalign.values.pixel_units import FixedFilePx

RELIEF_UNITS = {"parallax": "px", "confidence": "1", "range": "m"}
"""Units by layer of the raster."""


class ReliefMap(Product):
    """The relief that displaces the bands of a capture, whenever one was estimated; the sidecar refers to it."""

    kind = "relief"
    suffix = ".relief.tif"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.relief.tif."""
        relief = relief_of(context.with_pixels)
        if relief is None:
            return []
        layers = relief_layers(context.capture, context.with_pixels, relief, context.grid)
        if not context.write_settings.relief_map:
            layers = {"parallax": layers["parallax"]}
        descriptions = [LayerDescription(name, RELIEF_UNITS[name]) for name in layers]
        blocks = ((values, index, 0, 0) for index, values in enumerate(layers.values(), start=1))
        return self.write_layers(context, descriptions, blocks, StacAsset("relief", GEOTIFF, ("data",)))


def relief_of(alignments: Mapping[str, Alignment[FixedFilePx]]) -> Relief | None:
    """Return the relief of a capture; None if no band is displaced by one."""
    return next((a.mapping.parallax.relief for a in alignments.values() if a.mapping.parallax is not None), None)


def relief_layers(
    capture: Capture,
    alignments: Mapping[str, Alignment[FixedFilePx]],
    relief: Relief,
    grid: OutputGrid,
    size_px: tuple[int, int] | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Return layers (height, width) on a grid: `parallax` in px of the reference's file along a baseline of length 1,
    `confidence` from 0 to 1, and `range` in metres along the optical axis, nan where it is unknown.

    With `size_px` (width, height) the same area is sampled at that size.
    """
    columns, rows = size_px or (grid.width, grid.height)
    x, y = np.meshgrid(np.linspace(0, grid.width - 1, columns), np.linspace(0, grid.height - 1, rows))
    points = grid.reference_positions(np.stack([x, y], axis=-1), capture.reference.lens)
    parallax_px = relief(points)
    confidence = Relief(relief.confidence, relief.confidence, relief.scale)(points)
    return {
        "parallax": rounded(parallax_px),
        "confidence": rounded(confidence),
        "range": _range_m(capture, alignments, points, parallax_px),
    }


def _range_m(
    capture: Capture,
    alignments: Mapping[str, Alignment[FixedFilePx]],
    points: NDArray[np.float64],
    parallax_px: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Range (height, width), nan if baselines, focal length or the orientation of the lenses are unknown."""
    reference, at_infinity, baselines_m, mappings = capture.reference, [], [], []
    unit_m = rig_unit_m(capture.bands)
    for band in capture.moving:
        alignment = alignments.get(band.name)
        if alignment is None or alignment.mapping.parallax is None or alignment.space != "undistorted":
            continue
        try:
            homography_at_infinity = rig_seed(reference, band)
        except GeometryError:
            continue
        if homography_at_infinity is None or band.lens_offset is None or reference.lens_offset is None:
            continue
        at_infinity.append(homography_at_infinity)
        baselines_m.append(np.subtract(reference.lens_offset, band.lens_offset) * unit_m)
        mappings.append(alignment.mapping)
    if not mappings or reference.lens is None:
        return np.full(parallax_px.shape, np.nan, np.float32)
    inverse_m = inverse_range(mappings, at_infinity, np.array(baselines_m), reference.lens, points, parallax_px)
    max_range_m = 1e5  # the parallax of a larger range cannot be distinguished from that of an infinite one
    with np.errstate(divide="ignore"):
        range_m = np.where(inverse_m > 1 / max_range_m, 1 / inverse_m, np.nan)
    return np.asarray(range_m, np.float32)
