"""Residual shifts between the structures of two bands on one grid, window by window."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.pixels.structure import (
    Field,
    inverse_transform,
    peak_positions,
    structure_field,
    whitened_cross_spectra,
    windowed_spectra,
)
from agalign.values.alignment import Residual
from agalign.values.image import Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx, FixedPx

_Origin = tuple[int, int]

_WINDOW_PX = 112
"""Side of the windows: large enough for a plain peak over crops, small enough to localise what is not aligned."""
_MIN_WINDOW_PX = 32
"""Smaller windows of small images have no reliable peak."""
_MIN_STRENGTH = 0.05
"""Mean structure, of at most 1, below which a window shows only noise."""
_MIN_PEAK_SIGMA = 7.0
"""Correlation peak, in standard deviations of its surface, from which a shift counts: lower peaks are chance."""
_FIELD_PX = 128
"""Side of the fields of a chessboard: twice that of a window."""
_MIN_VALID = 0.9
"""Share of a window's pixels that must be valid in both images."""


class FixedWindows:
    """The reference cut into windows, ready to be compared with any number of moving bands."""

    def __init__(
        self, valid: Mask, structure: Field, side_px: int = _WINDOW_PX, step_px: int | None = None,
        origins: Sequence[_Origin] | None = None,
    ) -> None:  # fmt: skip
        """`valid` and `structure` (height, width) are those of the reference.

        Windows have a side of `side_px`, less on images smaller than four windows, and start every `step_px`, by
        default side by side; or they start at `origins` (x, y).
        """
        self.valid = valid
        height, width = valid.shape
        self.side = max(_MIN_WINDOW_PX, min(side_px, width // 4, height // 4))
        if origins is None:
            origins = [(x, y) for y in _starts(height, self.side, step_px) for x in _starts(width, self.side, step_px)]
        inside = [(x, y) for x, y in origins if x + self.side <= width and y + self.side <= height]
        self.origins, windows = self._strong(structure, inside)
        self.spectra = windowed_spectra(windows)

    @classmethod
    def on_chessboard(cls, valid: Mask, structure: Field, side_px: int, *, white: bool) -> "FixedWindows":
        """Three by three windows inside each of the black, or of the white, fields of a chessboard.

        Those of one colour share no pixel with those of the other: the ones can be fitted, the others verify.
        """
        height, width = valid.shape
        starts = range(0, _FIELD_PX - side_px + 1, (_FIELD_PX - side_px) // 2)
        origins = [
            (x + dx, y + dy)
            for y in range(0, height, _FIELD_PX)
            for x in range(0, width, _FIELD_PX)
            if ((x + y) // _FIELD_PX) % 2 == int(white)
            for dy in starts
            for dx in starts
        ]
        return cls(valid, structure, side_px, origins=origins)

    def residuals(self, moving: Raster, min_valid: float = _MIN_VALID) -> Residual[FixedImagePx]:
        """The shift of each window's content, px; nan where no correlation peak stands out.

        Windows with a smaller share of valid pixels than `min_valid` are left out. An invalid area has no structure,
        but its outline biases the shift: by some tenths of a px in windows of 64 px with a twentieth missing.
        """
        both = self.valid & moving.valid
        field = structure_field(moving)
        minimum = min_valid * self.side**2
        valid = [o for o in self.origins if np.count_nonzero(self._cut(both, o)) >= minimum]
        origins, windows = self._strong(field, valid)
        rows = {o: i for i, o in enumerate(self.origins)}
        tried = self.spectra if len(origins) == len(rows) else self.spectra[[rows[o] for o in origins]]
        cross = whitened_cross_spectra(tried, windowed_spectra(windows))
        result, sigma = _peaks(cross)
        return Residual.of(self._centres_px(origins), result, sigma)

    @property
    def centres_px(self) -> NDArray[np.float64]:
        """(n, 2) of the windows with structure."""
        return self._centres_px(self.origins)

    def _centres_px(self, origins: Sequence[_Origin]) -> NDArray[np.float64]:
        return np.asarray(np.array(origins, dtype=np.float64).reshape(-1, 2) + (self.side - 1) / 2)

    def _cut(self, image: NDArray[Any], origin: _Origin) -> NDArray[Any]:
        x, y = origin
        return image[y : y + self.side, x : x + self.side]

    def _strong(self, field: Field, origins: list[_Origin]) -> tuple[list[_Origin], Field]:
        """(origins of the windows with structure; their content (n, side, side), each without its mean).

        The mean orientation of a row crop is the same everywhere and does not distinguish places.
        """
        cut = np.empty((len(origins), self.side, self.side), np.complex64)
        for window, origin in zip(cut, origins, strict=True):
            window[:] = self._cut(field, origin)
        strong = np.abs(cut[:, ::2, ::2]).mean(axis=(1, 2)) >= _MIN_STRENGTH
        if not strong.all():
            cut = cut[strong]
        cut -= cut.mean(axis=(1, 2), keepdims=True)
        return [o for o, s in zip(origins, strong, strict=True) if s], cut


def residual_under(residual: Residual[FixedPx], before: PixelMapping, after: PixelMapping) -> Residual[FixedPx]:
    """The residual of windows measured under one mapping, as it is under another one that is all but equal.

    The content at p + s of the fixed image under `before` is at p + s - d under `after`, with before(p + s) =
    after(p + s - d); d to first order in the difference of the two.
    """
    shifts = residual.shifts_px
    at = residual.centres_px + np.nan_to_num(shifts)
    slopes = np.stack([before(at + e) - before(at - e) for e in 0.5 * np.eye(2)], axis=-1)
    farther = np.linalg.solve(slopes, (after(at) - before(at))[..., None])[..., 0]
    return Residual.of(residual.centres_px, shifts - farther, residual.peaks_sigma)


def _starts(length: int, side: int, step: int | None) -> list[int]:
    count = max(1, math.ceil(length / side) if step is None else 1 + math.ceil((length - side) / step))
    return [round(v) for v in np.linspace(0, max(0, length - side), count)]


def _peaks(cross: Field) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """((n, 2) shifts, nan where no peak stands out; (n,) heights in standard deviations) of cross spectra."""
    count, height, width = cross.shape
    surfaces = inverse_transform(cross).real.reshape(count, height * width)
    highest = surfaces.argmax(axis=1)
    # Their means are 0: the windows have none.
    spread = np.sqrt(np.einsum("ni,ni->n", surfaces, surfaces) / (height * width))
    sigma = surfaces[np.arange(count), highest] / np.where(spread > 0, spread, np.inf)
    row, column = np.divmod(highest, width)
    # Shifts are circular: beyond half a window they are negative.
    at = np.stack([(column + width // 2) % width - width // 2, (row + height // 2) % height - height // 2], axis=1)
    result = np.full((count, 2), np.nan)
    plain = sigma >= _MIN_PEAK_SIGMA
    result[plain] = peak_positions(cross[plain], at[plain].astype(np.float64))
    return result, sigma.astype(np.float64)
