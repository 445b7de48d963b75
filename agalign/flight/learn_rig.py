"""Fitting the rig of a flight to the mappings of some of its captures, and what it misses of captures left out."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.flight.rig import (
    MIN_CAPTURES,
    MIN_STD_PX,
    Factor,
    Observation,
    Rig,
    Seen,
    affine,
    design,
    median_mapping,
    moved,
    solve_factors,
    used,
    weight,
)
from agalign.values.geometry import Matrix

Array = NDArray[np.float64]

_SETS: tuple[tuple[Factor, ...], ...] = (
    (), ("distance",), ("distance", "tilt"), ("distance", "reference"), ("distance", "tilt", "reference"),
    ("distance", "motion"), ("distance", "tilt", "motion"),
)  # fmt: skip
_SETS_IN_MOTION: tuple[tuple[Factor, ...], ...] = (
    (), ("motion",), ("distance", "motion"), ("distance", "tilt", "motion"), ("distance",), ("distance", "tilt"),
)  # fmt: skip
"""Where the tags tell how the ground passes: to and fro along one line it looks like another distance."""
_LAYOUT_STD = 0.015
"""Of a camera model's known layout of lenses, in lengths of all baselines together."""
_ROUNDS = 20
_MAX_FOLDS = 12
_PLAINLY_BETTER = 0.9
"""Further factors must leave at most this share of the error that captures left out show without them."""


def learn_rig(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: Mapping[str, tuple[float, float]]
) -> Rig | None:
    """The rig that some captures show; None where fewer than three show the same band.

    `layout` is what is known of where each band's lens stands, in any unit; empty where nothing is.
    """
    counts = {b: sum(b in c.mappings for c in captures) for b in dict.fromkeys(b for c in captures for b in c.mappings)}
    bands = tuple(b for b, count in counts.items() if count >= MIN_CAPTURES)
    if not bands:
        return None
    captures = [c for c in captures if any(b in c.mappings for b in bands)]
    table = _Table.of(captures, bands, size_px, _normalised_layout(layout, bands))
    sets = _SETS_IN_MOTION if sum(c.motion is not None for c in captures) >= MIN_CAPTURES else _SETS
    errors = {factors: table.errors_left_out(factors) for factors in sets}
    best = sets[0]
    for more in sets[1:]:
        if len(bands) > 1 and _rms(errors[more].values()) < _PLAINLY_BETTER * _rms(errors[best].values()):
            best = more
    fitted = table.fit(np.ones(len(captures)), best or ("distance",))
    seen = tuple(
        Seen(c.seconds, c.altitude_m, c.motion, tuple(f))
        for c, f in zip(captures, fitted.factors.tolist(), strict=True)
    )
    return Rig(
        size_px, {b: moved(s, o, size_px) for b, s, o in zip(bands, table.start, fitted.offset, strict=True)},
        {b: (float(t[0]), float(t[1])) for b, t in zip(bands, fitted.t, strict=True)},
        dict(zip(bands, fitted.delay.tolist(), strict=True)), dict(zip(bands, fitted.t_std.tolist(), strict=True)),
        {b: tuple(c) for b, c in zip(bands, fitted.centre.tolist(), strict=True)}, best, seen, errors[best],
    )  # fmt: skip


