"""Resampling of a moving band onto the reference grid, tile by tile, and of reduced images for the estimation.

A reference pixel is mapped by the reference's lens model, the homography and the moving camera's lens model:
raw reference px -> undistorted -> H -> undistorted -> raw moving px. Output pixels are interpolated once.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import OpenRaster, open_raster, read_window
from agalign.values import geometry, lens
from agalign.values.capture import Band, Radiometry
from agalign.values.choices import Interpolation
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

_INTERPOLATION_FLAGS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_SUPPORT_PX = 4
"""Half width of the widest interpolation kernel."""
_SAMPLE_PX = 16
"""Spacing of the positions from which the extent of a tile in the moving image is computed."""
_MIN_VALID_WEIGHT = 0.999
"""Minimum weight of valid pixels in a valid resampled pixel: float32 weights do not sum to exactly 1."""
_MIN_SIDE_PX = 8
"""A moving image is not reduced below this, whatever the scale of the homography."""
_OUTSIDE_PX = -1e6
"""Position that replaces points on the horizon of a homography."""


def tiles(area: Tile, side_px: int) -> Iterator[Tile]:
    """Yield the tiles of an area row by row; those at the right and bottom may be smaller than `side_px`."""
    for y in range(area.y0, area.y0 + area.height, side_px):
        for x in range(area.x0, area.x0 + area.width, side_px):
            width = min(side_px, area.x0 + area.width - x)
            height = min(side_px, area.y0 + area.height - y)
            yield Tile(x, y, width, height)


def resample_tile(
    band: Band, mapping: PixelMapping, tile: Tile, interpolation: Interpolation, radiometry: Radiometry | None = None
) -> tuple[NDArray[np.generic], Mask]:
    """Resample the moving band to a tile of the reference grid; return pixels and mask, each (height, width).

    The type is that of the band, with integers rounded and clipped, or float32 if calibrated with `radiometry`. A pixel
    is valid if its position is inside the moving image and not occluded, and no invalid pixel contributes to it. Raises
    UnreadableFileError.
    """
    with open_raster(band.path) as dataset:
        return resample_tile_of(dataset, band, mapping, tile, interpolation, radiometry)


def resample_tile_of(
    dataset: OpenRaster, band: Band, mapping: PixelMapping, tile: Tile, interpolation: Interpolation,
    radiometry: Radiometry | None = None,
) -> tuple[NDArray[np.generic], Mask]:  # fmt: skip
    """Call `resample_tile` on an open file, so that GDAL's block cache serves neighbouring tiles."""
    positions = mapping.positions(tile, np.float32)
    shape = tile.height, tile.width
    # Without parallax the mapping is smooth: coarse samples and the borders determine the extent within one pixel.
    step = _SAMPLE_PX if mapping.parallax is None else 1
    rows, columns = (np.append(np.arange(0, n, step), n - 1) for n in shape)
    samples = positions[np.ix_(rows, columns)]
    low = np.floor(np.nanmin(samples, axis=(0, 1))).astype(int) - _SUPPORT_PX - 1
    high = np.ceil(np.nanmax(samples, axis=(0, 1))).astype(int) + _SUPPORT_PX + 2
    x0, y0 = np.maximum(low, 0)
    x1, y1 = np.minimum(high, band.size_px)
    if x1 - x0 < 1 or y1 - y0 < 1:
        dtype = np.dtype(band.dtype if radiometry is None else np.float32)
        return np.zeros(shape, dtype), np.zeros(shape, dtype=bool)
    pixels, valid = read_window(dataset, band, int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    if radiometry is not None:
        pixels = calibrated(pixels, radiometry, int(x0), int(y0))
    positions -= (x0, y0)
    resampled, resampled_valid = resample(
        pixels, valid, positions, (band.width_px - x0, band.height_px - y0), (-x0, -y0), interpolation
    )
    return resampled, resampled_valid & ~mapping.hidden(tile)


def resample(
    pixels: NDArray[np.generic],
    valid: Mask,
    positions: Points,
    sensor_end: tuple[int, int],
    sensor_start: tuple[int, int],
    interpolation: Interpolation,
) -> tuple[NDArray[np.generic], Mask]:
    """Resample pixels (h, w) of a window of an image at positions (H, W, 2) in px of the window.

    `sensor_start` (x, y) is the position of the image's first pixel in the window, `sensor_end` one past its last
    pixel. Returns (H, W) pixels of the same type, with integers rounded and clipped, and their mask.
    """
    map_xy = positions.astype(np.float32, copy=False)
    all_valid = bool(valid.all())
    source = _for_remap(pixels if all_valid else _filled(pixels, valid), interpolation)
    sampled = cv2.remap(source, map_xy, None, _INTERPOLATION_FLAGS[interpolation], borderMode=cv2.BORDER_REPLICATE)
    half = 0.5 if interpolation == "nearest" else 0.0
    inside = _between(map_xy, np.subtract(sensor_start, half), np.subtract(sensor_end, 1 - half))
    if not all_valid:
        flag = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
        weight = cv2.remap(valid.astype(np.float32), map_xy, None, flag, borderMode=cv2.BORDER_REPLICATE)
        inside &= weight > _MIN_VALID_WEIGHT
    return _as_type(sampled, pixels.dtype), np.asarray(inside)


def _between(positions: NDArray[np.floating], minimum: Points, maximum: Points) -> Mask:
    """Return (H, W) True where positions (H, W, 2) are inside or on the border of a rectangle."""
    return np.asarray(cv2.inRange(positions, tuple(map(float, minimum)), tuple(map(float, maximum))) != 0)


def _for_remap(pixels: NDArray[np.generic], interpolation: Interpolation) -> NDArray[np.generic]:
    """Convert to a type that cv2.remap supports and in which it neither rounds nor clips."""
    if interpolation == "nearest" and pixels.dtype in (np.uint8, np.uint16, np.int16, np.float32, np.float64):
        return pixels
    wide = pixels.dtype in (np.float64, np.int32, np.uint32, np.int64, np.uint64)
    return pixels.astype(np.float64 if wide else np.float32)


def _filled(pixels: NDArray[np.generic], valid: Mask) -> NDArray[np.generic]:
    """Replace invalid pixels by the mean of their surroundings, which prevents ringing of wide kernels at nodata."""
    known = valid.astype(np.float32)
    values = np.where(valid, pixels, 0).astype(np.float32)
    kernel = 2 * _SUPPORT_PX + 1, 2 * _SUPPORT_PX + 1
    mean = cv2.blur(values, kernel) / np.maximum(cv2.blur(known, kernel), 1e-6)
    return np.where(valid, pixels, mean.astype(pixels.dtype))


def _as_type(values: NDArray[np.generic], dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    if values.dtype == dtype or dtype.kind == "f":
        return values.astype(dtype, copy=False)
    if dtype.kind == "b":
        return np.asarray(values >= np.float32(0.5))
    limits = np.iinfo(str(dtype))
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max).astype(dtype))


