"""Resampling of arrays at fractional positions by an interpolation kernel, tile by tile."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.errors import InputError
from agalign.host.held_sizes import RESAMPLED_TILE_PX
from agalign.values import geometry
from agalign.values.choices import Interpolation
from agalign.values.geometry import Points
from agalign.values.image import FloatImage, Mask, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import Size

_KERNEL_PX = {"cubic": 4, "lanczos": 8}
"""Sides of the kernels with negative weights, which are wider than two pixels."""
_SUPPORT_PX = 4
"""Half width of the widest interpolation kernel."""
MIN_VALID_WEIGHT = 0.999
"""Minimum weight of valid pixels in a valid resampled or reduced pixel: float32 weights do not sum to exactly 1."""
_MAX_FLOAT32_PX = 1 << 15
"""Positions in images of longer sides need float64: their last bit in float32 is above 0.002 px."""
_MAX_REMAP_PX = 32_000
"""OpenCV limits the sides of one image to 32,767 px."""
NODES_PX = 16
"""Distance of the nodes at which a smooth value, such as an expected error, is calculated."""
_MAX_CHANNELS = 16
"""Distinguishes (H, W, C) from (C, H, W): images have more rows than this."""


def tiles(area: Tile, side_px: int) -> Iterator[Tile]:
    """Yield the tiles of an area row by row; those at the right and bottom may be smaller than `side_px`."""
    for y in range(area.y0, area.y0 + area.height, side_px):
        for x in range(area.x0, area.x0 + area.width, side_px):
            width = min(side_px, area.x0 + area.width - x)
            height = min(side_px, area.y0 + area.height - y)
            yield Tile(x, y, width, height)


def nodes_along(length_px: int) -> int:
    """Return the number of nodes along an axis of an image, at least every NODES_PX, for `between_nodes`."""
    return max(2, -(-length_px // NODES_PX))


def between_nodes(nodes: NDArray[np.float32], size_px: Size, tile: Tile) -> FloatImage:
    """Interpolate values at nodes (rows, columns) linearly to the pixels (height, width) of a tile.

    The nodes are spread evenly over an image (width, height), from corner to corner.
    """
    x, y = (np.linspace(0, n - 1, m, dtype=np.float32) for n, m in zip(nodes.shape[::-1], size_px, strict=True))
    values = np.empty((tile.height, tile.width), np.float32)
    for part in tiles(tile, _MAX_REMAP_PX):
        at = np.meshgrid(x[part.x0 : part.x0 + part.width], y[part.y0 : part.y0 + part.height])
        in_tile = values[part.y0 - tile.y0 :, part.x0 - tile.x0 :][: part.height, : part.width]
        in_tile[:] = cv2.remap(nodes, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values


def planes_of(image: ArrayLike, name: str) -> tuple[NDArray[np.generic], bool]:
    """Return an image (H, W), (H, W, C) or (C, H, W) as (C, H, W), and True if its channels were last.

    Raises InputError, with `name`, for any other array.
    """
    array = array_of(image, name)
    if array.dtype.kind not in "uifb" or array.ndim not in (2, 3):
        raise InputError(
            f"{name} must be a numeric (H, W), (H, W, C) or (C, H, W) array, not {array.dtype} {array.shape}"
        )
    channels_last = array.ndim == 3 and array.shape[-1] <= _MAX_CHANNELS < array.shape[0]
    planes = np.moveaxis(array, -1, 0) if channels_last else array if array.ndim == 3 else array[None]
    if not 1 <= len(planes) <= _MAX_CHANNELS:
        raise InputError(f"{name} is {array.shape}: images have 1 to {_MAX_CHANNELS} channels")
    return planes, channels_last


def array_of(values: ArrayLike, name: str) -> NDArray[np.generic]:
    """Return an array, also of a tensor of PyTorch. Raises InputError, with `name`, for what is not an array."""
    given: Any = values
    try:
        if hasattr(given, "detach") and hasattr(given, "cpu"):  # a tensor: with a gradient, on a GPU
            given = given.detach().cpu()
        try:
            return np.asarray(given)
        except TypeError:  # numpy lacks types of tensors, such as bfloat16
            return np.asarray(given.float() if hasattr(given, "float") else given)
    except ValueError:
        raise InputError(f"{name} is not an array: its rows have different lengths") from None
    except Exception as error:  # libraries of arrays raise errors of many classes
        raise InputError(f"{name} cannot be converted to an array ({str(error).partition(chr(10))[0]})") from None


def homography_of(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return a homography (3, 3) with its bottom-right element equal to 1.

    Raises InputError, with `name`, for what is not an array of real numbers, and GeometryError for other arrays that
    are not homographies.
    """
    array = array_of(values, name)
    if array.dtype.kind == "c":
        raise InputError(f"{name} has complex numbers; a homography has real ones")
    return geometry.normalised(array)


