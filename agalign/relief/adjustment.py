"""Adjustment of a capture: homography, lens field and baseline per band, parallax per window (plane + parallax).

The shift of window i in band b, in undistorted px of the reference, is

    s_ib = D(x_i) delta_b + N(x_i) f_b + t_b z_i + noise

delta_b (8,) corrects the band's homography at the image corners, f_b are the nodes of a smooth field (the difference of
the lenses' distortion), t_b (2,) is the band's baseline, and z_i is the parallax of the window, common to all bands: a
rank-1 factorisation (Irani 2002). It is solved by alternating least squares: z is determined before f, so that f only
contains what no common parallax explains. Cauchy weights reduce the influence of wrong correlation peaks and of windows
across depth edges.

Two ambiguities are removed. A plane a + b x + c y added to z is equivalent to other homographies of all bands: z is 0
on the plane that contains most windows. The scale of z is free: the longest baseline has length 1. If the lens layout
is known, positive parallax is nearer to the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px
from agalign.verify.window_fit import CAUCHY_SCALES, NODE_STEP_PX

Array = NDArray[np.float64]

_ITERATIONS = 12
"""Enough for the baselines to converge to a relative change of 0.001."""

_DAMPING = 1e-3
"""Weight of zero correction and zero parallax, relative to one window; matters only where no window contributes."""


class LensBasis:
    """Natural cubic splines over an image: the shapes of a smooth lens field."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        """Place nodes on an image (width, height)."""
        spacing_px, min_count = 200, 4  # along each axis; distortion varies over hundreds of pixels
        smoothness, damping = 3.0, 0.01  # weights of second differences and of the length, relative to one window
        self.size_px = size_px
        self.counts = [max(min_count, round(n / spacing_px) + 1) for n in size_px]
        columns, rows = (np.diff(np.eye(n), 2, axis=0) for n in self.counts)
        twist = np.kron(*(np.diff(np.eye(n), axis=0) for n in self.counts[::-1]))
        bending = np.kron(np.eye(self.counts[1]), columns.T @ columns) + np.kron(rows.T @ rows, np.eye(self.counts[0]))
        self.penalty = smoothness * (bending + 2 * twist.T @ twist) + damping * np.eye(len(bending))
        """(k, k) quadratic form of the prior."""

    def __call__(self, points_px: Points) -> Array:
        """Return (n, k) the value of each shape at points (n, 2)."""
        x, y = (self._along(points_px[:, axis], axis) for axis in (0, 1))
        return np.asarray((y[:, :, None] * x[:, None, :]).reshape(len(points_px), -1))

    def field(self, coefficients_px: Array) -> DisplacementField:
        """Return the field with coefficients (k, 2)."""
        return DisplacementField.sampled(lambda nodes: self(nodes) @ coefficients_px, NODE_STEP_PX, self.size_px)

    def _along(self, positions_px: Array, axis: int) -> Array:
        end, count = self.size_px[axis] - 1, self.counts[axis]
        spline = CubicSpline(np.linspace(0, end, count), np.eye(count), bc_type="natural")
        return np.asarray(spline(np.clip(positions_px, 0, end)))


@dataclass(frozen=True)
class Adjustment:
    """The adjusted model of a capture."""

    baselines: Array
    """(bands, 2) t_b, the longest of length 1."""
    corners_px: Array
    """(bands, 8) corrections of the homographies at the corners, px of the reference."""
    fields: Sequence[DisplacementField | None]
    """Corrections of the lens fields by band; None if they were not adjusted."""
    parallax_px: Array
    """(n,) parallax of the windows."""
    residuals_px: Array
    """(n, bands) lengths of the residuals; NaN where a window was not measured in a band."""

    @property
    def scales_px(self) -> Array:
        """(bands,) robust standard deviation of the residuals."""
        return _scales_px(self.residuals_px)


@dataclass(frozen=True)
class WindowShifts:
    """The shifts of the same windows in all bands, undistorted px of the reference."""

    centres_px: Points
    """(n, 2) of the windows, raw px."""
    points_px: Points
    """(n, 2) of the windows, undistorted px."""
    shifts_px: Array
    """(n, bands, 2), NaN where not measured."""
    weights: Array
    """(n, bands), median 1; 0 where not measured."""

    @classmethod
    def of(cls, residuals: Sequence[Residual[FixedImagePx]], mappings: Sequence[PixelMapping]) -> "WindowShifts":
        """Collect the windows of each band, measured with its mapping; all bands have the same grid of windows."""
        cells = np.concatenate([r.cells for r in residuals])
        _, first, index = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        centres_px = np.concatenate([r.centres_px for r in residuals])[first]
        index_of_band = np.split(index.reshape(-1), np.cumsum([len(r.cells) for r in residuals])[:-1])
        shifts, peaks = np.full((len(first), len(residuals), 2), np.nan), np.zeros((len(first), len(residuals)))
        for band, (residual, mapping) in enumerate(zip(residuals, mappings, strict=True)):
            measured = np.isfinite(residual.shifts_px[:, 0])
            if not measured.any():
                continue
            xy, rows = residual.centres_px[measured], index_of_band[band][measured]
            shifts[rows, band] = mapping.undistorted(xy + residual.shifts_px[measured]) - mapping.undistorted(xy)
            peaks[rows, band] = residual.peaks_sigma[measured]
        positive = peaks[peaks > 0]
        max_weight = 2.0  # so that well-textured parts do not dominate
        weights = np.minimum((peaks / np.median(positive)) ** 2, max_weight) if positive.size else peaks
        points = mappings[0].of_the_plane.undistorted(centres_px)
        return cls(centres_px, points, shifts, np.where(np.isfinite(shifts[..., 0]), weights, 0.0))

    def __len__(self) -> int:
        return len(self.points_px)

    def are_enough(self, minimum: int) -> bool:
        """Return True if at least `minimum` windows are measured in each band."""
        return len(self) > 0 and int((self.weights > 0).sum(axis=0).min()) >= minimum

    def of_bands(self, bands: Sequence[int]) -> "WindowShifts":
        """Select bands by index."""
        return replace(self, shifts_px=self.shifts_px[:, bands], weights=self.weights[:, bands])

    def fit_baseline(self, parallax_px: Array, size_px: tuple[int, int]) -> tuple[Array, Array]:
        """Fit homography and baseline of a single band to a known parallax (n,) of the windows.

        `size_px` is (width, height) of the reference. Returns corrections of the corners (8,) and of the baseline (2,).
        """
        design, prior = _design(self.points_px, size_px, None)
        shifts, weights = np.nan_to_num(self.shifts_px), self.weights
        for _ in range(_ITERATIONS):
            corners, baseline = _bands(shifts, parallax_px, design, prior, weights)
            predicted = design @ corners[0] + parallax_px[:, None] * baseline[0]
            residuals = np.linalg.norm(shifts[:, 0] - predicted, axis=1)
            scale = shift_scale_px(residuals[self.weights[:, 0] > 0])
            weights = self.weights * cauchy_weights(residuals, CAUCHY_SCALES * scale)[:, None]
        return corners[0], baseline[0]

    def plus(self, parallax: Array, baselines: Array) -> "WindowShifts":
        """Add the parallax (n,) of the relief with which the windows were measured, along the baselines (bands, 2).

        The results are shifts relative to the reference plane.
        """
        return replace(self, shifts_px=self.shifts_px + parallax[:, None, None] * baselines)


def adjust(
    windows: WindowShifts, size_px: tuple[int, int], layout: Array | None = None, *, with_fields: bool = True
) -> Adjustment | None:
    """Fit the model to the windows of a capture; None if too few windows are measured in all bands.

    `size_px` is (width, height) of the reference. `layout` (bands, 2) are the known directions, in any unit, in which
    points move in the bands when the scene comes nearer; they initialise the baselines and determine their sign.
    Without `with_fields`, f is 0.
    """
    initial = _initial_baselines(windows) if layout is None else layout
    if initial is None or not np.linalg.norm(initial, axis=1).max() > 0:
        return None
    baselines = initial / np.linalg.norm(initial, axis=1).max()
    basis = LensBasis(size_px) if with_fields else None
    design, prior = _design(windows.points_px, size_px, basis)
    plane = _plane_coordinates(windows.points_px, size_px)
    shifts, weights = np.nan_to_num(windows.shifts_px), windows.weights
    smooth, precisions = np.zeros((len(baselines), len(prior))), np.ones(len(baselines))
    for _ in range(_ITERATIONS):
        relative = shifts - np.einsum("nki,bi->nbk", design, smooth)
        parallax, information = _parallax(relative, baselines, weights * precisions)
        parallax = parallax - plane @ _reference_plane(parallax, plane, information)
        smooth, baselines = _bands(shifts, parallax, design, prior, weights)
        longest = np.linalg.norm(baselines, axis=1).max()
        if not longest > 0:
            return None
        baselines, parallax = baselines / longest, parallax * longest
        predicted = np.einsum("nki,bi->nbk", design, smooth) + parallax[:, None, None] * baselines
        residuals = np.where(windows.weights > 0, np.linalg.norm(shifts - predicted, axis=2), np.nan)
        scales = _scales_px(residuals)
        weights = windows.weights * np.nan_to_num(cauchy_weights(residuals, CAUCHY_SCALES * scales))
        # Inverse variance of bands worse than the median, so that an inconsistent band does not determine the parallax.
        # The fit of a band does not use it: its priors are relative to windows of weight 1.
        precisions = np.minimum(1, (np.median(scales) / scales) ** 2)
    if layout is not None and np.sum(baselines * layout) < 0:
        baselines, parallax = -baselines, -parallax
    fields = [None if basis is None else basis.field(s[8:].reshape(2, -1).T) for s in smooth]
    return Adjustment(baselines, smooth[:, :8], fields, parallax, residuals)


def are_of_lenses(baselines: Array, layout: Array | None) -> bool:
    """Return True if baselines (bands, 2) are plausible for lenses with a layout (bands, 2), None if unknown.

    Noise of the reference shifts the windows of all bands equally. It resembles parallax that is common to the bands,
    but all baselines are nearly equal, which those of different lenses are not. Equal baselines resemble the layout of
    lenses on one side of the reference, but it must be more similar to them than their mean is.
    """
    if layout is not None:
        min_cosine = 0.8  # measured: 0.998 for scenes with depth, up to 0.55 for noise
        of_mean = _cosine(baselines, np.broadcast_to(baselines.mean(axis=0), baselines.shape))
        return _cosine(baselines, layout) >= max(min_cosine, of_mean)
    lengths = np.linalg.norm(baselines, axis=1)
    from_mean = np.linalg.norm(baselines - baselines.mean(axis=0), axis=1)
    min_spread = 0.3  # at least 0.5 for real cameras, at most 0.2 for a blurred reference
    return bool(from_mean.max() >= min_spread * lengths.max() > 0)


def _cosine(baselines: Array, others: Array) -> float:
    """Return the cosine similarity of baselines (bands, 2) and others; 0 if either are all zero."""
    norms = np.linalg.norm(baselines) * np.linalg.norm(others)
    return float(np.sum(baselines * others) / norms) if norms > 0 else 0.0


def are_on_a_line(baselines: Array) -> bool:
    """Return True if baselines (bands, 2) have one direction.

    Those of lenses in a row do too, but edges of shadows and leaves in blurred bands, or rows in the wind, also move
    along one direction, by a different length in each band.
    """
    longest, shortest = np.linalg.svd(baselines, compute_uv=False)[[0, -1]]
    min_ratio = 0.15  # of baselines that are not on one line: 0.22 to 0.5 for cameras
    return bool(shortest < min_ratio * longest)


def shifts_by_corners(model: Adjustment, points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, bands, 2) the shifts by the corrections of the homographies at points (n, 2), without parallax."""
    return np.asarray(np.einsum("nki,bi->nbk", geometry.over_corners(points_px, *size_px), model.corners_px))


