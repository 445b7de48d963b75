"""Smooth displacement fields in addition to a homography, fitted to the residual shifts of windows.

A field is accepted if it reduces the residuals of windows that were left out of the fit and does not fold the image.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.sparse import dia_matrix, diags, identity, kron, vstack
from scipy.spatial import cKDTree

from agalign.pixels.resample import warped
from agalign.pixels.structure import Field
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.robust import cauchy_weights, shift_scale_px
from agalign.verify.residuals import FixedWindows

_WINDOW_PX, _STEP_PX = 40, 20
"""Side and spacing of the windows in which shifts are measured. On reference tie points of three cameras, smaller ones
are as accurate, and larger ones less."""
_LATTICE_PX = 24
"""Spacing of the field's nodes: leaves and branches near the camera have parallax at this scale."""
_VERIFICATION_PX = 48
"""Side of the windows in which a field is verified; larger ones are farther from the windows of the fit."""
_MAX_WINDOWS = 5500
"""The spacing of the windows grows in images above 2 megapixels, which limits the time."""
_MIN_NODE_SPACING = 0.75
"""Minimum spacing of the nodes relative to that of the windows: the windows do not determine more nodes."""
_SMOOTHNESS = (0.2, 1.0, 5.0, 25.0, 200.0)
"""Weights of the field's second differences relative to one window; selected by cross-validation."""
_DAMPING = 0.003
"""Weight of the field's length, relative to one window; it matters only far from all windows."""

_CAUCHY_SCALES = 4.0
"""Residual at which the robust weight is one half, in residual scales; only wrong peaks have larger ones."""
_REWEIGHTINGS = 4
"""Iterations after which the robust weights have converged."""
_MIN_ROUNDS, _MAX_ROUNDS, _CONVERGED_PX = 2, 4, 0.2
"""Shifts are measured again with the field of the previous round until their median is at most 0.2 px, because large
shifts are measured in steps."""
_MIN_WINDOWS = 24
"""Minimum number of windows with a shift; a fit without one fold may have half as many."""
_MIN_GAIN_SIGMA = 4.0
"""Minimum decrease of the loss of held-out windows, in standard errors of the decrease: 4 to 8 for lenses and canopies,
up to 3 for edges of shadows in blurred bands."""
_LOSS_SCALE_PX = 0.1
"""Scale of the robust loss by which fields are compared: several times the noise of a shift."""
_MIN_CAPTURES, _COMMON_FOLDS = 3, 4
"""Minimum number of captures for a common field, and number of folds of its cross-validation."""
_COMMON_LATTICE_PX = 48
"""Spacing of the nodes of a common field: the distortion of lenses varies over hundreds of pixels."""
_COMMON_SMOOTHNESS = (1.0, 4.0, 16.0, 64.0)
"""As `_SMOOTHNESS`, relative to one window of each capture."""
_MIN_COMMON_GAIN_SIGMA = 2.5
"""Less strict than within one capture: captures that are left out have only their lenses in common with the others."""
_MAX_P95_GROWTH = 1.05
"""Maximum ratio of the p95 of held-out windows with and without a field; the p95 of wrong peaks is noisy."""
_FOLDS = 4
"""Every fourth window along both axes is a fold. Without the windows that overlap it, most windows remain."""
_GAIN_FOLDS = (0, 2, 8, 10)
"""Folds with which fields are compared, a quarter of the windows."""
_SAME_WINDOW_PX = 1.0
"""Windows of one grid at a smaller distance are identical."""
_MIN_WEIGHT = 0.1
"""Windows with a lower relative weight are excluded from the comparison of fields: parallax within a window lowers its
peak."""


@dataclass(frozen=True)
class DisplacementResult:
    """A displacement field, and its effect on the residual of held-out windows; no field if it does not reduce it."""

    field: DisplacementField | None
    before_p95_px: FixedImagePx
    after_p95_px: FixedImagePx
    held_out: Residual[FixedImagePx] | None = None
    """Residual of held-out windows: each field is fitted without the window and those that overlap it."""


