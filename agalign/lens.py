"""Between raw pixels and undistorted (pinhole) pixels of the same camera matrix.

Model: Brown-Conrady. With (x, y) = K^-1 (u, v) and r^2 = x^2 + y^2,
x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y_d likewise; raw = K (x_d, y_d).
The undistorted image keeps K and the size, so that a camera without distortion maps onto itself.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.records import Lens, Raster

Points = NDArray[np.float64]

_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)


def is_distorting(lens: Lens | None) -> bool:
    """True where the lens model moves pixels at all."""
    return lens is not None and any(lens.distortion)


def distort(lens: Lens | None, undistorted_px: ArrayLike) -> Points:
    """Raw pixel positions of undistorted ones, both (..., 2); the identity for a lens without distortion."""
    points = np.asarray(undistorted_px, dtype=np.float64)
    if lens is None or not is_distorting(lens):
        return points
    k1, k2, p1, p2, k3 = (*lens.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    x = (points[..., 0] - lens.cx_px) / lens.fx_px
    y = (points[..., 1] - lens.cy_px) / lens.fy_px
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_d = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_d = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([lens.fx_px * x_d + lens.cx_px, lens.fy_px * y_d + lens.cy_px], axis=-1)


def undistort(lens: Lens | None, raw_px: ArrayLike) -> Points:
    """Undistorted pixel positions of raw ones, both (..., 2): the inverse of `distort`, by iteration."""
    points = np.asarray(raw_px, dtype=np.float64)
    if lens is None or not is_distorting(lens):
        return points
    flat = np.ascontiguousarray(points.reshape(-1, 1, 2))
    coefficients = np.array((*lens.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5])
    undistorted = cv2.undistortPoints(flat, lens.matrix, coefficients, P=lens.matrix, criteria=_UNDISTORT_CRITERIA)
    return np.asarray(undistorted, dtype=np.float64).reshape(points.shape)


def undistort_raster(raster: Raster, lens: Lens | None) -> Raster:
    """The raster as a pinhole camera with the same K would have seen it (for estimation only)."""
    if lens is None or not is_distorting(lens):
        return raster
    width, height = raster.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    raw = distort(lens, np.stack([x, y], axis=-1)).astype(np.float32)
    pixels = cv2.remap(raster.pixels, raw, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    valid = cv2.remap(raster.valid.astype(np.uint8) * 255, raw, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return Raster(np.asarray(pixels, dtype=np.float32), np.asarray(valid == 255))
