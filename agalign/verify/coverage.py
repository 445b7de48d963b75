"""Parts of an image that a moving image covers, and that the windows of a residual observe."""

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.image import Mask, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.pixel_units import Size
from agalign.values.resampling import between_nodes, nodes_along
from agalign.values.residual import Residual

_LATTICE = 24, 18
"""Columns and rows of the points of an image at which its coverage and the lens distortion are evaluated."""


def points_in_frame(mapping: PixelMapping, size_px: Size, moving_size_px: Size) -> Points:
    """Return the points (n, 2) of a grid over the reference that are mapped into the moving image.

    Sizes are (width, height).
    """
    points_px = _cells(size_px, *_LATTICE)
    return points_px[_to_border_px(mapping(points_px), moving_size_px) >= 0]


def points_in_mask(valid: Mask) -> Points:
    """Return the points (n, 2) of a grid over an image at which a mask (height, width) is True."""
    points_px = _cells((valid.shape[1], valid.shape[0]), *_LATTICE)
    column, row = np.rint(points_px).astype(np.int64).T
    return np.asarray(points_px[valid[row, column]])


def pixels_in_frame(mapping: PixelMapping, size_px: Size, moving_size_px: Size) -> Mask:
    """Return the mask (height, width) of the pixels of the reference that are mapped into the moving image.

    The distance from its border is interpolated between nodes.
    """
    columns, rows = (nodes_along(n) for n in size_px)
    distance_px = _to_border_px(mapping(geometry.lattice(*size_px, columns, rows)), moving_size_px)
    nodes = distance_px.reshape(rows, columns).astype(np.float32)
    return between_nodes(nodes, size_px, Tile(0, 0, *size_px)) >= 0


def _to_border_px(moving_px: Points, size_px: Size) -> NDArray[np.float64]:
    """Return the distance (n,) of points (n, 2) from the border of an image (width, height), negative outside."""
    return np.asarray(np.minimum(moving_px + 0.5, np.subtract(size_px, 0.5) - moving_px).min(axis=1))


def unobserved_quarters(centres_px: Points, size_px: tuple[int, int], in_frame_px: Points | None = None) -> list[str]:
    """Return the quarters of an image (width, height) with fewer than two of the centres (n, 2).

    `in_frame_px` are the points of the image that the moving image covers, all of them by default.
    """
    lattice = _cells(size_px, *_LATTICE)
    covered = lattice if in_frame_px is None else in_frame_px
    # Names, and signs of x and y relative to the centre.
    quarters = (("top left", -1, -1), ("top right", 1, -1), ("bottom right", 1, 1), ("bottom left", -1, 1))

    def count(points_px: Points, *signs: int) -> int:
        size = np.array(size_px, dtype=np.float64)
        from_centre = (points_px - (size - 1) / 2) / size * signs
        # With windows nearer to the image's axes only, most of a quarter would still be extrapolated.
        min_share_of_side = 1 / 8
        return int((from_centre > min_share_of_side).all(axis=1).sum())

    min_share_in_frame = 0.5  # of a quarter's points; others are not checked
    min_windows = 2  # a single one may be a wrong peak
    return [
        name
        for name, *signs in quarters
        if count(covered, *signs) >= min_share_in_frame * count(lattice, *signs)
        and count(centres_px, *signs) < min_windows
    ]


def unmodelled_std_px(residual: Residual, size_px: tuple[int, int], lens_std_px: NDArray[np.float64]) -> float:
    """Return the RMS lens distortion, px, that a homography fitted to the windows of a residual does not model.

    It is averaged over the whole image (width, height). `lens_std_px` (4,) are the standard deviations of the lens
    shapes, which the windows limit.
    """
    error = MappingError(size_px, np.zeros((8, 8)), residual, lens_std_px=lens_std_px)
    return error.distortion_px(_cells(size_px, *_LATTICE))


def _cells(size_px: tuple[int, int], columns: int, rows: int) -> Points:
    """Return the centres (n, 2) of equal cells of an image (width, height), row by row: their mean is that over it."""
    x, y = (
        (np.arange(count) + 0.5) * length / count - 0.5 for length, count in zip(size_px, (columns, rows), strict=True)
    )
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
