"""Fits of one band to the shifts of windows. The model of the geometry, also that of `adjustment`, is linear.

The shift of window i in band b, in undistorted px of the reference, is

    s_ib = D(x_i) delta_b + N(x_i) f_b + t_b z_i + noise

delta_b (8,) corrects the band's homography at the image corners and D is their Jacobian. f_b (4,) are the coefficients
of the lens shapes N: the smooth displacement by which the distortions of two lenses differ, to first order of the
Brown-Conrady model, which a homography only approximates where it is fitted. t_b (2,) is the band's baseline and z_i
the parallax of the window, which is common to all bands.

A single band is fitted without parallax or with a known one. Cauchy weights reduce the influence of wrong correlation
peaks and of windows across depth edges.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.fit.held_out import Folds, held_out, remaining
from agalign.fit.windows import Shifts
from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.least_squares import Robust, least_squares, shift_scale_px
from agalign.values.lens_shapes import CORNERS, jacobian, lens_shapes, shift_variance_px2
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax
from agalign.values.residual import Residual

Array = NDArray[np.float64]

NODE_STEP_PX = 48
"""Spacing of the nodes of a displacement field of lenses, as their distortion varies over hundreds of pixels."""
CAUCHY_SCALES = 2.0
"""Residual of a window at which its robust weight is one half, in residual scales."""
CORNER_STD_PX = 5.0
"""Prior of the displacement of a corner: the error of an extrapolated affine mapping."""
_COMMON_STD_PX = 0.01
"""Error that is common to all windows; their residuals do not contain it."""
_MIN_FITTED_WINDOWS = 12
"""Without a prior: 1.5 times the eight parameters of a homography."""


class BaselinePrior(NamedTuple):
    """What is known of the baseline of a band before it is fitted."""

    mean: tuple[float, float] = (0.0, 0.0)
    std: float = 1.0
    """Standard deviation of each coordinate: by default that of the lenses themselves."""


@dataclass(frozen=True)
class WindowFit:
    """The geometry of one band that fits windows: a correction of its mapping, px of the reference."""

    corners_px: Array
    """(8,) displacements x and y of the corners in turn, clockwise from the top left."""
    residuals_px: Array
    """(n,) lengths of the residuals: of the measured windows by `fit_windows`, of all with NaN by `adjust`."""
    size_px: tuple[int, int]
    covariance_px2: Array
    """(8, 8), or (12, 12) with the lens shapes."""
    lens_px: Array | None = None
    """(4,) coefficients of the lens shapes; None if they were not fitted."""
    baseline: Array | None = None
    """(2,) t_b; None without parallax."""
    baseline_std: float = 0.0
    """Standard error of t_b, x and y together, px per px of parallax."""

    @classmethod
    def of(
        cls, mean: Array, residuals_px: Array, size_px: tuple[int, int], covariance: Array, count: int
    ) -> "WindowFit":
        """Split parameters and their covariance into corners and lens shapes, `count` together, and baseline."""
        corners_px, lens_px, baseline = np.split(mean, [CORNERS, count])
        lens, t = (None if not len(part) else part for part in (lens_px, baseline))
        covariance_px2 = covariance[:count, :count] + _COMMON_STD_PX**2 * np.eye(count)
        baseline_std = math.sqrt(np.trace(covariance[count:, count:]))
        return cls(corners_px, residuals_px, size_px, covariance_px2, lens, t, baseline_std)

    @property
    def max_px(self) -> float:
        """Maximum displacement of a corner along x or y."""
        return float(np.abs(self.corners_px).max())

    def applied_to(self, mapping: PixelMapping) -> PixelMapping:
        """Correct a homography; lens shapes and baseline replace those of the mapping. Raises GeometryError."""
        corners = geometry.moving_corners(self.corners_px, *self.size_px)
        mapping = replace(mapping, fixed_to_moving=geometry.compose(mapping.fixed_to_moving, corners))
        if self.lens_px is not None:
            lens_px = self.lens_px

            def displaced_px(points_px: Points) -> Points:
                return np.asarray(lens_shapes(points_px, self.size_px) @ lens_px)

            mapping = replace(mapping, field=DisplacementField.sampled(displaced_px, NODE_STEP_PX, self.size_px))
        if self.baseline is not None and mapping.parallax is not None:
            x, y = self.baseline.tolist()
            mapping = mapping.with_parallax(Parallax(mapping.parallax.relief, (x, y)))
        return mapping


def fit_windows(
    mapping: PixelMapping,
    residual: Residual,
    size_px: tuple[int, int],
    lens_std_px: Array | None = None,
    *,
    baseline: BaselinePrior | None = None,
    start: PixelMapping | None = None,
) -> WindowFit | None:
    """Fit the correction of a mapping of a reference (width, height) to the residual measured with this mapping.

    With the standard deviations `lens_std_px` (4,) of the lens shapes, these are fitted too, and the homography has a
    prior around that of `start`, by default of the mapping itself. With the prior of its `baseline`, that along which
    the band sees the relief of the mapping is fitted too. Without lens shapes, the result is None if fewer than 12
    windows are measured. A window's weight is that of its correlation peak times a Cauchy weight.
    """
    raw = Shifts.of(residual)
    if lens_std_px is None and len(raw.centres_px) < _MIN_FITTED_WINDOWS:
        return None
    points_px, shifted_px = (mapping.undistorted(p) for p in (raw.centres_px, raw.centres_px + raw.shifts_px))
    shifts_px, std_px, with_shapes = shifted_px - points_px, np.full(CORNERS, np.inf), lens_std_px is not None
    if lens_std_px is not None:
        std_px = np.r_[np.full(CORNERS, CORNER_STD_PX), lens_std_px]
    count = len(std_px)
    design = jacobian(points_px, size_px, count)
    mean = np.zeros(count)
    if start is not None:
        to_start = geometry.compose(geometry.invert(mapping.fixed_to_moving), start.fixed_to_moving)
        at_corners = geometry.corners(*size_px)
        mean[:CORNERS] = (geometry.apply(to_start, at_corners) - at_corners).ravel()
    if baseline is not None and mapping.parallax is not None:
        parallax_px = mapping.parallax.relief(raw.centres_px)
        shifts_px = shifts_px + parallax_px[:, None] * np.array(mapping.parallax.baseline)
        design, std_px = with_parallax(design, parallax_px), np.r_[std_px, [baseline.std] * 2]
        mean = np.r_[mean, baseline.mean]
    robust = Robust(CAUCHY_SCALES, shift_scale_px, partial(shift_variance_px2, with_shapes=with_shapes))
    estimate = least_squares(design, shifts_px, raw.weights, np.diag(std_px**-2.0), mean, robust=robust)
    # Each parameter without a prior takes a degree of freedom from the residuals.
    components, covariance = 2 * len(raw.centres_px), estimate.covariance
    if lens_std_px is None:
        covariance = components / (components - count) * covariance
    return WindowFit.of(estimate.mean, estimate.residuals, size_px, covariance, count)


def with_parallax(design: Array, parallax_px: Array) -> Array:
    """Append the derivatives with respect to the baseline to a design (n, 2, p) for windows with a parallax (n,)."""
    return np.concatenate([design, parallax_px[:, None, None] * np.eye(2)], axis=2)


def fit_in_rounds(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual],
    size_px: tuple[int, int],
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    rounds: int = 4,
    *,
    baseline: BaselinePrior | None = None,
    max_moved_px: float = math.inf,
) -> tuple[PixelMapping, WindowFit] | None:
    """Correct a mapping repeatedly by the residual that `measure` returns for it; return it and the last correction.

    Peaks are sharper when windows overlap better, and a correction is accurate to first order.
    Other arguments are those of `fit_windows`. None if a correction does not exist or is not accepted, or if all
    together move a corner by more than `max_moved_px`, px of the reference. Lens shapes are always fitted to a
    mapping with the given displacement field, and replace it in the result.
    """
    start, result = mapping, None
    for _ in range(rounds):
        fit = fit_windows(mapping, measure(mapping), size_px, lens_std_px, baseline=baseline, start=start)
        if fit is None or not is_accepted(fit):
            return None
        try:
            result = fit.applied_to(mapping), fit
        except GeometryError:
            return None
        moved = geometry.compose(geometry.invert(start.fixed_to_moving), result[0].fixed_to_moving)
        if not geometry.corner_error_px(moved, geometry.identity(), *size_px) <= max_moved_px:
            return None
        converged_px, change_px = 0.02, fit.max_px  # noise of the windows
        if fit.baseline is not None and mapping.parallax is not None:
            change = np.linalg.norm(fit.baseline - mapping.parallax.baseline)
            change_px = max(change_px, float(change) * mapping.parallax.relief.rms_px)
        if change_px <= converged_px:
            break
        mapping = replace(result[0], field=mapping.field)
    return result


class CrossFit(NamedTuple):
    """A mapping that is fitted to all windows, and what verifies it."""

    mapping: PixelMapping
    fit: WindowFit
    """The last correction."""
    at_start: Residual
    """The windows under the first mapping."""
    held_out: Residual
    """Each window under the mapping that is fitted without its fold."""


def cross_fitted(
    mapping: PixelMapping,
    measure: Callable[[PixelMapping], Residual],
    size_px: tuple[int, int],
    folds_of: Callable[[Residual], Folds],
    side_px: float,
    *,
    is_accepted: Callable[[WindowFit], bool] = lambda _: True,
    lens_std_px: Array | None = None,
    max_moved_px: float = math.inf,
) -> CrossFit | None:
    """Correct a mapping by `fit_in_rounds`, and by the last measurement again without each fold of its windows.

    `side_px` is the side of the windows, px of the reference; the other arguments are those of `fit_in_rounds`. None if
    that returns None, or if the windows without a fold do not determine the mapping.
    """
    measured: list[tuple[PixelMapping, Residual]] = []

    def measured_at(at: PixelMapping) -> Residual:
        measured.append((at, measure(at)))
        return measured[-1][1]

    fitted = fit_in_rounds(mapping, measured_at, size_px, is_accepted, lens_std_px, max_moved_px=max_moved_px)
    if fitted is None:
        return None
    last, residual = measured[-1]
    folds = folds_of(residual)
    parts = remaining(residual, folds, side_px)
    fits = [fit_windows(last, part, size_px, lens_std_px, start=mapping) for part in parts]
    try:
        by_fold = [fit.applied_to(last) for fit in fits if fit is not None]
    except GeometryError:  # the windows are degenerate without a fold
        return None
    if len(by_fold) < len(fits):
        return None
    return CrossFit(*fitted, measured[0][1], held_out(residual, last, folds, by_fold))
