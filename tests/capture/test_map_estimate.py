"""MAP estimates of a capture from its images and the flight's rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from agalign.capture import map_estimate
from agalign.capture.band_pair import BandPair
from agalign.capture.by_rig import observation
from agalign.capture.candidate import RefinedBand, without_descriptors
from agalign.capture.map_estimate import with_map_estimates
from agalign.capture.warped_pair import WarpedPair
from agalign.fit.held_out import chessboard
from agalign.flight.rig import Observation, Rig
from agalign.values import geometry
from agalign.values.alignment import JointResult, Seed
from agalign.values.capture import Capture
from agalign.values.residual import Residual

from ..builders import joint_result, pair_of, residual_of, two_views, whole

SIZE = 640, 480
MEAN = geometry.translation(30.0, -12.0)
SEED = Seed("rig", MEAN, 30.0)
NOTHING = residual_of(np.empty((0, 2)), np.empty((0, 2)))


def rig(std_px: float = 0.1) -> Rig:
    bands = "red", "nir"
    mean, baselines = dict.fromkeys(bands, MEAN), {"red": (0.6, 0.0), "nir": (0.0, 0.8)}
    none, baseline_std, from_bands_px = (dict.fromkeys(bands, value) for value in (0.0, 0.01, std_px))
    return Rig(SIZE, mean, baselines, none, baseline_std, ("distance",), (), from_bands_px)


def pairs() -> list[BandPair]:
    blank = whole(np.zeros(SIZE[::-1], np.float32))
    return [replace(pair_of(blank, blank), name=name) for name in ("red", "nir")]


def result(corners_px: ArrayLike, std_px: ArrayLike) -> JointResult:
    """A result with given distances of the corners from the rig's mean and standard errors, px, up to (4, 2)."""
    corners_px, std_px = (np.broadcast_to(np.asarray(values, float), (4, 2)) for values in (corners_px, std_px))
    moved = geometry.compose(MEAN, geometry.moving_corners(corners_px.ravel(), *SIZE))
    return joint_result().with_homography(moved, np.diag(std_px.ravel() ** 2))


def corners_near_the_mean(result: JointResult) -> np.ndarray:
    points = geometry.corners(*SIZE)
    return np.asarray(geometry.apply(result.fixed_to_moving, points) - geometry.apply(MEAN, points))


def band(pair: BandPair, joint: JointResult, windows: Residual = NOTHING) -> RefinedBand:
    mapping = pair.mapping(joint.fixed_to_moving)
    return RefinedBand(joint, WarpedPair(pair, mapping, pair.moving_image, pair.windows, windows))


def found_together(red: JointResult, nir: JointResult, the_rig: Rig | None) -> dict[str, JointResult]:
    bands = [band(pair, joint) for pair, joint in zip(pairs(), (red, nir), strict=True)]
    return {b.pair.name: b.joint for b in with_map_estimates(bands, the_rig)}


def test_the_prior_of_a_band_is_by_time_and_altitude_of_its_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def observed(*known: object) -> Observation:
        seen.append(known[-1])
        return observation(*known[:2])

    monkeypatch.setattr(map_estimate, "observation", observed)
    capture = Capture("one", Path(), (), 0)
    with_map_estimates([band(pairs()[0], result(0.0, 1.0))], rig(), capture)
    assert seen == [capture] * 3  # by all windows, and by each half


def test_a_band_without_descriptors_is_estimated_from_windows_and_rig() -> None:
    """Windows in the left half determine the mapping there and the rig elsewhere; without a rig, they do everywhere."""
    red, nir = pairs()
    left = residual_of(geometry.lattice(250, 480, 5, 6), np.array([0.3, 0.0]), sigma=30.0)
    bands = [band(red, result(0, 0.03)), band(nir, without_descriptors(MEAN), left)]
    (_, by_both), (_, by_windows) = (with_map_estimates(bands, the_rig) for the_rig in (rig(), None))
    of_both, of_windows = (corners_near_the_mean(estimate.joint)[:, 0] for estimate in (by_both, by_windows))
    np.testing.assert_allclose(of_windows, 0.3, atol=0.001)
    assert of_both[[0, 3]] == pytest.approx(0.3, abs=0.02)
    assert (of_both[1:3] < 0.15).all()
    assert by_both.joint.corner_std_px < by_windows.joint.corner_std_px


