"""Removal of the column and row pattern noise that the bands of a capture have in common.

A fixed pattern in all bands correlates at zero shift and hides the offset between the bands: phase correlation peaks
at zero, and the descriptors learn the stripes. Structure of the scene is different: it has an offset of many px
between the bands, and differs between both halves of a column. Between co-registered bands, rows of crops resemble
stripes; the images of such captures are not changed.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from agalign.pixels.band_resampling import shrink
from agalign.pixels.structure import correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.values.image import Raster, reduced_size_px
from agalign.values.resampling import MIN_VALID_WEIGHT

_LOG = logging.getLogger(__name__)
_Profile = NDArray[np.float64]

_MIN_SIDE_PX = 64
"""Smaller images have too few rows and columns to distinguish a pattern from the scene."""


def without_common_stripes(images: Sequence[Raster]) -> list[Raster]:
    """Remove the column and row pattern that images of equal size have in common.

    `images` has one image per lens; images of several channels are not changed. Returns the same objects without a
    significant pattern.
    """
    result = list(images)
    for size in {image.size_px for image in images if image.channels == 1}:
        indices = [i for i, image in enumerate(images) if image.size_px == size and image.channels == 1]
        if len(indices) > 1 and min(size) >= _MIN_SIDE_PX:
            for i, cleaned in zip(indices, _cleaned([images[i] for i in indices]), strict=True):
                result[i] = cleaned
    return result


def _cleaned(images: Sequence[Raster]) -> list[Raster]:
    # Minimum correlation of one half of a band with the other half of another band, median over bands. Captures
    # of eight cameras without stripes have up to 0.14, white stripes of 5 % of the range 0.34, of 2 % 0.08.
    min_correlation = 0.3
    has_columns = _common_correlation(images) >= min_correlation
    has_rows = _common_correlation(_transposed(images)) >= min_correlation
    if not has_columns and not has_rows:
        return list(images)
    result = _without_columns(images) if has_columns else list(images)
    if has_rows:
        result = _transposed(_without_columns(_transposed(result)))
    if _are_registered(result):
        _LOG.debug("a common row or column pattern of co-registered bands is kept: it may be part of the scene")
        return list(images)
    removed = ["columns"] * has_columns + ["rows"] * has_rows
    _LOG.debug("removed a pattern of %s that the bands have in common", " and ".join(removed))
    return result


def _transposed(images: Sequence[Raster]) -> list[Raster]:
    """Return the images with their rows as columns."""
    return [
        replace(image, pixels=np.ascontiguousarray(image.pixels.T), valid=np.ascontiguousarray(image.valid.T))
        for image in images
    ]


def _common_correlation(images: Sequence[Raster]) -> float:
    """Return the correlation of opposite halves of the first band and each other band, median over bands."""
    (upper, lower), *others = (_halves(image) for image in images)
    return float(np.median([(_correlation(upper, low) + _correlation(lower, up)) / 2 for up, low in others]))


def _halves(image: Raster) -> tuple[_Profile, _Profile]:
    """Return the median differences of neighbouring columns in the upper and in the lower half of the image."""
    width, height = image.size_px
    lines = 32  # of averages, before their median; 128 give the same result in twice the time
    blocks, weights = (
        cv2.resize(plane, (width, min(lines, height)), interpolation=cv2.INTER_AREA)
        for plane in (image.pixels, image.valid.astype(np.float32))
    )
    # Smoothed as the structure field: higher frequencies, such as even and odd lines that differ, do not matter.
    smoothing_px, kernel_px = 1.0, 7
    differences = np.diff(cv2.GaussianBlur(blocks, (kernel_px, 1), smoothing_px), axis=1)
    known = (weights > MIN_VALID_WEIGHT).astype(np.uint8)
    valid = cv2.erode(known, np.ones((1, kernel_px), np.uint8), borderValue=0) > 0
    differences[~(valid[:, 1:] & valid[:, :-1])] = 0
    upper, lower = (np.median(half, axis=0).astype(float) for half in np.split(differences, [len(differences) // 2]))
    return upper, lower


def _correlation(a: _Profile, b: _Profile) -> float:
    norm = a.std() * b.std()
    return float(np.mean((a - a.mean()) * (b - b.mean())) / norm) if norm > 0 else 0.0


def _without_columns(images: Sequence[Raster]) -> list[Raster]:
    """Subtract the common pattern of columns, scaled to each image."""
    differences = np.stack([_differences(image) for image in images])
    scale = np.sqrt(np.mean(differences**2, axis=1, keepdims=True))
    common = np.mean(differences / np.maximum(scale, 1e-12), axis=0)
    gains = differences @ common / max(float(common @ common), 1e-12)
    pattern = np.concatenate([[0.0], np.cumsum(common)])
    # Standard deviation of the Gaussian that removes the drift of integrated differences; slower patterns remain.
    # Of 15, 40 and 80 px, 15 px has the smallest residual for white stripes.
    drift_px = 15.0
    pattern -= gaussian_filter1d(pattern, drift_px, mode="nearest")
    return [
        replace(image, pixels=np.where(image.valid, image.pixels - np.float32(gain * pattern), np.float32(0)))
        for image, gain in zip(images, gains, strict=True)
    ]


def _differences(image: Raster) -> _Profile:
    """Return the median differences of neighbouring columns over the valid pixels; 0 where there are none."""
    differences = np.diff(image.pixels, axis=1)
    differences[~(image.valid[:, 1:] & image.valid[:, :-1])] = np.nan
    known = np.isfinite(differences).any(axis=0)
    result = np.zeros(differences.shape[1])
    result[known] = np.nanmedian(differences[:, known], axis=0)
    return result


def _are_registered(images: Sequence[Raster]) -> bool:
    """Return True if the structures of all images match that of the first one at zero shift, in 1280 px or fewer."""
    max_shift_px, min_sigma = 0.5, 12.0  # unrelated structures have peaks of up to 8 sigma
    width, height = images[0].size_px
    scale = min(1.0, 1280 / max(width, height))
    size = reduced_size_px((width, height), 1 / scale)
    fixed, *moving = (windowed_spectra(structure_field(shrink(image, size))) for image in images)
    for spectrum in moving:
        peak = find_peak(correlation_surfaces(fixed, spectrum), exclusion_px=max(size) // 16)
        if np.hypot(*peak.shift_px) > max_shift_px * scale or peak.sigma < min_sigma:
            return False
    return True
