"""The expected error of a mapping: all that is known of it, in one record, and its value at any point.

Standard error, error map, quality flags, report and `Alignment.error_px` are this one quantity; so is the status, which
counts the error of a relief at the windows only, and does not count areas that moved, which are found after it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.values import geometry
from agalign.values.geometry import PairScales, Points
from agalign.values.image import FloatImage, Tile
from agalign.values.lens_shapes import CORNERS, SHAPES, lens_shapes, variance_of_shapes_px2, variance_px2
from agalign.values.moved_area import MovedArea, moved_px
from agalign.values.parallax import Parallax
from agalign.values.pixel_units import SAME_PIXELS, Size
from agalign.values.resampling import between_nodes, nodes_along
from agalign.values.residual import Residual, noise_px, square_weights

MAX_PIXEL_ERROR_PX = 1.0
"""Beyond it, px of the reference, a spectral index mixes neighbouring plants."""
_FAR_VARIANCE_FACTOR = 8.0
"""Factor on the variance of a mapping where it is extrapolated: the errors that neighbouring windows and patches have
in common average out between them only. Fitted, with _FAR_SPACINGS, to 16,700 tie points that are more than one spacing
from the windows, in 342 bands that are noisy, blurred, half saturated or cropped: at any distance, 0.64 to 0.73 of the
errors are below the expected error, and 0.93 to 0.96 below twice as much. benchmarks/errors_by_distance.py counts these
shares for single pairs."""
_FAR_SPACINGS = 2.0
"""Window spacings, beyond the first, over which a mapping becomes an extrapolation."""
_GAP_SPACINGS = 2.0
"""Window spacings that are left out between windows that verify a relief: these are in every other field of a
chessboard, whose sides are four spacings. The windows of the fit are in the other fields."""


@dataclass(frozen=True)
class MappingError:
    """What the error of one mapping is made of, px of the reference.

        error(x)^2 = rig^2 + trace(D(x) C D(x)^T) (1 + 7 far(x)) + far(x) (field^2 + relief^2)
                     + max(u(x)^2, z(x)^2, m(x)^2)

    D is the Jacobian `lens_shapes.jacobian`, far(x) rises from 0 near the measured windows to 1, u is
    the displacement that the mapping does not contain, by the residual shifts of the nearest windows beyond their
    noise, z the error by those of the parallax and of the baseline, and m the shift of an area that moved.

    Examples
    --------
    `result` is that of the example of `align`.

    >>> error = result.error
    >>> error.size_px, error.covariance_px2.shape, error.rig_std_px, error.parallax
    ((200, 200), (8, 8), 0.0, None)
    >>> error.residual.coverage, error.lens_std_px is None, error.field_std_px < 0.1, error.relief_std_px
    (1.0, False, True, 0.0)
    """

    size_px: Size
    """(width, height) of the reference."""
    covariance_px2: NDArray[np.float64] | None = None
    """C: covariance of the corners (8, 8), clockwise from the top left, x and y in turn, or with the lens shapes
    (12, 12); None for a prediction by other bands or captures."""
    residual: Residual | None = None
    """Shifts of windows that the fit did not use, under the mapping, or under that without its displacement field on a
    relief; None if they say nothing about it."""
    rig_std_px: float = 0.0
    """Standard error of a prediction by other bands or captures, or by a second layer, the same everywhere."""
    lens_std_px: NDArray[np.float64] | None = None
    """(4,) standard deviations of lens shapes that neither tags nor a rig determine; None if they are known or in C."""
    field_std_px: float = 0.0
    """Spread of the displacement field at the windows: elsewhere it continues by chance."""
    relief_std_px: float = 0.0
    """Spread of the relief, which a mapping without one lacks where no window is near."""
    parallax: Parallax | None = None
    """Parallax of the mapping, with its standard error."""
    baseline_std: float = 0.0
    """Standard error of the baseline, x and y together, px per px of parallax."""
    moved: tuple[MovedArea, ...] = ()
    """Areas that contradict the mapping: what they show moved between the exposures, or is near the camera."""

    def error_px(self, points_px: Points) -> NDArray[np.float64]:
        """Return the expected RMS error at points of the reference.

        Parameters
        ----------
        points_px
            (n, 2): x and y, raw px of the reference; (0, 0) is the centre of the top-left pixel.

        Returns
        -------
        array
            (n,), float64: px of the reference.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.error.error_px(np.array([[100.0, 100.0]])).shape
        (1,)
        """
        z_px2 = np.zeros(len(points_px))
        if self.parallax is not None:
            z_px2 = self.parallax.variance_px2(points_px, self.baseline_std)
        local_px2 = np.maximum(z_px2, np.square(moved_px(self.moved, *points_px.T)))
        return _error_px(*self.parts_px2(points_px), local_px2)

    def parts_px2(self, points_px: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the parts (n,) of the square that vary smoothly: all but u, z and m, and u, at points (n, 2)."""
        far = self._far(points_px)
        modelled_px2 = self.rig_std_px**2 + self._covariance_px2(points_px) * (1 + far * (_FAR_VARIANCE_FACTOR - 1))
        modelled_px2 = modelled_px2 + far * (self.field_std_px**2 + self.relief_std_px**2)
        # The windows are measured with a relief from other bands: their shifts contain its error.
        return modelled_px2, self._unmodelled_px2(points_px, far)

    def rms_px(self, points_px: Points) -> float:
        """Return the RMS of the expected error over points, without the shifts of `moved`: the standard error there.

        Parameters
        ----------
        points_px
            (n, 2): x and y, raw px of the reference.

        Returns
        -------
        float
            Px of the reference; infinite without points.

        Examples
        --------
        `result` is that of the example of `align`.

        >>> result.error.rms_px(np.array([[20.0, 20.0], [180.0, 180.0]])) < 0.2
        True
        """
        still = replace(self, moved=()) if self.moved else self
        return float(np.sqrt(np.square(still.error_px(points_px)).mean())) if len(points_px) else math.inf

    def distortion_px(self, points_px: Points) -> float:
        """Return the RMS over points (n, 2) of the error by corners and lenses alone, as if no window were far."""
        return float(np.sqrt(self._covariance_px2(points_px).mean()))

    def in_file_px(self, scales: PairScales, size_px: Size, parallax: Parallax | None) -> "MappingError":
        """Convert the error between images to one between their files; `size_px` is that of the reference's file, and
        `parallax` that between the files.

        What the windows say about unknown lenses is part of the covariance of a reduced image: its least error of a
        shift, px, is not that of the file.
        """
        up = scales.fixed.inverse
        per_axis = np.r_[np.tile(up, 4), np.full(SHAPES, up.mean)]
        covariance_px2 = self.covariance_px2 if scales.fixed == SAME_PIXELS else self._with_lenses
        is_given = covariance_px2 is self.covariance_px2
        return replace(
            self,
            size_px=size_px,
            covariance_px2=_scaled(covariance_px2, per_axis),
            residual=None if self.residual is None else self.residual.in_file_px(scales),
            rig_std_px=self.rig_std_px * up.mean,
            lens_std_px=self.lens_std_px * up.mean if is_given and self.lens_std_px is not None else None,
            field_std_px=self.field_std_px * up.mean,
            relief_std_px=self.relief_std_px * up.mean,
            parallax=parallax,
            moved=tuple(area.rescaled(up) for area in self.moved),
        )

    @cached_property
    def _measured(self) -> Residual | None:
        """The windows with a measured shift; None without any."""
        if self.residual is None or not self.residual.is_measured.any():
            return None
        return self.residual.where(self.residual.is_measured)

    @cached_property
    def _spacing_px(self) -> float:
        return 1.0 if self.residual is None else self.residual.spacing_px

    @cached_property
    def _tree(self) -> cKDTree:
        assert self._measured is not None
        return cKDTree(self._measured.centres_px)

    def _far(self, points_px: Points) -> NDArray[np.float64]:
        """Return (n,) from 0 to 1 how far points (n, 2) are from measured windows.

        It is 0 within one spacing of the windows. If these verify a relief, it is 0 also in the fields between them.
        """
        if self._measured is None:
            return np.zeros(len(points_px))
        distance_px, _ = self._tree.query(points_px)
        near_spacings = 1.0 if self.parallax is None else 1.0 + _GAP_SPACINGS
        return np.asarray(np.clip((distance_px / self._spacing_px - near_spacings) / _FAR_SPACINGS, 0, 1))

    def _covariance_px2(self, points_px: Points) -> NDArray[np.float64]:
        """Return the variance (n,) at points (n, 2) by the covariance of corners and lens shapes."""
        covariance = self._with_lenses
        return np.zeros(len(points_px)) if covariance is None else variance_px2(points_px, covariance, self.size_px)

    @cached_property
    def _with_lenses(self) -> NDArray[np.float64] | None:
        """The covariance (8, 8) of the corners, or (12, 12) with unknown lens shapes, given the windows.

        A homography fitted to the windows follows the lens shapes where the windows are, so that their errors cancel
        there and not elsewhere. The windows also limit the shapes that are possible.
        """
        if self.covariance_px2 is None or self.lens_std_px is None or self._measured is None:
            return self.covariance_px2
        centres_px = self._measured.centres_px
        flat_corners = geometry.over_corners(centres_px, *self.size_px).reshape(-1, CORNERS)
        flat_lenses = lens_shapes(centres_px, self.size_px).reshape(len(flat_corners), -1)
        damping = 1e-9 * np.trace(flat_corners.T @ flat_corners) * np.eye(CORNERS)
        followed = np.linalg.solve(flat_corners.T @ flat_corners + damping, flat_corners.T @ flat_lenses)
        remaining = flat_lenses - flat_corners @ followed
        # By the shifts beyond their noise: with all of the shift, bands with noise or saturation claim up to twice as
        # much, although seven tenths of the errors are within the claims without it.
        information = remaining.T @ remaining / variance_of_shapes_px2(self._measured.std_px**2 / 2)
        of_lenses = np.linalg.inv(np.diag(self.lens_std_px**-2.0) + information)
        of_corners = self.covariance_px2[:CORNERS, :CORNERS] + followed @ of_lenses @ followed.T
        of_both = -followed @ of_lenses
        return np.block([[of_corners, of_both], [of_both.T, of_lenses]])

    def _unmodelled_px2(self, points_px: Points, far: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return u^2 (n,): the expected squared shift at points that the mapping does not contain.

        It is the median of the nearest windows, by distance and noise, minus their noise, so that a single wrong peak
        does not count. Where one window has more weight than the others together, the value of all windows has the
        weight that they lack. It is shrunk towards the value of all windows, which is used alone far from them.
        """
        measured = self._measured
        if measured is None:
            return np.zeros(len(points_px))
        noise_px2, precision = np.square(noise_px(measured.peaks_sigma)), square_weights(measured)
        squares = np.square(measured.shifts_px).sum(axis=1)
        count = min(8, len(squares))  # nearest windows
        distance, index = (values.reshape(-1, count) for values in self._tree.query(points_px, k=count))
        weight = np.exp(-0.5 * (distance / self._spacing_px) ** 2) * precision[index] + 1e-12
        # The median square of a shift with two normally distributed components is log(2) times its mean square.
        all_px2, total = measured.std_px**2, weight.sum(axis=1)
        of_all_px2 = math.log(2) * (all_px2 + np.quantile(noise_px2, 0.5, weights=precision, method="inverted_cdf"))
        near_squares = np.column_stack([squares[index], np.full(len(index), of_all_px2)])
        order = np.argsort(near_squares, axis=1)
        lacking = np.maximum(2.001 * weight.max(axis=1) - total, 0.0)  # a little more, so that it decides
        cumulative = np.cumsum(np.take_along_axis(np.column_stack([weight, lacking]), order, axis=1), axis=1)
        middle = (cumulative >= cumulative[:, -1:] / 2).argmax(axis=1)[:, None]
        median_px2 = np.take_along_axis(near_squares, np.take_along_axis(order, middle, axis=1), axis=1)[:, 0]
        mean_noise_px2 = (weight * noise_px2[index]).sum(axis=1) / total
        local_px2 = np.maximum(median_px2 / math.log(2) - mean_noise_px2, 0.0)
        prior_windows = 4.0  # weight of all windows relative to one of the nearest
        near_px2 = (total * local_px2 + prior_windows * all_px2) / (total + prior_windows)
        return np.asarray((1 - far) * near_px2 + far * all_px2)


@dataclass(frozen=True)
class ErrorOnGrid:
    """The expected error at the pixels of a grid: its smooth parts at nodes, those of the parallax and of areas that
    moved at each pixel.
    """

    error: MappingError
    size_px: Size
    """(width, height) of the grid."""
    nodes_px2: NDArray[np.float32]
    """(2, rows, columns) the smooth parts of the square at nodes."""
    to_reference: Callable[[Points], Points] = np.asarray
    """Raw positions (n, 2) in the reference of positions on the grid; by default the grid is the reference's own."""
    is_along_axes: bool = True
    """Rows and columns of the grid are rows and columns of the reference."""

    @classmethod
    def of(
        cls,
        error: MappingError,
        size_px: Size,
        to_reference: Callable[[Points], Points] = np.asarray,
        *,
        is_along_axes: bool = True,
    ) -> "ErrorOnGrid":
        """Calculate the nodes of a map; the arguments are the fields."""
        columns, rows = (nodes_along(n) for n in size_px)
        points_px = to_reference(geometry.lattice(*size_px, columns, rows))
        nodes_px2 = np.reshape(error.parts_px2(points_px), (2, rows, columns)).astype(np.float32)
        return cls(error, size_px, nodes_px2, to_reference, is_along_axes)

    def on_tile(self, tile: Tile) -> FloatImage:
        """Return the expected error (height, width) on a tile of the grid, px of the reference."""
        modelled_px2, unmodelled_px2 = (between_nodes(plane, self.size_px, tile) for plane in self.nodes_px2)
        local_px2 = np.square(self.moved_px(tile))
        if self.error.parallax is not None:
            local_px2 = np.maximum(local_px2, self._z_px2(self.error.parallax, tile))
        return _error_px(modelled_px2, unmodelled_px2, local_px2).astype(np.float32, copy=False)

    def moved_px(self, tile: Tile) -> FloatImage:
        """Return the shift (height, width) of the areas that moved on a tile of the grid, px of the reference; 0
        elsewhere.
        """
        if not self.error.moved:
            return np.zeros((tile.height, tile.width), np.float32)
        if self.is_along_axes:
            columns, rows = self._crossings(tile)
            return moved_px(self.error.moved, columns, rows[:, None])
        return moved_px(self.error.moved, *self._points(tile).T).reshape(tile.height, tile.width)

    def _z_px2(self, parallax: Parallax, tile: Tile) -> FloatImage:
        if self.is_along_axes:
            return parallax.variance_at_crossings(*self._crossings(tile), self.error.baseline_std)
        variance = parallax.variance_px2(self._points(tile), self.error.baseline_std)
        return np.asarray(variance.reshape(tile.height, tile.width), np.float32)

    def _crossings(self, tile: Tile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x of the columns and y of the rows of a tile in the reference, for a grid along its axes."""
        x_px, y_px = (np.arange(first, first + n) for first, n in ((tile.x0, tile.width), (tile.y0, tile.height)))
        columns = self.to_reference(np.stack([x_px, np.zeros(tile.width)], axis=-1))[:, 0]
        return columns, self.to_reference(np.stack([np.zeros(tile.height), y_px], axis=-1))[:, 1]

    def _points(self, tile: Tile) -> Points:
        """Return the positions (n, 2) of the pixels of a tile in the reference, row by row."""
        x_px, y_px = (np.arange(first, first + n) for first, n in ((tile.x0, tile.width), (tile.y0, tile.height)))
        return self.to_reference(np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2).astype(np.float64))


def _error_px(modelled_px2: NDArray[Any], unmodelled_px2: NDArray[Any], local_px2: NDArray[Any]) -> NDArray[Any]:
    """Return the expected error from the parts of its square: those that the mapping contains, u, and z or m."""
    return np.asarray(np.sqrt(modelled_px2 + np.maximum(unmodelled_px2, local_px2)))


def _scaled(covariance: NDArray[np.float64] | None, per_parameter: NDArray[np.float64]) -> NDArray[np.float64] | None:
    if covariance is None:
        return None
    factors = per_parameter[: len(covariance)]
    return np.asarray(covariance * np.outer(factors, factors))
