"""Mappings as linear functions of a capture's factors, and the estimation of the factors by robust least squares.

The difference between two mappings of a band is expressed as (2, 3) coefficients of g = (1, u, v), the normalised
coordinates of the model in `rig`, in px. The norm of the coefficients is the RMS distance over the image.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agalign.flight.rig import FACTORS, Factor
from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.pixel_units import MovingFilePx
from agalign.values.robust import cauchy_weights

Array = NDArray[np.float64]

FACTOR_STD_PX = (20.0, 3.0, 3.0, 20.0, 20.0)
"""Standard deviations of the prior of a capture's factors (5,); wide, to allow heights outside the learned range."""
MIN_STD_PX = 0.05
"""Added in quadrature to the standard error of a mapping, which does not contain all errors."""
_COLUMNS: dict[Factor, tuple[int, ...]] = {"distance": (0,), "tilt": (1, 2), "motion": (3, 4), "reference": (3, 4)}
"""Columns of the factors (5,). `reference` is a motion of all moving bands relative to the reference."""
_LATTICE = 7, 5
"""Columns and rows of the points at which mappings are compared."""
_OUTLIER_PX = 0.3
"""Residual of a band at which its robust weight is one half."""
_REWEIGHTINGS = 6
"""Iterations after which the robust weights have converged."""


def factor_mask(factors: Sequence[Factor]) -> Array:
    """Return (5,) 1 for the columns of the given factors, else 0."""
    result = np.zeros(FACTORS)
    for factor in factors:
        result[list(_COLUMNS[factor])] = 1.0
    return result


def factor_design(baseline: Array, delay: float) -> Array:
    """Return (2, 3, 5) the derivative of a band's coefficients with respect to the factors.

    `baseline` (2,) and `delay` are t_b and d_b of the model in `rig`.
    """
    result = np.zeros((2, 3, FACTORS))
    result[:, range(3), range(3)] = baseline[:, None]
    result[(0, 1), 0, (3, 4)] = delay
    return result


def solve_factors(differences: Array, designs: Array, weights: Array, mask: Array) -> tuple[Array, Array]:
    """Estimate factors (captures, 5) and covariances (captures, 5, 5) by least squares with Cauchy weights.

    `differences` (captures, bands, 2, 3) are coefficients of the mappings minus the means of the bands, px; `designs`
    (bands, 2, 3, 5) are from `factor_design`, `weights` (captures, bands) from `mapping_weight`, 0 for bands without a
    mapping, and `mask` (5,) from `factor_mask`.
    """
    x = (designs * mask).reshape(len(designs), 6, FACTORS)
    y = differences.reshape(*differences.shape[:2], 6)
    prior = np.diag(1 / np.square(FACTOR_STD_PX))
    captures, bands = weights.shape
    squares = (x.transpose(0, 2, 1) @ x).reshape(bands, FACTORS * FACTORS)
    products = (y[:, :, None] @ x)[:, :, 0]
    rows = x.reshape(bands * 6, FACTORS)
    robust = np.ones_like(weights)
    for _ in range(_REWEIGHTINGS):
        w = weights * robust
        covariance = np.linalg.inv((w @ squares).reshape(captures, FACTORS, FACTORS) + prior)
        result = (covariance @ (w[:, None] @ products)[:, 0, :, None])[..., 0]
        squared_px2 = ((y - (result @ rows.T).reshape(y.shape)) ** 2).sum(axis=2)
        robust = cauchy_weights(np.sqrt(squared_px2), _OUTLIER_PX)
    return result, covariance * np.outer(mask, mask)


def mapping_weight(std_px: float, model_error_px: float = 0.0) -> float:
    """Return the weight, 1 / px^2, of a mapping from its standard error and the error of the model."""
    return 1 / (std_px**2 + model_error_px**2 + MIN_STD_PX**2)


def lattice_points(size_px: tuple[int, int]) -> Points:
    """Return the points (35, 2) of an image (width, height) at which mappings are compared."""
    return geometry.lattice(*size_px, *_LATTICE)


def coordinates(size_px: tuple[int, int], points_px: Points | None = None) -> Array:
    """Return g = (1, u, v), (N, 3), of points (N, 2), by default of `lattice_points`.

    u and v have mean 0 and variance 1 over the lattice.
    """
    lattice = lattice_points(size_px)
    points = lattice if points_px is None else points_px
    return np.column_stack([np.ones(len(points)), (points - lattice.mean(axis=0)) / lattice.std(axis=0)])


def affine_difference(mean: Matrix, mapping: Matrix, size_px: tuple[int, int]) -> Array:
    """Return (2, 3) coefficients of the affine part of the second mapping minus the first, px."""
    points = lattice_points(size_px)
    difference_px = geometry.apply(mapping, points) - geometry.apply(mean, points)
    return np.asarray(np.linalg.lstsq(coordinates(size_px), difference_px, rcond=None)[0].T)


def displaced(mean: Matrix, coefficients: Array, size_px: tuple[int, int]) -> Matrix:
    """Add a difference with coefficients (2, 3) to a mapping; the inverse of `affine_difference`."""
    points = lattice_points(size_px)
    return geometry.fit_homography(points, geometry.apply(mean, points) + coordinates(size_px) @ coefficients.T)


def distance_px(one: Matrix, other: Matrix, size_px: tuple[int, int]) -> MovingFilePx:
    """Return the RMS distance between two homographies over an image (width, height), px of the moving file."""
    points = lattice_points(size_px)
    difference_px = geometry.apply(one, points) - geometry.apply(other, points)
    return MovingFilePx(np.sqrt((difference_px**2).sum(axis=1).mean()))


def median_mapping(matrices: Sequence[Matrix], size_px: tuple[int, int]) -> Matrix:
    """Return the homography fitted to the coordinatewise median of the mapped lattice points."""
    if len(matrices) == 1:
        return matrices[0]
    points = lattice_points(size_px)
    return geometry.fit_homography(points, np.median([geometry.apply(m, points) for m in matrices], axis=0))
