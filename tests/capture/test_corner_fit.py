"""Corner corrections from the residual of windows."""

import numpy as np

from agalign.capture.corner_fit import corner_correction, fit_corners
from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.mapping import PixelMapping

SIZE = 640, 480


def residual(shift_px: tuple[float, float], columns: int = 8, rows: int = 6) -> Residual:
    centres = geometry.lattice(*SIZE, columns, rows) * 0.8 + np.array(SIZE) * 0.1
    return Residual.of(centres, np.tile(shift_px, (len(centres), 1)), np.full(len(centres), 20.0))


def test_the_windows_correct_the_homography_through_the_displacement_field() -> None:
    """The field stretches the image by 1.2 along x: 1 px of the raw image is 1.2 px for the homography."""
    nodes = np.zeros((12, 15, 2))
    nodes[..., 0] = 0.2 * 48.0 * np.arange(15)
    plain = PixelMapping(geometry.translation(5.0, 3.0))
    stretched = PixelMapping(geometry.translation(5.0, 3.0), local=DisplacementField(48.0, nodes))
    for mapping, expected_px in ((plain, 1.0), (stretched, 1.2)):
        fit = corner_correction(mapping, residual((1.0, -0.5)), SIZE)
        assert fit is not None
        np.testing.assert_allclose(fit.mean_px, np.tile([expected_px, -0.5], 4), atol=0.01)
        corrected = fit.applied_to(mapping.fixed_to_moving, SIZE)
        np.testing.assert_allclose(geometry.apply(corrected, [300.0, 200.0]), [305.0 + expected_px, 202.5], atol=0.02)


def test_the_common_error_of_windows_is_part_of_the_uncertainty() -> None:
    fit = corner_correction(PixelMapping(np.eye(3)), residual((0.3, 0.0), 60, 40), SIZE)
    assert fit is not None
    std_px = np.sqrt(np.diag(fit.covariance_px2))
    assert 0.01 <= std_px.min() <= std_px.max() < 0.015


def test_too_few_windows_correct_nothing() -> None:
    assert corner_correction(PixelMapping(np.eye(3)), residual((1.0, 0.0), 5, 3), SIZE) is None
    assert corner_correction(PixelMapping(np.eye(3)), residual((1.0, 0.0), 4, 4), SIZE) is not None


def test_windows_with_a_wrong_peak_do_not_bias_the_corners() -> None:
    some = residual((0.4, -0.2))
    shifts = some.shifts_px + np.random.default_rng(0).normal(0, 0.03, some.shifts_px.shape)
    clean = fit_corners(some.centres_px, shifts, some.peaks_sigma, SIZE)
    wrong = shifts.copy()
    wrong[np.random.default_rng(1).permutation(48)[:10]] += (6.0, -3.0)
    fit = fit_corners(some.centres_px, wrong, some.peaks_sigma, SIZE)
    np.testing.assert_allclose(fit.mean_px, np.tile([0.4, -0.2], 4), atol=0.08)
    np.testing.assert_allclose(clean.mean_px, np.tile([0.4, -0.2], 4), atol=0.05)
    # With a fifth fewer windows the standard errors are larger.
    assert np.trace(fit.covariance_px2) > np.trace(clean.covariance_px2)


def test_windows_with_low_peaks_have_little_weight() -> None:
    some = residual((0.0, 0.0), 16, 12)
    shifts, peaks = some.shifts_px.copy(), some.peaks_sigma.copy()
    low = np.random.default_rng(2).permutation(192)[:96]
    shifts[low] = (0.1, 0.0)
    peaks[low] = 10.0
    fit = fit_corners(some.centres_px, shifts, peaks, SIZE)
    # Half the height, a sixteenth of the weight.
    np.testing.assert_allclose(fit.mean_px[0::2].mean(), 0.1 / 17, atol=0.002)


def test_the_covariance_equals_the_scatter_of_repeated_fits() -> None:
    rng = np.random.default_rng(3)
    some = residual((0.0, 0.0), 16, 12)
    fits = [fit_corners(some.centres_px, rng.normal(0, 0.1, (192, 2)), some.peaks_sigma, SIZE) for _ in range(200)]
    scatter = np.cov(np.stack([f.mean_px for f in fits]).T)
    expected = np.mean([f.covariance_px2 for f in fits], axis=0) - 0.01**2 * np.eye(8)
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(expected)), rtol=0.25)
