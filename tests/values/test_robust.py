import numpy as np

from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px


def test_cauchy_weights_at_known_residuals() -> None:
    weights = cauchy_weights([0.0, 2.0, -2.0, 6.0, np.inf], 2.0)
    np.testing.assert_allclose(weights, [1.0, 0.5, 0.5, 0.1, 0.0])


def test_cauchy_weights_minimise_the_influence_of_an_outlier() -> None:
    """Reweighting finds the mean of the inliers, as the M-estimator with the Cauchy loss does."""
    values = np.array([0.9, 1.0, 1.1, 100.0])
    mean = np.median(values)
    for _ in range(20):
        mean = np.average(values, weights=cauchy_weights(values - mean, 0.2))
    assert abs(mean - 1.0) < 1e-3


def test_cauchy_weights_keep_the_shape_and_accept_a_scale_for_each_residual() -> None:
    weights = cauchy_weights(np.ones((2, 3)), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(weights, [[0.5, 0.8, 0.9]] * 2)


def test_the_scale_of_shifts_is_at_least_their_noise() -> None:
    assert shift_scale_px(np.array([0.1, 0.2, 9.0])) == 0.2 * 1.4826
    assert shift_scale_px(np.array([0.001, 0.002, 0.003])) == MIN_SHIFT_SCALE_PX
    assert shift_scale_px(np.array([])) == MIN_SHIFT_SCALE_PX
