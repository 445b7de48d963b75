"""Estimation of a flight's rig from the mappings of some captures, with cross-validated errors."""

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
from agalign.values.apply import Apply
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import MovingFilePx
from agalign.values.robust import cauchy_weights

Array = NDArray[np.float64]

_FACTOR_SETS: tuple[tuple[Factor, ...], ...] = (
    (), ("distance",), ("distance", "tilt"), ("distance", "reference"), ("distance", "tilt", "reference"),
    ("distance", "motion"), ("distance", "tilt", "motion"),
)  # fmt: skip
"""Candidates in the order of preference."""
_FACTOR_SETS_WITH_MOTION: tuple[tuple[Factor, ...], ...] = (
    (), ("motion",), ("distance", "motion"), ("distance", "tilt", "motion"), ("distance",), ("distance", "tilt"),
)  # fmt: skip
"""Candidates where the tags have the image motion; motion comes first, as on parallel flight lines it resembles a
change of distance."""
_LAYOUT_STD = 0.015
"""Standard error of the lens positions of a camera model, relative to the norm of all baselines."""
_MAX_ITERATIONS = 20
"""Of alternating least squares."""
_CONVERGED_PX, _CONVERGED = 1e-4, 1e-5
"""Maximum change of the means, px, and of the baselines, of norm 1, in the last iteration."""
_MAX_FOLDS = 12
"""Of the cross-validation: more folds take longer and change the errors little."""
_MAX_ERROR_RATIO = 0.9
"""A set of factors is preferred to the previous one if the ratio of the cross-validated errors is smaller."""


def learn_rig(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: Mapping[str, tuple[float, float]],
    apply: Apply = map,
) -> Rig | None:  # fmt: skip
    """Estimate the rig from captures; None if no band has a mapping in at least MIN_CAPTURES of them.

    `size_px` is (width, height) of the reference. `layout` has the known positions of the lenses by band, in any unit.
    `apply` runs the cross-validations.
    """
    counts = Counter(b for c in captures for b in c.mappings)
    bands = tuple(b for b, count in counts.items() if count >= MIN_CAPTURES)
    captures = [c for c in captures if any(b in c.mappings for b in bands)]
    if not bands:
        return None
    table = _Table.of(captures, bands, size_px, _normalised_layout(layout, bands))
    with_motion = sum(c.motion is not None for c in captures) >= MIN_CAPTURES
    factors, errors_px = _select_factors(table, apply, with_motion=with_motion)
    fit = table.fit(np.ones(len(captures)), factors or ("distance",))
    by_band = zip(bands, table.median, fit.offset, fit.t, strict=True)
    mean, baselines = dict[str, Matrix](), dict[str, tuple[float, float]]()
    for band, median, offset, t in by_band:
        mean[band], baselines[band] = displaced(median, offset, size_px), (float(t[0]), float(t[1]))
    by_capture = zip(captures, fit.factors.tolist(), strict=True)
    return Rig(
        size_px, mean, baselines, dict(zip(bands, fit.delay.tolist(), strict=True)),
        dict(zip(bands, fit.t_std.tolist(), strict=True)),
        dict(zip(bands, map(tuple, fit.centre.tolist()), strict=True)), factors,
        tuple(CaptureFactors(c.seconds, c.altitude_m, c.motion, tuple(f)) for c, f in by_capture), errors_px,
    )  # fmt: skip


def _select_factors(
    table: "_Table", apply: Apply, *, with_motion: bool
) -> tuple[tuple[Factor, ...], dict[str, MovingFilePx]]:
    """Select the factors by cross-validation; return them and their RMS error by band, px."""
    candidates = _FACTOR_SETS_WITH_MOTION if with_motion else _FACTOR_SETS
    if len(table.bands) == 1:
        candidates = candidates[:1]
    (best, errors_px), *others = zip(candidates, apply(table.cross_validated_px, candidates), strict=True)
    for candidate, candidate_px in others:
        if _rms(candidate_px.values()) < _MAX_ERROR_RATIO * _rms(errors_px.values()):
            best, errors_px = candidate, candidate_px
    return best, errors_px


@dataclass(frozen=True)
class _Fit:
    """Estimated parameters of the model in `rig`."""

    offset: Array
    """(bands, 2, 3) coefficients of the means minus the median mappings, px."""
    t: Array
    """(bands, 2) baselines, of norm 1 together."""
    delay: Array
    """(bands,) delays, of norm 1."""
    t_std: Array
    """(bands,) standard error of each coordinate of t."""
    factors: Array
    """(captures, 5)"""
    centre: Array
    """(bands, 5) weighted mean factors of the captures with a mapping of the band."""


