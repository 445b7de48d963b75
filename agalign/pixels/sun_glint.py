"""Detection of sun glint on water.

Water absorbs near-infrared light, so the excess of a water pixel over the darkest water nearby is light reflected by
the surface (Hedley, Harborne & Mumby 2005, doi:10.1080/01431160500034086). This reflection is nearly independent of the
wavelength (Kay, Hedley & Lavender 2009, doi:10.3390/rs1040697). Water has a positive NDWI (McFeeters 1996,
doi:10.1080/01431169608948714) in the darkest pixels nearby. In the centre of a glint pattern no pixel is dark, so
spectrally flat areas connected with water are classified as water too. Waves make glint vary from pixel to pixel, which
dry sand, a quay or a boat do not: bright areas without variation are not glint.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values.image import FloatImage, Mask

_BLOCK_PX = 16
"""Side of the blocks for which a dark value is computed."""
_MIN_PIXEL_NDWI = -0.2
"""Glint is as bright in green as in near infrared; vegetation and soil at a shore are not."""
_MIN_VARIATION, _MIN_AREA_SHARE = 0.1, 0.5
"""Minimum coefficient of variation of near infrared in a bright area, which covers at least this share of a block: 0.15
or more in 99 % of the glint on an estuary, below 0.08 on sand."""


def sun_glint(green: FloatImage, nir: FloatImage) -> Mask:
    """Return (height, width) True where more than half of the green light is sun glint on water.

    `green` and `nir` are reflectances (height, width), NaN where unknown.

        glint = nir - nir_dark,  water where (green_dark - nir_dark) / (green_dark + nir_dark) > 0

    Images with sides of fewer than two blocks have none: they have no neighbourhood to compare with.
    """
    height, width = green.shape
    if min(height, width) < 2 * _BLOCK_PX:
        return np.zeros(green.shape, dtype=bool)
    green_dark, nir_dark = (_darkest_nearby(band) for band in (green, nir))
    with np.errstate(invalid="ignore", divide="ignore"):
        ndwi = (green_dark - nir_dark) / (green_dark + nir_dark)
        is_water_block = ndwi > 0
        if not is_water_block.any():
            return np.zeros(green.shape, dtype=bool)
        # Where all pixels nearby are glint, their minimum is above the value of water.
        nir_dark = np.fmin(nir_dark, np.median(nir_dark[is_water_block]))
        blocks = _connected(ndwi > _MIN_PIXEL_NDWI, is_water_block)
        of_water = np.where(blocks, nir_dark, np.nan).repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
        glint = nir - of_water[:height, :width]
        is_flat = (green - nir) / (green + nir) > _MIN_PIXEL_NDWI
        min_glint_share = 0.5  # minimum share of glint in the green light
        is_bright = np.asarray(is_flat & (glint > min_glint_share * green))
    return is_bright & ~_is_uniform(nir, is_bright)


def _is_uniform(nir: FloatImage, area: Mask) -> Mask:
    """Return True (height, width) where an area covers the surroundings, and does not vary in them as glint does."""
    share, mean, square = (
        cv2.blur(np.where(area, values, 0).astype(np.float32), (_BLOCK_PX, _BLOCK_PX)) for values in (1, nir, nir * nir)
    )
    variance = square * share - mean * mean  # times the square of the share, as the square of the mean
    return np.asarray((share >= _MIN_AREA_SHARE) & (variance < (_MIN_VARIATION * mean) ** 2))


def _connected(candidates: Mask, seeds: Mask) -> Mask:
    """Return the candidates (rows, columns) that are connected with a seed; all seeds are candidates."""
    _, labels = cv2.connectedComponents(candidates.astype(np.uint8))
    return np.asarray(candidates & np.isin(labels, np.unique(labels[seeds])))


def _darkest_nearby(band: FloatImage) -> NDArray[np.float32]:
    """Return the minimum dark value of the blocks nearby for each block, (rows, columns); NaN if all are unknown."""
    complete = np.pad(band, [(0, -n % _BLOCK_PX) for n in band.shape], constant_values=np.nan)
    rows, columns = (n // _BLOCK_PX for n in complete.shape)
    blocks = complete.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    unknown = np.float32(1e30)  # larger than any reflectance
    known = np.where(np.isfinite(blocks), blocks, unknown)
    dark = np.percentile(known, 10, axis=-1, method="lower").astype(np.float32)  # less noisy than the minimum
    nearby = np.ones((5, 5), np.uint8)  # blocks; they contain the dark faces of waves
    darkest = cv2.erode(dark, nearby)
    return np.where(darkest < unknown, darkest, np.float32(np.nan))
