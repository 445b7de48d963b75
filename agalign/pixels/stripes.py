"""Column and row patterns of the sensors, estimated from the bands of a capture together and removed.

A fixed pattern that all bands share correlates at zero shift and hides the shift between the bands: phase correlation
peaks at zero, and the descriptors learn the stripes. Real structure does not look like such a pattern: the bands of a
camera see it displaced by many px, and it is not the same in both halves of a column. Where the bands are co-registered
already, real rows of crops do look like it; there the images stay as they are.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from agalign.pixels.resample import shrink
from agalign.pixels.structure import correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.values.image import Raster, reduced_size_px

_LOG = logging.getLogger(__name__)
_Profile = NDArray[np.float64]

_MIN_SIDE_PX = 64
"""Smaller images have too few rows and columns to tell a pattern from the scene."""
_MIN_CORRELATION = 0.3
"""Of one half of a band with the other half of another one, median over bands. Clean captures of eight cameras reach
0.14, white stripes of 5 % of the range 0.34, and those of 2 % 0.08."""
_SMOOTHING_PX = 1.0
"""The structure field's: what it does not see, such as amplifiers that differ between even and odd lines, may stay."""
_KERNEL_PX = 7
_BLOCKS = 32
"""Lines are averaged to so many before the median over them is taken; 128 show the same in twice the time."""
_DRIFT_PX = 15.0
"""Integrated differences drift; slower than this (1 sigma), the pattern stays in the image. Of 15, 40 and 80 px, this
leaves the smallest residual of white stripes."""
_REGISTERED_PX = 0.5
"""If the structure of all bands agrees at so small a shift, they are co-registered."""
_REGISTERED_SIGMA = 12.0
"""Unrelated structures reach 8."""
_MAX_SIDE_PX = 1280
"""Size at which that is looked at."""


def without_common_stripes(images: Sequence[Raster]) -> list[Raster]:
    """The images of a capture's sensors without the column and row pattern that those of the same size share.

    Args: (height, width) images, one for each lens; others are returned as they are.
    Returns: the same objects where no pattern is significant.
    """
    result = list(images)
    sizes = {image.size_px for image in images if image.channels == 1}
    for size in sizes:
        places = [i for i, image in enumerate(images) if image.size_px == size and image.channels == 1]
        if len(places) < 2 or min(size) < _MIN_SIDE_PX:
            continue
        for i, cleaned in zip(places, _cleaned([images[i] for i in places]), strict=True):
            result[i] = cleaned
    return result


def _cleaned(images: Sequence[Raster]) -> list[Raster]:
    axes = [axis for axis in (0, 1) if _common_correlation(images, axis) >= _MIN_CORRELATION]
    if not axes:
        return list(images)
    result = list(images)
    for axis in axes:
        result = _without_pattern(result, axis)
    if _are_registered(result):
        _LOG.debug("the bands share a row or column pattern, but are co-registered: it may be the scene's, and stays")
        return list(images)
    _LOG.debug("a pattern of %s that the bands share is removed", " and ".join(("columns", "rows")[a] for a in axes))
    return result


def _common_correlation(images: Sequence[Raster], axis: int) -> float:
    """Correlation of the halves of different bands, each with the first one; median over bands."""
    (upper, lower), *others = (_halves(image, axis) for image in images)
    return float(np.median([(_correlation(upper, low) + _correlation(lower, up)) / 2 for up, low in others]))


def _halves(image: Raster, axis: int) -> tuple[_Profile, _Profile]:
    """Median differences between neighbouring columns (axis 0) or rows (axis 1), of both halves of the image."""
    width, height = image.size_px
    size = (width, min(_BLOCKS, height)) if axis == 0 else (min(_BLOCKS, width), height)
    blocks, inside = (
        cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
        for plane in (image.pixels, image.valid.astype(np.float32))
    )
    if axis == 1:
        blocks, inside = np.ascontiguousarray(blocks.T), np.ascontiguousarray(inside.T)
    differences = np.diff(cv2.GaussianBlur(blocks, (_KERNEL_PX, 1), _SMOOTHING_PX), axis=1)
    # Averages of ones are not exactly 1.
    whole = cv2.erode((inside > 0.999).astype(np.uint8), np.ones((1, _KERNEL_PX), np.uint8), borderValue=0) > 0
    differences[~(whole[:, 1:] & whole[:, :-1])] = 0
    middle = len(differences) // 2
    upper, lower = (np.median(part, axis=0).astype(float) for part in (differences[:middle], differences[middle:]))
    return upper, lower


def _correlation(a: _Profile, b: _Profile) -> float:
    norm = a.std() * b.std()
    return float(np.mean((a - a.mean()) * (b - b.mean())) / norm) if norm > 0 else 0.0


def _without_pattern(images: Sequence[Raster], axis: int) -> list[Raster]:
    """Minus the pattern that is common to the images, scaled to each."""
    differences = np.stack([_differences(image, axis) for image in images])
    scale = np.sqrt(np.mean(differences**2, axis=1, keepdims=True))
    common = np.mean(differences / np.maximum(scale, 1e-12), axis=0)
    gains = differences @ common / max(float(common @ common), 1e-12)
    pattern = np.concatenate([[0.0], np.cumsum(common)])
    pattern -= gaussian_filter1d(pattern, _DRIFT_PX, mode="nearest")
    result = []
    for image, gain in zip(images, gains, strict=True):
        own = np.asarray(gain * pattern, np.float32)
        pixels = image.pixels - (own if axis == 0 else own[:, None])
        result.append(replace(image, pixels=np.where(image.valid, pixels, np.float32(0))))
    return result


def _differences(image: Raster, axis: int) -> _Profile:
    """Median difference between each two neighbouring columns (axis 0) or rows (axis 1) over the valid pixels."""
    pixels, valid = (image.pixels, image.valid) if axis == 0 else (image.pixels.T, image.valid.T)
    differences = np.diff(pixels, axis=1)
    if valid.all():
        return np.median(differences, axis=0).astype(np.float64)
    differences[~(valid[:, 1:] & valid[:, :-1])] = np.nan
    known = np.isfinite(differences).any(axis=0)
    result = np.zeros(differences.shape[1])
    result[known] = np.nanmedian(differences[:, known], axis=0)
    return result


def _are_registered(images: Sequence[Raster]) -> bool:
    """True where the structure of the images agrees with the first one's at no shift."""
    width, height = images[0].size_px
    scale = min(1.0, _MAX_SIDE_PX / max(width, height))
    size = reduced_size_px((width, height), 1 / scale)
    fixed, *moving = (windowed_spectra(structure_field(shrink(image, size))) for image in images)
    for spectrum in moving:
        peak = find_peak(correlation_surfaces(fixed, spectrum), apart_px=max(size) // 16)
        if np.hypot(*peak.shift_px) > _REGISTERED_PX * scale or peak.sigma < _REGISTERED_SIGMA:
            return False
    return True
