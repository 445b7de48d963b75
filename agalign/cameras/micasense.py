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
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, is_thermal, rays_to_rig, rotation
from agalign.cameras.consistency import clock_error, full_scale, raw_step_of
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.sun import Sun, sun_position
from agalign.values.band_names import own_stem
from agalign.values.capture import Band, CaptureTime, Pose, is_clock_set
from agalign.values.radiometric_errors import (
    FACTORY_CALIBRATION,
    LIGHT_SENSOR,
    NO_TILT,
    NO_VIGNETTING,
    REPEATABILITY,
    agreed,
    contradiction,
    tilt_error,
)
from agalign.values.radiometry import Errors, Radiometry, ReflectanceFactor

NAMESPACE, _DLS = "micasense.com/MicaSense", "micasense.com/DLS"
_SCALE_OF_DLS_2 = 0.01
"""W / m^2 / nm per unit of the irradiance of a DLS 2, whose firmware does not always state it."""
_SENSITIVITY = pix4d.NAMESPACE, "BandSensitivity"
_COEFFICIENT_BY_SENSITIVITY = 3.8079e-5
"""Product of the first coefficient of RadiometricCalibration and BandSensitivity, in 60 files of five RedEdge."""
_MAX_ABOVE_DARK_ROWS = 100.0
"""Of the black level, 4,800: dark rows have 4,870 to 6,500, the more the larger the gain is."""
_MAX_CORRECTION = 2.0
"""For the tilt of a light sensor: one that points further from the sun measures too little direct light."""
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
            implausible="" if is_thermal(band) else irradiance(tags).problem,
            lens_offset=offset,
        )
        return (band,)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the pose in the camera's tags, else the attitude of the light sensor on the same aircraft."""
        yaw, pitch, roll = (tags.number(_DLS, name) for name in ("Yaw", "Pitch", "Roll"))
        if (by_camera := pix4d.pose_of(tags)) is not None or yaw is None:
            return by_camera
        yaw_deg, pitch_deg, roll_deg = (math.degrees(angle or 0.0) for angle in (yaw, pitch, roll))
        return Pose(yaw_deg, pitch_deg, roll_deg, focal_length_px=pix4d.focal_length_px(tags))

    def contradictions(self, tags: Tags) -> Iterator[str]:
        """Compare what firmware writes twice: coefficient and sensitivity, black level and dark rows, wavelengths."""
        a, sensitivity = tags.numbers(NAMESPACE, "RadiometricCalibration", 3), tags.number(*_SENSITIVITY)
        is_known = bool(re.fullmatch(r"RedEdge(?!-P).*", tags.model)) and len(a) == 3 and bool(sensitivity)
        if is_known and not agreed((a[0] * (sensitivity or 0.0), _COEFFICIENT_BY_SENSITIVITY))[1]:
            yield f"its RadiometricCalibration {a[0]:g} and BandSensitivity {sensitivity:g} contradict each other"
        iso = finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")))
        if iso and not any(abs(iso - 100 * 2**k) < 1 for k in range(6)):
            yield f"its sensor gain of {iso / 100:g} is not one of 1, 2, 4, 8 …"
        dark = tags.numbers(NAMESPACE, "DarkRowValue", 4)
        if dark and tags.black_level is not None and tags.black_level > min(dark) + _MAX_ABOVE_DARK_ROWS:
            yield f"its BlackLevel {tags.black_level:g} is above its DarkRowValue {min(dark):g}"
        nm, of_sensor_nm = tags.number(pix4d.NAMESPACE, "CentralWavelength"), tags.number(_DLS, "CenterWavelength")
        if not agreed((nm, of_sensor_nm))[1]:
            yield f"its CentralWavelength {nm:g} and the CenterWavelength {of_sensor_nm:g} of the light sensor differ"
        model, rig = tags.model.lower(), tags.text(pix4d.NAMESPACE, "RigName").lower()
        if rig.startswith(("rededge", "altum")) and model and not (model.startswith(rig) or rig.startswith(model)):
            yield f"its Model {tags.model} and RigName {tags.text(pix4d.NAMESPACE, 'RigName')} contradict each other"

    def sun(self, tags: Tags) -> Sun | None:
        return _sun_by_sensor(tags)


