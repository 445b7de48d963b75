"""Resampling: of a moving band onto the reference's grid, tile by tile, and of reduced images for the estimation.

A reference pixel is mapped by the reference's lens model, the homography and the moving camera's lens model:
raw reference px -> undistorted -> H -> undistorted -> raw moving px. Pixels that are written are interpolated once.
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

_FLAGS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_SUPPORT_PX = 4
"""Half width of the widest interpolation kernel."""
_SAMPLE_PX = 16
"""Spacing of the positions that the extent of a tile is taken from."""
_MIN_WHOLE_WEIGHT = 0.999
"""Share of valid pixels in a resampled pixel that is valid: float32 weights do not add up to exactly 1."""
_MIN_SIDE_PX = 8
"""A moving image is not reduced below this side, whatever the homography's scale."""
_NOWHERE = -1e6
"""Position, px, of points on the horizon of a homography: outside any image."""


def tiles(area: Tile, side_px: int) -> Iterator[Tile]:
    """The tiles of an area, row by row, those at the right and bottom cut to fit."""
    for y in range(area.y0, area.y0 + area.height, side_px):
        for x in range(area.x0, area.x0 + area.width, side_px):
            width = min(side_px, area.x0 + area.width - x)
            height = min(side_px, area.y0 + area.height - y)
            yield Tile(x, y, width, height)


def resample_tile(
    band: Band, mapping: PixelMapping, tile: Tile, interpolation: Interpolation, radiometry: Radiometry | None = None
) -> tuple[NDArray[np.generic], Mask]:
    """The moving band on a tile of the reference grid, (height, width), and its mask. The type is the band's own,
    integers rounded and clipped; calibrated with `radiometry` it is float32.

    A pixel is valid where it is inside the moving image, not occluded there, and no invalid pixel contributes to it.
    Raises UnreadableFileError.
    """
    with open_raster(band.path) as dataset:
        return resample_tile_of(dataset, band, mapping, tile, interpolation, radiometry)


