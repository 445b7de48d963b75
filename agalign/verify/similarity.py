"""Similarity metrics of two bands on one grid: Mattes mutual information, NMI, NCC, gradient correlation, SSIM.

All are deterministic. Gradients and local moments are computed at full resolution. Sums are over the common valid
pixels; in large images over those on a regular grid of at least 250 000 pixels.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import entr

from agalign.pixels.structure import gradient_magnitude
from agalign.values.image import FloatImage, Mask, Raster
from agalign.values.residual import Similarity

_BINS = 32
"""Bins of each axis of the joint histogram, as in elastix."""
_SUBBINS = 64
"""Moving values are counted in subdivisions of a bin before the spline is applied; the error is at most 1/128 bin."""
_SSIM_WINDOW_PX = 11
"""Side of the Gaussian window (Wang et al. 2004)."""


class FixedSimilarity:
    """Similarity of the reference to any number of moving bands on its grid; rasters have one channel."""

    def __init__(self, fixed: Raster) -> None:
        self.fixed = fixed
        enough_pixels = 250_000
        step = max(1, int((fixed.pixels.size / enough_pixels) ** 0.5))
        self.grid = np.s_[step // 2 :: step, step // 2 :: step]
        self.gradient = _Gradient.of(fixed.pixels, self.grid)
        self.sampled = fixed.pixels[self.grid].ravel()
        self.bins = fixed_bins(self.sampled, _range(fixed))

    def to(self, moving: Raster) -> Similarity:
        """Compute all metrics over the pixels that are valid in both rasters.

        Below 256 common pixels only the overlap is computed.
        gradient_correlation is Pearson's coefficient of the gradient magnitudes, structure_ssim the SSIM (Wang et
        al. 2004, 11 px Gaussian window) of the standardised ones; neither depends on the sign of contrast.
        """
        both = self.fixed.valid & moving.valid
        overlap = float(np.count_nonzero(both) / both.size)
        # Indices are faster than boolean masks.
        valid = np.flatnonzero(both[self.grid])
        min_pixels = 256  # a joint histogram of fewer is noise
        if len(valid) < min_pixels:
            return Similarity(overlap=overlap)
        fixed_values, moving_values = self.sampled[valid], moving.pixels[self.grid].ravel()[valid]
        joint = joint_histogram(self.bins[valid], moving_values, _range(replace(moving, valid=both)))
        gradient = _Gradient.of(moving.pixels, self.grid)
        inside = np.flatnonzero(_eroded(both, 3)[self.grid])
        gradients = self.gradient.sampled[inside], gradient.sampled[inside]
        complete_windows = np.flatnonzero(_eroded(both, _SSIM_WINDOW_PX)[self.grid])
        return Similarity(
            mattes_mi=-mutual_information(joint),
            nmi=normalised_mutual_information(joint),
            ncc=correlation(fixed_values, moving_values),
            gradient_correlation=correlation(*gradients) if len(inside) else math.nan,
            structure_ssim=_ssim(self.gradient, gradient, valid, complete_windows),
            overlap=overlap,
        )


def _eroded(valid: Mask, side_px: int) -> Mask:
    """Return True where all pixels of the surrounding square are valid."""
    eroded = cv2.erode(valid.astype(np.uint8), np.ones((side_px, side_px), np.uint8), borderValue=0)
    return np.asarray(eroded > 0)


def fixed_bins(fixed: NDArray[np.float32], limits: tuple[float, float]) -> NDArray[np.int32]:
    """Return the bins (n,) of fixed values (n,); `limits` are the minimum and maximum of the image."""
    # The cast truncates, which is floor for positive values.
    return (_bin_position(fixed, limits, padding=0) + 0.5).astype(np.int32)


def joint_histogram(
    bins: NDArray[np.int32], moving: NDArray[np.float32], limits: tuple[float, float]
) -> NDArray[np.float64]:
    """Return elastix's joint density of two samples (n,), (32, 32) with sum 1; the fixed sample is along rows.

    `bins` are the `fixed_bins` of the fixed sample, `limits` the minimum and maximum of the moving image. The Parzen
    kernel is a box for the fixed and the cubic B-spline for the moving image, which needs one bin of padding at both
    ends (Klein et al. 2010; Mattes 2003).
    """
    moving_subbins = (_bin_position(moving, limits, padding=1) * _SUBBINS).astype(np.int32)
    counts = np.bincount(bins * (_BINS * _SUBBINS) + moving_subbins, minlength=_BINS * _BINS * _SUBBINS)
    counts = counts.reshape(_BINS, _BINS * _SUBBINS)
    density = counts @ _kernel()
    return np.asarray(density / density.sum())


@cache
def _kernel() -> NDArray[np.float64]:
    """Return the contribution of each subdivision to each bin, (32 x 64, 32)."""
    centres = (np.arange(_BINS * _SUBBINS) + 0.5) / _SUBBINS
    return cubic_spline(centres[:, None] - np.arange(_BINS)[None, :])


def _range(image: Raster) -> tuple[float, float]:
    """Return the minimum and maximum of the valid values; (0, 1) without any."""
    low, high, _, _ = cv2.minMaxLoc(image.pixels, mask=image.valid.view(np.uint8))
    return (low, high) if image.valid.any() else (0.0, 1.0)


def _bin_position(values: NDArray[np.float32], limits: tuple[float, float], padding: int) -> NDArray[np.float32]:
    """Return the positions of values in units of bins, with empty bins (`padding`) at both ends."""
    low, high = limits
    margin = 0.01 * (high - low)  # as in elastix
    low, high = low - margin, high + margin
    bin_size = max((high - low) / (_BINS - 2 * padding - 1), 1e-12)
    # Subtracted first: of nearly constant images with large values, the quotients exceed float32.
    return np.asarray((values - np.float32(low - padding * bin_size)) * np.float32(1 / bin_size))


def cubic_spline(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate the cubic B-spline at x (...,).

    (4 - 6 x^2 + 3 |x|^3) / 6 for |x| < 1, (2 - |x|)^3 / 6 for 1 <= |x| < 2, else 0.
    """
    a = np.abs(x)
    return np.where(a < 1, (4 - 6 * a**2 + 3 * a**3) / 6, np.where(a < 2, (2 - a) ** 3 / 6, 0.0))


