"""Displacement fields over a homography, for parallax: smooth, fitted to the residual shifts of windows.

A field is kept only where it explains windows that it was not fitted to, and where it does not fold the image.
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
from agalign.values.alignment import DisplacementField, DisplacementResult, Residual
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx
from agalign.values.robust import MAD_TO_STD, cauchy_weights
from agalign.verify.residuals import FixedWindows


@dataclass(frozen=True)
class FieldScale:
    """How fine a displacement field is, px."""

    window_px: int
    """Side of the windows in which shifts are measured; they overlap by half."""
    lattice_px: int
    """Spacing of the field's nodes."""
    verification_px: int = 48
    """Side of the windows in which the field is verified: small enough to be close to windows that take part in the
    fit, since none that shares a pixel does."""


LENS = FieldScale(window_px=48, lattice_px=96)
"""For what lenses leave under a relief: it changes over hundreds of pixels."""
COARSE = FieldScale(window_px=64, lattice_px=48)
FINE = FieldScale(window_px=32, lattice_px=24, verification_px=32)
"""For plants and walls that are too high above the ground for the coarse field to follow."""

_MAX_WINDOWS = 4000
"""In larger images the windows are farther apart: it bounds the time, and a field is smooth."""
_MIN_LATTICE_SHARE = 0.75
"""Spacing of the nodes relative to that of the windows, at least: more nodes would follow nothing that was measured."""
_SMOOTHNESS = (0.3, 1.0, 4.0, 16.0, 64.0)
"""Weights of the field's second differences relative to the shift of one window; cross-validation chooses."""
_PULL = 0.003
"""Weight of the field's own length, likewise: it decides only where nothing was measured."""
_MIN_SPREAD_PX, _OUTLIER_SPREADS = 0.05, 4.0
"""A window has half its weight at four times the typical misfit: only wrong peaks are farther out. Misfits below 0.05
px are the noise of shifts."""
_REWEIGHTINGS = 4
"""A fixed number, enough for the weights to settle."""
_ROUNDS, _SETTLED_PX, _MAX_ROUNDS = 2, 0.2, 4
"""Shifts are measured twice, and again, up to four times, while their median is above 0.2 px: long shifts are found in
steps."""
_MIN_WINDOWS = 24
"""Windows with a shift without which no field is fitted; a fit without a fold may have half as many."""
_MIN_GAIN_SIGMA = 4.0
"""A field is kept where the squared shifts of held-out windows fall by as many standard errors."""
_FAR_PX = 0.1
"""Scale on which residual shifts are compared: several times the noise of a shift."""
_MIN_CAPTURES, _COMMON_FOLDS = 3, 4
"""A field of the lenses needs captures to leave out; four folds leave out a quarter at a time."""
_COMMON_SMOOTHNESS = (1.0, 4.0, 16.0, 64.0)
"""As `_SMOOTHNESS`, relative to one window of each capture, for the field that the lenses cause."""
_MIN_COMMON_GAIN_SIGMA, _MAX_COMMON_P95_GROWTH = 2.5, 1.05
"""Less strict than within one capture: whole captures that are left out share only their lenses."""
_ITSELF_PX = 1.0
"""Two windows of one grid that are nearer are the same."""
_ALL_FOLDS = range(16)
_SOME_FOLDS = (0, 2, 8, 10)
"""Far enough apart to choose the smoothness by."""
_MIN_TRUST = 0.1
"""Windows with a lower relative weight do not take part in the comparison: parallax within a window lowers its peak
too."""


