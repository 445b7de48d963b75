"""Prediction of the mapping of a band in a capture, and of its standard error, from the rig of a flight."""

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

_ALTITUDE_SLOPE_STD_PX_PER_M = 1.5
"""Prior of the change of the distance factor per metre of altitude: a baseline of 0.03 m, 20 m above the ground."""
_MIN_ALTITUDE_SCATTER_PX = 0.5
"""Minimum scatter of the distance factor around its linear regression on the altitude."""
_MAX_MEDIAN_RATIO, _MIN_MEDIAN_PX = 6.0, 3.0
"""A capture is an outlier if a factor exceeds the ratio times the flight's median, or times the minimum median."""
_MAX_GAP_RATIO = 2.0
"""An estimate is validated on captures with a gap of at most this ratio to the gap of the predicted capture."""
_MIN_CAPTURES_TO_SELECT = 6
"""With fewer captures, the estimator with the smallest error would be selected by chance."""


@dataclass(frozen=True)
class Expectation:
    """Prior distribution of the displacements of the reference's corners between a mapping of a band and the rig's.

    The mean is corners + by_factor @ f for the factors f (5,) of a capture. Displacements are (x, y) of the corners in
    turn, clockwise from the top left, px of the reference.
    """

    corners: Array
    """(8,) displacements for factors of 0."""
    by_factor: Array
    """(8, 5) derivative with respect to the factors."""
    covariance: Array
    """(8, 8) for known factors, px squared."""

    def rescaled(self, scale: tuple[float, float]) -> "Expectation":
        """Convert to an image that is larger by the factors (x, y)."""
        factor = np.tile(scale, 4)
        return Expectation(
            self.corners * factor, self.by_factor * factor[:, None], self.covariance * np.outer(factor, factor)
        )


def predict_band(rig: Rig, band: str, known: Observation) -> Prediction:
    """Predict the mapping of a band from the known mappings of the other bands, or without any from other captures.

    Raises KeyError for a band that the rig does not contain.
    """
    others = [b for b in known.mappings if b != band and b in rig.mean]
    prediction = _from_bands(rig, band, known, others) if others else _from_captures(rig, band, known)
    if rig.covers(band):
        return prediction
    return replace(prediction, std_px=MovingFilePx(np.hypot(prediction.std_px, rig.extrapolation_px[band])))


def unobserved_error_px(rig: Rig, band: str, *, by_neighbours: bool) -> MovingFilePx:
    """Return the RMS error of a band in captures without any known band.

    They are predicted from the captures before and after (`by_neighbours`) or from the flight's mean. Raises KeyError
    for a band that the rig does not contain.
    """
    design, squares = band_design(rig, band), []
    for capture, others in _leave_one_out(rig.captures):
        estimate = interpolated_in_time(capture, others) if by_neighbours else None
        error = design @ (np.array(capture.factors) - (_MEAN if estimate is None else estimate).factors)
        squares.append(float((error**2).sum()))
    return MovingFilePx(np.sqrt(np.mean(squares or [0.0]) + rig.from_bands_px[band] ** 2))


def expected_corners(rig: Rig, band: str, fixed_to_moving: Matrix) -> Expectation:
    """Return the prior of the corner displacements of a band relative to `fixed_to_moving`, for unknown factors.

    The covariance distributes the cross-validated error over all homographies: those with equal mean square are
    equally likely. Raises KeyError for a band that the rig does not contain.
    """
    points, corners = lattice_points(rig.size_px), geometry.corners(*rig.size_px)
    to_fixed, centre = geometry.invert(fixed_to_moving), points.mean(axis=0)
    # (2, 2) Jacobian of moving_to_fixed at the centre, by central differences.
    moving_centre = geometry.apply(fixed_to_moving, centre)
    shifted = geometry.apply(to_fixed, moving_centre + np.vstack([np.eye(2), -np.eye(2)]))
    jacobian = (shifted[:2] - shifted[2:]).T / 2
    by_factor = np.einsum("xa,akf,nk->nxf", jacobian, band_design(rig, band), coordinates(rig.size_px, corners))
    over = geometry.over_corners(points, *rig.size_px).reshape(-1, 8)
    mean_square = over.T @ over / len(points)
    std_px = max(rig.from_bands_px[band], MIN_STD_PX) * float(np.sqrt(abs(np.linalg.det(jacobian))))
    corners_px = (geometry.apply(to_fixed, geometry.apply(rig.mean[band], corners)) - corners).reshape(8)
    covariance = np.asarray(std_px**2 / 8 * np.linalg.inv(mean_square))
    return Expectation(corners_px, np.asarray(by_factor.reshape(8, FACTORS)), covariance)


