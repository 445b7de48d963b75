from dataclasses import replace

import cv2
import numpy as np
import pytest

from agalign.capture import verification
from agalign.capture.band_pair import BandPair
from agalign.capture.verification import WarpedPair, verified, with_metrics
from agalign.values import geometry
from agalign.values.alignment import JointResult, PairScales, Residual, Seed
from agalign.values.choices import ReliefUse
from agalign.values.displacement import DisplacementField
from agalign.values.image import Raster
from agalign.values.issues import FEW_KEYPOINTS, Issue
from agalign.values.pixel_units import PixelScale
from agalign.verify.displacement_field import DisplacementResult

from ..conftest import textured_image, textured_pair

SEED = Seed("rig", geometry.translation(5, -3), 30.0, 30.0, 5.0, trusted=True)


def pair_of(fixed: np.ndarray, moving: np.ndarray) -> BandPair:
    images = (Raster(image, np.ones(image.shape, bool)) for image in (fixed, moving))
    return BandPair.of_images("nir", *images, {"rig": SEED.fixed_to_moving})


def result(matrix: np.ndarray, retrieval: float = 0.9) -> JointResult:
    return JointResult(matrix, 0.1, retrieval, 0.004, 0, (1.0,), "fast", "homography", 0.01, ((0.05, 0.05),) * 4)


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*textured_pair(geometry.translation(6, -4)))


def test_a_result_that_passes_is_aligned_and_measured(pair: BandPair) -> None:
    results = verified(pair, SEED, result(geometry.translation(6, -4)), "always")
    assert (results.status, results.issues, results.reason) == ("aligned", (), None)
    assert results.residual.median_px < 0.1
    measured = with_metrics(results, pair)
    assert measured.after["overlap"] > 0.9
    assert measured.after["mattes_mi"] < measured.before["mattes_mi"]


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
    warped_pair = WarpedPair.of(pair, pair.mapping(geometry.translation(6, -4)))
    by_black, by_white = geometry.translation(6.1, -4), geometry.translation(6, -4.2)
    crossed, before = warped_pair.cross_validated((by_black, by_white)).residual, warped_pair.residual
    black, change_px = before.is_black, crossed.shifts_px - before.shifts_px
    np.testing.assert_allclose(change_px[~black], np.broadcast_to((-0.1, 0), change_px[~black].shape), atol=1e-6)
    np.testing.assert_allclose(change_px[black], np.broadcast_to((0, 0.2), change_px[black].shape), atol=1e-6)
    joint = result(geometry.translation(6, -4))
    assert verified(pair, SEED, joint, "never", None, (by_black, by_white)).residual.median_px > 0.08


def test_a_result_with_issues_is_replaced_by_the_seed(pair: BandPair) -> None:
    results = verified(pair, SEED, result(geometry.translation(6, -4), retrieval=0.01), "always")
    assert results.status == "seed_only"
    assert results.issues[0].code == "retrieval"
    np.testing.assert_array_equal(results.fixed_to_moving, SEED.fixed_to_moving)
    assert results.residual.median_px == pytest.approx(np.hypot(1, 1), abs=0.15)


def test_a_missing_result_has_its_own_reason(pair: BandPair) -> None:
    result = verified(pair, SEED, Issue(FEW_KEYPOINTS, 3, 16), "always")
    assert result.status == "seed_only"
    assert result.reason == "only 3 keypoints are in the area that both bands show; the rig seed is used unchanged"


def test_an_unrelated_image_is_failed_with_or_without_a_seed() -> None:
    results = verified(
        pair_of(textured_image(400, 320), textured_image(400, 320, 9)), SEED, result(np.eye(3), 0.01), "always"
    )
    assert results.status == "failed"
    assert results.reason.endswith("but the seed does not fit either")


