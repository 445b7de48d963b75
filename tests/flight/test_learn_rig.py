import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from agalign.flight.learn_rig import _parallax_px, learn_rig
from agalign.flight.rig import CaptureFactors, Observation, Rig, displaced, distance_px, expected_square
from agalign.flight.rig_prediction import contradicts, estimated_factors, predict_band, unobserved_error_px
from agalign.values import geometry

SIZE = 1280, 960
BASELINES = {"Blue": (0.9, 0.0), "Red": (0.0, 0.65), "NIR": (0.9, 0.7), "Red edge": (0.4, 0.35)}
"""Lens layout of a RedEdge-M, in any unit."""


def mappings(distance_px: float, tilt: tuple[float, float] = (0.0, 0.0), noise: float = 0.0, seed: int = 0) -> dict:
    """Return the homographies A_b + e_b nu^T of a rig over a plane; baselines are in px at the image centre."""
    rng = np.random.default_rng(seed)
    result = {}
    for k, (name, (bx, by)) in enumerate(BASELINES.items()):
        own = np.array([[1.001, 0.002 * k, 20.0 + k], [-0.002 * k, 0.999, -8.0 * k], [1e-6, -2e-6, 1.0]])
        nu = np.array([tilt[0] / SIZE[0], tilt[1] / SIZE[1], distance_px - sum(tilt) / 2])
        moved = own + np.outer([bx, by, 0.0], nu)
        moved[:2, 2] += noise * rng.normal(size=2)
        result[name] = geometry.normalised(moved)
    return result


def observation(
    seconds: float | None, *plane: object, without: str = "", altitude_m: float | None = None, **options: object
) -> Observation:
    known = mappings(*plane, **options)
    known.pop(without, None)
    return Observation(seconds, known, dict.fromkeys(known, 0.05), altitude_m)


def flight(count: int = 8) -> list[Observation]:
    rng = np.random.default_rng(1)
    return [observation(float(k), rng.normal(), noise=0.03, seed=k) for k in range(count)]


def level_flight(count: int) -> list[Observation]:
    return [observation(float(k), 0.2 * np.sin(k), noise=0.05, seed=k) for k in range(count)]


def error_px(rig: Rig, band: str, known: Observation, truth: np.ndarray) -> tuple[float, float]:
    prediction = predict_band(rig, band, known)
    return distance_px(prediction.fixed_to_moving, truth, SIZE), prediction.std_px


def test_the_baselines_are_estimated_up_to_a_factor() -> None:
    rig = learn_rig(flight(), SIZE, {})
    assert rig.factors == ("distance",)
    result, wanted = (np.array([b[name] for name in BASELINES]) for b in (rig.baselines, BASELINES))
    wanted = wanted / np.linalg.norm(wanted)
    assert abs((result * wanted).sum()) > 0.995
    assert np.linalg.norm(result) == pytest.approx(1)


@pytest.mark.slow
def test_tilt_is_selected_where_the_ground_tilts() -> None:
    rng = np.random.default_rng(3)
    tilted = [observation(float(k), rng.normal(), tuple(2 * rng.normal(size=2))) for k in range(10)]
    rig = learn_rig(tilted, SIZE, {})
    assert rig.factors == ("distance", "tilt")
    known = observation(20.0, 0.5, (3.0, -2.0), without="Red")
    assert error_px(rig, "Red", known, mappings(0.5, (3.0, -2.0))["Red"])[0] < 0.3


def shifted(capture: Observation, shifts_px: dict[str, tuple[float, float]]) -> Observation:
    """The same with displaced mappings."""
    moved = {b: geometry.compose(geometry.translation(*xy), capture.mappings[b]) for b, xy in shifts_px.items()}
    return replace(capture, mappings={**capture.mappings, **moved})


def test_wrong_mappings_are_not_learned_from_and_contradict_the_rig() -> None:
    """Two of one band hide each other: the rig of the others contains one of them."""
    right, wrong = flight(6), {1: "Red", 3: "Red", 4: "NIR"}
    captures = [shifted(c, {wrong[k]: (8.0, 0.0)} if k in wrong else {}) for k, c in enumerate(right)]
    rig = learn_rig(captures, SIZE, {})
    assert {(k, b) for k, c in enumerate(captures) for b in BASELINES if contradicts(rig, b, c)} == set(wrong.items())
    assert max(rig.from_bands_px.values()) < 0.5  # 2 px or more with one of them


