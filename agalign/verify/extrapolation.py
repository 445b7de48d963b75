"""Errors where no window was measured: unobserved quarters, unmodelled lens distortion, expected error of a pixel."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agalign.fit.adjustment import lens_shapes, lens_std_px, variance_px2
from agalign.fit.windows import window_spacing_px
from agalign.values import geometry
from agalign.values.alignment import Alignment, Residual
from agalign.values.geometry import Points
from agalign.values.issues import Issue, IssueKind, Remedy
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedFilePx, FixedPx

EXTRAPOLATED = IssueKind(
    "extrapolated",
    "the bands show no common structure at the {detail} of the image; the mapping is extrapolated there",
    Remedy(
        "a part of the image is saturated, masked or without texture",
        "expose for the brightest band, or give --model OUT/models/… of a flight that shows the whole image; "
        "--error-map writes the expected error",
    ),
)
"""Not in `checks.CHECKS`: the result is kept as a prediction with the error of the extrapolation."""
MIN_COMMON_COVERAGE = 0.3
"""Minimum share of the windows with a measured shift; in a band of noise, a tenth has one by chance."""
_LATTICE = 24, 18
"""Columns and rows of the points of an image at which its coverage and the lens distortion are evaluated."""


def points_in_frame(mapping: PixelMapping, size_px: tuple[int, int], moving_size_px: tuple[int, int]) -> Points:
    """Return the points (n, 2) of a grid over the reference that are mapped into the moving image.

    Sizes are (width, height).
    """
    points = geometry.lattice(*size_px, *_LATTICE)
    mapped = mapping(points)
    return points[((mapped >= -0.5) & (mapped <= np.subtract(moving_size_px, 0.5))).all(axis=1)]


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


def issues_of_extrapolation(
    residual: Residual[FixedPx], size_px: tuple[int, int], in_frame_px: Points
) -> tuple[Issue, ...]:
    """Return an issue if a quarter of the area that the moving image covers has no measured windows."""
    quarters = unobserved_quarters(residual.measured_px, size_px, in_frame_px)
    return (Issue(EXTRAPOLATED, float(len(quarters)), 0.0, " and ".join(quarters)),) if quarters else ()


def unmodelled_std_px(centres_px: Points, size_px: tuple[int, int], *, calibrated: bool) -> float:
    """Return the RMS lens distortion, px, that a homography fitted to windows at centres (n, 2) does not model.

    It is averaged over the whole image (width, height). The homography approximates the distortion at the windows and
    deviates from it elsewhere.
    """
    points_px = geometry.lattice(*size_px, *_LATTICE)
    inside = geometry.over_corners(centres_px, *size_px).reshape(-1, 8)
    fitted = np.linalg.lstsq(inside, lens_shapes(centres_px, size_px).reshape(-1, 4), rcond=None)[0]
    unmodelled = lens_shapes(points_px, size_px) - geometry.over_corners(points_px, *size_px) @ fitted
    return float(np.sqrt(((unmodelled * lens_std_px(size_px, calibrated=calibrated)) ** 2).sum(axis=(1, 2)).mean()))


def expected_error_px(
    alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points
) -> NDArray[np.float64]:
    """Return the expected RMS error, px, at points (n, 2) of the reference (width, height), raw px.

        error^2 = trace(D(x) C D(x)^T) + (1 - far) * local mean square + far * p95^2 + variance of the parallax

    C is the covariance of the corners and D the Jacobian `geometry.over_corners`, with lens shapes if the mapping is
    extrapolated. For a band that is predicted by a rig, the first term is the squared standard error. The local mean
    square is that of the residual shifts of the nearest windows, but not for a band without common structure that a rig
    predicts; `far` grows from 0 to 1 with the distance from them.
    Infinite where the error is unknown.
    """
    square, residual = _mapping_px2(alignment, size_px, points_px), alignment.residual
    is_by_rig = alignment.prediction is not None and alignment.prediction.source != "windows"
    is_lost = is_by_rig and residual is not None and residual.coverage < MIN_COMMON_COVERAGE
    if residual is not None and len(residual.measured_px) and not is_lost:
        square = square + _windows_px2(residual, points_px)
    if alignment.mapping.parallax is not None:
        square = square + alignment.mapping.parallax.variance_px2(points_px)
    return np.asarray(np.sqrt(square))


def _mapping_px2(alignment: Alignment[FixedFilePx], size_px: tuple[int, int], points_px: Points) -> NDArray[np.float64]:
    """Return the variance of the mapping at points, (n,)."""
    prediction, joint = alignment.prediction, alignment.joint
    if alignment.status == "predicted" and prediction is not None:
        if prediction.covariance_px2 is not None:
            return variance_px2(points_px, prediction.covariance_px2, size_px)
        # The standard error is in px of the moving file.
        ratio = geometry.magnification(alignment.fixed_to_moving, *size_px)
        return np.full(len(points_px), (prediction.std_px / ratio) ** 2)
    if alignment.status != "aligned" or joint is None or joint.corner_covariance_px2 is None:
        return np.full(len(points_px), 0.0 if joint is None and alignment.status == "aligned" else np.inf)
    return variance_px2(points_px, joint.corner_covariance_px2, size_px)


def _windows_px2(residual: Residual[FixedFilePx], points_px: Points) -> NDArray[np.float64]:
    """Return the expected squared residual shift at points, (n,)."""
    centres = residual.measured_px
    squares = (residual.shifts_px[np.isfinite(residual.shifts_px[:, 0])] ** 2).sum(axis=1)
    count = min(8, len(centres))  # nearest windows, weighted by their distance
    distance, index = (values.reshape(-1, count) for values in cKDTree(centres).query(points_px, k=count))
    spacing_px = max(window_spacing_px(residual.centres_px), 1.0)
    weight = np.exp(-0.5 * (distance / spacing_px) ** 2) + 1e-12
    local_px2 = (weight * squares[index]).sum(axis=1) / weight.sum(axis=1)
    transition_spacings = 3.0  # beyond the first spacing, over which p95 replaces the residuals of the windows
    far = np.clip((distance[:, 0] / spacing_px - 1) / transition_spacings, 0, 1)
    return np.asarray((1 - far) * local_px2 + far * max(residual.p95_px**2, float(squares.mean())))
