"""Residual shifts of windows between the structures of two bands on one grid."""

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from agalign.pixels.structure import (
    Field,
    forward_transform,
    inverse_transform,
    peak_positions,
    structure_field,
    whitened_cross_spectra,
    windowed_spectra,
)
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.residual import Residual, peak_weights

_Element = TypeVar("_Element", bound=np.generic)

_WINDOW_PX = 112
"""Side of the windows that verify an alignment: large enough for a clear peak over crops, small enough to localise
misalignment."""
LARGE_WINDOW_PX = 168
"""Side of those in blurred images: 15 x 10 blurs of 3 px."""
RELIEF_FIT_WINDOW_PX = 48
"""Side of the windows that planes and baselines are fitted to: small, so that most contain a single surface."""
RELIEF_CHECK_WINDOW_PX = 64
"""Side of the windows that verify a relief; larger, because their shifts have less noise."""
MIN_WINDOW_PX = 32
"""Side of windows between saturated areas, and minimum in small images; smaller windows have no reliable peak."""
_MIN_VALID_SHARE = 0.3
"""Minimum share of valid pixels in a window. With 0.4, shifts of windows of 112 px have errors of 0.09 px instead of
0.05 px (a row crop with a known shift)."""
_PASS_FREQUENCY = 0.4
"""Cycles per px at which the subpixel shift uses 1/e of a spectrum. Products of gradients have aliases of their higher
frequencies, which are at rest with the pixels: with all of them, shifts below half a pixel are measured as 0.78 to 0.85
of their length (four bands, moved by known shifts), with this limit as 0.88 to 0.92, and the noise is 3 % larger. With
0.3, shifts are less biased, but images of half the size have errors that are a seventh larger."""
_MAX_IGNORED_SHARE = 0.01
"""Share of masked pixels in a window that does not bias its shift."""


