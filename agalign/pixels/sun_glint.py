"""Sun glint on water.

Water absorbs near infrared light, so what a pixel of water has above the darkest water around is light that the surface
reflects (Hedley, Harborne & Mumby 2005, doi:10.1080/01431160500034086), and the surface reflects all wavelengths alike
(Kay, Hedley & Lavender 2009, doi:10.3390/rs1040697). Water is where McFeeters' NDWI (1996,
doi:10.1080/01431169608948714) of the darkest pixels around is positive. In the centre of a glint pattern no pixel is
dark: what is spectrally flat and connected with water counts as water too, also a bright quay.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage, Mask

_BLOCK_PX = 16
"""Side of the blocks in which the darkest pixels are searched."""
_AROUND = 5
"""Side of the square of blocks that a pixel is compared with: waves have their dark faces within it."""
_DARK_PERCENTILE = 10
"""Of a block's pixels: less noisy than the minimum."""
_MIN_SHARE = 0.5
"""Of the green light that is glint."""
_MIN_PIXEL_NDWI = -0.2
"""Glint is as bright in green as in near infrared; vegetation and soil at a shore are not."""
_MIN_SIDE_BLOCKS = 2
_UNKNOWN = 1e30
"""Larger than any reflectance."""


def sun_glint(green: FloatImage, nir: FloatImage) -> Mask:
    """(height, width) True where more than half of the green light is sun glint on water, given reflectances
    (height, width), nan where unknown.

        glint = nir - nir_dark,  water where (green_dark - nir_dark) / (green_dark + nir_dark) > 0

    Images smaller than a few blocks have none.
    """
    height, width = green.shape
    if min(height, width) < _MIN_SIDE_BLOCKS * _BLOCK_PX:
        return np.zeros(green.shape, dtype=bool)
    green_dark, nir_dark = (_darkest_around(band) for band in (green, nir))
    size_px = width, height
    with np.errstate(invalid="ignore", divide="ignore"):
        ndwi = (green_dark - nir_dark) / (green_dark + nir_dark)
        clear = ndwi > 0
        if not clear.any():
            return np.zeros(green.shape, dtype=bool)
        # Where all pixels around are glint, the darkest of them is not that of the water.
        nir_dark = np.fmin(nir_dark, np.median(nir_dark[clear]))
        blocks = _connected(ndwi > _MIN_PIXEL_NDWI, clear)
        water = cv2.resize(blocks.astype(np.uint8), size_px, interpolation=cv2.INTER_NEAREST) > 0
        excess = nir - cv2.resize(nir_dark, size_px, interpolation=cv2.INTER_NEAREST)
        flat = (green - nir) / (green + nir) > _MIN_PIXEL_NDWI
        return np.asarray(water & flat & (excess > _MIN_SHARE * green))


def _connected(candidates: Mask, seeds: Mask) -> Mask:
    """The candidates (rows, columns) that are connected with a seed; all seeds are candidates."""
    _, labels = cv2.connectedComponents(candidates.astype(np.uint8))
    return np.asarray(candidates & np.isin(labels, np.unique(labels[seeds])))


def _darkest_around(band: FloatImage) -> NDArray[np.float32]:
    """(rows, columns) of blocks: the lowest of the dark values of the blocks around; nan where all is unknown."""
    rows, columns = (max(1, n // _BLOCK_PX) for n in band.shape)
    cut = band[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    blocks = cut.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    known = np.where(np.isfinite(blocks), blocks, np.float32(_UNKNOWN))
    dark = np.percentile(known, _DARK_PERCENTILE, axis=-1, method="lower").astype(np.float32)
    lowest = cv2.erode(dark, np.ones((_AROUND, _AROUND), np.uint8))
    return np.where(lowest < _UNKNOWN, lowest, np.float32(np.nan))
