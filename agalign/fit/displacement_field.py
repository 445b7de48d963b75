"""Smooth displacement fields in addition to a homography, fitted to the residual shifts of windows.

A field is accepted if the p95 of windows that were left out of the fit hardly grows, and the image does not fold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.sparse import diags, identity, kron, vstack

from agalign.fit.held_out import are_apart, every_nth, held_out
from agalign.fit.window_fit import NODE_STEP_PX
from agalign.fit.windows import FixedWindows, Shifts, residual_under
from agalign.pixels.band_resampling import warped
from agalign.pixels.structure import Field
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster
from agalign.values.least_squares import cauchy_weights, mean_in_standard_errors, shift_scale_px
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.residual import Residual, peak_weights

_FIELD_WINDOW_PX = 40
"""Side of the windows in which shifts are measured. On reference tie points of three cameras, smaller ones are as
accurate, and larger ones less."""
_LATTICE_PX = 24
"""Spacing of the field's nodes, as leaves and branches near the camera have parallax at this scale."""
_CAUCHY_SCALES = 4.0
"""Residual at which the robust weight is one half, in residual scales: only wrong peaks have larger ones."""
MIN_WINDOWS = 24
"""Minimum number of windows with a shift for a field, for a relief, and in a band for a test of common parallax; a fit
without one fold may have half as many."""
_NOISE_PX = 0.12
"""Noise of a window with weight 1: half of the windows of sharp images have less."""
_SMOOTHNESS = 0.4
"""Weight of the second differences of a field, relative to such a window: their prior has a standard deviation of
_NOISE_PX / sqrt(_SMOOTHNESS) = 0.19 px. With 2, errors at ties are a sixth larger on three scenes."""
_DAMPING = 0.003
"""Weight of the field itself, relative to such a window: it vanishes far from all windows."""
_MAX_P95_GROWTH = 1.05
"""Maximum ratio of the p95 of held-out windows with a field to that without it, as the p95 is noisy. No significance is
required: held-out windows are predicted without those near them, less accurately than by the complete field, which
decreases errors at tie points by a tenth also where their shifts decrease by less than two standard errors."""
_FOLDS = 3
"""Every third window along both axes is a fold. Without the windows that overlap it, most windows remain: with every
fourth one, which takes twice as long, the p95 of held-out windows differs by up to 3 %, in both directions."""


@dataclass(frozen=True)
class DisplacementResult:
    """A displacement field, and its effect on the residual of held-out windows; no field if that grows too much."""

    field: DisplacementField | None
    before: Residual
    """Held-out windows without the field."""
    held_out: Residual
    """The same windows, each under a field that is fitted without its fold."""