@dataclass(frozen=True)
class _Table:
    """The mappings of all captures as coefficients."""

    bands: tuple[str, ...]
    median: list[Matrix]
    """Median mapping of each band."""
    differences: Array
    """(captures, bands, 2, 3) coefficients of the mappings minus the median mapping, px."""
    weights: Array
    """(captures, bands) of `mapping_weight`, 0 without a mapping."""
    prior: Array | None
    """(bands, 2) baselines of the known lens layout, of norm 1 together; None if unknown."""

    @classmethod
    def of(
        cls, captures: Sequence[Observation], bands: tuple[str, ...], size_px: tuple[int, int], prior: Array | None
    ) -> "_Table":
        """Compute the coefficients of the mappings of `bands` in all captures."""
        median = [median_mapping([c.mappings[b] for c in captures if b in c.mappings], size_px) for b in bands]
        differences, weights = np.zeros((len(captures), len(bands), 2, 3)), np.zeros((len(captures), len(bands)))
        for i, capture in enumerate(captures):
            for j, band in enumerate(bands):
                if band in capture.mappings:
                    differences[i, j] = affine_difference(median[j], capture.mappings[band], size_px)
                    weights[i, j] = mapping_weight(capture.std_px[band])
        return cls(bands, median, differences, weights, prior)

    def fit(self, is_used: Array, factors: Sequence[Factor]) -> _Fit:
        """Fit the model by alternating least squares: the factors of captures, then the parameters of bands.

        `is_used` (captures,) is 0 for captures that are left out. If delays are part of the model, the baselines are
        orthogonal to them, because otherwise a shift of all bands along their delays could be distance or motion.
        """
        weights, mask = self.weights * is_used[:, None], factor_mask(factors)
        t, delay = self._initial(weights, factors)
        offset = np.zeros((len(self.bands), 2, 3))
        prior_weight = 0.0 if self.prior is None else 1 / _LAYOUT_STD**2
        for _ in range(_MAX_ITERATIONS):
            previous_offset, previous_t = offset, t
            designs = np.stack([factor_design(a, d) for a, d in zip(t, delay, strict=True)])
            result, _ = solve_factors(self.differences - offset, designs, weights, mask)
            # The median is robust to a few captures at another height.
            result -= np.median(result[is_used > 0], axis=0)
            # Errors of the baselines displace captures far from the median factors, which therefore have less weight.
            robust = cauchy_weights(np.linalg.norm(result[:, :3], axis=1), MIN_STD_PX / _LAYOUT_STD)
            target = t if self.prior is None else self._orthogonal(self.prior, delay, mask)
            offset, fitted_t, fitted_delay = _fit_bands(
                self.differences, weights * robust[:, None], result, target, delay, prior_weight
            )
            if "motion" in factors:
                delay = _unit(fitted_delay)
            t = self._orthogonal(fitted_t, delay, mask)
            if np.abs(offset - previous_offset).max() < _CONVERGED_PX and np.abs(t - previous_t).max() < _CONVERGED:
                break
        total = np.maximum(weights.sum(axis=0), 1e-12)
        centre = np.einsum("ij,ik->jk", weights, result) / total[:, None]
        information = np.einsum("ij,ijk->j", weights, (result[:, None, :3] - centre[None, :, :3]) ** 2)
        t_std = np.minimum(1 / np.sqrt(np.maximum(information + prior_weight, 1e-9)), 1.0)
        return _Fit(offset, t, delay, t_std, result, centre)

    def cross_validated_px(self, factors: Sequence[Factor]) -> dict[str, MovingFilePx]:
        """Return the RMS error by band of predictions from the other bands, in captures left out of the fit."""
        mask = factor_mask(factors)
        errors: dict[str, list[float]] = {b: [] for b in self.bands}
        for is_left_out in self._folds():
            fit = self.fit((~is_left_out).astype(np.float64), factors or ("distance",))
            designs = np.stack([factor_design(a, d) for a, d in zip(fit.t, fit.delay, strict=True)])
            differences = self.differences[is_left_out] - fit.offset
            for j, band in enumerate(self.bands):
                other_weights = self.weights[is_left_out].copy()
                other_weights[:, j] = 0.0
                result, _ = solve_factors(differences, designs, other_weights, mask)
                error = differences[:, j] - np.einsum("akf,cf->cak", designs[j] * mask, result)
                lengths = np.linalg.norm(error, axis=(1, 2))
                errors[band] += lengths[self.weights[is_left_out, j] > 0].tolist()
        # The final rig has one capture more than a fit of a fold: the error variance is proportional to 1 + 1 / n.
        count = (self.weights > 0).sum(axis=0)
        ratio = np.sqrt((1 + 1 / count) / (1 + 1 / np.maximum(count - 1, 1)))
        return {b: MovingFilePx(_rms(errors[b]) * r) for b, r in zip(self.bands, ratio, strict=True)}

    def _folds(self) -> list[NDArray[np.bool_]]:
        """Return (captures,) True for the captures that each fold leaves out.

        If a fold would contain all captures of a band, each capture is its own fold.
        """
        count = len(self.differences)
        for folds in (min(count, _MAX_FOLDS), count):
            left_out = [np.arange(count) % folds == fold for fold in range(folds)]
            if all((self.weights[~out].sum(axis=0) > 0).all() for out in left_out):
                break
        return left_out

    @staticmethod
    def _orthogonal(t: Array, delay: Array, mask: Array) -> Array:
        """Normalise the baselines to norm 1 together, orthogonal to the delays if those are part of the model."""
        return _unit(t - np.outer(delay, delay @ t) if mask[3] > 0 else t)

    def _initial(self, weights: Array, factors: Sequence[Factor]) -> tuple[Array, Array]:
        """Return initial baselines (bands, 2) and delays (bands,).

        The baselines are the prior if there is one, else the first singular vector of the coefficients of all bands
        over all captures, after subtracting the part that delays explain if those are part of the model.
        """
        scale, differences, mask = np.sqrt(weights)[:, :, None, None], self.differences, factor_mask(factors)
        shifts = (differences * scale)[..., 0].transpose(1, 0, 2).reshape(len(self.bands), -1)
        delay = np.asarray(np.linalg.svd(shifts, full_matrices=False)[0][:, 0])
        if "reference" in factors:
            delay = np.full(len(self.bands), len(self.bands) ** -0.5)
        if self.prior is not None:
            return self._orthogonal(self.prior, delay, mask), delay
        if mask[3] > 0:
            designs = np.stack([factor_design(np.zeros(2), d) for d in delay])
            result, _ = solve_factors(differences, designs, weights, factor_mask(("motion",)))
            differences = differences - np.einsum("bakf,cf->cbak", designs, result)
        coefficients = (differences * scale).transpose(1, 2, 0, 3).reshape(2 * len(self.bands), -1)
        t = np.asarray(np.linalg.svd(coefficients, full_matrices=False)[0][:, 0].reshape(-1, 2))
        return self._orthogonal(t, delay, mask), delay