def extreme_mappings(rig: Rig, band: str) -> list[Matrix]:
    """Return the mappings of a band in the captures with the minimum and maximum of each factor.

    Outliers, such as a capture of a panel from one metre above it, are excluded.
    """
    if not rig.factors:
        return [rig.mean[band]]
    factors = np.array([c.factors for c in rig.captures])
    median = np.median(np.abs(factors), axis=0)
    outlyingness = (np.abs(factors) / (_MAX_MEDIAN_RATIO * np.maximum(median, _MIN_MEDIAN_PX))).max(axis=1)
    # If every capture is an outlier in some factor, keep the least outlying one.
    factors = factors[outlyingness <= max(1.0, float(outlyingness.min()))]
    extremes = {int(i) for column in factors.T for i in (column.argmin(), column.argmax())}
    return [displaced(rig.mean[band], band_design(rig, band) @ factors[i], rig.size_px) for i in sorted(extremes)]


def band_design(rig: Rig, band: str) -> Array:
    """Return (2, 3, 5) the derivative of a band's coefficients with respect to the factors; 0 for unused factors."""
    return factor_design(np.array(rig.baselines[band]), rig.delays[band]) * factor_mask(rig.factors)


def band_summaries(rig: Rig) -> list[dict[str, Any]]:
    """Return for each band the offset of the image centre, the baseline and the errors of predictions, px."""
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
    """Predict a band from the mappings of the other bands of the capture.

    The variance is the sum of the cross-validated variance, the additional variance of the factors compared with
    captures in which all other bands are known, the variance by the baseline's error when the factors are outside the
    learned range, and the excess residual of the other bands.
    """
    design = band_design(rig, band)
    factors, covariance, excess_px = _factors_of(rig, known, others)
    if not rig.factors:
        return Prediction(rig.mean[band], "flight", MovingFilePx(np.hypot(rig.from_bands_px[band], excess_px)))
    additional_covariance = covariance - _complete_covariance(rig, band)
    additional_px2 = max(0.0, float(np.einsum("akf,fg,akg->", design, additional_covariance, design)))
    baseline_px2 = 2 * rig.baseline_std[band] ** 2 * _extrapolation_px2(rig, band, factors)
    error_px = MovingFilePx(np.sqrt(rig.from_bands_px[band] ** 2 + additional_px2 + baseline_px2 + excess_px**2))
    return Prediction(displaced(rig.mean[band], design @ factors, rig.size_px), "bands", error_px)


def _factors_of(rig: Rig, known: Observation, bands: Sequence[str]) -> tuple[Array, Array, float]:
    """Return the factors (5,), their covariance (5, 5), and the excess residual of the bands, px.

    The excess residual is the square root of the median squared residual minus the cross-validated variance. It is
    large for a capture that the rig does not describe.
    """
    differences = np.stack([affine_difference(rig.mean[b], known.mappings[b], rig.size_px) for b in bands])
    designs = np.stack([band_design(rig, b) for b in bands])
    weights = np.array([mapping_weight(known.std_px[b], rig.from_bands_px[b]) for b in bands])
    factors, covariance = solve_factors(differences[None], designs, weights[None], factor_mask(rig.factors))
    residual_px = np.linalg.norm(differences - designs @ factors[0], axis=(1, 2))
    expected_px = np.array([rig.from_bands_px[b] for b in bands])
    excess_px2 = float(np.median(residual_px**2 - expected_px**2))
    return factors[0], covariance[0], float(np.sqrt(max(0.0, excess_px2)))


def _complete_covariance(rig: Rig, band: str) -> Array:
    """Return the covariance (5, 5) of the factors of a capture in which all other bands are accurately known."""
    bands = [b for b in rig.mean if b != band]
    designs = np.stack([band_design(rig, b) for b in bands]) if bands else np.zeros((0, 2, 3, FACTORS))
    weights = np.array([[mapping_weight(MIN_STD_PX, rig.from_bands_px[b]) for b in bands]])
    _, covariance = solve_factors(np.zeros((1, len(bands), 2, 3)), designs, weights, factor_mask(rig.factors))
    return np.asarray(covariance[0])