def test_corners_without_texture_follow_the_rig_with_its_error() -> None:
    off = np.array([[0.0, 0.0], [2.5, -1.5], [-2.0, 3.0], [0.0, 0.0]])
    both = found_together(result(0, 0.03), result(off, [[0.03], [4.0], [4.0], [0.03]]), rig())
    assert np.abs(corners_near_the_mean(both["nir"])).max() < 0.15
    std = np.array(both["nir"].corner_std_xy_px)
    assert (std[[0, 3]] < 0.04).all()
    assert ((std[[1, 2]] > 0.05) & (std[[1, 2]] < 0.3)).all()


def test_the_distance_is_estimated_from_the_band_with_texture() -> None:
    """Red is shifted by 3 px along its baseline; NIR without texture must shift equally along its own."""
    both = found_together(result([3.0, 0.0], 0.03), result(0, 50.0), rig())
    np.testing.assert_allclose(corners_near_the_mean(both["nir"]), np.tile([0.0, 4.0], (4, 1)), atol=0.1)
    np.testing.assert_allclose(corners_near_the_mean(both["red"]), np.tile([3.0, 0.0], (4, 1)), atol=0.02)


def test_a_band_whose_patches_are_not_found_again_is_no_evidence_of_the_others() -> None:
    """Red without texture follows the mean of the flight, not the shift of NIR along its baseline."""
    for retrieval, shift_px in ((1.0, 3.0), (0.02, 0.0)):
        nir = replace(result([0.0, 4.0], 0.03), retrieval=retrieval, chance=0.01)
        both = found_together(result(0, 50.0), nir, rig())
        np.testing.assert_allclose(corners_near_the_mean(both["red"]), np.tile([shift_px, 0.0], (4, 1)), atol=0.1)


@pytest.mark.parametrize(
    ("there", "std_px", "rig_px", "atol"),
    [([[1.2, 0.0], [0.0, 1.4], [-1.2, 0.0], [1.0, 1.0]], 0.03, 0.05, 0.05), ([[3.0, 4.0]] * 4, 0.4, 0.08, 0.3)],
)
def test_neither_a_certain_band_nor_a_moved_lens_is_biased_by_the_rig(
    there: ArrayLike, std_px: float, rig_px: float, atol: float
) -> None:
    both = found_together(result(0, 0.03), result(there, std_px), rig(rig_px))
    np.testing.assert_allclose(corners_near_the_mean(both["nir"]), there, atol=atol)


def test_without_a_rig_the_results_are_unchanged() -> None:
    there = np.array([[0.2, 0.0], [0.0, 0.1], [-0.3, 0.0], [0.0, 0.0]])
    red = result(there, 0.05)
    both = found_together(red, replace(red), None)
    np.testing.assert_allclose(both["red"].fixed_to_moving, red.fixed_to_moving, atol=1e-9)
    np.testing.assert_allclose(both["red"].corner_std_xy_px, red.corner_std_xy_px, atol=1e-6)


def test_windows_correct_the_result_of_the_descriptors() -> None:
    truth = geometry.translation(5.0, -3.0)
    pair = pair_of(*two_views(truth, *SIZE))
    left_px = np.array([0.2, -0.15, 0.1, 0.2, -0.2, 0.1, 0.15, -0.1])
    off = geometry.compose(truth, geometry.moving_corners(left_px, *SIZE))
    before = replace(result(0, 0.2), fixed_to_moving=off)
    residual = WarpedPair.of(pair, pair.mapping(off)).residual
    (after,) = (b.joint for b in with_map_estimates([band(pair, before, residual)], None))
    assert geometry.corner_error_px(off, truth, *SIZE) > 0.2
    assert geometry.corner_error_px(after.fixed_to_moving, truth, *SIZE) < 0.08
    assert after.corner_std_px < 0.1


