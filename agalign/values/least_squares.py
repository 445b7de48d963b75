"""Linear least squares with Gaussian priors and robust weights: the solver of the dense fits of the geometry.

    min over m of  sum_i w_i rho(|y_i - X_i m|) + (m - m_0)^T P (m - m_0)

y_i are observations of k components with weight w_i, such as the shift of a window (k = 2), and X_i their derivatives
with respect to the parameters m. The prior of m has the mean m_0 and the information P. Robust estimates are computed
by iteratively reweighted least squares with Cauchy weights (Holland & Welsch 1977).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MIN_SHIFT_SCALE_PX = 0.05
"""Noise of the measured shift of a window: the minimum residual scale of a fit to shifts."""


class Estimate(NamedTuple):
    """The solution of n observations with p parameters, or of several such problems (…)."""

    mean: Array
    """(…, p)"""
    covariance: Array
    """(…, p, p) for weights that are inverse variances along each component."""
    residuals: Array
    """(…, n) lengths of the residuals."""


class Robust(NamedTuple):
    """The law of the robust weights."""

    half_weight: float
    """Residual at which the weight is one half, in scales of the residuals."""
    scale: Callable[[Array], float] = lambda _: 1.0
    """Returns the scale of lengths of residuals (n,)."""
    variance: Callable[[float], float] = lambda _: 1.0
    """Returns the variance along a component of an observation of weight 1 from that scale; 1 if the weights are
    inverse variances, or relative to the prior."""
    iterations: int = 12
    """Enough for the weights to converge where up to 40 % of the observations are outliers."""


def least_squares(
    design: Array,
    values: Array,
    weights: Array,
    information: Array,
    mean: ArrayLike = 0.0,
    *,
    robust: Robust | None = None,
    first_weights: Array | None = None,
) -> Estimate:
    """Solve a problem, or several that have the leading dimensions (…).

    `design` (…, n, k, p), `values` (…, n, k), `weights` (…, n), and `information` (p, p) and `mean` (p,) of the prior.
    Without `robust` the weights are used as they are. The first iteration has the weights `first_weights` (…, n), by
    default `weights`. Directions that nothing determines have a large variance.
    """
    rows = design.reshape(*design.shape[:-3], -1, design.shape[-1])
    flat = values.reshape(*values.shape[:-2], -1)
    of_prior = (information @ np.broadcast_to(mean, (*values.shape[:-2], len(information)))[..., None])[..., 0]
    weighted = weights if first_weights is None else first_weights
    scale, min_information_share = MIN_SHIFT_SCALE_PX, 1e-12
    for _ in range(1 if robust is None else robust.iterations):
        variance = 1.0 if robust is None else robust.variance(scale)
        of_rows = np.repeat(weighted / variance, design.shape[-2], axis=-1)[..., None] * rows
        normal = of_rows.swapaxes(-1, -2) @ rows + information
        floor = min_information_share * np.trace(normal, axis1=-2, axis2=-1)
        covariance = np.linalg.inv(normal + floor[..., None, None] * np.eye(normal.shape[-1]))
        right_side = (of_rows.swapaxes(-1, -2) @ flat[..., None])[..., 0] + of_prior
        solution = (covariance @ right_side[..., None])[..., 0]
        residuals = np.linalg.norm((flat - (rows @ solution[..., None])[..., 0]).reshape(values.shape), axis=-1)
        if robust is not None:
            scale = robust.scale(residuals)
            weighted = weights * cauchy_weights(residuals, robust.half_weight * scale)
    return Estimate(solution, covariance, residuals)


def shift_scale_px(lengths_px: Array) -> float:
    """Return a robust scale of residual shifts with these lengths (n,), at least MIN_SHIFT_SCALE_PX.

    Of normally distributed shifts, it is 1.23 times the RMS length, 1.75 times the standard deviation along an axis.
    """
    median_px = float(np.median(lengths_px)) if len(lengths_px) else 0.0
    mad_to_std = 1.4826  # of signed residuals; lengths of two components have a larger median
    return max(mad_to_std * median_px, MIN_SHIFT_SCALE_PX)


def cauchy_weights(residuals: ArrayLike, scale: float | Array) -> Array:
    """Return Cauchy weights 1 / (1 + (r / scale)^2) of residuals (...,), in their shape.

    `residuals` are lengths in the unit of `scale`, which must be positive. A residual of 0 has weight 1, one of `scale`
    has 0.5, an infinite one has 0. NaN stays NaN.
    """
    ratio = np.asarray(residuals, dtype=np.float64) / scale
    return np.asarray(1 / (1 + ratio**2))


def mean_in_standard_errors(values: Array) -> float:
    """Return the mean of values (n,) relative to its standard error; 0 for few values, whose spread is unknown."""
    min_values = 10  # noise exceeds four of these standard errors in 0.3 % of the cases, and in 3 % with four values
    if len(values) < min_values:
        return 0.0
    return float(values.mean() / max(values.std(ddof=1) / math.sqrt(len(values)), 1e-12))