class FixedWindows:
    """Windows of the reference with structure, at `centres_px` (n, 2); shifts are measured in any number of bands."""

    def __init__(
        self,
        valid: Mask,
        structure: Field,
        side_px: int = _WINDOW_PX,
        step_px: int | None = None,
        origins: NDArray[np.int64] | None = None,
        min_valid_share: float = _MIN_VALID_SHARE,
    ) -> None:
        """Cut the structure field (height, width) of the reference into windows.

        `valid` (height, width) is its mask. Windows have a side of `side_px`, less on images smaller than four windows,
        and a spacing of `step_px`, or their top left pixels are `origins` (n, 2), (x, y). By default they are a little
        smaller and share no pixels.
        """
        height, width = valid.shape
        self.valid = _inside(valid)
        self.side = max(MIN_WINDOW_PX, min(side_px, width // 4, height // 4))
        if origins is None and step_px is None:
            self.side = _covering_side(self.side, width, height)
        self.min_valid = min(1.0, max(min_valid_share, (MIN_WINDOW_PX / self.side) ** 2))
        """Minimum share of valid pixels: at least as many as the smallest windows have."""
        if origins is None:
            origins = _grid(*(_starts(length, self.side, step_px) for length in (width, height)))
        # From the complete grid: windows that drop out later must not change the column and row of the others.
        cells = np.stack([np.unique(along, return_inverse=True)[1] for along in origins.T], axis=1)
        inside = (origins + self.side <= (width, height)).all(axis=1)
        self.origins = origins[inside]
        counts, every = self._valid_counts(self.valid), np.arange(len(self.origins))
        rows, spectra = zip(*self._spectra(structure, self.valid, every, counts), strict=True)
        strong = np.concatenate(rows)
        self.origins, self.cells, self.spectra = self.origins[strong], cells[inside][strong], np.concatenate(spectra)
        self.centres_px = self.origins + (self.side - 1) / 2

    @classmethod
    def on_chessboard(
        cls, valid: Mask, structure: Field, side_px: int, *, white: bool, min_valid_share: float = _MIN_VALID_SHARE
    ) -> "FixedWindows":
        """Create 3 x 3 windows in each of the black or white fields of a chessboard over a mask (height, width).

        Windows of different colours share no pixels, so those of one colour can verify a fit to the other.
        """
        height, width = valid.shape
        field_px = 128  # twice the side of a window
        corners = _grid(range(0, width, field_px), range(0, height, field_px))
        corners = corners[corners.sum(axis=1) // field_px % 2 == int(white)]
        starts = range(0, field_px - side_px + 1, (field_px - side_px) // 2)
        origins = (corners[:, None] + _grid(starts, starts)).reshape(-1, 2)
        return cls(valid, structure, side_px, origins=origins, min_valid_share=min_valid_share)

    def residuals(self, moving: Raster) -> Residual:
        """Measure the shift of each window in a moving band on the reference grid, px; NaN without a clear peak."""
        return self.correlated(moving)[0]

    def correlated(self, moving: Raster) -> tuple[Residual, Field]:
        """Measure the shift of each window in a moving band on the reference grid, px; NaN without a clear peak. Also
        return the sum (1, side, side) of the cross spectra of every second window without invalid pixels.

        A window is measured by the pixels that are valid in both images; the fewer these are, the lower is the peak,
        and with it the weight of the shift. Windows with too few are omitted.
        """
        mask, structure = _inside(moving.valid), structure_field(moving)
        share, counts = self._valid_counts(self.valid & mask) / self.side**2, self._valid_counts(mask)
        with_pixels, parts = np.flatnonzero(share >= self.min_valid), []
        is_complete, is_summed = share >= 1 - _MAX_IGNORED_SHARE, np.zeros(len(share), dtype=bool)
        is_summed[np.flatnonzero(is_complete)[::2]] = True
        total = np.zeros((1, self.side, self.side), np.complex64)
        for rows, spectra in self._spectra(structure, mask, with_pixels, counts):
            cross = whitened_cross_spectra(self.spectra[rows], spectra)
            total += cross[is_summed[rows]].sum(axis=0)
            masked = ~is_complete[rows]
            if masked.any():
                fixed, other = (self._cut(valid, self.origins[rows[masked]]) for valid in (self.valid, mask))
                cross[masked] = _relative_to_overlap(cross[masked], fixed, other)
            parts.append((rows, *_peaks(cross)))
        rows, shifts_px, sigma = map(np.concatenate, zip(*parts, strict=True))
        return Residual(self.centres_px[rows], shifts_px, sigma, self.cells[rows]), total

    def _cut(self, image: NDArray[_Element], origins: NDArray[np.int64]) -> NDArray[_Element]:
        """Return (n, side, side) the windows with these origins, a copy."""
        if not len(origins):  # the image may be smaller than a window
            return np.empty((0, self.side, self.side), image.dtype)
        x, y = origins.T
        return np.asarray(sliding_window_view(image, (self.side, self.side))[y, x])

    def _valid_counts(self, valid: Mask) -> NDArray[np.int64]:
        """Return the number (n,) of valid pixels in the windows."""
        sums, (x, y), side = cv2.integral(valid.view(np.uint8)), self.origins.T, self.side
        return np.asarray(sums[y + side, x + side] - sums[y, x + side] - sums[y + side, x] + sums[y, x], np.int64)

    def _spectra(
        self, field: Field, valid: Mask, rows: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], Field]]:
        """Yield the windows with structure among some windows, `rows` (m,), and their spectra, a part at a time.

        `counts` (n,) are the valid pixels of all windows.
        """
        at_once = 64  # windows that fit into the CPU's cache: a quarter faster
        for first in range(0, max(len(rows), 1), at_once):
            part = rows[first : first + at_once]
            is_strong, windows = self._strong(field, valid, self.origins[part], counts[part])
            yield part[is_strong], windowed_spectra(windows)

    def _strong(
        self, field: Field, valid: Mask, origins: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], Field]:
        """Return True (n,) for windows with structure, and these windows (m, side, side) minus their means.

        The mean orientation of a row crop is the same everywhere and contains no information on the position. Mean and
        amplitude are those of the valid pixels, of which the windows have `counts` (n,); the others are 0.
        """
        windows, counts = self._cut(field, origins), np.maximum(counts, 1)
        min_amplitude = 0.05  # of the structure field, at most 1; weaker windows contain only noise
        amplitude = np.abs(windows[:, ::2, ::2]).mean(axis=(1, 2)) * (self.side**2 / counts)
        is_strong = (amplitude >= min_amplitude) & (counts >= self.min_valid * self.side**2)
        if not is_strong.all():
            windows, counts, origins = windows[is_strong], counts[is_strong], origins[is_strong]
        windows -= (windows.sum(axis=(1, 2)) / counts)[:, None, None]
        is_partly_valid = counts < self.side**2
        windows[is_partly_valid] *= self._cut(valid, origins[is_partly_valid])
        return is_strong, windows


def _inside(valid: Mask) -> Mask:
    """Return a mask without the pixels next to invalid ones, in which the structure field is 0."""
    return np.asarray(cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0)


def _relative_to_overlap(cross: Field, fixed: Mask, moving: Mask) -> Field:
    """Return the spectra (n, side, side) of correlation surfaces divided by the overlap of the valid pixels.

    The number of pixel pairs that are valid in both windows depends on the shift. It has a maximum where the masks
    coincide, which attracts the peak, and by which masked correlation divides (Padfield 2012). `fixed` and `moving` are
    the masks of the windows.
    """
    one = windowed_spectra(np.ones((1, *cross.shape[1:]), np.complex64))
    complete = inverse_transform(np.conj(one) * one).real
    spectra = [windowed_spectra(mask.astype(np.complex64)) for mask in (fixed, moving)]
    overlap = inverse_transform(np.conj(spectra[0]) * spectra[1]).real
    min_complete = 1e-3  # of the maximum: the overlap of the Hann windows themselves at large shifts
    share = overlap / np.maximum(complete, min_complete * complete.max())
    at_zero = share[:, :1, :1]
    min_share = 0.5  # of that at zero shift: smaller overlaps would amplify noise
    surfaces = inverse_transform(cross).real * (at_zero / np.maximum(share, min_share * at_zero))
    return forward_transform(surfaces.astype(np.complex64))


def centred_correlation(cross: Field) -> NDArray[np.float32]:
    """Return the correlation surface (side, side) of a cross spectrum (1, side, side); [dy, dx] is the shift from the
    peak next to zero.
    """
    side = cross.shape[-1]
    passed = np.asarray(cross * _low_pass(side, side), np.complex64)
    shift_px = np.clip(peak_positions(passed, np.zeros((1, 2)))[0], -1, 1)
    y, x = np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)
    to_peak = np.exp(2j * np.pi * (x * shift_px[0] + y * shift_px[1])).astype(np.complex64)
    return np.asarray(inverse_transform(cross * to_peak).real[0])


