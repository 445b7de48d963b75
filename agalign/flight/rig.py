"""The rig of a flight: what the mappings of all bands have in common from capture to capture.

A plane induces between two cameras of a rig the homography H_b = A_b + e_b nu^T, with A_b and e_b the rig's and
nu = n / d, the ground's normal over its distance, the capture's (Hartley & Zisserman, Eq. 13.2). Around the flight's
mean m_b that is, at the pixel x of the reference,

    H_b(c) x = m_b(x) + t_b (nu_c . g(x)) + what is left

with t_b (2,) the direction in which the band's lens stands in the rig, nu_c (3,) the capture's factors, shared by ALL
its bands, and g = (1, u, v) the image's coordinates, scaled so that each has mean 0 and variance 1 over the image: the
ground's distance moves each band along its own baseline, and its tilt does so in proportion to the place in the image.
The t_b together have length 1, so that nu is in px.

How many factors count (none, the distance, distance and tilt) is decided by leaving captures out: each is predicted
from rigs learnt on the others, band by band from its other bands. What that misses is the error bar of a prediction.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import LocalField, Prediction
from agalign.values.geometry import Matrix, Points

Array = NDArray[np.float64]

LEAST_CAPTURES = 3
_LATTICE = 7, 5
_LEAST_STD_PX = 0.05
"""Of a mapping: what its own uncertainty does not know."""
FACTOR_STD_PX = (20.0, 3.0, 3.0)
"""How far from the mean a capture may be before its own bands are doubted: wide, for heights that nobody has seen."""
_CLIMB_STD_PX_PER_M = 1.5
"""What a metre of climb may do to the factor of the ground's distance: 0.03 m of baseline 20 m above it."""
_LEAST_CLIMB_SPREAD_PX = 0.5
_LAYOUT_STD = 0.04
"""Of a camera model's known layout of lenses, in lengths of all baselines together."""
_OUTLIER_PX = 0.3
_ROUNDS = 12
_PLAINLY_BETTER = 0.9
"""A further factor must leave at most this share of the error that captures left out show without it."""


@dataclass(frozen=True)
class Observation:
    """The mappings of one capture, as they were found."""

    seconds: float
    """When it was taken, from any beginning."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving by band, undistorted px of the files."""
    std_px: Mapping[str, float]
    """How sure each is."""
    altitude_m: float | None = None
    """As the camera has it, above anything."""


@dataclass(frozen=True)
class Expectation:
    """Where the corners of the reference should move beside some mapping of a band, px of the reference, clockwise from
    the top left, (x, y) in turn: corners + by_factor nu, with a covariance.
    """

    corners: Array
    """(8,)"""
    by_factor: Array
    """(8, 3)"""
    covariance: Array
    """(8, 8)"""

    def rescaled(self, scale: tuple[float, float]) -> "Expectation":
        """The same on an image that is larger by these factors (x, y)."""
        up = np.tile(scale, 4)
        return Expectation(self.corners * up, self.by_factor * up[:, None], self.covariance * np.outer(up, up))


