"""MicaSense RedEdge-3, -M, -MX, -P, dual, Altum and Altum-PT: one TIFF per band, with EXIF and XMP tags.

Between undistorted pixels H(reference -> band) = K_band R_band^T R_reference K_reference^-1 with
R(a, b, c) = Rx(a) Ry(b) Rz(c) from Camera:RigRelatives in degrees. What remains is a shift by parallax, which is larger
between the two halves of a dual camera because of the longer baseline.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, is_thermal, rays_to_rig, rotation
from agalign.cameras.consistency import full_scale, raw_step_of
from agalign.cameras.dls import NAMESPACE as DLS
from agalign.cameras.dls import irradiance, sun_by_sensor
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.sun import Sun
from agalign.values.band_names import own_stem
from agalign.values.capture import Band, Pose
from agalign.values.radiometric_errors import FACTORY_CALIBRATION, NO_VIGNETTING, agreed
from agalign.values.radiometry import Radiometry, ReflectanceFactor

NAMESPACE = "micasense.com/MicaSense"
CALIBRATION = NAMESPACE, "RadiometricCalibration"
_SENSITIVITY = pix4d.NAMESPACE, "BandSensitivity"
_COEFFICIENT_BY_SENSITIVITY = 3.8079e-5
"""Product of the first coefficient of RadiometricCalibration and BandSensitivity, in 60 files of five RedEdge."""
_MAX_ABOVE_DARK_ROWS = 100.0
"""Of the black level, 4,800: dark rows have 4,870 to 6,500, the more the larger the gain is."""
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
        described = pix4d.described(stored[0], tags, f"band{numbered[0]}" if numbered else path.stem)
        lens, offset = pix4d.perspective_lens(tags), pix4d.lens_offset(tags)
        known_parallax = _REDEDGE_M_PARALLAX.get(described.name) if tags.model == "RedEdge-M" else None
        saturation, max_twelve_bit_value = stored[0].saturation_value, 65520.0  # stored in the upper bits of uint16
        band = replace(
            _with_radiometry(described, tags),
            saturation_value=saturation if saturation is None else min(saturation, max_twelve_bit_value),
            lens=lens,
            to_rig=rays_to_rig(lens, rotation(*pix4d.rig_degrees(tags))),
            parallax_direction=known_parallax if offset is None else (-offset[0], -offset[1]),
            lens_offset=offset,
        )
        return (band,)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the pose in the camera's tags, else the attitude of the light sensor on the same aircraft."""
        yaw, pitch, roll = (tags.number(DLS, name) for name in ("Yaw", "Pitch", "Roll"))
        if (by_camera := pix4d.pose_of(tags)) is not None or yaw is None:
            return by_camera
        yaw_deg, pitch_deg, roll_deg = (math.degrees(angle or 0.0) for angle in (yaw, pitch, roll))
        return Pose(yaw_deg, pitch_deg, roll_deg, focal_length_px=pix4d.focal_length_px(tags))

    def contradictions(self, tags: Tags) -> Iterator[str]:
        """Compare what firmware writes twice: coefficient and sensitivity, black level and dark rows, wavelengths."""
        a, sensitivity = tags.numbers(*CALIBRATION, 3), tags.number(*_SENSITIVITY)
        is_known = bool(re.fullmatch(r"RedEdge(?!-P).*", tags.model)) and len(a) == 3 and bool(sensitivity)
        if is_known and not agreed((a[0] * (sensitivity or 0.0), _COEFFICIENT_BY_SENSITIVITY))[1]:
            yield f"its RadiometricCalibration {a[0]:g} and BandSensitivity {sensitivity:g} contradict each other"
        iso = _iso(tags)
        if iso and not any(abs(iso - 100 * 2**k) < 1 for k in range(6)):
            yield f"its sensor gain of {iso / 100:g} is not one of 1, 2, 4, 8 …"
        dark = tags.numbers(NAMESPACE, "DarkRowValue", 4)
        if dark and tags.black_level is not None and tags.black_level > min(dark) + _MAX_ABOVE_DARK_ROWS:
            yield f"its BlackLevel {tags.black_level:g} is above its DarkRowValue {min(dark):g}"
        nm, of_sensor_nm = tags.number(pix4d.NAMESPACE, "CentralWavelength"), tags.number(DLS, "CenterWavelength")
        if not agreed((nm, of_sensor_nm))[1]:
            yield f"its CentralWavelength {nm:g} and the CenterWavelength {of_sensor_nm:g} of the light sensor differ"
        model, rig = tags.model.lower(), tags.text(pix4d.NAMESPACE, "RigName").lower()
        if rig.startswith(("rededge", "altum")) and model and not (model.startswith(rig) or rig.startswith(model)):
            yield f"its Model {tags.model} and RigName {tags.text(pix4d.NAMESPACE, 'RigName')} contradict each other"

    def sun(self, tags: Tags) -> Sun | None:
        return sun_by_sensor(tags)


