"""How alike two bands on one grid are, by the measures that Elastix and others have made common.

All of them are deterministic. Gradients and local moments are those of the images at full resolution; sums run over
the common valid pixels, of large images those of a regular lattice, which holds a quarter of a million or more.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import entr

from agalign.pixels.structure import gradient_magnitude
from agalign.values.image import FloatImage, Mask, Raster

_BINS = 32
_RANGE_MARGIN = 0.01
_FINE = 64
"""Moving values are counted in 64ths of a bin before the spline is applied: exact to 1/128 bin."""
_MIN_PIXELS = 256
_ENOUGH_PIXELS = 250_000
_MIN_DEVIATION = 1e-9
_SSIM_WINDOW_PX = 11
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
"""Of SSIM, for a range of 1."""


class FixedSimilarity:
    """The reference, ready to be compared with any number of moving bands on its grid. Rasters are single-band."""

    def __init__(self, fixed: Raster) -> None:
        self.fixed = fixed
        step = max(1, int((fixed.pixels.size / _ENOUGH_PIXELS) ** 0.5))
        self.lattice = np.s_[step // 2 :: step, step // 2 :: step]
        self.gradient = _Gradient.of(fixed.pixels, self.lattice)
        self.sampled = fixed.pixels[self.lattice].ravel()
        self.bins = fixed_bins(self.sampled, _range(fixed.pixels, fixed.valid))

    def to(self, moving: Raster) -> dict[str, float]:
        """All similarity metrics over the pixels that are valid in both.

        Keys: mattes_mi (elastix's sign: lower is better), nmi, ncc, gradient_correlation, structure_ssim (higher is
        better), overlap (share of the grid that is valid in both). Only overlap where fewer than 256 pixels are.
        gradient_correlation is Pearson's coefficient of the gradient magnitudes, structure_ssim the SSIM (Wang et
        al. 2004, 11 px Gaussian window) of the standardised ones: contrast reversal lowers neither.
        """
        both = self.fixed.valid & moving.valid
        overlap = float(np.count_nonzero(both) / both.size)
        valid = _rows_of(both[self.lattice])
        if len(valid) < _MIN_PIXELS:
            return {"overlap": overlap}
        one, other = self.sampled[valid], moving.pixels[self.lattice].ravel()[valid]
        joint = joint_histogram(self.bins[valid], other, _range(moving.pixels, both))
        gradient = _Gradient.of(moving.pixels, self.lattice)
        inside = _rows_of(_eroded(both, 3)[self.lattice])
        gradients = self.gradient.sampled[inside], gradient.sampled[inside]
        within_windows = _rows_of(_eroded(both, _SSIM_WINDOW_PX)[self.lattice])
        return {
            "mattes_mi": -mutual_information(joint),
            "nmi": normalised_mutual_information(joint),
            "ncc": correlation(one, other),
            "gradient_correlation": correlation(*gradients) if len(inside) else 0.0,
            "structure_ssim": _ssim(self.gradient, gradient, valid, within_windows),
            "overlap": overlap,
        }  # fmt: skip


def _rows_of(mask: Mask) -> NDArray[np.intp]:
    """Where a mask is True, (n,) rows of flattened arrays of its shape: picking by them is quicker than by the mask."""
    return np.flatnonzero(mask)


def _eroded(valid: Mask, side_px: int) -> Mask:
    """True where all pixels of a square of this side are valid."""
    eroded = cv2.erode(valid.astype(np.uint8), np.ones((side_px, side_px), np.uint8), borderValue=0)
    return np.asarray(eroded > 0)


def fixed_bins(fixed: NDArray[np.float32], limits: tuple[float, float]) -> NDArray[np.int32]:
    """The bin of each fixed value, of the shape given; `limits` are the smallest and the largest value."""
    # The values are positive: casting to an integer is floor.
    return (_bin_position(fixed, limits, padding=0) + 0.5).astype(np.int32)


def joint_histogram(
    bins: NDArray[np.int32], moving: NDArray[np.float32], limits: tuple[float, float]
) -> NDArray[np.float64]:
    """Elastix's joint density of two samples (n,): (32, 32), sums to 1, fixed along rows.

    `bins` are the `fixed_bins` of the fixed sample, `limits` the moving image's smallest and largest values. Each range
    is widened by 1 % on both sides. The fixed kernel is of order 0 (a box), the moving one the cubic B-spline; its
    support costs the moving axis a bin of padding at either end (Klein et al. 2010; Mattes 2003).
    """
    moving_fine = (_bin_position(moving, limits, padding=1) * _FINE).astype(np.int32)
    counts = np.bincount(bins * (_BINS * _FINE) + moving_fine, minlength=_BINS * _BINS * _FINE)
    counts = counts.reshape(_BINS, _BINS * _FINE)
    density = counts @ _kernel()
    return np.asarray(density / density.sum())


@cache
def _kernel() -> NDArray[np.float64]:
    """(32 x 64, 32): what a value counted in a 64th of a bin gives to each bin."""
    occupied = (np.arange(_BINS * _FINE) + 0.5) / _FINE
    return cubic_spline(occupied[:, None] - np.arange(_BINS)[None, :])


def _range(image: FloatImage, valid: Mask) -> tuple[float, float]:
    """The smallest and the largest valid value; (0, 1) without any."""
    if not valid.any():
        return 0.0, 1.0
    low, high, _, _ = cv2.minMaxLoc(image, mask=valid.view(np.uint8))
    return low, high


def _bin_position(values: NDArray[np.float32], limits: tuple[float, float], padding: int) -> NDArray[np.float32]:
    low, high = limits
    margin = _RANGE_MARGIN * (high - low)
    low, high = low - margin, high + margin
    bin_size = max((high - low) / (_BINS - 2 * padding - 1), 1e-12)
    return np.asarray(values * np.float32(1 / bin_size) - np.float32(low / bin_size - padding))


def cubic_spline(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The cubic B-spline: (4 - 6 x^2 + 3 |x|^3) / 6 for |x| < 1, (2 - |x|)^3 / 6 for 1 <= |x| < 2, else 0."""
    a = np.abs(x)
    return np.where(a < 1, (4 - 6 * a**2 + 3 * a**3) / 6, np.where(a < 2, (2 - a) ** 3 / 6, 0.0))


