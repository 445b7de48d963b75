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
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, colour_bands
from agalign.cameras.consistency import full_scale, raw_step_of
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.model_tables import MAVIC_3_PART, PHANTOM_4, named_by_camera
from agalign.cameras.tag_text import numbers_in
from agalign.errors import GeometryError
from agalign.values import geometry
from agalign.values.band_names import own_stem
from agalign.values.capture import Band, Pose, Position
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens
from agalign.values.radiometric_errors import (
    FACTORY_CALIBRATION,
    LIGHT_SENSOR,
    NO_GAIN_ADJUSTMENT,
    NO_VIGNETTING,
    REPEATABILITY,
    agreed,
)
from agalign.values.radiometry import Radiometry, ReflectanceFactor

_MAVIC_3_BAND = rf"{MAVIC_3_PART}|(?<=_\d{{4}})_D(?![a-z0-9])|_D$"
NAMESPACE = "dji.com/drone-dji"
_MAX_CENTRES_APART_PX = 5.0
"""Between the two tags of the centre of the vignetting, which firmware writes of one number."""


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
        calibrated = matrix(tags, "CalibratedHMatrix")
        lens = _lens(tags) if is_mavic or calibrated is not None else None
        if len(stored) > 1:
            return colour_bands(stored, lens, None if is_mavic else by_centres)
        band = pix4d.described(stored[0], tags, tags.text(NAMESPACE, "BandName") or _band_in_name(path))
        band = replace(_with_radiometry(band, tags), lens=lens)
        if calibrated is None or lens is None:
            return (replace(band, to_rig=by_centres),)
        return (replace(band, to_rig=calibrated, other_to_rig=by_centres),)

    def with_shared_rig(self, bands: Sequence[Band], tags: Sequence[Tags]) -> list[Band]:
        matrices = (matrix(t, "DewarpHMatrix") for t in tags if _is_mavic_3(t))
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

    def other_position(self, tags: Tags) -> Position | None:
        latitude_deg = tags.number(NAMESPACE, "GpsLatitude")
        names = "GpsLongitude", "GpsLongtitude"  # the second is a mistake of the firmware of the Phantom 4
        longitude_deg = next((v for name in names if (v := tags.number(NAMESPACE, name)) is not None), None)
        if latitude_deg is None or longitude_deg is None or latitude_deg == longitude_deg == 0:
            return None
        is_on_earth = abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180
        altitude_m = tags.number(NAMESPACE, "AbsoluteAltitude")
        return Position(latitude_deg, longitude_deg, altitude_m) if is_on_earth else None

    def contradictions(self, tags: Tags) -> Iterator[str]:
        """Compare what firmware writes twice: the wavelength and the model."""
        nm, frequency = tags.number(pix4d.NAMESPACE, "CentralWavelength"), tags.text(NAMESPACE, "BandFreq")
        of_dji = re.match(r"\d+", frequency)
        if nm is not None and of_dji and not agreed((nm, float(of_dji[0])))[1]:
            yield f"its CentralWavelength {nm:g} and BandFreq {frequency} contradict each other"
        rig = tags.text(pix4d.NAMESPACE, "RigName")
        if tags.model and rig.startswith(("FC", "M3M")) and rig != tags.model:
            yield f"its Model {tags.model} and RigName {rig} contradict each other"

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


def _factors(tags: Tags) -> tuple[dict[str, float], list[str]]:
    """({name of DJI's tag: value in its unit}, names of tags that others contradict): what the radiometry of a file
    depends on. Firmware writes most of it in two tags; a value of 0 is missing, except the black level.
    """
    of_dji, of_pix4d = partial(tags.number, NAMESPACE), partial(tags.number, pix4d.NAMESPACE)
    exif_s = finite(tags.exif.get("ExposureTime"))
    sources = {
        "SensorGain": (of_dji("SensorGain"),),
        "ExposureTime": (of_dji("ExposureTime"), None if exif_s is None else exif_s * 1e6),  # microseconds
        "BlackLevel": (of_dji("BlackLevel"), of_pix4d("BlackCurrent"), tags.black_level),
        "SensorGainAdjustment": (of_dji("SensorGainAdjustment"), of_pix4d("RadiometricCalibration")),
        "Irradiance": (of_dji("Irradiance"), of_pix4d("Irradiance"), of_pix4d("SunSensor")),
    }
    found = {k: agreed(v if v or k == "BlackLevel" else None for v in values) for k, values in sources.items()}
    known = {name: value for name, (value, _) in found.items() if value is not None}
    return known, [name for name, (_, is_agreed) in found.items() if not is_agreed]


