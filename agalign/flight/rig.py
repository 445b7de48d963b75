"""The rig of a flight: what the mappings of all bands have in common from capture to capture.

A plane induces between two cameras of a rig the homography H_b = A_b + e_b nu^T, with A_b and e_b the rig's and
nu = n / d, the ground's normal over its distance, the capture's (Hartley & Zisserman, Eq. 13.2). A rig that exposes its
bands one after another sees the ground move in between, by w times the band's delay. Around the flight's mean m_b that
is, at the pixel x of the reference,

    H_b(c) x = m_b(x) + t_b (nu_c . g(x)) + d_b w_c + what is left

with t_b (2,) the direction in which the band's lens stands in the rig, d_b its delay, and the capture's factors, which
ALL its bands share: nu_c (3,), over g = (1, u, v), the image's coordinates, scaled so that each has mean 0 and variance
1 over the image (the ground's distance moves each band along its own baseline, its tilt does so in proportion to the
place in the image), and w_c (2,). The t_b together have length 1, and so have the d_b: the factors are in px.

Which of them count is decided by leaving captures out (`learn_rig`): each is predicted from rigs learnt on the others,
band by band from its other bands. What that misses is the error bar of a prediction.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import DisplacementField, Prediction
from agalign.values.geometry import Matrix, Points

Array = NDArray[np.float64]
Factor = Literal["distance", "tilt", "motion", "reference"]

FACTORS = 5
"""nu and w together."""
NO_FACTORS: tuple[float, ...] = (0.0,) * FACTORS
FACTOR_STD_PX = (20.0, 3.0, 3.0, 20.0, 20.0)
"""How far from the mean a capture may be before its own bands are doubted: wide, for heights that nobody has seen."""
MIN_CAPTURES = 3
MIN_STD_PX = 0.05
"""Of a mapping: what its own uncertainty does not know."""
_COLUMNS: dict[Factor, tuple[int, ...]] = {"distance": (0,), "tilt": (1, 2), "motion": (3, 4), "reference": (3, 4)}
_LATTICE = 7, 5
_CLIMB_STD_PX_PER_M = 1.5
"""What a metre of climb may do to the factor of the ground's distance: 0.03 m of baseline 20 m above it."""
_MIN_CLIMB_SPREAD_PX = 0.5
_OUTLIER_PX = 0.3
_UNLIKE, _MIN_UNLIKE_PX = 6.0, 3.0
"""A capture whose factors are so many times as far from the typical one's as most are does not set the crop."""


@dataclass(frozen=True)
class Observation:
    """The mappings of one capture, as they were found."""

    seconds: float | None
    """When it was taken, from any beginning; None where that is unknown."""
    mappings: Mapping[str, Matrix]
    """fixed_to_moving by band, undistorted px of the files."""
    std_px: Mapping[str, float]
    """How sure each is."""
    altitude_m: float | None = None
    """As the camera has it, above anything."""
    motion: tuple[float, float] | None = None
    """How fast the ground passes, right and down in the image, in any unit."""


@dataclass(frozen=True)
class Seen:
    """A capture that a rig was learnt on."""

    seconds: float | None
    altitude_m: float | None
    motion: tuple[float, float] | None
    factors: tuple[float, ...]
    """(5,) nu and w."""