def _radiometry(tags: Tags, stored: Band) -> Radiometry | None:
    """L = V a1 / g (p - p_black) / (t + a2 y - a3 t y) with p = raw / 2^bits, vignetting V, gain g = ISO / 100,
    exposure time t and row y; reflectance = pi L / E with the irradiance E of the light sensor on a horizontal plane.
    """
    a = tags.numbers(NAMESPACE, "RadiometricCalibration", 3)
    exposure_s = finite(tags.exif.get("ExposureTime"))
    iso = finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")))
    if len(a) != 3 or not exposure_s or tags.black_level is None or not iso:
        return None
    light = irradiance(tags)
    of_sensor = {"irradiance (W / m^2 / nm)": light.value} if light.value else {}  # 0 without a reading
    centre, k = pix4d.vignetting(tags)
    return Radiometry(
        "radiance",
        tags.black_level,
        full_scale(stored),
        a[0] / (iso / 100) / exposure_s,
        centre,
        k,
        True,
        a[1] / exposure_s - a[2],
        ReflectanceFactor(math.pi / light.value, errors=light.errors) if light.value > 0 else None,
        raw_step=raw_step_of(tags, stored),
        tags={"calibration coefficient": a[0], "sensor gain": iso / 100, "exposure time (s)": exposure_s} | of_sensor,
        errors=(FACTORY_CALIBRATION,) if k else (FACTORY_CALIBRATION, NO_VIGNETTING["MicaSense"]),
    )


def _without_calibration(tags: Tags) -> str:
    """The tags that radiance needs and the file lacks, in words; empty if it lacks none."""
    has = {
        "RadiometricCalibration": tags.numbers(NAMESPACE, "RadiometricCalibration", 3),
        "ExposureTime": finite(tags.exif.get("ExposureTime")),
        "ISOSpeed": finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings"))),
        "BlackLevel": tags.black_level is not None,
    }
    missing = [name for name, value in has.items() if not value]
    return f"no tag {', '.join(missing)} for radiance" if missing else ""


# ---- the light sensor


class Irradiance(NamedTuple):
    """Irradiance on a horizontal plane by the light sensor."""

    value: float = 0.0
    """W / m^2 / nm; 0 without a usable reading."""
    errors: Errors = ()
    problem: str = ""
    """Why no reading is used although the tags have one; empty if one is, or they have none."""


def irradiance(tags: Tags) -> Irradiance:
    """Return the irradiance on a horizontal plane by the tags of a light sensor.

    The DLS 2 measures direct and diffuse light, so that its value does not depend on its tilt. The DLS 1 measures in
    its own plane: the time, the place and the attitude give the horizontal irradiance.
    """
    by_sensor = _sun_by_sensor(tags)
    is_clock_wrong = bool(clock_error(tags.near, tags.captured_at, by_sensor))
    sun = None if is_clock_wrong else _sun_by_clock(tags)
    if is_clock_wrong and by_sensor is not None and by_sensor.azimuth is not None:
        sun = by_sensor.elevation, by_sensor.azimuth
    elevation = sun[0] if sun is not None else None if by_sensor is None else by_sensor.elevation
    horizontal = _horizontal(tags, elevation)
    if horizontal is None:
        return _in_plane_of_sensor(tags, sun)
    measured, attitude_deg = _spectral(tags)[0], _sensor_attitude_deg(tags)
    if measured is None or attitude_deg is None or sun is None or not horizontal.value:
        return horizontal
    by_model = horizontal_irradiance(measured, attitude_deg, sun) * _scale_of_dls_2(tags)
    tilt = [] if math.isnan(by_model) else [tilt_error(by_model / horizontal.value)]
    return horizontal._replace(errors=(*horizontal.errors, *tilt))


def _sun_by_clock(tags: Tags) -> tuple[float, float] | None:
    """(elevation, azimuth) of the sun at the time and place of a file; None if one of them is unknown."""
    time = CaptureTime.of(tags.captured_at)
    if tags.near is None or time is None or not is_clock_set(tags.captured_at):
        return None
    return sun_position(tags.near, time.utc.timestamp())


