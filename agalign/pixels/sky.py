"""The texture of an image: a clear sky has next to none."""

import numpy as np

from agalign.values.image import Raster

MAX_SKY_TEXTURE = 0.015
"""Relative texture up to which a band may show a clear sky: the bands of a real one have 0.004 to 0.007. Every other
real capture at hand has a band with 0.068 or more (water without glint); crops, trees and soil have 0.1 to 1."""
LOOK_PX = 64
"""Longest side to which images are averaged down: noise vanishes, and texture of a hundredth of an image stays."""
_DEGREE = 4
"""Of the polynomial that models vignetting and the gradient of the sky."""
_MIN_VALID = 0.5


def relative_texture(image: Raster, black_level: float = 0.0) -> float | None:
    """Return the standard deviation of an image about a smooth surface, relative to its mean above the black level.

    The image has `LOOK_PX` along its longest side. None where less than half of it is valid, or where it is as dark as
    the black level.
    """
    pixels, valid = image.pixels, image.valid
    if pixels.ndim != 2 or valid.mean() < _MIN_VALID:
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
