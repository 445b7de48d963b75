"""The expected error of a band at every pixel: from the uncertainty of its mapping, and from the residual of the
windows around.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.values import geometry
from agalign.values.alignment import Alignment, Residual
from agalign.values.geometry import Points
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.lens_shapes import over_corners_and_lens

_NEIGHBOURS = 8
"""Windows that the error at a place is estimated from, those nearer with more weight."""
_FAR_WINDOWS = 3.0
"""Distance from all windows, in units of their spacing, beyond which they do not show the ground."""


def expected_error_px(
    alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points
) -> NDArray[np.float64]:
    """Root mean square error to be expected at points (n, 2) of the reference (width, height), raw px, (n,).

        error^2 = trace of D(x) C D(x)^T + mean square of the windows around + (1 - near) p95^2

    with the covariance C of the corners and D as in `geometry.over_corners`, with the lens shapes where the mapping is
    extrapolated. For a band that a rig predicts, the first term is the square of its standard error. The weight of the
    windows falls with the distance; far from all of them the plane may miss the ground by as much as it does in the
    worst twentieth of the windows. Infinite where nothing is known.
    """
    square = _of_the_mapping(alignment, size_px, points_px)
    residual = alignment.residual
    if residual is None or not np.isfinite(residual.shifts_px[:, 0]).any():
        return np.sqrt(square)
    return np.asarray(np.sqrt(square + _of_the_windows(residual, points_px)))


def _of_the_mapping(
    alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points
) -> NDArray[np.float64]:
    if alignment.status == "predicted" and alignment.prediction is not None:
        # A standard error is in px of the moving file.
        ratio = abs(float(geometry.local_scale(alignment.fixed_to_moving, *size_px)[-1]))
        if alignment.prediction.covariance_px2 is not None:
            over = over_corners_and_lens(points_px, size_px)
            return np.asarray(np.einsum("nki,ij,nkj->n", over, alignment.prediction.covariance_px2, over))
        return np.full(len(points_px), (alignment.prediction.std_px / ratio) ** 2)
    joint = alignment.joint
    if alignment.status != "aligned" or joint is None or joint.corner_covariance_px2 is None:
        return np.full(len(points_px), 0.0 if joint is None and alignment.status == "aligned" else np.inf)
    over = geometry.over_corners(points_px, *size_px)
    return np.asarray(np.einsum("nki,ij,nkj->n", over, joint.corner_covariance_px2, over))


def _of_the_windows(residual: Residual[FixedFilePx], points_px: Points) -> NDArray[np.float64]:
    some = np.isfinite(residual.shifts_px[:, 0])
    centres, squares = residual.centres_px[some], (residual.shifts_px[some] ** 2).sum(axis=1)
    count = min(_NEIGHBOURS, len(centres))
    distance, which = cKDTree(centres).query(points_px, k=count)
    distance, which = distance.reshape(-1, count), which.reshape(-1, count)
    all_apart, _ = cKDTree(residual.centres_px).query(residual.centres_px, k=min(2, len(residual.centres_px)))
    apart = max(float(np.median(all_apart.reshape(len(residual.centres_px), -1)[:, -1])), 1.0)
    nearness = np.exp(-0.5 * (distance / apart) ** 2) + 1e-12
    around = (nearness * squares[which]).sum(axis=1) / nearness.sum(axis=1)
    far = np.clip((distance[:, 0] / apart - 1) / _FAR_WINDOWS, 0, 1)
    return np.asarray((1 - far) * around + far * max(residual.p95_px**2, float(squares.mean())))
