"""Fits of homographies and lens shapes to windows: accuracy, standard errors, wrong peaks, areas without windows."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from agalign.fit.held_out import chessboard, one_by_one
from agalign.fit.window_fit import WindowFit, cross_fitted, fit_in_rounds, fit_windows
from agalign.fit.windows import residual_under
from agalign.values import geometry
from agalign.values.least_squares import shift_scale_px
from agalign.values.lens_shapes import CALIBRATED, LENS_STD, jacobian, lens_shapes, lens_std_px, variance_px2
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.residual import Residual
from agalign.verify.coverage import points_in_frame, unmodelled_std_px, unobserved_quarters

from ..builders import grid_px, residual_of, rms

SIZE = 1280, 960
CENTRES = grid_px(np.arange(56, 1280, 112), np.arange(56, 960, 112))
LEFT = CENTRES[CENTRES[:, 0] < 600]
EVERYWHERE = geometry.lattice(*SIZE, 17, 13)
RIGHT = EVERYWHERE[EVERYWHERE[:, 0] > 640]
CORNERS_PX = np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2, 0.3, -0.4])
TRUTH_PX = np.r_[CORNERS_PX, 1.2, -0.5, 0.8, -0.6]
IDENTITY = PixelMapping(np.eye(3))


def windows(truth_px: np.ndarray, centres_px: np.ndarray = CENTRES, noise_px: float = 0.05, seed: int = 0) -> Residual:
    exact = jacobian(centres_px, SIZE, len(truth_px)) @ truth_px
    return residual_of(centres_px, exact + np.random.default_rng(seed).normal(0, noise_px, exact.shape))


def fitted(residual: Residual, lens: bool = False, mapping: PixelMapping = IDENTITY) -> WindowFit:
    return fit_windows(mapping, residual, SIZE, lens_std_px(SIZE, calibrated=False) if lens else None)


def means_px(fit: WindowFit) -> np.ndarray:
    """(8,) corners, (12,) with the lens shapes."""
    return fit.corners_px if fit.lens_px is None else np.r_[fit.corners_px, fit.lens_px]


def test_the_windows_correct_the_homography_through_the_displacement_field() -> None:
    """The field stretches the image by 1.2 along x: 1 px of the raw image is 1.2 px for the homography."""
    nodes = np.zeros((22, 28, 2))
    nodes[..., 0] = 0.2 * 48.0 * np.arange(28)
    plain = PixelMapping(geometry.translation(5.0, 3.0))
    stretched = PixelMapping(geometry.translation(5.0, 3.0), field=DisplacementField(48.0, nodes))
    for mapping, expected_px in ((plain, 1.0), (stretched, 1.2)):
        fit = fitted(windows(np.tile([1.0, -0.5], 4), noise_px=0.0), mapping=mapping)
        np.testing.assert_allclose(means_px(fit), np.tile([expected_px, -0.5], 4), atol=0.01)
        corrected = fit.applied_to(mapping)
        assert corrected.field is mapping.field
        moved = geometry.apply(corrected.fixed_to_moving, [300.0, 200.0])
        np.testing.assert_allclose(moved, [305.0 + expected_px, 202.5], atol=0.02)


def test_exact_shifts_are_fitted_exactly_and_the_common_error_remains() -> None:
    fit = fitted(windows(CORNERS_PX, geometry.lattice(*SIZE, 60, 40), noise_px=0.0))
    np.testing.assert_allclose(means_px(fit), CORNERS_PX, atol=1e-6)
    std_px = np.sqrt(np.diag(fit.covariance_px2))
    assert 0.01 <= std_px.min() <= std_px.max() < 0.015


def test_eight_parameters_without_a_prior_need_twelve_windows_not_on_a_line() -> None:
    assert fitted(windows(CORNERS_PX, CENTRES[::8][:11])) is None
    assert fitted(windows(CORNERS_PX, CENTRES[::8][:12])) is not None
    on_a_line = fitted(windows(CORNERS_PX, CENTRES[:12]))
    assert np.sqrt(np.diag(on_a_line.covariance_px2)).max() > 100


def test_all_windows_are_fitted_and_each_is_verified_by_the_other_half() -> None:
    """The black windows of the right half contradict the others by 1 px: those that verify them do not follow."""
    truth = PixelMapping(geometry.moving_corners(CORNERS_PX * 4, *SIZE))
    wrong = (np.rint((CENTRES - 56) / 112).sum(axis=1) % 2 == 0) & (CENTRES[:, 0] > 640)

    def measure(mapping: PixelMapping) -> Residual:
        shifts_px = geometry.apply(geometry.invert(mapping.fixed_to_moving), truth(CENTRES)) - CENTRES
        return residual_of(CENTRES, shifts_px + wrong[:, None] * np.array((1.0, 0.0)))

    found = cross_fitted(IDENTITY, measure, SIZE, chessboard, 112, max_moved_px=8.0)
    assert rms(found.mapping(EVERYWHERE) - truth(EVERYWHERE)) < 0.25
    assert found.at_start.median_px > 1.0
    np.testing.assert_allclose(found.held_out.shifts_px[wrong].mean(axis=0), (1.0, 0.0), atol=0.1)
    assert cross_fitted(IDENTITY, measure, SIZE, chessboard, 112, max_moved_px=1.0) is None
    black = CENTRES[chessboard(found.held_out).numbers == 0]
    assert cross_fitted(IDENTITY, lambda _: windows(CORNERS_PX, black), SIZE, chessboard, 112) is None


def test_an_overlapping_window_is_verified_without_those_that_share_pixels_with_it() -> None:
    """A window that moves changes its own residual by as much, and no residual of those that overlap it."""
    side_px, lens_std = 112, lens_std_px(SIZE, calibrated=False)
    centres_px = grid_px(np.arange(56, 1280, 56), np.arange(56, 960, 56))
    residual, window = windows(TRUTH_PX, centres_px), 150
    moved_px = residual.shifts_px.copy()
    moved_px[window] += 2.0, 1.0
    before, after = (
        cross_fitted(IDENTITY, partial(residual_under, one, IDENTITY), SIZE, one_by_one, side_px, lens_std_px=lens_std)
        for one in (residual, residual.with_shifts(moved_px))
    )
    assert rms(before.held_out.shifts_px) < 0.1
    change_px = after.held_out.shifts_px - before.held_out.shifts_px
    np.testing.assert_allclose(change_px[window], (2.0, 1.0), atol=0.01)
    distance_px = np.abs(centres_px - centres_px[window]).max(axis=1)
    assert np.count_nonzero(distance_px < side_px) == 9
    overlaps = (distance_px < side_px) & (distance_px > 0)
    np.testing.assert_allclose(change_px[overlaps], 0, atol=1e-4)  # corners are moved to 3e-5 px
    assert np.abs(change_px[distance_px >= side_px]).max() > 1e-4


def test_many_wrong_peaks_on_one_side_do_not_move_a_homography() -> None:
    """Four of ten windows, as of saturated images that move."""
    rng, errors_px = np.random.default_rng(1), []
    for _ in range(20):
        shifts_px = 0.1 * rng.normal(size=CENTRES.shape)
        is_wrong = rng.random(len(CENTRES)) < 0.4
        shifts_px[is_wrong] = rng.uniform((-8, -20), (32, 20), (int(is_wrong.sum()), 2))
        fit = fit_windows(IDENTITY, residual_of(CENTRES, shifts_px), SIZE)
        assert fit is not None
        errors_px.append(np.abs(fit.corners_px).max())
    assert np.median(errors_px) < 0.3


def test_windows_without_a_shift_are_in_no_fold() -> None:
    residual = residual_of(CENTRES[:4], np.array([[1.0, 0.0], [np.nan, np.nan], [0.0, 1.0], [np.nan, np.nan]]))
    folds = one_by_one(residual)
    assert (folds.numbers.tolist(), folds.count) == ([0, -1, 1, -1], 2)


@pytest.mark.parametrize("magnification", [1.0, 0.1])
def test_the_limit_of_a_correction_is_for_all_rounds_together(magnification: float) -> None:
    """Windows that are shifted by 2 px again after each correction lead away from the seed."""
    start = PixelMapping(np.diag([magnification, magnification, 1.0]))

    def measure(_: PixelMapping) -> Residual:
        return residual_of(CENTRES, np.full(CENTRES.shape, (2.0, 0.0)))

    assert cross_fitted(start, measure, SIZE, chessboard, 112, max_moved_px=10.0) is not None
    assert cross_fitted(start, measure, SIZE, chessboard, 112, max_moved_px=5.0) is None


def test_the_prior_of_a_correction_is_around_the_first_mapping_in_all_rounds() -> None:
    """Four windows determine little beyond the prior: more rounds do not lead away from it."""
    of_start, stds_px = windows(np.full(8, 3.0), CENTRES[:4], noise_px=2.0), lens_std_px(SIZE, calibrated=False)

    def corners_px(rounds: int) -> np.ndarray:
        measure = partial(residual_under, of_start, IDENTITY)
        mapping, _ = fit_in_rounds(IDENTITY, measure, SIZE, lens_std_px=stds_px, rounds=rounds)
        return geometry.apply(mapping.fixed_to_moving, geometry.corners(*SIZE)) - geometry.corners(*SIZE)

    np.testing.assert_allclose(corners_px(4), corners_px(1), atol=0.1)


def test_unrelated_windows_do_not_verify_a_fit_to_others() -> None:
    rng, medians = np.random.default_rng(0), []
    for _ in range(20):
        shifts_px = rng.normal(0.0, 2.0, CENTRES[::3].shape)
        found = cross_fitted(IDENTITY, lambda _, s=shifts_px: residual_of(CENTRES[::3], s), SIZE, chessboard, 112)
        medians += [] if found is None else [found.held_out.median_px]
    assert len(medians) > 10
    assert min(medians) > 1.5


@pytest.mark.parametrize("lens", [False, True])
def test_wrong_peaks_do_not_bias_the_fit(lens: bool) -> None:
    clean = windows(TRUTH_PX if lens else CORNERS_PX, noise_px=0.03)
    shifts = clean.shifts_px.copy()
    shifts[np.random.default_rng(1).permutation(len(shifts))[:20]] += (6.0, -3.0)
    fit = fitted(residual_of(CENTRES, shifts), lens)
    design = jacobian(EVERYWHERE, SIZE, len(means_px(fit)))
    assert rms(design @ (means_px(fit) - TRUTH_PX[: len(means_px(fit))])) < 0.05
    # With a fifth fewer windows the standard errors are larger.
    assert np.trace(fit.covariance_px2) > np.trace(fitted(clean, lens).covariance_px2)


def test_windows_with_low_peaks_have_little_weight() -> None:
    centres = geometry.lattice(*SIZE, 60, 40)
    shifts, peaks = np.zeros((2400, 2)), np.full(2400, 20.0)
    shifts[::2], peaks[::2] = (0.1, 0.0), 10.0
    # Half the height, a sixteenth of the weight.
    fit = fitted(replace(residual_of(centres, shifts), peaks_sigma=peaks))
    assert fit.corners_px[0::2].mean() == pytest.approx(0.1 / 17, abs=0.002)


def test_the_covariance_equals_the_scatter_of_repeated_fits() -> None:
    fits = [fitted(windows(CORNERS_PX, noise_px=0.1, seed=seed)) for seed in range(200)]
    scatter = np.cov(np.stack([means_px(f) for f in fits]).T)
    expected = np.mean([f.covariance_px2 for f in fits], axis=0) - 0.01**2 * np.eye(8)
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(expected)), rtol=0.25)


def test_the_covariance_of_few_windows_is_not_that_of_their_small_residuals() -> None:
    """Twelve windows have 24 components, of which the eight parameters explain a third."""
    centres_px = geometry.lattice(*SIZE, 4, 3)
    fits = [fitted(windows(np.zeros(8), centres_px, noise_px=0.3, seed=seed)) for seed in range(300)]
    errors, covariances = np.stack([f.corners_px for f in fits]), np.mean([f.covariance_px2 for f in fits], axis=0)
    assert np.sqrt((errors**2).sum(axis=1).mean() / np.trace(covariances)) == pytest.approx(1.0, abs=0.08)


# ---- lens shapes


def test_the_radial_shapes_are_those_of_opencv_and_1_long_at_the_corners() -> None:
    corners = geometry.corners(*SIZE)
    np.testing.assert_allclose(np.linalg.norm(lens_shapes(corners, SIZE)[:, :, :2], axis=1), 1.0)
    focal, centre = 1500.0, (np.array(SIZE) - 1) / 2
    half_diagonal = float(np.linalg.norm(centre))
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    rays = np.column_stack([(EVERYWHERE - centre) / focal, np.ones(len(EVERYWHERE))])
    # k1, k2, p1, p2 that displace a corner by 1 px each
    k = [focal**2 / half_diagonal**3, focal**4 / half_diagonal**5, focal / half_diagonal**2 / 3]
    for shape, coefficients in enumerate([(k[0], 0, 0, 0), (0, k[1], 0, 0), (0, 0, 0, k[2]), (0, 0, k[2], 0)]):
        moved = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera, np.array(coefficients))[0][:, 0]
        np.testing.assert_allclose(moved - EVERYWHERE, lens_shapes(EVERYWHERE, SIZE)[:, :, shape], atol=1e-9)


def test_unmodelled_distortion_grows_with_extrapolation_and_shrinks_with_calibration() -> None:
    prior_px = lens_std_px(SIZE, calibrated=False)
    few = CENTRES[::8]
    whole, half = (unmodelled_std_px(residual_of(c, (0.0, 0.0)), SIZE, prior_px) for c in (few, LEFT[::8]))
    assert 0.02 < whole < 0.15
    assert 0.25 < half < 1.0
    calibrated = unmodelled_std_px(residual_of(LEFT[::8], (0.0, 0.0)), SIZE, CALIBRATED * prior_px)
    assert CALIBRATED * half < calibrated < half
    np.testing.assert_allclose(lens_std_px(SIZE, calibrated=False), 800 * np.array(LENS_STD))


def std_px(fit: WindowFit, points_px: np.ndarray) -> float:
    """RMS error of a fit over points, with the residual of single windows."""
    of_windows_px = shift_scale_px(fit.residuals_px)
    return float(np.hypot(np.sqrt(variance_px2(points_px, fit.covariance_px2, SIZE).mean()), of_windows_px))


def test_windows_in_one_half_determine_the_lens_in_the_other_half_to_the_stated_error() -> None:
    ratios = []
    for seed in range(30):
        fit = fitted(windows(TRUTH_PX, LEFT, seed=seed), lens=True)
        ratios.append(rms(jacobian(RIGHT, SIZE, len(TRUTH_PX)) @ (means_px(fit) - TRUTH_PX)) / std_px(fit, RIGHT))
    # Errors of windows are assumed to be correlated; independent ones have smaller errors.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.0
    assert std_px(fit, LEFT) < 0.15 < std_px(fit, RIGHT)


def test_without_windows_the_prior_remains() -> None:
    unknown = fitted(residual_of(np.empty((0, 2)), (0, 0)), lens=True)
    assert std_px(unknown, EVERYWHERE) > 5
    assert not means_px(unknown).any()


# ---- quarters of the image without a measured window


def test_windows_that_end_near_the_centre_do_not_cover_the_other_half() -> None:
    assert unobserved_quarters(CENTRES, SIZE) == []
    # An eighth of the width beyond the centre is 800 px.
    assert unobserved_quarters(CENTRES[CENTRES[:, 0] < 790], SIZE) == ["top right", "bottom right"]
    assert unobserved_quarters(CENTRES[CENTRES[:, 0] < 900], SIZE) == []
    assert unobserved_quarters(CENTRES[CENTRES[:, 1] > 480], SIZE) == ["top left", "top right"]
    three = CENTRES[(np.array(SIZE) / 2 > CENTRES).any(axis=1)]
    in_fourth = np.array([[1000.0, 800.0], [1100.0, 800.0]])
    assert unobserved_quarters(three, SIZE) == ["bottom right"]
    assert unobserved_quarters(np.vstack([three, in_fourth[:1]]), SIZE) == ["bottom right"]
    assert unobserved_quarters(np.vstack([three, in_fourth]), SIZE) == []


def test_areas_outside_the_moving_image_need_no_window() -> None:
    frame = points_in_frame(PixelMapping(geometry.translation(640, 0)), SIZE, SIZE)
    assert frame[:, 0].max() < 640
    assert unobserved_quarters(LEFT, SIZE, frame) == []
    assert len(points_in_frame(IDENTITY, SIZE, SIZE)) == 24 * 18
