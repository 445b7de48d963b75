"""Predictions of a flight's rig: the mapping of a band in a capture, and its standard error."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.flight.factors import (
    MIN_STD_PX,
    affine_difference,
    coordinates,
    displaced,
    factor_design,
    factor_mask,
    lattice_points,
    mapping_weight,
    solve_factors,
)
from agalign.flight.rig import FACTORS, MIN_CAPTURES, NO_FACTORS, CaptureFactors, Observation, Rig
from agalign.values import geometry
from agalign.values.alignment import Prediction
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import MovingFilePx

Array = NDArray[np.float64]

_CLIMB_STD_PX_PER_M = 1.5
"""Change of the distance's factor with a metre of climb: 0.03 m of baseline 20 m above the ground."""
_MIN_CLIMB_SPREAD_PX = 0.5
"""Scatter of that factor around a straight line over the altitude, at the least."""
_MAX_TYPICAL_RATIO, _MIN_TYPICAL_PX = 6.0, 3.0
"""A capture does not set the crop where a factor exceeds the larger of the flight's median and this by the ratio."""
_MAX_GAP_RATIO = 2.0
"""Largest ratio of the gaps, to their neighbours, of the captures on which a guess is checked to that of this one."""
_MIN_CAPTURES_FOR_A_CHOICE = 6
"""With fewer captures the best of several guesses is best by chance."""


@dataclass(frozen=True)
class Expectation:
    """Displacement of the reference's corners from some mapping of a band that the rig expects, px of the reference,
    clockwise from the top left, (x, y) in turn: corners + by_factor f, with a covariance.
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


def predict_band(rig: Rig, band: str, known: Observation) -> Prediction:
    """The mapping of a band in a capture, from the known mappings of its other bands, else from the captures around it.

    Raises KeyError for a band that the rig does not know.
    """
    others = [b for b in known.mappings if b != band and b in rig.mean]
    prediction = _from_bands(rig, band, known, others) if others else _from_captures(rig, band, known)
    if rig.covers(band):
        return prediction
    return replace(prediction, std_px=MovingFilePx(np.hypot(prediction.std_px, rig.extrapolation_px[band])))


def unobserved_error_px(rig: Rig, band: str, *, by_neighbours: bool) -> MovingFilePx:
    """Root mean square error of a band in captures in which no band is known, predicted from the captures around them,
    else from the flight's mean. Raises KeyError for a band that the rig does not know.
    """
    design, squares = band_design(rig, band), []
    for capture, others in _each_left_out(rig.captures):
        guess = interpolated_in_time(capture, others) if by_neighbours else None
        error = design @ (np.array(capture.factors) - (_TYPICAL if guess is None else guess).factors)
        squares.append(float((error**2).sum()))
    return MovingFilePx(np.sqrt(np.mean(squares or [0.0]) + rig.from_bands_px[band] ** 2))


def expected_corners(rig: Rig, band: str, fixed_to_moving: Matrix) -> Expectation:
    """The expected displacement of a band's corners from a mapping close to it, whatever the capture's factors.

    The error of captures left out is spread over all homographies alike: each with the same mean square is as likely.
    Raises KeyError for a band that the rig does not know.
    """
    points, corners = lattice_points(rig.size_px), geometry.corners(*rig.size_px)
    to_fixed, centre = geometry.invert(fixed_to_moving), points.mean(axis=0)
    # (2, 2): a px along x or y of the moving image, in px of the reference.
    moving_centre = geometry.apply(fixed_to_moving, centre)
    step = geometry.apply(to_fixed, moving_centre + np.vstack([np.eye(2), -np.eye(2)]))
    jacobian = (step[:2] - step[2:]).T / 2
    by_factor = np.einsum("xa,akf,nk->nxf", jacobian, band_design(rig, band), coordinates(rig.size_px, corners))
    over = geometry.over_corners(points, *rig.size_px).reshape(-1, 8)
    mean_square = over.T @ over / len(points)
    std_px = max(rig.from_bands_px[band], MIN_STD_PX) * float(np.sqrt(abs(np.linalg.det(jacobian))))
    corners_px = (geometry.apply(to_fixed, geometry.apply(rig.mean[band], corners)) - corners).reshape(8)
    covariance = np.asarray(std_px**2 / 8 * np.linalg.inv(mean_square))
    return Expectation(corners_px, np.asarray(by_factor.reshape(8, FACTORS)), covariance)


def extreme_mappings(rig: Rig, band: str) -> list[Matrix]:
    """The mappings of a band in the learned captures at the ends of each factor's range, without captures that are
    unlike all others, such as one of a panel from a metre above it.
    """
    if not rig.factors:
        return [rig.mean[band]]
    factors = np.array([c.factors for c in rig.captures])
    typical = np.median(np.abs(factors), axis=0)
    unlike = (np.abs(factors) / (_MAX_TYPICAL_RATIO * np.maximum(typical, _MIN_TYPICAL_PX))).max(axis=1)
    # Where every capture is unlike the others in some factor, the least unlike one counts.
    factors = factors[unlike <= max(1.0, float(unlike.min()))]
    ends = {int(pick) for column in factors.T for pick in (column.argmin(), column.argmax())}
    return [displaced(rig.mean[band], band_design(rig, band) @ factors[i], rig.size_px) for i in sorted(ends)]


def band_design(rig: Rig, band: str) -> Array:
    """(2, 3, 5): the change of a band's coefficients with each factor, 0 for factors that do not count."""
    return factor_design(np.array(rig.baselines[band]), rig.delays[band]) * factor_mask(rig.factors)


