"""Lens distortion that a homography does not model, and the error of an extrapolated mapping by it.

The distortions of two lenses of a rig differ by a smooth displacement, which is modelled by four shapes: the
Brown-Conrady model to first order. A homography that is fitted to a part of the image approximates them there and
deviates from them elsewhere.
"""

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.geometry import Points

Array = NDArray[np.float64]

LENS_STD = (1.3e-3, 0.7e-3, 1.2e-3, 1.2e-3)
"""Standard deviation of each shape at the corners, as a share of half the diagonal. The lenses of 28 band pairs of six
cameras (RedEdge-3, RedEdge-M, RedEdge-MX dual, Sequoia; calibrations in the tags) differ by 1.0, 0.6, 1.0 and 1.0 px
at 800 px from the centre."""
CALIBRATED = 0.4
"""Factor on LENS_STD if both lenses are calibrated; measured on reference tie points of 45 RedEdge pairs."""
_LATTICE = 17, 13
"""Columns and rows of the points over which errors are averaged."""


def lens_shapes(points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, 2, 4) the displacements by each shape at points (n, 2) of an image (width, height).

    The shapes are radial of third and fifth order, and the two of decentring. Their length is 1 at the corners.
    """
    centre = (np.array(size_px, dtype=np.float64) - 1) / 2
    u, v = ((points_px - centre) / np.linalg.norm(centre)).T
    square = u * u + v * v
    dx = np.stack([u * square, u * square**2, square + 2 * u * u, 2 * u * v], axis=-1)
    dy = np.stack([v * square, v * square**2, 2 * u * v, square + 2 * v * v], axis=-1)
    # The length of the decentring shapes is up to 3 along their axis.
    return np.asarray(np.stack([dx, dy], axis=1) * np.array([1.0, 1.0, 1 / 3, 1 / 3]))


def over_corners_and_lens(points_px: Points, size_px: tuple[int, int]) -> Array:
    """Return (n, 2, 12) the Jacobian of displacements of points by those of the corners and by the lens shapes."""
    return np.concatenate([geometry.over_corners(points_px, *size_px), lens_shapes(points_px, size_px)], axis=2)


def variance_px2(points_px: Points, covariance_px2: Array, size_px: tuple[int, int]) -> Array:
    """Return (n,) the variance at points (n, 2) by the covariance of the corners (8, 8), or with shapes (12, 12)."""
    jacobian = over_corners_and_lens(points_px, size_px)[:, :, : len(covariance_px2)]
    return np.asarray(np.einsum("nki,ij,nkj->n", jacobian, covariance_px2, jacobian))


def lens_std_px(size_px: tuple[int, int], *, calibrated: bool) -> Array:
    """Return (4,) the standard deviation of each shape on an image (width, height), px."""
    return np.array(LENS_STD) * float(np.hypot(*size_px)) / 2 * (CALIBRATED if calibrated else 1.0)


def unmodelled_std_px(centres_px: Points, size_px: tuple[int, int], *, calibrated: bool) -> float:
    """Return the RMS lens distortion, px, that a homography fitted to windows at centres (n, 2) does not model.

    It is averaged over the whole image (width, height).
    """
    points_px = geometry.lattice(*size_px, *_LATTICE)
    inside = geometry.over_corners(centres_px, *size_px).reshape(-1, 8)
    fitted = np.linalg.lstsq(inside, lens_shapes(centres_px, size_px).reshape(-1, 4), rcond=None)[0]
    unmodelled = lens_shapes(points_px, size_px) - geometry.over_corners(points_px, *size_px) @ fitted
    return float(np.sqrt(((unmodelled * lens_std_px(size_px, calibrated=calibrated)) ** 2).sum(axis=(1, 2)).mean()))
