"""Which pixels can be trusted."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import InputError
from agalign.values.image import Mask, Raster

_MIN_SIDE_PX = 48
"""Smaller images hold too few patches to learn from."""
_MAX_CHANNELS = 16
"""Distinguishes (H, W, C) from (C, H, W): images have more rows than this."""
_MAX_SENSOR_BYTES = 2
"""Sensors count in 8 or 16 bits; the largest value of a wider type is not saturation."""
_USUAL_FILLS = (-9999.0, -99999.0, -32767.0, -32768.0)
_LARGEST_MEASURED = 1e15
"""No sensor's unit reaches this; the fills of netCDF, GIS and C programs (1e20, 9.97e36, 3.4e38) do."""
_MIN_FILL_SHARE = 0.002
"""A constant patch at the border smaller than this share of the image is content, not fill."""
_MIN_SATURATED_PX = 7
"""Saturated spots narrower than this are content: half a patch still shows their surroundings."""


def data_mask(pixels: NDArray[np.generic], nodata: float | None) -> Mask:
    """(height, width), False where the pixels are nodata or not finite, and where they are what programs fill gaps of
    floats with, if nothing is declared.
    """
    valid: Mask = np.isfinite(pixels) if pixels.dtype.kind == "f" else np.ones(pixels.shape, dtype=bool)
    if nodata is not None and np.isfinite(nodata):
        valid &= pixels != nodata
    if nodata is None and pixels.dtype.kind == "f":
        valid &= (np.abs(pixels) < _LARGEST_MEASURED) & ~np.isin(pixels, _USUAL_FILLS)
    return valid


def undeclared_fill(pixels: ArrayLike) -> Mask:
    """(height, width), True where zeros (or the type's largest value) run in from the image's border.

    Images that were warped before are filled this way, usually without metadata about it.
    """
    values = np.asarray(pixels)
    fill = np.zeros(values.shape, dtype=bool)
    constants = [0] if values.dtype.kind in "fb" else [0, np.iinfo(values.dtype).max]
    for constant in constants:
        same = (values == constant).astype(np.uint8)
        edge = np.concatenate([same[0], same[-1], same[:, 0], same[:, -1]])
        if not edge.any():
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(same, connectivity=4)
        touching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        large = [k for k in touching if k and stats[k, cv2.CC_STAT_AREA] >= _MIN_FILL_SHARE * values.size]
        fill |= np.isin(labels, large)
    return fill


def learnable(valid: Mask, pixels: ArrayLike, saturation_value: float | None) -> Mask:
    """The valid pixels with a usable value: not in a saturated area, and not next to one.

    Glints narrower than an area's least width stay: their outlines are structure like any other.
    """
    if saturation_value is None:
        return valid
    saturated = (np.asarray(pixels) >= saturation_value).astype(np.uint8)
    if not saturated.any():
        return valid
    areas = cv2.morphologyEx(saturated, cv2.MORPH_OPEN, np.ones((_MIN_SATURATED_PX,) * 2, np.uint8))
    grown = cv2.dilate(areas, np.ones((3, 3), np.uint8)) > 0
    return np.asarray(valid & ~grown)


def raster_of(image: ArrayLike, valid: ArrayLike | None, name: str) -> Raster:
    """An array (H, W), (H, W, C) or (C, H, W) as the estimation sees it: without constant fill at its border, and for
    integers without saturated areas. Raises InputError, with `name`, if it is not an image.
    """
    planes = _planes(np.asarray(image), name)
    measured = planes.dtype.kind in "ui" and planes.dtype.itemsize <= _MAX_SENSOR_BYTES
    saturation = float(np.iinfo(str(planes.dtype)).max) if measured else None
    mask = np.ones(planes.shape[1:], bool) if valid is None else np.array(valid, bool)
    if mask.shape != planes.shape[1:]:
        raise InputError(f"{name}_valid is {mask.shape}, the image {planes.shape[1:]}")
    for plane in planes:
        mask &= data_mask(plane, None)
    mask &= ~np.logical_and.reduce([undeclared_fill(plane) for plane in planes])
    for plane in planes:
        mask = learnable(mask, plane, saturation)
    pixels = np.where(mask, planes, 0).astype(np.float32)
    return Raster(pixels if len(planes) > 1 else pixels[0], mask)


def _planes(array: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    """(C, H, W) from (H, W), (H, W, C) or (C, H, W). Raises InputError, with `name`, if the array is not an image."""
    if array.dtype.kind not in "uifb" or array.ndim not in (2, 3):
        raise InputError(
            f"{name} must be a numeric (H, W), (H, W, C) or (C, H, W) array, not {array.dtype} {array.shape}"
        )
    if array.ndim == 3 and array.shape[-1] <= _MAX_CHANNELS < array.shape[0]:
        array = np.moveaxis(array, -1, 0)
    planes = array if array.ndim == 3 else array[None]
    if len(planes) > _MAX_CHANNELS or min(planes.shape[1:]) < _MIN_SIDE_PX:
        raise InputError(
            f"{name} is {array.shape}: images need {_MIN_SIDE_PX} px a side and at most {_MAX_CHANNELS} channels"
        )
    return planes
