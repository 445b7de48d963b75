"""Where a capture is on the ground: by its georeference, or by the camera's position, height and direction."""

import math

import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.pixels.raster import transformed
from agalign.values import geometry
from agalign.values.capture import Capture, Position
from agalign.values.image import OutputGrid

_WGS84 = "EPSG:4326"
_MAX_TILT_DEG = 45.0
"""A camera that looks farther aside has no useful footprint, and often a wrong tag."""


def footprint(capture: Capture, grid: OutputGrid) -> NDArray[np.float64] | None:
    """Return a closed ring (5, 2) of longitudes and latitudes around the pixels of a grid, degrees.

    None where neither a georeference nor the camera's pose is known.
    """
    x0, y0 = grid.x0, grid.y0
    x1, y1 = x0 + grid.width, y0 + grid.height
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], dtype=np.float64) / grid.scale
    georeference = capture.reference.georeference
    try:
        if georeference is not None:
            return transformed(geometry.apply(georeference.transform, corners), georeference.crs_wkt, _WGS84)
        offsets_m, position = ground_m(capture, corners - 0.5), capture.position
        if offsets_m is None or position is None:
            return None
        return transformed(offsets_m, _local_crs(position), _WGS84)
    except GeometryError:
        return None


def ground_m(capture: Capture, points_px: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Project pixels of the reference (n, 2) onto a horizontal plane: (n, 2) metres east and north of the camera.

    None where height, heading or focal length is unknown, or the camera looks too far aside.
    """
    pose = capture.pose
    if pose is None or pose.height_m is None or pose.focal_length_px is None:
        return None
    if math.hypot(pose.pitch_deg, pose.roll_deg) > _MAX_TILT_DEG:
        return None
    middle = (np.array(capture.reference.size_px) - 1) / 2
    right, down = ((points_px - middle) / pose.focal_length_px).T
    # Rotated by the pitch, then by the roll: components ahead, to the right and below.
    pitch, roll, heading = np.radians((pose.pitch_deg, pose.roll_deg, pose.heading_deg))
    ahead, below = -down * np.cos(pitch) + np.sin(pitch), np.cos(pitch) + down * np.sin(pitch)
    aside, below = right * np.cos(roll) - below * np.sin(roll), below * np.cos(roll) + right * np.sin(roll)
    if not (below > 0).all():
        return None
    ahead_m, aside_m = pose.height_m * ahead / below, pose.height_m * aside / below
    east = aside_m * np.cos(heading) + ahead_m * np.sin(heading)
    return np.stack([east, ahead_m * np.cos(heading) - aside_m * np.sin(heading)], axis=-1)


def _local_crs(position: Position) -> str:
    """A coordinate system of metres east and north of a position."""
    return f"+proj=aeqd +lat_0={position.latitude:.9f} +lon_0={position.longitude:.9f} +datum=WGS84 +units=m"