def band_summaries(rig: Rig) -> list[dict[str, Any]]:
    """One entry per band: the offset of the image's centre, the baseline, and the errors of predictions, px."""
    centre = (np.array(rig.size_px, float) - 1) / 2
    return [
        {
            "band": band, "offset_px": (geometry.apply(mean, centre[None])[0] - centre).tolist(),
            "baseline": rig.baselines[band], "from_bands_px": rig.from_bands_px[band],
            "from_neighbours_px": unobserved_error_px(rig, band, by_neighbours=True),
            "from_flight_px": unobserved_error_px(rig, band, by_neighbours=False),
            "field_px": float(np.hypot(*np.moveaxis(rig.fields[band].displacements_px, -1, 0)).max())
            if band in rig.fields else None,
        }
        for band, mean in rig.mean.items()
    ]  # fmt: skip


# ---- from the other bands of the capture


def _from_bands(rig: Rig, band: str, known: Observation, others: Sequence[str]) -> Prediction:
    """The prediction from the mappings of a capture's other bands.

    Its variance is that of captures left out, in which all other bands were known, plus what these factors are less
    certain, plus the baseline's error at factors beyond any seen, plus the residual of the other bands.
    """
    design = band_design(rig, band)
    factors, covariance, excess_px = _factors_of(rig, known, others)
    if not rig.factors:
        return Prediction(rig.mean[band], "flight", MovingFilePx(np.hypot(rig.from_bands_px[band], excess_px)))
    less_certain = covariance - _usual_covariance(rig, band)
    spread = max(0.0, float(np.einsum("akf,fg,akg->", design, less_certain, design)))
    extrapolated = 2 * rig.baseline_std[band] ** 2 * _extrapolation_px2(rig, band, factors)
    error_px = MovingFilePx(np.sqrt(rig.from_bands_px[band] ** 2 + spread + extrapolated + excess_px**2))
    return Prediction(displaced(rig.mean[band], design @ factors, rig.size_px), "bands", error_px)


def _factors_of(rig: Rig, known: Observation, bands: Sequence[str]) -> tuple[Array, Array, float]:
    """(factors (5,), their covariance (5, 5), the bands' median residual beyond that of captures left out, px).

    A capture unlike all others has a large residual.
    """
    differences = np.stack([affine_difference(rig.mean[b], known.mappings[b], rig.size_px) for b in bands])
    designs = np.stack([band_design(rig, b) for b in bands])
    weights = np.array([mapping_weight(known.std_px[b], rig.from_bands_px[b]) for b in bands])
    factors, covariance = solve_factors(differences[None], designs, weights[None], factor_mask(rig.factors))
    residual_px = np.linalg.norm(differences - designs @ factors[0], axis=(1, 2))
    usual_px = np.array([rig.from_bands_px[b] for b in bands])
    excess_px2 = float(np.median(residual_px**2 - usual_px**2))
    return factors[0], covariance[0], float(np.sqrt(max(0.0, excess_px2)))


