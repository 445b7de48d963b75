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

from agalign.cameras.base import Camera, band_of, colour_bands, rays_to_rig, rotation
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import (
    BAND_NAME,
    CAMERA,
    CAPTURE_UUID,
    FLIGHT_UUID,
    FOCAL_LENGTH,
    FOCAL_LENGTH_UNITS,
    MODEL_TYPE,
    TagTransfer,
    number_text,
    perspective_lens,
    principal_point_px,
    rig_degrees,
    rotated_180,
    spectral,
)
from agalign.cameras.xmp import Name, Packet
from agalign.pixels.raster import RasterInfo
from agalign.values.capture import Band
from agalign.values.geometry import Matrix
from agalign.values.image import OutputGrid
from agalign.values.lens import Lens, radial_coefficients

_NAMES = {"GRE": "Green", "RED": "Red", "REG": "Red edge", "NIR": "NIR"}
_SUFFIX = re.compile(r"_(GRE|RED|REG|NIR|RGB)$", re.IGNORECASE)
_MAX_RAY_TAN = 3.0
"""tan of the largest angle from the axis that a lens is fitted to: 72 degrees."""
_CORNER_MARGIN = 1.1
"""The lens is fitted to this multiple of the corners' rays, so that it holds at the image's border."""
_FIT_SAMPLES = 1000
_MAX_SHEAR = 1e-3
"""Of a fisheye's affine matrix, relative to its scale: more cannot be expressed and leaves the lens out."""


_POLYNOMIAL: Name = (CAMERA, "FisheyePolynomial")
_AFFINE: Name = (CAMERA, "FisheyeAffineMatrix")
_FISHEYE: tuple[Name, ...] = (_POLYNOMIAL, _AFFINE, (CAMERA, "FisheyeAffineSymmetric"))


class _TagTransfer(TagTransfer):
    geometry = TagTransfer.geometry | {*_FISHEYE}
    in_px = (_AFFINE,)
    principal_point_follows_orientation = True

    def put_geometry(
        self, packet: Packet, reference_packet: Packet, reference: Band, tags: Tags, grid: OutputGrid
    ) -> None:
        super().put_geometry(packet, reference_packet, reference, tags, grid)
        density = self.pixels_per_mm(tags)
        if grid.undistorted and tags.numbers(*_AFFINE) and density and reference.lens is not None:
            # What was a fisheye is a pinhole now.
            packet.remove(_FISHEYE)
            packet.put(MODEL_TYPE, ["perspective"])
            packet.add(FOCAL_LENGTH, number_text(reference.lens.fx_px / density))
            packet.add(FOCAL_LENGTH_UNITS, "mm")


class Sequoia(Camera):
    """Parrot Sequoia and Sequoia+."""

    name = "Parrot Sequoia"
    capture_ids = (CAPTURE_UUID,)
    flight_ids = (FLIGHT_UUID,)
    tag_transfer = _TagTransfer()

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "parrot" or tags.text(CAMERA, "RigName").lower().startswith("sequoia")

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        fisheye = "fisheye" in tags.text(*MODEL_TYPE).lower()
        lens = _fisheye_lens(tags, info) if fisheye else perspective_lens(tags)
        to_camera = np.eye(3)
        if self.tag_transfer.is_rotated(tags):
            lens, to_camera = lens and _upside_down(lens, info), np.diag([-1.0, -1.0, 1.0])
        to_rig = rays_to_rig(lens, rotation(*rig_degrees(tags)) @ to_camera)
        if len(info.dtypes) > 1:
            return colour_bands(path, info, lens, to_rig)
        suffix = _SUFFIX.search(path.stem)
        name = _NAMES.get(suffix[1].upper(), suffix[1]) if suffix else tags.text(*BAND_NAME) or path.stem
        return (replace(spectral(band_of(path, info, name), tags), lens=lens, to_rig=to_rig),)

    def capture_name(self, path: Path) -> str:
        return _SUFFIX.sub("", path.stem)


def _fisheye_lens(tags: Tags, info: RasterInfo) -> Lens | None:
    polynomial, affine, centre_px = tags.numbers(*_POLYNOMIAL), tags.numbers(*_AFFINE), principal_point_px(tags)
    if len(polynomial) != 4 or len(affine) != 4 or centre_px is None:
        return None
    c, d, e, f = affine
    slope = polynomial[1]
    if not (c > 0 and f > 0 and slope > 0) or polynomial[0] != 0 or max(abs(d), abs(e)) > _MAX_SHEAR * c:
        return None
    fx, fy = slope * 2 * c / math.pi, slope * 2 * f / math.pi
    cx, cy = centre_px
    reach = math.hypot(max(cx, info.width_px - cx) / fx, max(cy, info.height_px - cy) / fy)

    def bent(r: Matrix) -> Matrix:
        """Distance from the axis in the image over its focal length, of a ray at r = tan(angle)."""
        theta = 2 / math.pi * np.arctan(r)
        return np.asarray(np.polynomial.polynomial.polyval(theta, polynomial) * math.pi / (2 * slope))

    rays = np.linspace(0.0, _MAX_RAY_TAN, _FIT_SAMPLES)
    corner = np.interp(reach, bent(rays), rays)
    return Lens(fx, fy, cx, cy, radial_coefficients(bent, _CORNER_MARGIN * float(corner)))


def _upside_down(lens: Lens, info: RasterInfo) -> Lens:
    """The lens in pixels of the stored image, which is rotated by 180 degrees."""
    k = lens.distortion
    flipped = (*k[:2], -k[2], -k[3], *k[4:]) if len(k) > 3 else k
    cx, cy = rotated_180((lens.cx_px, lens.cy_px), (info.width_px, info.height_px))
    return replace(lens, cx_px=cx, cy_px=cy, distortion=flipped)
