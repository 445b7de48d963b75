"""One resampling of a moving band onto the reference grid, tile by tile.

A reference pixel goes through the reference's lens model, the homography and the moving camera's lens model:
raw reference px -> undistorted -> H -> undistorted -> raw moving px. Nothing is interpolated twice.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.choices import Interpolation
from agalign.geometry import Points
from agalign.mapping import Mapping
from agalign.radiometry import calibrated
from agalign.raster import open_raster, read_window
from agalign.records import Band, Mask, Radiometry, Tile

_FLAGS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "bilinear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_SUPPORT_PX = 4
"""Half width of the widest interpolation kernel."""
_SAMPLE_PX = 16


def tiles(area: Tile, side_px: int) -> Iterator[Tile]:
    """The tiles of an area, row by row, those at the right and bottom cut to fit."""
    for y in range(area.y0, area.y0 + area.height, side_px):
        for x in range(area.x0, area.x0 + area.width, side_px):
            width = min(side_px, area.x0 + area.width - x)
            height = min(side_px, area.y0 + area.height - y)
            yield Tile(x, y, width, height)


def resample_tile(
    band: Band, mapping: Mapping, tile: Tile, interpolation: Interpolation, radiometry: Radiometry | None = None
) -> tuple[NDArray[np.generic], Mask]:
    """The moving band on a tile of the reference grid, in its own type (integers rounded and clipped) or, calibrated
    with `radiometry`, as float32, and its mask.

    A pixel is valid where it lies inside the moving image and no invalid pixel has a part in it.
    """
    positions = mapping.positions(tile)
    shape = tile.height, tile.width
    # The mapping is smooth: a coarse sample of it, edges included, tells its extent to a pixel.
    rows, columns = (np.append(np.arange(0, n, _SAMPLE_PX), n - 1) for n in shape)
    some = positions[np.ix_(rows, columns)]
    low = np.floor(np.nanmin(some, axis=(0, 1))).astype(int) - _SUPPORT_PX - 1
    high = np.ceil(np.nanmax(some, axis=(0, 1))).astype(int) + _SUPPORT_PX + 2
    x0, y0 = np.maximum(low, 0)
    x1, y1 = np.minimum(high, band.size_px)
    if x1 - x0 < 1 or y1 - y0 < 1:
        return np.zeros(shape, dtype=band.dtype), np.zeros(shape, dtype=bool)
    with open_raster(band.path) as dataset:
        pixels, valid = read_window(dataset, band, int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    if radiometry is not None:
        pixels = calibrated(pixels, radiometry, int(x0), int(y0))
    return resample(
        pixels, valid, positions - (x0, y0), (band.width_px - x0, band.height_px - y0), (-x0, -y0), interpolation
    )


def resample(
    pixels: NDArray[np.generic],
    valid: Mask,
    positions: Points,
    sensor_end: tuple[int, int],
    sensor_start: tuple[int, int],
    interpolation: Interpolation,
) -> tuple[NDArray[np.generic], Mask]:
    """Pixels (h, w) of a window at positions (H, W, 2) in px of that window.

    `sensor_start` and `sensor_end` (x, y) say where the whole image begins and ends in the window's px.
    """
    map_xy = positions.astype(np.float32)
    everything = bool(valid.all())
    source = _for_remap(pixels if everything else _filled(pixels, valid), interpolation)
    sampled = cv2.remap(source, map_xy, None, _FLAGS[interpolation], borderMode=cv2.BORDER_REPLICATE)
    half = 0.5 if interpolation == "nearest" else 0.0
    inside = np.ones(positions.shape[:2], dtype=bool)
    for along, start, end in zip((positions[..., 0], positions[..., 1]), sensor_start, sensor_end, strict=True):
        inside &= (along >= start - half) & (along <= end - 1 + half)
    if not everything:
        flag = cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR
        weight = cv2.remap(valid.astype(np.float32), map_xy, None, flag, borderMode=cv2.BORDER_REPLICATE)
        inside &= weight > 0.999
    return _as_type(sampled, pixels.dtype), np.asarray(inside)


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
    limits = np.iinfo(str(dtype))
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max).astype(dtype))


def common_area(mappings: list[tuple[Mapping, Band]], width_px: int, height_px: int) -> Tile | None:
    """The largest rectangle of the reference grid that lies inside every moving image; None where there is none."""
    step = max(1, min(8, width_px // 64, height_px // 64))
    x = _cell_edges(width_px, step)
    y = _cell_edges(height_px, step)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    inside = np.ones(points.shape[:2], dtype=bool)
    for mapping, band in mappings:
        there = mapping(points)
        with np.errstate(invalid="ignore"):
            inside &= (there >= 0).all(axis=-1) & (there <= np.subtract(band.size_px, 1)).all(axis=-1)
    # A cell counts where its four corners do: between them the mapping is all but straight.
    cells = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    found = _largest_rectangle(cells, np.diff(x), np.diff(y))
    if found is None:
        return None
    top, bottom, left, right = found
    x0, y0 = int(x[left]), int(y[top])
    return Tile(x0, y0, int(x[right]) - x0 + 1, int(y[bottom]) - y0 + 1)


def _cell_edges(length_px: int, step: int) -> NDArray[np.int64]:
    return np.append(np.arange(0, length_px - 1, step), length_px - 1)


def _largest_rectangle(
    cells: Mask, widths: NDArray[np.int64], heights: NDArray[np.int64]
) -> tuple[int, int, int, int] | None:
    """(top, bottom, left, right) in cell edges of the all-True rectangle of the largest area: a histogram with a
    stack, row by row.
    """
    best_area, best = 0, None
    left_edge = np.concatenate([[0], np.cumsum(widths)])
    tall = np.zeros(cells.shape[1], dtype=np.int64)
    first_row = np.zeros(cells.shape[1], dtype=np.int64)
    for row in range(cells.shape[0]):
        first_row = np.where(cells[row] & (tall > 0), first_row, row)
        tall = np.where(cells[row], tall + heights[row], 0)
        stack: list[tuple[int, int, int]] = []
        for column, (height, top) in enumerate([*zip(tall.tolist(), first_row.tolist(), strict=True), (0, row)]):
            start = column
            while stack and stack[-1][1] >= height:
                start, stacked, stacked_top = stack.pop()
                area = stacked * int(left_edge[column] - left_edge[start])
                if area > best_area:
                    best_area, best = area, (stacked_top, row + 1, start, column)
            stack.append((start, height, top))
    return best
