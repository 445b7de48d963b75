"""The homography close to the identity that the residual shifts of many windows suggest, by its corners."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx
from agalign.values.robust import MAD_TO_STD, cauchy_weights

Array = NDArray[np.float64]

_MIN_WINDOWS = 16
"""Measured windows without which corners are not corrected: twice the eight unknowns."""
_SPREADS = 2.0
"""A window has half its weight at twice the typical misfit."""
_MIN_SPREAD_PX = 0.05
"""Smaller misfits are the noise of shifts."""
_REWEIGHTINGS = 6
"""A fixed number, enough for the weights to settle."""
_COMMON_STD_PX = 0.01
"""Error along x and y that all windows have in common, in addition to what they disagree by."""
_UNKNOWN = 1e-9
"""Share of the total information that directions get which no window determines."""


@dataclass(frozen=True)
class CornerFit:
    """The displacement of each corner, clockwise from the top left, px of the reference, and its uncertainty."""

    mean_px: Array
    """(8,): x and y of the corners in turn."""
    covariance_px2: Array
    """(8, 8), from the disagreement of the windows."""

    @property
    def max_px(self) -> float:
        """Largest displacement of a corner along x or y."""
        return float(np.abs(self.mean_px).max())

    def applied_to(self, fixed_to_moving: Matrix, size_px: tuple[int, int]) -> Matrix:
        """A homography of an image (width, height) with its corners displaced. Raises GeometryError."""
        return geometry.compose(fixed_to_moving, geometry.moving_corners(self.mean_px, *size_px))


def with_corners(result: JointResult[FixedPx], fixed_to_moving: Matrix, covariance_px2: Array) -> JointResult[FixedPx]:
    """A result with another homography and the covariance (8, 8) of its corners."""
    std = np.sqrt(np.diag(covariance_px2)).reshape(4, 2)
    return replace(
        result, fixed_to_moving=fixed_to_moving, corner_covariance_px2=covariance_px2,
        corner_std_xy_px=tuple((float(x), float(y)) for x, y in std),
    )  # fmt: skip


def corner_correction(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], min_windows: int = _MIN_WINDOWS
) -> CornerFit | None:
    """The correction of a mapping's homography from the residual of windows measured under that mapping.

    Windows are brought to the pixels that the homography maps: through the displacement field and the lens of the
    reference image (width, height). None where fewer than `min_windows` windows were measured.
    """
    measured = np.isfinite(residual.shifts_px[:, 0])
    if measured.sum() < min_windows:
        return None
    centres_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    points_px, shifted_px = (mapping.undistorted(p) for p in (centres_px, centres_px + shifts_px))
    return fit_corners(points_px, shifted_px - points_px, residual.peaks_sigma[measured], size_px)


def fit_corners(points_px: Array, shifts_px: Array, peaks_sigma: Array, size_px: tuple[int, int]) -> CornerFit:
    """Least squares of shifts (n, 2) at points (n, 2) of an image (width, height).

    Weights are the fourth power of the heights (n,) of the correlation peaks, and Cauchy's against outliers.
    """
    design = geometry.over_corners(points_px, *size_px)
    by_peak, robust = (peaks_sigma / np.median(peaks_sigma)) ** 4, np.ones(len(shifts_px))
    for _ in range(_REWEIGHTINGS):
        weight = by_peak * robust
        normal = np.einsum("n,nki,nkj->ij", weight, design, design)
        mean = np.linalg.lstsq(normal, np.einsum("n,nki,nk->i", weight, design, shifts_px), rcond=None)[0]
        misfits_px = shifts_px - design @ mean
        lengths_px = np.linalg.norm(misfits_px, axis=1)
        spread_px = max(MAD_TO_STD * float(np.median(lengths_px)), _MIN_SPREAD_PX)
        robust = cauchy_weights(lengths_px, _SPREADS * spread_px)
    score = np.einsum("n,nki,nk->ni", weight, design, misfits_px)
    # Windows in a line agree, and do not determine the corners away from it.
    inverse = np.linalg.inv(normal + _UNKNOWN * np.trace(normal) * np.eye(8))
    disagreement = inverse @ (score.T @ score) @ inverse
    covariance = np.asarray(disagreement + (_MIN_SPREAD_PX**2 / np.median(weight)) * inverse)
    return CornerFit(mean, covariance + _COMMON_STD_PX**2 * np.eye(8))
