"""Weights for iteratively reweighted least squares."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

MIN_SHIFT_SCALE_PX = 0.05
"""Noise of the measured shift of a window: the minimum residual scale of a fit to shifts."""


def shift_scale_px(lengths_px: NDArray[np.float64]) -> float:
    """Return the robust standard deviation of residual shifts with these lengths (n,), at least MIN_SHIFT_SCALE_PX."""
    median_px = float(np.median(lengths_px)) if len(lengths_px) else 0.0
    mad_to_std = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
    return max(mad_to_std * median_px, MIN_SHIFT_SCALE_PX)


def cauchy_weights(residuals: ArrayLike, scale: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Cauchy weights 1 / (1 + (r / scale)^2) of residuals (...,), in their shape (Holland & Welsch 1977).

    `residuals` are lengths in the unit of `scale`, which must be positive. A residual of 0 has weight 1, one of `scale`
    has 0.5, an infinite one has 0. NaN stays NaN.
    """
    ratio = np.asarray(residuals, dtype=np.float64) / scale
    return np.asarray(1 / (1 + ratio**2))
