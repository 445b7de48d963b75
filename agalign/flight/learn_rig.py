"""The rig of a flight fitted to the mappings of some of its captures, with its error by cross-validation."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.flight.factors import (
    MIN_STD_PX,
    affine_difference,
    displaced,
    factor_design,
    factor_mask,
    mapping_weight,
    median_mapping,
    solve_factors,
)
from agalign.flight.rig import MIN_CAPTURES, CaptureFactors, Factor, Observation, Rig
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import MovingFilePx
from agalign.values.robust import cauchy_weights

Array = NDArray[np.float64]

_SETS: tuple[tuple[Factor, ...], ...] = (
    (), ("distance",), ("distance", "tilt"), ("distance", "reference"), ("distance", "tilt", "reference"),
    ("distance", "motion"), ("distance", "tilt", "motion"),
)  # fmt: skip
_SETS_IN_MOTION: tuple[tuple[Factor, ...], ...] = (
    (), ("motion",), ("distance", "motion"), ("distance", "tilt", "motion"), ("distance",), ("distance", "tilt"),
)  # fmt: skip
"""Where the tags have the ground's motion: to and fro along one line it looks like another distance."""
_LAYOUT_STD = 0.015
"""Standard error of a camera model's layout of lenses, in lengths of all baselines together."""
_MAX_ROUNDS = 20
"""Of alternating least squares."""
_CONVERGED_PX, _CONVERGED = 1e-4, 1e-5
"""Changes of the means, px, and of the baselines, of length 1 together, below which a round is the last."""
_MAX_FOLDS = 12
"""Of the cross-validation: more take longer and change little."""
_MAX_ERROR_SHARE = 0.9
"""Further factors must reduce the error of captures left out to this share."""


def learn_rig(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: Mapping[str, tuple[float, float]]
) -> Rig | None:
    """The rig that some captures show; None where fewer than three show the same band.

    `layout` has the position of each band's lens as far as it is known, in any unit.
    """
    counts = Counter(b for c in captures for b in c.mappings)
    bands = tuple(b for b, count in counts.items() if count >= MIN_CAPTURES)
    captures = [c for c in captures if any(b in c.mappings for b in bands)]
    if not bands:
        return None
    table = _Table.of(captures, bands, size_px, _normalised_layout(layout, bands))
    factors, errors_px = _choose_factors(
        table, motion_known=sum(c.motion is not None for c in captures) >= MIN_CAPTURES
    )
    fitted = table.fit(np.ones(len(captures)), factors or ("distance",))
    by_band = zip(bands, table.median, fitted.offset, fitted.t, strict=True)
    mean, baselines = dict[str, Matrix](), dict[str, tuple[float, float]]()
    for band, median, offset, t in by_band:
        mean[band], baselines[band] = displaced(median, offset, size_px), (float(t[0]), float(t[1]))
    learned = zip(captures, fitted.factors.tolist(), strict=True)
    return Rig(
        size_px, mean, baselines, dict(zip(bands, fitted.delay.tolist(), strict=True)),
        dict(zip(bands, fitted.t_std.tolist(), strict=True)),
        dict(zip(bands, map(tuple, fitted.centre.tolist()), strict=True)), factors,
        tuple(CaptureFactors(c.seconds, c.altitude_m, c.motion, tuple(f)) for c, f in learned), errors_px,
    )  # fmt: skip


def _choose_factors(table: "_Table", *, motion_known: bool) -> tuple[tuple[Factor, ...], dict[str, MovingFilePx]]:
    """(the factors that reduce the error of captures left out, that error by band, px)."""
    best, *others = _SETS_IN_MOTION if motion_known else _SETS
    errors_px = table.errors_left_out(best)
    for more in others if len(table.bands) > 1 else ():
        more_px = table.errors_left_out(more)
        if _rms(more_px.values()) < _MAX_ERROR_SHARE * _rms(errors_px.values()):
            best, errors_px = more, more_px
    return best, errors_px


@dataclass(frozen=True)
class _Fit:
    offset: Array
    """(bands, 2, 3) coefficients of the means minus the median mappings, px."""
    t: Array
    """(bands, 2)"""
    delay: Array
    """(bands,)"""
    t_std: Array
    """(bands,)"""
    factors: Array
    """(captures, 5)"""
    centre: Array
    """(bands, 5) mean factors of the captures that show a band."""


