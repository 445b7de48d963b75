"""Robust fit of a homography, by itself or with lens shapes, to the shifts of windows.

    s_i = D(x_i) m + noise        m = N(0, P^-1)

s_i is the shift of the window at x_i, m are the displacements of the image's corners and the coefficients of the lens
shapes, D is their Jacobian. The maximum a posteriori estimate is computed by iteratively reweighted least squares.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx
from agalign.values.robust import MIN_SHIFT_SCALE_PX, cauchy_weights, shift_scale_px
from agalign.verify.lens_shapes import lens_shapes, over_corners_and_lens, variance_px2

Array = NDArray[np.float64]

_MIN_WINDOWS = 12
"""Minimum number of windows for parameters without a prior: 1.5 times the eight of a homography."""
_CORNER_STD_PX = 5.0
"""Standard deviation of the prior of a corner, with lens shapes only: the error of an extrapolated affine mapping."""
_MIN_INFORMATION_SHARE = 1e-12
"""Share of the total information that is added to directions that no window determines, as with windows on a line."""
_CAUCHY_SCALES = 2.0
"""Residual at which the robust weight is one half, in residual scales."""
_REWEIGHTINGS = 6
"""Iterations after which the robust weights have converged."""
_AXIS_SHARE = 1 / 3
"""Variance along one axis over the square of the scale of lengths: normally distributed vectors have 1 / 3.05."""
_EXTRAPOLATION_FACTOR = 12.0
"""Factor on the variance of windows in a fit with lens shapes: it extrapolates errors by relief, which neighbouring
windows have in common."""
_COMMON_STD_PX = 0.01
"""Standard error along x and y common to all windows, which their residuals do not contain."""
_ROUNDS, _CONVERGED_PX = 4, 0.02
"""Rounds of warping and fitting, until no corner moves by more than the noise of the windows: peaks are sharper when
windows overlap better, and a correction is accurate to first order."""
_NODE_STEP_PX = 48
"""Spacing of the nodes of a displacement field."""


@dataclass(frozen=True)
class WindowFit:
    """Displacements of the corners and coefficients of lens shapes, fitted to windows, px of the reference."""

    mean_px: Array
    """(8,) x and y of the corners in turn, clockwise from the top left; (12,) with the four shapes."""
    covariance_px2: Array
    """(8, 8) or (12, 12)"""
    residuals_px: Array
    """(n,) lengths of the residuals of the windows."""
    size_px: tuple[int, int]

    @property
    def max_px(self) -> float:
        """Maximum displacement of a corner along x or y."""
        return float(np.abs(self.mean_px[:8]).max())

    def std_px(self, points_px: Points) -> float:
        """Return the RMS error over points (n, 2), including the residual of single windows."""
        of_mapping_px2 = variance_px2(points_px, self.covariance_px2, self.size_px).mean()
        return float(np.sqrt(of_mapping_px2 + shift_scale_px(self.residuals_px) ** 2))

    def applied_to(self, mapping: PixelMapping) -> PixelMapping:
        """Correct a homography; lens shapes become the mapping's displacement field. Raises GeometryError."""
        corners = geometry.moving_corners(self.mean_px[:8], *self.size_px)
        corrected = replace(mapping, fixed_to_moving=geometry.compose(mapping.fixed_to_moving, corners))
        if len(self.mean_px) == 8:
            return corrected
        return replace(corrected, local=DisplacementField.sampled(
            lambda nodes: lens_shapes(nodes, self.size_px) @ self.mean_px[8:], _NODE_STEP_PX, self.size_px
        ))  # fmt: skip


def fit_windows(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], lens_std_px: Array | None = None
) -> WindowFit | None:
    """Fit the correction of a mapping of a reference (width, height) to the residual measured with this mapping.

    With the standard deviations `lens_std_px` (4,) of the lens shapes, these are fitted too. Without, the result is
    None if fewer than 12 windows are measured. A window's weight is the fourth power of its correlation peak times a
    Cauchy weight.
    """
    measured = np.isfinite(residual.shifts_px[:, 0])
    if lens_std_px is None and measured.sum() < _MIN_WINDOWS:
        return None
    centres_px, peaks_sigma = residual.centres_px[measured], residual.peaks_sigma[measured]
    points_px, shifted_px = (mapping.undistorted(p) for p in (centres_px, centres_px + residual.shifts_px[measured]))
    shifts_px = shifted_px - points_px
    if lens_std_px is None:
        design, std_px, factor = geometry.over_corners(points_px, *size_px), np.full(8, np.inf), 1.0
    else:
        design, factor = over_corners_and_lens(points_px, size_px), _EXTRAPOLATION_FACTOR
        std_px = np.r_[np.full(8, _CORNER_STD_PX), lens_std_px]
    by_peak = (peaks_sigma / np.median(peaks_sigma)) ** 4 if len(peaks_sigma) else peaks_sigma
    weights, residuals_px, scale_px = by_peak, np.zeros(len(shifts_px)), MIN_SHIFT_SCALE_PX
    for _ in range(_REWEIGHTINGS):
        information = weights / (factor * _AXIS_SHARE * scale_px**2 + MIN_SHIFT_SCALE_PX**2)
        normal = np.einsum("n,nki,nkj->ij", information, design, design) + np.diag(std_px**-2.0)
        covariance = np.linalg.inv(normal + _MIN_INFORMATION_SHARE * np.trace(normal) * np.eye(len(normal)))
        mean = covariance @ np.einsum("n,nki,nk->i", information, design, shifts_px)
        residuals_px = np.linalg.norm(shifts_px - design @ mean, axis=1)
        scale_px = shift_scale_px(residuals_px)
        weights = by_peak * cauchy_weights(residuals_px, _CAUCHY_SCALES * scale_px)
    return WindowFit(mean, covariance + _COMMON_STD_PX**2 * np.eye(len(mean)), residuals_px, size_px)


def fit_in_rounds(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual[FixedPx]],
    size_px: tuple[int, int],
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    rounds: int = _ROUNDS,
) -> tuple[PixelMapping, WindowFit] | None:
    """Correct a mapping repeatedly by the residual that `measure` returns for it; return it and the last correction.

    Other arguments are those of `fit_windows`. None if a correction does not exist or is not accepted. Lens shapes are
    always fitted to a mapping with the given displacement field, and replace it in the result.
    """
    result: tuple[PixelMapping, WindowFit] | None = None
    for _ in range(rounds):
        fit = fit_windows(mapping, measure(mapping), size_px, lens_std_px)
        if fit is None or not is_accepted(fit):
            return None
        try:
            result = fit.applied_to(mapping), fit
        except GeometryError:
            return None
        if fit.max_px <= _CONVERGED_PX:
            break
        mapping = replace(result[0], local=mapping.local)
    return result