class DisplacementEstimator:
    """Small, overlapping windows of the reference, for fields of any number of moving bands."""

    def __init__(self, valid: Mask, structure: Field) -> None:
        """Cut windows from the structure field (height, width) of the reference with the mask `valid`."""
        self._valid, self._structure = valid, structure
        step_px = max(_STEP_PX, round((valid.size / _MAX_WINDOWS) ** 0.5))
        self.size_px = valid.shape[1], valid.shape[0]
        self.lattice_px = max(_LATTICE_PX, round(_MIN_NODE_SPACING * step_px))
        self.windows = FixedWindows(valid, structure, _WINDOW_PX, step_px)

    @cached_property
    def verification(self) -> FixedWindows:
        """The windows in which a field is verified; they do not overlap."""
        return FixedWindows(self._valid, self._structure, _VERIFICATION_PX)

    def refine(self, moving: Raster, mapping: PixelMapping, verified: PixelMapping | None = None) -> DisplacementResult:
        """Fit the displacement field of a mapping, including the field that the mapping already has.

        Returns no field if it does not reduce the residuals of held-out windows significantly. The shifts are measured
        again with the field of each round, as correlation is sharper and large shifts are measured in steps. The
        residual of held-out windows is that of the mapping `verified`, by default `mapping`, with the field.
        """
        shifts = self._measure(moving, mapping)
        gain = self._best_gain(shifts)
        without = DisplacementResult(None, gain.before_p95_px, gain.after_p95_px)
        if not gain.is_significant(_MIN_GAIN_SIGMA):
            return without
        field, total = (
            None if mapping.local is None else mapping.local.on_lattice(self.lattice_px, self.size_px),
            shifts,
        )
        for number in range(_MAX_ROUNDS):
            if number > 0:
                shifts = self._measure(moving, replace(mapping, local=field))
            total = shifts if field is None else shifts.plus(field(shifts.centres_px))
            next_field = self._field(total, gain.smoothness)
            if not _is_one_to_one(next_field, self.size_px):
                return without
            field = next_field
            if number + 1 >= _MIN_ROUNDS and shifts.median_px <= _CONVERGED_PX:
                break
        assert field is not None
        held_out = self._held_out(moving, replace(verified or mapping, local=field), total, gain.smoothness)
        return DisplacementResult(field, gain.before_p95_px, gain.after_p95_px, held_out)

    def _held_out(
        self, moving: Raster, mapping: PixelMapping, total: "Shifts", smoothness: float
    ) -> Residual[FixedImagePx]:
        """Return the cross-validated residual of the verification windows.

        The shifts are measured with the complete mapping, for which correlation is sharp. The total shift of each
        window is compared with a field fitted to windows that share no pixels with it.
        """
        assert mapping.local is not None
        residual = self.verification.residuals(warped(moving, mapping, self.size_px))
        min_distance_px = (self.windows.side + self.verification.side) / 2
        predicted_px = self._cross_predicted(total, residual.centres_px, min_distance_px, smoothness)
        remaining_px = residual.shifts_px + mapping.local(residual.centres_px) - predicted_px
        return Residual.of(residual.centres_px, remaining_px, residual.peaks_sigma)

    def _best_gain(self, shifts: "Shifts") -> "_Gain":
        """Return the gain of the least smooth field with a significant gain, else that of the smoothest field."""
        if len(shifts) < _MIN_WINDOWS:
            return _Gain(_SMOOTHNESS[-1])
        best = min(_SMOOTHNESS, key=lambda s: self._held_out_gain(shifts, s, min_distance_px=_SAME_WINDOW_PX).loss)
        # Held-out windows at a larger distance from those of the fit may require a smoother field.
        for smoothness in (s for s in _SMOOTHNESS if s >= best):
            gain = self._held_out_gain(shifts, smoothness, min_distance_px=self.windows.side)
            if gain.is_significant(_MIN_GAIN_SIGMA):
                break
        return gain

    def _held_out_gain(self, shifts: "Shifts", smoothness: float, min_distance_px: float) -> "_Gain":
        """Return the cross-validated gain of a field, without windows nearer than `min_distance_px` in the fit."""
        predicted = self._cross_predicted(shifts, shifts.centres_px, min_distance_px, smoothness, _GAIN_FOLDS)
        return _gain_of(shifts, np.linalg.norm(shifts.shifts_px - predicted, axis=1), smoothness)

    def _cross_predicted(
        self,
        shifts: "Shifts",
        centres_px: Points,
        min_distance_px: float,
        smoothness: float,
        folds: Iterable[int] = range(_FOLDS**2),
    ) -> Points:
        """Predict the shifts (n, 2) at centres (n, 2) by fields fitted to windows at a minimum distance.

        The distance is the maximum norm. NaN in other folds and where too few windows are left. The robust weights are
        those of a fit to all windows.
        """
        fold = _folds(centres_px)
        weighted = shifts.reweighted(self._field(shifts, smoothness)(shifts.centres_px))
        result = np.full((len(centres_px), 2), np.nan)
        for k in folds:
            is_held_out = fold == k
            is_fitted = ~_near(shifts.centres_px, centres_px[is_held_out], min_distance_px)
            if is_fitted.sum() >= _MIN_WINDOWS // 2:
                field = self._field(weighted.subset(is_fitted), smoothness, reweightings=1)
                result[is_held_out] = field(centres_px[is_held_out])
        return result

    def _field(self, shifts: "Shifts", smoothness: float, reweightings: int = _REWEIGHTINGS) -> DisplacementField:
        return fitted_field(shifts, smoothness, self.lattice_px, self.size_px, reweightings)

    def _measure(self, moving: Raster, mapping: PixelMapping) -> "Shifts":
        return Shifts.of(self.windows.residuals(warped(moving, mapping, self.size_px), min_valid=1.0))