@dataclass(frozen=True)
class Expectation:
    """Where the corners of the reference should move beside some mapping of a band, px of the reference, clockwise from
    the top left, (x, y) in turn: corners + by_factor f, with a covariance.
    """

    corners: Array
    """(8,)"""
    by_factor: Array
    """(8, 5)"""
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
    delays: Mapping[str, float]
    """d_b by band."""
    baseline_std: Mapping[str, float]
    """Of either coordinate of t_b."""
    centres: Mapping[str, tuple[float, ...]]
    """Mean factors (5,) of the captures that showed a band: there its mean is best known."""
    factors: tuple[Factor, ...]
    """Which of them a capture adds."""
    seen: tuple[Seen, ...]
    """The captures that it was learnt on, in their order."""
    from_bands_px: Mapping[str, float]
    """Root mean square error of each band as the other bands of captures left out predict it. Of a band all is in px
    of its own file.
    """
    fields: Mapping[str, DisplacementField] = field(default_factory=dict)
    """What no homography explains and all captures have in common, raw px of the reference's file, by band."""

    def as_json(self) -> str:
        """Everything but the fields' values, as text."""
        facts = {k: v for k, v in vars(self).items() if k not in ("mean", "fields", "seen")}
        facts["mean"] = {b: m.tolist() for b, m in self.mean.items()}
        facts["seen"] = [vars(s) for s in self.seen]
        return json.dumps(facts | {"field_steps_px": {b: f.step_px for b, f in self.fields.items()}})

    @classmethod
    def from_json(cls, text: str, fields: Mapping[str, Array]) -> "Rig":
        """The inverse, with the fields' values (rows, columns, 2) by band. Raises KeyError, TypeError, ValueError."""
        facts = json.loads(text)
        steps = facts.pop("field_steps_px")
        width, height = facts.pop("size_px")
        return cls(
            size_px=(int(width), int(height)), mean={b: np.array(m) for b, m in facts.pop("mean").items()},
            baselines={b: (x, y) for b, (x, y) in facts.pop("baselines").items()},
            centres={b: tuple(c) for b, c in facts.pop("centres").items()}, factors=tuple(facts.pop("factors")),
            seen=tuple(_seen(s) for s in facts.pop("seen")),
            fields={b: DisplacementField(steps[b], values) for b, values in fields.items()}, **facts,
        )  # fmt: skip

    def predict(self, band: str, known: Observation) -> Prediction:
        """Where a band lies, from what is known of the capture's others, else from the captures around it.

        Raises KeyError for a band that the rig does not know.
        """
        mean, here = self.mean[band], self._design(band)
        others = [b for b in known.mappings if b != band and b in self.mean]
        if others:
            result, covariance, off = self._factors_of(known, others)
            if not self.factors:
                return Prediction(mean, "flight", float(np.hypot(self.from_bands_px[band], off)))
            # What bands missed in captures left out, where all others were known; what these factors are known less,
            # errors of the baseline at factors beyond any seen, and what the others of this capture leave: one unlike
            # all others shows there.
            spread = float(np.einsum("akf,fg,akg->", here, covariance - self._usual_covariance(band), here))
            spread = max(0.0, spread)
            beyond = 2 * self.baseline_std[band] ** 2 * self._beyond(band, result)
            error = float(np.sqrt(self.from_bands_px[band] ** 2 + spread + beyond + off**2))
            return Prediction(moved(mean, here @ result, self.size_px), "bands", error)
        like = Seen(known.seconds, known.altitude_m, known.motion, NO_FACTORS)
        guesses = _GUESSES if len(self.seen) >= _MIN_FOR_A_CHOICE else _GUESSES[:2]
        guess, error_px = min((self._told(g, like, band) for g in guesses), key=lambda told: told[1])
        if not self.factors or guess is None:
            return Prediction(mean, "flight", error_px)
        return Prediction(moved(mean, here @ guess, self.size_px), "neighbours", error_px)

    def missed_px(self, band: str, *, by_neighbours: bool) -> float:
        """Root mean square error of a band in captures of which nothing is known but when, how high and how fast they
        were flown, or not even that: by captures around them, else by the flight's typical one.
        """
        here, squares = self._design(band), []
        for i, seen in enumerate(self.seen):
            rest = [*self.seen[:i], *self.seen[i + 1 :]]
            guess = around_in_time(seen, rest) if by_neighbours else None
            off = here @ (np.array(seen.factors) - (0.0 if guess is None else guess.factors))
            squares.append(float((off**2).sum()))
        return float(np.sqrt(np.mean(squares or [0.0]) + self.from_bands_px[band] ** 2))

    def _told(self, guess: "_Guess | None", like: Seen, band: str) -> tuple[Array | None, float]:
        """(factors of a capture from what is known of those around it, its error bar for a band, px): what the same
        guess misses of captures that lie as far from the others as this one does, or what those around it differ by.
        """
        here = self._design(band)
        result = _TYPICAL if guess is None else guess(like, self.seen)
        if result is None:
            return None, np.inf
        missed: list[tuple[float, float]] = []
        for i, seen in enumerate(self.seen):
            other = _TYPICAL if guess is None else guess(seen, [*self.seen[:i], *self.seen[i + 1 :]])
            if other is not None:
                missed.append((other.gap, float(((here @ (np.array(seen.factors) - other.factors)) ** 2).sum())))
        if guess is not None and not missed:
            return None, np.inf  # its error cannot be measured
        missed.sort()
        alike = [m for gap, m in missed if gap <= _AS_FAR * result.gap]
        enough = alike if len(alike) >= MIN_CAPTURES else [m for _, m in missed[:MIN_CAPTURES]]
        climb_px = self._unknown_climb_px(like.altitude_m) * float(np.linalg.norm(self.baselines[band]))
        # Of few captures the mean square may be small by chance.
        few = (len(enough) + 1) / max(len(enough) - 1, 1)
        between = float(((here @ result.std) ** 2).sum())
        square = max(few * float(np.mean(enough or [0.0])), between) + self.from_bands_px[band] ** 2 + climb_px**2
        return None if guess is None else result.factors, float(np.sqrt(square))

    def expectation(self, band: str, fixed_to_moving: Matrix) -> Expectation:
        """Where a band should lie beside a mapping close to it, whatever the factors of its capture.

        What captures left out missed is spread over all homographies alike: each with the same mean square is as
        likely. Raises KeyError for a band that the rig does not know.
        """
        points, corners = geometry.lattice(*self.size_px, *_LATTICE), geometry.corners(*self.size_px)
        back, middle = geometry.invert(fixed_to_moving), points.mean(axis=0)
        # What is a px along x or y of the moving image, in px of the reference.
        there = geometry.apply(fixed_to_moving, middle)
        step = geometry.apply(back, there + np.vstack([np.eye(2), -np.eye(2)]))
        turn = (step[:2] - step[2:]).T / 2
        by_factor = np.einsum("xa,akf,nk->nxf", turn, self._design(band), coordinates(self.size_px, corners))
        over = geometry.over_corners(points, *self.size_px).reshape(-1, 8)
        square = over.T @ over / len(points)
        std_px = max(self.from_bands_px[band], MIN_STD_PX) * float(np.sqrt(abs(np.linalg.det(turn))))
        corners_px = (geometry.apply(back, geometry.apply(self.mean[band], corners)) - corners).reshape(8)
        covariance = np.asarray(std_px**2 / 8 * np.linalg.inv(square))
        return Expectation(corners_px, np.asarray(by_factor.reshape(8, FACTORS)), covariance)

    def extremes(self, band: str) -> list[Matrix]:
        """The mapping of a band in the captures that were learnt from at whose factors it lies farthest out; without
        those that are unlike all others, as a panel's from a metre up is.
        """
        if not self.factors:
            return [self.mean[band]]
        factors = np.array([s.factors for s in self.seen])
        spread = np.median(np.abs(factors), axis=0)
        unlike = (np.abs(factors) / (_UNLIKE * np.maximum(spread, _MIN_UNLIKE_PX))).max(axis=1)
        # Where each capture is unlike the others in some factor, the one that is least so stays.
        factors = factors[unlike <= max(1.0, float(unlike.min()))]
        ends = {int(pick) for column in factors.T for pick in (column.argmin(), column.argmax())}
        return [moved(self.mean[band], self._design(band) @ factors[i], self.size_px) for i in sorted(ends)]

    def _design(self, band: str) -> Array:
        """(2, 3, 5): what each factor that counts does to a band, in terms of g."""
        return design(np.array(self.baselines[band]), self.delays[band]) * used(self.factors)

    def _beyond(self, band: str, result: Array) -> float:
        """By how much factors lie farther from where a band is known than those seen, squared px."""
        seen = np.array([s.factors for s in self.seen]) - self.centres[band]
        return max(0.0, float(((result - self.centres[band]) ** 2).sum() - (seen**2).sum(axis=1).mean()))

    def _unknown_climb_px(self, altitude_m: float | None) -> float:
        """Standard deviation of the distance's factor at an altitude that the captures it is taken from do not have:
        how much it changes with a metre is known as well as they have shown it.
        """
        seen = [(s.altitude_m, s.factors[0]) for s in self.seen if s.altitude_m is not None]
        if altitude_m is None or len(seen) < MIN_CAPTURES:
            return 0.0
        altitudes, nu = (np.array(v) for v in zip(*seen, strict=True))
        slope, offset = np.polyfit(altitudes, nu, 1) if np.ptp(altitudes) > 0 else (0.0, float(nu.mean()))
        spread = max(float((nu - slope * altitudes - offset).std()), _MIN_CLIMB_SPREAD_PX)
        information = 1 / _CLIMB_STD_PX_PER_M**2 + float(((altitudes - altitudes.mean()) ** 2).sum()) / spread**2
        nearest = float(np.abs(altitudes - altitude_m).min())
        return nearest / float(np.sqrt(information)) + abs(float(slope)) * nearest

    def _usual_covariance(self, band: str) -> Array:
        """(5, 5) of the factors where all other bands of a capture are known well."""
        bands = [b for b in self.mean if b != band]
        designs = np.stack([self._design(b) for b in bands]) if bands else np.zeros((0, 2, 3, FACTORS))
        weights = np.array([[weight(MIN_STD_PX, self.from_bands_px[b]) for b in bands]])
        _, covariance = solve_factors(np.zeros((1, len(bands), 2, 3)), designs, weights, used(self.factors))
        return np.asarray(covariance[0])

    def _factors_of(self, known: Observation, bands: Sequence[str]) -> tuple[Array, Array, float]:
        """(factors (5,), their covariance (5, 5), by how much more they leave of most of these bands than of captures
        left out, px).
        """
        there = np.stack([affine(self.mean[b], known.mappings[b], self.size_px) for b in bands])
        designs = np.stack([self._design(b) for b in bands])
        weights = np.array([weight(known.std_px[b], self.from_bands_px[b]) for b in bands])
        result, covariance = solve_factors(there[None], designs, weights[None], used(self.factors))
        off = np.linalg.norm(there - designs @ result[0], axis=(1, 2))
        usual = np.array([self.from_bands_px[b] for b in bands])
        return result[0], covariance[0], float(np.sqrt(max(0.0, float(np.median(off**2 - usual**2)))))


