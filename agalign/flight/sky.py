"""Detection of captures of the sky, with which surveys of water quality correct for its reflection."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from operator import call

import numpy as np

from agalign.cameras.base import is_thermal
from agalign.errors import AgalignError
from agalign.flight.panel_readings import Examine
from agalign.pixels.gdal import without_warnings
from agalign.pixels.masks import saturated
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import read_for_alignment, read_tile
from agalign.values.capture import Band, Capture
from agalign.values.image import Raster, Tile

MAX_SKY_TEXTURE = 0.015
"""Maximum relative texture of a band of clear sky. Measured: 0.004 to 0.007 for sky, 0.068 for water without glint,
0.1 to 1 for crops, trees and soil."""
LOOK_PX = 64
"""Longest side to which images are averaged: it suppresses noise and keeps textures of one hundredth of the image."""
_MIN_SHARE = 0.5
"""Minimum share of valid pixels for a texture, and of unsaturated ones for the median radiance."""


def relative_texture(image: Raster, black_level: float = 0.0) -> float | None:
    """Return the standard deviation of an image from a smooth surface, relative to its mean above the black level.

    The image has one channel and `LOOK_PX` along its longest side. None if less than half of it is valid or its mean is
    not above the black level.
    """
    pixels, valid = image.pixels, image.valid
    if pixels.ndim != 2 or valid.mean() < _MIN_SHARE:
        return None
    mean = float(pixels[valid].mean()) - black_level
    if mean <= 0:
        return None
    height, width = valid.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    degree = 4  # of the polynomial that models vignetting and the gradient of the sky
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    basis, values = np.stack([t[valid] for t in terms], axis=-1), (pixels[valid] - black_level) / mean
    if len(values) <= len(terms):
        return None
    surface, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return float((values - basis @ surface).std())


@dataclass(frozen=True)
class SkyCapture:
    """A capture of the sky, and the reasons to classify it so, in words."""

    capture: Capture
    cues: tuple[str, ...]


def sky_cues(capture: Capture, examine: Examine = call) -> tuple[str, ...]:
    """Return the reasons to classify a capture as one of the sky; empty if fewer than two of three hold.

    The camera points above the horizon according to the tags; the name of a folder or the file contains `sky`; no band
    has texture, which alone is also true of fog and calm water. Pixels are read only if one of the first two holds.
    """
    cues = []
    min_elevation_deg = 20.0  # half the field of view is about 20 degrees
    if capture.elevation_deg is not None and capture.elevation_deg > min_elevation_deg:
        cues.append(f"its tags point the camera more than {min_elevation_deg:.0f} degrees above the horizon")
    names = *capture.folder.parts, capture.name
    if any(re.search(r"(?:^|[-_. ])sky(?:$|[-_. ])", name, re.IGNORECASE) for name in names):
        cues.append("its folder or name contains 'sky'")
    if cues and bool(examine(_has_no_texture, capture)):
        cues.append("no band has texture")
    # A single cue also occurs in other captures.
    return tuple(cues) if len(cues) >= 2 else ()


def sky_captures(captures: Iterable[Capture], examine: Examine = call) -> tuple[list[SkyCapture], list[Capture]]:
    """Separate captures into (captures of the sky, other captures), both in their order."""
    with without_warnings():
        classified = [SkyCapture(capture, sky_cues(capture, examine)) for capture in captures]
    return [c for c in classified if c.cues], [c.capture for c in classified if not c.cues]


def sky_radiance(band: Band) -> float | None:
    """Return the median radiance of a band, W / m^2 / sr / nm.

    None without calibration by the camera, if half of the band is saturated, or if its file cannot be read.
    """
    if band.radiometry is None or band.radiometry.quantity != "radiance":
        return None
    try:
        pixels, valid = read_tile(band, Tile(0, 0, *band.size_px))
    except AgalignError:
        return None
    is_saturated = saturated(valid, pixels, band.saturation_value)
    radiance = np.where(is_saturated, np.inf, calibrated(pixels, band.radiometry, 0, 0))[valid]
    if (valid & ~is_saturated).mean() < _MIN_SHARE:
        return None
    return float(np.percentile(radiance, 50, method="lower" if np.isinf(radiance).any() else "linear"))


def _has_no_texture(capture: Capture) -> bool:
    """True if no band has texture, apart from thermal bands, in which the sky has little signal."""
    bands = [b for b in capture.bands if not is_thermal(b) and not b.is_from_photograph]
    return bool(bands) and all(map(_is_smooth, bands))


def _is_smooth(band: Band) -> bool:
    try:
        image = read_for_alignment(band, LOOK_PX)
    except AgalignError:
        return False
    texture = relative_texture(image, 0.0 if band.radiometry is None else band.radiometry.black_level)
    return texture is not None and texture <= MAX_SKY_TEXTURE
