"""Parrot Sequoia: four fisheye bands and a perspective JPEG in colour.

A ray (X, Y, Z) falls at theta = (2 / pi) atan2(sqrt(X^2 + Y^2), Z), rho = p0 + p1 theta + p2 theta^2 + p3 theta^3, and
[u v] = [C D; E F] rho (X, Y) / sqrt(X^2 + Y^2) + c with FisheyePolynomial p and FisheyeAffineMatrix C, D, E, F. Around
the axis that is a pinhole of f = p1 2 C / pi. RigRelatives turn a band's camera to that of the green one:
H(band -> green) = K_green R K_band^-1. Principal point and RigRelatives are of the image that EXIF's Orientation makes.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras.base import Camera, band_of, colour_bands, perspective_lens, rays_to_rig, rig_rotation, spectral
from agalign.cameras.metadata import Tags
from agalign.pixels.raster import RasterInfo
from agalign.values.capture import Band
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens, radial_coefficients

_NAMES = {"GRE": "Green", "RED": "Red", "REG": "Red edge", "NIR": "NIR"}
_SUFFIX = re.compile(r"_(GRE|RED|REG|NIR|RGB)$", re.IGNORECASE)
_UPSIDE_DOWN = 3
"""EXIF Orientation of an image that is stored turned by 180 degrees."""
_WIDEST_RAY = 3.0
"""tan of the largest angle from the axis that is looked for in an image: 72 degrees."""
_MOST_SHEAR = 1e-3
"""Of a fisheye's affine matrix, relative to its scale: more cannot be expressed and leaves the lens out."""


class Sequoia(Camera):
    """Parrot Sequoia and Sequoia+."""

    name = "Parrot Sequoia"

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "parrot" or tags.text("Camera", "RigName").lower().startswith("sequoia")

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        fisheye = "fisheye" in tags.text("Camera", "ModelType").lower()
        lens = _fisheye_lens(tags, info) if fisheye else perspective_lens(tags)
        turned = tags.orientation == _UPSIDE_DOWN
        if lens is not None and turned:
            lens = _upside_down(lens, info)
        to_rig = rays_to_rig(lens, rig_rotation(tags) @ (np.diag([-1.0, -1.0, 1.0]) if turned else np.eye(3)))
        if len(info.dtypes) > 1:
            return colour_bands(path, info, lens, to_rig)
        suffix = _SUFFIX.search(path.stem)
        name = _NAMES.get(suffix[1].upper(), suffix[1]) if suffix else tags.text("Camera", "BandName") or path.stem
        return (replace(spectral(band_of(path, info, name), tags), lens=lens, to_rig=to_rig),)

    def capture_key(self, path: Path, tags: Tags) -> str:
        return tags.text("Camera", "CaptureUUID") or self.capture_name(path)

    def capture_name(self, path: Path) -> str:
        return _SUFFIX.sub("", path.stem)


def _fisheye_lens(tags: Tags, info: RasterInfo) -> Lens | None:
    polynomial = tags.numbers("Camera", "FisheyePolynomial")
    affine = tags.numbers("Camera", "FisheyeAffineMatrix")
    centre_mm = tags.numbers("Camera", "PrincipalPoint")
    density = tags.pixels_per_mm
    if len(polynomial) != 4 or len(affine) != 4 or len(centre_mm) != 2 or density is None:
        return None
    c, d, e, f = affine
    slope = polynomial[1]
    if not (c > 0 and f > 0 and slope > 0) or polynomial[0] != 0 or max(abs(d), abs(e)) > _MOST_SHEAR * c:
        return None
    fx, fy = slope * 2 * c / math.pi, slope * 2 * f / math.pi
    cx, cy = (v * density for v in centre_mm)
    reach = math.hypot(max(cx, info.width_px - cx) / fx, max(cy, info.height_px - cy) / fy)

    def bent(r: Matrix) -> Matrix:
        """Distance from the axis in the image over its focal length, of a ray at r = tan(angle)."""
        theta = 2 / math.pi * np.arctan(r)
        return np.asarray(np.polynomial.polynomial.polyval(theta, polynomial) * math.pi / (2 * slope))

    rays = np.linspace(0.0, _WIDEST_RAY, 1000)
    corner = np.interp(reach, bent(rays), rays)
    return Lens(fx, fy, cx, cy, radial_coefficients(bent, 1.1 * float(corner)))


def _upside_down(lens: Lens, info: RasterInfo) -> Lens:
    """The lens in pixels of the stored image: principal points count from the image's outer edge."""
    k = lens.distortion
    flipped = (*k[:2], -k[2], -k[3], *k[4:]) if len(k) > 3 else k
    return replace(lens, cx_px=info.width_px - lens.cx_px, cy_px=info.height_px - lens.cy_px, distortion=flipped)