@dataclass(frozen=True)
class Shifts:
    """The measured shifts of windows."""

    centres_px: Points
    """(n, 2)"""
    shifts_px: Points
    """(n, 2)"""
    weights: NDArray[np.float64]
    """(n,) relative inverse variances, median 1: the error of a shift is inversely proportional to the square of the
    peak height."""
    peaks_sigma: NDArray[np.float64]
    """(n,) peak heights, in standard deviations of the correlation surface."""

    @classmethod
    def of(cls, residual: Residual[FixedImagePx]) -> "Shifts":
        """Select the measured shifts of a residual."""
        measured = np.isfinite(residual.shifts_px[:, 0])
        sigma = residual.peaks_sigma[measured]
        weights = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
        return cls(residual.centres_px[measured], residual.shifts_px[measured], weights, sigma)

    @classmethod
    def joined(cls, several: Sequence["Shifts"]) -> "Shifts":
        """Concatenate the shifts of several captures."""
        return cls(
            np.concatenate([s.centres_px for s in several]), np.concatenate([s.shifts_px for s in several]),
            np.concatenate([s.weights for s in several]), np.concatenate([s.peaks_sigma for s in several]),
        )  # fmt: skip

    def subset(self, mask: NDArray[np.bool_]) -> "Shifts":
        """Return the shifts where `mask` (n,) is True."""
        return Shifts(self.centres_px[mask], self.shifts_px[mask], self.weights[mask], self.peaks_sigma[mask])

    def plus(self, shifts_px: Points) -> "Shifts":
        """Return the windows with shifts (n, 2) added."""
        return replace(self, shifts_px=self.shifts_px + shifts_px)

    def reweighted(self, fitted_px: Points) -> "Shifts":
        """Return the windows with weights that are robust to shifts far from the fitted ones (n, 2)."""
        residuals_px = np.linalg.norm(self.shifts_px - fitted_px, axis=1)
        robust = cauchy_weights(residuals_px, _CAUCHY_SCALES * shift_scale_px(residuals_px))
        return replace(self, weights=self.weights * robust)

    @property
    def median_px(self) -> float:
        """Median length of the shifts."""
        return float(np.median(np.linalg.norm(self.shifts_px, axis=1))) if len(self) else math.inf

    def __len__(self) -> int:
        return len(self.centres_px)


_UNKNOWN_PX = FixedImagePx(math.nan)


