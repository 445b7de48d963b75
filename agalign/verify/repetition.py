"""Check for aliasing in repetitive scenes: orchards on a grid, solar panels, greenhouse roofs."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agalign.pixels.structure import Field, correlation_surfaces
from agalign.values.issues import Issue, IssueKind, Remedy
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

REPEATS = IssueKind(
    "repeats",
    "the scene repeats: a shift of {value:.0f} px fits nearly as well, and no prior information decides",
    Remedy(
        "the scene repeats, and no prior information decides which shift is right",
        "keep the camera's metadata in the files (no --ignore-metadata), or give --model OUT/models/… of an earlier "
        "flight",
    ),
)
MAX_ALIAS_PEAK = 0.75
"""Ratio of the heights of the next correlation peak and that of the result, above which the scene is repetitive."""
_PEAK_RADIUS_PX = 3
"""Radius of a correlation peak, px of the reduced images."""


@dataclass(frozen=True)
class AliasPeak:
    """The highest correlation peak after that of the result."""

    shift_px: tuple[float, float]
    """(x, y) relative to the result, px of the reduced images."""
    ratio: float
    """Its height relative to that of the result."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    """Yield an issue if another shift fits nearly as well and no prior information excludes it."""
    images = evidence.images
    if images is None:
        return
    alias = alias_peak(*images.reduced_spectra())
    if alias.ratio <= MAX_ALIAS_PEAK:
        return
    x_px, y_px = (shift / scale for shift, scale in zip(alias.shift_px, images.reduced_scale, strict=True))
    if not images.is_expected() or images.is_expected((x_px, y_px)):
        yield Issue(REPEATS, math.hypot(x_px, y_px))


def alias_peak(fixed: Field, moving: Field) -> AliasPeak:
    """Return the highest peak except that at zero shift; `fixed` and `moving` are windowed spectra (height, width)."""
    surface = np.fft.fftshift(correlation_surfaces(fixed, moving))
    height, width = surface.shape
    row, column, radius = height // 2, width // 2, _PEAK_RADIUS_PX
    centre = np.s_[row - radius : row + radius + 1, column - radius : column + radius + 1]
    centre_peak = float(surface[centre].max())
    surface[centre] = -np.inf
    index = int(surface.argmax())
    shift_px = float(index % width - column), float(index // width - row)
    other_peak = float(surface.flat[index])
    return AliasPeak(shift_px, other_peak / centre_peak if centre_peak > 0 else float("inf"))


CHECK = Check((REPEATS,), _issues, is_costly=True)
