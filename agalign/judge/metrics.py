"""How alike two bands on one grid are, by the measures that Elastix and others have made common.

All of them are deterministic and use every pixel of the common valid area.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage, Mask, Raster

_BINS = 32
_RANGE_MARGIN = 0.01
_FINE = 64
"""Moving values are counted in 64ths of a bin before the spline is applied: exact to 1/128 bin."""
_LEAST_PIXELS = 256
_SSIM_WINDOW_PX = 11


class FixedSimilarity:
    """The reference, ready to be compared with any number of moving bands on its grid. Rasters are single-band."""

    def __init__(self, fixed: Raster) -> None:
        self.fixed = fixed
        self.gradient = _Gradient(fixed.pixels)
        self.bins = fixed_bins(fixed.pixels, _range(fixed.pixels[fixed.valid]))

    def to(self, moving: Raster) -> dict[str, float]:
        """All similarity metrics over the pixels that are valid in both.

        Keys: mattes_mi (elastix's sign: lower is better), nmi, ncc, gradient_correlation, structure_ssim (higher is
        better), overlap (share of the grid that is valid in both). Only overlap where fewer than 256 pixels are.
        gradient_correlation is Pearson's coefficient of the gradient magnitudes, structure_ssim the SSIM (Wang et
        al. 2004, 11 px Gaussian window) of the standardised ones: contrast reversal lowers neither.
        """
        valid = self.fixed.valid & moving.valid
        overlap = float(valid.mean())
        if np.count_nonzero(valid) < _LEAST_PIXELS:
            return {"overlap": overlap}
        one, other = (_inside(r.pixels, valid) for r in (self.fixed, moving))
        joint = joint_histogram(self.bins.ravel() if valid.all() else self.bins[valid], other)
        gradient = _Gradient(moving.pixels)
        beside = _eroded(valid, 3)
        some = bool(beside.any())
        return {
            "mattes_mi": -mutual_information(joint),
            "nmi": normalised_mutual_information(joint),
            "ncc": correlation(one, other),
            "gradient_correlation": correlation(
                _inside(self.gradient.magnitude, beside), _inside(gradient.magnitude, beside)
            ) if some else 0.0,
            "structure_ssim": _ssim(self.gradient, gradient, valid),
            "overlap": overlap,
        }  # fmt: skip


def _inside(image: FloatImage, valid: Mask) -> NDArray[np.float32]:
    """The valid pixels, (n,)."""
    return image.ravel() if valid.all() else image[valid]


def _eroded(valid: Mask, side_px: int) -> Mask:
    """Where a square of this side holds nothing but valid pixels of the image."""
    eroded = cv2.erode(valid.astype(np.uint8), np.ones((side_px, side_px), np.uint8), borderValue=0)
    return np.asarray(eroded > 0)


def fixed_bins(fixed: NDArray[np.float32], limits: tuple[float, float]) -> NDArray[np.int32]:
    """The bin of each fixed value, of the shape given; `limits` are the smallest and the largest value there are."""
    # The values are positive: casting to an integer is floor.
    return (_bin_position(fixed, limits, padding=0) + 0.5).astype(np.int32)


def joint_histogram(bins: NDArray[np.int32], moving: NDArray[np.float32]) -> NDArray[np.float64]:
    """Elastix's joint density of two samples (n,): (32, 32), sums to 1, fixed along rows.

    `bins` are the `fixed_bins` of the fixed sample. Each range is widened by 1 % on both sides. The fixed kernel is of
    order 0 (a box), the moving one the cubic B-spline, whose support costs the moving axis a bin of padding at either
    end (Klein et al. 2010; Mattes 2003).
    """
    moving_fine = (_bin_position(moving, _range(moving), padding=1) * _FINE).astype(np.int32)
    counts = np.bincount(bins * (_BINS * _FINE) + moving_fine, minlength=_BINS * _BINS * _FINE)
    counts = counts.reshape(_BINS, _BINS * _FINE)
    occupied = (np.arange(_BINS * _FINE) + 0.5) / _FINE
    kernel = cubic_spline(occupied[:, None] - np.arange(_BINS)[None, :])
    density = counts @ kernel
    return np.asarray(density / density.sum())


def _range(values: NDArray[np.float32]) -> tuple[float, float]:
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


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
    product = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    some = joint > 1e-16
    return float((joint[some] * np.log(joint[some] / product[some])).sum())


def normalised_mutual_information(joint: NDArray[np.float64]) -> float:
    """(H(fixed) + H(moving)) / H(fixed, moving): 1 for independent images, 2 for identical ones (Studholme 1999)."""
    joint_entropy = _entropy(joint)
    return (_entropy(joint.sum(axis=1)) + _entropy(joint.sum(axis=0))) / joint_entropy if joint_entropy > 0 else 1.0


def _entropy(p: NDArray[np.float64]) -> float:
    some = p[p > 1e-16]
    return float(-(some * np.log(some)).sum())


def correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Pearson's coefficient of two samples (n,); 0 where either is constant."""
    centred = [x - np.float32(x.mean(dtype=np.float64)) for x in (a, b)]
    aa, bb, ab = (np.einsum("i,i->", centred[i], centred[j], dtype=np.float64) for i, j in ((0, 0), (1, 1), (0, 1)))
    spread = float(np.sqrt(aa * bb))
    return float(ab / spread) if spread > 0 else 0.0


class _Gradient:
    """An image's gradient magnitude with its local mean and variance."""

    def __init__(self, image: FloatImage) -> None:
        gx, gy = (cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        self.magnitude = np.asarray(cv2.magnitude(gx, gy), np.float32)
        self.local_mean = _blur(self.magnitude)
        self.local_variance = _blur(self.magnitude * self.magnitude) - self.local_mean * self.local_mean


def _ssim(one: _Gradient, other: _Gradient, valid: Mask) -> float:
    """SSIM of the two magnitudes, each brought to mean 0 and standard deviation 1 over the valid pixels; the local
    moments of the standardised images follow from those of the images.
    """
    inside = _eroded(valid, _SSIM_WINDOW_PX).view(np.uint8)
    moments = [cv2.meanStdDev(g.magnitude, mask=valid.view(np.uint8)) for g in (one, other)]
    means = [float(mean.item()) for mean, _ in moments]
    deviations = [max(float(deviation.item()), 1e-12) for _, deviation in moments]
    mean_a, mean_b = (
        (g.local_mean - np.float32(m)) / np.float32(s) for g, m, s in zip((one, other), means, deviations, strict=True)
    )
    covariance = _blur(one.magnitude * other.magnitude) - one.local_mean * other.local_mean
    covariance /= np.float32(deviations[0] * deviations[1])
    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    ssim = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    variances = sum(g.local_variance / np.float32(s * s) for g, s in zip((one, other), deviations, strict=True))
    ssim /= (mean_a * mean_a + mean_b * mean_b + c1) * (variances + c2)
    return float(cv2.mean(ssim, mask=inside)[0])


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), 1.5))