def _seen(facts: Mapping[str, Any]) -> Seen:
    motion = facts["motion"]
    return Seen(
        facts["seconds"], facts["altitude_m"], None if motion is None else (motion[0], motion[1]),
        tuple(facts["factors"]),
    )  # fmt: skip


# ---- factors


def used(factors: Sequence[Factor]) -> Array:
    """(5,): 1 where a column of the factors counts."""
    result = np.zeros(FACTORS)
    for factor in factors:
        result[list(_COLUMNS[factor])] = 1.0
    return result


def design(t: Array, delay: float) -> Array:
    """(2, 3, 5): what each factor does to a band with a baseline t (2,) and a delay, in terms of g."""
    result = np.zeros((2, 3, FACTORS))
    result[:, range(3), range(3)] = t[:, None]
    result[(0, 1), 0, (3, 4)] = delay
    return result


def solve_factors(there: Array, designs: Array, weights: Array, counts: Array) -> tuple[Array, Array]:
    """(factors (captures, 5), covariances (captures, 5, 5)) from what the bands of each capture show beside their
    means, (captures, bands, 2, 3), with weights (captures, bands); a band that disagrees is left aside.
    """
    x = (designs * counts).reshape(len(designs), 6, FACTORS)
    y = there.reshape(*there.shape[:2], 6)
    prior = np.diag(1 / np.square(FACTOR_STD_PX))
    vote = np.ones_like(weights)
    for _ in range(6):
        w = weights * vote
        covariance = np.linalg.inv(np.einsum("cb,bif,big->cfg", w, x, x) + prior)
        result = np.einsum("cfg,cg->cf", covariance, np.einsum("cbi,big->cg", w[:, :, None] * y, x))
        off2 = ((y - np.einsum("bif,cf->cbi", x, result)) ** 2).sum(axis=2)
        vote = 1 / (1 + off2 / _OUTLIER_PX**2)
    return result, covariance * np.outer(counts, counts)


