"""MicaSense RedEdge-3, -M, -MX, -P, dual, Altum and Altum-PT: one TIFF per band, with EXIF and XMP tags.

Between undistorted pixels H(reference -> band) = K_band R_band^T R_reference K_reference^-1 with
R(a, b, c) = Rx(a) Ry(b) Rz(c) from Camera:RigRelatives in degrees. What remains is a shift by parallax, which is larger
between the two halves of a dual camera because of the longer baseline.

A light sensor that is tilted with the aircraft measures the irradiance in its own plane. By the model of MicaSense's
library (github.com/micasense/imageprocessing, dls.py and image.py) and of OpenDroneMap, with the angle between the sun
and the axis of the sensor,

    measured / transmission(angle) = direct * cos(angle) + diffuse
    horizontal = direct * sin(elevation) + diffuse

Axes are north, east, down; angles are radians.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, is_thermal, rays_to_rig, rotation
from agalign.cameras.consistency import clock_error, full_scale, raw_step_of
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.sun import Sun, sun_position
from agalign.values.band_names import own_stem
from agalign.values.capture import Band, CaptureTime, Pose, Radiometry, is_clock_set

NAMESPACE, _DLS = "micasense.com/MicaSense", "micasense.com/DLS"
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


class MicaSense(Camera):
    """The MicaSense family."""

    name = "MicaSense"
    capture_ids = ((NAMESPACE, "CaptureId"),)
    flight_ids = ((NAMESPACE, "FlightId"),)
    band_in_name = re.compile(r"(?<=IMG_\d{4})_\d{1,2}(?![a-z0-9])|_\d+$", re.IGNORECASE)
    clock_is_utc = True

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "micasense" or (NAMESPACE, "CaptureId") in tags.xmp

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        numbered = self.band_in_name.search(own_stem(path))
        band = pix4d.described(stored[0], tags, f"band{numbered[0]}" if numbered else path.stem)
        lens = pix4d.perspective_lens(tags)
        offset = pix4d.lens_offset(tags)
        known_parallax = _REDEDGE_M_PARALLAX.get(band.name) if tags.model == "RedEdge-M" else None
        centikelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)  # in agreement with the Altum's SceneTemperature
        saturation, max_twelve_bit_value = stored[0].saturation_value, 65520.0  # stored in the upper bits of uint16
        band = replace(
            band,
            saturation_value=saturation if saturation is None else min(saturation, max_twelve_bit_value),
            lens=lens,
            to_rig=rays_to_rig(lens, rotation(*pix4d.rig_degrees(tags))),
            parallax_direction=known_parallax if offset is None else (-offset[0], -offset[1]),
            radiometry=centikelvin if is_thermal(band) else _radiometry(tags, stored[0]),
            missing_calibration="" if is_thermal(band) else _without_calibration(tags),
            lens_offset=offset,
        )
        return (band,)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the pose in the camera's tags, else the attitude of the light sensor on the same aircraft."""
        by_sensor = Pose(*_sensor_attitude_deg(tags), focal_length_px=pix4d.focal_length_px(tags))
        return pix4d.pose_of(tags) or (None if tags.number(_DLS, "Yaw") is None else by_sensor)

    def sun(self, tags: Tags) -> Sun | None:
        return _sun_by_sensor(tags)


def _radiometry(tags: Tags, stored: Band) -> Radiometry | None:
    """L = V a1 / g (p - p_black) / (t + a2 y - a3 t y) with p = raw / 2^bits, vignetting V, gain g = ISO / 100,
    exposure time t and row y; reflectance = pi L / E with the irradiance E of the light sensor on a horizontal plane.
    """
    a = tags.numbers(NAMESPACE, "RadiometricCalibration")
    exposure_s = finite(tags.exif.get("ExposureTime"))
    iso = finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")))
    if len(a) != 3 or not exposure_s or tags.black_level is None or not iso:
        return None
    measured, by_sensor = math.prod(_measured_irradiance(tags) or (0.0,)), irradiance(tags)
    of_sensor = {"irradiance (W / m^2 / nm)": measured} if measured else {}  # 0 without a reading
    centre, k = tags.numbers(pix4d.NAMESPACE, "VignettingCenter"), tags.numbers(pix4d.NAMESPACE, "VignettingPolynomial")
    has_vignetting = len(centre) == 2
    return Radiometry(
        "radiance",
        tags.black_level,
        full_scale(stored),
        a[0] / (iso / 100) / exposure_s,
        (centre[0], centre[1]) if has_vignetting else (0.0, 0.0),
        k if has_vignetting else (),
        True,
        a[1] / exposure_s - a[2],
        (math.pi / math.prod(by_sensor), "reflectance") if by_sensor else None,
        raw_step=raw_step_of(tags, stored),
        tags={"calibration coefficient": a[0], "sensor gain": iso / 100, "exposure time (s)": exposure_s} | of_sensor,
    )


