from dataclasses import replace

import numpy as np
import pytest

from agalign.capture import warped_pair
from agalign.capture.band_pair import BandPair
from agalign.capture.decision import fall_back_to_seed, verified
from agalign.capture.warped_pair import Candidate, WarpedPair
from agalign.fit.displacement_field import DisplacementResult
from agalign.values import geometry
from agalign.values.alignment import Prediction, Seed
from agalign.values.choices import ReliefUse
from agalign.values.image import Raster
from agalign.values.issues import FEW_KEYPOINTS, RETRIEVAL, SEED_DOES_NOT_FIT, Issue
from agalign.values.mapping import DisplacementField

from ..builders import displaced_views, joint_result, pair_of, residual_of, texture, two_views, whole

TRUTH = geometry.translation(6, -4)
SEED = Seed("rig", geometry.translation(5, -3), 30.0, 30.0, 5.0, trusted=True)
CENTRED = replace(SEED, fixed_to_moving=np.eye(3))
RIG = {"rig": SEED.fixed_to_moving}
GOOD = joint_result(TRUTH)


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*two_views(TRUTH), RIG)


@pytest.mark.parametrize(
    ("issues", "is_predicted", "is_seed_usable", "status"),
    [
        ((), True, True, "aligned"),
        ((Issue(RETRIEVAL, 0.1, 0.2),), True, True, "predicted"),
        ((Issue(RETRIEVAL, 0.1, 0.2),), False, True, "seed_only"),
        ((Issue(RETRIEVAL, 0.1, 0.2),), False, False, "failed"),
    ],
)
def test_the_status_is_that_of_the_first_row_that_applies(
    pair: BandPair, issues: tuple[Issue, ...], is_predicted: bool, is_seed_usable: bool, status: str
) -> None:
    prediction = Prediction(TRUTH, "windows", 0.1) if is_predicted else None
    result = replace(pair.seed_alignment(SEED, *issues), prediction=prediction, is_seed_usable=is_seed_usable)
    assert result.status == status


def test_a_trusted_seed_that_does_not_fit_the_windows_is_not_usable(pair: BandPair) -> None:
    issue = Issue(RETRIEVAL, 0.1, 0.2)
    assert fall_back_to_seed(pair, SEED, (issue,)).status == "seed_only"
    far = replace(SEED, fixed_to_moving=geometry.translation(150, 0))
    result = fall_back_to_seed(pair, far, (issue,))
    assert (result.status, result.issues) == ("failed", (issue, Issue(SEED_DOES_NOT_FIT)))
    assert "rig seed is used unchanged, but the seed does not fit either" in result.reason
    untrusted = fall_back_to_seed(pair, replace(SEED, trusted=False), (issue,))
    assert (untrusted.status, untrusted.issues) == ("failed", (issue,))


def test_a_seed_that_contradicts_the_tags_is_replaced_by_their_mapping(pair: BandPair) -> None:
    """An image of another capture fits at its own position, far from that of its band."""
    far = replace(SEED, kind="match", fixed_to_moving=geometry.translation(150, 0))
    tagged = replace(pair, seed_std_px={"rig": 5.0})
    result = fall_back_to_seed(tagged, far, (Issue(RETRIEVAL),))
    assert (result.status, result.seed.kind) == ("seed_only", "rig")
    np.testing.assert_array_equal(result.fixed_to_moving, RIG["rig"])
    assert fall_back_to_seed(pair, far, (Issue(RETRIEVAL),)).seed == far
    assert fall_back_to_seed(tagged, far, (Issue(RETRIEVAL),), seed_only=True).seed == far


def test_a_converted_residual_equals_a_new_measurement(pair: BandPair) -> None:
    warped_pair = WarpedPair.of(pair, pair.mapping(geometry.translation(5.95, -3.95)))
    mapping = pair.mapping(np.array([[1.0001, 0, 6.0], [0, 0.9999, -4.0], [0, 0, 1.0]]))
    near, again = warped_pair.with_mapping(mapping), WarpedPair.of(pair, mapping)
    assert near.warped is warped_pair.warped
    np.testing.assert_allclose(near.residual.shifts_px, again.residual.shifts_px, atol=0.04)
    assert near.residual.median_px == pytest.approx(again.residual.median_px, abs=0.04)
    far = pair.mapping(geometry.translation(9, -4))
    assert warped_pair.with_mapping(far).warped is not warped_pair.warped


