"""Factors of a capture, estimated from exactly known mappings."""

import numpy as np
import pytest

from agalign.flight.factors import (
    FACTOR_STD_PX,
    affine_difference,
    design_tensor,
    displaced,
    distance_px,
    least_squares,
    median_mapping,
)
from agalign.values import geometry

SIZE = 640, 480
LENSES = np.array([[0.6, 0.0, 0.2], [0.0, 0.7, -0.5], [-0.3, 0.2, 0.8]])
DESIGNS = np.tensordot(LENSES, design_tensor(("distance", "tilt", "motion")), 1)
DISTANCE = np.tensordot(LENSES, design_tensor(("distance",)), 1)


def test_the_model_shifts_a_band_along_its_baseline_and_by_its_delay() -> None:
    tensor = design_tensor(("distance", "tilt", "motion"))
    change = np.tensordot([0.6, -0.8, 0.5], tensor, 1) @ np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_allclose(change, [[0.6 + 0.5 * 4, 1.2, 1.8], [-0.8 + 0.5 * 5, -1.6, -2.4]])


def test_a_displaced_mapping_differs_by_its_coefficients() -> None:
    mean = geometry.normalised([[1.01, 0.02, 5.0], [-0.01, 0.99, -3.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([[2.0, 0.3, -0.1], [-1.0, 0.2, 0.4]])
    moved = displaced(mean, coefficients, SIZE)
    np.testing.assert_allclose(affine_difference(mean, moved, SIZE), coefficients, atol=1e-5)
    # The columns of g are orthonormal, so the norm is the RMS distance.
    assert distance_px(mean, moved, SIZE) == pytest.approx(np.linalg.norm(coefficients), rel=1e-6)
    assert distance_px(mean, mean, SIZE) == 0


def test_the_median_mapping_ignores_an_outlier() -> None:
    matrices = [geometry.translation(x, 2.0) for x in (3.0, 3.1, 90.0)]
    assert distance_px(median_mapping(matrices, SIZE), matrices[0], SIZE) < 0.2
    assert median_mapping(matrices[2:], SIZE) is matrices[2]


def test_factors_are_recovered_from_all_bands() -> None:
    factors = np.array([[3.0, 0.5, -0.4, 2.0, -1.0], [-6.0, 0.0, 0.2, 0.0, 0.5]])
    differences = np.einsum("bakf,cf->cbak", DESIGNS, factors)
    weights = np.full((2, 3), 1 / 0.01**2)
    result, covariance = least_squares(DESIGNS, differences, weights)
    np.testing.assert_allclose(result, factors, atol=2e-3)
    x = DESIGNS.reshape(3, 6, 5)
    normal = 1 / 0.01**2 * np.einsum("bif,big->fg", x, x) + np.diag(1 / np.square(FACTOR_STD_PX))
    np.testing.assert_allclose(covariance[0], np.linalg.inv(normal), rtol=1e-3)


def test_unused_factors_are_0_and_an_outlier_band_hardly_changes_the_others() -> None:
    differences = np.einsum("bakf,cf->cbak", DESIGNS, np.array([[3.0, 0, 0, 0, 0]]))
    result, _ = least_squares(DISTANCE, differences, np.full((1, 3), 1e4))
    assert result[0, 0] == pytest.approx(3.0, abs=1e-3)
    assert not result[0, 1:].any()
    # One band is an outlier.
    differences[0, 2, :, 0] += 5.0
    result, _ = least_squares(DISTANCE, differences, np.full((1, 3), 1e3))
    assert result[0, 0] == pytest.approx(3.0, abs=0.1)
    result, _ = least_squares(DISTANCE, differences, np.full((1, 3), 1e3), robust=False)
    assert abs(result[0, 0] - 3.0) > 0.5