@dataclass(frozen=True)
class _Table:
    """The mappings of all captures as numbers."""

    bands: tuple[str, ...]
    median: list[Matrix]
    """The median mapping of each band."""
    differences: Array
    """(captures, bands, 2, 3) coefficients of the mappings minus the median one, px."""
    weights: Array
    """(captures, bands), 0 where a capture does not show a band."""
    prior: Array | None
    """(bands, 2) baselines, of length 1 together."""

    @classmethod
    def of(
        cls, captures: Sequence[Observation], bands: tuple[str, ...], size_px: tuple[int, int], prior: Array | None
    ) -> "_Table":
        median = [median_mapping([c.mappings[b] for c in captures if b in c.mappings], size_px) for b in bands]
        differences, weights = np.zeros((len(captures), len(bands), 2, 3)), np.zeros((len(captures), len(bands)))
        for i, capture in enumerate(captures):
            for j, band in enumerate(bands):
                if band in capture.mappings:
                    differences[i, j] = affine_difference(median[j], capture.mappings[band], size_px)
                    weights[i, j] = mapping_weight(capture.std_px[band])
        return cls(bands, median, differences, weights, prior)

    def fit(self, kept: Array, factors: Sequence[Factor]) -> _Fit:
        """Means, baselines and delays, and factors in turn, each by least squares with the others known.

        `kept` (captures,) is 0 for captures that are left out. A band that a capture lacks has no weight in it. Where
        delays count, the baselines are orthogonal to them: a step of all bands by their delays is either distance or
        motion.
        """
        weights, counts = self.weights * kept[:, None], factor_mask(factors)
        t, delay = self._first(weights, factors)
        offset = np.zeros((len(self.bands), 2, 3))
        pull = 0.0 if self.prior is None else 1 / _LAYOUT_STD**2
        for _ in range(_MAX_ROUNDS):
            before = offset, t
            designs = np.stack([factor_design(a, d) for a, d in zip(t, delay, strict=True)])
            result, _ = solve_factors(self.differences - offset, designs, weights, counts)
            # The mean is at the typical factors, even of a flight that was low here and there.
            result -= np.median(result[kept > 0], axis=0)
            # Captures far from typical factors are off by errors of the baselines: they count less for the means.
            trust = cauchy_weights(np.linalg.norm(result[:, :3], axis=1), MIN_STD_PX / _LAYOUT_STD)
            target = t if self.prior is None else self._without_delays(self.prior, delay, counts)
            offset, moved, later = _fit_bands(self.differences, weights * trust[:, None], result, target, delay, pull)
            if "motion" in factors:
                delay = _unit(later)
            t = self._without_delays(moved, delay, counts)
            if np.abs(offset - before[0]).max() < _CONVERGED_PX and np.abs(t - before[1]).max() < _CONVERGED:
                break
        total = np.maximum(weights.sum(axis=0), 1e-12)
        centre = np.einsum("ij,ik->jk", weights, result) / total[:, None]
        information = np.einsum("ij,ijk->j", weights, (result[:, None, :3] - centre[None, :, :3]) ** 2)
        # Standard error of a baseline, relative to the length of all of them, which is 1.
        t_std = np.minimum(1 / np.sqrt(np.maximum(information + pull, 1e-9)), 1.0)
        return _Fit(offset, t, delay, t_std, result, centre)

    def errors_left_out(self, factors: Sequence[Factor]) -> dict[str, MovingFilePx]:
        """Root mean square error by band, px, of captures that are predicted from rigs learnt on the others."""
        counts = factor_mask(factors)
        errors: dict[str, list[float]] = {b: [] for b in self.bands}
        for out in self._folds():
            fit = self.fit((~out).astype(np.float64), factors or ("distance",))
            designs = np.stack([factor_design(a, d) for a, d in zip(fit.t, fit.delay, strict=True)])
            left = self.differences[out] - fit.offset
            for j, band in enumerate(self.bands):
                others = self.weights[out].copy()
                others[:, j] = 0.0
                result, _ = solve_factors(left, designs, others, counts)
                error = left[:, j] - np.einsum("akf,cf->cak", designs[j] * counts, result)
                lengths = np.linalg.norm(error, axis=(1, 2))
                errors[band] += lengths[self.weights[out, j] > 0].tolist()
        # The rig is learned on one capture more than those that give its errors.
        seen = (self.weights > 0).sum(axis=0)
        gained = np.sqrt((1 + 1 / seen) / (1 + 1 / np.maximum(seen - 1, 1)))
        return {b: MovingFilePx(_rms(errors[b]) * g) for b, g in zip(self.bands, gained, strict=True)}

    def _folds(self) -> list[NDArray[np.bool_]]:
        """Which captures (captures,) each fold leaves out. The others always show every band, so that each band has an
        error: where all captures of a band would be in one fold, each capture is a fold of its own.
        """
        count = len(self.differences)
        for folds in (min(count, _MAX_FOLDS), count):
            left_out = [np.arange(count) % folds == fold for fold in range(folds)]
            if all((self.weights[~out].sum(axis=0) > 0).all() for out in left_out):
                break
        return left_out

    @staticmethod
    def _without_delays(t: Array, delay: Array, counts: Array) -> Array:
        """Baselines of length 1 together, orthogonal to the delays where those count."""
        return _unit(t - np.outer(delay, delay @ t) if counts[3] > 0 else t)

    def _first(self, weights: Array, factors: Sequence[Factor]) -> tuple[Array, Array]:
        """Baselines and delays to start from: the prior, or the first singular vector of all bands' coefficients over
        all captures; that of what delays leave, where those count.
        """
        scale, left, counts = np.sqrt(weights)[:, :, None, None], self.differences, factor_mask(factors)
        later = (left * scale)[..., 0].transpose(1, 0, 2).reshape(len(self.bands), -1)
        delay = np.asarray(np.linalg.svd(later, full_matrices=False)[0][:, 0])
        if "reference" in factors:
            delay = np.full(len(self.bands), len(self.bands) ** -0.5)
        if self.prior is not None:
            return self._without_delays(self.prior, delay, counts), delay
        if counts[3] > 0:
            designs = np.stack([factor_design(np.zeros(2), d) for d in delay])
            result, _ = solve_factors(left, designs, weights, factor_mask(("motion",)))
            left = left - np.einsum("bakf,cf->cbak", designs, result)
        along = (left * scale).transpose(1, 2, 0, 3).reshape(2 * len(self.bands), -1)
        t = np.asarray(np.linalg.svd(along, full_matrices=False)[0][:, 0].reshape(-1, 2))
        return self._without_delays(t, delay, counts), delay


