"""MicaSense RedEdge-3, -M, -MX, -P, dual, Altum and Altum-PT: one TIFF per band, with EXIF and XMP tags.

Between undistorted pixels H(reference -> band) = K_band R_band^T R_reference K_reference^-1 with
R(a, b, c) = Rx(a) Ry(b) Rz(c) from Camera:RigRelatives in degrees. What remains is a shift by parallax, which is larger
between the two halves of a dual camera because of the longer baseline.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agalign.cameras import pix4d
from agalign.cameras.base import FULL_SCALE, Camera, is_thermal, rays_to_rig, rotation
from agalign.cameras.light_sensor import horizontal_irradiance, sun_position
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.xmp import Packet, names_in
from agalign.values.capture import Band, CaptureTime, Pose, Radiometry

_MICASENSE, _DLS = "micasense.com/MicaSense", "micasense.com/DLS"
_REDEDGE_M_PARALLAX = {
    "Blue": (-0.9, 0.0),
    "Green": (0.0, 0.0),
    "Red": (0.0, -0.65),
    "NIR": (-0.9, -0.7),
    "Red edge": (-0.4, -0.35),
}
"""Direction in which the bands of a RedEdge-M, which has no tag for it, move relative to green as the distance of the
ground decreases. Two flights with two cameras agree within 5 %.
"""


class _TagTransfer(pix4d.TagTransfer):
    radiometry = pix4d.TagTransfer.radiometry | names_in(_MICASENSE, "RadiometricCalibration DarkRowValue")

    def put_radiometry(
        self, packet: Packet, tags: Tags, vignetting: pix4d.GridVignetting | None, *, radiometry: bool
    ) -> None:
        """Also add the horizontal irradiance under the names that OpenDroneMap reads, with its unit."""
        super().put_radiometry(packet, tags, vignetting, radiometry=radiometry)
        irradiance = None if radiometry else _irradiance(tags)
        if irradiance is not None:
            packet.add((pix4d.NAMESPACE, "HorizontalIrradiance"), pix4d.number_text(irradiance[0]))
            packet.add((pix4d.NAMESPACE, "IrradianceScaleToSIUnits"), pix4d.number_text(irradiance[1]))


class MicaSense(Camera):
    """The MicaSense family."""

    name = "MicaSense"
    capture_ids = ((_MICASENSE, "CaptureId"),)
    flight_ids = ((_MICASENSE, "FlightId"),)
    clock_is_utc = True
    tag_transfer = _TagTransfer()

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "micasense" or (_MICASENSE, "CaptureId") in tags.xmp

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        name = tags.text(pix4d.NAMESPACE, "BandName") or _index_in_name(path) or path.stem
        band = replace(pix4d.with_wavelength(stored[0], tags), name=name)
        lens = pix4d.perspective_lens(tags)
        offset = pix4d.lens_offset(tags)
        known_parallax = _REDEDGE_M_PARALLAX.get(name) if tags.model == "RedEdge-M" else None
        centikelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)  # in agreement with the Altum's SceneTemperature
        max_twelve_bit_value = 65520.0  # stored in the upper bits of uint16
        band = replace(
            band,
            saturation_value=max_twelve_bit_value if band.dtype == "uint16" else band.saturation_value,
            lens=lens,
            to_rig=rays_to_rig(lens, rotation(*pix4d.rig_degrees(tags))),
            parallax_direction=known_parallax if offset is None else (-offset[0], -offset[1]),
            radiometry=centikelvin if is_thermal(band) else _radiometry(tags),
            uncalibrated="" if is_thermal(band) else _without_calibration(tags),
            lens_offset=offset,
        )
        return (band,)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the pose in the camera's tags, else the attitude of the light sensor on the same aircraft."""
        by_sensor = Pose(*_sensor_attitude_deg(tags), focal_length_px=pix4d.focal_length_px(tags))
        return pix4d.pose_of(tags) or (None if tags.number(_DLS, "Yaw") is None else by_sensor)

    def capture_name(self, path: Path) -> str:
        return re.sub(r"_\d+$", "", path.stem)


