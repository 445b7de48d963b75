"""Conversion of multichannel images to one grey channel."""

import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage, Mask, Raster

_BT_601 = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue (ITU-R BT.601), as in OpenCV and Pillow."""


def channel_mean(raster: Raster) -> Raster:
    """Return the mean of all channels, (H, W) or (C, H, W) -> (H, W)."""
    if raster.pixels.ndim == 2:
        return raster
    return Raster(np.asarray(raster.pixels.mean(axis=0), np.float32), raster.valid, raster.lens)


def luma(image: FloatImage) -> FloatImage:
    """Return the luma (H, W) of an RGB image (3, H, W), or the mean of any other number of channels (C, H, W)."""
    if image.ndim == 2:
        return image
    if len(image) != 3:
        return np.asarray(image.mean(axis=0), np.float32)
    return np.tensordot(_BT_601, image, axes=1)


def eight_bit(image: FloatImage, valid: Mask) -> NDArray[np.uint8]:
    """Stretch an image (H, W) to 0 to 255 between the 1st and 99th percentile of the valid pixels."""
    low, high = np.percentile(image[valid], (1, 99)) if valid.any() else (0.0, 1.0)
    return np.asarray((np.clip((image - low) / max(high - low, 1e-9), 0, 1) * 255).round().astype(np.uint8))
