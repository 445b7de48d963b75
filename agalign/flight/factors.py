"""Mappings as linear functions of a capture's factors, and the least squares that finds the factors.

Differences between mappings of one band are written as (2, 3) coefficients over g = (1, u, v), the coordinates of
`rig`'s model, in px: their norm is the root mean square distance over the image.
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
"""Prior of a capture's factors around the mean: wide, for heights that the flight has not seen."""
MIN_STD_PX = 0.05
"""Standard error that a mapping has beyond its own estimate of it."""
_COLUMNS: dict[Factor, tuple[int, ...]] = {"distance": (0,), "tilt": (1, 2), "motion": (3, 4), "reference": (3, 4)}
_LATTICE = 7, 5
_OUTLIER_PX = 0.3
"""A band that disagrees with the others by this has half its weight."""
_REWEIGHTINGS = 6
"""After so many the weights have converged."""


def factor_mask(factors: Sequence[Factor]) -> Array:
    """(5,): 1 for the columns of the factors that count, else 0."""
    result = np.zeros(FACTORS)
    for factor in factors:
        result[list(_COLUMNS[factor])] = 1.0
    return result


def factor_design(baseline: Array, delay: float) -> Array:
    """(2, 3, 5): the change of a band's coefficients with each factor, from its baseline (2,) and its delay."""
    result = np.zeros((2, 3, FACTORS))
    result[:, range(3), range(3)] = baseline[:, None]
    result[(0, 1), 0, (3, 4)] = delay
    return result


def solve_factors(differences: Array, designs: Array, weights: Array, mask: Array) -> tuple[Array, Array]:
    """(factors (captures, 5), covariances (captures, 5, 5)) by robust least squares with Cauchy weights.

    From the differences (captures, bands, 2, 3) of each capture's mappings from the bands' means, the bands' designs
    (bands, 2, 3, 5), weights (captures, bands) and the mask (5,) of the factors that count.
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
    """Weight of a mapping with this standard error, in a model with an error of its own: 1 / px^2."""
    return 1 / (std_px**2 + model_error_px**2 + MIN_STD_PX**2)


def lattice_points(size_px: tuple[int, int]) -> Points:
    """The points of an image (width, height) at which mappings are compared, (35, 2)."""
    return geometry.lattice(*size_px, *_LATTICE)


def coordinates(size_px: tuple[int, int], points_px: Points | None = None) -> Array:
    """The g (points, 3) of points (points, 2), by default of the lattice; over the lattice the first column is 1, and
    the others have mean 0 and variance 1.
    """
    lattice = lattice_points(size_px)
    points = lattice if points_px is None else points_px
    return np.column_stack([np.ones(len(points)), (points - lattice.mean(axis=0)) / lattice.std(axis=0)])


def affine_difference(mean: Matrix, mapping: Matrix, size_px: tuple[int, int]) -> Array:
    """(2, 3): the coefficients of the second mapping minus the first, as far as the difference is affine."""
    points = lattice_points(size_px)
    difference_px = geometry.apply(mapping, points) - geometry.apply(mean, points)
    return np.asarray(np.linalg.lstsq(coordinates(size_px), difference_px, rcond=None)[0].T)


def displaced(mean: Matrix, coefficients: Array, size_px: tuple[int, int]) -> Matrix:
    """The mapping plus a difference with coefficients (2, 3): the inverse of `affine_difference`."""
    points = lattice_points(size_px)
    return geometry.fit_homography(points, geometry.apply(mean, points) + coordinates(size_px) @ coefficients.T)


def distance_px(one: Matrix, other: Matrix, size_px: tuple[int, int]) -> MovingFilePx:
    """Root mean square distance between the positions in the moving file to which two homographies map an image
    (width, height).
    """
    points = lattice_points(size_px)
    difference_px = geometry.apply(one, points) - geometry.apply(other, points)
    return MovingFilePx(np.sqrt((difference_px**2).sum(axis=1).mean()))


def median_mapping(matrices: Sequence[Matrix], size_px: tuple[int, int]) -> Matrix:
    """The homography through the median of the images of each lattice point."""
    if len(matrices) == 1:
        return matrices[0]
    points = lattice_points(size_px)
    return geometry.fit_homography(points, np.median([geometry.apply(m, points) for m in matrices], axis=0))