def test_each_colour_is_verified_by_the_estimate_from_the_other(pair: BandPair) -> None:
    warped_pair = WarpedPair.of(pair, pair.mapping(TRUTH))
    by_black, by_white = geometry.translation(6.1, -4), geometry.translation(6, -4.2)
    crossed, before = warped_pair.cross_validated((by_black, by_white)).residual, warped_pair.residual
    expected_px = np.where(before.is_even_cell[:, None], (0, 0.2), (-0.1, 0))
    np.testing.assert_allclose(crossed.shifts_px - before.shifts_px, expected_px, atol=1e-6)
    candidate = replace(Candidate.of(pair, SEED, GOOD), by_halves=(by_black, by_white))
    assert verified(candidate, "never").residual.median_px > 0.08


def test_of_two_mappings_the_better_has_smaller_shifts_in_more_of_the_same_windows(pair: BandPair) -> None:
    given, large = WarpedPair.of(pair, pair.mapping(TRUTH)), pair.reference.large_windows

    def pair_with(shift_px: float, measured: int) -> WarpedPair:
        shifts = np.where(np.arange(10)[:, None] < measured, (shift_px, 0.0), np.nan)
        return replace(given, residual=residual_of(np.zeros((10, 2)), shifts))

    assert pair_with(0.5, 10).is_better_than(pair_with(0.6, 10))
    assert pair_with(0.5, 10).is_better_than(pair_with(0.4, 5))
    assert not pair_with(0.5, 5).is_better_than(pair_with(0.4, 5))
    assert not pair_with(0.5, 0).is_better_than(pair_with(3.0, 1))
    # Residuals of two grids are not compared: the other mapping is measured again, so its 9 px do not count.
    assert not pair_with(0.5, 10).is_better_than(replace(pair_with(9.0, 10), windows=large))


def test_a_result_with_issues_is_replaced_by_the_seed(pair: BandPair) -> None:
    results = verified(Candidate.of(pair, SEED, replace(GOOD, retrieval=0.01)), "always")
    assert (results.status, results.issues[0].code) == ("seed_only", "retrieval")
    np.testing.assert_array_equal(results.fixed_to_moving, SEED.fixed_to_moving)
    assert results.residual.median_px == pytest.approx(np.hypot(1, 1), abs=0.05)
    missing = fall_back_to_seed(pair, SEED, (Issue(FEW_KEYPOINTS, 3, 16),))
    assert missing.status == "seed_only"
    assert missing.reason == "only 3 keypoints are in the area that both bands show; the rig seed is used unchanged"


@pytest.mark.parametrize("kind", ["noise", "structure"])
def test_an_unrelated_image_is_not_aligned_by_a_seed_or_a_field(kind: str) -> None:
    noise = np.random.default_rng(3).normal(size=(320, 400)).astype(np.float32)
    pair = pair_of(texture(), whole(noise) if kind == "noise" else texture(seed=9), RIG)
    failed = verified(Candidate.of(pair, SEED, joint_result(retrieval=0.01)), "always")
    assert failed.status == "failed"
    assert failed.reason.endswith("but the seed does not fit either")
    results = verified(Candidate.of(pair, SEED, joint_result(SEED.fixed_to_moving)), "always")
    assert results.status not in ("aligned", "predicted")
    assert results.geometry == "homography"


