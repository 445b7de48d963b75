"""DJI Phantom 4 Multispectral and Mavic 3 Multispectral: one TIFF a band and a JPEG in colour.

Phantom 4: x_band = x_reference + (RelativeOpticalCenter_band - RelativeOpticalCenter_reference) between raw pixels. Its
DewarpData makes the bands fit worse than none (0.13 to 0.19 px against 0.08 to 0.11 px on the best homography), and
DewarpHMatrix is worse than no seed at all: neither is used.

Mavic 3: after undistortion by DewarpData, CalibratedHMatrix maps a band to a plane that all bands share:
H(reference -> band) = C_band^-1 C_reference. Firmware without it: the rule of the Phantom 4. Its bands are exposed one
after another, so that in motion a seed is off by tens of pixels.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras.base import Camera, band_of, colour_bands, spectral
from agalign.cameras.metadata import Tags
from agalign.errors import GeometryError
from agalign.pixels.raster import RasterInfo
from agalign.values import geometry
from agalign.values.capture import Band, Radiometry
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

_PHANTOM_4_BANDS = {"1": "Blue", "2": "Green", "3": "Red", "4": "RedEdge", "5": "NIR"}
_MAVIC_3_BANDS = {"G": "Green", "R": "Red", "RE": "RedEdge", "NIR": "NIR"}
_MAVIC_3_NAME = re.compile(r"^(?P<capture>.*?)_(?:MS_(?P<band>G|RE?|NIR)|D)$", re.IGNORECASE)


class Dji(Camera):
    """The multispectral cameras of DJI."""

    name = "DJI"

    def recognises(self, tags: Tags) -> bool:
        return tags.make.upper() == "DJI" or ("drone-dji", "CaptureUUID") in tags.xmp

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        calibrated = _matrix(tags, "CalibratedHMatrix")
        lens = _lens(tags) if calibrated is not None else None
        to_rig = _shift_to_rig(tags) if lens is None else calibrated
        if len(info.dtypes) > 1:
            return colour_bands(path, info, lens, to_rig)
        name = tags.text("Camera", "BandName") or tags.text("drone-dji", "BandName") or _band_in_name(path)
        band = spectral(band_of(path, info, name), tags)
        return (replace(band, lens=lens, to_rig=to_rig, radiometry=_radiometry(tags)),)

    def capture_key(self, path: Path, tags: Tags) -> str:
        return tags.text("drone-dji", "CaptureUUID") or self.capture_name(path)

    def capture_name(self, path: Path) -> str:
        mavic = _MAVIC_3_NAME.match(path.stem)
        return mavic["capture"] if mavic else re.sub(r"(?<=\d)\d$", "", path.stem)


def _radiometry(tags: Tags) -> Radiometry | None:
    """The signal is (raw - black) / 65536 (1 + k1 r + ... + k6 r^6) / (gain exposure), and as DJI's guide has
    it, signal SensorGainAdjustment / Irradiance is reflectance up to a factor that all bands share.
    """
    gain, exposure_us = tags.number("drone-dji", "SensorGain"), tags.number("drone-dji", "ExposureTime")
    black = tags.number("drone-dji", "BlackLevel") or tags.number("Camera", "BlackCurrent") or tags.black_level
    if not gain or not exposure_us or black is None:
        return None
    irradiance = tags.number("drone-dji", "Irradiance")
    adjusted = tags.number("drone-dji", "SensorGainAdjustment") or 1.0
    centre = [tags.number("drone-dji", f"CalibratedOpticalCenter{axis}") for axis in "XY"]
    k = tags.numbers("drone-dji", "VignettingData")
    known = centre[0] is not None and centre[1] is not None
    return Radiometry(
        "relative reflectance" if irradiance else "radiance", black, 65536.0,
        adjusted / (gain * exposure_us / 1e6) / (irradiance or 1.0),
        (centre[0] or 0.0, centre[1] or 0.0), k if known else (), False,
    )  # fmt: skip


def _band_in_name(path: Path) -> str:
    mavic = _MAVIC_3_NAME.match(path.stem)
    if mavic and mavic["band"]:
        return _MAVIC_3_BANDS[mavic["band"].upper()]
    return _PHANTOM_4_BANDS.get(path.stem[-1], path.stem)


def _shift_to_rig(tags: Tags) -> Matrix | None:
    centre = [tags.number("drone-dji", f"RelativeOpticalCenter{axis}") for axis in "XY"]
    if centre[0] is None or centre[1] is None:
        return None
    return geometry.translation(-centre[0], -centre[1])


def _matrix(tags: Tags, name: str) -> Matrix | None:
    values = tags.numbers("drone-dji", name)
    if len(values) != 9:
        return None
    matrix = np.array(values).reshape(3, 3)
    try:
        geometry.invert(matrix)
    except GeometryError:
        return None
    return matrix


def _lens(tags: Tags) -> Lens | None:
    """K = [fx, fy, COCx + cx, COCy + cy] from DewarpData 'date;fx,fy,cx,cy,k1,k2,p1,p2,k3'."""
    _, _, text = tags.text("drone-dji", "DewarpData").rpartition(";")
    centre = [tags.number("drone-dji", f"CalibratedOpticalCenter{axis}") for axis in "XY"]
    try:
        fx, fy, cx, cy, *k = (float(part) for part in text.split(","))
    except ValueError:
        return None
    if len(k) != 5 or not (fx > 0 and fy > 0) or centre[0] is None or centre[1] is None:
        return None
    return Lens(fx, fy, centre[0] + cx, centre[1] + cy, tuple(k))