def calibration_of_output(tags: Tags, band: Band, rows: pix4d.GridRows) -> tuple[float, float, float] | None:
    """Return RadiometricCalibration for raw numbers of a band that are written on other rows, and in all bits of their
    type; None if a tag is missing.

    1 + a2 y / t - a3 y is that of the band's own row up to a factor, which a1 contains. Programs divide by
    2^BitsPerSample, which is 12 in some files of the camera and 16 in the output.
    """
    a, exposure_s = tags.numbers(*CALIBRATION, 3), finite(tags.exif.get("ExposureTime"))
    if len(a) != 3 or not exposure_s:
        return None
    of_camera, known = a[1] / exposure_s - a[2], band.radiometry
    # In an image that a program resized, the band's rows are not those of the camera.
    step = known.row_gradient / of_camera if known is not None and known.row_gradient and of_camera else 1.0
    at_first_row = 1 + of_camera * step * rows.first
    if not at_first_row > 0:
        return None
    of_type = 2.0 ** (8 * np.dtype(band.dtype).itemsize)
    full_scale = known.full_scale if known is not None and known.is_of_light else of_type
    a1, a2, a3 = (k / at_first_row for k in a)
    return a1 * of_type / full_scale, a2 * step * rows.step, a3 * step * rows.step


def _iso(tags: Tags) -> float | None:
    return finite(tags.exif.get("ISOSpeed", tags.exif.get("ISOSpeedRatings")))


def _with_radiometry(band: Band, tags: Tags) -> Band:
    """The band with the calibration in its tags, or with what they lack or have wrongly.

    L = V a1 / g (p - p_black) / (t + a2 y - a3 t y) with p = raw / 2^bits, vignetting V, gain g = ISO / 100,
    exposure time t and row y; reflectance = pi L / E with the irradiance E of the light sensor on a horizontal plane.
    """
    if is_thermal(band):
        centikelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)  # in agreement with the Altum's SceneTemperature
        return replace(band, radiometry=centikelvin)
    light = irradiance(tags)
    band = replace(band, implausible=light.problem)
    a, exposure_s = tags.numbers(*CALIBRATION, 3), finite(tags.exif.get("ExposureTime"))
    black_level, iso = tags.black_level, _iso(tags)
    if len(a) != 3 or not exposure_s or black_level is None or not iso:
        has = {"RadiometricCalibration": len(a) == 3, "ExposureTime": exposure_s, "ISOSpeed": iso}
        has["BlackLevel"] = black_level is not None
        missing = ", ".join(name for name, value in has.items() if not value)
        return replace(band, missing_calibration=f"no tag {missing} for radiance")
    of_sensor = {"irradiance (W / m^2 / nm)": light.value} if light.value else {}  # 0 without a reading
    centre, k = pix4d.vignetting(tags)
    radiometry = Radiometry(
        "radiance",
        black_level,
        full_scale(band),
        a[0] / (iso / 100) / exposure_s,
        centre,
        k,
        True,
        a[1] / exposure_s - a[2],
        ReflectanceFactor(math.pi / light.value, errors=light.errors) if light.value > 0 else None,
        raw_step=raw_step_of(tags, band),
        tags={"calibration coefficient": a[0], "sensor gain": iso / 100, "exposure time (s)": exposure_s} | of_sensor,
        errors=(FACTORY_CALIBRATION,) if k else (FACTORY_CALIBRATION, NO_VIGNETTING["MicaSense"]),
    )
    return replace(band, radiometry=radiometry)
