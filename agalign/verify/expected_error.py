"""Expected error of a band at every pixel, from the uncertainty of its mapping and the residual shifts of windows."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.values import geometry
from agalign.values.alignment import Alignment, Residual
from agalign.values.geometry import Points
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.lens_shapes import variance_px2

_NEAREST_WINDOWS = 8
"""Number of windows from which the error at a point is estimated, weighted by their distance."""
_FAR_SPACINGS = 3.0
"""Range of distances beyond one spacing of windows over which p95 replaces the residuals of the nearest windows."""


def expected_error_px(
    alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points
) -> NDArray[np.float64]:
    """Return the expected RMS error, px, at points (n, 2) of the reference (width, height), raw px.

        error^2 = trace(D(x) C D(x)^T) + (1 - far) * local mean square + far * p95^2

    C is the covariance of the corners and D the Jacobian `geometry.over_corners`, with lens shapes if the mapping is
    extrapolated. For a band that is predicted by a rig, the first term is the squared standard error. The local mean
    square is that of the residual shifts of the nearest windows; `far` grows from 0 to 1 with the distance from them.
    Infinite where the error is unknown.
    """
    square = _mapping_px2(alignment, size_px, points_px)
    residual = alignment.residual
    if residual is None or not np.isfinite(residual.shifts_px[:, 0]).any():
        return np.sqrt(square)
    return np.asarray(np.sqrt(square + _windows_px2(residual, points_px)))


def _mapping_px2(alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points) -> NDArray[np.float64]:
    """Return the variance of the mapping at points, (n,)."""
    prediction, joint = alignment.prediction, alignment.joint
    if alignment.status == "predicted" and prediction is not None:
        if prediction.covariance_px2 is not None:
            return variance_px2(points_px, prediction.covariance_px2, size_px)
        # The standard error is in px of the moving file.
        ratio = abs(float(geometry.local_scale(alignment.fixed_to_moving, *size_px)[-1]))
        return np.full(len(points_px), (prediction.std_px / ratio) ** 2)
    if alignment.status != "aligned" or joint is None or joint.corner_covariance_px2 is None:
        return np.full(len(points_px), 0.0 if joint is None and alignment.status == "aligned" else np.inf)
    return variance_px2(points_px, joint.corner_covariance_px2, size_px)


def _windows_px2(residual: Residual[FixedFilePx], points_px: Points) -> NDArray[np.float64]:
    """Return the expected squared residual shift at points, (n,)."""
    measured = np.isfinite(residual.shifts_px[:, 0])
    centres, squares = residual.centres_px[measured], (residual.shifts_px[measured] ** 2).sum(axis=1)
    count = min(_NEAREST_WINDOWS, len(centres))
    distance, index = cKDTree(centres).query(points_px, k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    nearest, _ = cKDTree(residual.centres_px).query(residual.centres_px, k=min(2, len(residual.centres_px)))
    spacing = max(float(np.median(nearest.reshape(len(residual.centres_px), -1)[:, -1])), 1.0)
    weight = np.exp(-0.5 * (distance / spacing) ** 2) + 1e-12
    local_px2 = (weight * squares[index]).sum(axis=1) / weight.sum(axis=1)
    far = np.clip((distance[:, 0] / spacing - 1) / _FAR_SPACINGS, 0, 1)
    return np.asarray((1 - far) * local_px2 + far * max(residual.p95_px**2, float(squares.mean())))
