"""Prediction of the mapping of a band in a capture, and of its standard error, from the rig of a flight."""

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from agalign.flight.rig import (
    FACTORS,
    MIN_CAPTURES,
    MIN_STD_PX,
    NU,
    CaptureFactors,
    Observation,
    Rig,
    affine_difference,
    capture_factors,
    distance_px,
    expected_square,
    mapping_weight,
)
from agalign.values import geometry
from agalign.values.alignment import Prediction
from agalign.values.choices import PredictionSource
from agalign.values.geometry import Matrix
from agalign.verify.checks import rig_issues

Array = NDArray[np.float64]
Captures = Sequence[CaptureFactors]
Basis = Literal["flight", "seconds", "altitude_m"]
"""What a band is predicted from: the mean of the flight, or its variation over time or altitude."""
_MAX_GAP_RATIO = 2.0
"""An estimate is validated on captures with at most this ratio to its gap."""


def predict_band(rig: Rig, band: str, known: Observation) -> Prediction:
    """Predict the mapping of a band of the rig from the other bands of the capture, or if none is known from others."""
    has_others = any(b != band and b in rig.mean for b in known.mappings)
    mapping, source, error_px = (_from_bands if has_others else _from_captures)(rig, band, known)
    std_px = np.hypot(error_px, rig.extrapolation_px.get(band, 0.0)) * rig.magnification(band)
    return Prediction(mapping, source, float(std_px))


def unobserved_error_px(rig: Rig, band: str, *, by_neighbours: bool) -> float:
    """Return the RMS error of a band in captures without any known band.

    They are predicted from the captures before and after (`by_neighbours`), NaN if the times of fewer than two are
    known, or from the flight's mean.
    """
    squares = [square for _, square in _leave_one_out(rig, band, "seconds" if by_neighbours else "flight")]
    if not squares:
        return math.nan
    mean_px2 = float(expected_square(np.mean(squares), len(squares)))
    return math.sqrt(mean_px2 + rig.from_bands_px[band] ** 2)


def extreme_mappings(rig: Rig, band: str) -> list[Matrix]:
    """Return the mappings of a band in the captures with the minimum and maximum of each factor.

    Outliers, such as a capture of a panel from one metre above it, are excluded.
    """
    if not rig.factors:
        return [rig.mean[band]]
    factors = np.array([c.factors for c in rig.captures])
    median = np.median(np.abs(factors), axis=0)
    max_ratio, min_median_px = 6.0, 3.0  # a capture is an outlier if a factor exceeds this ratio to the median
    outlyingness = (np.abs(factors) / (max_ratio * np.maximum(median, min_median_px))).max(axis=1)
    # If every capture is an outlier in some factor, keep the least outlying one.
    factors = factors[outlyingness <= max(1.0, float(outlyingness.min()))]
    extremes = {int(i) for column in factors.T for i in (column.argmin(), column.argmax())}
    return [rig.mapping(band, factors[i]) for i in sorted(extremes)]


def band_summaries(rig: Rig) -> list[dict[str, Any]]:
    """Return the offset of the image centre, baseline, errors of predictions and displacements of each band.

    Errors are in px of the band, the other lengths in px of the reference. The error of a prediction by neighbours is
    None if their times are unknown.
    """

    def error_px(band: str, *, by_neighbours: bool) -> float | None:
        error = unobserved_error_px(rig, band, by_neighbours=by_neighbours) * rig.magnification(band)
        return None if math.isnan(error) else error

    centre = (np.array(rig.size_px, float) - 1) / 2
    field_px = {b: float(np.linalg.norm(f.displacements_px, axis=-1).max()) for b, f in rig.fields.items()}
    return [
        {
            "band": band,
            "offset_px": (geometry.apply(mean, centre[None])[0] - centre).tolist(),
            "baseline": rig.baselines[band],
            "pixel_size_px": 1 / rig.magnification(band),
            "from_bands_px": rig.from_bands_px[band] * rig.magnification(band),
            "from_neighbours_px": error_px(band, by_neighbours=True),
            "from_flight_px": error_px(band, by_neighbours=False),
            "field_px": field_px.get(band),
        }
        for band, mean in rig.mean.items()
    ]


def contradicts(rig: Rig, band: str, known: Observation) -> bool:
    """Return True if an observed band is farther from its prediction from the others than their errors allow."""
    predicted = predict_band(rig, band, known)
    off_px = distance_px(known.mappings[band], predicted.fixed_to_moving, rig.size_px)
    return any(rig_issues(replace(predicted, off_px=off_px)))