class Shifts(NamedTuple):
    """The measured shifts of windows, (n, 2), with relative weights (n,) by heights of peaks; their median is 1."""

    centres_px: Points
    shifts_px: Points
    weights: NDArray[np.float64]

    @classmethod
    def of(cls, residual: Residual) -> "Shifts":
        """Select the measured shifts of a residual."""
        measured = residual.is_measured
        weights = peak_weights(residual.peaks_sigma[measured])
        return cls(residual.centres_px[measured], residual.shifts_px[measured], weights)

    @classmethod
    def joined(cls, several: Sequence["Shifts"]) -> "Shifts":
        return cls(*map(np.concatenate, zip(*several, strict=True)))

    def subset(self, mask: NDArray[np.bool_]) -> "Shifts":
        """Return the shifts where a mask (n,) is True."""
        return Shifts(self.centres_px[mask], self.shifts_px[mask], self.weights[mask])

    def distances_px(self, predicted_px: Points | float = 0.0) -> NDArray[np.float64]:
        """Return (n,) the lengths of the shifts, minus predicted ones (n, 2)."""
        return np.asarray(np.linalg.norm(self.shifts_px - predicted_px, axis=1))


def residual_under(residual: Residual, before: PixelMapping, after: PixelMapping) -> Residual:
    """Convert the residual of windows measured with the mapping `before` to a mapping `after` that is nearly equal.

    A point p + s of the fixed image, mapped by `before`, corresponds to p + s - d, mapped by `after`, with
    before(p + s) = after(p + s - d). d is computed to first order in the difference of the mappings.
    """
    shifts = residual.shifts_px
    points = residual.centres_px + np.nan_to_num(shifts)
    jacobians = np.stack([before(points + e) - before(points - e) for e in 0.5 * np.eye(2)], axis=-1)
    difference = np.linalg.solve(jacobians, (after(points) - before(points))[..., None])[..., 0]
    return residual.with_shifts(shifts - difference)


def _grid(x: Sequence[int], y: Sequence[int]) -> NDArray[np.int64]:
    """Return (n, 2) all (x, y), row by row."""
    return np.stack(np.meshgrid(np.array(x, np.int64), np.array(y, np.int64)), axis=-1).reshape(-1, 2)


def _covering_side(max_px: int, *lengths_px: int) -> int:
    """Return the side, at most `max_px`, of windows that cover lengths without overlap and have a fast transform."""
    max_gap = 0.1  # of a window; a larger remainder is another window
    side = min(max_px, *(length // max(1, math.ceil(length / max_px - max_gap)) for length in lengths_px))
    return max((k for k in range(MIN_WINDOW_PX, side + 1) if cv2.getOptimalDFTSize(k) == k), default=MIN_WINDOW_PX)


def _starts(length: int, side: int, step: int | None) -> list[int]:
    """Return the first pixels of equally spaced windows along an axis; without `step` they share no pixels."""
    count = max(1, length // side if step is None else 1 + math.ceil((length - side) / step))
    return [round(v) for v in np.linspace(0, max(0, length - side), count)]


@cache
def _low_pass(height: int, width: int) -> NDArray[np.float32]:
    """Return the weight (height, width) of each frequency of a spectrum for the subpixel shift."""
    y, x = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)
    return np.exp(-(x**2 + y**2) / _PASS_FREQUENCY**2).astype(np.float32)


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
    min_peak_sigma = 7.0  # lower peaks may be chance
    is_clear = sigma >= min_peak_sigma
    passed = cross[is_clear] * _low_pass(height, width)
    shifts_px[is_clear] = peak_positions(passed, coarse[is_clear].astype(np.float64))
    return shifts_px, sigma.astype(np.float64)