def _extrapolation_px2(rig: Rig, band: str, factors: Array) -> float:
    """Return the squared distance of factors (5,) from the band's centre minus the mean of the learned captures."""
    learned = np.array([c.factors for c in rig.captures]) - rig.centres[band]
    return max(0.0, float(((factors - rig.centres[band]) ** 2).sum() - (learned**2).sum(axis=1).mean()))


# ---- from other captures


@dataclass(frozen=True)
class FactorEstimate:
    """Estimated factors of a capture without any known band."""

    factors: Array
    """(5,)"""
    gap: float
    """Distance to the nearest capture used, in the unit of the time, altitude or motion."""
    std: Array = field(default_factory=lambda: np.zeros(FACTORS))
    """(5,) standard error of an interpolation: a Brownian bridge between the two captures."""


_Estimator = Callable[[CaptureFactors, Sequence[CaptureFactors]], FactorEstimate | None]
_MEAN = FactorEstimate(np.zeros(FACTORS), 0.0)


def interpolated_in_time(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorEstimate | None:
    """Interpolate the factors between the captures before and after; None if times are unknown."""
    known = [c for c in others if c.seconds is not None]
    if capture.seconds is None or not known:
        return None
    return _interpolated([c.seconds or 0.0 for c in known], capture.seconds, known)


def interpolated_in_height(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorEstimate | None:
    """Interpolate the distance over the altitude and the other factors in time; None if altitudes are unknown."""
    known = [c for c in others if c.altitude_m is not None]
    if capture.altitude_m is None or len(known) < MIN_CAPTURES:
        return None
    in_height = _interpolated([c.altitude_m or 0.0 for c in known], capture.altitude_m, known)
    in_time = interpolated_in_time(capture, others) or _MEAN
    factors = np.concatenate([in_height.factors[:1], in_time.factors[1:]])
    return FactorEstimate(factors, in_height.gap, np.concatenate([in_height.std[:1], in_time.std[1:]]))


def regressed_on_motion(capture: CaptureFactors, others: Sequence[CaptureFactors]) -> FactorEstimate | None:
    """Estimate w by linear regression on the image motion, the other factors in time; None if motion is unknown."""
    known = [c for c in others if c.motion is not None]
    if capture.motion is None or len(known) < MIN_CAPTURES:
        return None
    x = np.array([(1.0, *c.motion) for c in known if c.motion is not None])
    # Captures of similar speed do not determine the slope: `rcond` selects the solution of minimum norm.
    scale = np.maximum(np.abs(x).max(axis=0), 1e-12)
    slope = np.linalg.lstsq(x / scale, np.array([c.factors[3:] for c in known]), rcond=1e-3)[0]
    in_time = interpolated_in_time(capture, others) or _MEAN
    factors = np.concatenate([in_time.factors[:3], (np.array([1.0, *capture.motion]) / scale) @ slope])
    gap = float(np.linalg.norm(x[:, 1:] - capture.motion, axis=1).min())
    return FactorEstimate(factors, gap, np.concatenate([in_time.std[:3], np.zeros(2)]))


def _mean(_capture: CaptureFactors, _others: Sequence[CaptureFactors]) -> FactorEstimate:
    """Return the factors of the flight's mean."""
    return _MEAN


_ESTIMATORS: tuple[_Estimator, ...] = (_mean, interpolated_in_time, interpolated_in_height, regressed_on_motion)


def _from_captures(rig: Rig, band: str, known: Observation) -> Prediction:
    """Predict a band from the estimate of the capture's factors with the smallest standard error."""
    capture = CaptureFactors(known.seconds, known.altitude_m, known.motion, NO_FACTORS)
    estimators = _ESTIMATORS if len(rig.captures) >= _MIN_CAPTURES_TO_SELECT else _ESTIMATORS[:2]
    results = [(estimate, f) for f in estimators if (estimate := f(capture, rig.captures)) is not None]
    errors_px = [_estimate_error_px(rig, band, capture, *result) for result in results]
    best = int(np.argmin(errors_px))
    estimate, estimator = results[best]
    if not rig.factors or estimator is _mean:
        return Prediction(rig.mean[band], "flight", errors_px[best])
    mapping = displaced(rig.mean[band], band_design(rig, band) @ estimate.factors, rig.size_px)
    return Prediction(mapping, "neighbours", errors_px[best])


def _estimate_error_px(
    rig: Rig, band: str, capture: CaptureFactors, estimate: FactorEstimate, estimator: _Estimator
) -> MovingFilePx:
    """Return the standard error of a band that is predicted with an estimate of the factors, px.

    It is the leave-one-out error of the estimator for learned captures with similar gaps, or the difference between
    the captures used if that is larger.
    """
    design = band_design(rig, band)
    errors: list[tuple[float, float]] = []
    for left_out, others in _leave_one_out(rig.captures):
        test = estimator(left_out, others)
        if test is not None:
            errors.append((test.gap, float(((design @ (np.array(left_out.factors) - test.factors)) ** 2).sum())))
    if not errors and estimator is not _mean:
        return MovingFilePx(math.inf)  # cross-validation was not possible
    errors.sort()
    similar = [square for gap, square in errors if gap <= _MAX_GAP_RATIO * estimate.gap]
    squares = similar if len(similar) >= MIN_CAPTURES else [square for _, square in errors[:MIN_CAPTURES]]
    # The mean square of few captures may be small by chance.
    inflation = (len(squares) + 1) / max(len(squares) - 1, 1)
    between_px2 = float(((design @ estimate.std) ** 2).sum())
    altitude_px = _altitude_error_px(rig, capture.altitude_m) * float(np.linalg.norm(rig.baselines[band]))
    factor_px2 = max(inflation * float(np.mean(squares or [0.0])), between_px2)
    return MovingFilePx(np.sqrt(factor_px2 + rig.from_bands_px[band] ** 2 + altitude_px**2))


def _altitude_error_px(rig: Rig, altitude_m: float | None) -> float:
    """Return the error of the distance factor at an altitude that differs from those of the learned captures.

    It is proportional to the difference from the nearest altitude: the slope of the factor over the altitude and the
    standard error of the slope, by linear regression over the learned captures with a prior.
    """
    known = [(c.altitude_m, c.factors[0]) for c in rig.captures if c.altitude_m is not None]
    if altitude_m is None or len(known) < MIN_CAPTURES:
        return 0.0
    altitudes, distances = (np.array(v) for v in zip(*known, strict=True))
    slope, offset = np.polyfit(altitudes, distances, 1) if np.ptp(altitudes) > 0 else (0.0, float(distances.mean()))
    scatter_px = max(float((distances - slope * altitudes - offset).std()), _MIN_ALTITUDE_SCATTER_PX)
    squares_m2 = float(((altitudes - altitudes.mean()) ** 2).sum())
    precision = 1 / _ALTITUDE_SLOPE_STD_PX_PER_M**2 + squares_m2 / scatter_px**2
    nearest_m = float(np.abs(altitudes - altitude_m).min())
    return nearest_m / float(np.sqrt(precision)) + abs(float(slope)) * nearest_m


def _leave_one_out(captures: Sequence[CaptureFactors]) -> list[tuple[CaptureFactors, list[CaptureFactors]]]:
    """Return each capture with all others."""
    return [(capture, [*captures[:i], *captures[i + 1 :]]) for i, capture in enumerate(captures)]


def _interpolated(positions: Sequence[float], position: float, captures: Sequence[CaptureFactors]) -> FactorEstimate:
    """Interpolate the factors linearly between captures at `positions`; constant outside."""
    order = np.argsort(positions, kind="stable")
    x, factors = np.array(positions)[order], np.array([c.factors for c in captures])[order]
    result = np.array([np.interp(position, x, column) for column in factors.T])
    after = int(np.searchsorted(x, position))
    std = np.zeros(FACTORS)
    if 0 < after < len(x) and x[after] > x[after - 1]:
        share = (position - x[after - 1]) / (x[after] - x[after - 1])
        std = np.abs(factors[after] - factors[after - 1]) * np.sqrt(share * (1 - share))
    return FactorEstimate(result, float(np.abs(x - position).min()), std)