def _horizontal(tags: Tags, elevation: float | None) -> Irradiance | None:
    """The irradiance by a DLS 2, given the elevation of the sun; None without one.

    HorizontalIrradiance is direct light on a horizontal plane plus diffuse light. Early firmware does not write it, or
    calculates only the components correctly: these are used where they contradict it.
    """
    tag, direct, diffuse = (_positive(tags, f"{name}Irradiance") for name in ("Horizontal", "Direct", "Scattered"))
    has_components = elevation is not None and direct is not None and diffuse is not None
    calculated = direct * math.sin(elevation) + diffuse if has_components and elevation and direct and diffuse else None
    known = [v for v in (tag, calculated) if v is not None]
    if not known:
        return None
    value, errors = known[-1], [LIGHT_SENSOR[2], REPEATABILITY]
    # Of HorizontalIrradiance: correct firmware differs from its own components by 0.03 %, from refraction.
    max_horizontal_error = 0.01
    if tag is not None and calculated is not None and abs(tag - calculated) < max_horizontal_error * tag:
        value = tag
    elif tag is not None and calculated is not None:
        # The sum of the light on a tilted sensor cannot be far from that on a horizontal plane.
        measured = _spectral(tags)[0] or calculated
        near = [v for v in (calculated, tag) if 1 / _MAX_CORRECTION < v / measured < _MAX_CORRECTION]
        if not near:
            names = f"HorizontalIrradiance {tag:g}, SpectralIrradiance {measured:g}"
            return Irradiance(problem=f"{names} and the components ({calculated:.4g}) contradict each other")
        value = near[0]
        errors.append(contradiction("components of the irradiance", tag, calculated))
    return Irradiance(value * _scale_of_dls_2(tags), tuple(errors))


def _scale_of_dls_2(tags: Tags) -> float:
    """W / m^2 / nm per unit of the tags of a DLS 2."""
    return _positive(tags, "IrradianceScaleToSIUnits") or _SCALE_OF_DLS_2


def _in_plane_of_sensor(tags: Tags, sun: tuple[float, float] | None) -> Irradiance:
    """The irradiance by a DLS 1, corrected for the tilt of the sensor if the sun and the attitude are known."""
    value, is_agreed = _spectral(tags)
    if not value:
        names = "HorizontalIrradiance", "SpectralIrradiance"
        negative = [name for name in names if (tags.number(_DLS, name) or 0.0) < 0]
        return Irradiance(problem=f"{negative[0]} is negative" if negative else "")
    if not is_agreed:
        return Irradiance(problem="SpectralIrradiance and Irradiance contradict each other")
    max_si = 3.0  # W / m^2 / nm, twice that of a clear noon: larger numbers have the unit of the DLS 2
    scale = _positive(tags, "IrradianceScaleToSIUnits") or (1.0 if value <= max_si else _SCALE_OF_DLS_2)
    attitude_deg = _sensor_attitude_deg(tags)
    if sun is None or attitude_deg is None:
        return Irradiance(value * scale, (LIGHT_SENSOR[1], REPEATABILITY, NO_TILT))
    horizontal = horizontal_irradiance(value, attitude_deg, sun)
    if math.isnan(horizontal):
        return Irradiance()
    return Irradiance(horizontal * scale, (LIGHT_SENSOR[1], REPEATABILITY, tilt_error(horizontal / value)))


def _spectral(tags: Tags) -> tuple[float | None, bool]:
    """(irradiance in the plane of the sensor, in the unit of the tag; False if its two tags contradict each other)."""
    spectral, same = _positive(tags, "SpectralIrradiance"), tags.number(pix4d.NAMESPACE, "Irradiance")
    return agreed((spectral, same if same and same > 0 else None))


def _positive(tags: Tags, name: str) -> float | None:
    """A number of the light sensor; None if it is missing or not positive."""
    number = tags.number(_DLS, name)
    return number if number is not None and number > 0 else None


def _sun_by_sensor(tags: Tags) -> Sun | None:
    """The position of the sun by the light sensor; None if the tags lack it, or have zeros in its place."""
    elevation, azimuth = tags.number(_DLS, "SolarElevation"), tags.number(_DLS, "SolarAzimuth")
    return Sun(elevation, azimuth) if elevation and elevation > 0 else None


def _sensor_attitude_deg(tags: Tags) -> tuple[float, float, float] | None:
    """(yaw, pitch, roll) of the light sensor; None if an angle is missing."""
    names = "Yaw", "Pitch", "Roll"
    angles = [_degrees(tags.number(_DLS, name), tags.number(pix4d.NAMESPACE, f"Irradiance{name}")) for name in names]
    yaw, pitch, roll = angles
    return None if yaw is None or pitch is None or roll is None else (yaw, pitch, roll)


def _degrees(angle: float | None, other_deg: float | None) -> float | None:
    """An angle, radians, in degrees; by another tag if it is missing, and None if the two contradict each other."""
    if angle is None:
        return other_deg
    angle_deg, max_difference_deg = math.degrees(angle), 1.0  # firmware writes both of one number
    is_other = other_deg is not None and abs((angle_deg - other_deg + 180) % 360 - 180) > max_difference_deg
    return None if is_other else angle_deg


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
    if not 1 / _MAX_CORRECTION < correction < _MAX_CORRECTION:
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
