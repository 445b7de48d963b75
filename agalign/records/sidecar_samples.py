"""Samples of a complete mapping, from which others interpolate it without knowing its lens models."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Delaunay

from agalign.values import geometry
from agalign.values.geometry import Points
from agalign.values.mapping import PixelMapping

_GRIDS = ((17, 13), (25, 19), (33, 25), (41, 31), (49, 37), (57, 43), (65, 49), (97, 73), (129, 97))
"""Columns and rows of the samples; the first with a small enough error is used."""
_MAX_INTERPOLATION_ERROR_PX, _INTERPOLATION_PERCENTILE = 0.02, 99
"""Maximum of this percentile of the error of cubic interpolation: less than the error of an alignment. The largest
errors are at the border, where the derivatives are estimated from one side."""


def sampled_mapping(mapping: PixelMapping, size_px: tuple[int, int]) -> Points:
    """Return the pixels (n, 2) of an image (width, height) from which cubic interpolation reproduces a smooth mapping,
    or those of the densest grid, row by row.

    Clough-Tocher, which works on any points, is less accurate than splines on the lattice.
    """
    points_px = _pixel_lattice(size_px, *_GRIDS[0])
    if min(size_px) == 1:
        return points_px  # points on one line have no triangles
    for columns, rows in _GRIDS:
        triangles = _triangles(size_px, columns, rows)
        points_px = triangles.points
        # The midpoints alone, as the error is 0 at the points themselves.
        between_px = geometry.lattice(*size_px, 2 * columns - 1, 2 * rows - 1).reshape(2 * rows - 1, -1, 2)[1::2, 1::2]
        interpolated = CloughTocher2DInterpolator(triangles, mapping(points_px))
        error_px = np.abs(interpolated(between_px) - mapping(between_px))
        # Rounding moves some points at the border outside of the triangles: NaN.
        if np.nanpercentile(error_px, _INTERPOLATION_PERCENTILE) <= _MAX_INTERPOLATION_ERROR_PX:
            break
    return points_px


@lru_cache(maxsize=len(_GRIDS))
def _triangles(size_px: tuple[int, int], columns: int, rows: int) -> Delaunay:
    """Triangulate the points of a grid, which takes as long as the interpolation; all bands have the same points."""
    return Delaunay(_pixel_lattice(size_px, columns, rows))


def _pixel_lattice(size_px: tuple[int, int], columns: int, rows: int) -> Points:
    """Centres (n, 2) of pixels that are spaced as evenly as whole numbers allow: fractions would make files larger."""
    x_px, y_px = (np.unique(np.rint(np.linspace(0, n - 1, k))) for n, k in zip(size_px, (columns, rows), strict=True))
    return np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)


def sampled_parallax(
    mapping: PixelMapping, nodes_px: Points
) -> tuple[Points, NDArray[np.float64], NDArray[np.float64]]:
    """Return the plane (n, 2), slope (n, 2) and curvature (n, 2) of a mapping with parallax at nodes (n, 2).

    A node with parallax z is mapped to plane + slope z + curvature z^2: parabolas through the value at 0 are fitted
    over the range of the scene, as lenses and tilt bend the mapping.
    """
    parallax = mapping.parallax
    assert parallax is not None
    z_px = parallax.relief.parallax_px
    levels_px = np.linspace(min(-1.0, z_px.min()), max(1.0, z_px.max()), 5)
    plane_px, *others_px = (mapping.at_parallax(nodes_px, parallax.baseline, z) for z in (0, *levels_px))
    powers = np.stack([levels_px, levels_px**2], axis=-1)
    moved_px = np.reshape(others_px - plane_px, (len(levels_px), -1))
    slope, curvature = np.linalg.lstsq(powers, moved_px, rcond=None)[0].reshape(2, *plane_px.shape)
    return plane_px, slope, curvature