class DisplacementEstimator:
    """The reference cut into small, overlapping windows, ready for any number of moving bands."""

    def __init__(self, valid: Mask, structure: Field, scale: FieldScale, windows: FixedWindows | None = None) -> None:
        """`valid` and `structure` (height, width) are those of the reference; a field is fitted in its `windows`, by
        default all over the image.
        """
        self._valid, self._structure, self._verification_px = valid, structure, scale.verification_px
        step_px = max(scale.window_px // 2, round((valid.size / _MAX_WINDOWS) ** 0.5))
        self.size_px = valid.shape[1], valid.shape[0]
        self.lattice_px = max(scale.lattice_px, round(_MIN_LATTICE_SHARE * step_px))
        self.windows = windows or FixedWindows(valid, structure, scale.window_px, step_px)

    @cached_property
    def verification(self) -> FixedWindows:
        """The windows in which a field is verified, side by side."""
        return FixedWindows(self._valid, self._structure, self._verification_px)

    def refine(
        self, moving: Raster, mapping: PixelMapping, *, verify: bool = False
    ) -> DisplacementResult[FixedImagePx]:
        """The field over a mapping, including the displacements that it already has, and its gain on held-out windows.

        The shifts are measured again under the field of each round: windows over steps become sharper, and long shifts
        are found in steps. To `verify` is to leave windows out of the fit that is kept.
        """
        first = self._measure(moving, mapping)
        gain = self._best_gain(first)
        if not gain.is_plain(_MIN_GAIN_SIGMA):
            return DisplacementResult(None, gain.before_p95_px, gain.after_p95_px)
        before = None if mapping.local is None else mapping.local.on_lattice(self.lattice_px, self.size_px)
        field = before
        for number in range(_MAX_ROUNDS):
            residual = first if number == 0 else self._measure(moving, replace(mapping, local=field))
            more = self._field(Shifts.of(residual), gain.smoothness)
            total = more if field is None else field.plus(more)
            if not _is_one_to_one(total, self.size_px):
                break
            field = total
            if number + 1 >= _ROUNDS and residual.median_px <= _SETTLED_PX:
                break
        if field is None or field is before:
            return DisplacementResult(None, gain.before_p95_px, gain.after_p95_px)
        result = DisplacementResult[FixedImagePx](field, gain.before_p95_px, gain.after_p95_px)
        if not verify:
            return result
        return replace(result, held_out=self._held_out(moving, replace(mapping, local=field), field, gain.smoothness))

    def _held_out(
        self, moving: Raster, mapping: PixelMapping, field: DisplacementField, smoothness: float
    ) -> Residual[FixedImagePx]:
        """The residual of windows, each under a field that all windows which share a pixel with it are
        left out of. Shifts are measured under the complete mapping, where the windows are sharp; the whole shift of
        each is compared with the one that the others predict.
        """
        shifts = Shifts.of(self._measure(moving, mapping))
        whole = replace(shifts, shifts_px=shifts.shifts_px + field(shifts.centres_px))
        residual = self.verification.residuals(warped(moving, mapping, self.size_px))
        apart_px = (self.windows.side + self.verification.side) / 2
        predicted_px = self._left_out(whole, residual.centres_px, apart_px, smoothness)
        left_px = residual.shifts_px + field(residual.centres_px) - predicted_px
        return Residual.of(residual.centres_px, left_px, residual.peaks_sigma)

    def _best_gain(self, first: Residual[FixedImagePx]) -> "_Gain":
        """The gain of the first smoothness with a plain gain, from the finest upwards; else that of the last."""
        some = [self._held_out_gain(first, s, _SOME_FOLDS, apart_px=0) for s in _SMOOTHNESS]
        finest = min(some, key=lambda g: g.left).smoothness
        # Held-out windows that are farther from those of the fit may only support a smoother field.
        for smoothness in (s for s in _SMOOTHNESS if s >= finest):
            gain = self._held_out_gain(first, smoothness, _ALL_FOLDS, apart_px=self.windows.side)
            if gain.is_plain(_MIN_GAIN_SIGMA):
                break
        return gain

    def _held_out_gain(
        self, residual: Residual[FixedImagePx], smoothness: float, folds: Iterable[int], apart_px: float
    ) -> "_Gain":
        """Leaves windows out in turn, and with them those nearer to one of them than `apart_px`."""
        shifts = Shifts.of(residual)
        if len(shifts) < _MIN_WINDOWS:
            return _Gain(smoothness)
        predicted = self._left_out(shifts, shifts.centres_px, apart_px, smoothness, folds)
        return _gain_of(shifts, np.linalg.norm(shifts.shifts_px - predicted, axis=1), smoothness)

    def _left_out(
        self,
        shifts: "Shifts",
        centres_px: Points,
        apart_px: float,
        smoothness: float,
        folds: Iterable[int] = _ALL_FOLDS,
    ) -> Points:
        """(n, 2) shifts at centres (n, 2), each by a field through those of the windows that are at least `apart_px`
        away along one axis; NaN in folds not tried.
        """
        fold = _folds(centres_px)
        result = np.full((len(centres_px), 2), np.nan)
        for k in folds:
            out = fold == k
            kept = ~_near(shifts.centres_px, centres_px[out], max(apart_px, _ITSELF_PX))
            if kept.sum() >= _MIN_WINDOWS // 2:
                result[out] = self._field(shifts.some(kept), smoothness)(centres_px[out])
        return result

    def _field(self, shifts: "Shifts", smoothness: float) -> DisplacementField:
        return fitted_field(shifts, smoothness, self.lattice_px, self.size_px)

    def _measure(self, moving: Raster, mapping: PixelMapping) -> Residual[FixedImagePx]:
        return self.windows.residuals(warped(moving, mapping, self.size_px), min_valid=1.0)


@dataclass(frozen=True)
class Shifts:
    """The windows with a measured shift."""

    centres_px: Points
    shifts_px: Points
    trust: NDArray[np.float64]
    """(n,) relative weights, 1 in the median: inverse variances, as the error of a shift falls with the square of its
    peak's height."""
    peaks_sigma: NDArray[np.float64]
    """(n,) heights of the peaks, standard deviations."""

    @classmethod
    def of(cls, residual: Residual[FixedImagePx]) -> "Shifts":
        known = np.isfinite(residual.shifts_px[:, 0])
        sigma = residual.peaks_sigma[known]
        trust = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
        return cls(residual.centres_px[known], residual.shifts_px[known], trust, sigma)

    @classmethod
    def together(cls, several: Sequence["Shifts"]) -> "Shifts":
        """The windows of several captures in one."""
        return cls(
            np.concatenate([s.centres_px for s in several]), np.concatenate([s.shifts_px for s in several]),
            np.concatenate([s.trust for s in several]), np.concatenate([s.peaks_sigma for s in several]),
        )  # fmt: skip

    def some(self, which: NDArray[np.bool_]) -> "Shifts":
        return Shifts(self.centres_px[which], self.shifts_px[which], self.trust[which], self.peaks_sigma[which])

    def __len__(self) -> int:
        return len(self.centres_px)


_UNKNOWN_PX = FixedImagePx(math.nan)


@dataclass(frozen=True)
class _Gain:
    """The gain of a field on windows left out of its fit."""

    smoothness: float
    before_p95_px: FixedImagePx = _UNKNOWN_PX
    after_p95_px: FixedImagePx = _UNKNOWN_PX
    left: float = math.inf
    """Mean log(1 + (shift / 0.1 px)^2) of the remaining shifts, weighted by trust: wrong peaks and the edges of trees,
    which no smooth field follows, hardly count."""
    sigma: float = 0.0
    """Mean fall of the squared shifts, in standard errors of that mean."""

    def is_plain(self, min_sigma: float) -> bool:
        """True where a field helps on the whole and does not make the worst windows worse."""
        return self.sigma >= min_sigma and self.after_p95_px <= self.before_p95_px


def _gain_of(shifts: Shifts, left: NDArray[np.float64], smoothness: float) -> _Gain:
    """From the lengths `left` (n,) of the remaining shifts, px, nan for windows that were not left out."""
    tried = np.isfinite(left) & (shifts.trust >= _MIN_TRUST)
    if not tried.any():
        return _Gain(smoothness)
    before, after = np.linalg.norm(shifts.shifts_px[tried], axis=1), left[tried]
    # Wrong peaks must not decide: a length counts up to twice the 95th percentile.
    maximum = 2 * np.percentile(before, 95)
    fall = np.minimum(before, maximum) ** 2 - np.minimum(after, maximum) ** 2
    sigma = fall.mean() / max(fall.std() / math.sqrt(len(fall)), 1e-12)
    left_over = float(np.average(np.log1p((after / _FAR_PX) ** 2), weights=shifts.trust[tried]))
    before_p95, after_p95 = (FixedImagePx(np.percentile(lengths, 95)) for lengths in (before, after))
    return _Gain(smoothness, before_p95, after_p95, left_over, float(sigma))


def _folds(centres_px: Points) -> NDArray[np.int64]:
    """(n,) the fold in which each window is left out: every fourth along both axes, so that between two of them there
    is one that overlaps neither.
    """
    column, row = (np.unique(centres_px[:, axis], return_inverse=True)[1] for axis in (0, 1))
    return np.asarray(column % 4 + 4 * (row % 4))


def _near(centres_px: Points, others_px: Points, apart_px: float) -> NDArray[np.bool_]:
    """(n,) True for windows (n, 2) nearer than this, along both axes, to one of the others (m, 2): two windows share a
    pixel where they are nearer than their side.
    """
    if not len(others_px):
        return np.zeros(len(centres_px), dtype=bool)
    nearest, _ = cKDTree(others_px).query(centres_px, p=np.inf)
    return np.asarray(nearest < apart_px)


def common_field(residuals: Sequence[Residual[FixedImagePx]], size_px: tuple[int, int]) -> DisplacementField | None:
    """The smooth field that the windows of several captures have in common, on an image (width, height).

    None where it does not explain captures that are left out of its fit: the lenses are the same in all.
    """
    captures = [s for s in map(Shifts.of, residuals) if len(s)]
    if len(captures) < _MIN_CAPTURES:
        return None
    count = min(len(captures), _COMMON_FOLDS)
    folds = [captures[k::count] for k in range(count)]

    def fitted(some: Sequence[Shifts], smoothness: float) -> DisplacementField:
        return fitted_field(Shifts.together(some), smoothness * len(some), COARSE.lattice_px, size_px)

    def gain(smoothness: float) -> _Gain:
        left = []
        for fold in folds:
            field = fitted([c for other in folds if other is not fold for c in other], smoothness)
            left += [np.linalg.norm(c.shifts_px - field(c.centres_px), axis=1) for c in fold]
        return _gain_of(Shifts.together([c for fold in folds for c in fold]), np.concatenate(left), smoothness)

    best = min(map(gain, _COMMON_SMOOTHNESS), key=lambda g: g.left)
    if best.sigma < _MIN_COMMON_GAIN_SIGMA or best.after_p95_px > _MAX_COMMON_P95_GROWTH * best.before_p95_px:
        return None
    field = fitted([c for fold in folds for c in fold], best.smoothness)
    return field if _is_one_to_one(field, size_px) else None


def fitted_field(shifts: Shifts, smoothness: float, lattice_px: int, size_px: tuple[int, int]) -> DisplacementField:
    """The smooth field d through shifts s at centres x: on a lattice,

        min sum_i t_i w_i |d(x_i) - s_i|^2 + smoothness |D2 d|^2 + pull |d|^2

    with trust t, second differences D2, and Cauchy weights w against wrong peaks. The pull to 0 is small: it decides
    where nothing was measured.

    The normal equations couple nodes at most two rows apart, so they are solved as a banded matrix, which is filled
    directly: with sparse matrices, their construction took most of the time of an alignment.
    """
    # The nodes are numbered along the shorter side of the image: the time grows with the square of their number there.
    columns, rows = (int(np.ceil(n / lattice_px)) + 1 for n in sorted(size_px))
    order = np.argsort(size_px, kind="stable")
    nodes, weights = _interpolation(shifts.centres_px[:, order] / lattice_px, columns, rows)
    penalty = smoothness * _bending(columns, rows)
    penalty[0] += _PULL
    first, second = np.triu_indices(len(nodes))
    places = (nodes[second] - nodes[first]) * (rows * columns) + nodes[first]
    products = weights[first] * weights[second]
    trust = shifts.trust
    for _ in range(_REWEIGHTINGS):
        normal = penalty + _sums(places, products * trust, penalty.size).reshape(penalty.shape)
        right = [_sums(nodes, weights * trust * s, rows * columns) for s in shifts.shifts_px.T]
        field = solveh_banded(normal, np.stack(right, axis=-1), overwrite_ab=True, lower=True, check_finite=False)
        fitted = (weights[..., None] * field[nodes]).sum(axis=0)
        off = np.linalg.norm(shifts.shifts_px - fitted, axis=1)
        spread = max(MAD_TO_STD * float(np.median(off)), _MIN_SPREAD_PX)
        trust = shifts.trust * cauchy_weights(off, _OUTLIER_SPREADS * spread)
    lattice = field.reshape(rows, columns, 2)
    return DisplacementField(float(lattice_px), lattice if order[0] == 0 else lattice.transpose(1, 0, 2).copy())


def _interpolation(points: Points, columns: int, rows: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(4, n) each: the nodes around points in steps of the lattice, in ascending order, and their bilinear weights."""
    cell = np.clip(np.floor(points).astype(np.int64), 0, (columns - 2, rows - 2))
    (x, y), (column, row) = (points - cell).T, cell.T
    nodes = row * columns + column + np.array([0, 1, columns, columns + 1])[:, None]
    return nodes, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])


def _sums(places: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(count,): the sum of the values at each place."""
    return np.asarray(np.bincount(places.ravel(), values.ravel(), count), np.float64)


@lru_cache(maxsize=8)
def _bending(columns: int, rows: int) -> NDArray[np.float64]:
    """(1 + 2 columns, rows columns): the quadratic form of the squared second differences along both axes, as the main
    diagonal and those below it, each from its first element.
    """
    bend = vstack([
        kron(identity(rows), _second_differences(columns)), kron(_second_differences(rows), identity(columns)),
    ])  # fmt: skip
    form = (bend.T @ bend).tocsr()
    diagonals = [form.diagonal(-below) for below in range(2 * columns + 1)]
    return np.stack([np.pad(d, (0, rows * columns - len(d))) for d in diagonals])


def _second_differences(count: int) -> dia_matrix:
    return diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))


def _is_one_to_one(field: DisplacementField, size_px: tuple[int, int]) -> bool:
    """True where x + d(x) folds nowhere: its Jacobian is positive at four points a step of the lattice."""
    x = np.arange(0.0, size_px[0], field.step_px / 4)
    y = np.arange(0.0, size_px[1], field.step_px / 4)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    displaced = points + field(points)
    by_x, by_y = np.diff(displaced, axis=1)[:-1], np.diff(displaced, axis=0)[:, :-1]
    return bool((by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0] > 0).all())
