"""What several captures of a camera tell about its radiance and reflectance: their mean is flat, and those of the same
ground agree.
"""

import math
from collections import defaultdict, deque
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from agalign.records.cautions import Caution
from agalign.records.sidecar import OutputPart
from agalign.values.capture import known_time_s
from agalign.values.remedies import JUMP, NOT_FLAT

_MIN_CAPTURES = 20
"""For the flatness of the mean: the ratio of corners to middle varies by 15 % between captures (eight sets of real
captures)."""
_MAX_UNEVEN, _MIN_UNEVEN_STD = 0.1, 4.0
"""Logarithm of the mean ratio, and the same relative to its standard error: vignetting that is not corrected makes 0.15
to 0.5, a direction of the sun up to 0.1."""
_CORNERS, _MIDDLE = 0.75, 0.4
"""Distance from the centre, relative to half the diagonal."""
_MAX_APART_S = 60.0
"""Between two captures that may show the same ground under the same light."""
_RECENT = 16
"""Captures that are kept for comparison: the order of their names need not be that of their times."""
_MIN_VALID = 0.5
"""Share of the cells of a band that are above the black level."""
_MIN_OVERLAP = 0.4
"""Of the cells of a capture; flights have 60 to 85 % of overlap along a line."""
_MAX_MISFIT, _MAX_MISFIT_SHARE = 0.1, 0.5
"""Median difference of the logarithms of the cells of the same ground, after their common part, and relative to that at
other shifts: 0.02 to 0.09 and 8 to 55 % in captures that overlap, 0.06 to 0.11 and more than 60 % in others.
"""
_SUCCESSIVE_S = 5.0
"""Between captures that overlap in any flight, so that the shift need not be clear."""
_MAX_JUMP = math.log(1.2)
"""Of the logarithm of a band: eight pairs of overlapping captures differ by up to 8 %."""

Cells = NDArray[np.float64]
"""Logarithms (bands, 12, 16) of the means of the cells of a capture."""


@dataclass(frozen=True)
class _CaptureCells:
    """The cells of the bands of a capture."""

    label: str
    time_s: float
    """Unix time; nan if it is unknown."""
    quantities: Set[str]
    """Such as `reflectance` or `radiance`, of all bands together."""
    bands: tuple[str, ...]
    cells: Cells

    @classmethod
    def of(cls, label: str, captured_at: str, output: OutputPart) -> Self | None:
        """Return the cells of the bands of a capture; None without any."""
        means = [(part, part.cell_means) for part in output.band_radiometry if part.cell_means is not None]
        usable = [(part, cells) for part, cells in means if np.mean(cells > 0) > _MIN_VALID]
        if not usable:
            return None
        cells = np.log(np.array([np.where(c > 0, c, np.nan) for _, c in usable]))
        quantities = {part.quantity or output.radiometry or "" for part, _ in usable}
        time_s = known_time_s(captured_at)
        bands = tuple(part.band for part, _ in usable)
        return cls(label, math.nan if time_s is None else time_s, quantities, bands, cells)

    def apart_s(self, other: Self) -> float:
        """Return the time between two captures."""
        return abs(self.time_s - other.time_s)

    def is_comparable(self, other: Self) -> bool:
        """Return True for another capture with the reflectance of the same bands, nearly at the same time."""
        is_same = self.bands == other.bands and self.quantities == other.quantities
        are_reflectance = all("reflectance" in quantity for quantity in self.quantities)
        return is_same and are_reflectance and self.apart_s(other) <= _MAX_APART_S

    def jumps(self, other: Self) -> Iterator[Caution]:
        """Yield the bands that differ from another capture over the same ground."""
        own, others = (np.nanmedian(c.cells, axis=(1, 2)) for c in (self, other))
        if (np.abs(own - others) <= _MAX_JUMP / 2).all():
            return  # most captures: the search takes 10 ms
        jumps = same_ground(other.cells, self.cells, is_certain=self.apart_s(other) <= _SUCCESSIVE_S)
        if jumps is None:
            return
        for band, jump in zip(self.bands, jumps.tolist(), strict=True):
            if abs(jump) > _MAX_JUMP:
                share = math.expm1(jump)
                way = "brighter" if share > 0 else "darker"
                reason = f"{abs(share):.0%} {way} than in {other.label} over the same ground"
                yield Caution(band, JUMP, reason, min(1.0, abs(share)), abs(share), f"up to {abs(share):.0%}")


