"""The scale between two pixel grids.

A band pair has four pixel grids: those of the *files* of the fixed (reference) and of the moving band, and those of the
*images* that the estimation uses, which are reductions of large files. The packages `capture`, `method`, `fit` and
`verify` measure lengths in px of the images, by default of the fixed one; all other packages use px of the files. Names
and docstrings state exceptions: a moving pixel may cover several times the ground of a fixed one.

Positions count from the CENTRE of the top-left pixel, (0, 0). Two images of the same area share their outer EDGES, so
a position x of one is (x + 0.5) * scale - 0.5 in the other. Only `PixelScale` implements this formula.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Size = tuple[int, int]
"""(width, height) of an image in pixels."""


class PixelScale(NamedTuple):
    """Pixels of one image per pixel of another that shows the same area: 0.5 halves the resolution."""

    x: float
    y: float

    @classmethod
    def between(cls, full_size_px: Size, size_px: Size) -> "PixelScale":
        """Return the scale from an image of one (width, height) to one of another."""
        return cls(size_px[0] / full_size_px[0], size_px[1] / full_size_px[1])

    @property
    def inverse(self) -> "PixelScale":
        """The scale in the other direction."""
        return PixelScale(1 / self.x, 1 / self.y)

    def over(self, other: "PixelScale") -> "PixelScale":
        """The scale from an image of scale `other` to one of this scale, both relative to the same image."""
        return PixelScale(self.x / other.x, self.y / other.y)

    @property
    def mean(self) -> float:
        """Geometric mean of both axes: the factor for lengths of unknown direction."""
        return math.sqrt(self.x * self.y)

    def positions(self, positions_px: ArrayLike) -> NDArray[np.float64]:
        """Return positions (..., 2) of the first image as positions of the second."""
        return np.asarray((np.asarray(positions_px, np.float64) + 0.5) * self - 0.5)

    def displacements(self, displacements_px: ArrayLike) -> NDArray[np.float64]:
        """Return displacements (..., 2) of the first image as displacements of the second."""
        return np.asarray(np.asarray(displacements_px, np.float64) * self)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """`positions` as a homography (3, 3)."""
        return np.array([[self.x, 0.0, 0.5 * self.x - 0.5], [0.0, self.y, 0.5 * self.y - 0.5], [0.0, 0.0, 1.0]])


SAME_PIXELS = PixelScale(1.0, 1.0)
"""Scale of an image with the pixels of its file."""