# ---- for estimation


def warped(
    moving: Raster, mapping: PixelMapping, size_px: tuple[int, int], fixed_scale: PixelScale = SAME_PIXELS
) -> Raster:
    """Warp the moving raster to the fixed grid reduced by `fixed_scale` to `size_px` (width, height).

    The moving raster is reduced first to avoid aliasing. `mapping` is between raw pixels at full size.
    """
    is_identity = not mapping.is_curved and np.array_equal(mapping.fixed_to_moving, np.eye(3))
    if is_identity and size_px == moving.size_px and fixed_scale == SAME_PIXELS:
        return moving
    full_size_px = round(size_px[0] / fixed_scale[0]), round(size_px[1] / fixed_scale[1])
    magnification = float(np.median(np.abs(geometry.local_scale(mapping.fixed_to_moving, *full_size_px))))
    ratio = float(np.clip(fixed_scale[0] / magnification, _MIN_SIDE_PX / min(moving.size_px), 1.0))
    width, height = (max(_MIN_SIDE_PX, round(side * ratio)) for side in moving.size_px)
    small = shrink(moving, (width, height))
    moving_scale = PixelScale.between(moving.size_px, small.size_px)
    rescaled, area = mapping.rescaled(fixed_scale, moving_scale), Tile(0, 0, *size_px)
    positions = rescaled.positions(area, np.float32)
    cv2.patchNaNs(positions, _OUTSIDE_PX)
    pixels = cv2.remap(small.pixels, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    valid = _between(positions, np.zeros(2), np.subtract(small.size_px, 1))
    if rescaled.parallax is not None:
        valid &= ~rescaled.hidden(area)
    if not small.valid.all():
        weight = small.valid.astype(np.uint8) * 255
        valid &= cv2.remap(weight, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) == 255
    return Raster(np.asarray(pixels, np.float32), np.asarray(valid))


def textured(raster: Raster, min_share: float = 0.02) -> bool:
    """Return True if more than `min_share` of the pixels are valid and not all of them are equal."""
    if np.count_nonzero(raster.valid) <= min_share * raster.valid.size:
        return False
    planes = raster.pixels if raster.pixels.ndim == 3 else raster.pixels[None]
    mask = raster.valid.astype(np.uint8)
    return any(float(cv2.meanStdDev(plane, mask=mask)[1].item()) > 0 for plane in planes)


def shrink(raster: Raster, size_px: tuple[int, int]) -> Raster:
    """Reduce a raster to `size_px` (width, height) by averaging; pixels are valid if all their source pixels are."""
    if size_px == raster.size_px:
        return raster
    planes = raster.pixels if raster.pixels.ndim == 3 else raster.pixels[None]
    if raster.valid.all():
        shrunk = np.stack([cv2.resize(plane, size_px, interpolation=cv2.INTER_AREA) for plane in planes])
        valid: Mask = np.ones(shrunk.shape[1:], bool)
    else:
        weight = cv2.resize(raster.valid.astype(np.float32), size_px, interpolation=cv2.INTER_AREA)
        weighted = [np.where(raster.valid, plane, 0) for plane in planes]
        shrunk = np.stack([cv2.resize(plane, size_px, interpolation=cv2.INTER_AREA) for plane in weighted])
        shrunk = (shrunk / np.maximum(weight, 1e-6)).astype(np.float32)
        valid = weight > _MIN_VALID_WEIGHT
    scale = PixelScale.between(raster.size_px, size_px)
    return Raster(shrunk if raster.pixels.ndim == 3 else shrunk[0], valid, lens.rescaled(raster.lens, scale))
