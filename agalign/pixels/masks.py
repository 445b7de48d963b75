"""Masks of valid pixels: nodata, fill values, saturation."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import InputError
from agalign.values.image import Mask, Raster, Tile
from agalign.values.resampling import planes_of, valid_of

_MIN_SIDE_PX = 48
"""Smaller images contain too few patches for learning."""
_MAX_SIDE_PX = 32_766
"""OpenCV resamples no larger images at once."""
_MAX_MEASURED = 1e15
"""Above the values of any sensor, below the fill values of netCDF, GIS and C programs (1e20 and more)."""
_MIN_FILL_SHARE = 0.002
"""Share of the image from which constant pixels at its border, or at the end of its file, count as fill."""
_MAX_SHARE_ELSEWHERE = 0.01
"""Share of the other pixels that may have the value of missing ones: in dark bands many pixels are 0, at any place."""
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

    Warped images are often filled so without a nodata tag; dark or bright objects may look the same, so that only the
    alignment leaves these areas out. `missing_end` is certain.
    """
    values = np.asarray(pixels)
    fill = np.zeros(values.shape, dtype=bool)
    constants = [0] if values.dtype.kind in "fb" else [0, np.iinfo(values.dtype).max]
    for constant in constants:
        equal = (values == constant).astype(np.uint8)
        border = np.concatenate([equal[0], equal[-1], equal[:, 0], equal[:, -1]])
        if not border.any():
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(equal, connectivity=4)
        touching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        large = [k for k in touching if k and stats[k, cv2.CC_STAT_AREA] >= _MIN_FILL_SHARE * values.size]
        fill |= np.isin(labels, large)
    return fill


def missing_end(pixels: NDArray[np.generic], block_px: tuple[int, int], saturation_value: float | None) -> list[Tile]:
    """Return the parts of an image (height, width) that its file lacks: the pixels at the end, in the order of the
    file, that all have one value, as an incomplete transfer leaves them.

    The file has blocks of `block_px` (width, height): strips, or tiles. Empty for a constant image, for saturated
    pixels, and if the value occurs elsewhere too.
    """
    height, width = pixels.shape
    value = pixels[-1, -1]
    if saturation_value is not None and value >= saturation_value:
        return []
    is_other = np.asarray(pixels != value)
    parts: list[Tile] = []
    tile_width, tile_height = (block_px[0], block_px[1]) if block_px[0] < width else (width, height)
    for y0 in range((height - 1) // tile_height * tile_height, -1, -tile_height):
        for x0 in range((width - 1) // tile_width * tile_width, -1, -tile_width):
            block = is_other[y0 : y0 + tile_height, x0 : x0 + tile_width]
            rows = np.flatnonzero(block.any(axis=1))
            first = int(rows[-1]) + 1 if rows.size else 0  # row that lacks all pixels
            if first < len(block):
                parts.append(Tile(x0, y0 + first, block.shape[1], len(block) - first))
            if first:
                begin = int(np.flatnonzero(block[first - 1])[-1]) + 1  # of the missing end of the row before
                if parts and begin < block.shape[1]:
                    parts.append(Tile(x0 + begin, y0 + first - 1, block.shape[1] - begin, 1))
                return parts if _is_missing(pixels, value, parts) else []
    return []


def _is_missing(pixels: NDArray[np.generic], value: np.generic, parts: Sequence[Tile]) -> bool:
    """True if parts with one value are large enough, and the value is rare elsewhere."""
    missing = sum(part.width * part.height for part in parts)
    elsewhere = np.count_nonzero(pixels == value) - missing
    return bool(
        missing >= _MIN_FILL_SHARE * pixels.size and elsewhere <= _MAX_SHARE_ELSEWHERE * (pixels.size - missing)
    )


def without_parts(valid: Mask, parts: Sequence[Tile], window: Tile) -> Mask:
    """Return a mask (height, width) of a window of an image, False in these parts of the image.

    The window has the size of the mask, or is reduced to it.
    """
    result = valid
    scale_x, scale_y = valid.shape[1] / window.width, valid.shape[0] / window.height
    for part in parts:
        left, top = (part.x0 - window.x0) * scale_x, (part.y0 - window.y0) * scale_y
        right, bottom = left + part.width * scale_x, top + part.height * scale_y
        if right > 0 and bottom > 0 and left < valid.shape[1] and top < valid.shape[0]:
            result = result.copy() if result is valid else result
            result[max(0, math.floor(top)) : math.ceil(bottom), max(0, math.floor(left)) : math.ceil(right)] = False
    return result


def saturated(valid: Mask, pixels: ArrayLike, saturation_value: float | None) -> Mask:
    """Return (height, width) True for valid pixels that are saturated; none if the value is unknown."""
    if saturation_value is None:
        return np.zeros(valid.shape, dtype=bool)
    return np.asarray(valid & (np.asarray(pixels) >= saturation_value))


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
    if max(planes.shape[1:]) > _MAX_SIDE_PX:
        raise InputError(
            f"{name} is {planes.shape[1:]}: images have at most {_MAX_SIDE_PX} px a side; reduce or cut it"
        )
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