@dataclass(frozen=True)
class Guessed:
    """The factors of a capture of which no band is known."""

    factors: Array
    """(5,)"""
    gap: float
    """How far it lies from the captures that they are taken from, in what they are taken by."""
    std: Array = field(default_factory=lambda: np.zeros(FACTORS))
    """(5,) how far off they may be between captures that differ: as a walk that is known at both ends only."""


_Guess = Callable[[Seen, Sequence[Seen]], Guessed | None]
_TYPICAL = Guessed(np.zeros(FACTORS), 0.0)


def around_in_time(like: Seen, seen: Sequence[Seen]) -> Guessed | None:
    """Factors between those of the captures before and after; None where no time is known."""
    known = [s for s in seen if s.seconds is not None]
    if like.seconds is None or not known:
        return None
    return _between([s.seconds or 0.0 for s in known], like.seconds, known)


def around_in_height(like: Seen, seen: Sequence[Seen]) -> Guessed | None:
    """The distance between those of the captures below and above, the rest in time; None where no height is known."""
    known = [s for s in seen if s.altitude_m is not None]
    if like.altitude_m is None or len(known) < MIN_CAPTURES:
        return None
    by_height = _between([s.altitude_m or 0.0 for s in known], like.altitude_m, known)
    in_time = around_in_time(like, seen) or Guessed(np.zeros(FACTORS), 0.0)
    factors, std = in_time.factors, in_time.std
    factors[0], std[0] = by_height.factors[0], by_height.std[0]
    return Guessed(factors, by_height.gap, std)


