"""Expected errors near windows and far from them, of predictions and of seeds."""

from dataclasses import replace

import numpy as np

from agalign.values.alignment import Alignment, JointResult, Prediction, Residual, Seed
from agalign.values.mapping import PixelMapping
from agalign.verify.expected_error import expected_error_px

SIZE = 640, 480
LEFT, RIGHT = np.array([[60.0, 240.0]]), np.array([[620.0, 240.0]])


def alignment(corner_std_px: list[float], residual: Residual | None) -> Alignment:
    std = np.repeat(corner_std_px, 2)
    joint = JointResult(
        np.eye(3), 0.1, 0.9, 0.004, 0, (1.0,), "fast", "homography", 0.01, ((0.1, 0.1),) * 4, np.diag(std**2)
    )
    return Alignment(PixelMapping(np.eye(3)), SIZE, "aligned", (), Seed("identity", np.eye(3), 1.0), joint, residual)


def windows(columns: int, shift_px: float) -> Residual:
    centres = np.stack(np.meshgrid(50.0 + 100 * np.arange(columns), 50.0 + 100 * np.arange(4)), -1).reshape(-1, 2)
    shifts = np.full_like(centres, 0.0)
    shifts[:, 0] = shift_px
    return Residual(centres, shifts, shift_px, 2.0, 1.0)


def test_the_expected_error_at_the_corners_is_their_covariance() -> None:
    result = expected_error_px(alignment([0.1, 0.5, 0.5, 0.1], None), SIZE, np.array([[0.0, 0.0], [639.0, 0.0]]))
    np.testing.assert_allclose(result, np.sqrt(2) * np.array([0.1, 0.5]), rtol=1e-6)


def test_the_error_near_windows_is_their_residual_and_far_from_them_p95() -> None:
    known = alignment([0.01] * 4, windows(3, 0.3))
    assert 0.25 < expected_error_px(known, SIZE, LEFT)[0] < 0.35
    assert 1.9 < expected_error_px(known, SIZE, RIGHT)[0] < 2.1
    everywhere = alignment([0.01] * 4, windows(7, 0.3))
    assert 0.25 < expected_error_px(everywhere, SIZE, RIGHT)[0] < 0.35


def test_predictions_have_their_standard_error_and_seeds_none() -> None:
    known = alignment([0.01] * 4, None)
    predicted = replace(known, status="predicted", prediction=Prediction(np.eye(3), "bands", 0.4))
    np.testing.assert_allclose(expected_error_px(predicted, SIZE, LEFT), 0.4)
    # The standard error of a thermal band is in its own pixels, which are ten times as large.
    thermal = replace(predicted, mapping=PixelMapping(np.diag([0.1, 0.1, 1.0])))
    np.testing.assert_allclose(expected_error_px(thermal, SIZE, LEFT), 4.0)
    assert np.isinf(expected_error_px(replace(known, status="seed_only"), SIZE, LEFT)).all()
