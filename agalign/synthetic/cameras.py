"""Synthetic cameras: lenses, positions, orientations and spectra of their bands, their homographies to the ground, and
the camera of `agalign demo` with MicaSense's file names and tags.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import tifffile
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from numpy.typing import NDArray

from agalign.cameras.base import rotation
from agalign.cameras.tiff_directory import Directory, Entry, add_directories, byte_string, rational, short, text
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

PIXELS_PER_MM = 266.666667
FOCAL_LENGTH_MM = 5.45
BLACK_LEVEL, WHITE_LEVEL = 4800.0, 52000.0
EXPOSURE_S = 1.3e-3
SOFTWARE = "agalign demo"
"""Tag Software of the images."""
VIGNETTING = 0.35
"""Relative decrease of the light from the centre to the corners."""
_IRRADIANCE = 0.8
"""W/m^2/nm at every wavelength."""


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


class MicaSenseCamera(CameraSpec):
    """A camera that writes a TIFF per band, with MicaSense's tags."""

    maker = "MicaSense"

    def capture_name(self, number: int) -> str:
        """Shared part of the names of a capture's files; captures are counted from 1."""
        return f"IMG_{number:04d}"

    def file_name(self, band: BandSpec, number: int) -> str:
        """Name of a band's file."""
        return f"{self.capture_name(number)}_{band.rig_index + 1}.tif"

    def write_band(self, path: Path, pixels: NDArray[np.uint16], band: BandSpec, exposure: Exposure) -> None:
        """Write (height, width) pixels and their tags."""
        black = {} if band.sees == "heat" else {50714: short(round(BLACK_LEVEL))}
        first, xmp = {305: text(SOFTWARE), **black}, self._xmp(band, exposure, _pixels_per_mm(pixels))
        exif = {0x829A: rational(EXPOSURE_S * exposure.shutter), 0x8827: short(100), 0x9290: text("000000")}
        write_tiff(path, pixels, self, band, exposure, xmp, "SY01-0000001-AG", first, exif)

    def _xmp(self, band: BandSpec, exposure: Exposure, density: float) -> str:
        """The tags in XMP, given the pixels per mm: with vignetting, calibration and light sensor except for heat."""
        angles = (v + off for v, off in zip(band.rig_degrees, band.tags_off_deg, strict=True))
        width, height = band.size_px(exposure.size_px)
        return _xmp_template().render(
            camera=self,
            band=band,
            exposure=exposure,
            lens=band.lens(*exposure.size_px),
            density=density,
            rig=", ".join(f"{angle:.6f}" for angle in angles),
            width=width,
            height=height,
            fall=-VIGNETTING / ((width / 2) ** 2 + (height / 2) ** 2),
            gain=_IRRADIANCE / np.pi * EXPOSURE_S * 65536 / (WHITE_LEVEL - BLACK_LEVEL) / band.exposure,
            irradiance=_IRRADIANCE,
        )


@cache
def _xmp_template() -> Template:
    loader = PackageLoader("agalign.synthetic", ".")
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True)
    return environment.get_template("micasense.xmp.j2")


def write_tiff(
    path: Path,
    pixels: NDArray[np.uint16],
    camera: CameraSpec,
    band: BandSpec,
    exposure: Exposure,
    xmp: str,
    serial: str,
    first: Directory,
    exif: Directory,
) -> None:
    """Write (height, width) pixels with the tags that all makers write; `first` and `exif` are a maker's additions to
    the first directory and to the Exif directory.
    """
    tifffile.imwrite(path, pixels, photometric="minisblack", rowsperstrip=100, metadata=None)
    moment, density, pose = text(exposure.moment), rational(_pixels_per_mm(pixels)), exposure.pose
    tags = {271: text(camera.maker), 272: text(camera.model), 306: moment, 700: byte_string(xmp.encode())}
    of_exif = {0x9003: moment, 0x920A: rational(band.focal_length_mm), 0xA20E: density, 0xA20F: density}
    of_exif |= {0xA210: short(4), 0xA431: text(serial)}
    if band.size_ratio != (1.0, 1.0):  # half of the pixels of the Altum-PT's Pan are about those of its other bands
        height, width = pixels.shape
        of_exif |= {0xA002: short(width), 0xA003: short(height)}
    place = {1: text("N"), 2: _degrees(52.0 + pose.north_m / 111_320), 3: text("E")}
    place |= {4: _degrees(5.0 + pose.east_m / 68_500), 5: byte_string(b"\0"), 6: rational(pose.altitude_m)}
    add_directories(path, tags | first, of_exif | exif, place)


def _pixels_per_mm(pixels: NDArray[np.uint16]) -> float:
    return PIXELS_PER_MM * float(pixels.shape[1]) / 1280


def _degrees(angle_deg: float) -> Entry:
    minutes = angle_deg % 1 * 60
    return rational(int(angle_deg), int(minutes), minutes % 1 * 60)


_SPECTRA = (
    ("Blue", 475, 20, 0.085, 0.042, 0.030),
    ("Green", 560, 20, 0.125, 0.105, 0.070),
    ("Red", 668, 10, 0.185, 0.055, 0.040),
    ("NIR", 840, 40, 0.265, 0.520, 0.430),
    ("Red edge", 717, 10, 0.225, 0.285, 0.220),
)
_LENSES = (
    ((0.31, -0.22, 0.12), (-0.03, -0.021), (-0.104, 0.150, -0.0003, 0.0006, -0.03), (11.2, -7.5)),
    ((0.0, 0.0, 0.0), (0.0, -0.021), (-0.101, 0.145, 0.0002, -0.0004, -0.02), (-6.3, 4.9)),
    ((-0.42, 0.35, -0.18), (0.03, -0.021), (-0.108, 0.158, -0.0001, 0.0003, -0.04), (3.7, 12.6)),
    ((0.55, -0.16, 0.21), (-0.03, 0.021), (-0.110, 0.152, -0.0003, 0.0005, -0.05), (13.5, 9.1)),
    ((-0.27, -0.31, -0.09), (0.03, 0.021), (-0.106, 0.160, 0.0004, -0.0002, -0.06), (-9.4, -5.8)),
)
BANDS = tuple(BandSpec(*_SPECTRA[index], index, *_LENSES[index]) for index in range(len(_SPECTRA)))
"""Fields of `BandSpec`: name to reflectances, and angles to offset of the principal point."""
REFERENCE = 1

REDEDGE = MicaSenseCamera("RedEdge-M", BANDS, REFERENCE)
