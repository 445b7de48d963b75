"""When one plane is not enough: a smooth field of displacements over the homography, from the shifts that windows of
the two bands still show. It is kept only where it explains windows that it was not fitted to, and it never folds.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, dia_matrix, diags, identity, kron, vstack
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from agalign.config import CheckSettings, LocalScale, LocalSettings
from agalign.pixels.resample import warped
from agalign.pixels.structure import Field
from agalign.values.alignment import DisplacementField, DisplacementResult, Residual
from agalign.values.geometry import Points
from agalign.values.image import Mask, Raster
from agalign.values.mapping import PixelMapping
from agalign.verify.residuals import FixedWindows


class DisplacementEstimator:
    """The reference cut into small, overlapping windows, ready for any number of moving bands."""

    def __init__(
        self, valid: Mask, structure: Field, settings: LocalSettings, check: CheckSettings, scale: LocalScale
    ) -> None:
        """`valid` and `structure` (height, width) are the reference's."""
        self.settings, self.size_px, self.lattice_px = settings, (valid.shape[1], valid.shape[0]), scale.lattice_px
        step = max(scale.window_px // 2, round((valid.size / settings.max_windows) ** 0.5))
        small = check.model_copy(update={"tile_px": scale.window_px})
        self.windows = FixedWindows(valid, structure, small, step)

    def refine(self, moving: Raster, mapping: PixelMapping) -> DisplacementResult:
        """The field over a mapping, with the displacements that it has already, and what it gains on windows that it
        was not fitted to.

        The shifts are measured again after each round, under the field so far: windows over steps sharpen so, and long
        shifts are found in steps.
        """
        before = None if mapping.local is None else mapping.local.on_lattice(self.lattice_px, self.size_px)
        first = self._measure(moving, mapping)
        some = [self._held_out_gain(first, s, _SOME_FOLDS, apart_px=0) for s in self.settings.smoothness]
        finest = min(some, key=lambda g: g.left).smoothness
        # Windows that lie farther from those of the fit may know a smoother field only.
        for smoothness in (s for s in self.settings.smoothness if s >= finest):
            gain = self._held_out_gain(first, smoothness, _ALL_FOLDS, apart_px=self.windows.side)
            if gain.is_plain(self.settings.min_gain_sigma):
                break
        else:
            return DisplacementResult(None, gain.before_p95_px, gain.after_p95_px)
        field = before
        for number in range(self.settings.max_rounds):
            result = first if number == 0 else self._measure(moving, replace(mapping, local=field))
            more = self._field(Shifts.of(result), gain.smoothness)
            total = more if field is None else field.plus(more)
            if not _is_one_to_one(total, self.size_px):
                break
            field = total
            if number + 1 >= self.settings.rounds and result.median_px <= self.settings.settled_px:
                break
        return DisplacementResult(None if field is before else field, gain.before_p95_px, gain.after_p95_px)

    def _held_out_gain(self, residual: Residual, smoothness: float, folds: Iterable[int], apart_px: float) -> "_Gain":
        """Windows are left out in turn, and with them from the fit all nearer than `apart_px` to one of them."""
        result = Shifts.of(residual)
        if len(result) < self.settings.min_windows:
            return _Gain(smoothness)
        fold = _folds(result.centres_px)
        left = np.full(len(result), np.nan)
        for k in folds:
            out = fold == k
            kept = ~out & ~_near(result.centres_px, result.centres_px[out], apart_px)
            if kept.sum() >= self.settings.min_windows // 2:
                field = self._field(result.some(kept), smoothness)
                left[out] = np.linalg.norm(result.shifts_px[out] - field(result.centres_px[out]), axis=1)
        return _gain_of(result, left, smoothness)

    def _field(self, result: "Shifts", smoothness: float) -> DisplacementField:
        return fitted_field(result, smoothness, self.settings, self.lattice_px, self.size_px)

    def _measure(self, moving: Raster, mapping: PixelMapping) -> Residual:
        return self.windows.residuals(warped(moving, mapping, self.size_px), min_valid=1.0)


_FAR_PX = 0.1
_MIN_CAPTURES = 3
_COMMON_FOLDS = 4
_COMMON_SMOOTHNESS = (1.0, 4.0, 16.0, 64.0)
"""Of what is the lenses' own, beside one window of each capture."""
_MIN_COMMON_GAIN_SIGMA, _NO_WORSE = 2.5, 1.05
"""Less than of one capture's windows: whole captures that are left out share nothing but their lenses."""
_ALL_FOLDS = range(16)
_SOME_FOLDS = (0, 2, 8, 10)
"""Far enough apart to say how smooth a field should be."""
_MIN_TRUST = 0.1
"""Of windows that are asked what a field explains; parallax within a window lowers its peak too."""


@dataclass(frozen=True)
class Shifts:
    """The windows in which a shift was found."""

    centres_px: Points
    shifts_px: Points
    trust: NDArray[np.float64]
    """(n,) relative weights, 1 in the median: inverse variances, as the error of a shift falls with the square of how
    far its peak stands out."""

    @classmethod
    def of(cls, residual: Residual) -> "Shifts":
        known = np.isfinite(residual.shifts_px[:, 0])
        sigma = residual.peaks_sigma[known]
        trust = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
        return cls(residual.centres_px[known], residual.shifts_px[known], trust)

    @classmethod
    def together(cls, several: Sequence["Shifts"]) -> "Shifts":
        """The windows of several captures as one's."""
        return cls(
            np.concatenate([s.centres_px for s in several]), np.concatenate([s.shifts_px for s in several]),
            np.concatenate([s.trust for s in several]),
        )  # fmt: skip

    def some(self, which: NDArray[np.bool_]) -> "Shifts":
        return Shifts(self.centres_px[which], self.shifts_px[which], self.trust[which])

    def __len__(self) -> int:
        return len(self.centres_px)


@dataclass(frozen=True)
class _Gain:
    """What a field gains on windows left out of its fit."""

    smoothness: float
    before_p95_px: float = math.nan
    after_p95_px: float = math.nan
    left: float = math.inf
    """What is left, on a scale on which wrong peaks and the edges of trees, which no smooth field follows, hardly
    count: mean log(1 + (shift / 0.1 px)^2), weighted by trust."""
    sigma: float = 0.0
    """Mean fall of the squared shifts, in standard errors of that mean."""

    def is_plain(self, min_sigma: float) -> bool:
        """True where a field helps on the whole and makes the worst windows no worse."""
        return self.sigma >= min_sigma and self.after_p95_px <= self.before_p95_px


def _gain_of(result: Shifts, left: NDArray[np.float64], smoothness: float) -> _Gain:
    """From what is `left` (n,) of the shifts, px, nan for windows that were not left out."""
    # What is measured badly says little of a field.
    tried = np.isfinite(left) & (result.trust >= _MIN_TRUST)
    if not tried.any():
        return _Gain(smoothness)
    before, after = np.linalg.norm(result.shifts_px[tried], axis=1), left[tried]
    # Wrong peaks must not decide: what lies far out counts no more than twice the 95th percentile.
    maximum = 2 * np.percentile(before, 95)
    fall = np.minimum(before, maximum) ** 2 - np.minimum(after, maximum) ** 2
    sigma = fall.mean() / max(fall.std() / math.sqrt(len(fall)), 1e-12)
    what_is_left = float(np.average(np.log1p((after / _FAR_PX) ** 2), weights=result.trust[tried]))
    before_p95, after_p95 = (float(np.percentile(shifts, 95)) for shifts in (before, after))
    return _Gain(smoothness, before_p95, after_p95, what_is_left, float(sigma))


def _folds(centres_px: Points) -> NDArray[np.int64]:
    """(n,) which fold each window is left out in: every fourth along both axes, so that between two of them there is
    one that overlaps neither.
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


def common_field(
    residuals: Sequence[Residual], settings: LocalSettings, size_px: tuple[int, int]
) -> DisplacementField | None:
    """The smooth field that the windows of several captures have in common, on an image (width, height).

    None where it does not explain captures that are left out of its fit: what is the lenses' is the same in all.
    """
    captures = [s for s in map(Shifts.of, residuals) if len(s)]
    if len(captures) < _MIN_CAPTURES:
        return None
    lattice_px = settings.scale.lattice_px
    folds = [captures[k :: min(len(captures), _COMMON_FOLDS)] for k in range(min(len(captures), _COMMON_FOLDS))]
    out = Shifts.together([c for fold in folds for c in fold])

    def gain(smoothness: float) -> _Gain:
        left = []
        for fold in folds:
            rest = [c for other in folds if other is not fold for c in other]
            field = fitted_field(Shifts.together(rest), smoothness * len(rest), settings, lattice_px, size_px)
            left += [np.linalg.norm(c.shifts_px - field(c.centres_px), axis=1) for c in fold]
        return _gain_of(out, np.concatenate(left), smoothness)

    best = min(map(gain, _COMMON_SMOOTHNESS), key=lambda g: g.left)
    if best.sigma < _MIN_COMMON_GAIN_SIGMA or best.after_p95_px > _NO_WORSE * best.before_p95_px:
        return None
    field = fitted_field(out, best.smoothness * len(captures), settings, lattice_px, size_px)
    return field if _is_one_to_one(field, size_px) else None


def fitted_field(
    result: Shifts, smoothness: float, settings: LocalSettings, lattice_px: int, size_px: tuple[int, int]
) -> DisplacementField:
    """The smooth field d through shifts s at centres x: on a lattice,

        min sum_i t_i w_i |d(x_i) - s_i|^2 + smoothness |D2 d|^2 + pull |d|^2

    with trust t, second differences D2, and Cauchy weights w against windows that found a wrong peak. The pull to
    nothing is small: it decides where nothing was measured.
    """
    step = lattice_px
    columns, rows = (int(np.ceil(n / step)) + 1 for n in size_px)
    design = _interpolation(result.centres_px / step, columns, rows)
    penalty = smoothness * _bending(columns, rows) + settings.pull * identity(rows * columns)
    weight = np.ones(len(result))
    nodes = np.zeros((rows * columns, 2))
    for _ in range(settings.reweightings):
        weighted = design.T @ diags(result.trust * weight)
        nodes = splu((weighted @ design + penalty).tocsc()).solve(weighted @ result.shifts_px)
        off = np.linalg.norm(result.shifts_px - design @ nodes, axis=1)
        spread = max(1.4826 * float(np.median(off)), settings.min_spread_px)
        weight = 1 / (1 + (off / (settings.outlier_spreads * spread)) ** 2)
    return DisplacementField(float(step), nodes.reshape(rows, columns, 2))


def _interpolation(at: Points, columns: int, rows: int) -> csr_matrix:
    """(n, rows columns): bilinear weights of the lattice's nodes at points in its steps."""
    cell = np.clip(np.floor(at).astype(int), 0, (columns - 2, rows - 2))
    part = at - cell
    entries = []
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            entries.append((weight, np.arange(len(at)), (cell[:, 1] + dy) * columns + cell[:, 0] + dx))
    weights, which, nodes = (np.concatenate(column) for column in zip(*entries, strict=True))
    return coo_matrix((weights, (which, nodes)), shape=(len(at), rows * columns)).tocsr()


@lru_cache(maxsize=8)
def _bending(columns: int, rows: int) -> csr_matrix:
    """(rows columns, rows columns): the quadratic form of the squared second differences along both axes."""
    bend = vstack([
        kron(identity(rows), _second_differences(columns)), kron(_second_differences(rows), identity(columns)),
    ])  # fmt: skip
    return (bend.T @ bend).tocsr()


def _second_differences(count: int) -> dia_matrix:
    return diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))


def _is_one_to_one(field: DisplacementField, size_px: tuple[int, int]) -> bool:
    """True where x + d(x) folds nowhere: its Jacobian is positive at four points a step of the lattice."""
    x = np.arange(0.0, size_px[0], field.step_px / 4)
    y = np.arange(0.0, size_px[1], field.step_px / 4)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    there = points + field(points)
    by_x, by_y = np.diff(there, axis=1)[:-1], np.diff(there, axis=0)[:, :-1]
    return bool((by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0] > 0).all())
