"""DJI Phantom 4 Multispectral and Mavic 3 Multispectral: one TIFF a band and a JPEG in colour.

Phantom 4: x_band = x_reference + (RelativeOpticalCenter_band - RelativeOpticalCenter_reference) between raw pixels.
DewarpData and DewarpHMatrix are not used: with DewarpData the residuals of the best homography are 0.13 to 0.19 px,
without it 0.08 to 0.11 px, and DewarpHMatrix is less accurate than the identity.

Mavic 3: after undistortion by DewarpData, CalibratedHMatrix C maps a band to a frame that all bands share:
H(reference -> band) = C_band^-1 C_reference. The rule of the Phantom 4 gives a second seed, and the only one if the
firmware does not write the matrix. DewarpHMatrix, in the files of the bands, maps the shared frame to that of the
colour photograph. The bands are exposed one after another, so in motion a seed is off by tens of pixels.
"""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, colour_bands
from agalign.cameras.consistency import full_scale, raw_step_of
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import MAVIC_3_PART, PHANTOM_4, named_by_camera
from agalign.errors import GeometryError
from agalign.values import geometry
from agalign.values.band_names import own_stem
from agalign.values.capture import Band, Pose, Radiometry
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

_MAVIC_3_BAND = rf"{MAVIC_3_PART}|(?<=_\d{{4}})_D(?![a-z0-9])|_D$"
NAMESPACE = "dji.com/drone-dji"


class Dji(Camera):
    """The multispectral cameras of DJI."""

    name = "DJI"
    capture_ids = ((NAMESPACE, "CaptureUUID"),)
    band_in_name = re.compile(rf"{_MAVIC_3_BAND}|(?<=DJI_\d{{3}})\d(?!\d)|(?<=\d)\d$", re.IGNORECASE)
    utc_times = ((NAMESPACE, "UTCAtExposure"),)

    def recognises(self, tags: Tags) -> bool:
        return tags.make.upper() == "DJI" or (NAMESPACE, "CaptureUUID") in tags.xmp

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        is_mavic = _is_mavic_3(tags) or bool(re.search(_MAVIC_3_BAND, own_stem(path), re.IGNORECASE))
        centre = pair(tags, "RelativeOpticalCenter")
        by_centres = None if centre is None else geometry.translation(-centre[0], -centre[1])
        calibrated = _matrix(tags, "CalibratedHMatrix")
        lens = _lens(tags) if is_mavic or calibrated is not None else None
        if len(stored) > 1:
            return colour_bands(stored, lens, None if is_mavic else by_centres)
        band = pix4d.described(stored[0], tags, tags.text(NAMESPACE, "BandName") or _band_in_name(path))
        band = replace(band, lens=lens, radiometry=_radiometry(tags, stored[0]))
        if calibrated is None or lens is None:
            return (replace(band, to_rig=by_centres),)
        return (replace(band, to_rig=calibrated, other_to_rig=by_centres),)

    def with_shared_rig(self, bands: Sequence[Band], tags: Sequence[Tags]) -> list[Band]:
        matrices = (_matrix(t, "DewarpHMatrix") for t in tags if _is_mavic_3(t))
        to_colour = next((m for m in matrices if m is not None), None)
        if to_colour is None:
            return list(bands)
        to_rig = geometry.invert(to_colour)
        return [replace(b, to_rig=to_rig) if b.is_from_photograph and b.to_rig is None else b for b in bands]

    def pose(self, tags: Tags) -> Pose | None:
        heading_deg, pitch_deg = _heading_deg(tags), tags.number(NAMESPACE, "GimbalPitchDegree")
        if heading_deg is None or pitch_deg is None:
            return None
        focal_length_px = tags.number(NAMESPACE, "CalibratedFocalLength")
        return Pose(heading_deg, pitch_deg + 90, 0.0, _height_m(tags), focal_length_px)

    def motion(self, tags: Tags) -> tuple[float, float] | None:
        """Calculate the motion from the speed over ground (north, east, m/s), the heading of the image's upper edge and
        the height above the take-off point.
        """
        north, east = (tags.number(NAMESPACE, f"Flight{axis}Speed") for axis in "XY")
        heading_deg, height_m = _heading_deg(tags), _height_m(tags)
        if north is None or east is None or heading_deg is None or height_m is None:
            return None
        yaw = math.radians(heading_deg)
        forward = north * math.cos(yaw) + east * math.sin(yaw)
        right = east * math.cos(yaw) - north * math.sin(yaw)
        return -right / height_m, forward / height_m


