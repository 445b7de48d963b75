"""Estimation of a flight's rig from the mappings of some captures, with cross-validated errors."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.flight import rig
from agalign.flight.rig import (
    MIN_CAPTURES,
    NU,
    CaptureFactors,
    Factor,
    Observation,
    Rig,
    capture_factors,
    design_tensor,
)
from agalign.flight.rig_prediction import contradicts, predict_band
from agalign.values.least_squares import least_squares
from agalign.verify.checks import MAX_UNEXPECTED_PX

Array = NDArray[np.float64]
LensLayout = Mapping[str, tuple[float, float]]
"""Positions of the lenses by band, in any unit."""

Factors = tuple[Factor, ...]
EachFactors = Callable[[Callable[[Factors], Array], Sequence[Factors]], Iterable[Array]]
"""Calls a function with each set of factors, and returns the results in order, as `map` does."""

_FACTOR_SETS: tuple[Factors, ...] = (
    (),
    ("distance",),
    ("distance", "tilt"),
    ("distance", "reference"),
    ("distance", "tilt", "reference"),
    ("motion",),
    ("distance", "motion"),
    ("distance", "tilt", "motion"),
)
"""Candidates in the order of preference: on parallel flight lines, motion alone resembles distance with motion."""
_UNKNOWN_STD = 1000.0
"""Of the prior of parameters that only the captures determine."""
_LAYOUT_STD = 0.015
"""Standard deviation of the lens positions of a camera model, relative to the norm of all baselines."""


def learn_rig(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: LensLayout, apply: EachFactors = map
) -> Rig | None:
    """Estimate the rig from captures; None if no band has a mapping in at least MIN_CAPTURES of them.

    `size_px` is (width, height) of the reference. `apply` runs the cross-validations. A few mappings that contradict
    the rig of all others, such as aliases in repetitive scenes, are left out.
    """
    of_all = learned = _learned(captures, size_px, layout, apply)
    # A wrong mapping may hide another one: all that are far away are left out first, then each is compared.
    max_wrong_share = 1 / 8  # of the mappings; the model does not describe a flight with more
    kept, left_out, max_wrong = list(captures), [], max_wrong_share * sum(len(c.mappings) for c in captures)
    while learned is not None and (farthest := _farthest(learned, kept)) is not None:
        left_out.append(farthest)
        if len(left_out) > max_wrong:
            return of_all
        kept = _without(kept, [farthest])
        learned = _learned(kept, size_px, layout, apply)
    wrong = [] if learned is None else [(k, b) for k, b in left_out if _is_wrong(learned, b, captures[k], kept[k])]
    if len(wrong) == len(left_out):
        return learned
    return _learned(_without(captures, wrong), size_px, layout, apply) if wrong else of_all


def _farthest(learned: Rig, captures: Sequence[Observation]) -> tuple[int, str] | None:
    """Return number of the capture and band of the mapping that is farthest from its prediction by at least two other
    bands; None if all are close.
    """
    # Half of a contradiction, as a mapping moves the mean of few captures. In flights without wrong mappings, the
    # maximum was 0.3 px.
    max_close_px, min_others = MAX_UNEXPECTED_PX / 2, 2  # fewer do not show which mapping is wrong
    distances_px = {
        (number, band): rig.distance_px(mapping, predict_band(learned, band, capture).fixed_to_moving, learned.size_px)
        for number, capture in enumerate(captures)
        if len(capture.mappings.keys() & learned.mean.keys()) > min_others
        for band, mapping in capture.mappings.items()
        if band in learned.mean
    }
    farthest = max(distances_px, key=distances_px.__getitem__, default=None)
    return None if farthest is None or distances_px[farthest] <= max_close_px else farthest


def _is_wrong(learned: Rig, band: str, capture: Observation, others: Observation) -> bool:
    """Return True if a band of a capture contradicts its `others`; not if these contradict each other."""
    alone = replace(others, mappings={**others.mappings, band: capture.mappings[band]})
    return band in learned.mean and contradicts(learned, band, alone)


def _without(captures: Sequence[Observation], wrong: Sequence[tuple[int, str]]) -> list[Observation]:
    """Return the captures without some mappings, each given by the number of its capture and its band."""
    return [
        replace(capture, mappings={b: m for b, m in capture.mappings.items() if (number, b) not in wrong})
        for number, capture in enumerate(captures)
    ]


def _learned(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: LensLayout, apply: EachFactors
) -> Rig | None:
    """Estimate the rig from all mappings."""
    counts = Counter(b for c in captures for b in c.mappings)
    bands = tuple(b for b, count in counts.items() if count >= MIN_CAPTURES)
    captures = [c for c in captures if any(b in c.mappings for b in bands)]
    if not bands:
        return None
    table = _Table(captures, bands, size_px, layout)
    factors, compared_px = table.selected_factors(apply)
    errors_px = table.of_predictions_px(compared_px)
    fitted, nu_w = table.fit(np.ones(len(captures)), factors)
    t_std = table.baseline_std(nu_w, errors_px)
    offsets, lenses = fitted[:, :6].reshape(-1, 2, 3), zip(bands, fitted[:, 6:8].tolist(), strict=True)
    by_capture = zip(captures, nu_w.tolist(), strict=True)
    result = Rig(
        size_px=size_px,
        mean={b: rig.displaced(m, o, size_px) for b, m, o in zip(bands, table.median, offsets, strict=True)},
        baselines={b: (x, y) for b, (x, y) in lenses},
        delays=dict(zip(bands, fitted[:, 8].tolist(), strict=True)),
        baseline_std=dict(zip(bands, t_std.tolist(), strict=True)),
        factors=factors,
        captures=tuple(CaptureFactors(c.seconds, c.altitude_m, c.motion, tuple(f)) for c, f in by_capture),
        from_bands_px=dict(zip(bands, errors_px.tolist(), strict=True)),
    )
    are_known = not rig.has_delays(factors) and (bool(factors) or table.layout is not None)
    return replace(result, parallax_px=_parallax_px(captures, result.baselines if are_known else None, bands))


def _parallax_px(
    captures: Sequence[Observation], baselines: Mapping[str, tuple[float, float]] | None, bands: Sequence[str]
) -> dict[str, float]:
    """Return the RMS displacement of each band by the reliefs of the captures, px of the reference.

    A band without a relief in a capture that has one, such as a thermal band, gets that of the other bands, as the
    displacement is proportional to the baseline; the largest if the baselines are not known, as delays hide them.
    """
    lengths = {band: 1.0 if baselines is None else math.hypot(*baselines[band]) for band in bands}
    squares_px2: dict[str, list[float]] = {band: [] for band in lengths}
    for capture in captures:
        known = [(lengths[b], px) for b, px in capture.parallax_px.items() if b in lengths]
        square = sum(length**2 for length, _ in known)
        per_length_px = sum(length * px for length, px in known) / square if square > 0 else 0.0
        largest_px = max(capture.parallax_px.values(), default=0.0)
        for band, length in lengths.items():
            if band in capture.mappings:
                by_others_px = largest_px if baselines is None else per_length_px * length
                squares_px2[band].append(capture.parallax_px.get(band, by_others_px) ** 2)
    return {band: float(np.sqrt(np.mean(squares))) for band, squares in squares_px2.items()}


class _Table:
    """The mappings of all captures as coefficients."""

    def __init__(
        self, captures: Sequence[Observation], bands: Sequence[str], size_px: tuple[int, int], layout: LensLayout
    ) -> None:
        self.median = [rig.median_mapping([c.mappings[b] for c in captures if b in c.mappings], size_px) for b in bands]
        self.differences = np.zeros((len(captures), len(bands), 2, 3))
        """Coefficients of the mappings minus the median mapping of the band, px."""
        self.weights = np.zeros((len(captures), len(bands)))
        """Of `mapping_weight`, 0 without a mapping."""
        for i, capture in enumerate(captures):
            for j, band in enumerate(bands):
                if band in capture.mappings:
                    self.differences[i, j] = rig.affine_difference(self.median[j], capture.mappings[band], size_px)
                    self.weights[i, j] = rig.mapping_weight(capture.std_px[band])
        known = np.array([layout.get(b, (np.nan, np.nan)) for b in bands])
        self.layout = _unit(known) if np.linalg.norm(known) > 0 else None
        """(bands, 2) baselines of the known lens layout, of norm 1 together; None if unknown."""

    def selected_factors(self, apply: EachFactors) -> tuple[Factors, Array]:
        """Return a set of factors and its cross-validated errors (bands,): a set replaces the one before it if its
        errors are smaller by a tenth.
        """
        candidates = _FACTOR_SETS if len(self.median) > 1 else _FACTOR_SETS[:1]
        (factors, errors_px), *others = zip(candidates, apply(self.cross_validated_px, candidates), strict=True)
        for candidate, candidate_px in others:
            max_ratio = 0.9  # another set of factors is only used for a clear improvement
            if np.linalg.norm(candidate_px) < max_ratio * np.linalg.norm(errors_px):
                factors, errors_px = candidate, candidate_px
        return factors, errors_px

    def fit(self, is_used: Array, factors: Sequence[Factor]) -> tuple[Array, Array]:
        """Fit the model by alternating least squares: the factors of captures, then the parameters of bands.

        Without factors, the distance is fitted.
        `is_used` (captures,) is 0 for captures that are left out. Return (bands, 9) the coefficients of the means minus
        the medians, px, t and d, and (captures, 5) the factors.
        """
        factors = factors or ("distance",)
        weights, tensor = self.weights * is_used[:, None], design_tensor(factors)
        bands = np.hstack([np.zeros((len(self.median), 6)), self._initial(weights, factors)])
        of_offset = np.broadcast_to(np.eye(6).reshape(2, 3, 6), (len(weights), 2, 3, 6))
        std = np.array([_UNKNOWN_STD] * 6 + [self._t_std, self._t_std, _UNKNOWN_STD])
        max_iterations, max_change = 20, 1e-4  # change of the means, px, and of the baselines, of norm 1
        for _ in range(max_iterations):
            offset, lens = bands[:, :6].reshape(-1, 2, 3), bands[:, 6:]
            result = capture_factors(np.tensordot(lens, tensor, 1), self.differences - offset, weights).mean
            # The median is robust to a few captures at another height.
            result -= np.median(result[is_used > 0], axis=0)
            # Errors of the baselines displace captures far from the median factors.
            displaced_px2 = _LAYOUT_STD**2 * (result[:, NU] ** 2).sum(axis=1, keepdims=True)
            weights_of_bands = (weights / (1 + weights * displaced_px2)).T
            design = np.concatenate([of_offset, np.moveaxis(tensor @ result.T, (3, 0), (0, 3))], axis=3)
            # Parameters that neither the layout nor the factors determine keep their values.
            known = lens if self.layout is None else np.column_stack([self.layout, lens[:, 2]])
            prior = np.hstack([np.zeros((len(lens), 6)), _normalised(known, factors)])
            by_band = self.differences.swapaxes(0, 1).reshape(len(lens), -1, 6), weights_of_bands
            estimate = least_squares(design.reshape(-1, 6, 9), *by_band, np.diag(std**-2), prior).mean
            previous, bands = bands, np.hstack([estimate[:, :6], _normalised(estimate[:, 6:], factors)])
            if np.abs(bands - previous).max() < max_change:
                break
        return bands, result

    def of_predictions_px(self, compared_px: Array) -> Array:
        """Return (bands,) the errors of predictions from their distances to mappings, which have errors of their own.

        These are known to a factor: at least half of the distance is kept.
        """
        is_known = self.weights > 0
        own_px2 = np.where(is_known, 2 / np.maximum(self.weights, 1e-12) - rig.MIN_STD_PX**2, 0.0)
        mean_own_px2 = own_px2.sum(axis=0) / is_known.sum(axis=0)
        return np.asarray(np.sqrt(np.maximum(compared_px**2 - mean_own_px2, compared_px**2 / 4)))

    @property
    def _t_std(self) -> float:
        """Standard deviation of the prior of each coordinate of a baseline."""
        return _UNKNOWN_STD if self.layout is None else _LAYOUT_STD

    def baseline_std(self, factors: Array, errors_px: Array) -> Array:
        """Return (bands,) the standard error of each coordinate of t, given the factors (captures, 5) and the errors
        (bands,) of the model.
        """
        weights = self.weights / (1 + self.weights * errors_px**2 / 2)
        information = weights.T @ (factors[:, NU] ** 2).sum(axis=1) + 1 / self._t_std**2
        return np.asarray(np.minimum(1 / np.sqrt(information), 1.0))

    def cross_validated_px(self, factors: Sequence[Factor]) -> Array:
        """Return (bands,) the RMS error of predictions from the other bands, in captures left out of the fit.

        A band that no capture has with another one is predicted by the flight's mean.
        """
        squares_px2, count = np.zeros(self.weights.shape), len(self.weights)
        max_folds = 12  # more take longer and change the errors little
        for folds in (min(count, max_folds), count):
            left_out = np.arange(count) % folds == np.arange(folds)[:, None]
            # If a fold would contain all captures of a band, each capture is its own fold.
            if (~left_out @ self.weights > 0).all():
                break
        for is_left_out in left_out:
            bands, _ = self.fit(~is_left_out * 1.0, factors)
            design = np.tensordot(bands[:, 6:], design_tensor(factors), 1)
            differences = self.differences[is_left_out] - bands[:, :6].reshape(-1, 2, 3)
            for j in range(len(design)):
                other_weights = self.weights[is_left_out] * (np.arange(len(design)) != j)
                result = capture_factors(design, differences, other_weights).mean
                error_px = differences[:, j] - (design[j] @ result.T).transpose(2, 0, 1)
                squares_px2[is_left_out, j] = (error_px**2).sum(axis=(1, 2))
        is_known = self.weights > 0
        has_others = is_known & (is_known.sum(axis=1, keepdims=True) > 1)
        is_compared = np.where(has_others.any(axis=0), has_others, is_known)
        counts = is_compared.sum(axis=0)
        mean_px2 = (squares_px2 * is_compared).sum(axis=0) / counts
        # The final rig has more captures than a fit without a fold, at least one: the error variance is proportional to
        # 1 + 1 / n.
        of_final_px2 = mean_px2 * (1 + 1 / counts) / (1 + 1 / np.maximum(counts - 1, 1))
        return np.asarray(np.sqrt(rig.expected_square(of_final_px2, counts)))

    def _initial(self, weights: Array, factors: Sequence[Factor]) -> Array:
        """Return initial baselines and delays (bands, 3): by default first singular vectors of the coefficients."""
        scaled = self.differences * np.sqrt(weights)[:, :, None, None]
        delay = np.linalg.svd(scaled[..., 0].swapaxes(0, 1).reshape(len(self.median), -1), full_matrices=False)[0][:, 0]
        coefficients = scaled.transpose(1, 2, 0, 3).reshape(2 * len(self.median), -1)
        t = np.linalg.svd(coefficients, full_matrices=False)[0][:, 0] if self.layout is None else self.layout
        return _normalised(np.column_stack([t.reshape(-1, 2), delay]), factors)


def _normalised(lens: Array, factors: Sequence[Factor]) -> Array:
    """Normalise baselines and delays (bands, 3) to norm 1.

    If delays are part of the model, the baselines are orthogonal to them, because otherwise a shift of all bands along
    their delays could be distance or motion.
    """
    t, delay = lens[:, :2], _unit(np.ones(len(lens)) if "reference" in factors else lens[:, 2])
    return np.column_stack([_unit(t - np.outer(delay, delay @ t) if rig.has_delays(factors) else t), delay])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / max(float(np.linalg.norm(vectors)), 1e-12))
