"""Irradiance on a horizontal plane from a light sensor that is tilted with the aircraft.

The model of MicaSense's library (github.com/micasense/imageprocessing, dls.py and image.py) and of OpenDroneMap:

    measured / transmission(angle) = direct * cos(angle) + diffuse
    horizontal = direct * sin(elevation) + diffuse

with the angle between the sun and the sensor's axis. Axes are north, east, down; angles are radians.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from agalign.cameras.base import rotation
from agalign.values.capture import Position

_REFRACTIVE_INDICES = 1.000277, 1.6, 1.38
"""Air, polycarbonate and Teflon: the window and the diffuser of the sensor, by the same library."""
_MAX_CORRECTION = 2.0
"""A sensor that points further from the sun measures too little direct light to calculate it from."""


def sun_position(position: Position, time_s: float) -> tuple[float, float]:
    """Return (elevation, azimuth clockwise from north) of the sun without refraction at a Unix time.

    Equations of NOAA's solar calculator (gml.noaa.gov/grad/solcalc, after Meeus, Astronomical Algorithms), which are
    accurate to 0.01 degrees.
    """
    days = (time_s - 946728000) / 86400  # since noon on 1 January 2000
    t = days / 36525
    anomaly = math.radians(357.52911 + t * (35999.05029 - 0.0001537 * t))
    centre_deg = math.sin(anomaly) * (1.914602 - 0.004817 * t) + math.sin(2 * anomaly) * 0.019993
    node = math.radians(125.04 - 1934.136 * t)
    longitude_deg = 280.46646 + t * 36000.76983 + centre_deg + 0.000289 * math.sin(3 * anomaly) - 0.00569
    longitude = math.radians(longitude_deg - 0.00478 * math.sin(node))
    obliquity = math.radians(23.439291 - 0.0130042 * t + 0.00256 * math.cos(node))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    right_ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    sidereal_deg = 280.46061837 + 360.98564736629 * days  # Meeus, equation 12.4
    hour_angle = math.radians(sidereal_deg + position.longitude) - right_ascension
    latitude = math.radians(position.latitude)
    north = math.cos(latitude) * math.sin(declination)
    north -= math.sin(latitude) * math.cos(declination) * math.cos(hour_angle)
    east = -math.cos(declination) * math.sin(hour_angle)
    up = math.sin(latitude) * math.sin(declination)
    up += math.cos(latitude) * math.cos(declination) * math.cos(hour_angle)
    return math.atan2(up, math.hypot(north, east)), math.atan2(east, north) % math.tau


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
    result = 1.0
    for n1, n2 in pairwise(_REFRACTIVE_INDICES):
        angle = math.asin(math.sin(angle) / n1)
        before, after = math.cos(angle), math.sqrt(1 - (n1 / n2 * math.sin(angle)) ** 2)
        s_polarised = (n1 * before - n2 * after) / (n1 * before + n2 * after)
        p_polarised = (n1 * after - n2 * before) / (n1 * after + n2 * before)
        result *= 1 - (s_polarised**2 + p_polarised**2) / 2
    return result
