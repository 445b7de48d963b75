"""Which pixels can be trusted."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.records import Mask

_LEAST_FILL_SHARE = 0.002
"""A constant patch at the border smaller than this share of the image is content, not fill."""
_LEAST_SATURATED_PX = 7
"""Saturated spots narrower than this are content: half a patch still shows their surroundings."""


def data_mask(pixels: NDArray[np.generic], nodata: float | None) -> Mask:
    """(height, width), False where the pixels are nodata or not finite."""
    valid: Mask = np.isfinite(pixels) if pixels.dtype.kind == "f" else np.ones(pixels.shape, dtype=bool)
    if nodata is not None and np.isfinite(nodata):
        valid &= pixels != nodata
    return valid


def undeclared_fill(pixels: ArrayLike) -> Mask:
    """(height, width), True where zeros (or the type's largest value) run in from the image's border.

    Images that were warped before are filled this way, and few of their files say so.
    """
    values = np.asarray(pixels)
    fill = np.zeros(values.shape, dtype=bool)
    constants = [0] if values.dtype.kind == "f" else [0, np.iinfo(values.dtype).max]
    for constant in constants:
        same = (values == constant).astype(np.uint8)
        edge = np.concatenate([same[0], same[-1], same[:, 0], same[:, -1]])
        if not edge.any():
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(same, connectivity=4)
        touching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        large = [k for k in touching if k and stats[k, cv2.CC_STAT_AREA] >= _LEAST_FILL_SHARE * values.size]
        fill |= np.isin(labels, large)
    return fill


def learnable(valid: Mask, pixels: ArrayLike, saturation_value: float | None) -> Mask:
    """The valid pixels whose value says something: not in a saturated area, and not next to one.

    Glints narrower than an area's least width stay: their outlines are structure like any other.
    """
    if saturation_value is None:
        return valid
    saturated = (np.asarray(pixels) >= saturation_value).astype(np.uint8)
    if not saturated.any():
        return valid
    areas = cv2.morphologyEx(saturated, cv2.MORPH_OPEN, np.ones((_LEAST_SATURATED_PX,) * 2, np.uint8))
    grown = cv2.dilate(areas, np.ones((3, 3), np.uint8)) > 0
    return np.asarray(valid & ~grown)