@dataclass(frozen=True)
class Rig:
    """What a flight knows of its camera."""

    size_px: tuple[int, int]
    """(width, height) of the reference's file."""
    mean: Mapping[str, Matrix]
    """fixed_to_moving by band."""
    baselines: Mapping[str, tuple[float, float]]
    """t_b by band."""
    baseline_std: Mapping[str, float]
    """Of either coordinate of t_b."""
    centres: Mapping[str, tuple[float, float, float]]
    """Mean of nu over the captures that showed a band: there its mean is best known."""
    factors: int
    """How many numbers a capture adds: 0, 1 or 3."""
    seen: tuple[tuple[float, float | None, tuple[float, float, float]], ...]
    """(seconds, altitude in m, nu) of the captures that it was learnt on, in their order."""
    from_bands_px: Mapping[str, float]
    """Root mean square error of each band as the other bands of captures left out predict it."""
    from_neighbours_px: Mapping[str, float]
    """The same from the captures before and after."""
    from_flight_px: Mapping[str, float]
    """The same from the mean of the others."""
    fields: Mapping[str, LocalField] = field(default_factory=dict)
    """What no homography explains and all captures have in common, raw px of the reference's file, by band."""

    def as_json(self) -> str:
        """Everything but the fields' values, as text."""
        facts = {k: v for k, v in vars(self).items() if k not in ("mean", "fields")}
        facts["mean"] = {b: m.tolist() for b, m in self.mean.items()}
        return json.dumps(facts | {"field_steps_px": {b: f.step_px for b, f in self.fields.items()}})

    @classmethod
    def from_json(cls, text: str, fields: Mapping[str, Array]) -> "Rig":
        """The inverse, with the fields' values (rows, columns, 2) by band. Raises KeyError, TypeError, ValueError."""
        facts = json.loads(text)
        steps = facts.pop("field_steps_px")
        width, height = facts["size_px"]
        return cls(
            size_px=(int(width), int(height)), mean={b: np.array(m) for b, m in facts["mean"].items()},
            baselines={b: (x, y) for b, (x, y) in facts["baselines"].items()}, baseline_std=facts["baseline_std"],
            centres={b: (x, y, z) for b, (x, y, z) in facts["centres"].items()}, factors=int(facts["factors"]),
            seen=tuple((s, a, (x, y, z)) for s, a, (x, y, z) in facts["seen"]), from_bands_px=facts["from_bands_px"],
            from_neighbours_px=facts["from_neighbours_px"], from_flight_px=facts["from_flight_px"],
            fields={b: LocalField(steps[b], values) for b, values in fields.items()},
        )  # fmt: skip

    def predict(self, band: str, known: Observation) -> Prediction:
        """Where a band lies, from what is known of the capture's others, else from the captures around it.

        Raises KeyError for a band that the rig does not know.
        """
        g, mean = _coordinates(self.size_px), self.mean[band]
        others = [b for b in known.mappings if b != band and b in self.mean]
        if others:
            t, std = np.array(self.baselines[band]), self.baseline_std[band]
            nu, spread, off = self._factors_of(known, others)
            if self.factors:
                # Errors of the factors along the baseline, of the baseline times the factors, what bands differ by in
                # captures left out, and what the others of this capture do: a capture unlike all others shows there.
                beyond = nu - self.centres[band]
                variance = spread * float(t @ t) + 2 * std**2 * float(beyond @ beyond)
                error = np.sqrt(variance + self.from_bands_px[band] ** 2 + off**2)
                return Prediction(_moved(mean, np.outer(t, nu), g, self.size_px), "bands", float(error))
            return Prediction(mean, "flight", float(np.hypot(self.from_flight_px[band], off)))
        climb_px = self._unknown_climb_px(known) * float(np.linalg.norm(self.baselines[band]))
        if self.factors and self.from_neighbours_px[band] < self.from_flight_px[band]:
            shift = np.outer(self.baselines[band], self._around(known.seconds))
            error = float(np.hypot(self.from_neighbours_px[band], climb_px))
            return Prediction(_moved(mean, shift, g, self.size_px), "neighbours", error)
        return Prediction(mean, "flight", float(np.hypot(self.from_flight_px[band], climb_px)))

    def expectation(self, band: str, fixed_to_moving: Matrix) -> Expectation:
        """Where a band should lie beside a mapping close to it, whatever the factors of its capture.

        What captures left out missed is spread over all homographies alike: each with the same mean square is as
        likely. Raises KeyError for a band that the rig does not know.
        """
        points, corners = geometry.lattice(*self.size_px, *_LATTICE), geometry.corners(*self.size_px)
        back = geometry.invert(fixed_to_moving)
        # A step along the baseline, px of the moving image, as one of the reference.
        middle = points.mean(axis=0)
        ends = geometry.apply(fixed_to_moving, middle) + np.vstack([np.zeros(2), self.baselines[band]])
        step = np.subtract(*geometry.apply(back, ends)[::-1])
        g = _coordinates(self.size_px, corners)
        by_factor = (step[None, :, None] * g[:, None, :]).reshape(8, 3) * (np.arange(3) < self.factors)
        over = geometry.over_corners(points, *self.size_px).reshape(-1, 8)
        square = over.T @ over / len(points)
        std_px = max(self.from_bands_px[band], _LEAST_STD_PX)
        corners_px = (geometry.apply(back, geometry.apply(self.mean[band], corners)) - corners).reshape(8)
        return Expectation(corners_px, by_factor, np.asarray(std_px**2 / 8 * np.linalg.inv(square)))

    def extremes(self, band: str) -> list[Matrix]:
        """The mapping of a band where the ground was nearest and farthest in the captures that were learnt from."""
        g, nu = _coordinates(self.size_px), np.array([n for _, _, n in self.seen])
        if not self.factors:
            return [self.mean[band]]
        ends = nu[[int(nu[:, 0].argmin()), int(nu[:, 0].argmax())]]
        return [_moved(self.mean[band], np.outer(self.baselines[band], n), g, self.size_px) for n in ends]

    def _unknown_climb_px(self, known: Observation) -> float:
        """Standard deviation of the distance's factor at an altitude that the captures it is taken from do not have:
        how much it changes with a metre is known as well as they have shown it.
        """
        seen = [(a, n[0]) for _, a, n in self.seen if a is not None]
        if known.altitude_m is None or len(seen) < LEAST_CAPTURES:
            return 0.0
        altitudes, nu = (np.array(v) for v in zip(*seen, strict=True))
        slope, offset = np.polyfit(altitudes, nu, 1) if np.ptp(altitudes) > 0 else (0.0, float(nu.mean()))
        spread = max(float((nu - slope * altitudes - offset).std()), _LEAST_CLIMB_SPREAD_PX)
        information = 1 / _CLIMB_STD_PX_PER_M**2 + float(((altitudes - altitudes.mean()) ** 2).sum()) / spread**2
        nearest = float(np.abs(altitudes - known.altitude_m).min())
        return nearest / float(np.sqrt(information)) + abs(float(slope)) * nearest

    def _factors_of(self, known: Observation, bands: Sequence[str]) -> tuple[Array, float, float]:
        """(nu, its variance over all factors, what it leaves of most of these bands, px)."""
        affine = np.stack([_affine(self.mean[b], known.mappings[b], self.size_px) for b in bands])
        t = np.array([self.baselines[b] for b in bands])
        weights = np.array([_weight(known.std_px[b], self.from_bands_px[b]) for b in bands])
        nu, covariance = _solve_factors(affine, t, weights, self.factors)
        off = np.linalg.norm(affine - t[:, :, None] * nu, axis=(1, 2))
        return nu, float(np.trace(covariance)), float(np.median(off))

    def _around(self, seconds: float) -> Array:
        """Factors between those of the captures before and after."""
        moments, nu = np.array([s for s, _, _ in self.seen]), np.array([n for _, _, n in self.seen])
        order = np.argsort(moments, kind="stable")
        return np.array([np.interp(seconds, moments[order], nu[order, k]) for k in range(3)])


