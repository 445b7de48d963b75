"""Check that shifts were measured in every quarter of the image; elsewhere the mapping is extrapolated."""

import numpy as np

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.geometry import Points
from agalign.values.issues import Issue, IssueKind, Remedy
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedPx

EXTRAPOLATED = IssueKind(
    "extrapolated",
    "the bands show no common structure at the {detail} of the image; the mapping is extrapolated there",
    Remedy(
        "a part of the image is saturated, masked or without texture, and no rig of the flight is known there",
        "expose for the brightest band; or give --model OUT/models/… of a flight that shows the whole image. "
        "--error-map writes the expected error of each pixel",
    ),
)
"""Not in `CHECKS`: the result is kept as a prediction with the error of the extrapolation."""
_INNER_SHARE = 1 / 8
"""Windows within this share of the side from the image's axes are not counted for a quarter, as most of it would still
be extrapolated."""
_MIN_WINDOWS = 2
"""Minimum number of measured windows in a quarter; a single one may be a wrong peak."""
_MIN_SHARE_IN_FRAME = 0.5
"""Quarters are only checked if the moving image covers at least this share of them."""
_LATTICE = 24, 18
"""Columns and rows of the points with which that share is measured."""
_QUARTERS = (("top left", -1, -1), ("top right", 1, -1), ("bottom right", 1, 1), ("bottom left", -1, 1))
"""Names, and signs of x and y relative to the centre."""


def points_in_frame(mapping: PixelMapping, size_px: tuple[int, int], moving_size_px: tuple[int, int]) -> Points:
    """Return the points (n, 2) of a grid over the reference that are mapped into the moving image.

    Sizes are (width, height).
    """
    points = geometry.lattice(*size_px, *_LATTICE)
    mapped = mapping(points)
    return points[((mapped >= -0.5) & (mapped <= np.subtract(moving_size_px, 0.5))).all(axis=1)]


def unobserved_quarters(centres_px: Points, size_px: tuple[int, int], in_frame_px: Points | None = None) -> list[str]:
    """Return the quarters of an image (width, height) with fewer than _MIN_WINDOWS of the centres (n, 2).

    `in_frame_px` are the points of the image that the moving image covers, all of them by default.
    """
    lattice = geometry.lattice(*size_px, *_LATTICE)
    covered = lattice if in_frame_px is None else in_frame_px
    return [
        name
        for name, *sides in _QUARTERS
        if _count(covered, size_px, sides) >= _MIN_SHARE_IN_FRAME * _count(lattice, size_px, sides)
        and _count(centres_px, size_px, sides) < _MIN_WINDOWS
    ]


def issues_of_extrapolation(
    residual: Residual[FixedPx], size_px: tuple[int, int], in_frame_px: Points
) -> tuple[Issue, ...]:
    """Return an issue if a quarter of the area that the moving image covers has no measured windows."""
    quarters = unobserved_quarters(residual.measured_px, size_px, in_frame_px)
    return (Issue(EXTRAPOLATED, float(len(quarters)), 0.0, " and ".join(quarters)),) if quarters else ()


def _count(points_px: Points, size_px: tuple[int, int], sides: list[int]) -> int:
    """Count the points (n, 2) in the outer part of the quarter with signs `sides` (x, y) relative to the centre."""
    size = np.array(size_px, dtype=np.float64)
    from_centre = (points_px - (size - 1) / 2) / size * np.array(sides)
    return int((from_centre > _INNER_SHARE).all(axis=1).sum())