def _vignetting(tags: Tags) -> tuple[tuple[float, float], tuple[float, ...], list[str]]:
    """(centre, k1 ... k6, names of tags that others contradict); no k if they are missing."""
    centre_px, coefficients = pair(tags, "CalibratedOpticalCenter"), tags.numbers(NAMESPACE, "VignettingData", 6)
    other_px, others = pix4d.vignetting(tags)
    if centre_px is None or not any(coefficients):
        return other_px, others, []
    if others and _is_mavic_3(tags):  # its CalibratedOpticalCenter is that of the design, the middle of the image
        centre_px = other_px
    contradicted = []
    if others and not _agree(coefficients, others):
        contradicted.append("VignettingData")
    if others and math.dist(centre_px, other_px) > _MAX_CENTRES_APART_PX:
        contradicted.append("CalibratedOpticalCenter")
    return centre_px, coefficients, contradicted


def _agree(one: Sequence[float], other: Sequence[float]) -> bool:
    """True if two lists of coefficients agree; firmware rounds them differently."""
    return len(one) == len(other) and all(agreed(two)[1] for two in zip(one, other, strict=True))


def _with_radiometry(band: Band, tags: Tags) -> Band:
    """The band with the calibration in its tags, or with what they lack or have in two ways.

    The signal is (raw - black) / 2^bits (1 + k1 r + ... + k6 r^6) / (gain exposure). By DJI's guide, signal *
    SensorGainAdjustment / Irradiance is proportional to reflectance, with the same factor for all bands.
    """
    (known, contradicted), (centre_px, vignetting, of_vignetting) = _factors(tags), _vignetting(tags)
    is_sun_known = "Irradiance" not in contradicted
    band = replace(band, implausible="" if is_sun_known else "other tags contradict Irradiance")
    if missing := [name for name in ("SensorGain", "ExposureTime", "BlackLevel") if name not in known]:
        return replace(band, missing_calibration=f"no tag {', '.join(missing)} for radiance")
    if wrong := [name for name in (*contradicted, *of_vignetting) if name != "Irradiance"]:
        why = f"other tags contradict {', '.join(wrong)}"
        return replace(band, missing_calibration=f"no usable tags for radiance ({why})")
    gain, exposure_s, adjusted = known["SensorGain"], known["ExposureTime"] / 1e6, known.get("SensorGainAdjustment")
    irradiance = known.get("Irradiance", 0.0)  # 0 without a reading
    by_sun = None
    if irradiance > 0 and is_sun_known:
        by_sun = ReflectanceFactor(1 / irradiance, "relative reflectance", errors=(LIGHT_SENSOR[2], REPEATABILITY))
    lacking = [] if vignetting else [NO_VIGNETTING["DJI"]]
    lacking += [] if adjusted else [NO_GAIN_ADJUSTMENT]
    radiometry = Radiometry(
        "relative radiance",
        known["BlackLevel"],
        full_scale(band),
        (adjusted or 1.0) / (gain * exposure_s),
        centre_px,
        vignetting,
        vignetting_divides=False,
        by_sun=by_sun,
        raw_step=raw_step_of(tags, band),
        tags={"sensor gain": gain, "gain adjustment": adjusted or 1.0, "exposure time (s)": exposure_s}
        | ({"relative irradiance": irradiance} if irradiance else {}),
        errors=(FACTORY_CALIBRATION, *lacking),
    )
    return replace(band, radiometry=radiometry)


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


def matrix(tags: Tags, name: str) -> Matrix | None:
    """Return a tag as a matrix (3, 3); None if it is missing or singular."""
    with suppress(GeometryError, ValueError):
        result = np.reshape(tags.numbers(NAMESPACE, name, 9), (3, 3))
        geometry.invert(result)
        return result
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
    terms = list(numbers_in([text], 9))
    return date, terms if len(terms) == 9 else []
