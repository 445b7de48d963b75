"""Lens shapes, the smooth displacements by which the distortions of two lenses differ; the variance of a mapping.

To first order of the Brown-Conrady model, two lenses differ by four shapes N(x) f. A homography follows them only where
it is fitted. The variance of a mapping is trace(D(x) C D(x)^T), with the derivatives D by the corners and the shapes.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.least_squares import MIN_SHIFT_SCALE_PX

Array = NDArray[np.float64]

CORNERS = 8
"""Coordinates of the corners, x and y in turn, clockwise from the top left: the parameters of a homography. Those of
the lens shapes follow them in a covariance."""
LENS_STD = (1.3e-3, 0.7e-3, 1.2e-3, 1.2e-3)
"""Standard deviation of each shape at the corners, as a share of half the diagonal. The lenses of 28 band pairs of six
cameras (RedEdge-3, RedEdge-M, RedEdge-MX dual, Sequoia; calibrations in the tags) differ by 1.0, 0.6, 1.0 and 1.0 px
at 800 px from the centre."""
SHAPES = len(LENS_STD)
"""Number of shapes."""
CALIBRATED = 0.4
"""Factor on LENS_STD if both lenses are calibrated; measured on reference tie points of 45 RedEdge pairs."""
_VARIANCE_FACTOR = 12.0
"""Factor on the variance of shifts for lens shapes: these extrapolate errors by relief, which neighbouring windows have
in common. `adjust` does not need it, because it fits the parallax of each window. The value is assumed."""


def lens_shapes(points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, 2, 4) the displacements by each shape at points (n, 2) of an image (width, height).

    The shapes are radial of third and fifth order, of length 1 at the corners, and the two of decentring, of length 1
    along their axis at the distance of the corners.
    """
    centre = (np.array(size_px, dtype=np.float64) - 1) / 2
    u, v = ((points_px - centre) / np.linalg.norm(centre)).T
    square = u * u + v * v
    dx = np.stack([u * square, u * square**2, square + 2 * u * u, 2 * u * v], axis=-1)
    dy = np.stack([v * square, v * square**2, 2 * u * v, square + 2 * v * v], axis=-1)
    # The length of the decentring shapes is up to 3 along their axis.
    return np.asarray(np.stack([dx, dy], axis=1) * np.array([1.0, 1.0, 1 / 3, 1 / 3]))


def lens_std_px(size_px: tuple[int, int], *, calibrated: bool) -> Array:
    """Return (4,) the standard deviation of each shape on an image (width, height), px."""
    return np.array(LENS_STD) * float(np.hypot(*size_px)) / 2 * (CALIBRATED if calibrated else 1.0)


def jacobian(points_px: Points, size_px: tuple[int, int], parameters: int) -> Array:
    """Return (n, 2, 8 or 12) the derivative of displacements of points by those of the corners, and by lens shapes."""
    of_corners = geometry.over_corners(points_px, *size_px)
    if parameters == CORNERS:
        return of_corners
    return np.concatenate([of_corners, lens_shapes(points_px, size_px)], axis=2)


def variance_px2(points_px: Points, covariance_px2: Array, size_px: tuple[int, int]) -> Array:
    """Return (n,) the variance at points (n, 2) by the covariance of the corners (8, 8), or with shapes (12, 12)."""
    design = jacobian(points_px, size_px, len(covariance_px2))
    return np.asarray(np.einsum("nki,ij,nkj->n", design, covariance_px2, design))


def shift_variance_px2(scale_px: float | Array, *, with_shapes: bool = False) -> Any:
    """Return the variance along an axis of shifts with residuals of this robust scale, `least_squares.shift_scale_px`,
    to which `with_shapes` lens shapes are fitted.
    """
    axis_share = 1 / 3  # of the squared scale of lengths; normally distributed: 1 / 3.05
    variance_px2 = axis_share * scale_px**2
    return variance_of_shapes_px2(variance_px2) if with_shapes else variance_px2 + MIN_SHIFT_SCALE_PX**2


def variance_of_shapes_px2(axis_variance_px2: float | Array) -> Any:
    """Return the variance along an axis that shifts have for lens shapes, from that of their residuals."""
    return _VARIANCE_FACTOR * axis_variance_px2 + MIN_SHIFT_SCALE_PX**2