def resample_tile_of(
    dataset: OpenRaster, band: Band, mapping: PixelMapping, tile: Tile, interpolation: Interpolation,
    radiometry: Radiometry | None = None,
) -> tuple[NDArray[np.generic], Mask]:  # fmt: skip
    """`resample_tile` of a file that is open: what GDAL has decoded for one tile serves the next."""
    positions = mapping.positions(tile, np.float32)
    shape = tile.height, tile.width
    # Without parallax the mapping is smooth: a coarse sample of it, edges included, gives its extent to a pixel.
    step = _SAMPLE_PX if mapping.parallax is None else 1
    rows, columns = (np.append(np.arange(0, n, step), n - 1) for n in shape)
    some = positions[np.ix_(rows, columns)]
    low = np.floor(np.nanmin(some, axis=(0, 1))).astype(int) - _SUPPORT_PX - 1
    high = np.ceil(np.nanmax(some, axis=(0, 1))).astype(int) + _SUPPORT_PX + 2
    x0, y0 = np.maximum(low, 0)
    x1, y1 = np.minimum(high, band.size_px)
    if x1 - x0 < 1 or y1 - y0 < 1:
        dtype = np.dtype(band.dtype if radiometry is None else np.float32)
        return np.zeros(shape, dtype), np.zeros(shape, dtype=bool)
    pixels, valid = read_window(dataset, band, int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    if radiometry is not None:
        pixels = calibrated(pixels, radiometry, int(x0), int(y0))
    positions -= (x0, y0)
    resampled, whole = resample(
        pixels, valid, positions, (band.width_px - x0, band.height_px - y0), (-x0, -y0), interpolation
    )
    return resampled, whole & ~mapping.hidden(tile)


def resample(
    pixels: NDArray[np.generic],
    valid: Mask,
    positions: Points,
    sensor_end: tuple[int, int],
    sensor_start: tuple[int, int],
    interpolation: Interpolation,
) -> tuple[NDArray[np.generic], Mask]:
    """Pixels (h, w) of a window at positions (H, W, 2) in px of that window.

    `sensor_start` (x, y) is the whole image's first pixel in the window's px, `sensor_end` one past its last pixel.
    Returns (H, W) of the pixels' type, integers rounded and clipped, and the mask of valid pixels.
    """
    map_xy = positions.astype(np.float32, copy=False)
    everything = bool(valid.all())
    source = _for_remap(pixels if everything else _filled(pixels, valid), interpolation)
    sampled = cv2.remap(source, map_xy, None, _FLAGS[interpolation], borderMode=cv2.BORDER_REPLICATE)
    half = 0.5 if interpolation == "nearest" else 0.0
    inside = _between(map_xy, np.subtract(sensor_start, half), np.subtract(sensor_end, 1 - half))
    if not everything:
        flag = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
        weight = cv2.remap(valid.astype(np.float32), map_xy, None, flag, borderMode=cv2.BORDER_REPLICATE)
        inside &= weight > _MIN_WHOLE_WEIGHT
    return _as_type(sampled, pixels.dtype), np.asarray(inside)


def _between(positions: NDArray[np.floating], minimum: Points, maximum: Points) -> Mask:
    """(H, W) True where positions (H, W, 2) are within a rectangle, its border included."""
    return np.asarray(cv2.inRange(positions, tuple(map(float, minimum)), tuple(map(float, maximum))) != 0)


def _for_remap(pixels: NDArray[np.generic], interpolation: Interpolation) -> NDArray[np.generic]:
    """A type that remap takes and in which it neither rounds nor clips."""
    if interpolation == "nearest" and pixels.dtype in (np.uint8, np.uint16, np.int16, np.float32, np.float64):
        return pixels
    wide = pixels.dtype in (np.float64, np.int32, np.uint32, np.int64, np.uint64)
    return pixels.astype(np.float64 if wide else np.float32)


def _filled(pixels: NDArray[np.generic], valid: Mask) -> NDArray[np.generic]:
    """Invalid pixels replaced by their surroundings' mean, so that wide kernels do not ring against nodata."""
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
    """The moving raster resampled onto the fixed grid reduced by `fixed_scale` to `size_px`, without aliasing.

    `mapping` is between the raw pixels of the two images at their full size.
    """
    unmoved = not mapping.is_curved and np.array_equal(mapping.fixed_to_moving, np.eye(3))
    if unmoved and size_px == moving.size_px and fixed_scale == SAME_PIXELS:
        return moving
    full = round(size_px[0] / fixed_scale[0]), round(size_px[1] / fixed_scale[1])
    magnification = float(np.median(np.abs(geometry.local_scale(mapping.fixed_to_moving, *full))))
    reduce = float(np.clip(fixed_scale[0] / magnification, _MIN_SIDE_PX / min(moving.size_px), 1.0))
    width, height = (max(_MIN_SIDE_PX, round(side * reduce)) for side in moving.size_px)
    small = shrink(moving, (width, height))
    moving_scale = PixelScale.between(moving.size_px, small.size_px)
    rescaled, whole = mapping.rescaled(fixed_scale, moving_scale), Tile(0, 0, *size_px)
    positions = rescaled.positions(whole, np.float32)
    cv2.patchNaNs(positions, _NOWHERE)
    pixels = cv2.remap(small.pixels, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    valid = _between(positions, np.zeros(2), np.subtract(small.size_px, 1))
    if rescaled.parallax is not None:
        valid &= ~rescaled.hidden(whole)
    if not small.valid.all():
        known = small.valid.astype(np.uint8) * 255
        valid &= cv2.remap(known, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) == 255
    return Raster(np.asarray(pixels, np.float32), np.asarray(valid))


def textured(raster: Raster, min_share: float = 0.02) -> bool:
    """False where the valid pixels are constant, or at most `min_share` of the image."""
    if np.count_nonzero(raster.valid) <= min_share * raster.valid.size:
        return False
    planes = raster.pixels if raster.pixels.ndim == 3 else raster.pixels[None]
    mask = raster.valid.astype(np.uint8)
    return any(float(cv2.meanStdDev(plane, mask=mask)[1].item()) > 0 for plane in planes)


def shrink(raster: Raster, size_px: tuple[int, int]) -> Raster:
    """Area-averaged copy of `size_px` (width, height); a pixel is valid where all of its source pixels are."""
    if size_px == raster.size_px:
        return raster
    planes = raster.pixels if raster.pixels.ndim == 3 else raster.pixels[None]
    if raster.valid.all():
        shrunk = np.stack([cv2.resize(plane, size_px, interpolation=cv2.INTER_AREA) for plane in planes])
        valid: Mask = np.ones(shrunk.shape[1:], bool)
    else:
        weight = cv2.resize(raster.valid.astype(np.float32), size_px, interpolation=cv2.INTER_AREA)
        known = [np.where(raster.valid, plane, 0) for plane in planes]
        shrunk = np.stack([cv2.resize(plane, size_px, interpolation=cv2.INTER_AREA) for plane in known])
        shrunk = (shrunk / np.maximum(weight, 1e-6)).astype(np.float32)
        valid = weight > _MIN_WHOLE_WEIGHT
    scale = PixelScale.between(raster.size_px, size_px)
    return Raster(shrunk if raster.pixels.ndim == 3 else shrunk[0], valid, lens.rescaled(raster.lens, scale))
