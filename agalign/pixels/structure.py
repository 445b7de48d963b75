"""The structure of an image, blind to contrast: its gradient orientations, and shifts measured on them.

The double-angle field z = a ((gx + i gy) / |g|)^2 is the same for an edge and its contrast-reversed twin; a is the
gradient magnitude, clipped so that a few strong edges do not outvote the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage, Raster

Field = NDArray[np.complex64]

_AMPLITUDE_QUANTILE = 0.75
"""Gradients above this quantile of the valid area count alike."""


def structure_field(raster: Raster, smoothing_px: float = 1.0) -> Field:
    """Z of a single-band raster, (height, width) complex64 with |z| <= 1, and 0 at and next to invalid pixels."""
    complete = bool(raster.valid.all())
    pixels = raster.pixels if complete else np.where(raster.valid, raster.pixels, np.float32(0))
    smooth = cv2.GaussianBlur(np.asarray(pixels, np.float32), (0, 0), smoothing_px)
    if not complete:
        smooth /= np.maximum(cv2.GaussianBlur(raster.valid.astype(np.float32), (0, 0), smoothing_px), 1e-3)
    gx, gy = (cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    magnitude = gradient_magnitude(gx, gy)
    inside = cv2.erode(raster.valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    some = magnitude[::3, ::3][inside[::3, ::3]]
    ceiling = float(np.quantile(some, _AMPLITUDE_QUANTILE)) if some.size else 0.0
    if ceiling <= 0:
        return np.zeros(raster.valid.shape, np.complex64)
    # a ((gx + i gy) / |g|)^2 with a = min(|g| / ceiling, 1)
    weight = np.maximum(magnitude, np.float32(ceiling))
    weight *= magnitude
    np.divide(inside, np.maximum(weight, np.float32(1e-30), out=weight), out=weight)
    real, imaginary = gx - gy, 2 * gx
    real *= gx + gy
    imaginary *= gy
    real *= weight
    imaginary *= weight
    return np.asarray(cv2.merge([real, imaginary]).view(np.complex64)[..., 0])


def gradient_magnitude(gx: FloatImage, gy: FloatImage) -> FloatImage:
    """(height, width). OpenCV's depends in its last digit on where in memory its arrays lie, and with it all results
    would.
    """
    square = gx * gx
    square += gy * gy
    return np.asarray(np.sqrt(square, out=square))


@dataclass(frozen=True)
class Peak:
    """A shift between two structure fields."""

    shift_px: tuple[float, float]
    """(dx, dy): p in the first field corresponds to p + shift in the second."""
    sigma: float
    """Height above the surface's mean, in standard deviations of the surface."""
    runner_up_sigma: float
    """The same for the highest value away from the peak."""
    sigma_at_zero: float
    """The same at no shift."""


def correlation_surface(fixed: Field, moving: Field) -> NDArray[np.float32]:
    """Circular correlation of two windowed fields (height, width); index [dy, dx] is the shift.

    Half whitened: the square root of the cross spectrum's magnitude is divided away, between a plain correlation
    (nothing) and phase correlation (all of it).
    """
    return correlation_surfaces(windowed_spectra(fixed), windowed_spectra(moving))


def windowed_spectra(fields: Field) -> Field:
    """Fourier transform of fields (..., height, width) under a Hann window."""
    height, width = fields.shape[-2:]
    return _each_plane(cv2.dft, fields * _hann_window(height, width))


@cache
def _hann_window(height: int, width: int) -> FloatImage:
    return np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1]).astype(np.float32)


def inverse_transform(spectra: Field) -> Field:
    """Inverse Fourier transform of spectra (..., height, width)."""
    return _each_plane(lambda plane: cv2.idft(plane, flags=cv2.DFT_SCALE), spectra)


def _each_plane(transform: Callable[[FloatImage], FloatImage], fields: Field) -> Field:
    """OpenCV's Fourier transform, 2 to 3 times as fast as SciPy's, of each plane of fields (..., height, width)."""
    height, width = fields.shape[-2:]
    planes = np.ascontiguousarray(fields).view(np.float32).reshape(-1, height, width, 2)
    result = np.empty_like(planes)
    for plane, transformed in zip(planes, result, strict=True):
        transformed[:] = transform(plane)
    return result.view(np.complex64).reshape(fields.shape)


def correlation_surfaces(fixed: Field, moving: Field) -> NDArray[np.float32]:
    """`correlation_surface` of fields given by their `windowed_spectra`, (..., height, width)."""
    return np.asarray(inverse_transform(whitened_cross_spectra(fixed, moving)).real)