@dataclass(frozen=True)
class _Fit:
    offset: Array
    """(bands, 2, 3) of the means beside where the fit started, in terms of g."""
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
    start: list[Matrix]
    """The median mapping of each band."""
    there: Array
    """(captures, bands, 2, 3) beside it, in terms of g, px."""
    weights: Array
    """(captures, bands), 0 where a capture does not show a band."""
    prior: Array | None
    """(bands, 2) baselines, of length 1 together."""

    @classmethod
    def of(
        cls, captures: Sequence[Observation], bands: tuple[str, ...], size_px: tuple[int, int], prior: Array | None
    ) -> "_Table":
        start = [median_mapping([c.mappings[b] for c in captures if b in c.mappings], size_px) for b in bands]
        there, weights = np.zeros((len(captures), len(bands), 2, 3)), np.zeros((len(captures), len(bands)))
        for i, capture in enumerate(captures):
            for j, band in enumerate(bands):
                if band in capture.mappings:
                    there[i, j] = affine(start[j], capture.mappings[band], size_px)
                    weights[i, j] = weight(capture.std_px[band])
        return cls(bands, start, there, weights, prior)

    def fit(self, kept: Array, factors: Sequence[Factor]) -> _Fit:
        """Means, baselines and delays, and factors in turn, each by least squares with the others known.

        `kept` (captures,) is 0 for captures that are left out. A band that a capture lacks says nothing of it: its mean
        is at the same factors as the others'. Where delays count, what of the baselines goes with them is theirs: a
        step of all bands by their delays is the same, whether it is called distance or motion.
        """
        weights, counts = self.weights * kept[:, None], used(factors)
        t, delay = self._first(weights, factors)
        offset = np.zeros((len(self.bands), 2, 3))
        pull = 0.0 if self.prior is None else 1 / _LAYOUT_STD**2
        for _ in range(_ROUNDS):
            designs = np.stack([design(a, d) for a, d in zip(t, delay, strict=True)])
            result, _ = solve_factors(self.there - offset, designs, weights, counts)
            # Of a flight that was low here and there, what is typical.
            result -= np.median(result[kept > 0], axis=0)
            # What lies far from typical factors is off by errors of the baselines: it tells less of the means.
            vote = 1 / (1 + (_LAYOUT_STD / MIN_STD_PX) ** 2 * (result[:, :3] ** 2).sum(axis=1))
            towards = t if self.prior is None else self._beside(self.prior, delay, counts)
            each = [
                _band(self.there[:, j], weights[:, j] * vote, result, towards[j], delay[j], pull)
                for j in range(len(self.bands))
            ]
            offset = np.stack([o for o, _, _ in each])
            if "motion" in factors:
                delay = _unit(np.array([d for _, _, d in each]))
            t = self._beside(np.stack([v for _, v, _ in each]), delay, counts)
        total = np.maximum(weights.sum(axis=0), 1e-12)
        centre = np.einsum("ij,ik->jk", weights, result) / total[:, None]
        information = np.einsum("ij,ijk->j", weights, (result[:, None, :3] - centre[None, :, :3]) ** 2)
        # What a baseline is unsure by, relative to the length of all of them, which is 1.
        t_std = np.minimum(1 / np.sqrt(np.maximum(information + pull, 1e-9)), 1.0)
        return _Fit(offset, t, delay, t_std, result, centre)

    def errors_left_out(self, factors: Sequence[Factor]) -> dict[str, float]:
        """Root mean square error by band, px, of captures that are predicted from rigs learnt on the others."""
        counts = used(factors)
        errors: dict[str, list[float]] = {b: [] for b in self.bands}
        for out in self._folds():
            fit = self.fit(1.0 - out, factors or ("distance",))
            designs = np.stack([design(a, d) for a, d in zip(fit.t, fit.delay, strict=True)])
            left = self.there[out] - fit.offset
            for j, band in enumerate(self.bands):
                others = self.weights[out].copy()
                others[:, j] = 0.0
                result, _ = solve_factors(left, designs, others, counts)
                error = left[:, j] - np.einsum("akf,cf->cak", designs[j] * counts, result)
                lengths = np.linalg.norm(error, axis=(1, 2))
                errors[band] += lengths[self.weights[out, j] > 0].tolist()
        # The rig is learnt on one capture more than those that tell its errors.
        seen = (self.weights > 0).sum(axis=0)
        gained = np.sqrt((1 + 1 / seen) / (1 + 1 / np.maximum(seen - 1, 1)))
        return {b: _rms(errors[b]) * float(g) for b, g in zip(self.bands, gained, strict=True)}

    def _folds(self) -> list[NDArray[np.bool_]]:
        """Which captures (captures,) each fold leaves out. The others always show every band, so that each band has an
        error: where all captures of a band would be in one fold, each capture is a fold of its own.
        """
        count = len(self.there)
        for folds in (min(count, _MAX_FOLDS), count):
            left_out = [np.arange(count) % folds == fold for fold in range(folds)]
            if all((self.weights[~out].sum(axis=0) > 0).all() for out in left_out):
                break
        return left_out

    @staticmethod
    def _beside(t: Array, delay: Array, counts: Array) -> Array:
        """Baselines of length 1 together, without what goes with the delays where those count."""
        return _unit(t - np.outer(delay, delay @ t) if counts[3] > 0 else t)

    def _first(self, weights: Array, factors: Sequence[Factor]) -> tuple[Array, Array]:
        """Baselines and delays to start from: the prior, or what explains most of all bands' coordinates over all
        captures, a first singular vector; the baselines of what delays leave, where those count.
        """
        scale, left, counts = np.sqrt(weights)[:, :, None, None], self.there, used(factors)
        later = (left * scale)[..., 0].transpose(1, 0, 2).reshape(len(self.bands), -1)
        delay = np.asarray(np.linalg.svd(later, full_matrices=False)[0][:, 0])
        if "reference" in factors:
            delay = np.full(len(self.bands), len(self.bands) ** -0.5)
        if self.prior is not None:
            return self._beside(self.prior, delay, counts), delay
        if counts[3] > 0:
            designs = np.stack([design(np.zeros(2), d) for d in delay])
            result, _ = solve_factors(left, designs, weights, used(("motion",)))
            left = left - np.einsum("bakf,cf->cbak", designs, result)
        along = (left * scale).transpose(1, 2, 0, 3).reshape(2 * len(self.bands), -1)
        t = np.asarray(np.linalg.svd(along, full_matrices=False)[0][:, 0].reshape(-1, 2))
        return self._beside(t, delay, counts), delay


def _band(
    there: Array, weights: Array, factors: Array, t: Array, delay: float, pull: float
) -> tuple[Array, Array, float]:
    """(offset (2, 3), t (2,), delay) of one band: a linear regression of what it shows, (captures, 2, 3), on the
    factors (captures, 5), with t pulled to the given one.
    """
    count = len(there)
    by_place = np.zeros((count, 2, 3, 9))
    by_place[:, (0, 0, 0, 1, 1, 1), (0, 1, 2, 0, 1, 2), range(6)] = 1.0
    by_place[:, 0, :, 6] = by_place[:, 1, :, 7] = factors[:, :3]
    by_place[:, :, 0, 8] = factors[:, 3:]
    x = by_place.reshape(count, 6, 9)
    # What the factors do not say of a baseline or a delay stays as it was.
    ridge = np.array([1e-9] * 6 + [pull + 1e-6] * 2 + [1e-6])
    normal = np.einsum("c,cif,cig->fg", weights, x, x) + np.diag(ridge)
    wanted = np.einsum("c,cif,ci->f", weights, x, there.reshape(count, 6)) + ridge * np.array([0.0] * 6 + [*t, delay])
    result = np.linalg.solve(normal, wanted)
    return result[:6].reshape(2, 3), result[6:8], float(result[8])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / max(float(np.linalg.norm(vectors)), 1e-12))


def _normalised_layout(layout: Mapping[str, tuple[float, float]], bands: Sequence[str]) -> Array | None:
    if not all(b in layout for b in bands):
        return None
    result = np.array([layout[b] for b in bands], dtype=np.float64)
    return _unit(result) if np.linalg.norm(result) > 0 else None


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))
