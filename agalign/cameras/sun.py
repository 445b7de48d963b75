"""Position of the sun."""

import math
from typing import NamedTuple

from agalign.values.capture import Position


class Sun(NamedTuple):
    """Direction of the sun, radians."""

    elevation: float
    azimuth: float | None
    """Clockwise from north; None if it is unknown."""

    def angle_to(self, other: tuple[float, float]) -> float:
        """Return the angle to another (elevation, azimuth); without an azimuth the difference of the elevations."""
        if self.azimuth is None:
            return abs(self.elevation - other[0])
        cosine = math.sin(self.elevation) * math.sin(other[0])
        cosine += math.cos(self.elevation) * math.cos(other[0]) * math.cos(self.azimuth - other[1])
        return math.acos(min(1.0, max(-1.0, cosine)))


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