def positions_of(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return positions (..., 2), px. Raises InputError, with `name`, for anything else."""
    array = array_of(values, name)
    if array.dtype.kind not in "uifb" or array.shape[-1:] != (2,):
        raise InputError(f"{name} must be positions x, y (..., 2), not {array.dtype} {array.shape}")
    return array.astype(np.float64)


def valid_of(image: ArrayLike, valid: ArrayLike | None, size: tuple[int, int], name: str = "") -> Mask:
    """Return the mask (height, width) `size` of an image: True where `valid` is neither 0 nor NaN, and a masked array
    is not masked.

    Raises InputError, with the `name` of the image, for a mask that has another size.
    """
    mask_name = f"{name}_valid" if name else "valid"
    mask = np.ones(size, bool)
    if valid is not None:
        given = array_of(np.ma.filled(valid, False) if isinstance(valid, np.ma.MaskedArray) else valid, mask_name)
        if given.dtype.kind not in "uifb":
            raise InputError(f"{mask_name} must be a mask (H, W), not {given.dtype} {given.shape}")
        mask = given.astype(bool) & ~np.isnan(given)
    if mask.shape != size:
        raise InputError(f"{mask_name} is {mask.shape}, the image {size}")
    if isinstance(image, np.ma.MaskedArray):
        hidden, _ = planes_of(np.ma.getmaskarray(image), name)
        mask &= ~hidden.any(axis=0)
    return mask


def resample_planes(
    planes: NDArray[np.generic],
    valid: Mask,
    mapping: PixelMapping,
    size_px: Size,
    interpolation: Interpolation,
    fill: float,
) -> tuple[NDArray[np.generic], Mask]:
    """Resample planes (C, h, w) with the mask `valid` (h, w) to a reference of `size_px` (width, height).

    Returns (C, height, width) of the same type, with `fill` where a pixel is not valid, and the mask (height, width).
    """
    width, height = size_px
    result = np.empty((len(planes), height, width), planes.dtype)
    result_valid = np.empty((height, width), bool)
    moving_size_px = valid.shape[1], valid.shape[0]
    pending = list(tiles(Tile(0, 0, width, height), RESAMPLED_TILE_PX))
    while pending:
        tile = pending.pop()
        at = np.s_[tile.y0 : tile.y0 + tile.height, tile.x0 : tile.x0 + tile.width]
        positions, source = source_positions(mapping, tile, size_px, moving_size_px)
        if source is None:
            result[:, *at], result_valid[at] = fill, False
            continue
        if max(source.width, source.height) > _MAX_REMAP_PX:
            pending += tiles(tile, (max(tile.width, tile.height) + 1) // 2)
            continue
        cut = np.s_[source.y0 : source.y0 + source.height, source.x0 : source.x0 + source.width]
        visible = ~mapping.hidden(tile)
        for plane, resampled in zip(planes, result, strict=True):
            pixels, inside = resample(plane[cut], valid[cut], positions, source, moving_size_px, interpolation)
            result_valid[at] = inside & visible
            resampled[at] = np.where(result_valid[at], pixels, np.asarray(fill).astype(planes.dtype))
    return result, result_valid


def source_positions(
    mapping: PixelMapping, tile: Tile, size_px: Size | None, moving_size_px: Size
) -> tuple[NDArray[np.floating], Tile | None]:
    """Return the positions (height, width, 2) of a tile's pixels in the moving image, and the `source_window` of them.

    With (width, height) `size_px` of the reference they are the same, to the last bit, in any tile: OpenCV's Lanczos
    kernel rounds them to 1/32 px, so that a difference of rounding may change a pixel by hundreds.
    """
    dtype = np.float32 if max(moving_size_px) <= _MAX_FLOAT32_PX else np.float64
    positions = mapping.positions(tile, dtype, size_px)
    return positions, source_window(positions, moving_size_px, is_smooth=mapping.is_smooth(tile))


def source_window(positions: NDArray[np.floating], size_px: Size, *, is_smooth: bool) -> Tile | None:
    """Return the window of an image (width, height) that interpolation at positions (H, W, 2) reads; None for none.

    If the mapping is smooth, samples 16 px apart and the borders determine the extent within one pixel.
    """
    step = 16 if is_smooth else 1
    rows, columns = (np.append(np.arange(0, n, step), n - 1) for n in positions.shape[:2])
    samples = positions[np.ix_(rows, columns)]
    if not np.isfinite(samples).any():
        return None
    # Points near the horizon of a homography are far outside of every image.
    low, high = (np.clip(f(samples, axis=(0, 1)), -(2**30), 2**30) for f in (np.nanmin, np.nanmax))
    # Twice: pixels under a kernel, and those from which the invalid ones among them are filled.
    x0, y0 = np.maximum(np.floor(low).astype(int) - 2 * _SUPPORT_PX - 1, 0).tolist()
    x1, y1 = np.minimum(np.ceil(high).astype(int) + 2 * _SUPPORT_PX + 2, size_px).tolist()
    return Tile(x0, y0, x1 - x0, y1 - y0) if x1 - x0 >= 1 and y1 - y0 >= 1 else None


def resample(
    pixels: NDArray[np.generic],
    valid: Mask,
    positions: NDArray[np.floating],
    window: Tile,
    size_px: Size,
    interpolation: Interpolation,
) -> tuple[NDArray[np.generic], Mask]:
    """Resample pixels (h, w) of a window of an image of `size_px` (width, height) at positions (H, W, 2) in the image.

    Values are limited to the range of the pixels under the kernel: wide kernels ring next to saturated pixels. Returns
    (H, W) pixels of the same type, with integers rounded and clipped, and their mask.
    """
    start = window.x0, window.y0
    map_xy = np.empty(positions.shape, np.float32)
    for axis in (0, 1):  # both at once take four times as long
        np.subtract(positions[..., axis], start[axis], out=map_xy[..., axis])
    all_valid = bool(valid.all())
    source = _for_remap(pixels if all_valid else _filled(pixels, valid), interpolation)
    flags: dict[Interpolation, int] = {
        "nearest": cv2.INTER_NEAREST,
        "bilinear": cv2.INTER_LINEAR,
        "cubic": cv2.INTER_CUBIC,
        "lanczos": cv2.INTER_LANCZOS4,
    }
    sampled = cv2.remap(source, map_xy, None, flags[interpolation], borderMode=cv2.BORDER_REPLICATE)
    if interpolation in _KERNEL_PX:
        np.clip(sampled, *_range_under_kernel(source, map_xy, _KERNEL_PX[interpolation]), out=sampled)
    half = 0.5 if interpolation == "nearest" else 0.0
    inside = between(map_xy, np.negative(start) - half, np.subtract(size_px, start) - 1 + half)
    if not all_valid:
        flag = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
        weight = cv2.remap(valid.astype(np.float32), map_xy, None, flag, borderMode=cv2.BORDER_REPLICATE)
        inside &= weight > MIN_VALID_WEIGHT
    return as_type(sampled, pixels.dtype), np.asarray(inside)


def _range_under_kernel(
    source: NDArray[np.generic], positions: NDArray[np.float32], side_px: int
) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """Return minimum and maximum (H, W) of the pixels (h, w) that a kernel of even side uses at positions (H, W, 2)."""
    kernel, before = np.ones((side_px, side_px), np.uint8), (side_px // 2 - 1, side_px // 2 - 1)
    first = np.floor(positions)
    low, high = (
        cv2.remap(f(source, kernel, anchor=before), first, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        for f in (cv2.erode, cv2.dilate)
    )
    return np.asarray(low), np.asarray(high)


def is_under_kernel(mask: Mask, positions: NDArray[np.float32], interpolation: Interpolation) -> Mask:
    """Return True (H, W) where a pixel of a mask (h, w) contributes to a value at a position (H, W, 2)."""
    if not mask.any():
        return np.zeros(positions.shape[:2], dtype=bool)
    if interpolation in _KERNEL_PX:
        return _range_under_kernel(mask.astype(np.uint8), positions, _KERNEL_PX[interpolation])[1].astype(bool)
    kernel = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
    weight = cv2.remap(mask.astype(np.float32), positions, None, kernel, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(weight > 1e-3)  # smaller weights are rounding errors


def between(positions: NDArray[np.floating], minimum: Points, maximum: Points) -> Mask:
    """Return (H, W) True where positions (H, W, 2) are inside or on the border of a rectangle."""
    return np.asarray(cv2.inRange(positions, tuple(map(float, minimum)), tuple(map(float, maximum))) != 0)


def _for_remap(pixels: NDArray[np.generic], interpolation: Interpolation) -> NDArray[np.generic]:
    """Convert to a type that cv2.remap supports and in which it neither rounds nor clips."""
    if interpolation == "nearest" and pixels.dtype in (np.uint8, np.uint16, np.int16, np.float32, np.float64):
        return pixels
    wide = pixels.dtype in (np.float64, np.int32, np.uint32, np.int64, np.uint64)
    return pixels.astype(np.float64 if wide else np.float32, copy=False)


def _filled(pixels: NDArray[np.generic], valid: Mask) -> NDArray[np.generic]:
    """Replace invalid pixels by the mean of their surroundings, which prevents ringing of wide kernels at nodata."""
    known = valid.astype(np.float32)
    values = np.where(valid, pixels, 0).astype(np.float32)
    kernel = 2 * _SUPPORT_PX + 1, 2 * _SUPPORT_PX + 1
    mean = cv2.blur(values, kernel) / np.maximum(cv2.blur(known, kernel), 1e-6)
    return np.where(valid, pixels, mean.astype(pixels.dtype))


def can_hold(dtype: np.dtype[np.generic], value: float) -> bool:
    """Return True for a value within the limits of a type, and for NaN and infinity if it is a floating-point type."""
    if dtype.kind not in "ui":
        with np.errstate(over="ignore"):
            return not np.isfinite(value) or bool(np.isfinite(np.float64(value).astype(dtype)))
    limits = np.iinfo(str(dtype))
    return float(value).is_integer() and limits.min <= value <= limits.max


def as_type(values: NDArray[np.generic], dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Return values (height, width) in another type, rounded and limited to its range if it is an integer type."""
    if values.dtype == dtype or dtype.kind == "f":
        return values.astype(dtype, copy=False)
    if dtype.kind == "b":
        return np.asarray(values >= np.float32(0.5))
    limits = np.iinfo(str(dtype))
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max).astype(dtype))
