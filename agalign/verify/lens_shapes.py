"""The error of a mapping where the images show nothing: what an unknown lens leaves, beyond what a homography follows.

Two lenses of one rig differ by a smooth displacement. It has a few shapes, of Brown and Conrady's model to first order.
A homography that is fitted to a part of the image follows them there and deviates from them elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import DisplacementField, Residual
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx
from agalign.values.robust import MAD_TO_STD, cauchy_weights

Array = NDArray[np.float64]

LENS_STD = (1.3e-3, 0.7e-3, 1.2e-3, 1.2e-3)
"""Standard deviation of each shape at the corners, as a share of half the diagonal. The lenses of 28 band pairs of six
cameras (RedEdge-3, RedEdge-M, RedEdge-MX dual, Sequoia; calibrations in the tags) differ by 1.0, 0.6, 1.0 and 1.0 px
at 800 px from the centre."""
CALIBRATED = 0.4
"""The same where both lenses are calibrated: reference tie points of 45 RedEdge pairs show two fifths of it."""
_CORNER_STD_PX = 5.0
"""Standard deviation of a corner before windows are considered: the error of an extrapolated affinity."""
_MIN_SPREAD_PX = 0.05
"""Smaller misfits are the noise of shifts."""
_SHARED = 4.0
"""Neighbouring windows see the same relief: so many of them count as one."""
_SPREADS = 2.0
"""A window has half its weight at twice the typical misfit."""
_REWEIGHTINGS = 6
"""A fixed number, enough for the weights to settle."""
_LATTICE_PX = 48
"""Between the nodes of a displacement field, which is cubic between them."""
_CHECKED = 17, 13
"""Columns and rows of the points over which errors are averaged."""


def lens_shapes(points_px: Points, size_px: tuple[int, int]) -> Array:
    """(n, 2, 4): displacements of points (n, 2) of an image (width, height), of length 1 at the corners: radial with
    the third and the fifth power of the distance from the centre, and the two decentring shapes.
    """
    centre = (np.array(size_px, dtype=np.float64) - 1) / 2
    u, v = ((points_px - centre) / np.linalg.norm(centre)).T
    square = u * u + v * v
    along_x = np.stack([u * square, u * square**2, square + 2 * u * u, 2 * u * v], axis=-1)
    along_y = np.stack([v * square, v * square**2, 2 * u * v, square + 2 * v * v], axis=-1)
    # The decentring shapes are up to 3 long along their axis.
    return np.asarray(np.stack([along_x, along_y], axis=1) * np.array([1.0, 1.0, 1 / 3, 1 / 3]))


def over_corners_and_lens(points_px: Points, size_px: tuple[int, int]) -> Array:
    """(n, 2, 12): the displacement of points over those of the corners, and over the lens shapes, px."""
    return np.concatenate([geometry.over_corners(points_px, *size_px), lens_shapes(points_px, size_px)], axis=2)


def lens_std_px(size_px: tuple[int, int], *, calibrated: bool) -> Array:
    """(4,) standard deviation of each shape on an image (width, height)."""
    return np.array(LENS_STD) * float(np.hypot(*size_px)) / 2 * (CALIBRATED if calibrated else 1.0)


@dataclass(frozen=True)
class LensFit:
    """The displacements of the corners and the lens shapes that windows suggest, px of the reference."""

    mean_px: Array
    """(12,): x and y of the corners in turn, clockwise from the top left, and the shapes."""
    covariance_px2: Array
    """(12, 12)"""
    spread_px: float
    """Typical misfit of a window."""
    size_px: tuple[int, int]

    def std_px(self, points_px: Points) -> float:
        """Root mean square error over points (n, 2), with the misfit of single windows."""
        design = over_corners_and_lens(points_px, self.size_px)
        square = np.einsum("nki,ij,nkj->n", design, self.covariance_px2, design).mean()
        return float(np.sqrt(square + self.spread_px**2))

    def misfits_px(self, points_px: Points, shifts_px: Array) -> Array:
        """(n, 2): what the fit leaves of shifts (n, 2) at points (n, 2)."""
        return np.asarray(shifts_px - over_corners_and_lens(points_px, self.size_px) @ self.mean_px)

    def field(self) -> DisplacementField:
        """The lens shapes as displacements of raw pixels of the reference."""
        columns, rows = (int(np.ceil(n / _LATTICE_PX)) + 1 for n in self.size_px)
        at_x, at_y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
        nodes = np.stack([at_x.ravel(), at_y.ravel()], axis=1) * _LATTICE_PX
        displacements = lens_shapes(nodes, self.size_px) @ self.mean_px[8:]
        return DisplacementField(float(_LATTICE_PX), displacements.reshape(rows, columns, 2))


def fit_with_lens(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], *, calibrated: bool
) -> LensFit:
    """The maximum a posteriori correction of a mapping, from residual windows measured under it."""
    measured = np.isfinite(residual.shifts_px[:, 0])
    centres_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    points_px, shifted_px = (mapping.undistorted(p) for p in (centres_px, centres_px + shifts_px))
    shifts_px, sigma = shifted_px - points_px, residual.peaks_sigma[measured]
    design = over_corners_and_lens(points_px, size_px)
    prior = np.diag(np.r_[np.full(8, _CORNER_STD_PX), lens_std_px(size_px, calibrated=calibrated)] ** -2.0)
    by_peak = (sigma / np.median(sigma)) ** 4 if len(sigma) else sigma
    robust, spread_px = np.ones(len(sigma)), _MIN_SPREAD_PX
    mean, covariance = np.zeros(12), np.linalg.inv(prior)
    for _ in range(_REWEIGHTINGS if len(sigma) else 0):
        weight = by_peak * robust / (_SHARED * spread_px**2)
        covariance = np.linalg.inv(np.einsum("n,nki,nkj->ij", weight, design, design) + prior)
        mean = covariance @ np.einsum("n,nki,nk->i", weight, design, shifts_px)
        misfits_px = np.linalg.norm(shifts_px - design @ mean, axis=1)
        spread_px = max(MAD_TO_STD * float(np.median(misfits_px)), _MIN_SPREAD_PX)
        robust = cauchy_weights(misfits_px, _SPREADS * spread_px)
    return LensFit(mean, covariance, spread_px, size_px)


def unmodelled_std_px(centres_px: Points, size_px: tuple[int, int], *, calibrated: bool) -> float:
    """Root mean square over an image (width, height) of what the lenses leave under a homography that is fitted to
    windows at centres (n, 2), px.
    """
    points_px = geometry.lattice(*size_px, *_CHECKED)
    inside = geometry.over_corners(centres_px, *size_px).reshape(-1, 8)
    followed = np.linalg.lstsq(inside, lens_shapes(centres_px, size_px).reshape(-1, 4), rcond=None)[0]
    left = lens_shapes(points_px, size_px) - geometry.over_corners(points_px, *size_px) @ followed
    return float(np.sqrt(((left * lens_std_px(size_px, calibrated=calibrated)) ** 2).sum(axis=(1, 2)).mean()))
