"""How alike two aligned bands are, and how far apart their structures still lie.

All functions are deterministic and use every pixel of the common valid area.
"""

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.config import CheckSettings
from agalign.records import FloatImage, Mask, Raster, Residual
from agalign.structure import Field, correlation_surfaces, structure_field, windowed_spectra

_BINS = 32
_RANGE_MARGIN = 0.01
_FINE = 64
"""Moving values are counted in 64ths of a bin before the spline is applied: exact to 1/128 bin."""
_LEAST_PIXELS = 256


def similarity(fixed: FloatImage, moving: FloatImage, valid: Mask) -> dict[str, float]:
    """All similarity metrics of two single-band images on one grid, over the valid pixels.

    Keys: mattes_mi (elastix's sign: lower is better), nmi, ncc, gradient_correlation, structure_ssim
    (higher is better), overlap (share of valid pixels). Only overlap where fewer than 256 pixels are valid.
    """
    overlap = float(valid.mean())
    if np.count_nonzero(valid) < _LEAST_PIXELS:
        return {"overlap": overlap}
    one, other = fixed[valid], moving[valid]
    joint = joint_histogram(one, other)
    gradients = _gradient(fixed), _gradient(moving)
    return {
        "mattes_mi": -mutual_information(joint),
        "nmi": normalised_mutual_information(joint),
        "ncc": correlation(one, other),
        "gradient_correlation": _inner_correlation(*gradients, valid),
        "structure_ssim": _ssim(_standardised(gradients[0], valid), _standardised(gradients[1], valid), valid),
        "overlap": overlap,
    }


def joint_histogram(fixed: NDArray[np.float32], moving: NDArray[np.float32]) -> NDArray[np.float64]:
    """Elastix's joint density of two samples (n,): (32, 32), sums to 1, fixed along rows.

    Each range is widened by 1 % on both sides. The fixed kernel is of order 0 (a box), the moving one the cubic
    B-spline, whose support costs the moving axis a bin of padding at either end (Klein et al. 2010; Mattes 2003).
    """
    # The values are positive: casting to an integer is floor.
    fixed_position = (_bin_position(fixed, padding=0) + 0.5).astype(np.int32)
    moving_fine = (_bin_position(moving, padding=1) * _FINE).astype(np.int32)
    counts = np.bincount(fixed_position * (_BINS * _FINE) + moving_fine, minlength=_BINS * _BINS * _FINE)
    counts = counts.reshape(_BINS, _BINS * _FINE)
    occupied = (np.arange(_BINS * _FINE) + 0.5) / _FINE
    kernel = cubic_spline(occupied[:, None] - np.arange(_BINS)[None, :])
    density = counts @ kernel
    return np.asarray(density / density.sum())


def _bin_position(values: NDArray[np.float32], padding: int) -> NDArray[np.float64]:
    low, high = float(values.min()), float(values.max())
    margin = _RANGE_MARGIN * (high - low)
    low, high = low - margin, high + margin
    bin_size = max((high - low) / (_BINS - 2 * padding - 1), 1e-12)
    return np.asarray(values / bin_size - (low / bin_size - padding), dtype=np.float64)


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
    a64, b64 = a.astype(np.float64), b.astype(np.float64)
    a64 -= a64.mean()
    b64 -= b64.mean()
    spread = float(np.sqrt((a64 @ a64) * (b64 @ b64)))
    return float(a64 @ b64 / spread) if spread > 0 else 0.0


def gradient_correlation(fixed: FloatImage, moving: FloatImage, valid: Mask) -> float:
    """Pearson's coefficient of the gradient magnitudes: contrast reversal does not lower it."""
    return _inner_correlation(_gradient(fixed), _gradient(moving), valid)


def structure_ssim(fixed: FloatImage, moving: FloatImage, valid: Mask) -> float:
    """SSIM (Wang et al. 2004, 11 px Gaussian window) of the standardised gradient magnitudes."""
    return _ssim(_standardised(_gradient(fixed), valid), _standardised(_gradient(moving), valid), valid)


def _inner_correlation(a: FloatImage, b: FloatImage, valid: Mask) -> float:
    """Where no gradient reaches over an invalid pixel."""
    inside = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    return correlation(a[inside], b[inside]) if inside.any() else 0.0


def _ssim(a: FloatImage, b: FloatImage, valid: Mask) -> float:
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a, variance_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    ssim /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    inside = cv2.erode(valid.astype(np.uint8), np.ones((11, 11), np.uint8), borderValue=0) > 0
    return float(ssim[inside].mean()) if inside.any() else 0.0


def _gradient(image: FloatImage) -> FloatImage:
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8)
    return np.asarray(cv2.magnitude(gx, gy))


def _standardised(image: FloatImage, valid: Mask) -> FloatImage:
    inside = image[valid]
    return np.asarray((image - inside.mean()) / max(float(inside.std()), 1e-12), dtype=np.float32)


def _blur(image: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5))


