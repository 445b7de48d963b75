"""Mappings as bilinear functions of a band's lens and a capture's factors, and their robust least squares.

The difference between two mappings of a band is expressed as (2, 3) coefficients of g = (1, u, v), the normalised
coordinates of the model in `rig`, in px. The norm of the coefficients is the RMS distance over the image.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.flight.rig import FACTORS, Factor
from agalign.values import geometry
from agalign.values.geometry import Matrix, Points
from agalign.values.pixel_units import MovingFilePx
from agalign.values.robust import cauchy_weights

Array = NDArray[np.float64]

FACTOR_STD_PX = (20.0, 3.0, 3.0, 20.0, 20.0)
"""Standard deviations of the prior of a capture's factors (5,); wide, to allow heights outside the learned range."""
_FACTOR_PRIOR = np.zeros((1, FACTORS)), np.array(FACTOR_STD_PX)
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


def design_tensor(factors: Sequence[Factor]) -> Array:
    """Return (3, 2, 3, 5) the bilinear model: coefficients of (t_x, t_y, d) times the factors (5,), 0 if not used."""
    result = np.zeros((3, 2, 3, FACTORS))
    result[0, 0, range(3), range(3)] = result[1, 1, range(3), range(3)] = 1.0
    result[2, (0, 1), 0, (3, 4)] = 1.0
    return result * np.isin(range(FACTORS), [column for factor in factors for column in _COLUMNS[factor]])


def least_squares(
    design: Array, target: Array, weights: Array, prior: tuple[Array, Array] = _FACTOR_PRIOR, *, robust: bool = True
) -> tuple[Array, Array]:
    """Solve n linear problems with Gaussian priors; return the parameters (n, p) and their covariances (n, p, p).

    The parameters are the factors of n captures, or the parameters of n bands. `target` (n, k, 2, 3) has the
    coefficients of k mappings, px, and `design` (k, 2, 3, p) their derivative with respect to the parameters. `weights`
    (n, k) are from `mapping_weight`, 0 without a mapping. `prior` is the mean (n or 1, p) and the standard deviation
    (p,), by default of factors. `robust` reduces the weights of mappings with large residuals.
    """
    x, y = design.reshape(len(design), 6, design.shape[-1]), target.reshape(*weights.shape, 6)
    mean, information = prior[0], 1 / prior[1] ** 2
    squares, products = x.swapaxes(1, 2) @ x, np.einsum("nkr,krp->nkp", y, x)
    inlier = np.ones_like(weights)
    for _ in range(_REWEIGHTINGS if robust else 1):
        covariance = np.linalg.inv(np.tensordot(weights * inlier, squares, 1) + np.diag(information))
        right_side = ((weights * inlier)[:, None] @ products)[:, 0] + mean * information
        result = (covariance @ right_side[..., None])[..., 0]
        inlier = cauchy_weights(np.linalg.norm(y - np.moveaxis(x @ result.T, 2, 0), axis=2), _OUTLIER_PX)
    return np.asarray(result), np.asarray(covariance)


def mapping_weight(std_px: ArrayLike, model_error_px: ArrayLike = 0.0) -> Array:
    """Return the weight, 1 / px^2, of a mapping from its standard error and the error of the model."""
    return np.asarray(1 / (np.square(std_px) + np.square(model_error_px) + MIN_STD_PX**2))


def lattice_points(size_px: tuple[int, int]) -> Points:
    """Return the points (35, 2) of an image (width, height) at which mappings are compared."""
    return geometry.lattice(*size_px, *_LATTICE)


def coordinates(size_px: tuple[int, int]) -> Array:
    """Return g = (1, u, v), (35, 3), of `lattice_points`; u and v have mean 0 and variance 1."""
    points = lattice_points(size_px)
    return np.column_stack([np.ones(len(points)), (points - points.mean(axis=0)) / points.std(axis=0)])


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