def mutual_information(joint: NDArray[np.float64]) -> float:
    """Return the sum of p log(p / (p_fixed p_moving)), in nats, of a joint histogram (bins, bins)."""
    of_each, of_both = _entropies(joint)
    return of_each - of_both


def normalised_mutual_information(joint: NDArray[np.float64]) -> float:
    """Return (H(fixed) + H(moving)) / H(fixed, moving), 1 if independent to 2 if identical (Studholme 1999)."""
    of_each, of_both = _entropies(joint)
    return of_each / of_both if of_both > 0 else 1.0


def _entropies(joint: NDArray[np.float64]) -> tuple[float, float]:
    """Return H(fixed) + H(moving) and H(fixed, moving), in nats."""
    fixed, moving, both = (float(entr(p).sum()) for p in (joint.sum(axis=1), joint.sum(axis=0), joint))
    return fixed + moving, both


def correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Return Pearson's coefficient of two samples (n,); 0 if either is constant."""
    a, b = (x - np.float32(x.mean(dtype=np.float64)) for x in (a, b))
    norm = float(np.sqrt(float(a @ a) * float(b @ b)))
    return float(a @ b) / norm if norm > 0 else 0.0


@dataclass(frozen=True)
class _Gradient:
    """Gradient magnitude (height, width) of an image; on a grid of n pixels also its moments in the SSIM window."""

    grid: tuple[slice, slice]
    magnitude: FloatImage
    sampled: NDArray[np.float32]
    local_mean: NDArray[np.float32]
    local_variance: NDArray[np.float32]

    @classmethod
    def of(cls, image: FloatImage, grid: tuple[slice, slice]) -> "_Gradient":
        gx, gy = (cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        magnitude = gradient_magnitude(gx, gy)
        mean, square = (_blur(x)[grid].ravel() for x in (magnitude, magnitude * magnitude))
        return cls(grid, magnitude, magnitude[grid].ravel(), mean, square - mean * mean)


def _ssim(fixed: _Gradient, moving: _Gradient, valid: NDArray[np.intp], complete: NDArray[np.intp]) -> float:
    """Return the mean SSIM of the gradient magnitudes over the samples with `complete` windows.

    NaN without any. The magnitudes are standardised over the `valid` samples; the local moments are transformed
    accordingly.
    """
    if not len(complete):
        return math.nan
    (mean_a, scale_a), (mean_b, scale_b) = (_standardisation(g.sampled[valid]) for g in (fixed, moving))
    if not scale_a * scale_b:  # one image is constant
        return 0.0
    a, b = (g.local_mean[complete] for g in (fixed, moving))
    product = _blur(fixed.magnitude * moving.magnitude)[fixed.grid].ravel()[complete]
    covariance = (scale_a * scale_b) * (product - a * b)
    a, b = scale_a * (a - mean_a), scale_b * (b - mean_b)
    variances = scale_a**2 * fixed.local_variance[complete] + scale_b**2 * moving.local_variance[complete]
    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)  # constants of SSIM for a range of 1
    ssim = (2 * a * b + c1) * (2 * covariance + c2) / ((a * a + b * b + c1) * (variances + c2))
    return float(ssim.mean(dtype=np.float64))


def _standardisation(values: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Return the mean and 1 / standard deviation, 0 for constant values."""
    mean, std = values.mean(dtype=np.float64), values.std(dtype=np.float64)
    min_std = 1e-9  # smaller ones are rounding errors of constant images
    return np.float32(mean), np.float32(1 / std if std > min_std else 0.0)


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), 1.5))
