"""What remains after an alignment: shifts of windows between the two images, and the similarity of their pixels."""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import dataclasses as validated
from scipy.spatial import cKDTree

from agalign.values.fields import RECORD, Array, Number6, equal
from agalign.values.geometry import PairScales
from agalign.values.least_squares import mean_in_standard_errors
from agalign.values.pixel_units import PixelScale

_NOISE_PX_SIGMA2 = 48.0
"""RMS noise of the shift of a window times the squared height of its peak, in windows of 40 to 64 px: the median shift
of aligned windows is 0.7 to 1.35 of that noise in sharp, noisy and blurred scenes, with peaks of 8 sigma to 30. Shifts
of windows of 100 and 160 px have 1.3 to 5 times that noise. The constant stands for wrong peaks too: with an estimate
by the phases alone, which is accurate for right peaks in windows of any size, the expected errors of noisy bands are up
to four times as large."""


_TOLERATED_NOISE = 1 / 100
"""Noise of a shift from which its weight decreases, relative to the spacing of the windows: 1.1 px for windows of 112
px, 0.3 px for those of 64 px that overlap by half. In images with 30 % of noise, the error by windows without weights
is up to five times that at tie points. With 1/150, a blurred band passes whose error is above 1 px at a tenth of the
tie points: low peaks of blurred images are not noise alone."""


_MAX_WEIGHT = 4.0
"""Of a shift in a fit: the parts with most texture do not determine the geometry of the others."""


def noise_px(peaks_sigma: ArrayLike) -> NDArray[np.float64]:
    """Return the RMS noise (n,) of the length of measured shifts from the heights (n,) of their correlation peaks."""
    with np.errstate(divide="ignore"):  # a height of 0 has infinite noise
        return np.asarray(_NOISE_PX_SIGMA2 / np.square(peaks_sigma))


def peak_weights(peaks_sigma: NDArray[np.float64], noise_of_1_px: float | None = None) -> NDArray[np.float64]:
    """Return the weights of shifts in a fit from the heights of their correlation peaks, of the same shape; 0 for a
    height of 0.

    They are inversely proportional to the variances, and 1 for a noise of `noise_of_1_px`, by default that of the
    median peak; the largest is _MAX_WEIGHT.
    """
    if noise_of_1_px is None:
        positive = peaks_sigma[peaks_sigma > 0]
        noise_of_1_px = float(noise_px(np.median(positive))) if positive.size else 1.0
    return np.minimum(np.square(noise_of_1_px / noise_px(peaks_sigma)), _MAX_WEIGHT)


@validated.dataclass(frozen=True, config=RECORD)
class Residual:
    """Shifts of windows under a mapping, by phase correlation.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> residual = result.residual
    >>> residual.median_px < 0.1, residual.p95_px < 0.1, residual.std_px < 0.1, residual.coverage
    (True, True, True, 1.0)
    >>> residual.shifts_px.shape, residual.lengths_px.shape, int(residual.is_measured.sum())
    ((24, 2), (24,), 24)
    >>> x_px, y_px = residual.measured_px[residual.lengths_px.argmax()]  # window with the largest shift
    """

    __eq__ = equal

    centres_px: Annotated[NDArray[np.float64], Array((None, 2), 2)]
    """(n, 2) centres of the windows, px of the reference."""
    shifts_px: Annotated[NDArray[np.float64], Array((None, 2), 3, nullable=True)]
    """(n, 2) position of the moving band's structure minus that of the reference's, px of the reference; NaN, null in
    JSON, where it could not be measured."""
    peaks_sigma: Annotated[NDArray[np.float64], Array((None,), 2, nullable=True)]
    """(n,) height of the correlation peak of each window, in standard deviations; the error of a shift is inversely
    proportional to its square. In px of a file that was reduced, the height of a shift with the same error."""
    cells: Annotated[NDArray[np.int64], Array((None, 2), integers=True)]
    """(n, 2) column and row of each window in the complete grid, whichever windows of it are measured."""

    def __post_init__(self) -> None:
        """Raise ValueError for arrays of different lengths."""
        if len({len(column) for column in (self.centres_px, self.shifts_px, self.peaks_sigma, self.cells)}) > 1:
            raise ValueError("its lists have different lengths")

    @classmethod
    def joined(cls, several: Sequence["Residual"]) -> "Residual":
        """Return the windows of several residuals as one."""
        return cls(*(np.concatenate([getattr(one, f.name) for one in several]) for f in fields(cls)))

    def with_shifts(self, shifts_px: NDArray[np.float64]) -> "Residual":
        """Return the same windows with other shifts (n, 2)."""
        return replace(self, shifts_px=shifts_px)

    @property
    def is_measured(self) -> NDArray[np.bool_]:
        """(n,) True for windows in which a shift was measured."""
        return np.isfinite(self.shifts_px[:, 0])

    @cached_property
    def lengths_px(self) -> NDArray[np.float64]:
        """(m,) lengths of the measured shifts, px of the reference."""
        return np.asarray(np.linalg.norm(self.shifts_px[self.is_measured], axis=1))

    @property
    def median_px(self) -> float:
        """Median length of the measured shifts, px of the reference; infinite without any."""
        return self._percentiles_px[0]

    @property
    def p95_px(self) -> float:
        """95th percentile of the lengths of the measured shifts, px of the reference; infinite without any."""
        return self._percentiles_px[1]

    @cached_property
    def _percentiles_px(self) -> tuple[float, float]:
        median, p95 = np.percentile(self.lengths_px, (50, 95)).tolist() if len(self.lengths_px) else (np.inf, np.inf)
        return median, p95

    @property
    def coverage(self) -> float:
        """Share of the textured windows in which a shift could be measured."""
        return float(self.is_measured.mean()) if len(self.shifts_px) else 0.0

    @property
    def std_px(self) -> float:
        """Standard error estimated from the windows, px: their RMS shift beyond the noise of their peaks; infinite
        without any.

        A fifth of the windows may be wrong peaks or at depth edges: the RMS is the larger of those of a normal
        distribution with the same median, and with the same 80th percentile. Windows are weighted by their noise. At
        least half of the RMS is kept, because the noise is known only to a factor.
        """
        if not len(self.lengths_px):
            return math.inf
        noise, weights = noise_px(self.peaks_sigma[self.is_measured]), square_weights(self)

        def quantile(values: NDArray[np.float64], p: float) -> float:
            return float(np.quantile(values, p, weights=weights, method="inverted_cdf"))

        # Of a Rayleigh distribution: sqrt(-2 log(1 - p)) for the quantile p, and sqrt(2) for the RMS.
        rms_px = max(quantile(self.lengths_px, p) / math.sqrt(-math.log(1 - p)) for p in (0.5, 0.8))
        return math.sqrt(max(rms_px**2 - quantile(noise, 0.5) ** 2, (rms_px / 2) ** 2))

    def where(self, selected: NDArray[np.bool_]) -> "Residual":
        """Return the windows where a mask (n,) is True."""
        shifts_px, peaks_sigma, cells = self.shifts_px[selected], self.peaks_sigma[selected], self.cells[selected]
        return Residual(self.centres_px[selected], shifts_px, peaks_sigma, cells)

    @property
    def measured_px(self) -> NDArray[np.float64]:
        """(m, 2) centres of the windows in which a shift was measured, px of the reference."""
        return self.centres_px[self.is_measured]

    @cached_property
    def spacing_px(self) -> float:
        """Median distance from a window to the nearest one elsewhere, px; at least 1."""
        places_px = np.unique(self.centres_px, axis=0)  # several captures have windows at the same places
        if len(places_px) < 2:
            return 1.0
        return max(1.0, float(np.median(cKDTree(places_px).query(places_px, k=2)[0][:, 1])))

    def in_file_px(self, scales: PairScales) -> "Residual":
        """Convert the residual to px of the reference band's file."""
        return self.rescaled(scales.fixed.inverse)

    def rescaled(self, scale: PixelScale) -> "Residual":
        """Return the same on a reference that is resized by `scale`; peaks have the height that belongs to the noise of
        their shifts there.
        """
        centres_px, shifts_px = scale.positions(self.centres_px), scale.displacements(self.shifts_px)
        return replace(
            self, centres_px=centres_px, shifts_px=shifts_px, peaks_sigma=self.peaks_sigma / math.sqrt(scale.mean)
        )