class DisplacementEstimator:
    """Small, overlapping windows of the reference, for fields of any number of moving bands."""

    def __init__(self, valid: Mask, structure: Field) -> None:
        """Cut windows from the structure field (height, width) of the reference with the mask `valid`."""
        max_windows = 5500  # limits the time: their spacing grows in images above 2 megapixels
        step_px = max(_FIELD_WINDOW_PX // 2, round((valid.size / max_windows) ** 0.5))
        min_node_spacings = 0.75  # of windows, which do not determine more nodes
        self.size_px = valid.shape[1], valid.shape[0]
        self.lattice_px = max(_LATTICE_PX, round(min_node_spacings * step_px))
        self.windows = FixedWindows(valid, structure, _FIELD_WINDOW_PX, step_px)
        verification_px = 48  # side of windows without overlap; larger ones are farther from those of the fit
        self.verification = FixedWindows(valid, structure, verification_px)

    def refine(self, moving: Raster, mapping: PixelMapping) -> DisplacementResult | None:
        """Fit the displacement field of a mapping; far from all windows, it is the field that the mapping already has.

        The shifts are measured again with the field of each round until their median is at most 0.2 px, as correlation
        is sharper and large shifts are measured in steps. Returns no field if it folds the image or increases the p95
        of held-out windows beyond _MAX_P95_GROWTH; None if too few windows are measured.
        """
        zero = DisplacementField.sampled(np.zeros_like, self.lattice_px, self.size_px)
        given = zero if mapping.field is None else mapping.field.on_lattice(self.lattice_px, self.size_px)
        field, max_rounds, converged_px = given, 4, 0.2
        for _ in range(max_rounds):
            shifts = self._measure(moving, mapping if field is zero else replace(mapping, field=field))
            beyond_given_px = shifts.shifts_px + field(shifts.centres_px) - given(shifts.centres_px)
            beyond_given = shifts._replace(shifts_px=beyond_given_px)
            if len(shifts.weights) < MIN_WINDOWS:
                return None
            field = given.plus(fitted_field(beyond_given, _SMOOTHNESS, self.lattice_px, self.size_px))
            if np.median(shifts.distances_px()) <= converged_px:
                break
        before, after = self._held_out(moving, mapping, field, given, beyond_given)
        is_verified = after.is_measured.any() and after.p95_px <= _MAX_P95_GROWTH * before.p95_px
        is_used = is_verified and _is_one_to_one(field, self.size_px)
        return DisplacementResult(field if is_used else None, before, after)

    def _measure(self, moving: Raster, mapping: PixelMapping) -> Shifts:
        """Measure the windows; their weights are relative to one with a noise of _NOISE_PX."""
        residual = self.windows.residuals(warped(moving, mapping, self.size_px))
        peaks_sigma = residual.peaks_sigma[residual.is_measured]
        return Shifts.of(residual)._replace(weights=peak_weights(peaks_sigma, _NOISE_PX))

    def _held_out(
        self,
        moving: Raster,
        mapping: PixelMapping,
        field: DisplacementField,
        given: DisplacementField,
        beyond_given: Shifts,
    ) -> tuple[Residual, Residual]:
        """Return the residuals of the verification windows without the field and, cross-validated, with it, which is
        `given` with a field that is fitted to the shifts `beyond_given`.

        The shifts are measured with the complete mapping, for which correlation is sharp.
        """
        with_field = replace(mapping, field=field)
        residual = self.verification.residuals(warped(moving, with_field, self.size_px))
        folds = every_nth(residual, _FOLDS)
        of_folds = (residual.centres_px[folds.numbers == fold] for fold in range(folds.count))
        fields = [self._field_apart_from(of_fold, beyond_given) for of_fold in of_folds]
        by_fold = [None if one is None else replace(mapping, field=given.plus(one)) for one in fields]
        after = held_out(residual, with_field, folds, by_fold)
        before_px = residual_under(residual, with_field, mapping).shifts_px
        before_px[~after.is_measured] = np.nan  # in the same windows
        return residual.with_shifts(before_px), after

    def _field_apart_from(self, held_out_px: Points, shifts: Shifts) -> DisplacementField | None:
        """Fit a field to the shifts of windows that share no pixels with those of a fold, with these centres (n, 2);
        None if too few windows are left.
        """
        reweightings = 2  # the p95 of held-out windows differs by less than 0.001 px from that with four
        apart = are_apart(shifts.centres_px, held_out_px, (self.windows.side + self.verification.side) / 2)
        if apart.sum() < MIN_WINDOWS // 2:
            return None
        return fitted_field(shifts.subset(apart), _SMOOTHNESS, self.lattice_px, self.size_px, reweightings)


def _losses(lengths_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log(1 + (length / 0.1 px)^2), which is robust to wrong peaks and depth edges."""
    scale_px = 0.1  # several times the noise of a shift
    return np.asarray(np.log1p((lengths_px / scale_px) ** 2))


def common_field(residuals: Sequence[Residual], size_px: tuple[int, int]) -> DisplacementField | None:
    """Fit the displacement field that several captures have in common, on an image (width, height).

    None if it does not reduce the residuals of captures that are left out of the fit.
    """
    captures = [s for s in map(Shifts.of, residuals) if len(s.weights)]
    min_captures, max_folds = 3, 4  # more folds take longer and change the errors little
    if len(captures) < min_captures:
        return None
    count = min(len(captures), max_folds)
    folds = [captures[k::count] for k in range(count)]
    every = [c for fold in folds for c in fold]

    def fitted(some: Sequence[Shifts], smoothness: float) -> DisplacementField:
        return fitted_field(Shifts.joined(some), smoothness * len(some), NODE_STEP_PX, size_px)

    def held_out_px(smoothness: float) -> Points:
        predicted_px = []
        for fold in folds:
            field = fitted([c for other in folds if other is not fold for c in other], smoothness)
            predicted_px += [field(c.centres_px) for c in fold]
        return compared.shifts_px - np.concatenate(predicted_px)[is_compared]

    joined, min_weight = Shifts.joined(every), 0.1  # parallax within a window lowers its peak
    is_compared = joined.weights >= min_weight
    compared = joined.subset(is_compared)
    candidates = 1.0, 4.0, 16.0, 64.0  # relative to one window of each capture
    lengths_px = {smoothness: np.linalg.norm(held_out_px(smoothness), axis=1) for smoothness in candidates}
    best = min(candidates, key=lambda smoothness: np.average(_losses(lengths_px[smoothness]), weights=compared.weights))
    if not _are_decreased(compared.distances_px(), lengths_px[best]):
        return None
    field = fitted(every, best)
    return field if _is_one_to_one(field, size_px) else None


def _are_decreased(before_px: NDArray[np.float64], after_px: NDArray[np.float64]) -> bool:
    """Return True if the lengths (n,) of shifts decrease significantly, and their p95 hardly grows."""
    # Less than within one capture, as captures that are left out have only their lenses in common with the others.
    min_decrease = 2.5  # standard errors
    before_p95_px, after_p95_px = (np.percentile(lengths_px, 95) for lengths_px in (before_px, after_px))
    decrease = mean_in_standard_errors(_losses(before_px) - _losses(after_px))
    return bool(decrease >= min_decrease and after_p95_px <= _MAX_P95_GROWTH * before_p95_px)


def fitted_field(
    shifts: Shifts, smoothness: float, lattice_px: int, size_px: tuple[int, int], reweightings: int = 4
) -> DisplacementField:
    """Fit a smooth field d to shifts s at centres x on a grid of nodes:

        min sum_i t_i w_i |d(x_i) - s_i|^2 + smoothness |D2 d|^2 + damping |d|^2

    t are the weights of the shifts, D2 second differences, and w Cauchy weights, which reduce the influence of wrong
    peaks and converge in four iterations. The small damping makes the problem well-posed far from all windows.

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
            fitted_px = (bilinear[..., None] * field[nodes]).sum(axis=0)
            residuals_px = shifts.distances_px(fitted_px)
            weights = shifts.weights * cauchy_weights(residuals_px, _CAUCHY_SCALES * shift_scale_px(residuals_px))
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
    along_x, along_y = (diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count)) for count in (columns, rows))
    differences = vstack([kron(identity(rows), along_x), kron(along_y, identity(columns))])
    form = (differences.T @ differences).tocsr()
    diagonals = [form.diagonal(-k) for k in range(2 * columns + 1)]
    return np.stack([np.pad(d, (0, rows * columns - len(d))) for d in diagonals])


def _is_one_to_one(field: DisplacementField, size_px: tuple[int, int]) -> bool:
    """Return True if x + d(x) does not fold: its Jacobian determinant is positive at four points per node spacing."""
    x = np.arange(0.0, size_px[0], field.step_px / 4)
    y = np.arange(0.0, size_px[1], field.step_px / 4)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    displaced = points + field(points)
    dx, dy = np.diff(displaced, axis=1)[:-1], np.diff(displaced, axis=0)[:, :-1]
    return bool((dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0] > 0).all())
