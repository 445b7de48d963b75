"""Whether a scene repeats, so that another place fits as well: orchards on a lattice, panels, greenhouse roofs."""

from dataclasses import dataclass

import numpy as np

from agalign.pixels.structure import Field, correlation_surfaces

_SAME_PX = 3
"""Around a peak, px of the reduced images, lies its own flank."""


@dataclass(frozen=True)
class AliasPeak:
    """The best of all other places."""

    shift_px: tuple[float, float]
    """From the place that was found, px of the reduced images."""
    share: float
    """Height of its correlation peak over that of the place found."""


def alias_peak(fixed: Field, moving: Field) -> AliasPeak:
    """The highest peak away from no shift of two windowed spectra (height, width) of images laid on each other."""
    surface = np.fft.fftshift(correlation_surfaces(fixed, moving))
    height, width = surface.shape
    row, column = height // 2, width // 2
    near = np.s_[row - _SAME_PX : row + _SAME_PX + 1, column - _SAME_PX : column + _SAME_PX + 1]
    here = float(surface[near].max())
    surface[near] = -np.inf
    there = int(surface.argmax())
    shift_px = float(there % width - column), float(there // width - row)
    best = float(surface.flat[there])
    return AliasPeak(shift_px, best / here if here > 0 else float("inf"))
