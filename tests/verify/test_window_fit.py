"""Fits of homographies and lens shapes to windows: accuracy, standard errors, wrong peaks."""

import numpy as np
import pytest

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.mapping import PixelMapping
from agalign.verify.lens_shapes import lens_shapes, lens_std_px, over_corners_and_lens
from agalign.verify.window_fit import WindowFit, fit_windows

SIZE = 1280, 960
CENTRES = np.stack(np.meshgrid(np.arange(56.0, 1280, 112), np.arange(56.0, 960, 112)), -1).reshape(-1, 2)
LEFT = CENTRES[CENTRES[:, 0] < 600]
EVERYWHERE = geometry.lattice(*SIZE, 17, 13)
RIGHT = EVERYWHERE[EVERYWHERE[:, 0] > 640]
CORNERS_PX = np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2, 0.3, -0.4])
TRUTH_PX = np.r_[CORNERS_PX, 1.2, -0.5, 0.8, -0.6]
IDENTITY = PixelMapping(np.eye(3))


def windows(truth_px: np.ndarray, centres_px: np.ndarray = CENTRES, noise_px: float = 0.05, seed: int = 0) -> Residual:
    exact = over_corners_and_lens(centres_px, SIZE)[:, :, : len(truth_px)] @ truth_px
    shifts = exact + np.random.default_rng(seed).normal(0, noise_px, exact.shape)
    return Residual.of(centres_px, shifts, np.full(len(centres_px), 20.0))


def fitted(residual: Residual, lens: bool = False, mapping: PixelMapping = IDENTITY) -> WindowFit:
    fit = fit_windows(mapping, residual, SIZE, lens_std_px(SIZE, calibrated=False) if lens else None)
    assert fit is not None
    return fit


def rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def test_the_windows_correct_the_homography_through_the_displacement_field() -> None:
    """The field stretches the image by 1.2 along x: 1 px of the raw image is 1.2 px for the homography."""
    nodes = np.zeros((22, 28, 2))
    nodes[..., 0] = 0.2 * 48.0 * np.arange(28)
    plain = PixelMapping(geometry.translation(5.0, 3.0))
    stretched = PixelMapping(geometry.translation(5.0, 3.0), local=DisplacementField(48.0, nodes))
    for mapping, expected_px in ((plain, 1.0), (stretched, 1.2)):
        fit = fitted(windows(np.tile([1.0, -0.5], 4), noise_px=0.0), mapping=mapping)
        np.testing.assert_allclose(fit.mean_px, np.tile([expected_px, -0.5], 4), atol=0.01)
        corrected = fit.applied_to(mapping)
        assert corrected.local is mapping.local
        moved = geometry.apply(corrected.fixed_to_moving, [300.0, 200.0])
        np.testing.assert_allclose(moved, [305.0 + expected_px, 202.5], atol=0.02)


def test_exact_shifts_are_fitted_exactly_and_the_common_error_remains() -> None:
    fit = fitted(windows(CORNERS_PX, geometry.lattice(*SIZE, 60, 40), noise_px=0.0))
    np.testing.assert_allclose(fit.mean_px, CORNERS_PX, atol=1e-6)
    std_px = np.sqrt(np.diag(fit.covariance_px2))
    assert 0.01 <= std_px.min() <= std_px.max() < 0.015


def test_eight_parameters_without_a_prior_need_twelve_windows() -> None:
    assert fit_windows(IDENTITY, windows(CORNERS_PX, CENTRES[::8][:11]), SIZE) is None
    assert fit_windows(IDENTITY, windows(CORNERS_PX, CENTRES[::8][:12]), SIZE) is not None


def test_windows_on_a_line_leave_corners_unknown() -> None:
    fit = fitted(windows(CORNERS_PX, CENTRES[:12]))
    assert np.sqrt(np.diag(fit.covariance_px2)).max() > 100


@pytest.mark.parametrize("lens", [False, True])
def test_wrong_peaks_do_not_bias_the_fit(lens: bool) -> None:
    clean = windows(TRUTH_PX if lens else CORNERS_PX, noise_px=0.03)
    shifts = clean.shifts_px.copy()
    shifts[np.random.default_rng(1).permutation(len(shifts))[:20]] += (6.0, -3.0)
    fit = fitted(Residual.of(CENTRES, shifts, clean.peaks_sigma), lens)
    jacobian = over_corners_and_lens(EVERYWHERE, SIZE)[:, :, : len(fit.mean_px)]
    assert rms(jacobian @ (fit.mean_px - TRUTH_PX[: len(fit.mean_px)])) < 0.05
    # With a fifth fewer windows the standard errors are larger.
    assert np.trace(fit.covariance_px2) > np.trace(fitted(clean, lens).covariance_px2)


def test_windows_with_low_peaks_have_little_weight() -> None:
    centres = geometry.lattice(*SIZE, 60, 40)
    shifts, peaks = np.zeros((2400, 2)), np.full(2400, 20.0)
    shifts[::2], peaks[::2] = (0.1, 0.0), 10.0
    # Half the height, a sixteenth of the weight.
    np.testing.assert_allclose(fitted(Residual.of(centres, shifts, peaks)).mean_px[0::2].mean(), 0.1 / 17, atol=0.002)


def test_the_covariance_equals_the_scatter_of_repeated_fits() -> None:
    fits = [fitted(windows(CORNERS_PX, noise_px=0.1, seed=seed)) for seed in range(200)]
    scatter = np.cov(np.stack([f.mean_px for f in fits]).T)
    expected = np.mean([f.covariance_px2 for f in fits], axis=0) - 0.01**2 * np.eye(8)
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(expected)), rtol=0.25)


def test_windows_in_one_half_determine_the_lens_in_the_other_half_to_the_stated_error() -> None:
    ratios = []
    for seed in range(30):
        fit = fitted(windows(TRUTH_PX, LEFT, seed=seed), lens=True)
        ratios.append(rms(over_corners_and_lens(RIGHT, SIZE) @ (fit.mean_px - TRUTH_PX)) / fit.std_px(RIGHT))
    # Errors of windows are assumed to be correlated; independent ones have smaller errors.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.0
    assert fit.std_px(LEFT) < 0.15 < fit.std_px(RIGHT)


def test_more_windows_leave_less_error_and_none_leave_the_prior() -> None:
    few, many = (fitted(windows(TRUTH_PX, c), lens=True) for c in (LEFT[LEFT[:, 0] < 300], CENTRES))
    assert many.std_px(EVERYWHERE) < 0.2 < few.std_px(EVERYWHERE) < 5
    unknown = fitted(Residual.of(np.empty((0, 2)), np.empty((0, 2)), np.empty(0)), lens=True)
    assert unknown.std_px(EVERYWHERE) > 5
    assert not unknown.mean_px.any()


def test_the_lens_shapes_become_the_displacement_field() -> None:
    fit = fitted(windows(TRUTH_PX, noise_px=0.01), lens=True)
    mapping, inside = fit.applied_to(IDENTITY), EVERYWHERE[(EVERYWHERE > 50).all(axis=1)]
    assert mapping.local is not None
    np.testing.assert_allclose(mapping.local(inside), lens_shapes(inside, SIZE) @ fit.mean_px[8:], atol=0.02)
