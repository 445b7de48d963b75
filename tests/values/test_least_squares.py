"""Least squares with priors and robust weights."""

import numpy as np
import pytest

from agalign.values.least_squares import (
    MIN_SHIFT_SCALE_PX,
    Robust,
    cauchy_weights,
    least_squares,
    mean_in_standard_errors,
    shift_scale_px,
)

X = np.random.default_rng(0).normal(size=(200, 2, 3))
TRUTH = np.array([1.0, -2.0, 0.5])
NO_PRIOR = np.zeros((3, 3))


def test_observations_and_prior_have_the_weight_of_their_information() -> None:
    """Against the solution of the stacked system by NumPy."""
    values = X @ TRUTH + np.random.default_rng(1).normal(size=(200, 2))
    weights, std, mean = np.linspace(0.1, 2, 200), np.array([0.1, 1.0, 10.0]), np.array([2.0, 0.0, 0.0])
    root = np.sqrt(weights)[:, None]
    stacked = np.vstack([(root[..., None] * X).reshape(-1, 3), np.diag(1 / std)])
    expected = np.linalg.lstsq(stacked, np.r_[(root * values).ravel(), mean / std], rcond=None)[0]
    estimate = least_squares(X, values, weights, np.diag(std**-2), mean)
    np.testing.assert_allclose(estimate.mean, expected, rtol=1e-6)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(stacked.T @ stacked), rtol=1e-6)
    np.testing.assert_allclose(estimate.residuals, np.linalg.norm(values - X @ expected, axis=1), rtol=1e-6)


def test_several_problems_are_solved_together() -> None:
    values = np.stack([X @ TRUTH, X @ (2 * TRUTH)])
    values[1, :50] += 30.0
    weights = np.stack([np.ones(200), np.linspace(1, 2, 200)])
    together = least_squares(X, values, weights, NO_PRIOR, robust=Robust(0.5))
    for number in (0, 1):
        alone = least_squares(X, values[number], weights[number], NO_PRIOR, robust=Robust(0.5))
        np.testing.assert_allclose(together.mean[number], alone.mean, atol=1e-9)
        np.testing.assert_allclose(alone.mean, (number + 1) * TRUTH, atol=0.01)


def test_the_first_weights_decide_between_two_groups() -> None:
    """Most observations are of another solution."""
    values = X @ TRUTH
    values[:120] += X[:120] @ np.array([50.0, 0.0, 0.0])
    starts = TRUTH, (*TRUTH[:1] + 50.0, *TRUTH[1:])
    for start in starts:
        near = cauchy_weights(np.linalg.norm(values - X @ start, axis=1), 0.3)
        estimate = least_squares(X, values, np.ones(200), NO_PRIOR, robust=Robust(0.3), first_weights=near)
        np.testing.assert_allclose(estimate.mean, start, atol=0.05)


def test_the_spread_of_few_values_is_unknown() -> None:
    assert mean_in_standard_errors(np.array([1.0, 1.01, 0.99, 1.0])) == 0.0
    assert mean_in_standard_errors(np.r_[np.full(10, 0.9), np.full(10, 1.1)]) == pytest.approx(
        1 / 0.1 * 19**0.5, rel=1e-6
    )


def test_a_direction_without_observations_is_uncertain() -> None:
    flat = X * [1.0, 1.0, 0.0]
    estimate = least_squares(flat, flat @ TRUTH, np.ones(200), NO_PRIOR)
    np.testing.assert_allclose(estimate.mean, [1.0, -2.0, 0.0], atol=1e-6)
    assert estimate.covariance[2, 2] > 1e6 * estimate.covariance[0, 0]


def test_the_variance_of_the_weights_grows_with_the_residuals() -> None:
    """It makes the covariance that of the scatter, whatever the weights."""
    noise = np.random.default_rng(2).normal(size=(200, 2))
    robust = Robust(4.0, shift_scale_px, lambda scale: scale**2 / 3)
    small, large = (
        least_squares(X, X @ TRUTH + std * noise, np.ones(200), NO_PRIOR, robust=robust).covariance
        for std in (0.2, 2.0)
    )
    np.testing.assert_allclose(large, 100 * small, rtol=1e-3)
    exact = np.linalg.inv(np.einsum("nki,nkj->ij", X, X)) * 0.2**2
    assert np.sqrt(np.diag(small)) == pytest.approx(np.sqrt(np.diag(exact)), rel=0.2)


def test_cauchy_weights_at_known_residuals() -> None:
    weights = cauchy_weights([0.0, 2.0, -2.0, 6.0, np.inf], 2.0)
    np.testing.assert_allclose(weights, [1.0, 0.5, 0.5, 0.1, 0.0])


def test_the_scale_of_shifts_is_at_least_their_noise() -> None:
    assert shift_scale_px(np.array([0.1, 0.2, 9.0])) == 0.2 * 1.4826
    assert shift_scale_px(np.array([0.001, 0.002, 0.003])) == MIN_SHIFT_SCALE_PX
    assert shift_scale_px(np.array([])) == MIN_SHIFT_SCALE_PX
