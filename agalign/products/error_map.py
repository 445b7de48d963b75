"""A raster of the expected alignment error at every pixel, with a layer for each moving band, on the output grid."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.products.product import Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import GEOTIFF, write_layers
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Capture
from agalign.values.image import OutputGrid, Tile
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.expected_error import expected_error_px

_LATTICE_PX = 16
"""Distance of the nodes at which the error, which is smooth, is calculated."""
_STEP_PX = 0.001
"""Errors are rounded to this step, below their accuracy: the raster compresses better."""


class ErrorMap(Product):
    """The expected error of each moving band that is written."""

    kind = "error_map"
    suffix = ".error.tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True with `--error-map`."""
        return settings.error_map

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.error.tif."""
        path = context.paths.file(self.suffix)
        write_error_map(context.capture, context.usable, context.grid, path)
        return [WrittenFile(self.kind, path, StacAsset("error", GEOTIFF, ("metadata",)))]


def write_error_map(
    capture: Capture, alignments: Mapping[str, Alignment[FixedFilePx]], grid: OutputGrid, path: Path
) -> None:
    """Write the expected errors (bands, height, width), float32, px of the reference's file, on the output grid of the
    capture, atomically. Raises OutputError.
    """
    size_px, georeference = capture.reference.size_px, capture.reference.georeference
    layers = {name: _error_px(alignment, size_px, grid) for name, alignment in alignments.items()}
    tags = {name: {"units": "px of the reference", "STATUS": a.status} for name, a in alignments.items()}
    write_layers(path, layers, grid, georeference, tags=tags)


def error_lattice_px(
    alignment: Alignment[FixedFilePx], size_px: tuple[int, int], grid: OutputGrid
) -> NDArray[np.float32]:
    """Return the expected error (rows, columns) on a lattice over a grid, px of the reference's file; nan where it is
    unknown. `size_px` is (width, height) of that file.
    """
    columns, rows = (max(2, -(-n // _LATTICE_PX)) for n in (grid.width, grid.height))
    points = grid.reference_positions(geometry.lattice(grid.width, grid.height, columns, rows))
    nodes = expected_error_px(alignment, size_px, points).reshape(rows, columns)
    return np.where(np.isfinite(nodes), nodes, np.nan).astype(np.float32)


def error_on_tile(nodes: NDArray[np.float32], grid: OutputGrid, tile: Tile) -> NDArray[np.float32]:
    """Return the expected error (height, width) on a tile of a grid, linearly interpolated from `error_lattice_px`."""
    rows, columns = nodes.shape
    # Positions of the pixels of the grid, in nodes.
    x, y = (np.linspace(0, n - 1, m, dtype=np.float32) for n, m in ((columns, grid.width), (rows, grid.height)))
    x0, y0 = tile.x0 - grid.x0, tile.y0 - grid.y0
    positions = np.meshgrid(x[x0 : x0 + tile.width], y[y0 : y0 + tile.height])
    return np.asarray(cv2.remap(nodes, *positions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _error_px(alignment: Alignment[FixedFilePx], size_px: tuple[int, int], grid: OutputGrid) -> NDArray[np.float32]:
    """Expected error (height, width) on a grid, rounded."""
    result = error_on_tile(error_lattice_px(alignment, size_px, grid), grid, grid.tile)
    return np.asarray(np.round(result / _STEP_PX) * _STEP_PX, np.float32)
