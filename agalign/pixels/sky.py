"""Texture of an image, which distinguishes clear sky from other scenes."""

import numpy as np

from agalign.values.image import Raster

MAX_SKY_TEXTURE = 0.015
"""Maximum relative texture of a band of clear sky. Measured: 0.004 to 0.007 for sky, 0.068 for water without glint,
0.1 to 1 for crops, trees and soil."""
LOOK_PX = 64
"""Longest side to which images are averaged: it suppresses noise and keeps textures of one hundredth of the image."""
_DEGREE = 4
"""Degree of the polynomial that models vignetting and the gradient of the sky."""
_MIN_VALID_SHARE = 0.5
"""Minimum share of valid pixels for a texture."""


def relative_texture(image: Raster, black_level: float = 0.0) -> float | None:
    """Return the standard deviation of an image from a smooth surface, relative to its mean above the black level.

    The image has one channel and `LOOK_PX` along its longest side. None if less than half of it is valid or its mean is
    not above the black level.
    """
    pixels, valid = image.pixels, image.valid
    if pixels.ndim != 2 or valid.mean() < _MIN_VALID_SHARE:
        return None
    mean = float(pixels[valid].mean()) - black_level
    if mean <= 0:
        return None
    height, width = valid.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    basis, values = np.stack([t[valid] for t in terms], axis=-1), (pixels[valid] - black_level) / mean
    if len(values) <= len(terms):
        return None
    surface, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return float((values - basis @ surface).std())
