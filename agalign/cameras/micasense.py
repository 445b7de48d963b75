"""MicaSense RedEdge-3, -M, -MX, -P, dual, Altum and Altum-PT: one TIFF a band, everything in EXIF and XMP.

Between undistorted pixels H(reference -> band) = K_band R_band^T R_reference K_reference^-1 with
R(a, b, c) = Rx(a) Ry(b) Rz(c) from Camera:RigRelatives in degrees. The residual is a shift by parallax, larger between
the two cameras of a dual, which have a longer baseline.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

from agalign.cameras.base import Camera, band_of, elevation_of, is_thermal, max_value, rays_to_rig, rotation
from agalign.cameras.metadata import Tags, rational
from agalign.cameras.pix4d import (
    BAND_NAME,
    CAMERA,
    VIGNETTING_CENTRE,
    VIGNETTING_POLYNOMIAL,
    TagTransfer,
    focal_length_px,
    lens_offset_m,
    parallax_of,
    perspective_lens,
    pose_of,
    rig_degrees,
    spectral,
)
from agalign.cameras.xmp import Name
from agalign.pixels.raster import RasterInfo
from agalign.values.capture import Band, Pose, Radiometry

_FULL_SCALE = 65536.0
"""Bands are stored as 16 bits."""
_HORIZONTAL_IRRADIANCE_UNIT = 0.01
"""W / m^2 / nm, where no tag gives the scale."""
_MAX_TWELVE_BIT_VALUE = 65520.0
"""RedEdge cameras store 12 bits in the upper bits of uint16."""


_MICASENSE, _DLS = "micasense.com/MicaSense", "micasense.com/DLS"
_CAPTURE_ID: Name = (_MICASENSE, "CaptureId")
_CALIBRATION: Name = (_MICASENSE, "RadiometricCalibration")


_CENTIKELVIN = Radiometry("temperature", 27315.0, 1.0, 0.01)
"""What thermal bands count in: the Altum's tag SceneTemperature agrees with it."""
_LAYOUT = {
    "Blue": (-0.9, 0.0), "Green": (0.0, 0.0), "Red": (0.0, -0.65), "NIR": (-0.9, -0.7), "Red edge": (-0.4, -0.35),
}  # fmt: skip
"""How a RedEdge-M's bands move against green as the ground comes nearer: two flights of two cameras agree on it within
a twentieth."""


class _TagTransfer(TagTransfer):
    radiometry = TagTransfer.radiometry | {_CALIBRATION, (_MICASENSE, "DarkRowValue")}


class MicaSense(Camera):
    """The MicaSense family."""

    name = "MicaSense"
    capture_ids = (_CAPTURE_ID,)
    flight_ids = ((_MICASENSE, "FlightId"),)
    tag_transfer = _TagTransfer()

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "micasense" or _CAPTURE_ID in tags.xmp

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        band = spectral(band_of(path, info, tags.text(*BAND_NAME) or _index_in_name(path) or path.stem), tags)
        lens = perspective_lens(tags)
        top = _MAX_TWELVE_BIT_VALUE if band.dtype == "uint16" else max_value(band.dtype)
        to_rig = rays_to_rig(lens, rotation(*rig_degrees(tags)))
        parallax = parallax_of(tags) or (_LAYOUT.get(band.name) if tags.model == "RedEdge-M" else None)
        radiometry = _CENTIKELVIN if is_thermal(band) else _radiometry(tags)
        return (
            replace(
                band, saturation_value=top, lens=lens, to_rig=to_rig, parallax=parallax, radiometry=radiometry,
                lens_offset_m=lens_offset_m(tags),
            ),
        )  # fmt: skip

    def pose(self, tags: Tags) -> Pose | None:
        """From the camera's tags, else with the yaw of the light sensor, which is on the same aircraft."""
        yaw, focal_px = tags.number(_DLS, "Yaw"), focal_length_px(tags)
        return pose_of(tags) or (None if yaw is None else Pose(math.degrees(yaw), focal_length_px=focal_px))

    def elevation_deg(self, tags: Tags) -> float | None:
        """From the camera's tags, else from the light sensor, which looks up where the camera looks down."""
        if pose_of(tags) is not None:
            return super().elevation_deg(tags)
        pitch, roll = tags.number(_DLS, "Pitch"), tags.number(_DLS, "Roll")
        return None if pitch is None or roll is None else elevation_of(math.degrees(pitch), math.degrees(roll))

    def capture_name(self, path: Path) -> str:
        return re.sub(r"_\d+$", "", path.stem)


def _radiometry(tags: Tags) -> Radiometry | None:
    """L = V a1 / g (p - p_black) / (t + a2 y - a3 t y) with p = raw / 65536, g = ISO / 100 and the exposure time t;
    reflectance = pi L / E with the light sensor's irradiance E on a horizontal plane.
    """
    a = tags.numbers(*_CALIBRATION)
    exposure_s, iso = rational(tags.exif.get("ExposureTime")), _iso(tags)
    if len(a) != 3 or not exposure_s or tags.black_level is None or not iso:
        return None
    irradiance = _irradiance(tags)
    centre, k = tags.numbers(*VIGNETTING_CENTRE), tags.numbers(*VIGNETTING_POLYNOMIAL)
    known = len(centre) == 2
    return Radiometry(
        "radiance", tags.black_level, _FULL_SCALE, a[0] / (iso / 100) / exposure_s,
        (centre[0], centre[1]) if known else (0.0, 0.0), k if known else (), True, a[1] / exposure_s - a[2],
        (math.pi / irradiance, "reflectance") if irradiance else None,
    )  # fmt: skip


def _iso(tags: Tags) -> int | None:
    """The sensitivity, under any of the names that EXIF has had for it."""
    values = (tags.exif[n] for n in ("ISOSpeed", "ISOSpeedRatings", "PhotographicSensitivity") if n in tags.exif)
    value = next(values, None)
    return value if isinstance(value, int) else None


def _irradiance(tags: Tags) -> float | None:
    """W / m^2 / nm: HorizontalIrradiance, which is in hundredths of that unless a scale is given, else what the older
    light sensor measured in its own plane.
    """
    scale = tags.number(_DLS, "IrradianceScaleToSIUnits")
    result = [
        (tags.number(_DLS, "HorizontalIrradiance"), scale or _HORIZONTAL_IRRADIANCE_UNIT),
        (tags.number(_DLS, "SpectralIrradiance"), scale or 1.0),
        (tags.number(CAMERA, "Irradiance"), scale or 1.0),
    ]
    return next((value * unit for value, unit in result if value is not None and value * unit > 0), None)


def _index_in_name(path: Path) -> str:
    match = re.search(r"_(\d+)$", path.stem)
    return f"band_{match.group(1)}" if match else ""