def test_captures_that_the_model_does_not_describe_are_learned_from() -> None:
    """No majority of their bands shows which mapping is wrong; a rig without them would contradict them all."""
    moved = shifted(flight(6)[2], {"Red": (12.0, 0.0), "NIR": (0.0, 12.0), "Blue": (-8.0, 4.0)})
    others = [c for k, c in enumerate(flight(6)) if k != 2]
    rig = learn_rig([*others, moved], SIZE, {})
    assert not any(contradicts(rig, b, moved) for b in BASELINES)
    assert rig.from_bands_px["Red"] > 2


def test_without_common_variation_no_factor_is_selected() -> None:
    still = [observation(float(k), 0.0, noise=0.05, seed=k) for k in range(8)]
    rig = learn_rig(still, SIZE, {})
    assert rig.factors == ()
    prediction = predict_band(rig, "Red", observation(3.5, 0.0, without="Red"))
    assert prediction.source == "flight"
    assert distance_px(prediction.fixed_to_moving, rig.mean["Red"], SIZE) < 1e-4


def enlarged(observation: Observation, magnification: float) -> Observation:
    """The same with an NIR that has more pixels."""
    to_file = np.diag([magnification, magnification, 1.0])
    own = {b: geometry.normalised(to_file @ m) if b == "NIR" else m for b, m in observation.mappings.items()}
    return replace(observation, mappings=own)


@pytest.mark.parametrize("magnification", [0.1, 1.0, 2.0])
def test_a_known_layout_predicts_captures_at_an_unseen_height(magnification: float) -> None:
    # Without the layout, the error and its standard error may be several pixels.
    for layout, max_px, max_std in ((BASELINES, 1.0, 2.0), ({}, np.inf, 2.5)):
        rig = learn_rig([enlarged(o, magnification) for o in level_flight(4)], SIZE, layout)
        truth = enlarged(observation(9.0, 9.0), magnification).mappings["NIR"]
        error, std = error_px(rig, "NIR", observation(9.0, 9.0, without="NIR"), truth)
        assert error < min(magnification * max_px, max_std * std)


@pytest.mark.parametrize("magnification", [1.0, 2.0])
def test_the_baselines_of_the_lenses_follow_from_two_bands_if_the_reference_moves(magnification: float) -> None:
    """Those of the rig are orthogonal to its delays: they lack what all bands have in common."""
    rng = np.random.default_rng(5)
    captures = []
    for k in range(12):
        still = enlarged(observation(float(k), rng.normal(), noise=0.01, seed=k), magnification)
        step = geometry.translation(*(4 * rng.normal(size=2)))
        captures.append(replace(still, mappings={b: geometry.compose(m, step) for b, m in still.mappings.items()}))
    rig = learn_rig(captures, SIZE, {})
    assert "reference" in rig.factors
    design = np.concatenate([rig.baseline_design(b) for b in ("Blue", "Red")])
    solution = np.linalg.lstsq(design, np.ravel([BASELINES[b] for b in ("Blue", "Red")]), rcond=None)[0]
    for band in ("NIR", "Red edge"):
        np.testing.assert_allclose(rig.baseline_design(band) @ solution, BASELINES[band], atol=0.05)


def test_the_parallax_of_a_flight_is_the_rms_over_its_captures() -> None:
    captures = flight(4)
    captures[0] = replace(captures[0], parallax_px={"Red": 6.0})
    learned = learn_rig(captures, SIZE, {})
    assert learned.parallax_px["Red"] == pytest.approx(3.0)


def test_a_band_without_a_relief_has_the_parallax_of_the_others_by_its_baseline() -> None:
    """A thermal band is aligned without the relief of the others, and moves by it all the same."""
    captures = flight(4)
    captures[0] = replace(captures[0], parallax_px={"Red": 6.0})
    learned = learn_rig(captures, SIZE, {})
    lengths = {band: math.hypot(*learned.baselines[band]) for band in learned.mean}
    assert lengths["NIR"] > 0
    assert learned.parallax_px["NIR"] == pytest.approx(3.0 * lengths["NIR"] / lengths["Red"])
    assert learn_rig(flight(4), SIZE, {}).parallax_px == dict.fromkeys(learned.mean, 0.0)
    # Baselines orthogonal to delays are not those of the lenses.
    assert _parallax_px(captures, None, list(learned.mean)) == pytest.approx(dict.fromkeys(learned.mean, 3.0))


