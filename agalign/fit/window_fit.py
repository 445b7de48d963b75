"""The adjustment of a capture to the shifts of windows: the one linear model of its geometry.

The shift of window i in band b, in undistorted px of the reference, is

    s_ib = D(x_i) delta_b + N(x_i) f_b + t_b z_i + noise

delta_b (8,) corrects the band's homography at the image corners and D is their Jacobian. f_b (4,) are the coefficients
of the lens shapes N: the smooth displacement by which the distortions of two lenses differ, to first order of the
Brown-Conrady model, which a homography only approximates where it is fitted. t_b (2,) is the band's baseline and z_i
the parallax of the window, common to all bands: a rank-1 factorisation (Irani 2002).

`fit_windows` fits a single band, without parallax or with a known one. `adjust` fits all bands of a capture by
alternating least squares: z is determined before f, so that f only contains what no common parallax explains. Cauchy
weights reduce the influence of wrong correlation peaks and of windows across depth edges.

Two ambiguities are removed. A plane a + b x + c y added to z is equivalent to other homographies of all bands: z is 0
on the plane that contains most windows. The scale of z is free: the longest baseline has length 1. If the lens layout
is known, positive parallax is nearer to the camera. Else its mean is positive, as most objects are nearer than the
plane, until occlusions show the opposite (`dense.nearer_sign`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.errors import GeometryError
from agalign.fit.held_out import Folds, held_out, remaining
from agalign.fit.windows import Shifts
from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.least_squares import MIN_SHIFT_SCALE_PX, Robust, cauchy_weights, least_squares, shift_scale_px
from agalign.values.lens_shapes import CORNERS, jacobian, lens_shapes, shift_variance_px2
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale
from agalign.values.residual import Residual, peak_weights

Array = NDArray[np.float64]

NODE_STEP_PX = 48
"""Spacing of the nodes of a displacement field of lenses, as their distortion varies over hundreds of pixels."""
_CAUCHY_SCALES = 2.0
"""Residual of a window at which its robust weight is one half, in residual scales."""
_RELIEF_STEP_PX = 32
"""Spacing of a relief by windows."""
_COMMON_STD_PX = 0.01
"""Error that is common to all windows; their residuals do not contain it."""
_ALTERNATIONS = 12
"""Enough for the baselines to converge to a relative change of 0.001."""
_MIN_FITTED_WINDOWS = 12
"""Without a prior: 1.5 times the eight parameters of a homography."""
_CORNER_STD_PX = 5.0
"""Prior of the displacement of a corner: the error of an extrapolated affine mapping."""
_NOISE_PX = 0.1
"""Scale of the residuals of windows before the first fit."""
_MIN_INFORMATION = 0.01
"""Weight of zero parallax, relative to one window of one band; matters only where no window contributes."""


class BaselinePrior(NamedTuple):
    """What is known of the baseline of a band before it is fitted."""

    mean: tuple[float, float] = (0.0, 0.0)
    std: float = 1.0
    """Standard deviation of each coordinate: by default that of the lenses themselves."""


@dataclass(frozen=True)
class WindowFit:
    """The geometry of one band that fits windows: a correction of its mapping, px of the reference."""

    corners_px: Array
    """(8,) displacements x and y of the corners in turn, clockwise from the top left."""
    residuals_px: Array
    """(n,) lengths of the residuals: of the measured windows by `fit_windows`, of all with NaN by `adjust`."""
    size_px: tuple[int, int]
    covariance_px2: Array
    """(8, 8), or (12, 12) with the lens shapes."""
    lens_px: Array | None = None
    """(4,) coefficients of the lens shapes; None if they were not fitted."""
    baseline: Array | None = None
    """(2,) t_b; None without parallax."""
    baseline_std: float = 0.0
    """Standard error of t_b, x and y together, px per px of parallax."""

    @property
    def max_px(self) -> float:
        """Maximum displacement of a corner along x or y."""
        return float(np.abs(self.corners_px).max())

    def applied_to(self, mapping: PixelMapping) -> PixelMapping:
        """Correct a homography; lens shapes and baseline replace those of the mapping. Raises GeometryError."""
        corners = geometry.moving_corners(self.corners_px, *self.size_px)
        mapping = replace(mapping, fixed_to_moving=geometry.compose(mapping.fixed_to_moving, corners))
        if self.lens_px is not None:
            lens_px = self.lens_px

            def displaced_px(points_px: Points) -> Points:
                return np.asarray(lens_shapes(points_px, self.size_px) @ lens_px)

            mapping = replace(mapping, field=DisplacementField.sampled(displaced_px, NODE_STEP_PX, self.size_px))
        if self.baseline is not None and mapping.parallax is not None:
            x, y = self.baseline.tolist()
            mapping = mapping.with_parallax(Parallax(mapping.parallax.relief, (x, y)))
        return mapping


def fit_windows(
    mapping: PixelMapping,
    residual: Residual,
    size_px: tuple[int, int],
    lens_std_px: Array | None = None,
    *,
    baseline: BaselinePrior | None = None,
    start: PixelMapping | None = None,
) -> WindowFit | None:
    """Fit the correction of a mapping of a reference (width, height) to the residual measured with this mapping.

    With the standard deviations `lens_std_px` (4,) of the lens shapes, these are fitted too, and the homography has a
    prior around that of `start`, by default of the mapping itself. With the prior of its `baseline`, that along which
    the band sees the relief of the mapping is fitted too. Without lens shapes, the result is None if fewer than 12
    windows are measured. A window's weight is that of its correlation peak times a Cauchy weight.
    """
    raw = Shifts.of(residual)
    if lens_std_px is None and len(raw.centres_px) < _MIN_FITTED_WINDOWS:
        return None
    points_px, shifted_px = (mapping.undistorted(p) for p in (raw.centres_px, raw.centres_px + raw.shifts_px))
    shifts_px, std_px, with_shapes = shifted_px - points_px, np.full(CORNERS, np.inf), lens_std_px is not None
    if lens_std_px is not None:
        std_px = np.r_[np.full(CORNERS, _CORNER_STD_PX), lens_std_px]
    count = len(std_px)
    design = jacobian(points_px, size_px, count)
    mean = np.zeros(count)
    if start is not None:
        to_start = geometry.compose(geometry.invert(mapping.fixed_to_moving), start.fixed_to_moving)
        at_corners = geometry.corners(*size_px)
        mean[:CORNERS] = (geometry.apply(to_start, at_corners) - at_corners).ravel()
    if baseline is not None and mapping.parallax is not None:
        parallax_px = mapping.parallax.relief(raw.centres_px)
        shifts_px = shifts_px + parallax_px[:, None] * np.array(mapping.parallax.baseline)
        design, std_px = _with_parallax(design, parallax_px), np.r_[std_px, [baseline.std] * 2]
        mean = np.r_[mean, baseline.mean]
    robust = Robust(_CAUCHY_SCALES, shift_scale_px, partial(shift_variance_px2, with_shapes=with_shapes))
    estimate = least_squares(design, shifts_px, raw.weights, np.diag(std_px**-2.0), mean, robust=robust)
    # Each parameter without a prior takes a degree of freedom from the residuals.
    components, covariance = 2 * len(raw.centres_px), estimate.covariance
    if lens_std_px is None:
        covariance = components / (components - count) * covariance
    return _window_fit(estimate.mean, estimate.residuals, size_px, covariance, count)


def _window_fit(mean: Array, residuals_px: Array, size_px: tuple[int, int], covariance: Array, count: int) -> WindowFit:
    """Split parameters and their covariance into corners and lens shapes, `count` together, and baseline."""
    corners_px, lens_px, baseline = np.split(mean, [CORNERS, count])
    lens, t = (None if not len(part) else part for part in (lens_px, baseline))
    covariance_px2 = covariance[:count, :count] + _COMMON_STD_PX**2 * np.eye(count)
    baseline_std = math.sqrt(np.trace(covariance[count:, count:]))
    return WindowFit(corners_px, residuals_px, size_px, covariance_px2, lens, t, baseline_std)


def _with_parallax(design: Array, parallax_px: Array) -> Array:
    """Append the derivatives with respect to the baseline to a design (n, 2, p) for windows with a parallax (n,)."""
    return np.concatenate([design, parallax_px[:, None, None] * np.eye(2)], axis=2)


def fit_in_rounds(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual],
    size_px: tuple[int, int],
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    rounds: int = 4,
    *,
    baseline: BaselinePrior | None = None,
    max_moved_px: float = math.inf,
) -> tuple[PixelMapping, WindowFit] | None:
    """Correct a mapping repeatedly by the residual that `measure` returns for it; return it and the last correction.

    Peaks are sharper when windows overlap better, and a correction is accurate to first order.
    Other arguments are those of `fit_windows`. None if a correction does not exist or is not accepted, or if all
    together move a corner by more than `max_moved_px`, px of the reference. Lens shapes are always fitted to a
    mapping with the given displacement field, and replace it in the result.
    """
    start, result = mapping, None
    for _ in range(rounds):
        fit = fit_windows(mapping, measure(mapping), size_px, lens_std_px, baseline=baseline, start=start)
        if fit is None or not is_accepted(fit):
            return None
        try:
            result = fit.applied_to(mapping), fit
        except GeometryError:
            return None
        moved = geometry.compose(geometry.invert(start.fixed_to_moving), result[0].fixed_to_moving)
        if not geometry.corner_error_px(moved, geometry.identity(), *size_px) <= max_moved_px:
            return None
        converged_px, change_px = 0.02, fit.max_px  # noise of the windows
        if fit.baseline is not None and mapping.parallax is not None:
            change = np.linalg.norm(fit.baseline - mapping.parallax.baseline)
            change_px = max(change_px, float(change) * mapping.parallax.relief.rms_px)
        if change_px <= converged_px:
            break
        mapping = replace(result[0], field=mapping.field)
    return result


class CrossFit(NamedTuple):
    """A mapping that is fitted to all windows, and what verifies it."""

    mapping: PixelMapping
    fit: WindowFit
    """The last correction."""
    at_start: Residual
    """The windows under the first mapping."""
    held_out: Residual
    """Each window under the mapping that is fitted without its fold."""


def cross_fitted(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual],
    size_px: tuple[int, int],
    folds_of: Callable[[Residual], Folds],
    side_px: float,
    *,
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    max_moved_px: float = math.inf,
) -> CrossFit | None:
    """Correct a mapping by `fit_in_rounds`, and by the last measurement again without each fold of its windows.

    `side_px` is the side of the windows, px of the reference; the other arguments are those of `fit_in_rounds`. None if
    that returns None, or if the windows without a fold do not determine the mapping.
    """
    measured: list[tuple[PixelMapping, Residual]] = []

    def measured_at(at: PixelMapping) -> Residual:
        measured.append((at, measure(at)))
        return measured[-1][1]

    fitted = fit_in_rounds(mapping, measured_at, size_px, is_accepted, lens_std_px, max_moved_px=max_moved_px)
    if fitted is None:
        return None
    last, residual = measured[-1]
    folds = folds_of(residual)
    parts = remaining(residual, folds, side_px)
    fits = [fit_windows(last, part, size_px, lens_std_px, start=mapping) for part in parts]
    try:
        by_fold = [fit.applied_to(last) for fit in fits if fit is not None]
    except GeometryError:  # the windows are degenerate without a fold
        return None
    if len(by_fold) < len(fits):
        return None
    return CrossFit(*fitted, measured[0][1], held_out(residual, last, folds, by_fold))


# ---- all bands of a capture


@dataclass(frozen=True)
class WindowShifts:
    """The shifts of the same windows in all bands, undistorted px of the reference."""

    centres_px: Points
    """(n, 2) of the windows, raw px."""
    points_px: Points
    """(n, 2) of the windows, undistorted px."""
    shifts_px: Array
    """(n, bands, 2) relative to the planes and the lenses of the tags or the rig, NaN where not measured."""
    weights: Array
    """(n, bands), median 1; 0 where not measured."""

    @classmethod
    def of(
        cls, residuals: Sequence[Residual], mappings: Sequence[PixelMapping], *, with_lens_shapes: bool = False
    ) -> "WindowShifts":
        """Collect the windows of each band, measured with its mapping; all bands have the same grid of windows.

        The displacements by the relief of the mappings are part of the shifts, and `with_lens_shapes` those by their
        fields.
        """
        cells = np.concatenate([r.cells for r in residuals])
        _, first, index = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        centres_px = np.concatenate([r.centres_px for r in residuals])[first]
        index_of_band = np.split(index.reshape(-1), np.cumsum([len(r.cells) for r in residuals])[:-1])
        shifts, peaks = np.full((len(first), len(residuals), 2), np.nan), np.zeros((len(first), len(residuals)))
        for band, (residual, mapping) in enumerate(zip(residuals, mappings, strict=True)):
            measured = residual.is_measured
            if not measured.any():
                continue
            xy, rows = residual.centres_px[measured], index_of_band[band][measured]
            shifts[rows, band] = mapping.undistorted(xy + residual.shifts_px[measured]) - mapping.undistorted(xy)
            if mapping.parallax is not None:
                shifts[rows, band] += mapping.parallax.relief(xy)[:, None] * np.array(mapping.parallax.baseline)
            if with_lens_shapes and mapping.field is not None:
                shifts[rows, band] += mapping.field(xy)
            peaks[rows, band] = residual.peaks_sigma[measured]
        points = mappings[0].without_parallax.undistorted(centres_px)
        return cls(centres_px, points, shifts, peak_weights(peaks))

    def __len__(self) -> int:
        return len(self.points_px)

    def are_enough(self, minimum: int) -> bool:
        """Return True if at least `minimum` windows are measured in each band."""
        return len(self) > 0 and int((self.weights > 0).sum(axis=0).min()) >= minimum

    def relief(self, parallax_px: Array, size_px: tuple[int, int]) -> Relief:
        """Return the parallax (n,) of the windows as a relief of a reference (width, height): that of the nearest."""
        shape = size_px[1] // _RELIEF_STEP_PX, size_px[0] // _RELIEF_STEP_PX
        scale = PixelScale.between(size_px, shape[::-1])
        centres_px = scale.inverse.positions(np.indices(shape)[::-1].reshape(2, -1).T.astype(np.float64))
        nearest = parallax_px[cKDTree(self.centres_px).query(centres_px)[1]].reshape(shape).astype(np.float32)
        return Relief(nearest, np.ones_like(nearest), scale)

    def shifts_of(self, residual: Residual, shifts_px: Array) -> Array:
        """Select from the shifts (n, 2) of all windows those of the windows of a band."""
        return np.asarray(shifts_px[cKDTree(self.centres_px).query(residual.centres_px)[1]])

    def of_bands(self, bands: Sequence[int]) -> "WindowShifts":
        """Select bands by index."""
        return replace(self, shifts_px=self.shifts_px[:, bands], weights=self.weights[:, bands])


@dataclass(frozen=True)
class Adjustment:
    """The adjusted model of a capture."""

    fits: Sequence[WindowFit]
    """Of each band; the longest baseline has length 1."""
    parallax_px: Array
    """(n,) parallax of the windows."""
    scales_px: Array
    """(bands,) robust scales of the residuals, `shift_scale_px`."""

    @property
    def baselines(self) -> Array:
        """(bands, 2) t_b."""
        return np.array([fit.baseline for fit in self.fits])


def adjust(
    windows: WindowShifts, size_px: tuple[int, int], layout: Array | None = None, lens_std_px: Array | None = None
) -> Adjustment | None:
    """Fit the model to the windows of a capture; None if too few windows are measured in all bands.

    `size_px` is (width, height) of the reference. `layout` (bands, 2) are the known directions, in any unit, in which
    points move in the bands when the scene comes nearer; they initialise the baselines and determine their sign.
    Lens shapes are fitted with the standard deviations `lens_std_px` (4,).
    """
    initial = _initial_baselines(windows) if layout is None else layout
    if initial is None or not np.linalg.norm(initial, axis=1).max() > 0:
        return None
    baselines = initial / np.linalg.norm(initial, axis=1).max()
    smooth_std_px = np.r_[np.full(CORNERS, _CORNER_STD_PX), [] if lens_std_px is None else lens_std_px]
    count = len(smooth_std_px)
    design = jacobian(windows.points_px, size_px, count)
    prior = np.diag(np.r_[smooth_std_px, [BaselinePrior().std] * 2] ** -2)
    # (n, 3) = (1, u, v) with u and v from -1 to 1 across the image.
    plane = np.column_stack([np.ones(len(windows)), 2 * windows.points_px / np.asarray(size_px) - 1])
    shifts, weights = np.nan_to_num(windows.shifts_px), windows.weights
    smooth, scales = np.zeros((len(baselines), count)), np.full(len(baselines), _NOISE_PX)
    for _ in range(_ALTERNATIONS):
        relative = shifts - np.einsum("nki,bi->nbk", design, smooth)
        # A band worse than the median has the weight of its variance, so that it does not determine the parallax.
        precisions = np.minimum(1, (np.median(scales) / scales) ** 2)
        parallax, of_windows = _parallax(relative, baselines, weights * precisions)
        parallax = parallax - plane @ _reference_plane(parallax, plane, of_windows)
        absolute = weights.T / shift_variance_px2(scales)[:, None]
        by_band = least_squares(_with_parallax(design, parallax), shifts.swapaxes(0, 1), absolute, prior)
        smooth, baselines = by_band.mean[:, :count], by_band.mean[:, count:]
        longest = np.linalg.norm(baselines, axis=1).max()
        if not longest > 0:
            return None
        baselines, parallax = baselines / longest, parallax * longest
        residuals = np.where(windows.weights.T > 0, by_band.residuals, np.nan)
        scales = np.array([shift_scale_px(r[np.isfinite(r)]) for r in residuals])
        weights = windows.weights * np.nan_to_num(cauchy_weights(residuals.T, _CAUCHY_SCALES * scales))
    if (parallax.mean() if layout is None else np.sum(baselines * layout)) < 0:
        baselines, parallax = -baselines, -parallax
    of_bands = zip(np.hstack([smooth, baselines]), residuals, by_band.covariance, strict=True)
    fits = [_window_fit(mean, r, size_px, covariance, count) for mean, r, covariance in of_bands]
    return Adjustment(fits, parallax, scales)


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


def _parallax(residual_px: Array, baselines: Array, weights: Array) -> tuple[Array, Array]:
    """Return the parallax (n,) by weighted least squares along the baselines, and its information (n,)."""
    projection = (weights * np.einsum("nbk,bk->nb", residual_px, baselines)).sum(axis=1)
    information = (weights * (baselines**2).sum(axis=1)).sum(axis=1)
    return projection / (information + _MIN_INFORMATION), information


def _reference_plane(parallax: Array, plane: Array, information: Array) -> Array:
    """Return the coefficients (3,) in (1, u, v) of the plane of most windows: an M-estimate from their median."""
    min_information = 0.2  # sum of weights times squared baselines for the parallax of a window to be known
    half_weight_px = 0.5  # distance from the plane at which the robust weight of a window is one half
    known = (information > min_information).astype(float)
    median, damping = np.array([np.median(parallax), 0.0, 0.0]), 1e-6 * np.eye(3)
    near_median = known * cauchy_weights(parallax - median[0], half_weight_px)
    by_window = plane[:, None], parallax[:, None], known
    return least_squares(*by_window, damping, median, robust=Robust(half_weight_px), first_weights=near_median).mean
