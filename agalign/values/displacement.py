"""Smooth displacement fields over an image."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from agalign.values.pixel_units import SAME_PIXELS, PixelScale

POSITION_DECIMALS = 4
"""Of positions and displacements in a sidecar, px: a hundredth of the error of an alignment."""


@dataclass(frozen=True)
class DisplacementField:
    """A smooth field of displacements on an image, px, by its values on a lattice."""

    step_px: float
    """Distance of the lattice's nodes, px of the image that it was made for."""
    displacements_px: NDArray[np.float64]
    """(rows, columns, 2), px of that image; the first node is the centre of its top-left pixel."""
    scale: PixelScale = SAME_PIXELS
    """Size of that image relative to the one on which the field is evaluated."""

    @classmethod
    def sampled(
        cls, function: Callable[[NDArray[np.float64]], NDArray[np.float64]], step_px: float, size_px: tuple[int, int]
    ) -> "DisplacementField":
        """Sample a function from points (n, 2) to displacements (n, 2) on a lattice over an image (width, height)."""
        columns, rows = (math.ceil(n / step_px) + 1 for n in size_px)
        nodes = (
            np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(np.float64)
            * step_px
        )
        return cls(float(step_px), function(nodes).reshape(rows, columns, 2))

    def __call__(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """The displacement (..., 2) at points (..., 2), by cubic splines; outside the lattice that of its edge."""
        points = np.asarray(points_px)
        on_lattice = points if self.scale == SAME_PIXELS else self.scale.positions(points)
        at = on_lattice.reshape(-1, 2)[:, ::-1].T / self.step_px
        planes = np.moveaxis(self.displacements_px, -1, 0)
        values = [map_coordinates(plane, at, order=3, mode="nearest") for plane in planes]
        return self.scale.inverse.displacements(np.stack(values, axis=-1).reshape(points.shape))

    def rescaled(self, scale: PixelScale) -> "DisplacementField":
        """The same on an image that is resized by `scale`."""
        return replace(self, scale=self.scale.over(scale))

    def on_lattice(self, step_px: float, size_px: tuple[int, int]) -> "DisplacementField":
        """The same by its values on another lattice, which covers an image (width, height).

        They have the decimals of a sidecar, so that a reader of it has the same field.
        """
        return DisplacementField.sampled(lambda points: self(points).round(POSITION_DECIMALS), step_px, size_px)

    def plus(self, other: "DisplacementField") -> "DisplacementField":
        """The sum of two fields on one lattice: x -> d(x) + other(x)."""
        return DisplacementField(self.step_px, self.displacements_px + other.displacements_px)
