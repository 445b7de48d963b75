"""The downwelling light sensor (DLS) of MicaSense cameras: the irradiance on a horizontal plane.

A DLS 1 that is tilted with the aircraft measures the irradiance in its own plane. By the model of MicaSense's
library (github.com/micasense/imageprocessing, dls.py and image.py) and of OpenDroneMap, with the angle between the sun
and the axis of the sensor,

    measured / transmission(angle) = direct * cos(angle) + diffuse
    horizontal = direct * sin(elevation) + diffuse

Axes are north, east, down; angles are radians.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agalign.cameras import pix4d
from agalign.cameras.base import rotation
from agalign.cameras.consistency import clock_error
from agalign.cameras.metadata import Tags
from agalign.cameras.sun import Sun, sun_position
from agalign.values.capture import known_time_s
from agalign.values.radiometric_errors import LIGHT_SENSOR, NO_TILT, REPEATABILITY, agreed, contradiction, tilt_error
from agalign.values.radiometry import Errors

NAMESPACE = "micasense.com/DLS"
_SCALE_OF_DLS_2 = 0.01
"""W / m^2 / nm per unit of the irradiance of a DLS 2, whose firmware does not always state it."""
_MAX_CORRECTION = 2.0
"""For the tilt of a light sensor: one that points further from the sun measures too little direct light."""


class Irradiance(NamedTuple):
    """Irradiance on a horizontal plane by the light sensor."""

    value: float = 0.0
    """W / m^2 / nm; 0 without a usable reading."""
    errors: Errors = ()
    unit: float = 1.0
    """W / m^2 / nm per unit of the tags of the file."""
    problem: str = ""
    """Why no reading is used although the tags have one; empty if one is, or they have none."""


def irradiance(tags: Tags) -> Irradiance:
    """Return the irradiance on a horizontal plane by the tags of a light sensor.

    The DLS 2 measures direct and diffuse light, so that its value does not depend on its tilt. The DLS 1 measures in
    its own plane: the time, the place and the attitude give the horizontal irradiance.
    """
    by_sensor = sun_by_sensor(tags)
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
    time_s = known_time_s(tags.captured_at)
    return None if tags.near is None or time_s is None else sun_position(tags.near, time_s)


def _horizontal(tags: Tags, elevation: float | None) -> Irradiance | None:
    """The irradiance by a DLS 2, given the elevation of the sun; None without one.

    HorizontalIrradiance is direct light on a horizontal plane plus diffuse light. Early firmware does not write it, or
    calculates only the components correctly: these are used where they contradict it.
    """
    tag, direct, diffuse = (_positive(tags, f"{name}Irradiance") for name in ("Horizontal", "Direct", "Scattered"))
    calculated = None
    if elevation is not None and elevation > 0 and direct is not None and diffuse is not None:
        calculated = direct * math.sin(elevation) + diffuse
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
    unit = _scale_of_dls_2(tags)
    return Irradiance(value * unit, tuple(errors), unit)


def _scale_of_dls_2(tags: Tags) -> float:
    """W / m^2 / nm per unit of the tags of a DLS 2."""
    return _positive(tags, "IrradianceScaleToSIUnits") or _SCALE_OF_DLS_2


def _in_plane_of_sensor(tags: Tags, sun: tuple[float, float] | None) -> Irradiance:
    """The irradiance by a DLS 1, corrected for the tilt of the sensor if the sun and the attitude are known."""
    value, is_agreed = _spectral(tags)
    if not value:
        names = "HorizontalIrradiance", "SpectralIrradiance"
        negative = [name for name in names if (tags.number(NAMESPACE, name) or 0.0) < 0]
        return Irradiance(problem=f"{negative[0]} is negative" if negative else "")
    if not is_agreed:
        return Irradiance(problem="SpectralIrradiance and Irradiance contradict each other")
    max_si = 3.0  # W / m^2 / nm, twice that of a clear noon: larger numbers have the unit of the DLS 2
    unit = _positive(tags, "IrradianceScaleToSIUnits") or (1.0 if value <= max_si else _SCALE_OF_DLS_2)
    attitude_deg = _sensor_attitude_deg(tags)
    if sun is None or attitude_deg is None:
        return Irradiance(value * unit, (LIGHT_SENSOR[1], REPEATABILITY, NO_TILT), unit)
    horizontal = horizontal_irradiance(value, attitude_deg, sun)
    if math.isnan(horizontal):
        return Irradiance(problem="the light sensor points too far from the sun, or the sun is below the horizon")
    return Irradiance(horizontal * unit, (LIGHT_SENSOR[1], REPEATABILITY, tilt_error(horizontal / value)), unit)


def _spectral(tags: Tags) -> tuple[float | None, bool]:
    """(irradiance in the plane of the sensor, in the unit of the tag; False if its two tags contradict each other)."""
    spectral, same = _positive(tags, "SpectralIrradiance"), tags.number(pix4d.NAMESPACE, "Irradiance")
    return agreed((spectral, same if same and same > 0 else None))


def _positive(tags: Tags, name: str) -> float | None:
    """A number of the light sensor; None if it is missing or not positive."""
    number = tags.number(NAMESPACE, name)
    return number if number is not None and number > 0 else None


def sun_by_sensor(tags: Tags) -> Sun | None:
    """Return the position of the sun by the light sensor; None if the tags lack it, or have zeros in its place."""
    elevation, azimuth = tags.number(NAMESPACE, "SolarElevation"), tags.number(NAMESPACE, "SolarAzimuth")
    return Sun(elevation, azimuth) if elevation and elevation > 0 else None


def _sensor_attitude_deg(tags: Tags) -> tuple[float, float, float] | None:
    """(yaw, pitch, roll) of the light sensor; None if an angle is missing."""
    names = "Yaw", "Pitch", "Roll"
    angles = [
        _degrees(tags.number(NAMESPACE, name), tags.number(pix4d.NAMESPACE, f"Irradiance{name}")) for name in names
    ]
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