@dataclass(frozen=True)
class _Gain:
    """Decrease of the residuals of held-out windows by a field."""

    smoothness: float
    before_p95_px: FixedImagePx = _UNKNOWN_PX
    after_p95_px: FixedImagePx = _UNKNOWN_PX
    loss: float = math.inf
    """Weighted mean of log(1 + (shift / 0.1 px)^2) of the remaining shifts, which is robust to wrong peaks and depth
    edges."""
    sigma: float = 0.0
    """Mean decrease of that loss, without weights, in standard errors."""

    def is_significant(self, min_sigma: float) -> bool:
        """Return True if a field reduces the shifts significantly without a larger p95."""
        return self.sigma >= min_sigma and self.after_p95_px <= _MAX_P95_GROWTH * self.before_p95_px


def robust_loss(residual: Residual[FixedImagePx]) -> float:
    """Return the mean of log(1 + (shift / 0.1 px)^2) of the measured windows, infinite without any."""
    lengths = np.linalg.norm(residual.shifts_px, axis=1)
    measured = np.isfinite(lengths)
    return float(_losses(lengths[measured]).mean()) if measured.any() else math.inf


def _losses(lengths_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log(1 + (length / 0.1 px)^2), which is robust to wrong peaks and depth edges."""
    return np.asarray(np.log1p((lengths_px / _LOSS_SCALE_PX) ** 2))


def _gain_of(shifts: Shifts, remaining_px: NDArray[np.float64], smoothness: float) -> _Gain:
    """Return the gain from the lengths (n,) of the remaining shifts, NaN for windows that were not held out."""
    is_compared = np.isfinite(remaining_px) & (shifts.weights >= _MIN_WEIGHT)
    if not is_compared.any():
        return _Gain(smoothness)
    before, after = np.linalg.norm(shifts.shifts_px[is_compared], axis=1), remaining_px[is_compared]
    losses_before, losses = _losses(before), _losses(after)
    decrease = losses_before - losses
    sigma = float(decrease.mean() / max(decrease.std() / math.sqrt(len(decrease)), 1e-12))
    before_p95, after_p95 = (FixedImagePx(np.percentile(lengths, 95)) for lengths in (before, after))
    loss = float(np.average(losses, weights=shifts.weights[is_compared]))
    return _Gain(smoothness, before_p95, after_p95, loss, sigma)


def _folds(centres_px: Points) -> NDArray[np.int64]:
    """Return the fold (n,) of each window.

    A fold contains every fourth window along both axes.
    """
    column, row = (np.unique(centres_px[:, axis], return_inverse=True)[1] for axis in (0, 1))
    return np.asarray(column % _FOLDS + _FOLDS * (row % _FOLDS))


def _near(centres_px: Points, others_px: Points, distance_px: float) -> NDArray[np.bool_]:
    """Return (n,) True for centres (n, 2) nearer than a distance to one of the others (m, 2), in the maximum norm.

    Two windows share pixels if this distance is less than their side.
    """
    if not len(others_px):
        return np.zeros(len(centres_px), dtype=bool)
    nearest, _ = cKDTree(others_px).query(centres_px, p=np.inf)
    return np.asarray(nearest < distance_px)


def common_field(residuals: Sequence[Residual[FixedImagePx]], size_px: tuple[int, int]) -> DisplacementField | None:
    """Fit the displacement field that several captures have in common, on an image (width, height).

    None if it does not reduce the residuals of captures that are left out of the fit.
    """
    captures = [s for s in map(Shifts.of, residuals) if len(s)]
    if len(captures) < _MIN_CAPTURES:
        return None
    count = min(len(captures), _COMMON_FOLDS)
    folds = [captures[k::count] for k in range(count)]

    def fitted(some: Sequence[Shifts], smoothness: float) -> DisplacementField:
        return fitted_field(Shifts.joined(some), smoothness * len(some), _COMMON_LATTICE_PX, size_px)

    def gain(smoothness: float) -> _Gain:
        remaining_px = []
        for fold in folds:
            field = fitted([c for other in folds if other is not fold for c in other], smoothness)
            remaining_px += [np.linalg.norm(c.shifts_px - field(c.centres_px), axis=1) for c in fold]
        return _gain_of(Shifts.joined([c for fold in folds for c in fold]), np.concatenate(remaining_px), smoothness)

    best = min(map(gain, _COMMON_SMOOTHNESS), key=lambda g: g.loss)
    if not best.is_significant(_MIN_COMMON_GAIN_SIGMA):
        return None
    field = fitted([c for fold in folds for c in fold], best.smoothness)
    return field if _is_one_to_one(field, size_px) else None


def fitted_field(
    shifts: Shifts, smoothness: float, lattice_px: int, size_px: tuple[int, int], reweightings: int = _REWEIGHTINGS
) -> DisplacementField:
    """Fit a smooth field d to shifts s at centres x on a grid of nodes:

        min sum_i t_i w_i |d(x_i) - s_i|^2 + smoothness |D2 d|^2 + damping |d|^2

    t are the weights of the shifts, D2 second differences, and w Cauchy weights, which reduce the influence of wrong
    peaks. The small damping makes the problem well-posed far from all windows.

    The normal equations couple nodes at most two rows apart. Their banded matrix is filled directly, because the
    construction of sparse matrices takes longer than the solution.
    """
    # Nodes are numbered along the shorter side of the image, because the time is quadratic in their number there.
    columns, rows = (int(np.ceil(n / lattice_px)) + 1 for n in sorted(size_px))
    order = np.argsort(size_px, kind="stable")
    nodes, bilinear = _interpolation(shifts.centres_px[:, order] / lattice_px, columns, rows)
    penalty = smoothness * _second_difference_form(columns, rows)
    penalty[0] += _DAMPING
    first, second = np.triu_indices(len(nodes))
    elements = (nodes[second] - nodes[first]) * (rows * columns) + nodes[first]
    products = bilinear[first] * bilinear[second]
    weights = shifts.weights
    for number in range(reweightings):
        normal = penalty + _sums(elements, products * weights, penalty.size).reshape(penalty.shape)
        right_side = [_sums(nodes, bilinear * weights * s, rows * columns) for s in shifts.shifts_px.T]
        field = solveh_banded(normal, np.stack(right_side, axis=-1), overwrite_ab=True, lower=True, check_finite=False)
        if number + 1 < reweightings:
            weights = shifts.reweighted((bilinear[..., None] * field[nodes]).sum(axis=0)).weights
    lattice = field.reshape(rows, columns, 2)
    return DisplacementField(float(lattice_px), lattice if order[0] == 0 else lattice.transpose(1, 0, 2).copy())


def _interpolation(points: Points, columns: int, rows: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the four nodes around points (n, 2), in ascending order, and their bilinear weights, each (4, n).

    The points are in units of the node spacing.
    """
    cell = np.clip(np.floor(points).astype(np.int64), 0, (columns - 2, rows - 2))
    (x, y), (column, row) = (points - cell).T, cell.T
    nodes = row * columns + column + np.array([0, 1, columns, columns + 1])[:, None]
    return nodes, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])


