"""Weights for iteratively reweighted least squares."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def cauchy_weights(residuals: ArrayLike, scale: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Cauchy weights 1 / (1 + (r / scale)^2), the shape of `residuals` (Holland & Welsch 1977).

    `residuals` are lengths in the unit of `scale`, which must be positive. A residual of 0 has weight 1, one of `scale`
    has 0.5, an infinite one has 0. NaN stays NaN.
    """
    ratio = np.asarray(residuals, dtype=np.float64) / scale
    return np.asarray(1 / (1 + ratio**2))
