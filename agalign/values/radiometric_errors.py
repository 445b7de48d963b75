"""The parts of the expected error of radiance and reflectance: what causes each, its size, and where that is from.

All sizes are standard errors (1 sigma) in percent of the value; `values.radiometry.total_percent` adds them. "Measured"
is on real captures of three RedEdge-M, a RedEdge and a RedEdge-MX dual, and of two Phantom 4 Multispectral.
"""

import math
from collections.abc import Iterable, Mapping

from agalign.values.radiometry import RadiometricError

FACTORY_CALIBRATION = RadiometricError("factory calibration", 17.0)
"""RMS of the errors of the radiance of five bands of a RedEdge with its factory calibration, -11, 0, 4, 33 and -17 %,
in front of a traceable source (Mamaghani and Salvaggio 2019, https://doi.org/10.3390/s19204453).
"""
PANEL = RadiometricError("calibration panel", 3.0)
"""RMS of the errors of the same bands with a calibration by reference targets, 3, 3, 3, 4 and 1 % (the same source)."""
NO_VIGNETTING: Mapping[str, RadiometricError] = {
    "MicaSense": RadiometricError("vignetting", 12.0, "missing"),
    "DJI": RadiometricError("vignetting", 27.0, "missing"),
}
"""By maker: RMS over the image of the change by the correction, measured on 40 bands (5 to 25 %) and 10 bands."""
NO_GAIN_ADJUSTMENT = RadiometricError("sensor gain adjustment", 40.0, "missing")
"""RMS of the difference of the factor from 1, measured on ten bands."""
NO_TILT = RadiometricError("tilt of the light sensor", 13.0, "missing")
"""RMS of the difference between the irradiance in the plane of the sensor and on a horizontal one, measured on seven
captures of two flights, with the sensor tilted by up to 20 degrees.
"""
LIGHT_SENSOR = {1: RadiometricError("light sensor", 25.0), 2: RadiometricError("light sensor", 10.0)}
"""By version of the sensor. Two calibrated sensors agree with panels within 20 %; the irradiance by the first version,
which measures only in its plane, differs from that on a panel by 40 to 60 % on one flight and 10 to 20 % on another.
"""
PANEL_AND_SENSOR = "calibration panel and light sensor"
"""Name of the contradiction of the two."""
REPEATABILITY = RadiometricError("repeatability of the light sensor", 1.0)
"""Two captures of one forest within seconds differ by 0.1 to 0.6 % in five bands."""
_CORRECTED_TILT_SHARE = 0.25
"""Standard error of the correction of a tilt, relative to the correction by the model of a clear sky: two captures of
one field with corrections of 20 % differ by 7 %, three captures of another one with 17 % by up to 3 %.
"""
_SATURATED_SHARE = 0.5
"""Of a saturated pixel: its value is a lower limit, and sensors that saturate are mostly overexposed by up to 2."""
_LIGHT_PER_HOUR = 0.2
"""Share by which the irradiance changes in an hour under a clear sky with the sun above 40 degrees, at most."""


def tilt_error(correction: float) -> RadiometricError:
    """Return the error of a correction, the irradiance on a horizontal plane relative to that in the sensor's plane."""
    return RadiometricError("tilt of the light sensor", 100 * _CORRECTED_TILT_SHARE * abs(correction - 1))


def contradiction(name: str, *values: float) -> RadiometricError:
    """Return the error of a value that sources give differently: the distance of the extremes from their geometric
    mean, because one of them may be right.
    """
    return RadiometricError(name, 100 * (math.sqrt(max(values) / min(values)) - 1), "contradicted")


BRIGHT = "reflectance above 1"
"""Name of the error that only the pixels tell."""


def too_bright(median: float) -> RadiometricError:
    """Return the error of a band whose median reflectance is above 1, which only a wrong panel or sensor explains."""
    max_usual = 0.5  # of vegetation, soil, water and roofs
    return contradiction(BRIGHT, max_usual, median)


def change_of_light(age_s: float) -> float:
    """Return the share by which the irradiance may have changed since a panel was recorded."""
    return _LIGHT_PER_HOUR * age_s / 3600


def panel_errors(spread: float, age_s: float | None) -> tuple[RadiometricError, ...]:
    """Return the errors of a factor by a panel, given the standard deviation of its pixels relative to their mean, and
    the time to the capture if the light since then is not known.
    """
    errors = [PANEL, RadiometricError("homogeneity of the panel", 100 * spread)]
    if age_s is not None:
        errors.append(RadiometricError("light since the panel", 100 * change_of_light(age_s)))
    return tuple(errors)


def saturation_error(share: float) -> RadiometricError:
    """Return the error of the values of a band, given the share of its pixels that are saturated."""
    return RadiometricError("saturation", 100 * _SATURATED_SHARE * share)


def agreed(values: Iterable[float | None]) -> tuple[float | None, bool]:
    """Return the first known value of a tag that has several sources, and whether the others agree with it."""
    tolerance = 0.02  # sources round differently
    known = [v for v in values if v is not None and math.isfinite(v)]
    return next(iter(known), None), all(abs(v - known[0]) <= tolerance * abs(known[0]) for v in known)
