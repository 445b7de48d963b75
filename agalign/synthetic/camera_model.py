"""A synthetic camera: lenses, positions, orientations and spectra of its bands, and their homographies to the ground.

`synthetic.cameras` has the camera of the demo.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

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
    """Position of the lens in the rig, metres right of and below the centre of the rig."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3."""
    centre_offset_px: tuple[float, float]
    """Offset of the principal point from the centre of a 1280 x 960 sensor."""
    delay_s: float = 0.0
    """Delay of its exposure after the first band's."""
    sees: Literal["light", "colour", "heat"] = "light"
    """colour: one of three bands in one file; heat: the reflectances are temperatures, as shares of 50 degrees C."""
    size_ratio: tuple[float, float] = (1.0, 1.0)
    """Width and height of its images relative to those of the reference."""
    tags_off_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Error of the angles in its tags."""
    view: float = 1.0
    """Field of view as a multiple of the RedEdge-M's."""

    @property
    def exposure(self) -> float:
        """Signal of a reflectance of 1, as a share of full scale."""
        return 0.55 / max(self.soil, self.crop)

    @property
    def focal_length_mm(self) -> float:
        """Focal length; all sensors are 4.8 mm wide."""
        return FOCAL_LENGTH_MM / self.view

    def size_px(self, camera_px: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of its images for a camera with this size of the reference's images."""
        return round(camera_px[0] * self.size_ratio[0]), round(camera_px[1] * self.size_ratio[1])

    def lens(self, width_px: int, height_px: int) -> Lens:
        """The lens for a camera with this size of the reference's images; smaller images have larger pixels."""
        width, height = self.size_px((width_px, height_px))
        scale = width / 1280
        focal = self.focal_length_mm * PIXELS_PER_MM * scale
        cx = (width - 1) / 2 + self.centre_offset_px[0] * scale
        cy = (height - 1) / 2 + self.centre_offset_px[1] * scale
        return Lens(focal, focal, cx, cy, self.distortion)


@dataclass(frozen=True)
class Pose:
    """Position and attitude of the rig at a capture."""

    altitude_m: float
    yaw_deg: float
    roll_deg: float
    pitch_deg: float
    east_m: float
    north_m: float
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    """East and south."""


@dataclass(frozen=True)
class Exposure:
    """Conditions of one image of a band."""

    pose: Pose
    number: int
    """Number of the capture, from 1."""
    size_px: tuple[int, int]
    """(width, height) of the reference's images."""
    vignetting: float
    """Relative decrease of the light from the centre to the corners."""
    shutter: float = 1.0
    """Exposure time as a multiple of the normal one."""

    @property
    def moment(self) -> str:
        """Time in the format of Exif."""
        return f"2026:06:21 10:{self.number // 60:02d}:{self.number % 60:02d}"


@dataclass(frozen=True)
class CameraSpec(ABC):
    """A camera; its subclasses write the files of a maker."""

    maker: ClassVar[str]
    model: str
    bands: tuple[BandSpec, ...]
    reference: int
    """Index of the band that the others are aligned to."""
    size_px: tuple[int, int] = (1280, 960)
    """(width, height) of the reference's images."""

    @abstractmethod
    def capture_name(self, number: int) -> str:
        """Return the shared part of the file names of a capture; numbers start at 1."""

    @abstractmethod
    def file_name(self, band: BandSpec, number: int) -> str:
        """Return the name of a band's file, with its folder if each band has a folder."""

    @abstractmethod
    def write_band(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write (height, width) pixels and their tags."""

    @property
    def sharpest(self) -> float:
        """Highest angular resolution of a band, as a multiple of the RedEdge-M's."""
        return max(b.size_ratio[0] / b.view for b in self.bands)

    @property
    def widest(self) -> float:
        """Widest field of view of a band, as a multiple of the RedEdge-M's."""
        return max(b.view for b in self.bands)


def true_homography(reference: BandSpec, band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """Return fixed_to_moving between undistorted pixels, from the homographies of both bands to the ground plane."""
    return geometry.compose(
        geometry.invert(_pixel_to_ground(band, pose, size_px)), _pixel_to_ground(reference, pose, size_px)
    )


def _pixel_to_ground(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> Matrix:
    """Return the homography from undistorted pixels to metres east and south on the ground plane."""
    position, rays = place_and_rays(band, pose, size_px)
    # ground = position + ray * (-position_z / ray_z); multiplied by ray_z, it is linear in the ray.
    ray_to_ground = np.array([[-position[2], 0.0, position[0]], [0.0, -position[2], position[1]], [0.0, 0.0, 1.0]])
    return geometry.normalised(ray_to_ground @ rays)


def place_and_rays(band: BandSpec, pose: Pose, size_px: tuple[int, int]) -> tuple[NDArray[np.float64], Matrix]:
    """Return the position of the lens (metres east, south, down) and the 3x3 matrix from undistorted pixels to rays."""
    attitude = rotation(pose.roll_deg, pose.pitch_deg, pose.yaw_deg)
    rays = attitude @ rotation(*band.rig_degrees) @ np.linalg.inv(band.lens(*size_px).matrix)
    flown = band.delay_s * np.array([*pose.velocity_m_s, 0.0])
    place = attitude @ np.array([*band.baseline_m, 0.0]) + flown + (pose.east_m, pose.north_m, -pose.altitude_m)
    return place, rays


def rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    """Return the product of the rotations about x, y and z by these angles."""
    rotations = [
        cv2.Rodrigues(np.radians(angle) * axis)[0] for angle, axis in zip((a_deg, b_deg, c_deg), np.eye(3), strict=True)
    ]
    return np.asarray(rotations[0] @ rotations[1] @ rotations[2], np.float64)