def _usual_covariance(rig: Rig, band: str) -> Array:
    """(5, 5) of the factors where all other bands of a capture are known well."""
    bands = [b for b in rig.mean if b != band]
    designs = np.stack([band_design(rig, b) for b in bands]) if bands else np.zeros((0, 2, 3, FACTORS))
    weights = np.array([[mapping_weight(MIN_STD_PX, rig.from_bands_px[b]) for b in bands]])
    _, covariance = solve_factors(np.zeros((1, len(bands), 2, 3)), designs, weights, factor_mask(rig.factors))
    return np.asarray(covariance[0])


def _extrapolation_px2(rig: Rig, band: str, factors: Array) -> float:
    """By how much factors (5,) are farther than the learned ones from where a band's mean is known, squared px."""
    learned = np.array([c.factors for c in rig.captures]) - rig.centres[band]
    return max(0.0, float(((factors - rig.centres[band]) ** 2).sum() - (learned**2).sum(axis=1).mean()))


# ---- from the captures around it


@dataclass(frozen=True)
class FactorGuess:
    """The factors of a capture in which no band is known."""

    factors: Array
    """(5,)"""
    gap: float
    """Distance to the nearest capture that they are taken from, in the unit of time, height or speed."""
    std: Array = field(default_factory=lambda: np.zeros(FACTORS))
    """(5,) standard error between captures that differ: that of a random walk which is known at both ends only."""


_Guess = Callable[[CaptureFactors, Sequence[CaptureFactors]], FactorGuess | None]
_TYPICAL = FactorGuess(np.zeros(FACTORS), 0.0)