def _heading_deg(tags: Tags) -> float | None:
    """The heading of the image's upper edge. Some gimbals that look down report a roll of 180 degrees and the opposite
    yaw.
    """
    yaw_deg, roll_deg = tags.number(NAMESPACE, "GimbalYawDegree"), tags.number(NAMESPACE, "GimbalRollDegree")
    max_upright_roll_deg = 90.0  # larger gimbal rolls mean upside down: gimbals write a roll near 0 or near 180 degrees
    is_upside_down = abs(roll_deg or 0.0) > max_upright_roll_deg
    return None if yaw_deg is None else yaw_deg + (180 if is_upside_down else 0)


def _height_m(tags: Tags) -> float | None:
    """The height above the take-off point; None if it is not positive."""
    height_m = tags.number(NAMESPACE, "RelativeAltitude")
    return height_m if height_m and height_m > 0 else None


def _radiometry(tags: Tags, stored: Band) -> Radiometry | None:
    """The signal is (raw - black) / 2^bits (1 + k1 r + ... + k6 r^6) / (gain exposure). By DJI's guide, signal *
    SensorGainAdjustment / Irradiance is proportional to reflectance, with the same factor for all bands.
    """
    gain, exposure_us = tags.number(NAMESPACE, "SensorGain"), tags.number(NAMESPACE, "ExposureTime")
    levels = tags.number(NAMESPACE, "BlackLevel"), tags.number(pix4d.NAMESPACE, "BlackCurrent"), tags.black_level
    black = next((level for level in levels if level is not None), None)  # it may be 0
    if not gain or not exposure_us or black is None:
        return None
    irradiance = tags.number(NAMESPACE, "Irradiance") or 0.0
    adjusted = tags.number(NAMESPACE, "SensorGainAdjustment") or 1.0
    centre, k = pair(tags, "CalibratedOpticalCenter"), tags.numbers(NAMESPACE, "VignettingData")
    return Radiometry(
        "relative radiance",
        black,
        full_scale(stored),
        adjusted / (gain * exposure_us / 1e6),
        centre or (0.0, 0.0),
        k if centre else (),
        vignetting_divides=False,
        by_sun=(1 / irradiance, "relative reflectance") if irradiance > 0 else None,
        raw_step=raw_step_of(tags, stored),
        tags={"sensor gain": gain, "gain adjustment": adjusted, "exposure time (s)": exposure_us / 1e6}
        | ({"relative irradiance": irradiance} if irradiance else {}),  # 0 without a reading
    )


def _is_mavic_3(tags: Tags) -> bool:
    return tags.model.upper().startswith("M3M")


def _band_in_name(path: Path) -> str:
    if of_mavic := named_by_camera(own_stem(path))[1]:
        return of_mavic
    part = Dji.band_in_name.search(own_stem(path))
    known = PHANTOM_4.get(part[0]) if part else None
    return known[0] if known else path.stem


def pair(tags: Tags, name: str) -> tuple[float, float] | None:
    """Return the numbers of the two values whose names end in X and Y; None if one is missing."""
    x, y = (tags.number(NAMESPACE, f"{name}{axis}") for axis in "XY")
    return None if x is None or y is None else (x, y)


def _matrix(tags: Tags, name: str) -> Matrix | None:
    """A tag as a matrix (3, 3); None if it is missing or singular."""
    with suppress(GeometryError, ValueError):
        matrix = np.reshape(tags.numbers(NAMESPACE, name), (3, 3))
        geometry.invert(matrix)
        return matrix
    return None


def _lens(tags: Tags) -> Lens | None:
    """The lens by DewarpData (fx, fy, cx, cy, k …), with the principal point CalibratedOpticalCenter + (cx, cy). If
    DewarpFlag is 1, the image is already undistorted.
    """
    (_, terms), centre = dewarp_data(tags), pair(tags, "CalibratedOpticalCenter")
    if centre is None or not terms or not (terms[0] > 0 and terms[1] > 0):
        return None
    fx, fy, cx, cy, *k = terms
    dewarped = tags.number(NAMESPACE, "DewarpFlag") == 1
    return Lens(fx, fy, centre[0] + cx, centre[1] + cy, () if dewarped else tuple(k))


def dewarp_data(tags: Tags) -> tuple[str, list[float]]:
    """Return (date, [fx, fy, cx, cy, k1, k2, p1, p2, k3]) of DewarpData 'date;fx,fy,…', px, in OpenCV's order; no terms
    if the tag has another form.
    """
    date, _, text = tags.text(NAMESPACE, "DewarpData").rpartition(";")
    with suppress(ValueError):
        terms = [float(part) for part in text.split(",")]
        return date, terms if len(terms) == 9 else []
    return date, []