def learn_rig(
    captures: Sequence[Observation], size_px: tuple[int, int], layout: Mapping[str, tuple[float, float]]
) -> Rig | None:
    """The rig that some captures show; None where fewer than three show the same band.

    `layout` is what is known of where each band's lens stands, in any unit; empty where nothing is.
    """
    counts = {b: sum(b in c.mappings for c in captures) for b in dict.fromkeys(b for c in captures for b in c.mappings)}
    bands = tuple(b for b, count in counts.items() if count >= LEAST_CAPTURES)
    if not bands:
        return None
    captures = [c for c in captures if any(b in c.mappings for b in bands)]
    prior = _normalised_layout(layout, bands)
    errors = {k: _errors_left_out(captures, bands, size_px, prior, k) for k in (0, 1, 3)}
    best = 0
    for more in (1, 3):
        if len(bands) > 1 and _rms(errors[more].values()) < _PLAINLY_BETTER * _rms(errors[best].values()):
            best = more
    flight, neighbours = errors[0], _errors_of_neighbours(captures, bands, size_px, prior, best or 1)
    fitted = _fit(captures, bands, size_px, prior, best or 1)
    return Rig(
        size_px, dict(zip(bands, fitted.mean, strict=True)),
        {b: (float(t[0]), float(t[1])) for b, t in zip(bands, fitted.t, strict=True)},
        dict(zip(bands, fitted.t_std.tolist(), strict=True)),
        {b: (float(c[0]), float(c[1]), float(c[2])) for b, c in zip(bands, fitted.centre, strict=True)}, best,
        tuple(
            (c.seconds, c.altitude_m, (float(n[0]), float(n[1]), float(n[2])))
            for c, n in zip(captures, fitted.nu, strict=True)
        ),
        errors[best], neighbours, flight,
    )  # fmt: skip


# ---- the fit


@dataclass(frozen=True)
class _Fit:
    mean: list[Matrix]
    t: Array
    """(bands, 2)"""
    t_std: Array
    nu: Array
    """(captures, 3)"""
    centre: Array
    """(bands, 3) mean of nu over the captures that show a band."""