def interpolated_in_time(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorGuess | None:
    """Factors between those of the captures before and after; None where no time is known."""
    known = [c for c in others if c.seconds is not None]
    if capture.seconds is None or not known:
        return None
    return _interpolated([c.seconds or 0.0 for c in known], capture.seconds, known)


def interpolated_in_height(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorGuess | None:
    """The distance between those of the captures below and above, the rest in time; None where no height is known."""
    known = [c for c in others if c.altitude_m is not None]
    if capture.altitude_m is None or len(known) < MIN_CAPTURES:
        return None
    by_height = _interpolated([c.altitude_m or 0.0 for c in known], capture.altitude_m, known)
    in_time = interpolated_in_time(capture, others) or _TYPICAL
    factors = np.concatenate([by_height.factors[:1], in_time.factors[1:]])
    return FactorGuess(factors, by_height.gap, np.concatenate([by_height.std[:1], in_time.std[1:]]))


def regressed_on_motion(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorGuess | None:
    """The w as a linear function of the ground's motion, the rest in time; None where no motion is known."""
    known = [c for c in others if c.motion is not None]
    if capture.motion is None or len(known) < MIN_CAPTURES:
        return None
    x = np.array([(1.0, *c.motion) for c in known if c.motion is not None])
    # Captures of one speed do not determine other speeds: the smallest slope that fits.
    scale = np.maximum(np.abs(x).max(axis=0), 1e-12)
    slope = np.linalg.lstsq(x / scale, np.array([c.factors[3:] for c in known]), rcond=1e-3)[0]
    in_time = interpolated_in_time(capture, others) or _TYPICAL
    factors = np.concatenate([in_time.factors[:3], (np.array([1.0, *capture.motion]) / scale) @ slope])
    gap = float(np.linalg.norm(x[:, 1:] - capture.motion, axis=1).min())
    return FactorGuess(factors, gap, np.concatenate([in_time.std[:3], np.zeros(2)]))


def _typical(_capture: CaptureFactors, _others: Sequence[CaptureFactors]) -> FactorGuess:
    """The factors of the flight's mean."""
    return _TYPICAL


_GUESSES: tuple[_Guess, ...] = (_typical, interpolated_in_time, interpolated_in_height, regressed_on_motion)


def _from_captures(rig: Rig, band: str, known: Observation) -> Prediction:
    """The prediction from the guess of the capture's factors that has the smallest error."""
    capture = CaptureFactors(known.seconds, known.altitude_m, known.motion, NO_FACTORS)
    guesses = _GUESSES if len(rig.captures) >= _MIN_CAPTURES_FOR_A_CHOICE else _GUESSES[:2]
    results = [(result, guess) for guess in guesses if (result := guess(capture, rig.captures)) is not None]
    errors_px = [_guess_error_px(rig, band, capture, *result) for result in results]
    best = int(np.argmin(errors_px))
    result, guess = results[best]
    if not rig.factors or guess is _typical:
        return Prediction(rig.mean[band], "flight", errors_px[best])
    mapping = displaced(rig.mean[band], band_design(rig, band) @ result.factors, rig.size_px)
    return Prediction(mapping, "neighbours", errors_px[best])


def _guess_error_px(rig: Rig, band: str, capture: CaptureFactors, result: FactorGuess, guess: _Guess) -> MovingFilePx:
    """Standard error of a guess for a band, px: the error of the same guess for learned captures with gaps as large as
    this one's, or the difference between the captures that it is taken from.
    """
    design = band_design(rig, band)
    errors: list[tuple[float, float]] = []
    for other, rest in _each_left_out(rig.captures):
        again = guess(other, rest)
        if again is not None:
            errors.append((again.gap, float(((design @ (np.array(other.factors) - again.factors)) ** 2).sum())))
    if not errors and guess is not _typical:
        return MovingFilePx(math.inf)  # no capture that was left out measures its error
    errors.sort()
    alike = [square for gap, square in errors if gap <= _MAX_GAP_RATIO * result.gap]
    squares = alike if len(alike) >= MIN_CAPTURES else [square for _, square in errors[:MIN_CAPTURES]]
    # Of few captures the mean square may be small by chance.
    inflation = (len(squares) + 1) / max(len(squares) - 1, 1)
    between = float(((design @ result.std) ** 2).sum())
    climb_px = _unknown_climb_px(rig, capture.altitude_m) * float(np.linalg.norm(rig.baselines[band]))
    square = max(inflation * float(np.mean(squares or [0.0])), between) + rig.from_bands_px[band] ** 2 + climb_px**2
    return MovingFilePx(np.sqrt(square))


def _unknown_climb_px(rig: Rig, altitude_m: float | None) -> float:
    """Standard error of the distance's factor at an altitude that no learned capture has: its change with a metre is
    known as well as they have shown it.
    """
    known = [(c.altitude_m, c.factors[0]) for c in rig.captures if c.altitude_m is not None]
    if altitude_m is None or len(known) < MIN_CAPTURES:
        return 0.0
    altitudes, distances = (np.array(v) for v in zip(*known, strict=True))
    slope, offset = np.polyfit(altitudes, distances, 1) if np.ptp(altitudes) > 0 else (0.0, float(distances.mean()))
    spread = max(float((distances - slope * altitudes - offset).std()), _MIN_CLIMB_SPREAD_PX)
    precision = 1 / _CLIMB_STD_PX_PER_M**2 + float(((altitudes - altitudes.mean()) ** 2).sum()) / spread**2
    nearest = float(np.abs(altitudes - altitude_m).min())
    return nearest / float(np.sqrt(precision)) + abs(float(slope)) * nearest


def _each_left_out(captures: Sequence[CaptureFactors]) -> list[tuple[CaptureFactors, list[CaptureFactors]]]:
    """Each capture with all others."""
    return [(capture, [*captures[:i], *captures[i + 1 :]]) for i, capture in enumerate(captures)]


def _interpolated(positions: Sequence[float], position: float, captures: Sequence[CaptureFactors]) -> FactorGuess:
    """Factors interpolated linearly between those of captures at some positions."""
    order = np.argsort(positions, kind="stable")
    at, factors = np.array(positions)[order], np.array([c.factors for c in captures])[order]
    result = np.array([np.interp(position, at, column) for column in factors.T])
    after = int(np.searchsorted(at, position))
    std = np.zeros(FACTORS)
    if 0 < after < len(at) and at[after] > at[after - 1]:
        share = (position - at[after - 1]) / (at[after] - at[after - 1])
        std = np.abs(factors[after] - factors[after - 1]) * np.sqrt(share * (1 - share))
    return FactorGuess(result, float(np.abs(at - position).min()), std)
