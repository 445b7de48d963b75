"""Expected error of a mapping at any point: its covariance, unknown lenses, and what the windows show beyond it."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.fit.window_fit import lens_shapes, lens_shift_variance_px2, variance_px2
from agalign.fit.windows import window_spacing_px
from agalign.values import geometry
from agalign.values.alignment import Alignment, Residual, noise_px
from agalign.values.geometry import Points
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.parallax import Parallax

MIN_COMMON_COVERAGE = 0.3
"""Minimum share of the windows with a measured shift; in a band of noise, a tenth has one by chance."""
_COMMON_ERROR_FACTOR = 12.0
"""Factor on the variance of a mapping where it is extrapolated: the errors that neighbouring windows and patches have
in common average out between them only."""
_LATTICE = 24, 18
"""Columns and rows of the points of an image at which its coverage and the lens distortion are evaluated."""


def points_in_frame(mapping: PixelMapping, size_px: tuple[int, int], moving_size_px: tuple[int, int]) -> Points:
    """Return the points (n, 2) of a grid over the reference that are mapped into the moving image.

    Sizes are (width, height).
    """
    points_px = geometry.lattice(*size_px, *_LATTICE)
    mapped = mapping(points_px)
    return points_px[((mapped >= -0.5) & (mapped <= np.subtract(moving_size_px, 0.5))).all(axis=1)]


def unobserved_quarters(centres_px: Points, size_px: tuple[int, int], in_frame_px: Points | None = None) -> list[str]:
    """Return the quarters of an image (width, height) with fewer than two of the centres (n, 2).

    `in_frame_px` are the points of the image that the moving image covers, all of them by default.
    """
    lattice = geometry.lattice(*size_px, *_LATTICE)
    covered = lattice if in_frame_px is None else in_frame_px
    # Names, and signs of x and y relative to the centre.
    quarters = (("top left", -1, -1), ("top right", 1, -1), ("bottom right", 1, 1), ("bottom left", -1, 1))

    def count(points_px: Points, *signs: int) -> int:
        size = np.array(size_px, dtype=np.float64)
        from_centre = (points_px - (size - 1) / 2) / size * signs
        # With windows nearer to the image's axes only, most of a quarter would still be extrapolated.
        min_share_of_side = 1 / 8
        return int((from_centre > min_share_of_side).all(axis=1).sum())

    min_share_in_frame = 0.5  # of a quarter's points; others are not checked
    min_windows = 2  # a single one may be a wrong peak
    return [
        name
        for name, *signs in quarters
        if count(covered, *signs) >= min_share_in_frame * count(lattice, *signs)
        and count(centres_px, *signs) < min_windows
    ]


def unmodelled_std_px(residual: Residual, size_px: tuple[int, int], lens_std_px: NDArray[np.float64]) -> float:
    """Return the RMS lens distortion, px, that a homography fitted to the windows of a residual does not model.

    It is averaged over the whole image (width, height). `lens_std_px` (4,) are the standard deviations of the lens
    shapes, which the windows limit.
    """
    covariance_px2 = _with_lenses(np.zeros((8, 8)), residual, size_px, lens_std_px)
    return float(np.sqrt(variance_px2(geometry.lattice(*size_px, *_LATTICE), covariance_px2, size_px).mean()))


def expected_error_px(alignment: Alignment, size_px: tuple[int, int], points_px: Points) -> NDArray[np.float64]:
    """Return the expected RMS error, px, at points (n, 2) of the reference (width, height), raw px.

    By `error_px` for a band that is aligned or predicted by windows. The mapping by a rig has the standard error of the
    prediction instead of the first term. Infinite where the error is unknown.
    """
    prediction, joint, residual = alignment.prediction, alignment.joint, alignment.residual
    parallax, lens_std_px = alignment.mapping.parallax, alignment.lens_std_px
    if alignment.status == "predicted" and prediction is not None:
        if prediction.covariance_px2 is not None:
            return error_px(prediction.covariance_px2, residual, size_px, points_px, parallax=parallax)
        if prediction.source != "windows" or joint is None:
            # The standard error is in px of the moving file.
            std_px = prediction.std_px / geometry.magnification(alignment.fixed_to_moving, *size_px)
            is_lost = residual is None or residual.coverage < MIN_COMMON_COVERAGE
            result = error_px(None, None if is_lost else residual, size_px, points_px, parallax=parallax)
            return np.asarray(np.hypot(result, std_px))
    elif alignment.status != "aligned":
        return np.full(len(points_px), np.inf)
    return error_px(
        None if joint is None else joint.covariance_px2,
        residual,
        size_px,
        points_px,
        lens_std_px=lens_std_px,
        field=alignment.mapping.field,
        parallax=parallax,
        relief_std_px=alignment.relief_std_px,
    )


def error_px(
    covariance_px2: NDArray[np.float64] | None,
    residual: Residual | None,
    size_px: tuple[int, int],
    points_px: Points,
    *,
    lens_std_px: NDArray[np.float64] | None = None,
    field: DisplacementField | None = None,
    parallax: Parallax | None = None,
    relief_std_px: float = 0.0,
) -> NDArray[np.float64]:
    """Return the expected RMS error (n,) of a mapping at points (n, 2) of the reference (width, height).

        error^2 = trace(D(x) C D(x)^T) + max(u(x)^2, variance of the parallax)

    C is the covariance of the corners (8, 8), or with the lens shapes (12, 12), and D the Jacobian
    `window_fit.jacobian`. With the standard deviations `lens_std_px` (4,) of unknown lens shapes, C contains what the
    windows leave unknown of them. `relief_std_px` is the spread of the relief that a mapping without one lacks where no
    window is near. u is the displacement that the model does not contain, by the residual shifts of the
    nearest windows beyond their noise.
    """
    square = np.zeros(len(points_px))
    is_measured = residual is not None and len(residual.measured_px) > 0
    far = _far(residual, points_px) if residual is not None and is_measured else np.zeros(len(points_px))
    if covariance_px2 is not None:
        if lens_std_px is not None and residual is not None and is_measured:
            covariance_px2 = _with_lenses(covariance_px2, residual, size_px, lens_std_px)
        square = square + variance_px2(points_px, covariance_px2, size_px) * (1 + far * (_COMMON_ERROR_FACTOR - 1))
    unmodelled_px2 = np.zeros(len(points_px))
    if residual is not None and is_measured:
        unmodelled_px2 = _unmodelled_px2(residual, points_px, far)
        if field is not None:  # between the windows it is known, elsewhere it continues by chance
            displacements_px = field(residual.measured_px)
            square = square + far * np.square(displacements_px - displacements_px.mean(axis=0)).sum(axis=1).mean()
    if parallax is not None:
        # The windows are measured with a relief from other bands: their shifts contain its error.
        unmodelled_px2 = np.maximum(unmodelled_px2, parallax.variance_px2(points_px))
    else:
        square = square + far * relief_std_px**2
    return np.asarray(np.sqrt(square + unmodelled_px2))


def _far(residual: Residual, points_px: Points) -> NDArray[np.float64]:
    """Return (n,) from 0 to 1 how far points (n, 2) are from the measured windows: 0 within one spacing of these."""
    spacing_px, transition_spacings = max(window_spacing_px(residual.centres_px), 1.0), 3.0
    distance_px, _ = cKDTree(residual.measured_px).query(points_px)
    return np.asarray(np.clip((distance_px / spacing_px - 1) / transition_spacings, 0, 1))


def _with_lenses(
    covariance_px2: NDArray[np.float64], residual: Residual, size_px: tuple[int, int], lens_std_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (12, 12) of the corners and of unknown lens shapes, given the windows of a residual.

    A homography fitted to the windows follows the lens shapes where the windows are, so that their errors cancel there
    and not elsewhere. The windows also limit the shapes that are possible.
    """
    flat_corners = geometry.over_corners(residual.measured_px, *size_px).reshape(-1, 8)
    flat_lenses = lens_shapes(residual.measured_px, size_px).reshape(-1, 4)
    damping = 1e-9 * np.trace(flat_corners.T @ flat_corners) * np.eye(8)
    followed = np.linalg.solve(flat_corners.T @ flat_corners + damping, flat_corners.T @ flat_lenses)
    remaining = flat_lenses - flat_corners @ followed
    information = remaining.T @ remaining / lens_shift_variance_px2(float(residual.std_px))
    of_lenses = np.linalg.inv(np.diag(lens_std_px**-2.0) + information)
    result = np.zeros((12, 12))
    result[:8, :8] = covariance_px2[:8, :8] + followed @ of_lenses @ followed.T
    result[:8, 8:] = -followed @ of_lenses
    result[8:, :8], result[8:, 8:] = result[:8, 8:].T, of_lenses
    return result


