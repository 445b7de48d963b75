"""Residual shifts of windows between the structures of two bands on one grid."""

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
"""Side of the windows: large enough for a clear peak over crops, small enough to localise misalignment."""
_MIN_WINDOW_PX = 32
"""Minimum side of the windows in small images; smaller windows have no reliable peak."""
_MIN_STRENGTH = 0.05
"""Minimum mean amplitude of the structure field, which is at most 1; weaker windows contain only noise."""
_MIN_PEAK_SIGMA = 7.0
"""Minimum correlation peak of a measured shift, in standard deviations of its surface; lower peaks may be chance."""
_FIELD_PX = 128
"""Side of the fields of a chessboard: twice that of a window."""
_MIN_VALID_SHARE = 0.9
"""Minimum share of a window's pixels that are valid in both images."""


class FixedWindows:
    """Windows of the reference with structure, at `centres_px` (n, 2); shifts are measured in any number of bands."""

    def __init__(
        self, valid: Mask, structure: Field, side_px: int = _WINDOW_PX, step_px: int | None = None,
        origins: Sequence[_Origin] | None = None,
    ) -> None:  # fmt: skip
        """Cut the structure field (height, width) of the reference into windows.

        `valid` (height, width) is its mask. Windows have a side of `side_px`, less on images smaller than four windows,
        and a spacing of `step_px`, by default without overlap; or their top left pixels are `origins` (x, y).
        """
        self.valid = valid
        height, width = valid.shape
        self.side = max(_MIN_WINDOW_PX, min(side_px, width // 4, height // 4))
        if origins is None:
            origins = [(x, y) for y in _starts(height, self.side, step_px) for x in _starts(width, self.side, step_px)]
        inside = [(x, y) for x, y in origins if x + self.side <= width and y + self.side <= height]
        self.origins, windows = self._strong(structure, inside)
        self.centres_px = self._centres_px(self.origins)
        self.spectra = windowed_spectra(windows)

    @classmethod
    def on_chessboard(cls, valid: Mask, structure: Field, side_px: int, *, white: bool) -> "FixedWindows":
        """Create 3 x 3 windows in each of the black or white fields of a chessboard.

        Windows of different colours share no pixels, so those of one colour can verify a fit to the other.
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

    def residuals(self, moving: Raster, min_valid: float = _MIN_VALID_SHARE) -> Residual[FixedImagePx]:
        """Measure the shift of each window in a moving band on the reference grid, px; NaN without a clear peak.

        Windows with a smaller share of valid pixels than `min_valid` are omitted: the outline of an invalid area biases
        the shift, by some tenths of a px in windows of 64 px with a twentieth of invalid pixels.
        """
        valid = self.valid & moving.valid
        field = structure_field(moving)
        min_count = min_valid * self.side**2
        usable = [o for o in self.origins if np.count_nonzero(self._cut(valid, o)) >= min_count]
        origins, windows = self._strong(field, usable)
        rows = {o: i for i, o in enumerate(self.origins)}
        fixed = self.spectra if len(origins) == len(rows) else self.spectra[[rows[o] for o in origins]]
        shifts_px, sigma = _peaks(whitened_cross_spectra(fixed, windowed_spectra(windows)))
        return Residual.of(self._centres_px(origins), shifts_px, sigma)

    def _centres_px(self, origins: Sequence[_Origin]) -> NDArray[np.float64]:
        return np.asarray(np.array(origins, dtype=np.float64).reshape(-1, 2) + (self.side - 1) / 2)

    def _cut(self, image: NDArray[Any], origin: _Origin) -> NDArray[Any]:
        x, y = origin
        return image[y : y + self.side, x : x + self.side]

    def _strong(self, field: Field, origins: list[_Origin]) -> tuple[list[_Origin], Field]:
        """Return the origins of the windows with structure, and the windows (n, side, side) minus their means.

        The mean orientation of a row crop is the same everywhere and contains no information on the position.
        """
        windows = np.empty((len(origins), self.side, self.side), np.complex64)
        for window, origin in zip(windows, origins, strict=True):
            window[:] = self._cut(field, origin)
        is_strong = np.abs(windows[:, ::2, ::2]).mean(axis=(1, 2)) >= _MIN_STRENGTH
        if not is_strong.all():
            windows = windows[is_strong]
        windows -= windows.mean(axis=(1, 2), keepdims=True)
        return [o for o, strong in zip(origins, is_strong, strict=True) if strong], windows


def residual_under(residual: Residual[FixedPx], before: PixelMapping, after: PixelMapping) -> Residual[FixedPx]:
    """Convert the residual of windows measured with the mapping `before` to a mapping `after` that is nearly equal.

    A point p + s of the fixed image, mapped by `before`, corresponds to p + s - d, mapped by `after`, with
    before(p + s) = after(p + s - d). d is computed to first order in the difference of the mappings.
    """
    shifts = residual.shifts_px
    points = residual.centres_px + np.nan_to_num(shifts)
    jacobians = np.stack([before(points + e) - before(points - e) for e in 0.5 * np.eye(2)], axis=-1)
    difference = np.linalg.solve(jacobians, (after(points) - before(points))[..., None])[..., 0]
    return Residual.of(residual.centres_px, shifts - difference, residual.peaks_sigma)


def decrease_sigma(before_px: NDArray[np.float64], after_px: NDArray[np.float64]) -> float:
    """Return the mean decrease of squared shifts with lengths (n,), in standard errors.

    Lengths are clipped at twice the p95 of `before_px`, which limits the influence of wrong peaks.
    """
    limit_px = 2 * np.percentile(before_px, 95)
    decrease = np.minimum(before_px, limit_px) ** 2 - np.minimum(after_px, limit_px) ** 2
    return float(decrease.mean() / max(decrease.std() / math.sqrt(len(decrease)), 1e-12))


def _starts(length: int, side: int, step: int | None) -> list[int]:
    """Return the first pixels of equally spaced windows along an axis; without `step` they cover it once."""
    count = max(1, math.ceil(length / side) if step is None else 1 + math.ceil((length - side) / step))
    return [round(v) for v in np.linspace(0, max(0, length - side), count)]


def _peaks(cross: Field) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shifts (n, 2) px of cross spectra, NaN without a clear peak, and the peak heights (n,) in sigma."""
    count, height, width = cross.shape
    surfaces = inverse_transform(cross).real.reshape(count, height * width)
    highest = surfaces.argmax(axis=1)
    # The surfaces have mean 0, because the windows have.
    std = np.sqrt(np.einsum("ni,ni->n", surfaces, surfaces) / (height * width))
    sigma = surfaces[np.arange(count), highest] / np.where(std > 0, std, np.inf)
    row, column = np.divmod(highest, width)
    # Shifts are circular: beyond half a window they are negative.
    coarse = np.stack([(column + width // 2) % width - width // 2, (row + height // 2) % height - height // 2], axis=1)
    shifts_px = np.full((count, 2), np.nan)
    is_clear = sigma >= _MIN_PEAK_SIGMA
    shifts_px[is_clear] = peak_positions(cross[is_clear], coarse[is_clear].astype(np.float64))
    return shifts_px, sigma.astype(np.float64)