def test_verification_is_repeated_with_a_displacement_field(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A field that leaves the windows misaligned must not be accepted."""
    wild = np.zeros((11, 14, 2))
    wild[..., 0] = 3.0
    monkeypatch.setattr(
        pair.reference.displacement_field,
        "refine",
        lambda *_, **__: DisplacementResult(DisplacementField(32.0, wild), 1.0, 0.5),
    )
    results = verified(pair, SEED, result(geometry.translation(6, -4)), "always")
    assert results.status == "aligned"
    assert results.candidates == {"homography": 1.0, "field": 0.5}
    assert results.geometry == "homography"
    assert results.residual.median_px < 0.1
    monkeypatch.setattr(verification, "issues_of", lambda *_: ())
    assert verified(pair, SEED, result(geometry.translation(6, -4)), "always").geometry == "field"


def test_residuals_of_a_reduced_image_are_in_px_of_the_file() -> None:
    at_quarter = PairScales(PixelScale(0.25, 0.25), PixelScale(0.25, 0.25))
    residual = Residual.of(np.array([[10.0, 20.0]]), np.array([[0.5, 0.0]]), np.array([9.0])).in_file_px(at_quarter)
    np.testing.assert_allclose(residual.centres_px, [[41.5, 81.5]])
    assert (residual.median_px, residual.shifts_px[0, 0]) == (2.0, 2.0)


def displaced_pair(height_px: float, apart_px: float | None = None) -> BandPair:
    """A pair with a smooth bump in the centre or waves everywhere, which no homography represents."""
    fixed, moving = textured_pair(np.eye(3), 640, 480, seed=4)
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1)

    def bump(points: np.ndarray) -> np.ndarray:
        if apart_px is None:
            fall = np.exp(-(((points - (320, 240)) / 110) ** 2).sum(-1))
        else:
            fall = np.prod(np.sin(2 * np.pi * points / apart_px), axis=-1)
        return height_px * fall[..., None] * np.array([1.0, -0.6])

    back = grid - bump(grid - bump(grid))
    displaced_image = cv2.remap(moving, back.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    images = (Raster(image, np.ones(image.shape, bool)) for image in (fixed, displaced_image))
    return BandPair.of_images("nir", *images, {"rig": np.eye(3)})


@pytest.mark.parametrize(("use", "status"), [("auto", "aligned"), ("always", "aligned"), ("never", "seed_only")])
def test_a_field_is_fitted_where_a_part_of_the_image_is_misaligned(use: ReliefUse, status: str) -> None:
    seed = Seed("rig", np.eye(3), 30.0, 30.0, 5.0, trusted=True)
    results = verified(displaced_pair(4.0), seed, result(np.eye(3)), use)
    assert results.status == status
    assert results.geometry == ("field" if status == "aligned" else "homography")


@pytest.mark.slow
def test_a_field_follows_quickly_varying_parallax() -> None:
    """Waves of 300 px. Shorter ones are not predicted without the windows that overlap one of verification."""
    pair, seed = displaced_pair(2.5, apart_px=300.0), Seed("rig", np.eye(3), 30.0, 30.0, 5.0, trusted=True)
    results = verified(pair, seed, result(np.eye(3)), "auto")
    assert results.status == "aligned"
    # The residual is that of held-out windows.
    assert results.residual.median_px < 0.4
    assert results.geometry == "field"


@pytest.mark.parametrize(("rig_known", "tried"), [(True, False), (False, True)])
def test_a_field_is_tried_without_a_rig_and_rejected_without_need(rig_known: bool, tried: bool) -> None:
    pair = displaced_pair(0.0)
    pair = replace(pair, candidate_std_px={"model": 1.0} if rig_known else {})
    seed = Seed("rig", np.eye(3), 30.0, 30.0, 5.0, trusted=True)
    plain = verified(pair, seed, result(np.eye(3)), "auto")
    assert (plain.status, "field" in plain.candidates, plain.geometry) == ("aligned", tried, "homography")


def test_issues_that_a_field_cannot_remove_are_reported(pair: BandPair) -> None:
    """A third of the image 15 px off."""
    fixed, moving = textured_pair(geometry.translation(6, -4))
    partly_shifted = moving.copy()
    partly_shifted[:, 270:] = np.roll(moving, 15, axis=0)[:, 270:]
    results = verified(pair_of(fixed, partly_shifted), SEED, result(geometry.translation(6, -4)), "auto")
    assert results.status != "aligned"
    assert {"close_windows", "cluster"} & {d.code for d in results.issues}
    assert "of the windows" in (results.reason or "")


def test_smaller_windows_are_measured_where_valid_areas_are_small() -> None:
    fixed, moving = textured_pair(np.eye(3), 640, 480)
    scattered = np.ones((480, 640), bool)
    scattered[np.arange(480) % 60 < 12] = False
    scattered[:, np.arange(640) % 60 < 12] = False
    whole = pair_of(fixed, moving)
    pair = BandPair.of_images("nir", Raster(fixed, scattered), whole.moving_image, whole.candidates)
    assert len(pair.reference.windows.residuals(pair.moving).centres_px) == 0
    residual = WarpedPair.of(pair, pair.mapping(np.eye(3))).residual
    assert residual.coverage > 0.9
    assert residual.median_px < 0.1
    usual = WarpedPair.of(whole, whole.mapping(np.eye(3))).residual
    assert len(usual.centres_px) == len(whole.reference.windows.origins)


def test_a_field_is_verified_in_held_out_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field may fit any shifts of its own windows."""
    pair = displaced_pair(2.5)
    seed = Seed("rig", np.eye(3), 30.0, 30.0, 5.0, trusted=True)
    good = pair.reference.displacement_field.refine(pair.moving_image, pair.mapping(np.eye(3)))
    assert good.field is not None
    accepted = verified(pair, seed, result(np.eye(3)), "always")
    assert accepted.status == "aligned"
    np.testing.assert_array_equal(accepted.residual.shifts_px, good.held_out.shifts_px)
    off = replace(
        good, held_out=Residual.of(good.held_out.centres_px, good.held_out.shifts_px + 1.5, good.held_out.peaks_sigma)
    )
    monkeypatch.setattr(pair.reference.displacement_field, "refine", lambda *_: off)
    refused = verified(pair, seed, result(np.eye(3)), "always")
    assert refused.status == "predicted"
    assert refused.prediction.std_px > 1.5


@pytest.mark.parametrize("kind", ["noise", "structure"])
def test_no_field_aligns_an_unrelated_image(kind: str) -> None:
    fixed = textured_image(480, 360)
    other = (
        np.random.default_rng(3).normal(size=fixed.shape).astype(np.float32)
        if kind == "noise"
        else textured_image(480, 360, 9)
    )
    pair = pair_of(fixed, other)
    results = verified(pair, SEED, result(SEED.fixed_to_moving), "always")
    assert results.status not in ("aligned", "predicted")
    assert results.geometry == "homography"