def test_baselines_that_nothing_determines_do_not_scale_the_parallax() -> None:
    """Captures from one height: without a layout, their baselines are noise."""
    captures = [observation(10.0 * k, 0.0, noise=0.05, seed=k) for k in range(4)]
    captures[0] = replace(captures[0], parallax_px={"Red": 6.0})
    learned = learn_rig(captures, SIZE, {})
    assert learned.factors == ()
    assert learned.parallax_px == pytest.approx(dict.fromkeys(learned.mean, 3.0))


def test_the_standard_error_of_a_baseline_contains_what_the_model_does_not_explain() -> None:
    rng, nu = np.random.default_rng(3), np.linspace(-6, 6, 16)
    scattered = [observation(10.0 * k, nu_k) for k, nu_k in enumerate(nu)]
    for number, capture in enumerate(scattered):
        moved = {b: displaced(m, 0.3 * rng.normal(size=(2, 3)), SIZE) for b, m in capture.mappings.items()}
        scattered[number] = replace(capture, mappings=moved)
    exact = learn_rig([observation(10.0 * k, nu_k) for k, nu_k in enumerate(nu)], SIZE, {})
    learned = learn_rig(scattered, SIZE, {})
    errors = [np.subtract(learned.baselines[b], exact.baselines[b]) for b in exact.mean]
    rms = float(np.sqrt(np.mean(np.square(errors))))
    claimed = float(np.sqrt(np.mean(np.square(list(learned.baseline_std.values())))))
    assert 0.3 * claimed < rms < 1.5 * claimed


@pytest.mark.slow
def test_the_error_of_predictions_is_without_that_of_the_mappings_they_are_compared_with() -> None:
    """Noisy captures: the mean of many others is more accurate than any of them."""
    rng, noise_px = np.random.default_rng(2), 0.4

    def noisy(seed: int, nu: float) -> Observation:
        capture = observation(10.0 * seed, nu, noise=noise_px, seed=seed)
        return replace(capture, std_px=dict.fromkeys(capture.mappings, noise_px * 2**0.5))

    rig = learn_rig([noisy(k, rng.normal(0, 5)) for k in range(24)], SIZE, {})
    errors_px, claims_px = [], []
    for seed, nu in enumerate(rng.normal(0, 5, 20), start=100):
        known = noisy(seed, nu)
        known = replace(known, mappings={b: m for b, m in known.mappings.items() if b != "Red edge"})
        predicted = predict_band(rig, "Red edge", known)
        errors_px.append(distance_px(predicted.fixed_to_moving, mappings(nu)["Red edge"], SIZE))
        claims_px.append(predicted.std_px)
    rms_px, claimed_px = (float(np.sqrt(np.mean(np.square(values)))) for values in (errors_px, claims_px))
    assert 0.45 * claimed_px < rms_px < 1.2 * claimed_px


@pytest.mark.slow
def test_a_capture_without_bands_is_interpolated_between_its_neighbours() -> None:
    """The drone descends steadily: interpolation is more accurate than the flight's mean."""
    rig = learn_rig([observation(10.0 * k, 0.5 * k) for k in range(9)], SIZE, {})
    prediction = predict_band(rig, "NIR", Observation(35.0, {}, {}))
    assert prediction.source == "neighbours"
    assert distance_px(prediction.fixed_to_moving, mappings(1.75)["NIR"], SIZE) < 0.3
    # A capture of unknown time is not one at time 0.
    for altitude_m in (None, 100.0):
        prediction = predict_band(rig, "NIR", Observation(None, {}, {}, altitude_m))
        assert prediction.source == "flight"
        np.testing.assert_allclose(prediction.fixed_to_moving, rig.mean["NIR"], atol=1e-4)


def test_too_few_captures_give_no_rig() -> None:
    assert learn_rig(flight(2), SIZE, {}) is None
    assert learn_rig([], SIZE, BASELINES) is None


def test_an_unseen_altitude_increases_the_standard_error() -> None:
    level = [replace(capture, altitude_m=100.0 + 0.5 * k) for k, capture in enumerate(level_flight(5))]
    rig = learn_rig(level, SIZE, BASELINES)
    at_101, at_90, unknown = (predict_band(rig, "NIR", Observation(2.5, {}, {}, m)).std_px for m in (101.0, 90.0, None))
    assert max(at_101, unknown) < 0.6
    assert at_90 > 2.0


def test_a_capture_after_the_learned_ones_may_have_drifted_further() -> None:
    drifting = [observation(60.0 * k, 1.2 * k, noise=0.01, seed=k) for k in range(11)]
    rig = learn_rig(drifting, SIZE, BASELINES)
    for steps_after in (1, 2):
        later = Observation(60.0 * (10 + steps_after), {}, {})
        error, std = error_px(rig, "NIR", later, mappings(1.2 * (10 + steps_after))["NIR"])
        assert error > 1.0 * steps_after
        assert error < 1.5 * std