def _without_calibration(tags: Tags) -> str:
    """The tags that radiance needs and the file lacks, in words; empty if it lacks none."""
    has = {
        "RadiometricCalibration": tags.text(NAMESPACE, "RadiometricCalibration"),
        "ExposureTime": tags.exif.get("ExposureTime"),
        "ISOSpeed": tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")),
        "BlackLevel": tags.black_level is not None,
    }
    missing = [name for name, value in has.items() if not value]
    return f"no tag {', '.join(missing)} for radiance" if missing else ""


def irradiance(tags: Tags) -> tuple[float, float] | None:
    """Return (irradiance on a horizontal plane in the unit of the tags, this unit in W / m^2 / nm); None if there is no
    positive one.
    """
    measured = _measured_irradiance(tags)
    # Products of damaged tags underflow.
    return None if measured is None or not math.prod(measured) > 0 else measured


def _measured_irradiance(tags: Tags) -> tuple[float, float] | None:
    """The irradiance as `irradiance`, also one that is not positive; None if there is none.

    Older sensors measure only in their own plane: the time, the place and the attitude then give the horizontal one.
    """
    time, by_sensor = CaptureTime.of(tags.captured_at), _sun_by_sensor(tags)
    is_known = tags.position is not None and time is not None and is_clock_set(tags.captured_at)
    sun = sun_position(tags.position, time.utc.timestamp()) if tags.position and time and is_known else None
    is_clock_wrong = bool(clock_error(tags.position, tags.captured_at, by_sensor))
    scale = tags.number(_DLS, "IrradianceScaleToSIUnits")
    horizontal = _measured_horizontal(tags, None if is_clock_wrong else sun)
    if horizontal is not None and horizontal > 0:
        return horizontal, scale or 0.01  # the unit without a tag
    value = tags.number(_DLS, "SpectralIrradiance")
    value = tags.number(pix4d.NAMESPACE, "Irradiance") if value is None else value
    if value is None:
        return None if horizontal is None else (horizontal, scale or 0.01)
    if is_clock_wrong and by_sensor is not None:
        sun = None if by_sensor.azimuth is None else (by_sensor.elevation, by_sensor.azimuth)
    if sun is not None:
        value = horizontal_irradiance(value, _sensor_attitude_deg(tags), sun)
    return None if math.isnan(value) else (value, scale or 1.0)


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


def _sun_by_sensor(tags: Tags) -> Sun | None:
    """The position of the sun by the light sensor; None if the tags lack it, or have zeros in its place."""
    elevation, azimuth = tags.number(_DLS, "SolarElevation"), tags.number(_DLS, "SolarAzimuth")
    return Sun(elevation, azimuth) if elevation and elevation > 0 else None


def _sensor_attitude_deg(tags: Tags) -> tuple[float, float, float]:
    """(yaw, pitch, roll) of the light sensor; zeros if they are missing, as in MicaSense's library."""
    yaw, pitch, roll = (math.degrees(tags.number(_DLS, name) or 0.0) for name in ("Yaw", "Pitch", "Roll"))
    return yaw, pitch, roll


# ---- the light sensor


def horizontal_irradiance(measured: float, attitude_deg: tuple[float, float, float], sun: tuple[float, float]) -> float:
    """Return the horizontal irradiance, in the unit of `measured`, by a sensor with an attitude (yaw, pitch, roll) and
    the position of the sun; nan if the sun is below the horizon or the sensor points too far from it.
    """
    elevation, azimuth = sun
    yaw, pitch, roll = attitude_deg
    axis: NDArray[np.float64] = rotation(0, 0, yaw) @ rotation(0, pitch, 0) @ rotation(roll, 0, 0) @ [0.0, 0.0, -1.0]
    horizontal = math.cos(elevation)
    to_sun = math.cos(azimuth) * horizontal, math.sin(azimuth) * horizontal, -math.sin(elevation)
    cos_angle = float(np.clip(axis @ to_sun, -1.0, 1.0))
    direct_per_diffuse = 6.0  # ratio under a clear sky that MicaSense's library assumes if a sensor does not measure it
    diffuse = 1 / direct_per_diffuse
    if elevation <= 0 or cos_angle <= 0:
        return math.nan
    correction = (math.sin(elevation) + diffuse) / (cos_angle + diffuse)
    max_correction = 2.0  # a sensor that points further from the sun measures too little direct light
    if not 1 / max_correction < correction < max_correction:
        return math.nan
    return measured / transmission(math.acos(cos_angle)) * correction


def transmission(angle: float) -> float:
    """Return the transmission of unpolarised light from an angle to the normal, 0 to 1, by Fresnel's equations.

    As in MicaSense's library, the refraction at each surface divides the sine by the index of the medium before it.
    """
    result, air, polycarbonate, teflon = 1.0, 1.000277, 1.6, 1.38  # refractive indices: window and diffuser
    for n1, n2 in pairwise((air, polycarbonate, teflon)):
        angle = math.asin(math.sin(angle) / n1)
        before, after = math.cos(angle), math.sqrt(1 - (n1 / n2 * math.sin(angle)) ** 2)
        s_polarised = (n1 * before - n2 * after) / (n1 * before + n2 * after)
        p_polarised = (n1 * after - n2 * before) / (n1 * after + n2 * before)
        result *= 1 - (s_polarised**2 + p_polarised**2) / 2
    return result
