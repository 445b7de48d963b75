"""What the method works on: the images of one capture, and where their alignment stands."""

from collections.abc import Sequence
from dataclasses import dataclass

from agalign.values.geometry import Matrix
from agalign.values.image import Raster


@dataclass
class Subject:
    """The images of one capture and where their alignment stands."""

    fixed: Raster
    moving: Sequence[Raster]
    mappings: list[Matrix]
    """fixed_to_moving of each moving image, undistorted px; moved along by the optimisation."""
    sides: Sequence[int]
    """Which of the network's sides describes each moving image."""
    trusted: Sequence[bool]
    """Seeds that are good to a few pixels: recipe fast leaves the coarse levels out."""

    @classmethod
    def of_one(cls, fixed: Raster, moving: Raster, fixed_to_moving: Matrix, *, trusted: bool = False) -> "Subject":
        """A single pair, described by the network's first two sides."""
        return cls(fixed, [moving], [fixed_to_moving], [1], [trusted])
