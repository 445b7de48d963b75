"""Images as the estimation sees them, and the pixel grids they lie on."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.values.lens import Lens

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Raster:
    """Pixels with their validity, as the estimation sees them."""

    pixels: FloatImage
    """(height, width) float32, or (channels, height, width)."""
    valid: Mask
    """(height, width), False where a pixel is nodata, saturated or outside the sensor."""
    lens: Lens | None = None
    """Of the camera that took it, in these pixels; None where positions are not to be corrected."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return int(self.valid.shape[1]), int(self.valid.shape[0])

    @property
    def channels(self) -> int:
        """1 for a single band."""
        return 1 if self.pixels.ndim == 2 else len(self.pixels)


@dataclass(frozen=True)
class Tile:
    """A rectangle of a pixel grid."""

    x0: int
    y0: int
    width: int
    height: int


@dataclass(frozen=True)
class OutputGrid:
    """The pixels that are written, within the reference's: its pixel x lies at scale (x + 0.5) - 0.5 - x0."""

    x0: int
    y0: int
    width: int
    height: int
    scale_xy: tuple[float, float] = (1.0, 1.0)
    """Written pixels along one of the reference, in whole numbers a side."""
    undistorted: bool = False
    """The lens-corrected grid of the reference."""
    has_gaps: bool = True
    """Some of its pixels may lie outside the image of some band that is written."""

    @property
    def scale(self) -> float:
        """`scale_xy` for what has one number for both."""
        return math.sqrt(self.scale_xy[0] * self.scale_xy[1])

    @property
    def tile(self) -> Tile:
        """The rectangle of the reference's grid at this scale."""
        return Tile(self.x0, self.y0, self.width, self.height)

    def px(self, x: float, y: float) -> tuple[float, float]:
        """Where a pixel of the reference lies."""
        sx, sy = self.scale_xy
        return sx * (x + 0.5) - 0.5 - self.x0, sy * (y + 0.5) - 0.5 - self.y0
