"""Predictions of a simple rig: factors of a capture, and each term of the standard error separately."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agalign.flight.rig import (
    CaptureFactors,
    Observation,
    Rig,
    capture_factors,
    design_tensor,
    displaced,
    distance_px,
    expected_square,
    mapping_weight,
    median_mapping,
)
from agalign.flight.rig_prediction import (
    band_summaries,
    estimated_factors,
    extreme_mappings,
    predict_band,
    unobserved_error_px,
)
from agalign.values import geometry

SIZE = 640, 480
FROM_BANDS_PX = 0.1


def capture(distance_px: float, seconds: float | None = None, **more: Any) -> CaptureFactors:
    factors = distance_px, 0.0, 0.0, *more.get("steps_px", (0.0, 0.0))
    return CaptureFactors(seconds, more.get("altitude_m"), more.get("motion"), factors)


def rig(*captures: CaptureFactors, baseline_std: float = 0.0) -> Rig:
    """Two bands with baselines along x and y; the distance is the only factor."""
    mean = {"Red": geometry.translation(30, -5), "NIR": geometry.translation(-12, 8)}
    baselines, delays = {"Red": (0.6, 0.0), "NIR": (0.0, 0.8)}, {"Red": 1.0, "NIR": 0.5}
    stds = dict.fromkeys(mean, baseline_std), ("distance",), captures, dict.fromkeys(mean, FROM_BANDS_PX)
    return Rig(SIZE, mean, baselines, delays, *stds)


@pytest.fixture
def some() -> Rig:
    return rig(capture(1.0), capture(-1.0), capture(0.0))


def showing(rig: Rig, band: str, distance_px: float, std_px: float = 0.01) -> Observation:
    factors = np.array([distance_px, 0, 0, 0, 0])
    mapping = displaced(rig.mean[band], rig.design(band) @ factors, SIZE)
    return Observation(None, {band: mapping}, {band: float(std_px)})


def test_an_unobserved_quarter_adds_the_error_of_the_lenses(some: Rig) -> None:
    half = replace(some, extrapolation_px={"NIR": 0.7})
    assert (some.covers("NIR"), half.covers("NIR"), some.covers("Green")) == (True, False, False)
    for band, other, extra_px in (("NIR", "Red", 0.7), ("Red", "NIR", 0.0)):
        std_px, half_px = (predict_band(r, band, showing(some, other, 2.0)).std_px for r in (some, half))
        assert half_px == pytest.approx(np.hypot(std_px, extra_px))


def test_the_mean_square_of_few_captures_is_inflated() -> None:
    some = rig(capture(1.0), capture(-1.0), capture(2.0))
    error_px = predict_band(some, "Red", Observation(None, {}, {})).std_px
    mean_square = 0.6**2 * (1 + 1 + 4) / 3
    assert error_px == pytest.approx(np.sqrt((3 + 1) / (3 - 1) * mean_square + FROM_BANDS_PX**2))


def test_factors_outside_the_learned_range_add_the_error_of_the_baseline() -> None:
    captures = capture(1.0), capture(-1.0), capture(2.0)
    exact, rough = rig(*captures), rig(*captures, baseline_std=0.05)
    far, near = showing(exact, "Red", 10.0), showing(exact, "Red", 1.0)
    excess = predict_band(rough, "NIR", far).std_px ** 2 - predict_band(exact, "NIR", far).std_px ** 2
    assert excess == pytest.approx(2 * 0.05**2 * (10.0**2 - 2.0), rel=0.01)
    assert predict_band(rough, "NIR", near).std_px == predict_band(exact, "NIR", near).std_px


def test_an_uncertain_mapping_makes_the_prediction_uncertain(some: Rig) -> None:
    sure, unsure = (predict_band(some, "NIR", showing(some, "Red", 1.0, std_px)).std_px for std_px in (0.05, 1.0))
    # The baselines are 0.6 and 0.8: 1 px in Red corresponds to 0.8 / 0.6 px in NIR.
    assert sure < 0.2
    assert unsure == pytest.approx(0.8 / 0.6 / np.sqrt(2), rel=0.5)


def test_excess_residuals_of_bands_make_the_prediction_uncertain(some: Rig) -> None:
    known = showing(some, "Red", 1.0)
    across = geometry.compose(geometry.translation(0.0, 3.0), known.mappings["Red"])
    disagreeing = replace(known, mappings={"Red": across})
    usual, unusual = (predict_band(some, "NIR", k).std_px for k in (known, disagreeing))
    assert usual < 0.2
    # The excess, and the larger variance of the factor because the weight of the band is smaller.
    assert np.sqrt(3.0**2 - FROM_BANDS_PX**2) < unusual < 3.6


def test_errors_of_unobserved_captures() -> None:
    line = rig(*(capture(float(k), seconds=10.0 * k) for k in range(5)))
    squares = [0.6**2 * k**2 for k in range(5)]
    expected = np.sqrt(expected_square(np.mean(squares), len(squares)) + FROM_BANDS_PX**2)
    assert unobserved_error_px(line, "Red", by_neighbours=False) == pytest.approx(expected)
    # Linear interpolation is exact between neighbours and constant at the ends.
    expected = np.sqrt(expected_square(0.6**2 * (1 + 0 + 0 + 0 + 1) / 5, 5) + FROM_BANDS_PX**2)
    assert unobserved_error_px(line, "Red", by_neighbours=True) == pytest.approx(expected)
    without_times = rig(*(capture(float(k)) for k in range(5)))
    assert math.isnan(unobserved_error_px(without_times, "Red", by_neighbours=True))
    assert band_summaries(without_times)[0]["from_neighbours_px"] is None


def distance_at(query: CaptureFactors, known: list[CaptureFactors]) -> tuple[float, float, float]:
    """The estimated distance, its standard error, and the gap."""
    factors, std, gap = estimated_factors(query, known, "seconds") or pytest.fail("no estimate")
    return factors[0], std[0], gap


def test_factors_are_interpolated_in_time_with_the_error_of_a_brownian_bridge() -> None:
    known = [capture(4.0, seconds=30.0), capture(0.0, seconds=10.0)]
    assert distance_at(capture(0.0, seconds=15.0), known) == pytest.approx((1.0, 4.0 * np.sqrt(0.25 * 0.75), 5.0))
    # Before the first capture, the change may go on: 4 px in 20 s are 2 px in 10 s.
    assert distance_at(capture(0.0, seconds=0.0), known) == pytest.approx((0.0, 2.0, 10.0))
    assert estimated_factors(capture(0.0), known, "seconds") is None


def test_captures_at_the_same_time_are_one() -> None:
    """As by clocks that count whole seconds: no change is divided by the time between them."""
    known = [capture(float(k), seconds=10.0 * k) for k in range(3)]
    twice = [*known, capture(4.0, seconds=20.0)]
    assert distance_at(capture(0.0, seconds=30.0), twice) == pytest.approx((3.0, 2.0, 10.0))


def test_the_distance_is_interpolated_in_height_and_the_rest_in_time() -> None:
    known = [capture(2.0 * k, float(k), altitude_m=50.0 + k, steps_px=(float(k), 0.0)) for k in range(3)]
    factors, std, gap = estimated_factors(capture(0.0, 2.0, altitude_m=50.5), known, "altitude_m")
    assert (factors[0], factors[3], std[0], std[3], gap) == pytest.approx((1.0, 2.0, 2.0 * 0.5, 0.0, 0.5))
    assert estimated_factors(capture(0.0, seconds=1.0), known, "altitude_m") is None


def test_a_capture_far_from_all_learned_ones_is_not_interpolated() -> None:
    """The leave-one-out error of neighbours 10 s away says nothing of a capture hours later."""
    slow = rig(*(capture(float(k // 3), seconds=10.0 * k) for k in range(9)))
    near, far = (predict_band(slow, "Red", Observation(s, {}, {})) for s in (35.0, 36000.0))
    assert near.source == "neighbours"
    assert far.source == "flight"
    assert far.std_px == predict_band(slow, "Red", Observation(None, {}, {})).std_px > 2 * near.std_px


def test_with_few_captures_only_two_estimators_are_used() -> None:
    """Heights would predict these captures exactly; with five captures that may be chance."""
    captures = [capture(float(k % 3), seconds=float(k * 7 % 6), altitude_m=50.0 + k % 3) for k in range(6)]
    known = Observation(2.5, {}, {}, altitude_m=51.0)
    six, five = (predict_band(rig(*captures[:count]), "NIR", known) for count in (6, 5))
    assert six.source == "neighbours"
    assert six.std_px < 0.5 * five.std_px


def test_a_prediction_by_the_motion_of_the_flight_is_not_one_by_neighbours() -> None:
    """Its time is unknown: only the regression over all captures predicts the step of the bands."""
    captures = [capture(0.0, motion=(float(k), 0.0), steps_px=(2.0 * k, 0.0)) for k in range(6)]
    moving = replace(rig(*captures), factors=("motion",))
    prediction = predict_band(moving, "Red", Observation(None, {}, {}, motion=(3.0, 0.0)))
    assert distance_px(prediction.fixed_to_moving, moving.mean["Red"], SIZE) > 3
    assert prediction.source == "flight"


def test_the_extremes_exclude_outliers() -> None:
    captures = [capture(d) for d in (-2.0, 0.5, 3.0, 1.0, 100.0)]
    ends = extreme_mappings(rig(*captures), "Red")
    offsets = sorted(round(float(m[0, 2]), 6) for m in ends)
    # Unused factors are equal in all captures: their extremes are the first capture.
    assert offsets == [pytest.approx(30 - 0.6 * 2), pytest.approx(30 + 0.6 * 3)]
    assert len(extreme_mappings(replace(rig(*captures), factors=()), "Red")) == 1
    # If all captures are outliers, each in another factor, the least outlying one is kept.
    steps = [capture(0.0, steps_px=steps_px) for steps_px in ((90.0, 0.0), (0.0, 70.0))]
    (end,) = extreme_mappings(rig(capture(50.0), *steps), "Red")
    assert end[0, 2] == pytest.approx(30 + 0.6 * 50)


def test_the_summary_has_the_offset_of_the_centre_and_the_errors() -> None:
    red, nir = band_summaries(rig(*(capture(float(k), seconds=float(k)) for k in range(4))))
    assert (red["band"], nir["band"]) == ("Red", "NIR")
    assert red["offset_px"] == pytest.approx([30, -5])
    assert red["baseline"] == (0.6, 0.0)
    assert red["from_bands_px"] == FROM_BANDS_PX
    assert red["from_neighbours_px"] < red["from_flight_px"]
    assert red["field_px"] is None


# ---- factors, estimated from exactly known mappings


LENSES = np.array([[0.6, 0.0, 0.2], [0.0, 0.7, -0.5], [-0.3, 0.2, 0.8]])
DISTANCE = np.tensordot(LENSES, design_tensor(("distance",)), 1)


def test_a_weight_is_the_inverse_of_all_variances_along_an_axis() -> None:
    assert mapping_weight(0.3, 0.4) == pytest.approx(2 / (0.3**2 + 0.4**2 + 0.05**2))


def test_the_median_mapping_ignores_an_outlier() -> None:
    matrices = [geometry.translation(x, 2.0) for x in (3.0, 3.1, 90.0)]
    assert distance_px(median_mapping(matrices, SIZE), matrices[0], SIZE) < 0.2
    assert median_mapping(matrices[2:], SIZE) is matrices[2]


def test_unused_factors_are_0_and_an_outlier_band_hardly_changes_the_others() -> None:
    differences = np.einsum("bakf,cf->cbak", DISTANCE, np.array([[3.0, 0, 0, 0, 0]]))
    result = capture_factors(DISTANCE, differences, np.full((1, 3), 1e4)).mean
    assert result[0, 0] == pytest.approx(3.0, abs=1e-3)
    assert not result[0, 1:].any()
    # One band is an outlier.
    differences[0, 2, :, 0] += 5.0
    result = capture_factors(DISTANCE, differences, np.full((1, 3), 1e3)).mean
    assert result[0, 0] == pytest.approx(3.0, abs=0.1)