def whitened_cross_spectra(fixed: Field, moving: Field) -> Field:
    """The cross spectrum; `correlation_surfaces` are its inverse transform."""
    cross = np.conj(fixed)
    cross *= moving
    power = cross.real**2 + cross.imag**2
    floor = np.maximum(power.max(axis=(-2, -1), keepdims=True) * 1e-18, 1e-30)
    # The fourth root as two square roots, far quicker than a power, and a product, far quicker than a division.
    cross *= 1 / np.sqrt(np.sqrt(np.maximum(power, floor)))
    return cross


def peak_positions(cross: Field, near_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """The highest points (n, 2) of the surfaces of cross spectra (n, height, width), each near the given one.

    A surface is a trigonometric polynomial, evaluated between its samples on finer and finer lattices of 3 x 3: a
    paraboloid through the samples themselves takes a shift of a fifth of a px for an eighth.
    """
    height, width = cross.shape[-2:]
    result = near_px.copy()
    offset = np.array([-1.0, 0.0, 1.0])
    for step in _LATTICE_STEPS_PX:
        at_x, at_y = (result[:, axis, None] + step * offset for axis in (0, 1))
        rows = _waves(at_y, height) @ cross
        patches = (rows @ _waves(at_x, width).transpose(0, 2, 1)).real
        result += step * paraboloid_peaks(patches.astype(np.float64))
    return result


_LATTICE_STEPS_PX = (0.5, 0.25)


def _waves(at_px: NDArray[np.float64], length: int) -> Field:
    """(n, m, length): the waves of an inverse transform at m places each."""
    frequencies = np.fft.fftfreq(length)
    return np.asarray(np.exp(2j * np.pi * at_px[..., None] * frequencies), np.complex64)


def paraboloid_peaks(patches: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2): (x, y) of the tops of the quadratic surfaces fitted to (n, 3, 3) samples, each within one of the centre;
    0 where a surface has none.
    """
    offset, curve = np.array([-1.0, 0.0, 1.0]), np.array([1.0, -2.0, 1.0])
    slope_x, slope_y = (patches @ offset).sum(axis=1) / 6, (offset @ patches).sum(axis=1) / 6
    xx, yy = (patches @ curve).sum(axis=1) / 3, (curve @ patches).sum(axis=1) / 3
    xy = (patches[:, 0, 0] + patches[:, 2, 2] - patches[:, 0, 2] - patches[:, 2, 0]) / 4
    determinant = xx * yy - xy * xy
    has_top = (xx < 0) & (determinant > 0)
    divisor = np.where(has_top, determinant, 1.0)
    top = np.stack([xy * slope_y - yy * slope_x, xy * slope_x - xx * slope_y], axis=1) / divisor[:, None]
    return np.asarray(np.clip(np.where(has_top[:, None], top, 0.0), -1, 1))


def find_peak(surface: NDArray[np.float32], apart_px: int, within_px: float = np.inf) -> Peak:
    """The highest point of a correlation surface (height, width), to a fraction of a pixel.

    `apart_px` is how far away the runner-up must lie, `within_px` how far from no shift the highest point may.
    """
    height, width = surface.shape
    spread = float(surface.std())
    if spread <= 0:
        return Peak((0.0, 0.0), 0.0, 0.0, 0.0)
    z = np.fft.fftshift((surface - surface.mean()) / spread)
    zero_row, zero_column = height // 2, width // 2
    far = np.hypot(*np.ogrid[-zero_row : height - zero_row, -zero_column : width - zero_column]) > within_px
    row, column = np.unravel_index(int(np.where(far, -np.inf, z).argmax()), z.shape)
    dx = column - zero_column + _vertex(z[row, (column - 1) % width], z[row, column], z[row, (column + 1) % width])
    dy = row - zero_row + _vertex(z[(row - 1) % height, column], z[row, column], z[(row + 1) % height, column])
    sigma = float(z[row, column])
    at_zero = float(z[zero_row, zero_column])
    z[max(0, row - apart_px) : row + apart_px + 1, max(0, column - apart_px) : column + apart_px + 1] = -np.inf
    runner_up = float(z.max())
    return Peak((float(dx), float(dy)), sigma, runner_up if np.isfinite(runner_up) else 0.0, at_zero)


def _vertex(before: float, at: float, after: float) -> float:
    """Offset of the top of the parabola through three samples a pixel apart, in [-0.5, 0.5]."""
    curvature = before - 2 * at + after
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