def square_weights(residual: Residual) -> NDArray[np.float64]:
    """Return the weights (m,) of the squares of measured shifts, up to 1: inversely proportional to their variances."""
    noise = noise_px(residual.peaks_sigma[residual.is_measured])
    return np.asarray((1 + np.square(noise / (_TOLERATED_NOISE * residual.spacing_px))) ** -2)


def decrease_in_standard_errors(before: Residual, after: Residual) -> float:
    """Return the mean decrease of held-out shifts relative to its standard error, in the windows that both residuals
    have measured; 0 if these are few.

    It is that of log(1 + (length / 0.3 px)^2), which is robust to wrong peaks. The windows are of one grid.
    """
    scale_px = 0.3
    before_px, after_px = lengths_in_common_px(before, after)
    losses = [np.log1p((px / scale_px) ** 2) for px in (before_px, after_px)]
    return mean_in_standard_errors(losses[0] - losses[1])


def lengths_in_common_px(one: Residual, other: Residual) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lengths (m,) of the shifts of two residuals in windows that both have measured, px of the reference.

    Their windows are of one grid.
    """
    one, other = (residual.where(residual.is_measured) for residual in (one, other))
    key = np.array([1 << 32, 1])  # column and row in one number
    _, first, second = np.intersect1d(one.cells @ key, other.cells @ key, return_indices=True)
    return one.lengths_px[first], other.lengths_px[second]


@validated.dataclass(frozen=True, config=RECORD)
class Similarity:
    """Similarity of the pixels that are valid in both bands; null: not measured. Large images are sampled.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> result.before.nmi < 1.01, result.after.nmi > 1.4
    (True, True)
    >>> round(result.after.ncc, 2), round(result.after.gradient_correlation, 2)  # reversed contrast, equal edges
    (-1.0, 1.0)
    """

    __eq__ = equal

    mattes_mi: Number6 = math.nan
    """Negative Mattes mutual information, nats, 32 bins: lower is better."""
    nmi: Number6 = math.nan
    """Normalised mutual information, 1 to 2: higher is better."""
    ncc: Number6 = math.nan
    """Normalised cross-correlation; negative if contrast is reversed."""
    gradient_correlation: Number6 = math.nan
    """Correlation of gradient magnitudes."""
    structure_ssim: Number6 = math.nan
    """SSIM of structure images."""
    overlap: Number6 = math.nan
    """Share of the image in which both bands are valid."""
    residual_px: Number6 = math.nan
    """Median length of the windows' shifts, px of the reference."""
    residual_p95_px: Number6 = math.nan
    """Their 95th percentile."""
    residual_coverage: Number6 = math.nan
    """Share of the textured windows with a measured shift."""