def parallax_of(residual_px: Array, baselines: Array, weights: Array) -> Array:
    """Return the parallax (n,) of windows from their shifts (n, bands, 2) relative to the homographies.

    `baselines` are (bands, 2), `weights` (n, bands). The parallax is 0 for windows without information.
    """
    return _parallax(np.nan_to_num(residual_px), baselines, weights)[0]


def _initial_baselines(windows: WindowShifts) -> Array | None:
    """Return (bands, 2) the first right singular vector of the shifts of windows that are measured in all bands."""
    complete = (windows.weights > 0).all(axis=1)
    if complete.sum() < 2 * windows.weights.shape[1]:
        return None
    shifts = windows.shifts_px[complete].reshape(int(complete.sum()), -1)
    shifts = shifts - np.median(shifts, axis=0)
    max_medians = 5.0  # larger shifts are clipped, so that outliers do not determine the initial estimate
    limit = max_medians * np.median(np.abs(shifts)) + MIN_SHIFT_SCALE_PX
    _, _, right = np.linalg.svd(np.clip(shifts, -limit, limit), full_matrices=False)
    return np.asarray(right[0].reshape(-1, 2))


def _plane_coordinates(points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, 3) = (1, u, v) with u and v from -1 to 1 across the image."""
    return np.column_stack([np.ones(len(points_px)), 2 * points_px / np.asarray(size_px) - 1])


def _parallax(residual_px: Array, baselines: Array, weights: Array) -> tuple[Array, Array]:
    """Return the parallax (n,) by weighted least squares along the baselines, and its information (n,)."""
    projection = (weights * np.einsum("nbk,bk->nb", residual_px, baselines)).sum(axis=1)
    information = (weights * (baselines**2).sum(axis=1)).sum(axis=1)
    return projection / (information + 10 * _DAMPING), information


def _reference_plane(parallax: Array, plane: Array, information: Array) -> Array:
    """Return the coefficients (3,) in (1, u, v) of the plane of most windows: an M-estimate from their median."""
    min_information = 0.2  # sum of weights times squared baselines for the parallax of a window to be known
    half_weight_px = 0.5  # distance from the plane at which the robust weight of a window is one half
    known = (information > min_information).astype(float)
    result = np.array([np.median(parallax), 0.0, 0.0])
    for _ in range(8):
        weight = known * cauchy_weights(parallax - plane @ result, half_weight_px)
        normal = plane.T @ (weight[:, None] * plane) + 1e-6 * np.eye(3)
        result = np.linalg.solve(normal, plane.T @ (weight * parallax))
    return np.asarray(result)


def _design(points_px: Points, size_px: tuple[int, int], basis: LensBasis | None) -> tuple[Array, Array]:
    """Return the Jacobian (n, 2, k) of shifts by (delta, f) and the quadratic form (k, k) of their prior."""
    corners = geometry.over_corners(points_px, *size_px)
    if basis is None:
        return corners, _DAMPING * np.eye(8)
    shapes = basis(points_px)
    count = shapes.shape[1]
    design, prior = np.zeros((len(points_px), 2, 8 + 2 * count)), np.zeros((8 + 2 * count,) * 2)
    design[:, :, :8], prior[:8, :8] = corners, _DAMPING * np.eye(8)
    for axis in (0, 1):
        columns = slice(8 + axis * count, 8 + (axis + 1) * count)
        design[:, axis, columns], prior[columns, columns] = shapes, basis.penalty
    return design, prior


def _bands(shifts: Array, parallax: Array, design: Array, prior: Array, weights: Array) -> tuple[Array, Array]:
    """Return (delta, f) (bands, k) and baselines (bands, 2) by weighted least squares for each band."""
    count = design.shape[2]
    full = np.concatenate([design, parallax[:, None, None] * np.eye(2)], axis=2).reshape(-1, count + 2)
    form = np.zeros((count + 2,) * 2)
    form[:count, :count], form[count:, count:] = prior, 1e-3 * _DAMPING * np.eye(2)
    solution = np.empty((shifts.shape[1], count + 2))
    for band, of_band in enumerate(solution):
        weighted = full * np.repeat(weights[:, band], 2)[:, None]
        of_band[:] = np.linalg.solve(weighted.T @ full + form, weighted.T @ shifts[:, band].reshape(-1))
    return solution[:, :count], solution[:, count:]


def _scales_px(residuals_px: Array) -> Array:
    """Return (bands,) the robust standard deviations of residuals (n, bands), NaN where not measured."""
    return np.array([shift_scale_px(r[np.isfinite(r)]) for r in residuals_px.T])
