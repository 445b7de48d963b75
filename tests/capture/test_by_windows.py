"""Results by windows: where descriptors fail, and of coarse bands."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from agalign.capture import align_bands
from agalign.capture import by_windows as module
from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand
from agalign.capture.reference import Reference
from agalign.capture.seeding import find_seed
from agalign.capture.warped_pair import WarpedPair
from agalign.config import SeedSettings
from agalign.values import geometry
from agalign.values.alignment import Seed
from agalign.values.issues import FOLDS, OTHER_GEOMETRY, RETRIEVAL, UNREADABLE, Issue

from ..builders import estimation_of, fitted_to_windows, joint_result, pair_of, rms, two_views, whole
from ..conftest import textured_image

SIZE = 640, 480
SILENT = Issue(RETRIEVAL, 0.05, 0.2)

# ---- where descriptors fail: confirmed by held-out windows

LARGE = 800, 640
TRUTH = geometry.compose(
    geometry.translation(5.0, -3.0), np.array([[1.004, 0.002, 0], [-0.003, 0.998, 0], [0, 0, 1.0]])
)
GOOD = joint_result(TRUTH)


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*two_views(TRUTH, *LARGE))


SEED = Seed("structure", geometry.translation(5.0, -3.0), 20.0, trusted=True)


def lost(pair: BandPair, issue: Issue = SILENT) -> BandCandidates:
    """A band without a result of the descriptors, whose seed fits."""
    band = BandCandidates(pair, SEED, issue)
    assert band.does_seed_fit
    return band


def test_windows_suffice_where_descriptors_fail(pair: BandPair) -> None:
    after = fitted_to_windows(lost(pair))
    assert (after.status, after.issues, after.joint.recipe) == ("aligned", (), "windows")
    assert geometry.corner_error_px(SEED.fixed_to_moving, TRUTH, *LARGE) > 1
    assert geometry.corner_error_px(after.fixed_to_moving, TRUTH, *LARGE) < 0.3


def test_windows_do_not_override_descriptors_or_other_failures(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fitted_to_windows(lost(pair, Issue(UNREADABLE, detail="x"))).status == "failed"
    assert fitted_to_windows(lost(pair, Issue(FOLDS, 9.0, 4.0))).status == "seed_only"
    aligned_already = BandCandidates(pair, SEED)
    aligned_already.candidates = [Candidate.of(RefinedBand.of(pair, SEED, GOOD).warped, GOOD)]
    assert fitted_to_windows(aligned_already).joint.recipe == "fast"
    assert len(aligned_already.candidates) == 1
    monkeypatch.setattr(module, "_MAX_MOVED_PX", 0.5)  # less than the error of the seed
    assert fitted_to_windows(lost(pair)).status == "seed_only"


@pytest.mark.parametrize(("std_px", "is_fitted"), [(0.6, False), (4.0, True)])
def test_windows_are_fitted_where_descriptors_predict_with_an_error_that_no_index_accepts(
    pair: BandPair, std_px: float, is_fitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[BandCandidates] = []
    monkeypatch.setattr(align_bands, "fitted_to_windows", fitted.append)
    warped = WarpedPair.of(pair, pair.mapping(TRUTH))
    band = BandCandidates(pair, SEED, candidates=[Candidate.of(warped, joint_result(TRUTH, std_px=std_px))])
    assert fitted_to_windows(band).status == "predicted"
    assert bool(fitted) is is_fitted


@pytest.mark.parametrize("in_second", [True, False])
def test_windows_are_not_fitted_for_bands_under_each_relief(
    pair: BandPair, in_second: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The candidate under the relief is chosen before any other: the result of the descriptors remains."""
    fitted: list[BandCandidates] = []
    monkeypatch.setattr(align_bands, "fitted_to_windows", fitted.append)
    result = joint_result(TRUTH, std_px=4.0)
    refined = RefinedBand.of(pair, SEED, result)
    estimation = estimation_of(BandCandidates(pair, SEED, candidates=[Candidate.of(refined.warped, result)]), refined)
    under = {pair.name: Candidate.of(refined.warped, result)}
    estimation.reliefs = [under, under if in_second else {}]
    estimation._fit_windows(estimation.decided())
    assert bool(fitted) is not in_second
    assert estimation.refined == [refined]


def test_held_out_windows_must_confirm_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, moving = two_views(TRUTH, *LARGE)
    moving.pixels[:, 480:] = textured_image(320, 640, seed=5)  # unrelated content
    after = fitted_to_windows(lost(pair_of(fixed, moving)))
    assert after.status == "predicted"
    assert "other_content" in [issue.code for issue in after.issues]
    moving.pixels[:] = textured_image(*LARGE, seed=5)
    unrelated = BandCandidates(pair_of(fixed, moving), SEED, SILENT)
    monkeypatch.setattr(BandCandidates, "does_seed_fit", True)
    assert fitted_to_windows(unrelated).status == "seed_only"


# ---- bands with few pixels and little common structure: predicted with a correct standard error, or failed

FIXED_PX, MOVING_PX = (320, 240), (160, 120)
COARSE_TRUTH = geometry.compose(
    geometry.translation(83.0, 57.0), np.diag([0.43, 0.43, 1.0]), geometry.translation(-159.5, -119.5)
)
"""A field of view a sixth wider than in an overlay of the images."""