def _fit_bands(
    differences: Array, weights: Array, factors: Array, t: Array, delay: Array, prior_weight: float
) -> tuple[Array, Array, Array]:
    """Fit offsets (bands, 2, 3), t (bands, 2) and delays (bands,) by ridge regression of each band on the factors.

    `differences` (captures, bands, 2, 3) are coefficients, px, with `weights` (captures, bands); `factors` are
    (captures, 5). `t` (bands, 2) and `delay` (bands,) are prior values; `prior_weight` is the weight of that of t.
    """
    captures, bands = weights.shape
    design = np.zeros((captures, 2, 3, 9))
    design[:, (0, 0, 0, 1, 1, 1), (0, 1, 2, 0, 1, 2), range(6)] = 1.0
    design[:, 0, :, 6] = design[:, 1, :, 7] = factors[:, :3]
    design[:, :, 0, 8] = factors[:, 3:]
    x = design.reshape(captures, 6, 9)
    # Baselines and delays that the factors do not determine keep their prior values.
    ridge = np.array([1e-9] * 6 + [prior_weight + 1e-6] * 2 + [1e-6])
    squares = (x.transpose(0, 2, 1) @ x).reshape(captures, 81)
    normal = (weights.T @ squares).reshape(bands, 9, 9) + np.diag(ridge)
    weighted = (weights[..., None] * differences.reshape(captures, bands, 6)).transpose(1, 0, 2).reshape(bands, -1)
    right_side = weighted @ x.reshape(captures * 6, 9) + ridge * np.column_stack([np.zeros((bands, 6)), t, delay])
    result = np.linalg.solve(normal, right_side[..., None])[..., 0]
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