def tile_residuals(fixed: Raster, moving: Raster, settings: CheckSettings) -> Residual:
    """Local shifts between two single-band rasters on one grid, by structure correlation in windows side by side.

    The residual is of the moving band's content: positive x means that it lies to the right of the reference's.
    """
    return FixedWindows(fixed, settings).residuals(moving)


class FixedWindows:
    """The reference cut into windows, ready to be compared with any number of moving bands."""

    def __init__(self, fixed: Raster, settings: CheckSettings) -> None:
        self.settings = settings
        self.valid = fixed.valid
        width, height = fixed.size_px
        self.side = max(32, min(settings.tile_px, width // 4, height // 4))
        field = structure_field(fixed, settings.smoothing_px)
        origins = [(x, y) for y in _starts(height, self.side) for x in _starts(width, self.side)]
        fits = min(width, height) >= self.side
        strengths = [_strength(self._cut(field, o)) for o in origins] if fits else []
        self.origins = [o for o, s in zip(origins, strengths, strict=False) if s >= settings.least_strength]
        self.spectra = windowed_spectra(self._windows(field, self.origins))

    def residuals(self, moving: Raster) -> Residual:
        """The shift of each window's content; a window counts as measured where its peak stands out."""
        both = self.valid & moving.valid
        field = structure_field(moving, self.settings.smoothing_px)
        tried = [
            i for i, o in enumerate(self.origins)
            if self._cut(both, o).mean() > 0.9 and _strength(self._cut(field, o)) >= self.settings.least_strength
        ]  # fmt: skip
        origins = [self.origins[i] for i in tried]
        surfaces = correlation_surfaces(self.spectra[tried], windowed_spectra(self._windows(field, origins)))
        shifts = [_shift_at_peak(surface, self.settings) for surface in surfaces]
        found = np.array(shifts, dtype=np.float64).reshape(-1, 2)
        measured = np.isfinite(found[:, 0])
        length = np.linalg.norm(found[measured], axis=1)
        some = bool(measured.any())
        return Residual(
            centres_px=np.array(origins, dtype=np.float64).reshape(-1, 2) + (self.side - 1) / 2,
            shifts_px=found,
            median_px=float(np.median(length)) if some else float("inf"),
            p95_px=float(np.percentile(length, 95)) if some else float("inf"),
            coverage=float(measured.mean()) if tried else 0.0,
            bias_px=float(np.linalg.norm(np.median(found[measured], axis=0))) if some else float("inf"),
        )

    def _cut(self, image: NDArray[Any], origin: tuple[int, int]) -> NDArray[Any]:
        x, y = origin
        return image[y : y + self.side, x : x + self.side]

    def _windows(self, field: Field, origins: list[tuple[int, int]]) -> Field:
        """(n, side, side), each without its mean: the mean orientation of a row crop is the same everywhere and tells
        no place from another.
        """
        cut = np.empty((len(origins), self.side, self.side), np.complex64)
        for window, origin in zip(cut, origins, strict=True):
            piece = self._cut(field, origin)
            np.subtract(piece, piece.mean(), out=window)
        return cut


def _strength(window: Field) -> float:
    return float(np.abs(window[::2, ::2]).mean())


def _starts(length: int, side: int) -> list[int]:
    count = max(1, math.ceil(length / side))
    return [round(v) for v in np.linspace(0, max(0, length - side), count)]


def _shift_at_peak(surface: NDArray[np.float32], settings: CheckSettings) -> tuple[float, float]:
    """The shift that a correlation surface shows; nan, nan where no peak stands out."""
    height, width = surface.shape
    row, column = divmod(int(surface.argmax()), width)
    # Its mean is 0: the windows have none.
    spread = math.sqrt(float(np.vdot(surface, surface)) / surface.size)
    if spread <= 0 or surface[row, column] < settings.least_peak_sigma * spread:
        return math.nan, math.nan
    patch = np.take(
        np.take(surface, range(row - 1, row + 2), 0, mode="wrap"), range(column - 1, column + 2), 1, mode="wrap"
    )
    dx, dy = _paraboloid_top(patch)
    x = (column + width // 2) % width - width // 2 + dx
    y = (row + height // 2) % height - height // 2 + dy
    return float(x), float(y)


def _paraboloid_top(patch: NDArray[np.float32]) -> tuple[float, float]:
    """(x, y) of the top of the quadratic surface fitted to 3 x 3 samples, each within a pixel of the centre."""
    offset = np.array([-1.0, 0.0, 1.0])
    slope_x, slope_y = (patch @ offset).sum() / 6, (offset @ patch).sum() / 6
    curve = np.array([1.0, -2.0, 1.0])
    xx, yy = (patch @ curve).sum() / 3, (curve @ patch).sum() / 3
    xy = (patch[0, 0] + patch[2, 2] - patch[0, 2] - patch[2, 0]) / 4
    determinant = xx * yy - xy * xy
    if xx >= 0 or determinant <= 0:
        return 0.0, 0.0
    x, y = (xy * slope_y - yy * slope_x) / determinant, (xy * slope_x - xx * slope_y) / determinant
    return float(np.clip(x, -1, 1)), float(np.clip(y, -1, 1))