def _fit_bands(
    differences: Array, weights: Array, factors: Array, t: Array, delay: Array, pull: float
) -> tuple[Array, Array, Array]:
    """(offsets (bands, 2, 3), t (bands, 2), delays (bands,)) by a linear regression of each band's differences
    (captures, bands, 2, 3), with weights (captures, bands), on the factors (captures, 5), with t (bands, 2) and the
    delays (bands,) pulled to the given ones.
    """
    captures, bands = weights.shape
    design = np.zeros((captures, 2, 3, 9))
    design[:, (0, 0, 0, 1, 1, 1), (0, 1, 2, 0, 1, 2), range(6)] = 1.0
    design[:, 0, :, 6] = design[:, 1, :, 7] = factors[:, :3]
    design[:, :, 0, 8] = factors[:, 3:]
    x = design.reshape(captures, 6, 9)
    # A baseline or a delay that the factors do not determine stays as it was.
    ridge = np.array([1e-9] * 6 + [pull + 1e-6] * 2 + [1e-6])
    squares = (x.transpose(0, 2, 1) @ x).reshape(captures, 81)
    normal = (weights.T @ squares).reshape(bands, 9, 9) + np.diag(ridge)
    weighted = (weights[..., None] * differences.reshape(captures, bands, 6)).transpose(1, 0, 2).reshape(bands, -1)
    wanted = weighted @ x.reshape(captures * 6, 9) + ridge * np.column_stack([np.zeros((bands, 6)), t, delay])
    result = np.linalg.solve(normal, wanted[..., None])[..., 0]
    return result[:, :6].reshape(bands, 2, 3), result[:, 6:8], result[:, 8]


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / max(float(np.linalg.norm(vectors)), 1e-12))


def _normalised_layout(layout: Mapping[str, tuple[float, float]], bands: Sequence[str]) -> Array | None:
    if not all(b in layout for b in bands):
        return None
    result = np.array([layout[b] for b in bands], dtype=np.float64)
    return _unit(result) if np.linalg.norm(result) > 0 else None


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))
