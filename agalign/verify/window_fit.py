"""Robust fit of a homography, by itself or with lens shapes, to the shifts of windows.

    s_i = D(x_i) m + noise        m = N(0, P^-1)

s_i is the shift of the window at x_i, m are the displacements of the image's corners and the coefficients of the lens
shapes, D is their Jacobian. The maximum a posteriori estimate is computed by iteratively reweighted least squares.

The lens shapes model the smooth displacement by which the distortions of two lenses differ: the Brown-Conrady model to
first order. A homography approximates it in the part of the image to which it is fitted.
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
from agalign.values.robust import MIN_SHIFT_SCALE_PX, shift_scale_px
from agalign.verify.residuals import Shifts

Array = NDArray[np.float64]

LENS_STD = (1.3e-3, 0.7e-3, 1.2e-3, 1.2e-3)
"""Standard deviation of each shape at the corners, as a share of half the diagonal. The lenses of 28 band pairs of six
cameras (RedEdge-3, RedEdge-M, RedEdge-MX dual, Sequoia; calibrations in the tags) differ by 1.0, 0.6, 1.0 and 1.0 px
at 800 px from the centre."""
CALIBRATED = 0.4
"""Factor on LENS_STD if both lenses are calibrated; measured on reference tie points of 45 RedEdge pairs."""
CAUCHY_SCALES, REWEIGHTINGS = 2.0, 6
"""Residual at which the robust weight is one half, in residual scales, and iterations after which it has converged;
also of fits of the relief, of the rig and of the MAP estimate."""
NODE_STEP_PX = 48
"""Spacing of the nodes of a displacement field of lenses, as their distortion varies over hundreds of pixels."""


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

        def lens_px(points_px: Points) -> Points:
            return np.asarray(lens_shapes(points_px, self.size_px) @ self.mean_px[8:])

        return replace(corrected, field=DisplacementField.sampled(lens_px, NODE_STEP_PX, self.size_px))


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


def lens_std_px(size_px: tuple[int, int], *, calibrated: bool) -> Array:
    """Return (4,) the standard deviation of each shape on an image (width, height), px."""
    return np.array(LENS_STD) * float(np.hypot(*size_px)) / 2 * (CALIBRATED if calibrated else 1.0)


def jacobian(points_px: Points, size_px: tuple[int, int], parameters: int = 12) -> Array:
    """Return (n, 2, 8 or 12) the derivative of displacements of points by those of the corners, and by lens shapes."""
    of_corners = geometry.over_corners(points_px, *size_px)
    return of_corners if parameters == 8 else np.concatenate([of_corners, lens_shapes(points_px, size_px)], axis=2)


def variance_px2(points_px: Points, covariance_px2: Array, size_px: tuple[int, int]) -> Array:
    """Return (n,) the variance at points (n, 2) by the covariance of the corners (8, 8), or with shapes (12, 12)."""
    design = jacobian(points_px, size_px, len(covariance_px2))
    return np.asarray(np.einsum("nki,ij,nkj->n", design, covariance_px2, design))


def fit_windows(
    mapping: PixelMapping, residual: Residual[FixedPx], size_px: tuple[int, int], lens_std_px: Array | None = None
) -> WindowFit | None:
    """Fit the correction of a mapping of a reference (width, height) to the residual measured with this mapping.

    With the standard deviations `lens_std_px` (4,) of the lens shapes, these are fitted too. Without, the result is
    None if fewer than 12 windows are measured. A window's weight is that of its correlation peak times a Cauchy weight.
    """
    raw = Shifts.of(residual)
    min_windows = 12  # without a prior: 1.5 times the eight parameters of a homography
    if lens_std_px is None and len(raw.centres_px) < min_windows:
        return None
    points_px, shifted_px = (mapping.undistorted(p) for p in (raw.centres_px, raw.centres_px + raw.shifts_px))
    shifts = raw._replace(centres_px=points_px, shifts_px=shifted_px - points_px)
    std_px, factor = np.full(8, np.inf), 1.0
    if lens_std_px is not None:
        corner_std_px = 5.0  # error of an extrapolated affine mapping
        std_px = np.r_[np.full(8, corner_std_px), lens_std_px]
        # Lens shapes extrapolate errors by relief, which neighbouring windows have in common.
        factor = 12.0
    design = jacobian(points_px, size_px, len(std_px))
    weighted, scale_px = shifts, MIN_SHIFT_SCALE_PX
    axis_share = 1 / 3  # variance along one axis over the squared scale of lengths; normally distributed: 1 / 3.05
    min_information_share = 1e-12  # for directions that no window determines, as with windows on a line
    for _ in range(REWEIGHTINGS):
        information = weighted.weights / (factor * axis_share * scale_px**2 + MIN_SHIFT_SCALE_PX**2)
        normal = np.einsum("n,nki,nkj->ij", information, design, design) + np.diag(std_px**-2.0)
        covariance = np.linalg.inv(normal + min_information_share * np.trace(normal) * np.eye(len(normal)))
        mean = covariance @ np.einsum("n,nki,nk->i", information, design, shifts.shifts_px)
        scale_px = shift_scale_px(shifts.distances_px(design @ mean))
        weighted = shifts.reweighted(design @ mean, CAUCHY_SCALES)
    common_std_px = 0.01  # common to all windows; their residuals do not contain it
    covariance += common_std_px**2 * np.eye(len(mean))
    return WindowFit(mean, covariance, shifts.distances_px(design @ mean), size_px)


def fit_in_rounds(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual[FixedPx]],
    size_px: tuple[int, int],
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    rounds: int = 4,
) -> tuple[PixelMapping, WindowFit] | None:
    """Correct a mapping repeatedly by the residual that `measure` returns for it; return it and the last correction.

    Peaks are sharper when windows overlap better, and a correction is accurate to first order.
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
        converged_px = 0.02  # noise of the windows
        if fit.max_px <= converged_px:
            break
        mapping = replace(result[0], field=mapping.field)
    return result