def mutual_information(joint: NDArray[np.float64]) -> float:
    """Sum of p log(p / (p_fixed p_moving)), in nats."""
    return _entropy(joint.sum(axis=1)) + _entropy(joint.sum(axis=0)) - _entropy(joint)


def normalised_mutual_information(joint: NDArray[np.float64]) -> float:
    """(H(fixed) + H(moving)) / H(fixed, moving): 1 for independent images, 2 for identical ones (Studholme 1999)."""
    joint_entropy = _entropy(joint)
    return (_entropy(joint.sum(axis=1)) + _entropy(joint.sum(axis=0))) / joint_entropy if joint_entropy > 0 else 1.0


def _entropy(p: NDArray[np.float64]) -> float:
    return float(entr(p).sum())


def correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Pearson's coefficient of two samples (n,); 0 where either is constant."""
    centred = [x - np.float32(x.mean(dtype=np.float64)) for x in (a, b)]
    aa, bb, ab = (float(centred[i] @ centred[j]) for i, j in ((0, 0), (1, 1), (0, 1)))
    spread = float(np.sqrt(aa * bb))
    return float(ab / spread) if spread > 0 else 0.0


@dataclass(frozen=True)
class _Gradient:
    """An image's gradient magnitude, (height, width); the rest (n,) on the pixels of a lattice, row by row."""

    lattice: tuple[slice, slice]
    magnitude: FloatImage
    sampled: NDArray[np.float32]
    local_mean: NDArray[np.float32]
    local_variance: NDArray[np.float32]

    @classmethod
    def of(cls, image: FloatImage, lattice: tuple[slice, slice]) -> "_Gradient":
        gx, gy = (cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        magnitude = gradient_magnitude(gx, gy)
        mean, square = (_blur(x)[lattice].ravel() for x in (magnitude, magnitude * magnitude))
        return cls(lattice, magnitude, magnitude[lattice].ravel(), mean, square - mean * mean)


def _ssim(one: _Gradient, other: _Gradient, valid: NDArray[np.intp], inside: NDArray[np.intp]) -> float:
    """SSIM of the two magnitudes, each brought to mean 0 and standard deviation 1 over the `valid` pixels of the
    lattice, where its windows lie `inside` both images; the standardised images' local moments follow from those of
    the images.
    """
    if not len(inside):
        return 0.0
    (mean_a, by_a), (mean_b, by_b) = (_standard(g.sampled[valid]) for g in (one, other))
    if not by_a * by_b:  # an image without edges has no structure
        return 0.0
    a, b = (g.local_mean[inside] for g in (one, other))
    product = _blur(one.magnitude * other.magnitude)[one.lattice].ravel()[inside]
    covariance = (by_a * by_b) * (product - a * b)
    a, b = by_a * (a - mean_a), by_b * (b - mean_b)
    variances = by_a**2 * one.local_variance[inside] + by_b**2 * other.local_variance[inside]
    ssim = (2 * a * b + _C1) * (2 * covariance + _C2) / ((a * a + b * b + _C1) * (variances + _C2))
    return float(ssim.mean(dtype=np.float64))


def _standard(values: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """(mean, 1 / standard deviation); 0 for one that is none."""
    mean, deviation = values.mean(dtype=np.float64), values.std(dtype=np.float64)
    return np.float32(mean), np.float32(1 / deviation if deviation > _MIN_DEVIATION else 0.0)


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), 1.5))