def by_motion(like: Seen, seen: Sequence[Seen]) -> Guessed | None:
    """W as a linear function of the ground's motion, the rest in time; None where no motion is known."""
    known = [s for s in seen if s.motion is not None]
    if like.motion is None or len(known) < MIN_CAPTURES:
        return None
    x = np.array([(1.0, *s.motion) for s in known if s.motion is not None])
    # Where all flew alike nothing is said of other motions: the least slope that fits.
    scale = np.maximum(np.abs(x).max(axis=0), 1e-12)
    slope = np.linalg.lstsq(x / scale, np.array([s.factors[3:] for s in known]), rcond=1e-3)[0]
    in_time = around_in_time(like, seen) or Guessed(np.zeros(FACTORS), 0.0)
    factors, std = in_time.factors, in_time.std
    factors[3:], std[3:] = (np.array([1.0, *like.motion]) / scale) @ slope, 0.0
    return Guessed(factors, float(np.linalg.norm(x[:, 1:] - like.motion, axis=1).min()), std)


_GUESSES: tuple[_Guess | None, ...] = (None, around_in_time, around_in_height, by_motion)
_AS_FAR = 2.0
_MIN_FOR_A_CHOICE = 6
"""With fewer captures the best of several guesses is best by chance."""


def _between(places: Sequence[float], place: float, seen: Sequence[Seen]) -> Guessed:
    order = np.argsort(places, kind="stable")
    at, factors = np.array(places)[order], np.array([s.factors for s in seen])[order]
    result = np.array([np.interp(place, at, column) for column in factors.T])
    after = int(np.searchsorted(at, place))
    std = np.zeros(FACTORS)
    if 0 < after < len(at) and at[after] > at[after - 1]:
        share = (place - at[after - 1]) / (at[after] - at[after - 1])
        std = np.abs(factors[after] - factors[after - 1]) * np.sqrt(share * (1 - share))
    return Guessed(result, float(np.abs(at - place).min()), std)


# ---- mappings as numbers


def coordinates(size_px: tuple[int, int], points_px: Points | None = None) -> Array:
    """The g (points, 3) of points (points, 2), by default of a lattice over the image, over which each column has
    variance 1 but the first, which is 1.
    """
    lattice = geometry.lattice(*size_px, *_LATTICE)
    points = lattice if points_px is None else points_px
    return np.column_stack([np.ones(len(points)), (points - lattice.mean(axis=0)) / lattice.std(axis=0)])


def affine(mean: Matrix, mapping: Matrix, size_px: tuple[int, int]) -> Array:
    """(2, 3): the difference of two mappings of one band in terms of g, px. Its norm is the root mean square
    distance, as far as that is affine.
    """
    points = geometry.lattice(*size_px, *_LATTICE)
    apart = geometry.apply(mapping, points) - geometry.apply(mean, points)
    return np.asarray(np.linalg.lstsq(coordinates(size_px), apart, rcond=None)[0].T)


def moved(mean: Matrix, shift: Array, size_px: tuple[int, int]) -> Matrix:
    """The mean with (2, 3) in terms of g added."""
    points = geometry.lattice(*size_px, *_LATTICE)
    return geometry.fit_homography(points, geometry.apply(mean, points) + coordinates(size_px) @ shift.T)


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
    return geometry.fit_homography(points, np.median([geometry.apply(m, points) for m in matrices], axis=0))


def weight(std_px: float, left_px: float = 0.0) -> float:
    """Of a mapping that is known so well, in a model that leaves so much."""
    return 1 / (std_px**2 + left_px**2 + MIN_STD_PX**2)