@pytest.mark.parametrize(("off_px", "low", "high"), [(0.02, 0.1, 0.5), (0.9, 0.9, 1.01), (1.3, 0.9, 1.01)])
def test_descriptors_that_windows_contradict_have_little_weight(off_px: float, low: float, high: float) -> None:
    """The descriptors claim less than the windows, and a mean of both, off by many standard errors, still less."""
    at = np.stack(np.meshgrid(np.arange(56.0, 640.0, 112.0), np.arange(56.0, 480.0, 112.0)), -1).reshape(-1, 2)
    along_y = np.where(np.arange(len(at)) % 2 == 0, 0.15, -0.15)
    windows = residual_of(at, np.column_stack([np.full(len(at), off_px), along_y]))
    (after,) = (b.joint for b in with_map_estimates([band(pairs()[0], result(0, 0.04), windows)], None))
    centre = np.array([320.0, 240.0])
    moved_px = geometry.apply(after.fixed_to_moving, centre) - geometry.apply(MEAN, centre)
    assert low < moved_px[0] / off_px <= high


def test_collinear_windows_do_not_determine_corners_away_from_the_line() -> None:
    x = np.linspace(40.0, 600.0, 20)
    centres = np.column_stack([x, np.full(20, 240.0)])
    rng = np.random.default_rng(0)
    shifts = np.array([0.3, 0.0]) + 0.02 * rng.normal(size=(20, 2))
    shown = residual_of(centres, shifts)
    (results,) = (b.joint for b in with_map_estimates([band(pairs()[0], result(0, 2.0), shown)], None))
    middle = geometry.apply(results.fixed_to_moving, [320.0, 240.0]) - geometry.apply(MEAN, [320.0, 240.0])
    np.testing.assert_allclose(middle, [0.3, 0.0], atol=0.05)
    assert results.corner_std_px > 0.5


@pytest.mark.parametrize("magnification", [1.0, 0.1])
def test_the_error_of_a_prediction_is_in_px_of_the_reference(magnification: float) -> None:
    """For a band without texture; the t distribution at its maximum has the curvature of a third of the variance."""
    to_nir = geometry.compose(np.diag([magnification, magnification, 1.0]), MEAN)
    nir = replace(result(0, 50.0), fixed_to_moving=to_nir)
    both = found_together(result(0, 0.03), nir, replace(rig(), mean={"red": MEAN, "nir": to_nir}))
    over = geometry.over_corners(geometry.lattice(*SIZE, 7, 5), *SIZE)
    squares = np.einsum("nki,ij,nkj->n", over, both["nir"].corner_covariance_px2, over)
    assert squares.mean() == pytest.approx(0.1**2 / 3, rel=0.01)


@pytest.mark.parametrize(("shift_px", "is_used"), [(0.6, True), (4.4, False)])
def test_windows_are_ignored_without_each_fold_or_never(shift_px: float, is_used: bool) -> None:
    """The correction by one fold may be within the limit of 4 px where that by all windows is not."""
    at = np.stack(np.meshgrid(np.arange(56.0, 640.0, 112.0), np.arange(56.0, 480.0, 112.0)), -1).reshape(-1, 2)
    windows = residual_of(at, (shift_px, 0.0))
    own_px = np.where(chessboard(windows).numbers == 0, shift_px + 0.5, shift_px - 0.5)  # 3.9 px of the second fold
    windows = windows.with_shifts(np.column_stack([own_px, np.zeros(len(at))]))
    before = result(0, 2.0)
    (after,) = with_map_estimates([band(pairs()[0], before, windows)], None)
    used = [abs(matrix[0, 2] - MEAN[0, 2]) > 0.05 for matrix in (after.joint.fixed_to_moving, *after.by_fold)]
    assert used == [is_used] * 3