def _fit(
    captures: Sequence[Observation], bands: Sequence[str], size_px: tuple[int, int], prior: Array | None, factors: int
) -> _Fit:
    """Means, baselines and factors in turn, each by least squares with the others known. A band that a capture lacks
    says nothing of it: its mean is at the same factors as the others'.
    """
    start = [median_mapping([c.mappings[b] for c in captures if b in c.mappings], size_px) for b in bands]
    affine = np.zeros((len(captures), len(bands), 2, 3))
    weights = np.zeros((len(captures), len(bands)))
    for i, capture in enumerate(captures):
        for j, band in enumerate(bands):
            if band in capture.mappings:
                affine[i, j] = _affine(start[j], capture.mappings[band], size_px)
                weights[i, j] = _weight(capture.std_px[band], 0.0)
    t = _first_baselines(affine, weights) if prior is None else prior
    offset, nu = np.zeros((len(bands), 2, 3)), np.zeros((len(captures), 3))
    pull = 0.0 if prior is None else 1 / _LAYOUT_STD**2
    for _ in range(_ROUNDS):
        for i in range(len(captures)):
            nu[i] = _solve_factors(affine[i] - offset, t, weights[i], factors)[0]
        nu -= np.average(nu, axis=0, weights=weights.sum(axis=1))
        # A band's mean and baseline are a line through its captures: what it lacks says nothing of either.
        centre = np.einsum("ij,ik->jk", weights, nu) / weights.sum(axis=0)[:, None]
        apart = nu[:, None, :] - centre[None]
        information = np.einsum("ij,ijk->j", weights, apart**2)
        wanted = np.einsum("ij,ijak,ijk->ja", weights, affine, apart)
        t = (wanted + (0 if prior is None else pull * prior)) / np.maximum(information + pull, 1e-9)[:, None]
        t = t / max(float(np.linalg.norm(t)), 1e-12)
        level = np.einsum("ij,ijak->jak", weights, affine) / weights.sum(axis=0)[:, None, None]
        offset = level - t[:, :, None] * centre[:, None, :]
    g = _coordinates(size_px)
    mean = [_moved(m, o, g, size_px) for m, o in zip(start, offset, strict=True)]
    # What a baseline is unsure by, relative to the length of all of them, which is 1.
    t_std = 1 / np.sqrt(np.maximum(information + pull, 1e-9))
    return _Fit(mean, t, np.minimum(t_std, 1.0), nu, centre)


def _first_baselines(affine: Array, weights: Array) -> Array:
    """The one direction that explains most: the first singular vector of all bands' coordinates over all captures."""
    table = (affine * np.sqrt(weights)[:, :, None, None]).transpose(1, 2, 0, 3).reshape(2 * affine.shape[1], -1)
    left, _, _ = np.linalg.svd(table, full_matrices=False)
    return np.asarray(left[:, 0].reshape(-1, 2))


def _solve_factors(affine: Array, t: Array, weights: Array, factors: int) -> tuple[Array, Array]:
    """(nu (3,), its covariance (3, 3)) of a capture from its bands' (bands, 2, 3), a band that disagrees left aside."""
    used = np.arange(3) < factors
    precision = 1 / np.square(FACTOR_STD_PX)
    nu, vote = np.zeros(3), np.ones(len(weights))
    for _ in range(6):
        w = weights * vote
        information = (w * (t**2).sum(axis=1)).sum() + precision
        nu = np.where(used, np.einsum("j,jak,ja->k", w, affine, t) / information, 0.0)
        off = np.linalg.norm(affine - t[:, :, None] * nu, axis=(1, 2))
        vote = 1 / (1 + (off / _OUTLIER_PX) ** 2)
    return nu, np.diag(np.where(used, 1 / information, 0.0))