def _radiometry(tags: Tags) -> Radiometry | None:
    """L = V a1 / g (p - p_black) / (t + a2 y - a3 t y) with p = raw / 65536, vignetting V, gain g = ISO / 100, exposure
    time t and row y; reflectance = pi L / E with the irradiance E of the light sensor on a horizontal plane.
    """
    a = tags.numbers(_MICASENSE, "RadiometricCalibration")
    exposure_s = finite(tags.exif.get("ExposureTime"))
    iso = finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")))
    if len(a) != 3 or not exposure_s or tags.black_level is None or not iso:
        return None
    irradiance = _irradiance(tags)
    centre, k = tags.numbers(pix4d.NAMESPACE, "VignettingCenter"), tags.numbers(pix4d.NAMESPACE, "VignettingPolynomial")
    has_vignetting = len(centre) == 2
    return Radiometry(
        "radiance",
        tags.black_level,
        FULL_SCALE,
        a[0] / (iso / 100) / exposure_s,
        (centre[0], centre[1]) if has_vignetting else (0.0, 0.0),
        k if has_vignetting else (),
        True,
        a[1] / exposure_s - a[2],
        (math.pi / math.prod(irradiance), "reflectance") if irradiance else None,
        tags={"calibration coefficient": a[0], "sensor gain": iso / 100, "exposure time (s)": exposure_s},
    )


def _without_calibration(tags: Tags) -> str:
    """The tags that radiance needs and the file lacks, in words; empty if it lacks none."""
    has = {
        "RadiometricCalibration": tags.text(_MICASENSE, "RadiometricCalibration"),
        "ExposureTime": tags.exif.get("ExposureTime"),
        "ISOSpeed": tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")),
        "BlackLevel": tags.black_level is not None,
    }
    missing = [name for name, value in has.items() if not value]
    return f"no tag {', '.join(missing)} for radiance" if missing else ""


def _irradiance(tags: Tags) -> tuple[float, float] | None:
    """(irradiance on a horizontal plane in the unit of the tags, this unit in W / m^2 / nm); None if there is no
    plausible one.

    Older sensors measure only in their own plane: the time, the place and the attitude then give the horizontal one.
    """
    time = CaptureTime.of(tags.captured_at)
    is_clock_set = time is not None and time.utc.year > 1970  # others count from 1970
    sun = sun_position(tags.position, time.utc.timestamp()) if tags.position and time and is_clock_set else None
    scale = tags.number(_DLS, "IrradianceScaleToSIUnits")
    value, unit = _measured_horizontal(tags, sun), scale or 0.01  # the unit without a tag
    if value is None or value <= 0:
        value, unit = tags.number(_DLS, "SpectralIrradiance"), scale or 1.0
        value = tags.number(pix4d.NAMESPACE, "Irradiance") if value is None else value
        if value is not None and sun is not None:
            value = horizontal_irradiance(value, _sensor_attitude_deg(tags), sun)
    # Products of damaged tags underflow.
    return None if value is None or not value * unit > 0 else (value, unit)


def _measured_horizontal(tags: Tags, sun: tuple[float, float] | None) -> float | None:
    """HorizontalIrradiance, in the unit of the tag; from its direct and diffuse components where it contradicts them,
    because early firmware of the DLS 2 calculates only them correctly.
    """
    names = "HorizontalIrradiance", "DirectIrradiance", "ScatteredIrradiance"
    horizontal, direct, diffuse = (tags.number(_DLS, name) for name in names)
    if sun is None or horizontal is None or not direct or not diffuse:
        return horizontal
    calculated = direct * math.sin(sun[0]) + diffuse
    # Of HorizontalIrradiance: correct firmware differs from its own components by 0.03 %, from refraction.
    max_horizontal_error = 0.01
    return horizontal if abs(horizontal - calculated) < max_horizontal_error * horizontal else calculated


def _sensor_attitude_deg(tags: Tags) -> tuple[float, float, float]:
    """(yaw, pitch, roll) of the light sensor; zeros if they are missing, as in MicaSense's library."""
    yaw, pitch, roll = (math.degrees(tags.number(_DLS, name) or 0.0) for name in ("Yaw", "Pitch", "Roll"))
    return yaw, pitch, roll


def _index_in_name(path: Path) -> str:
    match = re.search(r"_(\d+)$", path.stem)
    return f"band_{match.group(1)}" if match else ""
