"""Detection of captures of the sky, with which surveys of water quality correct for its reflection."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from agalign.cameras.base import is_thermal
from agalign.errors import AgalignError
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import open_raster, read_for_alignment, read_window, without_warnings
from agalign.pixels.sky import LOOK_PX, MAX_SKY_TEXTURE, relative_texture
from agalign.values.capture import Band, Capture

_MIN_ELEVATION_DEG = 20.0
"""Minimum elevation of the optical axis: half the field of view is about 20 degrees."""
_MIN_UNSATURATED_SHARE = 0.5
"""Minimum share of unsaturated pixels for the median radiance."""
_MIN_CUES = 2
"""A single cue also occurs in other captures."""
_SKY_NAME = re.compile(r"(?:^|[-_. ])sky(?:$|[-_. ])", re.IGNORECASE)


@dataclass(frozen=True)
class SkyCapture:
    """A capture of the sky."""

    capture: Capture
    cues: tuple[str, ...]
    """The reasons to classify it so, in words."""


def sky_cues(capture: Capture) -> tuple[str, ...]:
    """Return the reasons to classify a capture as one of the sky; empty if fewer than two of three hold.

    The camera points above the horizon according to the tags; the name of a folder or the file contains `sky`; no band
    has texture, which alone is also true of fog and calm water. Pixels are read only if one of the first two holds.
    """
    cues = []
    if capture.elevation_deg is not None and capture.elevation_deg > _MIN_ELEVATION_DEG:
        cues.append(f"its tags point the camera {capture.elevation_deg:.0f} degrees above the horizon")
    if any(_SKY_NAME.search(part) for part in (*capture.folder.parts, capture.name)):
        cues.append("its folder or name contains 'sky'")
    if cues and _is_without_texture(capture):
        cues.append("no band has texture")
    return tuple(cues) if len(cues) >= _MIN_CUES else ()


def sky_captures(captures: Iterable[Capture]) -> tuple[list[SkyCapture], list[Capture]]:
    """Separate captures into (captures of the sky, other captures), both in their order."""
    sky: list[SkyCapture] = []
    others: list[Capture] = []
    with without_warnings():
        for capture in captures:
            cues = sky_cues(capture)
            if cues:
                sky.append(SkyCapture(capture, cues))
            else:
                others.append(capture)
    return sky, others


def sky_radiance(band: Band) -> float | None:
    """Return the median radiance of a band, W / m^2 / sr / nm.

    None without calibration by the camera, or if half of the band is saturated. Raises UnreadableFileError.
    """
    if band.radiometry is None or band.radiometry.quantity != "radiance":
        return None
    with open_raster(band.path) as source:
        pixels, valid = read_window(source, band, 0, 0, band.width_px, band.height_px)
    if band.saturation_value is not None:
        valid &= pixels.astype(np.float64) < band.saturation_value
    if valid.mean() < _MIN_UNSATURATED_SHARE:
        return None
    return float(np.median(calibrated(pixels, band.radiometry, 0, 0)[valid]))


def _is_without_texture(capture: Capture) -> bool:
    """Return True if all bands except thermal ones, in which the sky has little signal, have no texture."""
    bands = [b for b in capture.bands if not is_thermal(b) and not b.companion]
    return bool(bands) and all(_is_smooth(b) for b in bands)


def _is_smooth(band: Band) -> bool:
    try:
        image = read_for_alignment(band, LOOK_PX)
    except AgalignError:
        return False
    texture = relative_texture(image, 0.0 if band.radiometry is None else band.radiometry.black_level)
    return texture is not None and texture <= MAX_SKY_TEXTURE
