"""The range of the scene from the parallax of all bands.

A lens displaced by B_b (metres, right and down in the image) sees a point at range Z, measured along the optical axis,

    d_b = -f B_b / Z

px away from where it would be at an infinite range (Hartley & Zisserman 2004, Eq. 9.6), in px of the reference with
focal length f. The homography of an infinite range follows from the orientation of the lenses in the tags. 1 / Z is the
least-squares solution over all bands.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from agalign.values import geometry, lens
from agalign.values.geometry import Matrix, Points
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping

Array = NDArray[np.float64]

_NODES = 33
"""Of the lattice on which the smooth part is calculated, along both axes."""


def inverse_range(
    mappings: Sequence[PixelMapping], at_infinity: Sequence[Matrix], towards_m: Array, reference_lens: Lens,
    points_px: Points, parallax_px: Array,
) -> Array:  # fmt: skip
    """1 / Z (height, width), per metre, at raw pixels (height, width, 2) of the reference with their parallax.

    `mappings` are the complete mappings of the bands, `at_infinity` their homographies between undistorted pixels for
    an infinite range, and `towards_m` (bands, 2) the directions in which pixels move as the scene comes nearer, metres:
    the negative positions of the lenses relative to that of the reference.
    """
    focal_px = np.array([reference_lens.fx_px, reference_lens.fy_px])
    weights = towards_m * focal_px
    low, high = points_px.reshape(-1, 2).min(axis=0), points_px.reshape(-1, 2).max(axis=0)
    x, y = (np.linspace(a, max(b, a + 1), _NODES) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    levels = float(parallax_px.min()), float(parallax_px.max()) + 1.0
    values = []
    for level in levels:
        total = np.zeros(nodes.shape[:2])
        for mapping, infinite, weight in zip(mappings, at_infinity, weights, strict=True):
            undistorted = mapping.of_the_plane.undistorted(nodes)
            assert mapping.parallax is not None
            moved = undistorted + level * np.array(mapping.parallax.baseline)
            seen = geometry.apply(geometry.invert(infinite), geometry.apply(mapping.fixed_to_moving, moved))
            total += (seen - lens.undistort(reference_lens, nodes)) @ weight
        values.append(total / (weights**2).sum())
    at = [RegularGridInterpolator((y, x), v)(points_px[..., ::-1]) for v in values]
    share = (parallax_px - levels[0]) / (levels[1] - levels[0])
    return np.asarray(at[0] + share * (at[1] - at[0]))
