"""Range of the scene from the parallax of all bands.

In a lens displaced by B_b (metres, right and down in the image), a point at range Z along the optical axis is shifted
by

    d_b = -f B_b / Z

relative to its position at infinite range (Hartley & Zisserman 2004, Eq. 9.6), in px of the reference with focal
length f. The homography at infinite range follows from the orientations of the lenses in the tags. 1 / Z is the least
squares solution over all bands.
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


def inverse_range(
    mappings: Sequence[PixelMapping],
    at_infinity: Sequence[Matrix],
    directions_m: Array,
    reference_lens: Lens,
    points_px: Points,
    parallax_px: Array,
) -> Array:
    """Return 1 / Z (height, width), per metre, at raw pixels (height, width, 2) of the reference with a parallax.

    `mappings` are the complete mappings of the bands and `at_infinity` their fixed_to_moving at infinite range,
    undistorted px. `directions_m` (bands, 2) are the directions in which points move when the scene comes nearer: the
    negative positions of the lenses relative to the reference, metres.
    """
    focal_px = np.array([reference_lens.fx_px, reference_lens.fy_px])
    weights = directions_m * focal_px
    low, high = points_px.reshape(-1, 2).min(axis=0), points_px.reshape(-1, 2).max(axis=0)
    node_count = 33  # along both axes of the grid on which mappings are evaluated
    x, y = (np.linspace(a, max(b, a + 1), node_count) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    levels = float(parallax_px.min()), float(parallax_px.max()) + 1.0
    values = []
    for level in levels:
        total = np.zeros(nodes.shape[:2])
        for mapping, infinite, weight in zip(mappings, at_infinity, weights, strict=True):
            undistorted = mapping.of_the_plane.undistorted(nodes)
            assert mapping.parallax is not None
            moved = undistorted + level * np.array(mapping.parallax.baseline)
            observed = geometry.apply(geometry.invert(infinite), geometry.apply(mapping.fixed_to_moving, moved))
            total += (observed - lens.undistort(reference_lens, nodes)) @ weight
        values.append(total / (weights**2).sum())
    # Linear interpolation in the parallax between two levels.
    low_value, high_value = (RegularGridInterpolator((y, x), v)(points_px[..., ::-1]) for v in values)
    share = (parallax_px - levels[0]) / (levels[1] - levels[0])
    return np.asarray(low_value + share * (high_value - low_value))
