"""Error of an extrapolated mapping by unknown lens distortion that a homography does not model.

The distortions of two lenses of a rig differ by a smooth displacement, which is modelled by four shapes: the
Brown-Conrady model to first order. A homography that is fitted to a part of the image approximates them there and
deviates from them elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx
from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px

Array = NDArray[np.float64]

LENS_STD = (1.3e-3, 0.7e-3, 1.2e-3, 1.2e-3)
"""Standard deviation of each shape at the corners, as a share of half the diagonal. The lenses of 28 band pairs of six
cameras (RedEdge-3, RedEdge-M, RedEdge-MX dual, Sequoia; calibrations in the tags) differ by 1.0, 0.6, 1.0 and 1.0 px
at 800 px from the centre."""
CALIBRATED = 0.4
"""Factor on LENS_STD if both lenses are calibrated; measured on reference tie points of 45 RedEdge pairs."""
_CORNER_STD_PX = 5.0
"""Standard deviation of the prior of a corner: the error of an extrapolated affine mapping."""

_CORRELATED_WINDOWS = 4.0
"""Effective number of neighbouring windows with the same relief, by which the weights are divided."""
_CAUCHY_SCALES = 2.0
"""Residual at which the robust weight is one half, in residual scales."""
_REWEIGHTINGS = 6
"""Iterations after which the robust weights have converged."""
_NODE_STEP_PX = 48
"""Spacing of the nodes of a displacement field."""
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


def lens_std_px(size_px: tuple[int, int], *, calibrated: bool) -> Array:
    """Return (4,) the standard deviation of each shape on an image (width, height), px."""
    return np.array(LENS_STD) * float(np.hypot(*size_px)) / 2 * (CALIBRATED if calibrated else 1.0)


@dataclass(frozen=True)
class LensFit:
    """Displacements of the corners and coefficients of the lens shapes, fitted to windows, px of the reference."""

    mean_px: Array
    """(12,) x and y of the corners in turn, clockwise from the top left, and the four shapes."""
    covariance_px2: Array
    """(12, 12)"""
    scale_px: float
    """Robust standard deviation of the residuals of windows."""
    size_px: tuple[int, int]

    def std_px(self, points_px: Points) -> float:
        """Return the RMS error over points (n, 2), including the residual of single windows."""
        design = over_corners_and_lens(points_px, self.size_px)
        square = np.einsum("nki,ij,nkj->n", design, self.covariance_px2, design).mean()
        return float(np.sqrt(square + self.scale_px**2))

    def residuals_px(self, points_px: Points, shifts_px: Array) -> Array:
        """Return (n, 2) the residuals of shifts (n, 2) at points (n, 2)."""
        return np.asarray(shifts_px - over_corners_and_lens(points_px, self.size_px) @ self.mean_px)

    def field(self) -> DisplacementField:
        """Return the lens shapes as a displacement field over raw pixels of the reference."""
        columns, rows = (int(np.ceil(n / _NODE_STEP_PX)) + 1 for n in self.size_px)
        x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
        nodes = np.stack([x.ravel(), y.ravel()], axis=1) * _NODE_STEP_PX
        displacements = lens_shapes(nodes, self.size_px) @ self.mean_px[8:]
        return DisplacementField(float(_NODE_STEP_PX), displacements.reshape(rows, columns, 2))


def fit_with_lens(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], *, calibrated: bool
) -> LensFit:
    """Return the maximum a posteriori correction of a mapping from the residual shifts that were measured with it."""
    measured = np.isfinite(residual.shifts_px[:, 0])
    centres_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    points_px, shifted_px = (mapping.undistorted(p) for p in (centres_px, centres_px + shifts_px))
    shifts_px, sigma = shifted_px - points_px, residual.peaks_sigma[measured]
    design = over_corners_and_lens(points_px, size_px)
    prior = np.diag(np.r_[np.full(8, _CORNER_STD_PX), lens_std_px(size_px, calibrated=calibrated)] ** -2.0)
    by_peak = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
    robust, scale_px = np.ones(len(sigma)), MIN_SHIFT_SCALE_PX
    mean, covariance = np.zeros(12), np.linalg.inv(prior)
    for _ in range(_REWEIGHTINGS if len(sigma) else 0):
        weight = by_peak * robust / (_CORRELATED_WINDOWS * scale_px**2)
        covariance = np.linalg.inv(np.einsum("n,nki,nkj->ij", weight, design, design) + prior)
        mean = covariance @ np.einsum("n,nki,nk->i", weight, design, shifts_px)
        residuals_px = np.linalg.norm(shifts_px - design @ mean, axis=1)
        scale_px = shift_scale_px(residuals_px)
        robust = cauchy_weights(residuals_px, _CAUCHY_SCALES * scale_px)
    return LensFit(mean, covariance, scale_px, size_px)


def unmodelled_std_px(centres_px: Points, size_px: tuple[int, int], *, calibrated: bool) -> float:
    """Return the RMS lens distortion, px, that a homography fitted to windows at centres (n, 2) does not model.

    It is averaged over the whole image (width, height).
    """
    points_px = geometry.lattice(*size_px, *_LATTICE)
    inside = geometry.over_corners(centres_px, *size_px).reshape(-1, 8)
    fitted = np.linalg.lstsq(inside, lens_shapes(centres_px, size_px).reshape(-1, 4), rcond=None)[0]
    unmodelled = lens_shapes(points_px, size_px) - geometry.over_corners(points_px, *size_px) @ fitted
    return float(np.sqrt(((unmodelled * lens_std_px(size_px, calibrated=calibrated)) ** 2).sum(axis=(1, 2)).mean()))