@pytest.mark.parametrize("std_px", [0.2, 1.0])
def test_the_error_of_a_prediction_by_uncertain_bands_is_that_of_many(std_px: float) -> None:
    """Neither twice as much, by noise that counts twice, nor with the outliers of accurate bands."""
    rng = np.random.default_rng(0)
    rig = learn_rig([observation(float(k), 3 * rng.normal(), noise=0.03, seed=k) for k in range(20)], SIZE, BASELINES)
    pairs = []
    for k in range(100, 200):
        distance = 3 * rng.normal()
        # The noise is along an axis, the standard error of both.
        known = observation(float(k), distance, without="NIR", noise=std_px / math.sqrt(2), seed=k)
        known = replace(known, std_px=dict.fromkeys(known.mappings, std_px))
        pairs.append(error_px(rig, "NIR", known, mappings(distance)["NIR"]))
    true_px, claimed_px = np.sqrt(np.square(pairs).mean(axis=0))
    assert 0.9 < claimed_px / true_px < 1.5
    assert np.mean([error <= std for error, std in pairs]) < 0.8


def test_an_altitude_between_learned_ones_does_not_count_as_unseen() -> None:
    """The distance is interpolated over the altitude, in captures that are not in its order."""
    altitudes_m = np.random.default_rng(0).permutation(np.arange(50.0, 71.0))
    hilly = [
        observation(10.0 * k, 2000 / m, noise=0.03, seed=k, altitude_m=m) for k, m in enumerate(altitudes_m.tolist())
    ]
    rig = learn_rig(hilly, SIZE, BASELINES)
    for altitude_m in (54.5, 58.5, 64.5):
        known = Observation(55.0, {}, {}, altitude_m)
        error, std = error_px(rig, "NIR", known, mappings(2000 / altitude_m)["NIR"])
        assert error < 0.1
        assert std < 0.4


def test_a_band_without_others_in_its_capture_says_nothing_of_predictions_by_others() -> None:
    captures = flight(16)
    alone = observation(100.0, 10.0, noise=0.03, seed=100)
    alone = replace(alone, mappings={"Red": alone.mappings["Red"]}, std_px={"Red": alone.std_px["Red"]})
    without, with_it = (learn_rig(some, SIZE, {}).from_bands_px for some in (captures, [*captures, alone]))
    assert with_it == pytest.approx(without, rel=0.1)
    only_red = [replace(alone, seconds=float(k)) for k in range(4)]
    assert learn_rig(only_red, SIZE, {}).from_bands_px["Red"] > 0


def test_factors_are_not_those_of_captures_far_in_time_at_the_same_altitude() -> None:
    captures = [CaptureFactors(60.0 * k, 100.0 + k, None, (0.1 * k, 0.0, 0.0, 1.0, 1.0)) for k in range(8)]
    mean = np.zeros(5)
    for seconds, is_mean in ((540.0, False), (86_400.0, True)):
        factors, std, _ = estimated_factors(Observation(seconds, {}, {}, 103.0), captures, "altitude_m")
        assert factors[0] == pytest.approx(0.3)
        assert np.array_equal(factors[1:], mean[1:]) is is_mean
        assert std[3:].tolist() == ([1.0, 1.0] if is_mean else [0.0, 0.0])  # all of them differ from the mean by 1


def test_altitudes_that_hardly_differ_determine_no_slope() -> None:
    """Their differences and the noise of the distance would make it thousands of px per m."""
    level = [replace(capture, altitude_m=100.0 + 1e-4 * k) for k, capture in enumerate(level_flight(5))]
    at_90 = predict_band(learn_rig(level, SIZE, BASELINES), "NIR", Observation(2.5, {}, {}, 90.0)).std_px
    assert 2.0 < at_90 < 10 * 1.5 * 1.1  # the prior, px per m


DELAYS = {"Blue": 0.0, "Red": 0.4, "NIR": 1.0, "Red edge": 0.7}


def passing(seconds: float, motion: tuple[float, float], distance_px: float = 0.0, seed: int = 0) -> Observation:
    """A capture of a rig that exposes its bands one after another during image motion."""
    result = mappings(distance_px, noise=0.03, seed=seed)
    moved = {b: geometry.compose(geometry.translation(*(DELAYS[b] * np.array(motion))), m) for b, m in result.items()}
    return Observation(seconds, moved, dict.fromkeys(moved, 0.05), motion=(motion[0] / 50, motion[1] / 50))