def thermal(scene: np.ndarray, other_share: float) -> np.ndarray:
    """The scene in a thermal camera: inverted, with unrelated content in a share of the image."""
    large = cv2.GaussianBlur(scene, (0, 0), 1.2)
    to_moving = geometry.compose(COARSE_TRUTH, geometry.translation(-100.0, -100.0))
    seen = cv2.warpPerspective(large, to_moving, MOVING_PX, flags=cv2.INTER_LINEAR)
    mask = cv2.GaussianBlur(np.random.default_rng(5).normal(size=MOVING_PX[::-1]), (0, 0), 12)
    other = cv2.GaussianBlur(textured_image(*MOVING_PX, seed=9), (0, 0), 1.0)
    return np.asarray(np.where(mask > np.quantile(mask, other_share), -seen / seen.std(), other / other.std()))


def coarse_band(fixed: np.ndarray, moving: np.ndarray) -> BandCandidates:
    images = (whole((1000 + 100 * pixels).astype(np.float32)) for pixels in (fixed, moving))
    pair = replace(pair_of(*images, {"identity": geometry.overlay(FIXED_PX, MOVING_PX)}), is_coarse=True)
    return BandCandidates(pair, find_seed(pair, SeedSettings()), Issue(RETRIEVAL, 0.0, 0.2))


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """100 px wider than the reference on every side."""
    return textured_image(520, 440, seed=3)


@pytest.mark.parametrize("other_share", [0.2, 0.5])
def test_a_coarse_band_with_another_field_of_view_is_predicted_with_its_error(
    scene: np.ndarray, other_share: float
) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, other_share))
    result = fitted_to_windows(band)
    assert result.status == "predicted"
    points = geometry.lattice(*FIXED_PX, 9, 7)
    assert rms(result.map(points) - geometry.apply(COARSE_TRUTH, points)) < result.prediction.std_px < 0.6
    assert "predicted from windows in the image" in result.reason
    of_full_resolution = replace(band.pair, is_coarse=False)
    untrusted = replace(band.seed, trusted=False)
    for pair, seed in ((of_full_resolution, band.seed), (band.pair, untrusted)):
        lost = fitted_to_windows(BandCandidates(pair, seed, band.issue))
        assert (lost.status != "aligned", lost.prediction) == (True, None)  # half of its windows are too few


def test_a_coarse_band_without_any_candidate_is_not_verified_by_the_windows_of_its_fit(scene: np.ndarray) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.2))
    by_windows = module.in_windows_that_agree(BandCandidates(band.pair, band.seed))
    assert by_windows.issues == (Issue(OTHER_GEOMETRY),)


def test_the_error_of_a_coarse_band_is_by_windows_without_their_part_in_the_fit(scene: np.ndarray) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.5))
    by_windows = module.in_windows_that_agree(BandCandidates(band.pair, band.seed, band.issue))
    of_fit = by_windows.images.residual
    assert by_windows.error.residual is by_windows.residual
    assert by_windows.residual.std_px > of_fit.std_px


def test_a_coarse_band_whose_windows_agree_in_the_fit_only_is_not_predicted(
    scene: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.2))
    cross_fitted = module.cross_fitted

    def contradicting(*arguments: Any, **named: Any) -> Any:
        found = cross_fitted(*arguments, **named)
        return found._replace(held_out=found.held_out.with_shifts(found.held_out.shifts_px + 9))

    monkeypatch.setattr(module, "cross_fitted", contradicting)
    assert module.in_windows_that_agree(BandCandidates(band.pair, band.seed, band.issue)) is None


def test_a_coarse_band_has_the_error_of_the_relief_of_its_flight(scene: np.ndarray) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.2))
    over_trees = replace(band.pair, relief_std_px=3.0)
    assert module.in_windows_that_agree(BandCandidates(over_trees, band.seed)).error.relief_std_px == 3.0


def test_a_coarse_band_is_not_predicted_far_from_its_seed(scene: np.ndarray) -> None:
    """Its windows may agree with the next row of plants."""
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.2))
    for off_px, is_predicted in ((0.0, True), (10.0, True), (20.0, False)):
        off = geometry.compose(band.seed.fixed_to_moving, geometry.translation(off_px, 0.0))
        by_windows = module.in_windows_that_agree(BandCandidates(band.pair, replace(band.seed, fixed_to_moving=off)))
        assert (by_windows is not None) is is_predicted


def test_areas_without_data_do_not_count_in_a_georeferenced_coarse_band(scene: np.ndarray) -> None:
    band = coarse_band(scene[100:340, 100:420], thermal(scene, 0.2))
    reference = band.pair.reference.image
    valid = reference.valid & (np.arange(FIXED_PX[0]) >= 100)
    matrices = {"geo": band.seed.fixed_to_moving, **band.pair.seed_matrices}
    pair = replace(band.pair, reference=Reference(replace(reference, valid=valid)), seed_matrices=matrices)
    by_windows = module.in_windows_that_agree(BandCandidates(pair, band.seed, band.issue))
    assert by_windows.common_px[:, 0].min() > 90


@pytest.mark.parametrize("kind", ["unrelated", "repetitive"])
def test_unrelated_and_repetitive_coarse_bands_are_not_predicted(scene: np.ndarray, kind: str) -> None:
    tile = np.tile(textured_image(40, 40, seed=4), (11, 13))
    fixed = textured_image(*FIXED_PX, seed=11) if kind == "unrelated" else tile[100:340, 100:420]
    result = fitted_to_windows(coarse_band(fixed, thermal(scene if kind == "unrelated" else tile, 0.2)))
    assert (result.status, result.prediction) == ("failed", None)
