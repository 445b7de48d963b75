"""Images for the estimation, and grids of pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.values.lens import Lens, distort
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

FloatImage = NDArray[np.float32]
"""(height, width), or (bands, height, width) where it is stated."""
Mask = NDArray[np.bool_]
"""(height, width), True for the pixels that it selects."""


def reduced_size_px(size_px: tuple[int, int], reduction: float) -> tuple[int, int]:
    """(width, height) of an image after a reduction, at least 1 px each."""
    return max(1, round(size_px[0] / reduction)), max(1, round(size_px[1] / reduction))


@dataclass(frozen=True)
class Raster:
    """Pixels for the estimation, with their mask."""

    pixels: FloatImage
    """(height, width) float32, or (channels, height, width)."""
    valid: Mask
    """(height, width), False where a pixel is nodata, saturated or outside the sensor."""
    lens: Lens | None = None
    """Lens of the camera in these pixels; None if positions are not corrected for distortion."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return int(self.valid.shape[1]), int(self.valid.shape[0])

    @property
    def planes(self) -> FloatImage:
        """(channels, height, width) float32."""
        return self.pixels if self.pixels.ndim == 3 else self.pixels[None]

    @property
    def channels(self) -> int:
        """1 for a single band."""
        return len(self.planes)


@dataclass(frozen=True)
class Tile:
    """A rectangle of a pixel grid."""

    x0: int
    y0: int
    width: int
    height: int


@dataclass(frozen=True)
class OutputGrid(Tile):
    """Grid of the output: a rectangle, from (x0, y0) on, of the reference's grid at a scale."""

    scale: PixelScale = SAME_PIXELS
    """Output pixels per pixel of the reference; each side has a whole number of pixels."""
    undistorted: bool = False
    """The lens-corrected grid of the reference."""
    has_gaps: bool = True
    """Some pixels may be outside the image of a band."""

    def px(self, x: float, y: float) -> tuple[float, float]:
        """Position (x, y) on this grid of a position of the reference."""
        on_grid_x, on_grid_y = self.scale.positions((x, y)).tolist()
        return on_grid_x - self.x0, on_grid_y - self.y0

    def reference_positions(self, positions_px: ArrayLike, reference_lens: Lens | None) -> NDArray[np.float64]:
        """Raw positions (..., 2) in the reference's file of positions on this grid."""
        positions = self.scale.inverse.positions(np.asarray(positions_px) + np.array([self.x0, self.y0]))
        return distort(reference_lens, positions) if self.undistorted else positions