def _from_bands(rig: Rig, band: str, known: Observation) -> tuple[Matrix, PredictionSource, float]:
    """Predict a band from the mappings of the other bands of the capture; return it and its standard error, px.

    The variance is the sum of the cross-validated one, the additional variance of the factors compared with captures in
    which all other bands are known accurately, that by the baseline's error for factors outside the learned range, and
    the excess residual of the other bands (the median of their squares minus the cross-validated variance and that of
    their own errors), which is large for a capture that the rig does not describe.
    """
    others = [b for b in rig.mean if b != band]
    std_px = [known.std_px[b] if b in known.mappings else math.inf for b in others]
    design, designs = rig.design(band), np.stack([rig.design(b) for b in others])
    expected_px = np.array([rig.from_bands_px[b] for b in others])
    mappings = {**rig.mean, **known.mappings}
    differences = np.stack([affine_difference(rig.mean[b], mappings[b], rig.size_px) for b in others])
    weights = mapping_weight(np.stack([std_px, np.full(len(others), MIN_STD_PX)]), expected_px)
    both = np.stack([differences, 0 * differences])  # of this capture, and of one with accurate mappings of all others
    solutions, (covariance, if_all_known), _ = capture_factors(designs, both, weights)
    residuals_px2 = ((differences - designs @ solutions[0]) ** 2).sum(axis=(1, 2))
    is_known = weights[0] > 0
    excess_px2 = (residuals_px2 - expected_px**2)[is_known] - np.square(std_px)[is_known]
    learned_px2 = [np.square(c.factors[NU]).sum() for c in rig.captures]
    outside_px2 = np.square(solutions[0, NU]).sum() - np.mean(learned_px2 or [0.0])
    of_factors_px2 = np.einsum("akf,fg,akg->", design, covariance - if_all_known, design)
    baseline_px2 = 2 * rig.baseline_std[band] ** 2 * outside_px2
    variances_px2 = (np.median(excess_px2), of_factors_px2, baseline_px2)
    error_px = np.sqrt(rig.from_bands_px[band] ** 2 + sum(max(0.0, v) for v in variances_px2))
    mapping = rig.mapping(band, solutions[0])
    return mapping, "bands" if rig.factors else "flight", float(error_px)


def estimated_factors(
    capture: CaptureFactors | Observation, others: Captures, basis: Basis
) -> tuple[Array, Array, float] | None:
    """Return factors (5,), their standard error (5,), and the gap to the nearest capture used; None if unknown.

    They are the flight's mean, or linearly interpolated in time, with the standard deviation of the two captures,
    weighted by their shares; before the first and after the last capture, those of this one, with the change that the
    nearest two predict as standard error. With `altitude_m` the distance is interpolated over the altitude, and the
    others in time; of a capture far in time these are the flight's mean, with their spread as standard error.
    """
    moved, mean = _at_motion(others, capture.motion)
    if basis == "flight":
        return mean, np.zeros(FACTORS), 0.0
    known = [c for c in moved if getattr(c, basis) is not None]
    position = getattr(capture, basis)
    if position is None or not known:
        return None
    every = np.array([c.factors for c in known])
    # Clocks may count whole seconds: captures at the same time, or altitude, are one.
    x, of_capture, counts = np.unique([getattr(c, basis) for c in known], return_inverse=True, return_counts=True)
    factors = np.zeros((len(x), FACTORS))
    np.add.at(factors, of_capture, every / counts[of_capture][:, None])
    place = float(np.interp(position, x, np.arange(len(x))))
    start, end, share = factors[int(place)], factors[min(int(place) + 1, len(x) - 1)], place % 1
    result, std = start + share * (end - start), np.abs(end - start) * np.sqrt(share * (1 - share))
    gap = float(np.abs(x - position).min())
    if len(x) > 1 and not x[0] <= position <= x[-1]:
        first, second = (0, 1) if position < x[0] else (-2, -1)
        std = np.abs(factors[second] - factors[first]) * gap / (x[second] - x[first])
    if basis == "altitude_m" and (in_time := estimated_factors(capture, others, "seconds")):
        times_s = sorted(c.seconds for c in others if c.seconds is not None)
        is_near = in_time[2] <= _MAX_GAP_RATIO * max(np.diff(times_s), default=0.0)
        spread = np.sqrt(np.square(every - mean).mean(axis=0))
        result[1:], std[1:] = (in_time[0][1:], in_time[1][1:]) if is_near else (mean[1:], spread[1:])
    return result, std, gap


