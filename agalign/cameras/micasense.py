"""MicaSense RedEdge-3, -M, -MX, -P, dual, Altum and Altum-PT: one TIFF a band, everything in EXIF and XMP.

Between undistorted pixels H(reference -> band) = K_band R_band^T R_reference K_reference^-1 with
R(a, b, c) = Rx(a) Ry(b) Rz(c) from Camera:RigRelatives in degrees. What is left is a shift by parallax.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign import geometry
from agalign.cameras.base import largest_value
from agalign.geometry import Matrix
from agalign.metadata import Tags, rational
from agalign.raster import RasterInfo
from agalign.records import Band, Lens

_TWELVE_BIT_TOP = 65520.0
"""RedEdge cameras store 12 bits in the upper bits of uint16."""
_LONGEST_FOCAL_LENGTH_MM = 100.0
"""Focal lengths above this are in pixels: old firmware gives px without saying so."""


class MicaSense:
    """The MicaSense family."""

    name = "MicaSense"

    def recognises(self, tags: Tags) -> bool:
        return tags.make.lower() == "micasense" or ("MicaSense", "CaptureId") in tags.xmp

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        name = tags.text("Camera", "BandName") or _index_in_name(path) or path.stem
        reference = tags.text("Camera", "RigRelativesReferenceRigCameraIndex")
        band = Band(
            name=name,
            path=path,
            band_index=1,
            width_px=info.width_px,
            height_px=info.height_px,
            dtype=info.dtypes[0],
            nodata=info.nodata[0],
            has_mask=info.has_mask,
            wavelength_nm=tags.number("Camera", "CentralWavelength"),
            bandwidth_nm=tags.number("Camera", "WavelengthFWHM"),
            saturation_value=_TWELVE_BIT_TOP if info.dtypes[0] == "uint16" else largest_value(info.dtypes[0]),
            lens=_lens(tags),
            rig_group=f"{tags.serial.split('-')[0][:2]}/{reference}",
        )
        angles = tags.numbers("Camera", "RigRelatives")
        return (replace(band, rig_rotation=rotation(*angles)),) if len(angles) == 3 else (band,)

    def capture_key(self, path: Path, tags: Tags) -> str:
        return tags.text("MicaSense", "CaptureId") or self.capture_name(path)

    def capture_name(self, path: Path) -> str:
        return re.sub(r"_\d+$", "", path.stem)

    def rig_seed(self, reference: Band, moving: Band) -> Matrix | None:
        if reference.lens is None or moving.lens is None:
            return None
        turn = np.eye(3)
        here, there = reference.rig_rotation, moving.rig_rotation
        if here is not None and there is not None and reference.rig_group == moving.rig_group:
            turn = there.T @ here
        return geometry.compose(moving.lens.matrix, turn, geometry.invert(reference.lens.matrix))


def rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    """R = Rx(a) Ry(b) Rz(c), right-handed, angles in degrees."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.radians([a_deg, b_deg, c_deg])), np.cos(np.radians([a_deg, b_deg, c_deg]))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z)


def _lens(tags: Tags) -> Lens | None:
    """K = [f r, f r, ppx r, ppy r] with r in px/mm; Camera:PerspectiveDistortion is k1, k2, k3, p1, p2."""
    density = tags.pixels_per_mm
    focal = tags.number("Camera", "PerspectiveFocalLength")
    centre = tags.numbers("Camera", "PrincipalPoint")
    if focal is None or focal <= 0 or len(centre) != 2:
        return None
    in_px = "px" in tags.text("Camera", "PerspectiveFocalLengthUnits").lower() or "pixel" in tags.text(
        "Camera", "PerspectiveFocalLengthUnits"
    )
    in_px = in_px or focal > _LONGEST_FOCAL_LENGTH_MM
    if density is None:
        focal_mm = rational(tags.exif.get("FocalLength"))
        if not (in_px and focal_mm):
            return None
        density = focal / focal_mm
    focal_px = focal if in_px else focal * density
    k = tags.numbers("Camera", "PerspectiveDistortion")
    distortion = (k[0], k[1], k[3], k[4], k[2]) if len(k) == 5 else ()
    return Lens(focal_px, focal_px, centre[0] * density, centre[1] * density, distortion)


def _index_in_name(path: Path) -> str:
    match = re.search(r"_(\d+)$", path.stem)
    return f"band_{match.group(1)}" if match else ""