def _sums(indices: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return (count,) the sum of the values of each index."""
    return np.asarray(np.bincount(indices.ravel(), values.ravel(), count), np.float64)


@lru_cache(maxsize=8)
def _second_difference_form(columns: int, rows: int) -> NDArray[np.float64]:
    """Return the quadratic form of the squared second differences along both axes as a lower banded matrix.

    Shape (1 + 2 columns, rows columns), as `scipy.linalg.solveh_banded` expects it.
    """
    differences = vstack([
        kron(identity(rows), _second_differences(columns)), kron(_second_differences(rows), identity(columns)),
    ])  # fmt: skip
    form = (differences.T @ differences).tocsr()
    diagonals = [form.diagonal(-k) for k in range(2 * columns + 1)]
    return np.stack([np.pad(d, (0, rows * columns - len(d))) for d in diagonals])


def _second_differences(count: int) -> dia_matrix:
    return diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))


def _is_one_to_one(field: DisplacementField, size_px: tuple[int, int]) -> bool:
    """Return True if x + d(x) does not fold: its Jacobian determinant is positive at four points per node spacing."""
    x = np.arange(0.0, size_px[0], field.step_px / 4)
    y = np.arange(0.0, size_px[1], field.step_px / 4)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    displaced = points + field(points)
    dx, dy = np.diff(displaced, axis=1)[:-1], np.diff(displaced, axis=0)[:, :-1]
    return bool((dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0] > 0).all())
