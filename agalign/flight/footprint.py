"""The footprint of a capture on the ground, by its georeference or the pose of the camera."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError
from agalign.flight.groups import flights_of
from agalign.pixels.coordinates import crs_wkt, transformed
from agalign.values import geometry
from agalign.values.capture import Capture, Georeference, HeightSource, Position
from agalign.values.geometry import Points
from agalign.values.image import OutputGrid

_MAX_TILT_DEG = 45.0
"""The footprint of a camera with a larger tilt is not useful, and the tag is often wrong."""


def footprint(capture: Capture, grid: OutputGrid) -> NDArray[np.float64] | None:
    """Return a closed ring (5, 2) of (longitude, latitude) in degrees around the pixels of a grid.

    None if neither a georeference nor the camera's pose is known.
    """
    outline = geometry.corners(grid.width + 1, grid.height + 1)[[0, 1, 2, 3, 0]]
    corners = np.add(outline, (grid.x0, grid.y0)) / grid.scale
    georeference = capture.reference.georeference
    try:
        if georeference is not None:
            return transformed(geometry.apply(georeference.transform, corners), georeference.crs_wkt, "EPSG:4326")
        offsets_m, position = ground_m(capture, corners - 0.5), capture.position
        if offsets_m is None or position is None:
            return None
        return transformed(offsets_m, _local_crs(position), "EPSG:4326")
    except GeometryError:
        return None


def ground_m(capture: Capture, points_px: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Project pixels of the reference (n, 2) onto a horizontal plane: (n, 2) metres east and north of the camera.

    None if height, heading or focal length is unknown, or the camera is tilted too much.
    """
    pose = capture.pose
    if pose is None or pose.height_m is None or pose.focal_length_px is None:
        return None
    if math.hypot(pose.pitch_deg, pose.roll_deg) > _MAX_TILT_DEG:
        return None
    centre = (np.array(capture.reference.size_px) - 1) / 2
    right, down = ((points_px - centre) / pose.focal_length_px).T
    # Components (forward, right, downward) of rays, rotated by the roll, then by the pitch and the heading, as those of
    # an aircraft: Rz(yaw) Ry(pitch) Rx(roll).
    pitch, roll, heading = np.radians((pose.pitch_deg, pose.roll_deg, pose.heading_deg))
    right, below = right * np.cos(roll) - np.sin(roll), np.cos(roll) + right * np.sin(roll)
    forward, downward = -down * np.cos(pitch) + below * np.sin(pitch), below * np.cos(pitch) + down * np.sin(pitch)
    if not (downward > 0).all():
        return None
    forward_m, right_m = pose.height_m * forward / downward, pose.height_m * right / downward
    east_m = right_m * np.cos(heading) + forward_m * np.sin(heading)
    return np.stack([east_m, forward_m * np.cos(heading) - right_m * np.sin(heading)], axis=-1)


def missing_for_footprint(capture: Capture) -> str:
    """Return what `ground_m` lacks of a capture, and the remedy: tags, the height, or a view that is steep enough."""
    pose, position = capture.pose, capture.position
    tags = {
        "a position": position is not None,
        "a heading": pose is not None,
        "a focal length": pose is None or pose.focal_length_px is not None,
    }
    if lacking := [name for name, known in tags.items() if not known]:
        return f"{' and '.join(lacking)} in its tags; leave --georeference out"
    if pose is not None and pose.height_m is not None:
        return f"a tilt below {_MAX_TILT_DEG:.0f} degrees; leave --georeference out"
    if position is not None and position.altitude_m is not None:
        return "a height above the ground; give --ground-elevation, in metres and below the altitude of the camera"
    return "an altitude or a height above the ground in its tags; leave --georeference out"


def above_elevation(capture: Capture, ground_elevation_m: float) -> Capture:
    """Return the capture with the height above ground of this elevation, if its tags give none."""
    return _with_height(capture, ground_elevation_m, math.inf, "ground elevation")


def with_assumed_height(capture: Capture) -> Capture:
    """Return the capture with an upper limit of the height above ground, if no height is known: the altitude above sea
    level, at most the legal limit.
    """
    max_assumed_height_m = 120.0  # legal limit of the height above ground of drones in most countries
    return _with_height(capture, 0.0, max_assumed_height_m, "assumed")