@cache
def headings_rig(*, known_layout: bool) -> Rig:
    """The rig of parallel flight lines with a constant camera heading, at varying speeds and heights."""
    rng = np.random.default_rng(4)
    there = [(float(0.5 * rng.normal()), (-1) ** (k // 4) * 16.0 + float(rng.normal())) for k in range(16)]
    flight = [passing(float(k), motion, float(rng.normal()), seed=k) for k, motion in enumerate(there)]
    return learn_rig(flight, SIZE, BASELINES if known_layout else {})


@pytest.mark.slow
@pytest.mark.parametrize("known_layout", [False, True])
def test_delays_are_distinguished_from_baselines(known_layout: bool) -> None:
    rig = headings_rig(known_layout=known_layout)
    assert "motion" in rig.factors
    result, wanted = (np.array([d[name] for name in DELAYS]) for d in (rig.delays, DELAYS))
    assert abs(result @ wanted) / np.linalg.norm(wanted) > 0.99
    truth = passing(20.0, (0.3, 15.0), 1.5, seed=99)
    known = replace(truth, mappings={b: m for b, m in truth.mappings.items() if b != "NIR"})
    assert error_px(rig, "NIR", known, truth.mappings["NIR"])[0] < 0.3


@pytest.mark.slow
def test_a_capture_on_another_heading_is_predicted_from_its_motion() -> None:
    rig = headings_rig(known_layout=True)
    for moment, sign in ((7.5, -1), (7.5, 1)):  # at a turn, where the captures before and after differ
        truth = passing(moment, (0.0, sign * 16.0))
        unobserved = Observation(moment, {}, {}, motion=truth.motion)
        error, std = error_px(rig, "NIR", unobserved, truth.mappings["NIR"])
        assert error < min(1.0, 2.5 * std)


@pytest.mark.parametrize("known_times", [0, 1, 2])
def test_too_few_known_times_have_the_typical_error(known_times: int) -> None:
    sinking = [observation(10.0 * k if k < known_times else None, 0.5 * k, altitude_m=90.0 - k) for k in range(9)]
    rig = learn_rig(sinking, SIZE, {})
    assert [c.seconds for c in rig.captures] == [c.seconds for c in sinking]
    for band in BASELINES:
        unseen = predict_band(rig, band, Observation(35.0, {}, {}))
        # Without the times the error is that of the flight, not that of few captures.
        assert unseen.std_px > 0.7 * unobserved_error_px(rig, band, by_neighbours=False)
    # The capture is predicted from its height, which is known.
    assert error_px(rig, "NIR", Observation(None, {}, {}, altitude_m=86.5), mappings(1.75)["NIR"])[0] < 0.3


@pytest.mark.full
def test_a_band_in_few_captures_has_a_finite_error() -> None:
    """25 captures, three of them with NIR, twelve apart like the folds of the cross-validation."""
    rng = np.random.default_rng(1)
    without = ["NIR" if k % 12 else "" for k in range(25)]
    flight = [observation(float(k), rng.normal(), noise=0.03, seed=k, without=w) for k, w in enumerate(without)]
    rig = learn_rig(flight, SIZE, {})
    assert all(0 < rig.from_bands_px[band] < 0.3 for band in BASELINES)
    error, std = error_px(rig, "NIR", observation(30.0, 0.5, without="NIR"), mappings(0.5)["NIR"])
    assert error < min(0.3, 3 * std)
    assert std < 0.33


def test_few_errors_may_be_small_by_chance() -> None:
    """The variance of a further error from the mean square of n: 2 for three, 1.03 for sixty."""
    np.testing.assert_allclose(expected_square([1.0] * 4, [1, 2, 3, 60]), [3.0, 3.0, 2.0, 61 / 59])


def test_a_lens_that_moved_contradicts_the_rig_though_the_others_predict_it_accurately() -> None:
    rig, known = learn_rig(flight(), SIZE, BASELINES), observation(3.5, 0.4)
    assert not any(contradicts(rig, band, known) for band in BASELINES)
    nir = geometry.compose(geometry.translation(5.0, 0.0), known.mappings["NIR"])
    moved = replace(known, mappings={**known.mappings, "NIR": nir})
    assert max(predict_band(rig, band, moved).std_px for band in BASELINES) < 1.0
    assert [band for band in BASELINES if contradicts(rig, band, moved)] == ["NIR"]
