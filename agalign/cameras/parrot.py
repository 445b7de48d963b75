"""Parrot Sequoia: four fisheye bands and a perspective colour JPEG.

A ray (X, Y, Z) is projected to [u v] = [C D; E F] rho (X, Y) / sqrt(X^2 + Y^2) + c with
theta = (2 / pi) atan2(sqrt(X^2 + Y^2), Z) and rho = p0 + p1 theta + p2 theta^2 + p3 theta^3, FisheyePolynomial p,
FisheyeAffineMatrix C, D, E, F and principal point c. Near the axis this is a pinhole camera of f = p1 2 C / pi.
RigRelatives rotate a band's camera to that of the green band: H(band -> green) = K_green R K_band^-1. Principal point
and RigRelatives refer to the image after EXIF's Orientation is applied.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras import pix4d
from agalign.cameras.base import Camera, colour_bands, rays_to_rig, rotation
from agalign.cameras.metadata import Tags
from agalign.cameras.model_tables import SEQUOIA, SEQUOIA_PART
from agalign.values.band_names import own_stem
from agalign.values.capture import Band
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens, radial_coefficients
from agalign.values.pixel_units import Size


class Sequoia(Camera):
    """Parrot Sequoia and Sequoia+."""

    name = "Parrot Sequoia"
    capture_ids = ((pix4d.NAMESPACE, "CaptureUUID"),)
    flight_ids = ((pix4d.NAMESPACE, "FlightUUID"),)
    band_in_name = re.compile(
        rf"{SEQUOIA_PART}|(?<=_\d{{4}})_RGB(?![a-z0-9])|_({'|'.join(SEQUOIA)}|RGB)$", re.IGNORECASE
    )

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "parrot" or tags.text(pix4d.NAMESPACE, "RigName").lower().startswith("sequoia")

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        fisheye = "fisheye" in tags.text(pix4d.NAMESPACE, "ModelType").lower()
        lens = _fisheye_lens(tags, stored[0].size_px) if fisheye else pix4d.perspective_lens(tags)
        to_camera = np.eye(3)
        if tags.orientation == 3:
            lens, to_camera = lens and _upside_down(lens, stored[0].size_px), np.diag([-1.0, -1.0, 1.0])
        to_rig = rays_to_rig(lens, rotation(*pix4d.rig_degrees(tags)) @ to_camera)
        if len(stored) > 1:
            return colour_bands(stored, lens, to_rig)
        suffix = self.band_in_name.search(own_stem(path))
        described = pix4d.described(stored[0], tags, path.stem)
        name = SEQUOIA.get(suffix[0][1:].upper(), (suffix[0][1:], 0.0))[0] if suffix else described.name
        band = replace(described, name=name, lens=lens, to_rig=to_rig)
        # Parrot's formula for them has not been compared with a reference.
        why = "no tags for radiance (SensorModel and IrradianceList are not used)"
        return (replace(band, missing_calibration=why if tags.text(pix4d.NAMESPACE, "SensorModel") else ""),)


def _fisheye_lens(tags: Tags, size_px: Size) -> Lens | None:
    polynomial, affine = (tags.numbers(pix4d.NAMESPACE, f"Fisheye{name}", 4) for name in ("Polynomial", "AffineMatrix"))
    centre_px = pix4d.principal_point_px(tags)
    if len(polynomial) != 4 or len(affine) != 4 or centre_px is None:
        return None
    c, d, e, f = affine
    slope = polynomial[1]
    max_shear = 1e-3  # `Lens` has none
    if not (c > 0 and f > 0 and slope > 0) or polynomial[0] != 0 or max(abs(d), abs(e)) > max_shear * c:
        return None
    fx, fy = slope * 2 * c / math.pi, slope * 2 * f / math.pi
    cx, cy = centre_px
    corner_distance = math.hypot(max(cx, size_px[0] - cx) / fx, max(cy, size_px[1] - cy) / fy)

    def distorted(r: Matrix) -> Matrix:
        """Distance from the principal point, in focal lengths, of a ray at r = tan(angle from the axis)."""
        theta = 2 / math.pi * np.arctan(r)
        return np.asarray(np.polynomial.polynomial.polyval(theta, polynomial) * math.pi / (2 * slope))

    rays = np.linspace(0.0, 3.0, 1000)  # up to 72 degrees from the axis, beyond the corners of any Sequoia
    corner_ray = float(np.interp(corner_distance, distorted(rays), rays))
    # The distortion is fitted beyond the corners, so that it is accurate at the border.
    return Lens(fx, fy, cx, cy, radial_coefficients(distorted, 1.1 * corner_ray))


def _upside_down(lens: Lens, size_px: Size) -> Lens:
    """The lens in pixels of the stored image, rotated by 180 degrees: tangential distortion changes its sign."""
    k = lens.distortion
    distortion = (*k[:2], -k[2], -k[3], *k[4:]) if len(k) > 3 else k
    cx, cy = pix4d.rotated_180((lens.cx_px, lens.cy_px), size_px)
    return replace(lens, cx_px=cx, cy_px=cy, distortion=distortion)