def _errors_left_out(
    captures: Sequence[Observation], bands: Sequence[str], size_px: tuple[int, int], prior: Array | None, factors: int
) -> dict[str, float]:
    """Root mean square error by band, px, of captures that are predicted from rigs learnt on the others."""
    squares: dict[str, list[float]] = {b: [] for b in bands}
    for out in captures:
        rest = [c for c in captures if c is not out]
        fit = _fit(rest, bands, size_px, prior, max(factors, 1))
        for j, band in enumerate(bands):
            others = [k for k, b in enumerate(bands) if b != band and b in out.mappings]
            if band not in out.mappings or not any(band in c.mappings for c in rest):
                continue
            shift = np.zeros((2, 3))
            if factors and others:
                affine = np.stack([_affine(fit.mean[k], out.mappings[bands[k]], size_px) for k in others])
                weights = np.array([_weight(out.std_px[bands[k]], 0.0) for k in others])
                shift = np.outer(fit.t[j], _solve_factors(affine, fit.t[others], weights, factors)[0])
            left = _affine(fit.mean[j], out.mappings[band], size_px) - shift
            squares[band].append(float((left**2).sum()))
    return {b: float(np.sqrt(np.mean(s))) if s else float("inf") for b, s in squares.items()}


def _errors_of_neighbours(
    captures: Sequence[Observation], bands: Sequence[str], size_px: tuple[int, int], prior: Array | None, factors: int
) -> dict[str, float]:
    """The same of captures that the ones before and after predict."""
    fit = _fit(captures, bands, size_px, prior, factors)
    moments = np.array([c.seconds for c in captures])
    squares: dict[str, list[float]] = {b: [] for b in bands}
    for i, capture in enumerate(captures):
        rest = np.argsort(moments, kind="stable")
        rest = rest[rest != i]
        nu = np.array([np.interp(capture.seconds, moments[rest], fit.nu[rest, k]) for k in range(3)])
        for j, band in enumerate(bands):
            if band in capture.mappings:
                left = _affine(fit.mean[j], capture.mappings[band], size_px) - np.outer(fit.t[j], nu)
                squares[band].append(float((left**2).sum()))
    return {b: float(np.sqrt(np.mean(s))) if s else float("inf") for b, s in squares.items()}


# ---- mappings as numbers


def _coordinates(size_px: tuple[int, int], points_px: Points | None = None) -> Array:
    """The g (points, 3) of points (points, 2), by default of a lattice over the image, over which each column has
    variance 1 but the first, which is 1.
    """
    lattice = geometry.lattice(*size_px, *_LATTICE)
    points = lattice if points_px is None else points_px
    return np.column_stack([np.ones(len(points)), (points - lattice.mean(axis=0)) / lattice.std(axis=0)])


def _affine(mean: Matrix, mapping: Matrix, size_px: tuple[int, int]) -> Array:
    """(2, 3): the difference of two mappings of one band in terms of g, px. Its norm is the root mean square
    distance, as far as that is affine.
    """
    points, g = geometry.lattice(*size_px, *_LATTICE), _coordinates(size_px)
    apart = geometry.apply(mapping, points) - geometry.apply(mean, points)
    return np.asarray(np.linalg.lstsq(g, apart, rcond=None)[0].T)


def _moved(mean: Matrix, shift: Array, g: Array, size_px: tuple[int, int]) -> Matrix:
    """The mean with (2, 3) added."""
    points = geometry.lattice(*size_px, *_LATTICE)
    found, _ = cv2.findHomography(points, geometry.apply(mean, points) + g @ shift.T, 0)
    return geometry.normalised(found)


def distance_px(one: Matrix, other: Matrix, size_px: tuple[int, int]) -> float:
    """Root mean square distance between where two homographies send an image (width, height)."""
    points: Points = geometry.lattice(*size_px, *_LATTICE)
    apart = geometry.apply(one, points) - geometry.apply(other, points)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def median_mapping(matrices: Sequence[Matrix], size_px: tuple[int, int]) -> Matrix:
    """The homography through the median of where each point of a lattice is sent."""
    if len(matrices) == 1:
        return matrices[0]
    points = geometry.lattice(*size_px, *_LATTICE)
    there = np.median([geometry.apply(m, points) for m in matrices], axis=0)
    found, _ = cv2.findHomography(points, there, 0)
    return geometry.normalised(found)


def _weight(std_px: float, left_px: float) -> float:
    return 1 / (std_px**2 + left_px**2 + _LEAST_STD_PX**2)


def _normalised_layout(layout: Mapping[str, tuple[float, float]], bands: Sequence[str]) -> Array | None:
    if not all(b in layout for b in bands):
        return None
    found = np.array([layout[b] for b in bands], dtype=np.float64)
    length = float(np.linalg.norm(found))
    return found / length if length > 0 else None


def _rms(values: Iterable[float]) -> float:
    found = np.array([v for v in values if np.isfinite(v)])
    return float(np.sqrt((found**2).mean())) if len(found) else float("inf")
