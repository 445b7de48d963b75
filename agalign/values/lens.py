"""Lens models: conversion between raw pixels of a file and pixels without lens distortion.

Brown-Conrady in OpenCV's convention, on normalised coordinates x = (u - cx) / fx, y = (v - cy) / fy, r^2 = x^2 + y^2:

    radial = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    x_d = x radial + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y radial + p1 (r^2 + 2 y^2) + 2 p2 x y

The undistorted image has the camera matrix K of the raw one. Fisheye lenses are converted to this model; within the
field of view of drone cameras the error is below 0.01 px (`radial_coefficients`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from pydantic import dataclasses as validated

from agalign.values.fields import RECORD, Number
from agalign.values.geometry import Matrix, Points
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size


@validated.dataclass(frozen=True, config=RECORD)
class Lens:
    """Lens model for raw pixels: x_px = fx * x / z + cx, after Brown-Conrady distortion."""

    fx_px: Number
    """Focal length."""
    fy_px: Number
    """Focal length."""
    cx_px: Number
    """Principal point."""
    cy_px: Number
    """Principal point."""
    distortion: tuple[Number, ...] = ()
    """k1, k2, p1, p2, k3, k4, k5, k6; omitted ones are 0."""

    @property
    def matrix(self) -> Matrix:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def is_plausible(self, size_px: Size) -> bool:
        """Return False for values that no camera has, or not for images of this size, as after resizing: focal lengths
        beyond 0.1 to 1000 times the longer side, an optical centre farther than a tenth of it from the middle of the
        image, where cameras have up to 0.02, and coefficients above 1000.
        """
        side_px = max(size_px)
        is_focused = all(0.1 < focal_px / side_px < 1000 for focal_px in (self.fx_px, self.fy_px))
        from_middle_px = self.cx_px - size_px[0] / 2, self.cy_px - size_px[1] / 2
        is_near = all(abs(distance_px) < side_px / 10 for distance_px in from_middle_px)
        return is_focused and is_near and all(abs(k) < 1000 for k in self.distortion)


def is_distorting(lens: Lens | None) -> bool:
    """True where raw and undistorted pixels differ."""
    return lens is not None and any(lens.distortion)


def distort(lens: Lens | None, undistorted_px: ArrayLike) -> Points:
    """Return the raw positions of undistorted ones, both (..., 2) px; None is a lens without distortion."""
    points = np.asarray(undistorted_px, dtype=np.float64)
    if lens is None or not is_distorting(lens):
        return points
    return np.stack(distorted(lens, points[..., 0], points[..., 1]), axis=-1)


def distorted(lens: Lens, u: Any, v: Any) -> tuple[Any, Any]:
    """`distort` on separate coordinates, for anything with arithmetic: arrays or tensors."""
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(lens)
    x, y = (u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    x_d = x * radial + (2.0 * p1) * xy + p2 * (r2 + 2.0 * xx)
    y_d = y * radial + p1 * (r2 + 2.0 * yy) + (2.0 * p2) * xy
    return lens.fx_px * x_d + lens.cx_px, lens.fy_px * y_d + lens.cy_px


def undistort(lens: Lens | None, raw_px: ArrayLike) -> Points:
    """Return the undistorted positions of raw ones, both (..., 2) px: the inverse of `distort`, by iteration."""
    points = np.asarray(raw_px, dtype=np.float64)
    if lens is None or not is_distorting(lens) or points.size == 0:
        return points
    flat = np.ascontiguousarray(points.reshape(-1, 1, 2))
    coefficients = np.array(_eight(lens))
    until = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-12
    undistorted = cv2.undistortPoints(flat, lens.matrix, coefficients, P=lens.matrix, criteria=until)
    return np.asarray(undistorted, dtype=np.float64).reshape(points.shape)


def rescaled(lens: Lens | None, scale: PixelScale) -> Lens | None:
    """The same lens on an image that is resized by `scale`."""
    if lens is None or scale == SAME_PIXELS:
        return lens
    cx_px, cy_px = scale.positions((lens.cx_px, lens.cy_px)).tolist()
    return replace(lens, fx_px=lens.fx_px * scale.x, fy_px=lens.fy_px * scale.y, cx_px=cx_px, cy_px=cy_px)


def radial_coefficients(distorted_radius: Callable[[Points], Points], max_radius: float) -> tuple[float, ...]:
    """Return the distortion (k1, k2, 0, 0, k3, k4, k5, k6) of a lens with distorted radius `distorted_radius(r)`.

    r is the distance from the optical axis in focal lengths, and the fit is for r up to `max_radius`. The equation
    distorted_radius(r) / r (1 + k4 r^2 + k5 r^4 + k6 r^6) = 1 + k1 r^2 + k2 r^4 + k3 r^6 is linear in k.
    """
    r = np.linspace(max_radius / 256, max_radius, 256)
    ratio = distorted_radius(r) / r
    powers = np.stack([r**2, r**4, r**6], axis=1)
    k = np.linalg.lstsq(np.hstack([powers, -ratio[:, None] * powers]), ratio - 1.0, rcond=None)[0]
    k1, k2, k3, k4, k5, k6 = k.tolist()
    return k1, k2, 0.0, 0.0, k3, k4, k5, k6


def _eight(lens: Lens) -> tuple[float, float, float, float, float, float, float, float]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.distortion, *(0.0,) * 8)[:8]
    return k1, k2, p1, p2, k3, k4, k5, k6