@dataclass
class LightOverCaptures:
    """The mean values of the captures of a run, which are added one by one and not kept."""

    _corners: dict[tuple[str, str], list[float]] = field(default_factory=lambda: defaultdict(list))
    """Logarithms of the ratios of corners to middle, by camera and band."""
    _recent: dict[str, deque[_CaptureCells]] = field(default_factory=lambda: defaultdict(lambda: deque(maxlen=_RECENT)))
    """The last captures by camera."""

    def add(self, label: str, camera: str, captured_at: str, output: OutputPart | None) -> Iterator[Caution]:
        """Add a capture, and yield the bands that differ from the capture nearest in time over the same ground."""
        own = None if output is None else _CaptureCells.of(label, captured_at, output)
        if own is None:
            return
        for band, cells in zip(own.bands, own.cells, strict=True):
            if math.isfinite(ratio := _corner_ratio(cells)):
                self._corners[camera, band].append(ratio)
        near = [other for other in self._recent[camera] if own.is_comparable(other)]
        if near:
            yield from own.jumps(min(near, key=own.apart_s))
        self._recent[camera].append(own)

    def uneven(self) -> Iterator[Caution]:
        """Yield the bands whose mean over many captures is not flat: scenes differ, the lens does not."""
        for (camera, band), logarithms in self._corners.items():
            count, mean = len(logarithms), float(np.mean(logarithms))
            std = float(np.std(logarithms)) / math.sqrt(count)
            if count >= _MIN_CAPTURES and abs(mean) > max(_MAX_UNEVEN, _MIN_UNEVEN_STD * std):
                share = math.expm1(mean)
                reason = f"in {count} captures, the corners are {share:+.0%} from the middle (± {std:.0%})"
                lost = min(1.0, abs(share)) * count
                size, last = f"up to {abs(share):.0%}", self._recent[camera][-1].label
                yield Caution(band, NOT_FLAT, reason, lost, abs(share), size, capture=last, captures=count)


def same_ground(one: Cells, other: Cells, *, is_certain: bool) -> NDArray[np.float64] | None:
    """Return the median difference (bands,) of two captures over the ground that both show; None if none is found.

    The captures are shifted by whole cells in every way that leaves enough of them in common. The shift counts at
    which the bands differ from each other by the same amount everywhere, whatever that is. `is_certain` says that they
    do show the same ground.
    """
    rows, columns = one.shape[1:]
    best: tuple[float, NDArray[np.float64]] | None = None
    misfits = []
    for down in range(1 - rows, rows):
        for right in range(1 - columns, columns):
            if (rows - abs(down)) * (columns - abs(right)) < _MIN_OVERLAP * rows * columns:
                continue
            here = one[:, max(0, down) : rows + min(0, down), max(0, right) : columns + min(0, right)]
            there = other[:, max(0, -down) : rows + min(0, -down), max(0, -right) : columns + min(0, -right)]
            difference = (there - here).reshape(len(one), -1)
            difference = difference[:, np.isfinite(difference).all(axis=0)]
            if difference.shape[1] < _MIN_OVERLAP * rows * columns / 2:
                continue
            common = np.median(difference, axis=1)
            misfit = float(np.median(np.abs(difference - common[:, np.newaxis]), axis=1).mean())
            misfits.append(misfit)
            if best is None or misfit < best[0]:
                best = misfit, common
    if best is None or best[0] > _MAX_MISFIT:
        return None
    is_clear = best[0] <= _MAX_MISFIT_SHARE * float(np.median(misfits))
    return best[1] if is_clear or is_certain else None


def _corner_ratio(cells: Cells) -> float:
    """The logarithm of the ratio of the corners of a band (rows, columns) to its middle; nan if one is invalid."""
    rows, columns = cells.shape
    y, x = np.mgrid[:rows, :columns]
    r = np.hypot(x - (columns - 1) / 2, y - (rows - 1) / 2) / math.hypot(columns / 2, rows / 2)
    corners, middle = (cells[area & np.isfinite(cells)] for area in (r > _CORNERS, r < _MIDDLE))
    return float(np.median(corners) - np.median(middle)) if corners.size and middle.size else math.nan
