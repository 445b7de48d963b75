"""Lens shapes: their size, their estimation from a part of the image, and the error elsewhere."""

import cv2
import numpy as np
import pytest

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.mapping import PixelMapping
from agalign.verify.lens_shapes import (
    CALIBRATED,
    LENS_STD,
    fit_with_lens,
    lens_shapes,
    lens_std_px,
    over_corners_and_lens,
    unmodelled_std_px,
)

SIZE = 1280, 960
CENTRES = np.stack(np.meshgrid(np.arange(56.0, 1280, 112), np.arange(56.0, 960, 112)), -1).reshape(-1, 2)
LEFT = CENTRES[CENTRES[:, 0] < 600]
EVERYWHERE = geometry.lattice(*SIZE, 17, 13)
RIGHT = EVERYWHERE[EVERYWHERE[:, 0] > 640]
TRUTH_PX = np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2, 0.3, -0.4, 1.2, -0.5, 0.8, -0.6])
IDENTITY = PixelMapping(np.eye(3))


def windows(truth_px: np.ndarray, centres_px: np.ndarray, noise_px: float, seed: int = 0) -> Residual:
    exact = over_corners_and_lens(centres_px, SIZE) @ truth_px
    shifts = exact + np.random.default_rng(seed).normal(0, noise_px, exact.shape)
    return Residual.of(centres_px, shifts, np.full(len(centres_px), 20.0))


def rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


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


def test_windows_in_one_half_determine_the_other_half_to_the_stated_error() -> None:
    ratios = []
    for seed in range(30):
        fit = fit_with_lens(IDENTITY, windows(TRUTH_PX, LEFT, 0.05, seed), SIZE, calibrated=False)
        error = over_corners_and_lens(RIGHT, SIZE) @ (fit.mean_px - TRUTH_PX)
        ratios.append(rms(error) / fit.std_px(RIGHT))
    # Errors of windows are assumed to be correlated; independent ones have smaller errors.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.0
    assert fit.std_px(LEFT) < 0.15 < fit.std_px(RIGHT)


def test_more_windows_leave_less_error_and_none_leave_the_prior() -> None:
    nothing = Residual.of(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    few, many = (
        fit_with_lens(IDENTITY, windows(TRUTH_PX, c, 0.05), SIZE, calibrated=False).std_px(EVERYWHERE)
        for c in (LEFT[LEFT[:, 0] < 300], CENTRES)
    )
    assert many < 0.2 < few < 5
    unknown = fit_with_lens(IDENTITY, nothing, SIZE, calibrated=False)
    assert unknown.std_px(EVERYWHERE) > 5
    assert not unknown.mean_px.any()


def test_wrong_peaks_do_not_move_the_fit() -> None:
    clean = windows(TRUTH_PX, CENTRES, 0.02)
    shifts = clean.shifts_px.copy()
    shifts[::9] += 20
    fit = fit_with_lens(IDENTITY, Residual.of(CENTRES, shifts, clean.peaks_sigma), SIZE, calibrated=False)
    assert rms(over_corners_and_lens(EVERYWHERE, SIZE) @ (fit.mean_px - TRUTH_PX)) < 0.1


def test_the_field_is_the_displacement_of_the_shapes() -> None:
    fit = fit_with_lens(IDENTITY, windows(TRUTH_PX, CENTRES, 0.01), SIZE, calibrated=False)
    inside = EVERYWHERE[(EVERYWHERE > 50).all(axis=1)]
    np.testing.assert_allclose(fit.field()(inside), lens_shapes(inside, SIZE) @ fit.mean_px[8:], atol=0.02)


def test_unmodelled_distortion_grows_with_extrapolation_and_shrinks_with_calibration() -> None:
    whole, half = (unmodelled_std_px(c, SIZE, calibrated=False) for c in (CENTRES, LEFT))
    assert 0.1 < whole < 0.25
    assert 0.5 < half < 1.0
    assert unmodelled_std_px(LEFT, SIZE, calibrated=True) == pytest.approx(CALIBRATED * half)
    np.testing.assert_allclose(lens_std_px(SIZE, calibrated=False), 800 * np.array(LENS_STD))
