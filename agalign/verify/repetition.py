"""Check for a repetitive scene, where another place fits as well: orchards on a lattice, panels, greenhouse roofs."""

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
"""Height of the next correlation peak over that of the result, from which the scene counts as repetitive."""
_SAME_PX = 3
"""Radius of a correlation peak, px of the reduced images: anything nearer is its own flank."""


@dataclass(frozen=True)
class AliasPeak:
    """The highest correlation peak apart from that of the result."""

    shift_px: tuple[float, float]
    """(x, y) from the result, px of the reduced images."""
    share: float
    """Its height over that of the result's peak."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    """One where another place fits nearly as well and nothing known beforehand rules it out."""
    images = evidence.images
    if images is None:
        return
    alias = alias_peak(*images.reduced_spectra())
    if alias.share <= MAX_ALIAS_PEAK:
        return
    x_px, y_px = (shift / scale for shift, scale in zip(alias.shift_px, images.reduced_scale, strict=True))
    if not images.is_expected() or images.is_expected((x_px, y_px)):
        yield Issue(REPEATS, math.hypot(x_px, y_px))


def alias_peak(fixed: Field, moving: Field) -> AliasPeak:
    """The highest peak apart from that at no shift, of windowed spectra (height, width) of two images on one grid."""
    surface = np.fft.fftshift(correlation_surfaces(fixed, moving))
    height, width = surface.shape
    row, column = height // 2, width // 2
    near = np.s_[row - _SAME_PX : row + _SAME_PX + 1, column - _SAME_PX : column + _SAME_PX + 1]
    own_height = float(surface[near].max())
    surface[near] = -np.inf
    index = int(surface.argmax())
    shift_px = float(index % width - column), float(index // width - row)
    height_there = float(surface.flat[index])
    return AliasPeak(shift_px, height_there / own_height if own_height > 0 else float("inf"))


CHECK = Check((REPEATS,), _issues, is_costly=True)
