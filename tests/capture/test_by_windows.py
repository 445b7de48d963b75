"""Results by windows: where descriptors fail, where half of the image has no windows, and of coarse bands."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

import agalign
from agalign.capture import align_bands
from agalign.capture import by_windows as module
from agalign.capture.band_pair import BandPair
from agalign.capture.by_windows import is_extrapolated
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand
from agalign.capture.reference import Reference
from agalign.capture.seeding import find_seed
from agalign.capture.warped_pair import WarpedPair
from agalign.config import SeedSettings
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.issues import FOLDS, OTHER_GEOMETRY, RETRIEVAL, UNREADABLE, Issue
from agalign.values.lens_shapes import lens_shapes

from ..builders import decided, fitted_to_windows, joint_result, pair_of, rms, two_views, whole
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


# ---- no structure in one half: a prediction with the error of that half

MATRIX = geometry.translation(6.0, -4.0)
LENS_PX = np.array([0.8, 0.0, 0.4, 0.0])
WHOLE, LEFT, RIGHT = slice(None), slice(None, 320), slice(320, None)


def distorted_images() -> tuple[np.ndarray, np.ndarray]:
    """A pair of lenses with a difference of up to 1.2 px."""
    fixed, moving = two_views(MATRIX, *SIZE)
    pixels = geometry.lattice(*SIZE, *SIZE)
    away = (pixels + lens_shapes(pixels, SIZE) @ LENS_PX).reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    return cv2.remap(fixed.pixels, away, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), moving.pixels


def valid_in(columns: slice) -> np.ndarray:
    valid = np.zeros(SIZE[::-1], bool)
    valid[:, columns] = True
    return valid


def pair_in(columns: slice) -> BandPair:
    return pair_of(*(raster_of(image, valid_in(columns), "image") for image in distorted_images()))


def true_positions(points: np.ndarray) -> np.ndarray:
    return geometry.apply(MATRIX, points + lens_shapes(points, SIZE) @ LENS_PX)


def refined(pair: BandPair) -> RefinedBand:
    """The band with a homography fitted to the common part."""
    points = geometry.lattice(*SIZE, 40, 30)
    seen = points[pair.fixed.valid[points[:, 1].astype(int), points[:, 0].astype(int)]]
    matrix = geometry.fit_homography(seen, true_positions(seen))
    joint = joint_result(matrix, covariance=0.0025 * np.eye(8))
    return RefinedBand.of(pair, SEED, joint)


def seed_of(band: RefinedBand) -> Seed:
    return Seed("structure", band.joint.fixed_to_moving, 20.0)


def by_homography(band: RefinedBand) -> Candidate:
    (plane,) = band.candidates("never")
    return plane


def with_relief(band: RefinedBand) -> Alignment:
    return fitted_to_windows(BandCandidates(band.pair, seed_of(band), None, [by_homography(band)]), band)


@pytest.fixture(scope="module")
def left() -> RefinedBand:
    """The band with pixels in its left half."""
    return refined(pair_in(LEFT))


def test_a_half_without_windows_has_the_error_of_unknown_lenses(left: RefinedBand) -> None:
    result = with_relief(left)
    assert (result.status, result.prediction.source) == ("predicted", "windows")
    assert [issue.code for issue in result.issues] == ["inaccurate"]
    assert "the expected error is above 0.5 px in" in result.reason
    assert "windows in the image" in result.reason
    points = geometry.lattice(*SIZE, 17, 13)
    errors = result.map(points) - true_positions(points)
    right = points[:, 0] > 330
    assert rms(errors[~right]) < 0.1 < 0.5 < rms(errors[right])
    assert 0.5 * rms(errors) < result.prediction.std_px < 1.0
    expected = result.error_px(points)
    assert np.median(expected[right]) > 2 * np.median(expected[points[:, 0] < 300])
    assert (np.linalg.norm(errors, axis=1) < 3 * expected).mean() > 0.95


def test_covered_images_georeferenced_files_and_failed_pairs_are_not_extrapolated(left: RefinedBand) -> None:
    everywhere, plane = by_homography(refined(pair_in(WHOLE))), by_homography(left)
    assert everywhere.issues == ()
    assert is_extrapolated(plane)
    mosaic = replace(plane, pair=replace(left.pair, seed_matrices={"geo": np.eye(3)}))
    failed = replace(plane, joint=replace(plane.joint, retrieval=0.1))
    assert not any(map(is_extrapolated, (everywhere, mosaic, failed)))


@pytest.mark.parametrize(
    ("facts", "status"),
    [
        ({"is_lens_known": True}, "aligned"),
        ({}, "predicted"),
        ({"is_lens_known": True, "relief_std_px": 4.0}, "predicted"),
    ],
)
def test_a_rig_of_the_whole_image_without_relief_prevents_extrapolation(
    left: RefinedBand, facts: dict[str, object], status: str
) -> None:
    band = refined(replace(left.pair, seed_std_px={"model": 1.0}, **facts))
    after = decided(band.pair, seed_of(band), [by_homography(band)])
    assert after.status == status
    if "relief_std_px" in facts:
        assert after.prediction.std_px > 1.5
        assert after.error_px([620.0, 240.0]) > 3.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset_px", "shift_px"),
    [((-20.0, 0.0), 20.0), ((0.0, 20.0), 0.0), ((20.0, 0.0), 0.0)],
    ids=["along the layout", "error of the tags", "beyond infinity"],
)
def test_unknown_relief_is_a_share_of_the_range(
    left: RefinedBand, offset_px: tuple[float, float], shift_px: float
) -> None:
    """The nearer the scene, the larger its shift from the mapping at infinity, along the layout of the lenses.

    The relief is unknown where no window is near.
    """
    pair, matrix = left.pair, left.joint.fixed_to_moving
    at_infinity = geometry.compose(geometry.translation(*np.negative(offset_px)), matrix)
    near = replace(pair, layout=(-1.0, 0.0), seed_matrices={**pair.seed_matrices, "rig": at_infinity})
    without, of_near = (with_relief(replace(left, warped=replace(left.warped, pair=one))) for one in (pair, near))
    relief_px = module._RELIEF_SHARE * shift_px
    for point, expected_px in (((630.0, 240.0), relief_px), ((60.0, 240.0), 0.0)):
        squares = [a.error_px(point) ** 2 for a in (of_near, without)]
        assert squares[0] - squares[1] == pytest.approx(expected_px**2, rel=0.1, abs=0.01)
    assert without.prediction.std_px <= of_near.prediction.std_px
    assert of_near.prediction.std_px <= np.hypot(without.prediction.std_px, relief_px)


def test_half_masked_arrays_are_predicted() -> None:
    fixed, moving = distorted_images()
    result = agalign.align(fixed, moving, fixed_valid=valid_in(RIGHT), moving_valid=valid_in(RIGHT))
    assert result.status == "predicted"
    points = geometry.lattice(*SIZE, 17, 13)
    assert rms(result.map(points) - true_positions(points)) < 2 * result.prediction.std_px


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
