"""Masks of valid pixels: nodata, fill values, saturation."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import InputError
from agalign.values.image import Mask, Raster
from agalign.values.resampling import planes_of, valid_of

_MIN_SIDE_PX = 48
"""Smaller images contain too few patches for learning."""
_MAX_MEASURED = 1e15
"""Above the values of any sensor, below the fill values of netCDF, GIS and C programs (1e20 and more)."""
_MIN_SATURATED_PX = 7
"""Minimum width of a masked saturated area: patches around smaller ones contain enough of their surroundings."""


def data_mask(pixels: NDArray[np.generic], nodata: float | None) -> Mask:
    """Return (height, width) False where pixels are nodata or not finite.

    Without a declared nodata value, common fill values of floating-point and 64-bit images are also False.
    """
    valid: Mask = np.isfinite(pixels) if pixels.dtype.kind == "f" else np.ones(pixels.shape, dtype=bool)
    if nodata is not None and np.isfinite(nodata):
        valid &= pixels != nodata
    if nodata is None and (pixels.dtype.kind == "f" or pixels.dtype.itemsize == 8):
        common_fill = -9999.0, -99999.0, -32767.0, -32768.0
        values = pixels.astype(np.float32) if pixels.dtype == np.float16 else pixels  # float16 ends at 65,504
        valid &= (np.fabs(values) < _MAX_MEASURED) & ~np.isin(values, common_fill)
    return valid


def undeclared_fill(pixels: ArrayLike) -> Mask:
    """Return (height, width) True in constant areas, 0 or the type's maximum, that touch the image border.

    Warped images are often filled so without a nodata tag.
    """
    values = np.asarray(pixels)
    fill = np.zeros(values.shape, dtype=bool)
    constants = [0] if values.dtype.kind in "fb" else [0, np.iinfo(values.dtype).max]
    min_fill_share = 0.002  # a constant area at the border is fill if it covers at least this share of the image
    for constant in constants:
        equal = (values == constant).astype(np.uint8)
        border = np.concatenate([equal[0], equal[-1], equal[:, 0], equal[:, -1]])
        if not border.any():
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(equal, connectivity=4)
        touching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        large = [k for k in touching if k and stats[k, cv2.CC_STAT_AREA] >= min_fill_share * values.size]
        fill |= np.isin(labels, large)
    return fill


def learnable(valid: Mask, pixels: ArrayLike, saturation_value: float | None) -> Mask:
    """Return (height, width) True for valid pixels outside of saturated areas and their direct neighbours.

    Saturated spots narrower than _MIN_SATURATED_PX, such as glint, are kept.
    """
    if saturation_value is None:
        return valid
    saturated = (np.asarray(pixels) >= saturation_value).astype(np.uint8)
    if not saturated.any():
        return valid
    areas = cv2.morphologyEx(saturated, cv2.MORPH_OPEN, np.ones((_MIN_SATURATED_PX,) * 2, np.uint8))
    dilated = cv2.dilate(areas, np.ones((3, 3), np.uint8)) > 0
    return np.asarray(valid & ~dilated)


def raster_of(image: ArrayLike, valid: ArrayLike | None, name: str) -> Raster:
    """Convert an array (H, W), (H, W, C) or (C, H, W) to a raster.

    Constant fill at the border is masked, and saturated areas of 8 and 16 bit integers. A last channel of the lowest
    and highest value alone, as in RGBA, is alpha: a mask. Raises InputError, with `name`, if the array is not an image
    or `valid` has another shape.
    """
    planes, _ = planes_of(image, name)
    if min(planes.shape[1:]) < _MIN_SIDE_PX:
        raise InputError(f"{name} is {planes.shape[1:]}: images need {_MIN_SIDE_PX} px a side")
    # Sensors deliver 8 or 16 bits: the maximum of a wider type is not saturation.
    is_sensor_type = planes.dtype.kind in "ui" and planes.dtype.itemsize <= 2
    saturation = float(np.iinfo(str(planes.dtype)).max) if is_sensor_type else None
    mask = valid_of(image, valid, (planes.shape[1], planes.shape[2]), name)
    if len(planes) in (2, 4) and saturation is not None and np.isin(planes[-1], (0, saturation)).all():
        mask, planes = mask & (planes[-1] > 0), planes[:-1]
    for plane in planes:
        mask &= data_mask(plane, None)
    if not mask.any() and np.isfinite(planes).any() and (np.abs(planes[np.isfinite(planes)]) >= _MAX_MEASURED).all():
        raise InputError(f"{name} has only values beyond {_MAX_MEASURED:g}, which are fill values; rescale it")
    mask &= ~np.logical_and.reduce([undeclared_fill(plane) for plane in planes])
    for plane in planes:
        mask = learnable(mask, plane, saturation)
    pixels = np.where(mask, planes, 0).astype(np.float32)
    return Raster(pixels if len(planes) > 1 else pixels[0], mask)