def _at_motion(captures: Captures, motion: tuple[float, float] | None) -> tuple[Captures, Array]:
    """Return captures with the factors that they would have at an image motion, and the flight's mean (5,).

    w is a linear function of the motion. If motions are unknown, the captures are unchanged, and the mean is 0.
    """
    known = [c for c in captures if c.motion is not None]
    if motion is None or len(known) < MIN_CAPTURES:
        return captures, np.zeros(FACTORS)
    x = np.array([(1.0, *(c.motion or ())) for c in known])
    # Captures of similar speed do not determine the slope: `rcond` selects the solution of minimum norm.
    scale = np.abs(x).max(axis=0) + 1e-12
    slope = np.linalg.lstsq(x / scale, np.array([c.factors for c in known]), rcond=1e-3)[0]
    slope[:, NU] = 0  # only w depends on the motion
    change = (np.array([1.0, *motion]) - x) / scale @ slope
    moved = [replace(c, factors=tuple(np.add(c.factors, d).tolist())) for c, d in zip(known, change, strict=True)]
    return moved, np.array([1.0, *motion]) / scale @ slope


def _from_captures(rig: Rig, band: str, known: Observation) -> tuple[Matrix, PredictionSource, float]:
    """Predict a band from the estimate of the capture's factors with the smallest standard error, px.

    That is the leave-one-out error of the basis for learned captures with similar gaps, or the difference between
    the captures used if that is larger. A basis other than the altitude also has the error by the distance from the
    altitudes of the learned captures. A gap of more than _MAX_GAP_RATIO times those of all learned captures is not
    validated: the flight's mean remains.
    """
    min_for_altitude = 6  # with fewer captures, the basis with the smallest error would be selected by chance
    design, results = rig.design(band), []
    altitude_px = _altitude_error_px(rig, known.altitude_m) * float(np.linalg.norm(rig.baselines[band]))
    for basis in get_args(Basis)[: 3 if len(rig.captures) >= min_for_altitude else 2]:
        estimate, tests = estimated_factors(known, rig.captures, basis), _leave_one_out(rig, band, basis)
        if estimate is not None and tests and estimate[2] <= _MAX_GAP_RATIO * tests[-1][0]:
            factors, std, gap = estimate
            similar = [square for other_gap, square in tests if other_gap <= _MAX_GAP_RATIO * gap]
            squares = similar if len(similar) >= MIN_CAPTURES else [square for _, square in tests[:MIN_CAPTURES]]
            mean_px2 = float(expected_square(np.mean(squares), len(squares)))
            other_px2 = 0.0 if basis == "altitude_m" else altitude_px**2
            source: PredictionSource = "neighbours" if basis != "flight" and (design @ factors).any() else "flight"
            results.append((max(mean_px2, float(((design @ std) ** 2).sum())) + other_px2, factors, source))
    of_mean: tuple[float, Array, PredictionSource] = altitude_px**2, np.zeros(FACTORS), "flight"
    variance_px2, factors, source = min(results, key=itemgetter(0), default=of_mean)
    error_px = float(np.sqrt(variance_px2 + rig.from_bands_px[band] ** 2))
    return rig.mapping(band, factors), source, error_px


def _leave_one_out(rig: Rig, band: str, basis: Basis) -> list[tuple[float, float]]:
    """Return (gap, squared error of the band, px^2) of estimates of each learned capture from the others, sorted."""
    design, result = rig.design(band), []
    for i, capture in enumerate(rig.captures):
        estimate = estimated_factors(capture, [*rig.captures[:i], *rig.captures[i + 1 :]], basis)
        if estimate is not None:
            result.append((estimate[2], float(((design @ (capture.factors - estimate[0])) ** 2).sum())))
    return sorted(result)


def _altitude_error_px(rig: Rig, altitude_m: float | None) -> float:
    """Return the error of the distance factor by the difference from the nearest altitude of the learned captures.

    It is proportional to the slope of the factor and the slope's standard error, by linear regression with a prior of
    mean 0: altitudes that hardly differ do not determine a slope.
    """
    known = np.array([(c.altitude_m, c.factors[0]) for c in rig.captures if c.altitude_m is not None])
    if altitude_m is None or len(known) < MIN_CAPTURES:
        return 0.0
    x_m, y_px = (known - known.mean(axis=0)).T
    slope = float(x_m @ y_px) / max(float(x_m @ x_m), 1e-9)
    min_scatter_px = 0.5  # around the regression
    scatter_px = max(float((y_px - slope * x_m).std()), min_scatter_px)
    prior_std_px_per_m = 1.5  # a baseline of 0.03 m, 20 m above the ground
    information = x_m @ x_m / scatter_px**2
    variance = 1 / (1 / prior_std_px_per_m**2 + information)
    return float(np.abs(known[:, 0] - altitude_m).min() * (np.sqrt(variance) + abs(slope) * information * variance))