def with_approximate_georeference(capture: Capture, crs: str) -> Capture:
    """Return the capture with an affine georeference of its reference, if it has none and its height is known.

    `crs` is the WKT of the flight's coordinate system: captures across the border of a UTM zone have one as well.
    The ground is assumed to be a horizontal plane, lens distortion is neglected, and `accuracy_m` is set.
    """
    reference, position = capture.reference, capture.position
    corners = _outline_px(capture)
    offsets_m = ground_m(capture, corners - 0.5)
    if reference.georeference is not None or offsets_m is None or position is None:
        return capture
    try:
        on_map = transformed(offsets_m, _local_crs(position), crs)
    except GeometryError:
        return capture
    design = np.column_stack([corners, np.ones(4)])
    affine, *_ = np.linalg.lstsq(design, on_map - on_map[0], rcond=None)
    fit_error_m = float(np.abs(design @ affine - (on_map - on_map[0])).max())
    transform = np.vstack([affine.T, [0.0, 0.0, 1.0]])
    transform[:2, 2] += on_map[0]
    accuracy_m = accuracy_of_footprint_m(capture)
    assert accuracy_m is not None
    georeference = Georeference(transform, crs, round(math.hypot(accuracy_m, fit_error_m), 1))
    bands = tuple(replace(b, georeference=georeference) if b is reference else b for b in capture.bands)
    return replace(capture, bands=bands)


def accuracy_of_footprint_m(capture: Capture) -> float | None:
    """Return the standard error, metres, of the farthest corner of a footprint: that of a georeference, if it is known,
    or by `ground_m` from the errors of the camera's position, heading, tilt and height. None if it is not known.
    """
    if (georeference := capture.reference.georeference) is not None:
        return georeference.accuracy_m
    offsets_m = ground_m(capture, _outline_px(capture) - 0.5)
    pose = capture.pose
    if offsets_m is None or pose is None or pose.height_m is None:
        return None
    distance_m = float(np.linalg.norm(offsets_m, axis=1).max())
    tangent = distance_m / pose.height_m  # of the corner's angle from the vertical
    position_std_m = 3.0  # of a GPS receiver without corrections
    heading_std = math.radians(5.0)  # of a magnetic heading
    # By a gimbal or attitude sensor; of a camera that is fixed to an aircraft.
    tilt_std = math.radians(2.0 if pose.pitch_deg or pose.roll_deg else 7.0)
    # Of an assumed height; of a barometric height over uneven ground.
    height_std_m = 0.5 * pose.height_m if pose.height_from == "assumed" else 5.0
    tilted_m = tilt_std * pose.height_m * (1 + tangent**2)
    return round(math.hypot(position_std_m, heading_std * distance_m, tilted_m, height_std_m * tangent), 1)


def utm_wkt(longitude: float, latitude: float) -> str:
    """Return the WKT of the UTM zone of a position, degrees."""
    zone = min(int((longitude + 180) // 6), 59) + 1
    return crs_wkt(f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}")


def utm_of_flights(captures: Sequence[Capture]) -> dict[str, str]:
    """Return the WKT of the UTM zone of each capture's flight, by label: that of the flight's first position."""
    result: dict[str, str] = {}
    for flight in flights_of(captures):
        position = next((c.position for c in flight if c.position is not None), None)
        if position is not None:
            result |= dict.fromkeys((c.label for c in flight), utm_wkt(position.longitude, position.latitude))
    return result


def _outline_px(capture: Capture) -> Points:
    """The outer corners (4, 2) of the corner pixels of the reference; (0, 0) is the first one."""
    width, height = capture.reference.size_px
    return geometry.corners(width + 1, height + 1)


def _with_height(capture: Capture, elevation_m: float, max_height_m: float, source: HeightSource) -> Capture:
    """The capture with the height of its altitude above an elevation, if none is known and that is above the ground."""
    pose, altitude_m = capture.pose, capture.altitude_m
    if pose is None or pose.height_m is not None or altitude_m is None or altitude_m - elevation_m <= 1.0:
        return capture
    height_m = min(altitude_m - elevation_m, max_height_m)
    return replace(capture, pose=replace(pose, height_m=height_m, height_from=source))


def _local_crs(position: Position) -> str:
    """Azimuthal equidistant projection around a position: metres east and north of it."""
    return f"+proj=aeqd +lat_0={position.latitude:.9f} +lon_0={position.longitude:.9f} +datum=WGS84 +units=m"
