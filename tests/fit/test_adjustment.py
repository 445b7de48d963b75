"""Homographies, lens fields, baselines and parallax, recovered from synthetic shifts of windows."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.fit.adjustment import Adjustment, WindowShifts, adjust, are_of_lenses, parallax_of
from agalign.fit.window_fit import BaselinePrior, fit_windows
from agalign.synthetic import cameras
from agalign.values import geometry
from agalign.values.lens_shapes import lens_std_px
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief

from ..builders import grid_px, residual_of

SIZE = 640, 480
BASELINES = np.array([[-0.8, 0.0], [0.0, -0.6], [-0.8, -0.6], [-0.4, -0.3]])
"""The longest has length 1; points move opposite to the positions of the lenses."""
POINTS = grid_px(np.arange(24, 640, 24), np.arange(24, 480, 24))
HEIGHTS = np.zeros(len(POINTS))
"""Parallax (n,) of the windows: most on the ground, some on a bench, on boxes and below the ground."""
HEIGHTS[(POINTS[:, 0] > 250) & (POINTS[:, 0] < 400)] = 4
HEIGHTS[(POINTS[:, 0] > 300) & (POINTS[:, 0] < 370) & (POINTS[:, 1] > 200) & (POINTS[:, 1] < 330)] = 11
HEIGHTS[POINTS[:, 1] > 430] = -3
CORNERS_PX = np.random.default_rng(1).normal(0, 1.5, (len(BASELINES), 8))
PLANES = np.einsum("nki,bi->nbk", geometry.over_corners(POINTS, *SIZE), CORNERS_PX)
"""Shifts (n, bands, 2) of the windows by errors of the homographies."""


def shifts(wrong: float = 0.2, missing: float = 0.0) -> WindowShifts:
    """Shifts of all windows in all bands, with wrong peaks of up to 20 px."""
    rng = np.random.default_rng(0)
    result = PLANES + HEIGHTS[:, None, None] * BASELINES
    result += rng.normal(0, 0.06, result.shape)
    off = rng.random(result.shape[:2]) < wrong
    result[off] = rng.uniform(-20, 20, (off.sum(), 2))
    gone = rng.random(result.shape[:2]) < missing
    result[gone] = np.nan
    return WindowShifts(POINTS, POINTS, result, np.where(gone, 0.0, 1.0))


def by_corners(model: Adjustment, points_px: np.ndarray) -> np.ndarray:
    """Return (n, bands, 2) the shifts by the corrections of the homographies."""
    return np.stack([geometry.over_corners(points_px, *SIZE) @ fit.corners_px for fit in model.fits], axis=1)


def assert_recovered(model: Adjustment | None, sign: int = 1) -> None:
    np.testing.assert_allclose(model.baselines, sign * BASELINES, atol=0.02)
    assert np.percentile(np.abs(model.parallax_px - sign * HEIGHTS), 75) < 0.15
    assert np.abs(by_corners(model, POINTS) - PLANES).max() < 0.15


@pytest.mark.parametrize(("unit", "missing"), [(0.001, 0.0), (40.0, 0.0), (1.0, 0.3)])
def test_the_model_is_recovered_despite_noise_wrong_peaks_and_missing_windows(unit: float, missing: float) -> None:
    """Whatever the unit of the layout."""
    windows = shifts(missing=missing)
    model = adjust(windows, SIZE, BASELINES * unit)
    assert_recovered(model)
    residuals_px = np.stack([fit.residuals_px for fit in model.fits], axis=1)
    np.testing.assert_array_equal(np.isfinite(residuals_px), windows.weights > 0)
    assert np.nanmedian(residuals_px) < 0.15
    assert 0.1 < (residuals_px > 2).mean() < 0.25


@pytest.mark.parametrize("layout", [BASELINES, None])
def test_an_unrelated_band_does_not_bias_the_others(layout: np.ndarray | None) -> None:
    windows = shifts(wrong=0.0)
    windows.shifts_px[:, 0] = np.random.default_rng(2).uniform(-20, 20, (len(POINTS), 2))
    model = adjust(windows, SIZE, layout)
    others = model.baselines[1:] / np.linalg.norm(model.baselines[1:], axis=1).max()
    wanted = BASELINES[1:] * np.sign(np.sum(others * BASELINES[1:]))
    np.testing.assert_allclose(others, wanted / np.linalg.norm(wanted, axis=1).max(), atol=0.03)


def test_priors_do_not_depend_on_the_noise_of_a_band() -> None:
    """A noisy band has little influence on the parallax, but its own homography must not be damped."""
    few = POINTS[::6]
    rng = np.random.default_rng(0)
    shift = HEIGHTS[::6, None, None] * BASELINES + rng.normal(0, 0.02, (len(few), 4, 2))
    shift[:, 1] += rng.normal((20, -20), 1.5, (len(few), 2))
    model = adjust(WindowShifts(few, few, shift, np.ones((len(few), 4))), SIZE, BASELINES)
    error_px = by_corners(model, few)[:, 1] - [20, -20]
    assert np.abs(error_px.mean(axis=0)).max() < 0.5


def test_a_corner_without_windows_is_uncertain() -> None:
    """The smaller the part of the image with windows, as in the fit of a single band."""
    worst_px = []
    for share in (1.0, 0.12):
        some = np.array([320, 240]) + share * (POINTS - [320, 240])
        shift = HEIGHTS[:, None, None] * BASELINES + np.random.default_rng(0).normal(0, 0.03, (len(some), 4, 2))
        model = adjust(WindowShifts(some, some, shift, np.ones(shift.shape[:2])), SIZE, BASELINES)
        worst_px.append(max(np.sqrt(np.diag(fit.covariance_px2)).max() for fit in model.fits))
    assert worst_px[0] < 0.1
    assert worst_px[1] > 0.5


def test_the_layout_determines_only_the_sign() -> None:
    rough = BASELINES + np.random.default_rng(5).normal(0, 0.15, BASELINES.shape)
    assert_recovered(adjust(shifts(), SIZE, rough))
    assert_recovered(adjust(shifts(), SIZE, -BASELINES), sign=-1)


@pytest.mark.parametrize("sign", [1, -1])
def test_without_a_layout_most_objects_are_nearer_than_the_plane(sign: int) -> None:
    """Not by the sign of a singular vector, which is that of the linear algebra library."""
    model = adjust(replace(shifts(), shifts_px=PLANES + sign * HEIGHTS[:, None, None] * BASELINES), SIZE)
    np.testing.assert_allclose(model.baselines, sign * BASELINES, atol=0.02)
    assert np.percentile(np.abs(model.parallax_px - HEIGHTS), 75) < 0.15


def test_the_error_of_a_baseline_is_that_of_repeated_fits() -> None:
    """Of a band that is fitted alone under a relief, and of all bands together."""
    of_windows = HEIGHTS.reshape(-1, len(np.unique(POINTS[:, 0]))).astype(np.float32)
    row, column = (
        ((at - 12) // 24).clip(0, n - 1) for at, n in zip(np.indices(SIZE[::-1]), of_windows.shape, strict=True)
    )
    relief = Relief(of_windows[row, column], np.ones(SIZE[::-1], np.float32))
    under = PixelMapping(np.eye(3)).with_parallax(Parallax(relief, tuple(BASELINES[3])))
    baselines, stds = [], []
    for seed in range(60):
        noise_px = np.random.default_rng(seed).normal(0, 0.3, (len(POINTS), 4, 2))
        together = adjust(replace(shifts(), shifts_px=HEIGHTS[:, None, None] * BASELINES + noise_px), SIZE, BASELINES)
        alone = fit_windows(under, residual_of(POINTS, noise_px[:, 3]), SIZE, baseline=BaselinePrior())
        fits = [alone, together.fits[3]]
        baselines.append([fit.baseline for fit in fits])
        stds.append([fit.baseline_std for fit in fits])
    rms = np.sqrt(np.var(baselines, axis=0).sum(axis=1))
    np.testing.assert_allclose(np.mean(stds, axis=0), rms, rtol=0.3)


def lens_fields() -> np.ndarray:
    """(n, bands, 2) differences of radial distortion, up to 1 px at the corners of the image."""
    u = 2 * POINTS / np.array(SIZE) - 1
    radial = u * (u**2).sum(axis=1, keepdims=True)
    radial /= np.linalg.norm(radial, axis=1).max()
    return radial[:, None, :] * np.array([1.0, -1.0, 0.5, -0.5])[:, None]


def test_lens_fields_are_recovered_next_to_parallax() -> None:
    """Homography and lens shapes are compared as a sum, because they are not orthogonal."""
    windows = shifts(wrong=0.05)
    windows = replace(windows, shifts_px=windows.shifts_px + lens_fields())
    model = adjust(windows, SIZE, BASELINES, 3 * lens_std_px(SIZE, calibrated=False))
    np.testing.assert_allclose(model.baselines, BASELINES, atol=0.02)
    assert np.percentile(np.abs(model.parallax_px - HEIGHTS), 90) < 0.15
    left = by_corners(model, POINTS) - PLANES - lens_fields()
    for band, fit in enumerate(model.fits):
        field = fit.applied_to(PixelMapping(np.eye(3))).field
        error_px = np.linalg.norm(left[:, band] + field(POINTS), axis=1)
        assert np.percentile(error_px, 95) < 0.25
        assert np.median(error_px) < 0.08
    without = adjust(windows, SIZE, BASELINES)
    assert all(fit.lens_px is None for fit in without.fits)
    assert np.all(without.scales_px > 1.05 * model.scales_px)


def test_too_few_windows_give_no_model() -> None:
    windows = shifts()
    few = WindowShifts(POINTS[:7], POINTS[:7], windows.shifts_px[:7], windows.weights[:7])
    assert adjust(few, SIZE) is None
    # Eight windows suffice if they are measured in all bands.
    nothing = replace(windows, weights=np.where(np.arange(4) == 2, 0.0, windows.weights))
    assert adjust(nothing, SIZE) is None
    assert adjust(windows, SIZE, np.zeros((4, 2))) is None


def test_parallax_is_the_projection_onto_the_baselines() -> None:
    baselines, weights = np.array([[1.0, 0.0], [0.0, 0.5]]), np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    shift = np.array([[[3.0, 9.0], [9.0, 1.5]]] * 4)
    shift[1, 1] = shift[2, 0] = shift[3] = np.nan
    np.testing.assert_allclose(parallax_of(shift, baselines, weights), [3, 3, 3, 0], rtol=0.05)
    np.testing.assert_allclose(parallax_of(shift[:2], baselines, weights[:2]), [3, 3], rtol=0.02)


# ---- windows of several bands


def test_windows_are_matched_by_their_cells() -> None:
    at = np.array([[10.0, 20.0], [30.0, 20.0], [50.0, 20.0]])
    one = residual_of(at, np.array([[1.0, 0], [2, 0], [np.nan, np.nan]]))
    other = residual_of(at[[2, 1, 0]], np.array([[3.0, 0], [0, 0], [4, 0]]), sigma=60.0).where(np.array([1, 0, 1]) > 0)
    plain = PixelMapping(np.eye(3))
    windows = WindowShifts.of([one, other], [plain, plain])
    np.testing.assert_array_equal(windows.centres_px, at)
    np.testing.assert_array_equal(windows.shifts_px[..., 0], [[1, 4], [2, np.nan], [np.nan, 3]])
    # Weights grow with the peak height up to a limit; windows without a measurement have weight 0.
    np.testing.assert_allclose(windows.weights, [[0.0625, 4], [0.0625, 0], [0, 4]])
    assert WindowShifts.of([residual_of(at, (np.nan, np.nan))], [plain]).weights.tolist() == [[0.0]] * 3
    assert len(WindowShifts.of([residual_of(at[:0], at[:0])], [plain])) == 0


def test_shifts_are_those_of_undistorted_pixels() -> None:
    """A shift near a corner of a distorted image, measured with a relief."""
    lens = cameras.BANDS[1].lens(*SIZE)
    relief = Relief(np.full(SIZE[::-1], 5.0, np.float32), np.ones(SIZE[::-1], np.float32))
    mapping = PixelMapping(np.eye(3), lens, None, parallax=Parallax(relief, (0.6, -0.8)))
    centre, shift = np.array([[40.0, 30.0]]), np.array([[3.0, 2.0]])
    windows = WindowShifts.of([residual_of(centre, shift)], [mapping])
    plane = mapping.without_parallax
    np.testing.assert_allclose(windows.points_px, plane.undistorted(centre))
    expected = plane.undistorted(centre + shift) - plane.undistorted(centre)
    # The shift relative to the plane includes the displacement by the relief.
    np.testing.assert_allclose(windows.shifts_px[:, 0], expected + np.array([[3, -4]]), atol=1e-6)
    assert np.abs(expected - shift).max() > 0.05


@pytest.mark.parametrize("layout", [None, BASELINES])
@pytest.mark.parametrize("bands", [[0, 1], [0, 2], [0, 1, 2], [0, 1, 2, 3]])
@pytest.mark.parametrize("noise_px", [(0.3, 1.0), (1.0, 0.3)])
def test_noise_of_the_reference_is_not_parallax(
    layout: np.ndarray | None, bands: list[int], noise_px: tuple[float, float]
) -> None:
    """It shifts the windows of all bands equally, mostly in the direction with little texture."""
    rng = np.random.default_rng(2)
    of_reference = rng.normal(0, noise_px, (len(POINTS), 1, 2))
    noise = of_reference + rng.normal(0, 0.2, (len(POINTS), len(BASELINES), 2))
    for shifts_px, is_depth in ((noise, False), (shifts().shifts_px, True)):
        windows = WindowShifts(POINTS, POINTS, shifts_px[:, bands], np.ones((len(POINTS), len(bands))))
        known = None if layout is None else layout[bands]
        assert are_of_lenses(adjust(windows, SIZE, known).baselines, known) == is_depth