def _unmodelled_px2(residual: Residual, points_px: Points, far: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the expected squared shift (n,) at points that the mapping does not contain.

    It is the median of the nearest windows, so that a single wrong peak does not count, minus their noise. It is shrunk
    towards the value of all windows, which is used alone far from them.
    """
    is_measured = np.isfinite(residual.shifts_px[:, 0])
    centres, noise_px2 = residual.centres_px[is_measured], np.square(noise_px(residual.peaks_sigma[is_measured]))
    squares = np.square(residual.shifts_px[is_measured]).sum(axis=1)
    count = min(8, len(centres))  # nearest windows, weighted by their distance
    distance, index = (values.reshape(-1, count) for values in cKDTree(centres).query(points_px, k=count))
    spacing_px = max(window_spacing_px(residual.centres_px), 1.0)
    weight = np.exp(-0.5 * (distance / spacing_px) ** 2) + 1e-12
    order = np.argsort(squares[index], axis=1)
    cumulative = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    middle = (cumulative >= cumulative[:, -1:] / 2).argmax(axis=1)[:, None]
    median_px2 = np.take_along_axis(squares[index], np.take_along_axis(order, middle, axis=1), axis=1)[:, 0]
    mean_noise_px2 = (weight * noise_px2[index]).sum(axis=1) / weight.sum(axis=1)
    # The median square of a shift with two normally distributed components is log(2) times its mean square.
    local_px2 = np.maximum(median_px2 / math.log(2) - mean_noise_px2, 0.0)
    prior_windows = 4.0  # weight of all windows relative to one of the nearest
    all_px2, total = float(residual.std_px) ** 2, weight.sum(axis=1)
    near_px2 = (total * local_px2 + prior_windows * all_px2) / (total + prior_windows)
    return np.asarray((1 - far) * near_px2 + far * all_px2)
