"""Correction of a homography from the residual shifts of windows, parametrised by displacements of the corners."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx
from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px

Array = NDArray[np.float64]

_MIN_WINDOWS = 16
"""Minimum number of measured windows: twice the eight parameters."""
_CAUCHY_SCALES = 2.0
"""Residual at which the robust weight is one half, in residual scales."""

_REWEIGHTINGS = 6
"""Iterations after which the robust weights have converged."""
_COMMON_STD_PX = 0.01
"""Standard error along x and y common to all windows, which their residuals do not contain."""
_MIN_INFORMATION_SHARE = 1e-9
"""Share of the total information that is added to directions that no window determines."""


@dataclass(frozen=True)
class CornerFit:
    """Displacements of the corners, clockwise from the top left, px of the reference."""

    mean_px: Array
    """(8,) x and y of the corners in turn."""
    covariance_px2: Array
    """(8, 8) sandwich covariance, from the residuals of the windows."""

    @property
    def max_px(self) -> float:
        """Maximum displacement of a corner along x or y."""
        return float(np.abs(self.mean_px).max())

    def applied_to(self, fixed_to_moving: Matrix, size_px: tuple[int, int]) -> Matrix:
        """Apply the displacements to a homography of an image (width, height). Raises GeometryError."""
        return geometry.compose(fixed_to_moving, geometry.moving_corners(self.mean_px, *size_px))


def with_corners(result: JointResult[FixedPx], fixed_to_moving: Matrix, covariance_px2: Array) -> JointResult[FixedPx]:
    """Return a result with another homography and covariance (8, 8) of the corners."""
    std = np.sqrt(np.diag(covariance_px2)).reshape(4, 2)
    return replace(
        result, fixed_to_moving=fixed_to_moving, corner_covariance_px2=covariance_px2,
        corner_std_xy_px=tuple((float(x), float(y)) for x, y in std),
    )  # fmt: skip


def corner_correction(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], min_windows: int = _MIN_WINDOWS
) -> CornerFit | None:
    """Fit the correction of a mapping's homography to the residual that was measured with this mapping.

    The windows are converted to undistorted px of the reference (width, height). None if fewer than `min_windows`
    windows are measured.
    """
    measured = np.isfinite(residual.shifts_px[:, 0])
    if measured.sum() < min_windows:
        return None
    centres_px, shifts_px = residual.centres_px[measured], residual.shifts_px[measured]
    points_px, shifted_px = (mapping.undistorted(p) for p in (centres_px, centres_px + shifts_px))
    return fit_corners(points_px, shifted_px - points_px, residual.peaks_sigma[measured], size_px)


def fit_corners(points_px: Array, shifts_px: Array, peaks_sigma: Array, size_px: tuple[int, int]) -> CornerFit:
    """Fit corner displacements to shifts (n, 2) at points (n, 2) of an image (width, height) by robust least squares.

    Weights are the fourth power of the heights (n,) of the correlation peaks times Cauchy weights.
    """
    design = geometry.over_corners(points_px, *size_px)
    by_peak, robust = (peaks_sigma / np.median(peaks_sigma)) ** 4, np.ones(len(shifts_px))
    for _ in range(_REWEIGHTINGS):
        weight = by_peak * robust
        normal = np.einsum("n,nki,nkj->ij", weight, design, design)
        mean = np.linalg.lstsq(normal, np.einsum("n,nki,nk->i", weight, design, shifts_px), rcond=None)[0]
        residuals_px = shifts_px - design @ mean
        lengths_px = np.linalg.norm(residuals_px, axis=1)
        robust = cauchy_weights(lengths_px, _CAUCHY_SCALES * shift_scale_px(lengths_px))
    score = np.einsum("n,nki,nk->ni", weight, design, residuals_px)
    # Collinear windows do not determine all corners, although their residuals are small.
    inverse = np.linalg.inv(normal + _MIN_INFORMATION_SHARE * np.trace(normal) * np.eye(8))
    sandwich = inverse @ (score.T @ score) @ inverse
    covariance = np.asarray(sandwich + (MIN_SHIFT_SCALE_PX**2 / np.median(weight)) * inverse)
    return CornerFit(mean, covariance + _COMMON_STD_PX**2 * np.eye(8))
