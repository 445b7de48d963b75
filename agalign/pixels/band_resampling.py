"""Resampling of a moving band onto the reference grid, tile by tile, and of reduced images for the estimation.

A reference pixel is mapped by the reference's lens model, the homography and the moving camera's lens model:
raw reference px -> undistorted -> H -> undistorted -> raw moving px. Output pixels are interpolated once.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import ReadTile, read_tile
from agalign.values import geometry, lens
from agalign.values.capture import Band
from agalign.values.choices import Interpolation
from agalign.values.image import FloatImage, Mask, Raster, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size
from agalign.values.radiometry import Radiometry
from agalign.values.resampling import MIN_VALID_WEIGHT, between, resample, source_positions

_MIN_SIDE_PX = 8
"""A moving image is not reduced below this, whatever the scale of the homography."""


def resample_tile(
    band: Band,
    mapping: PixelMapping,
    tile: Tile,
    interpolation: Interpolation,
    radiometry: Radiometry | None = None,
    *,
    size_px: Size | None = None,
    read: ReadTile = read_tile,
) -> tuple[NDArray[np.generic], Mask]:
    """Resample the moving band to a tile of the reference grid; return pixels and mask, each (height, width).

    `size_px` is (width, height) of that grid, with which a pixel has the same value in any tile.

    The type is that of the band, with integers rounded and clipped, or float32 if calibrated with `radiometry`. A pixel
    is valid if its position is inside the moving image and not occluded, and the pixels next to the position are valid.
    `read` reads the pixels of the file. Raises UnreadableFileError.
    """
    positions, source = source_positions(mapping, tile, size_px, band.size_px)
    if source is None:
        shape = tile.height, tile.width
        return np.zeros(shape, band.dtype if radiometry is None else np.float32), np.zeros(shape, dtype=bool)
    pixels, valid = read(band, source)
    if radiometry is not None:
        pixels = calibrated(pixels, radiometry, source.x0, source.y0)
    resampled, resampled_valid = resample(pixels, valid, positions, source, band.size_px, interpolation)
    return resampled, resampled_valid & ~mapping.hidden(tile)


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
    if np.isnan(positions).any():
        positions = np.nan_to_num(positions, nan=-1e6)  # on the horizon of the homography: outside of every image
    pixels = cv2.remap(small.pixels, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    valid = between(positions, np.zeros(2), np.subtract(small.size_px, 1))
    if rescaled.parallax is not None:
        valid &= ~rescaled.hidden(area)
    if not small.valid.all():
        weight = small.valid.astype(np.uint8) * 255
        valid &= cv2.remap(weight, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) == 255
    return Raster(np.asarray(pixels, np.float32), np.asarray(valid))


MIN_VALID_SHARE = 0.02
"""Of the pixels of an image that can be aligned: windows need areas that are valid."""


def textured(raster: Raster) -> bool:
    """Return True if more than MIN_VALID_SHARE of the pixels are valid and not all of them are equal."""
    if np.count_nonzero(raster.valid) <= MIN_VALID_SHARE * raster.valid.size:
        return False
    mask = raster.valid.astype(np.uint8)
    return any(float(cv2.meanStdDev(plane, mask=mask)[1].item()) > 0 for plane in raster.planes)


def shrink(raster: Raster, size_px: tuple[int, int]) -> Raster:
    """Reduce a raster to `size_px` (width, height) by averaging; pixels are valid if all their source pixels are."""
    if size_px == raster.size_px:
        return raster
    complete = bool(raster.valid.all())
    planes = raster.planes if complete else np.where(raster.valid, raster.planes, np.float32(0))
    shrunk = np.stack([cv2.resize(plane, size_px, interpolation=cv2.INTER_AREA) for plane in planes])
    valid: Mask = np.ones(shrunk.shape[1:], bool)
    if not complete:
        weight = cv2.resize(raster.valid.astype(np.float32), size_px, interpolation=cv2.INTER_AREA)
        shrunk = (shrunk / np.maximum(weight, 1e-6)).astype(np.float32)
        valid = weight > MIN_VALID_WEIGHT
    scale = PixelScale.between(raster.size_px, size_px)
    return Raster(shrunk if raster.pixels.ndim == 3 else shrunk[0], valid, lens.rescaled(raster.lens, scale))


def channel_mean(raster: Raster) -> Raster:
    """Return the mean of all channels, (H, W) or (C, H, W) -> (H, W)."""
    if raster.pixels.ndim == 2:
        return raster
    return Raster(np.asarray(raster.pixels.mean(axis=0), np.float32), raster.valid, raster.lens)


def luma(image: FloatImage) -> FloatImage:
    """Return the luma (H, W), as in OpenCV and Pillow, of an RGB image (3, H, W), or the mean of any other number of
    channels (C, H, W).
    """
    if image.ndim == 2:
        return image
    if len(image) != 3:
        return np.asarray(image.mean(axis=0), np.float32)
    bt_601 = np.array([0.299, 0.587, 0.114], np.float32)
    return np.tensordot(bt_601, image, axes=1)


def eight_bit(image: FloatImage, valid: Mask) -> NDArray[np.uint8]:
    """Stretch an image (H, W) to 0 to 255 between the 1st and 99th percentile of the valid pixels."""
    low, high = np.percentile(image[valid], (1, 99)) if valid.any() else (0.0, 1.0)
    return np.asarray((np.clip((image - low) / max(high - low, 1e-9), 0, 1) * 255).round().astype(np.uint8))
