"""The synthetic camera: the lenses of its bands, their places and angles in the rig, and what they are sensitive to."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

PIXELS_PER_MM = 266.666667
FOCAL_LENGTH_MM = 5.45


@dataclass(frozen=True)
class BandSpec:
    """One camera of the rig."""

    name: str
    wavelength_nm: float
    bandwidth_nm: float
    soil: float
    crop: float
    tree: float
    """Reflectances, 0 to 1."""
    rig_index: int
    rig_degrees: tuple[float, float, float]
    baseline_m: tuple[float, float]
    """Place of the lens in the rig, metres right of and below the rig's centre."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3."""
    centre_offset_px: tuple[float, float]
    """Of the principal point from the middle of a 1280 x 960 sensor."""
    delay_s: float = 0.0
    """How much later than the first band it is exposed."""

    @property
    def exposure(self) -> float:
        """Share of the full signal that a reflectance of 1 would give."""
        return 0.55 / max(self.soil, self.crop)

    def lens(self, width_px: int, height_px: int) -> Lens:
        """The lens on a sensor of the given size; smaller sensors have larger pixels."""
        scale = width_px / 1280
        focal = FOCAL_LENGTH_MM * PIXELS_PER_MM * scale
        cx = (width_px - 1) / 2 + self.centre_offset_px[0] * scale
        cy = (height_px - 1) / 2 + self.centre_offset_px[1] * scale
        return Lens(focal, focal, cx, cy, self.distortion)


BANDS = (
    BandSpec("Blue", 475, 20, 0.085, 0.042, 0.030, 0, (0.31, -0.22, 0.12), (-0.03, -0.021),
             (-0.104, 0.150, -0.0003, 0.0006, -0.03), (11.2, -7.5)),
    BandSpec("Green", 560, 20, 0.125, 0.105, 0.070, 1, (0.0, 0.0, 0.0), (0.0, -0.021),
             (-0.101, 0.145, 0.0002, -0.0004, -0.02), (-6.3, 4.9)),
    BandSpec("Red", 668, 10, 0.185, 0.055, 0.040, 2, (-0.42, 0.35, -0.18), (0.03, -0.021),
             (-0.108, 0.158, -0.0001, 0.0003, -0.04), (3.7, 12.6)),
    BandSpec("NIR", 840, 40, 0.265, 0.520, 0.430, 3, (0.55, -0.16, 0.21), (-0.03, 0.021),
             (-0.110, 0.152, -0.0003, 0.0005, -0.05), (13.5, 9.1)),
    BandSpec("Red edge", 717, 10, 0.225, 0.285, 0.220, 4, (-0.27, -0.31, -0.09), (0.03, 0.021),
             (-0.106, 0.160, 0.0004, -0.0002, -0.06), (-9.4, -5.8)),
)  # fmt: skip
REFERENCE = 1


@dataclass(frozen=True)
class CameraSpec:
    """A camera, and whose tags it writes."""

    maker: Literal["MicaSense", "DJI"]
    bands: tuple[BandSpec, ...]
    reference: int
    """Index of the band that the others are aligned to."""


REDEDGE = CameraSpec("MicaSense", BANDS, REFERENCE)
MAVIC = CameraSpec("DJI", (
    BandSpec("Green", 560, 32, 0.125, 0.105, 0.070, 1, (0.0, 0.0, 0.0), (-0.012, -0.009),
             (-0.081, 0.095, 0.0002, -0.0003, -0.02), (-5.1, 3.4), 0.0),
    BandSpec("Red", 650, 32, 0.175, 0.060, 0.045, 2, (-0.21, 0.17, -0.11), (0.012, -0.009),
             (-0.084, 0.098, -0.0001, 0.0002, -0.02), (4.6, 8.2), 0.025),
    BandSpec("RedEdge", 730, 32, 0.230, 0.310, 0.240, 3, (-0.12, -0.24, 0.08), (-0.012, 0.009),
             (-0.079, 0.091, 0.0003, -0.0001, -0.03), (-7.7, -2.9), 0.050),
    BandSpec("NIR", 860, 52, 0.270, 0.510, 0.420, 4, (0.26, -0.09, 0.14), (0.012, 0.009),
             (-0.086, 0.101, -0.0002, 0.0003, -0.03), (9.3, 5.5), 0.075),
), 0)  # fmt: skip
"""Its bands are exposed one after another: at 8 m/s and 28 m up near infra-red moves by 62 px against green between
opposite headings.
"""


@dataclass(frozen=True)
class Pose:
    """Where the rig is at a capture, and its attitude."""

    altitude_m: float
    yaw_deg: float
    roll_deg: float
    pitch_deg: float
    east_m: float
    north_m: float
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    """East and south."""


def true_homography(reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """fixed_to_moving between undistorted pixels: both cameras' homographies to the ground plane, chained."""
    return geometry.compose(
        geometry.invert(_pixel_to_ground(band, pose, size_px)), _pixel_to_ground(reference, pose, size_px)
    )


def _pixel_to_ground(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """Undistorted pixel -> metres east and south on the plane below: the ray from the lens, cut with the plane."""
    place, rays = place_and_rays(band, pose, size_px)
    # ground = place + ray * (-place_z / ray_z): linear in the homogeneous pixel once multiplied by ray_z.
    cut = np.array([[-place[2], 0.0, place[0]], [0.0, -place[2], place[1]], [0.0, 0.0, 1.0]])
    return geometry.normalised(cut @ rays)


def to_plane(reference: BandSpec, band: BandSpec, size_px: tuple[int, int]) -> Matrix:
    """Undistorted pixels of a band -> those of the reference, were both lenses in one place."""
    rays = _rotation(*band.rig_degrees) @ np.linalg.inv(band.lens(*size_px).matrix)
    return np.asarray(reference.lens(*size_px).matrix @ _rotation(*reference.rig_degrees).T @ rays)


def place_and_rays(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> tuple[NDArray[np.float64], Matrix]:
    """(where the lens is, metres east, south and down of the origin; undistorted pixel -> direction of its ray)."""
    attitude = _rotation(pose.roll_deg, pose.pitch_deg, pose.yaw_deg)
    rays = attitude @ _rotation(*band.rig_degrees) @ np.linalg.inv(band.lens(*size_px).matrix)
    flown = band.delay_s * np.array([*pose.velocity_m_s, 0.0])
    place = attitude @ np.array([*band.baseline_m, 0.0]) + flown + (pose.east_m, pose.north_m, -pose.altitude_m)
    return place, rays


def _rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    turns = [
        cv2.Rodrigues(np.radians(angle) * axis)[0] for angle, axis in zip((a_deg, b_deg, c_deg), np.eye(3), strict=True)
    ]
    return np.asarray(turns[0] @ turns[1] @ turns[2], np.float64)
