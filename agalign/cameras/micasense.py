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
from agalign.cameras.metadata import Tags, finite
from agalign.cameras.xmp import names_in
from agalign.values.capture import Band, Pose, Radiometry

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


class MicaSense(Camera):
    """The MicaSense family."""

    name = "MicaSense"
    capture_ids = ((_MICASENSE, "CaptureId"),)
    flight_ids = ((_MICASENSE, "FlightId"),)
    tag_transfer = _TagTransfer()

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "micasense" or (_MICASENSE, "CaptureId") in tags.xmp

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        name = tags.text(pix4d.NAMESPACE, "BandName") or _index_in_name(path) or path.stem
        band = replace(pix4d.with_wavelength(stored[0], tags), name=name)
        lens = pix4d.perspective_lens(tags)
        parallax = pix4d.parallax_of(tags)
        if parallax is None and tags.model == "RedEdge-M":
            parallax = _REDEDGE_M_PARALLAX.get(name)
        centikelvin = Radiometry("temperature", 27315.0, 1.0, 0.01)  # in agreement with the Altum's SceneTemperature
        max_twelve_bit_value = 65520.0  # stored in the upper bits of uint16
        band = replace(
            band,
            saturation_value=max_twelve_bit_value if band.dtype == "uint16" else band.saturation_value,
            lens=lens,
            to_rig=rays_to_rig(lens, rotation(*pix4d.rig_degrees(tags))),
            parallax=parallax,
            radiometry=centikelvin if is_thermal(band) else _radiometry(tags),
            lens_offset=pix4d.lens_offset(tags),
        )
        return (band,)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the pose in the camera's tags, else the attitude of the light sensor on the same aircraft."""
        yaw, pitch, roll = (math.degrees(tags.number(_DLS, name) or 0.0) for name in ("Yaw", "Pitch", "Roll"))
        by_sensor = Pose(yaw, pitch, roll, focal_length_px=pix4d.focal_length_px(tags))
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
        (math.pi / irradiance, "reflectance") if irradiance else None,
    )


def _irradiance(tags: Tags) -> float | None:
    """HorizontalIrradiance, W / m^2 / nm; else the irradiance that an older light sensor measured in its own plane."""
    scale = tags.number(_DLS, "IrradianceScaleToSIUnits")
    candidates = [
        (tags.number(_DLS, "HorizontalIrradiance"), scale or 0.01),  # the unit without a tag
        (tags.number(_DLS, "SpectralIrradiance"), scale or 1.0),
        (tags.number(pix4d.NAMESPACE, "Irradiance"), scale or 1.0),
    ]
    return next((value * unit for value, unit in candidates if value is not None and value * unit > 0), None)


def _index_in_name(path: Path) -> str:
    match = re.search(r"_(\d+)$", path.stem)
    return f"band_{match.group(1)}" if match else ""