def test_verification_is_repeated_with_a_displacement_field(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A field that leaves the windows misaligned must not be accepted."""
    wild = np.zeros((11, 14, 2))
    wild[..., 0] = 3.0
    result = DisplacementResult(DisplacementField(32.0, wild), 1.0, 0.5)
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_, **__: result)
    results = verified(Candidate.of(pair, SEED, GOOD), "always")
    assert (results.status, results.geometry) == ("aligned", "homography")
    assert results.candidates == {"homography": 1.0, "field": 0.5}
    assert results.residual.median_px < 0.1
    monkeypatch.setattr(warped_pair, "issues_of", lambda *_: ())
    assert verified(Candidate.of(pair, SEED, GOOD), "always").geometry == "field"


def displaced_pair(height_px: float, wavelength_px: float | None = None) -> BandPair:
    """A pair with a smooth bump in the centre or waves everywhere, which no homography represents."""

    def displacement(points: np.ndarray) -> np.ndarray:
        bump = np.exp(-(((points - (320, 240)) / 110) ** 2).sum(-1))
        form = bump if wavelength_px is None else np.prod(np.sin(2 * np.pi * points / wavelength_px), axis=-1)
        return height_px * form[..., None] * np.array([1.0, -0.6])

    return pair_of(*displaced_views(displacement), {"rig": np.eye(3)})


@pytest.mark.parametrize(
    ("displaced", "use", "status", "geometry"),
    [
        ((4.0,), "auto", "aligned", "field"),
        ((4.0,), "always", "aligned", "field"),
        ((4.0,), "never", "predicted", "homography"),
        # Shorter waves are not predicted without the windows that overlap one of verification.
        ((2.5, 300.0), "auto", "aligned", "field"),
    ],
)
def test_a_field_is_fitted_where_a_part_of_the_image_is_misaligned(
    displaced: tuple[float, ...], use: ReliefUse, status: str, geometry: str
) -> None:
    results = verified(Candidate.of(displaced_pair(*displaced), CENTRED, joint_result()), use)
    assert (results.status, results.geometry) == (status, geometry)
    if status == "aligned":  # the residual is that of held-out windows
        assert results.residual.median_px < (0.1 if displaced == (4.0,) else 0.4)


@pytest.mark.parametrize(("rig_known", "tried"), [(True, False), (False, True)])
def test_a_field_is_tried_without_a_rig_and_rejected_without_need(rig_known: bool, tried: bool) -> None:
    pair = replace(displaced_pair(0.0), seed_std_px={"model": 1.0} if rig_known else {})
    plain = verified(Candidate.of(pair, CENTRED, joint_result()), "auto")
    assert (plain.status, "field" in plain.candidates, plain.geometry) == ("aligned", tried, "homography")


def test_issues_that_a_field_cannot_remove_are_reported() -> None:
    """A third of the image 15 px off."""
    fixed, moving = two_views(TRUTH)
    moving.pixels[:, 270:] = np.roll(moving.pixels, 15, axis=0)[:, 270:]
    results = verified(Candidate.of(pair_of(fixed, moving, RIG), SEED, GOOD), "auto")
    assert results.status != "aligned"
    assert {"close_windows", "cluster"} & {d.code for d in results.issues}
    assert "of the windows" in results.reason


def test_smaller_windows_are_measured_where_valid_areas_are_small() -> None:
    fixed, moving = two_views(np.eye(3), 640, 480)
    scattered = np.ones((480, 640), bool)
    scattered[np.arange(480) % 60 < 12] = False
    scattered[:, np.arange(640) % 60 < 12] = False
    usual, pair = pair_of(fixed, moving), pair_of(Raster(fixed.pixels, scattered), moving)
    residual = WarpedPair.of(pair, pair.mapping(np.eye(3))).residual
    assert residual.coverage > 0.9
    assert residual.median_px < 0.1
    usual_windows = WarpedPair.of(usual, usual.mapping(np.eye(3))).residual
    assert len(usual_windows.centres_px) == len(usual.reference.windows.origins)


def test_a_field_is_verified_in_held_out_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field may fit any shifts of its own windows."""
    pair = displaced_pair(2.5)
    good = pair.reference.displacement_field.refine(pair.moving_image, pair.mapping(np.eye(3)))
    accepted = verified(Candidate.of(pair, CENTRED, joint_result()), "always")
    assert accepted.status == "aligned"
    np.testing.assert_array_equal(accepted.residual.shifts_px, good.held_out.shifts_px)
    misaligned = good.held_out.with_shifts(good.held_out.shifts_px + 1.5)
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_: replace(good, held_out=misaligned))
    refused = verified(Candidate.of(pair, CENTRED, joint_result()), "always")
    assert (refused.status, refused.geometry) == ("predicted", "homography")
    assert refused.prediction.std_px < good.held_out.median_px + 1.5
