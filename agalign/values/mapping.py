"""The complete mapping between the raw pixels of two images, and its fast evaluation on a grid."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from pydantic import Field
from pydantic import dataclasses as validated
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates, spline_filter

from agalign.host.held_sizes import MAX_HELD_POSITIONS_PX
from agalign.values import geometry, lens
from agalign.values.fields import POSITION_DECIMALS, RECORD, Array, Positive
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Mask, Tile
from agalign.values.lens import Lens
from agalign.values.parallax import Parallax
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size

_BLOCK_PX = 256
"""Side of the blocks of the reference in which positions are interpolated."""
_KNOT_STEP_PX = 32
"""Distance of the knots of interpolated curved mappings: the error with real lenses is below 0.0001 px."""
_CELL_PX = 32.0
"""Range of parallax over which a parabola replaces the mapping, to 0.001 px; the first range is around 0, so that it
contains most scenes."""


_PADDED_NODES = 12
"""Copies of the nodes at the edge beyond it, for its splines: their influence decreases by a factor of 3.7 per node."""


@validated.dataclass(frozen=True, config=RECORD)
class DisplacementField:
    """Smooth displacements of raw pixels of the reference, added before its lens and the homography: values on a
    lattice.
    """

    step_px: Positive
    """Distance of the nodes, px."""
    displacements_px: Annotated[NDArray[np.float64], Array((None, None, 2), POSITION_DECIMALS)]
    """(x, y) by row and column, px; the first node is the centre of the top-left pixel, with cubic splines between
    nodes."""
    scale: Annotated[PixelScale, Field(exclude=True)] = SAME_PIXELS
    """Size of that image relative to the one on which the field is evaluated."""

    @classmethod
    def sampled(
        cls, function: Callable[[NDArray[np.float64]], NDArray[np.float64]], step_px: float, size_px: tuple[int, int]
    ) -> "DisplacementField":
        """Sample a function from points (n, 2) to displacements (n, 2) on a lattice over an image (width, height)."""
        columns, rows = (math.ceil(n / step_px) + 1 for n in size_px)
        nodes = geometry.lattice(columns, rows, columns, rows) * step_px
        return cls(float(step_px), function(nodes).reshape(rows, columns, 2))

    def __call__(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """The displacement (..., 2) at points (..., 2), by cubic splines; outside the lattice that of its edge."""
        points = np.asarray(points_px)
        on_lattice = points if self.scale == SAME_PIXELS else self.scale.positions(points)
        at = on_lattice.reshape(-1, 2)[:, ::-1].T / self.step_px + _PADDED_NODES
        values = [map_coordinates(c, at, order=3, mode="nearest", prefilter=False) for c in self._coefficients]
        return self.scale.inverse.displacements(np.stack(values, axis=-1).reshape(points.shape))

    @cached_property
    def _coefficients(self) -> list[NDArray[np.float64]]:
        """Coefficients of the splines along x and y, padded: they are calculated once for all blocks of an image."""
        planes = (np.pad(plane, _PADDED_NODES, mode="edge") for plane in np.moveaxis(self.displacements_px, -1, 0))
        return [spline_filter(plane, order=3, mode="nearest") for plane in planes]

    def rescaled(self, scale: PixelScale) -> "DisplacementField":
        """The same on an image that is resized by `scale`."""
        return replace(self, scale=self.scale.over(scale))

    def plus(self, other: "DisplacementField") -> "DisplacementField":
        """Return the sum of two fields on one lattice."""
        return replace(self, displacements_px=self.displacements_px + other.displacements_px)

    def on_lattice(self, step_px: float, size_px: tuple[int, int]) -> "DisplacementField":
        """The same by its values on another lattice, which covers an image (width, height).

        They have the decimals of a sidecar, so that a reader of it has the same field.
        """
        return DisplacementField.sampled(lambda points: self(points).round(POSITION_DECIMALS), step_px, size_px)


@dataclass(frozen=True)
class PixelMapping:
    """raw reference px -> undistorted (-> moved by parallax) -> homography -> undistorted -> raw moving px."""

    fixed_to_moving: Matrix
    fixed_lens: Lens | None = None
    moving_lens: Lens | None = None
    pre_distortion: Lens | None = None
    """Lens that distorts the given positions first, if these are undistorted px of the reference."""
    field: DisplacementField | None = None
    """Displacements of raw reference px, applied first."""
    parallax: Parallax | None = None
    """Displacements of undistorted reference px, by the parallax at the raw ones."""
    held: Points | None = dataclasses.field(default=None, init=False, repr=False, compare=False)
    """Positions of all pixels, once they are computed (`hold_positions`); a changed mapping does not have them."""

    def __call__(self, reference_px: ArrayLike) -> Points:
        """(..., 2) raw reference pixels to raw moving pixels."""
        return lens.distort(self.moving_lens, geometry.apply(self.fixed_to_moving, self.undistorted(reference_px)))

    def at_parallax(self, reference_px: ArrayLike, baseline: tuple[float, float], parallax_px: float) -> Points:
        """The same, (..., 2), with one parallax and baseline for all pixels, instead of those of the mapping."""
        moved = self.without_parallax.undistorted(reference_px) + np.array(baseline) * parallax_px
        return lens.distort(self.moving_lens, geometry.apply(self.fixed_to_moving, moved))

    def undistorted(self, reference_px: ArrayLike) -> Points:
        """(..., 2) raw reference pixels to those that the homography maps: displaced, undistorted, with parallax."""
        raw = lens.distort(self.pre_distortion, reference_px)
        displaced = raw if self.field is None else raw + self.field(raw)
        undistorted = lens.undistort(self.fixed_lens, displaced)
        return undistorted if self.parallax is None else undistorted + self.parallax.displacements(raw)

    def inverse(self, moving_px: ArrayLike) -> Points:
        """(..., 2) raw moving pixels to raw reference pixels, NaN where the iteration does not converge.

        The displacements of field and relief are subtracted in turn until the positions no longer change: a fixed-point
        iteration, which converges where displacements change by less than 1 px per px.
        """
        tolerance_px, max_iterations = 1e-3, 50
        undistorted = geometry.apply(geometry.invert(self.fixed_to_moving), lens.undistort(self.moving_lens, moving_px))
        result = raw = lens.distort(self.fixed_lens, undistorted)
        for _ in range(max_iterations):
            of_plane = undistorted if self.parallax is None else undistorted - self.parallax.displacements(raw)
            displaced = lens.distort(self.fixed_lens, of_plane)
            result = displaced if self.field is None else displaced - self.field(raw)
            change_px, raw = np.abs(result - raw).max(axis=-1, keepdims=True), result
            if not (change_px > tolerance_px).any():
                break
        else:
            result = np.where(change_px > tolerance_px, np.nan, result)
        return lens.undistort(self.pre_distortion, result)

    def with_parallax(self, parallax: Parallax | None) -> "PixelMapping":
        """The mapping with another parallax."""
        return replace(self, parallax=parallax)

    @property
    def without_parallax(self) -> "PixelMapping":
        """The mapping without parallax."""
        return self if self.parallax is None else self.with_parallax(None)

    def from_undistorted(self, reference_lens: Lens) -> "PixelMapping":
        """The mapping for undistorted pixels of the reference instead of its raw ones."""
        if self.fixed_lens is not None and self.field is None and self.parallax is None:
            return replace(self, fixed_lens=None)
        return replace(self, pre_distortion=reference_lens)

    def rescaled(self, fixed_scale: PixelScale, moving_scale: PixelScale) -> "PixelMapping":
        """The same mapping between images that are resized by `fixed_scale` and `moving_scale`."""
        if fixed_scale == moving_scale == SAME_PIXELS:
            return self
        return PixelMapping(
            geometry.rescale(self.fixed_to_moving, fixed_scale, moving_scale),
            lens.rescaled(self.fixed_lens, fixed_scale),
            lens.rescaled(self.moving_lens, moving_scale),
            lens.rescaled(self.pre_distortion, fixed_scale),
            None if self.field is None else self.field.rescaled(fixed_scale),
            None if self.parallax is None else self.parallax.rescaled(fixed_scale),
        )

    @property
    def is_curved(self) -> bool:
        """True where the mapping is not just a homography: a lens model or displacements take part."""
        return (
            self.field is not None
            or self.parallax is not None
            or any(map(lens.is_distorting, (self.fixed_lens, self.moving_lens, self.pre_distortion)))
        )

    def hold_positions(self, size_px: Size) -> None:
        """Compute the positions of all pixels of a reference (width, height) once for the steps that resample it.

        Nothing is done for large images, which are resampled in tiles.
        """
        if size_px[0] * size_px[1] <= MAX_HELD_POSITIONS_PX and self.held is None:
            object.__setattr__(self, "held", self.positions(Tile(0, 0, *size_px), np.float32))

    def is_smooth(self, tile: Tile) -> bool:
        """True without parallax, and if the horizon of the homography does not cross the tile."""
        corners = np.array([(tile.x0 + x, tile.y0 + y) for x in (0, tile.width) for y in (0, tile.height)], np.float64)
        depths = self.without_parallax.undistorted(corners) @ self.fixed_to_moving[2, :2] + self.fixed_to_moving[2, 2]
        return self.parallax is None and bool((depths > 0).all() or (depths < 0).all())

    def positions(self, tile: Tile, dtype: DTypeLike = np.float64, size_px: Size | None = None) -> Points:
        """Position of each pixel of a tile in the moving image, (height, width, 2) raw px.

        They are interpolated in blocks of the reference, which end at its (width, height) `size_px`, by default at the
        tile: with it, a pixel has the same position, to the last bit, in any tile.
        """
        width, height = size_px or (tile.x0 + tile.width, tile.y0 + tile.height)
        if self.held is not None and self.held.shape[1::-1] == (width, height) and dtype == np.float32:
            return self.held[tile.y0 : tile.y0 + tile.height, tile.x0 : tile.x0 + tile.width]
        (left, columns), (top, rows) = _blocks(tile.x0, tile.width, width), _blocks(tile.y0, tile.height, height)
        result = np.empty((sum(map(len, rows)), sum(map(len, columns)), 2), dtype)
        for y_px in rows:
            of_row = result[int(y_px[0] - rows[0][0]) :][: len(y_px)]
            for x_px in columns:
                block, target = self.at_crossings(x_px, y_px, dtype), of_row[:, int(x_px[0] - columns[0][0]) :]
                for axis in (0, 1):  # both at once take ten times as long
                    target[:, : len(x_px), axis] = block[..., axis]
        return result[top : top + tile.height, left : left + tile.width]

    def at_crossings(self, x_px: Points, y_px: Points, dtype: DTypeLike = np.float64) -> Points:
        """Positions (m, n, 2) in the moving image, raw px, of columns x (n,) and rows y (m,), both ascending."""
        if self.parallax is not None:
            return self._with_parallax(self.parallax, x_px, y_px, dtype)
        if self.is_curved:
            return splined(self, x_px, y_px, self._knot_step_px, dtype)
        h = self.fixed_to_moving
        result = np.empty((len(y_px), len(x_px), 2), dtype)
        denominator = (h[2, 0] * x_px)[None, :] + (h[2, 1] * y_px + h[2, 2])[:, None]
        for k in (0, 1):
            with np.errstate(divide="ignore", invalid="ignore"):
                result[..., k] = ((h[k, 0] * x_px)[None, :] + (h[k, 1] * y_px + h[k, 2])[:, None]) / denominator
        return result

    def _with_parallax(self, parallax: Parallax, x_px: Points, y_px: Points, dtype: DTypeLike) -> Points:
        """`at_crossings` with parallax, which is not smooth and cannot be interpolated between knots.

        In each cell of the parallax, the parabola through three levels replaces the mapping; its coefficients are
        smooth. The cells do not depend on other pixels.
        """
        relief = parallax.relief
        of_raw_pixels = self.pre_distortion is None
        levels_px = relief.at_crossings(x_px, y_px) if of_raw_pixels else relief(self._raw_crossings(x_px, y_px))
        cells = np.rint(levels_px / _CELL_PX)
        planes = np.empty((2, *levels_px.shape), dtype)  # contiguous ones are faster
        for cell in range(int(cells.min()), int(cells.max()) + 1):

            def coefficients(points: Points, cell: int = cell) -> Points:
                levels = (_CELL_PX * (cell + k / 2) for k in (-1, 0, 1))
                before, at, after = (self.at_parallax(points, parallax.baseline, level_px) for level_px in levels)
                return np.concatenate([at, (after - before) / 2, (after + before) / 2 - at], axis=-1)

            constant, linear, square = np.split(_splined_planes(coefficients, x_px, y_px, self._knot_step_px, dtype), 3)
            u = (levels_px * (2 / _CELL_PX) - 2 * cell).astype(dtype)
            np.copyto(planes, constant + u * (linear + u * square), where=cells == cell)
        return np.moveaxis(planes, 0, -1)

    def hidden(self, tile: Tile) -> Mask:
        """(height, width) True for pixels of a tile that nearer parts of the scene occlude in the moving image."""
        if self.parallax is None or self.parallax.hidden is None:
            return np.zeros((tile.height, tile.width), dtype=bool)
        x_px, y_px = _along(tile.x0, tile.width), _along(tile.y0, tile.height)
        if self.pre_distortion is None:
            return self.parallax.hides(x_px, y_px[:, None])
        return self.parallax.hides(*np.moveaxis(self._raw_crossings(x_px, y_px), -1, 0))

    def _raw_crossings(self, x_px: Points, y_px: Points) -> Points:
        """(m, n, 2) raw reference px of the pixels of columns x (n,) and rows y (m,)."""
        return splined(lambda points: lens.distort(self.pre_distortion, points), x_px, y_px)

    @property
    def _knot_step_px(self) -> int:
        if self.field is None:
            return _KNOT_STEP_PX
        # Minimum distance of the knots with a displacement field, which has four knots per step of its
        # lattice.
        field_knot_step_px = 12
        return int(np.clip(self.field.step_px / 4, field_knot_step_px, _KNOT_STEP_PX))


def _along(start: int, length: int) -> Points:
    return np.arange(start, start + length, dtype=np.float64)


def _blocks(start: int, length: int, side: int) -> tuple[int, list[Points]]:
    """Return the positions (n,) of the blocks, from 0 to `side`, that contain a range; first its offset in them."""
    firsts = range(start // _BLOCK_PX * _BLOCK_PX, start + length, _BLOCK_PX)
    return start % _BLOCK_PX, [_along(n, min(_BLOCK_PX, side - n)) for n in firsts]


def splined(
    mapping: Callable[[Points], Points],
    x_px: Points,
    y_px: Points,
    step_px: int = _KNOT_STEP_PX,
    dtype: DTypeLike = np.float64,
) -> Points:
    """A smooth function (..., k) of points (..., 2) at all crossings of columns x (n,) and rows y (m,): (m, n, k).

    A bicubic spline through the mapping's values on a lattice is linear in those values: two matrix products. The
    second one, by far the larger, is in `dtype`.
    """
    return np.moveaxis(_splined_planes(mapping, x_px, y_px, step_px, dtype), 0, -1)


def _splined_planes(
    mapping: Callable[[Points], Points], x_px: Points, y_px: Points, step_px: int, dtype: DTypeLike
) -> Points:
    """Return `splined` as contiguous planes (k, m, n), which are faster."""
    (knots_x, weights_x), (knots_y, weights_y) = (
        _spline_weights(np.asarray(at - at[0], np.float64).tobytes(), step_px) for at in (x_px, y_px)
    )
    values = mapping(np.stack(np.meshgrid(x_px[0] + knots_x, y_px[0] + knots_y), axis=-1))
    across = np.ascontiguousarray(weights_x.T, dtype)
    planes = np.empty((values.shape[-1], len(y_px), len(x_px)), dtype)
    for k, plane in enumerate(planes):
        np.matmul((weights_y @ values[..., k]).astype(dtype, copy=False), across, out=plane)
    return planes


@lru_cache(maxsize=32)
def _spline_weights(at_px: bytes, step_px: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (knots (k,), weights (n, k)) of cubic interpolation at positions (n,) from 0 on, as bytes of float64.

    Cached, because all bands of all captures of a flight have the same positions.
    """
    positions = np.frombuffer(at_px)
    knots = np.linspace(0, max(positions[-1], 3), max(4, 1 + math.ceil(positions[-1] / step_px)))
    return knots, np.asarray(CubicSpline(knots, np.eye(len(knots)))(positions))
