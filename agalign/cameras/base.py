"""What agalign asks of a camera, and what several of them have in common.

A new camera is one module with one class of the shape of `Camera`, and one test.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from agalign.cameras.metadata import Tags
from agalign.errors import GeometryError
from agalign.pixels.raster import RasterInfo
from agalign.values import geometry
from agalign.values.capture import Band
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

_PREFERRED_REFERENCES = ("green", "gre", "g")
_THERMAL = ("lwir", "thermal")
_COLOURS = ("Red", "Green", "Blue")


class Camera(Protocol):
    """How one family of cameras groups and names its bands, and what its tags say of lenses and rig."""

    name: str

    def recognises(self, tags: Tags) -> bool:
        """True for files of this camera."""
        ...

    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        """The bands in one of its files, with their lens and their place in the rig."""
        ...

    def capture_key(self, path: Path, tags: Tags) -> str:
        """Files with the same key (and the same camera and folder) are one capture."""
        ...

    def capture_folder(self, path: Path) -> Path:
        """The folder of the capture that a file belongs to."""
        return path.parent

    def capture_name(self, path: Path) -> str:
        """The part of a file's name that the bands of its capture share."""
        ...


def default_reference(bands: Sequence[Band]) -> int:
    """Index of the green band; else of the one nearest to 550 nm; else the first. Never a thermal one."""
    for index, band in enumerate(bands):
        if re.split(r"[-_ ]", band.name.lower())[0] in _PREFERRED_REFERENCES:
            return index
    known = [(abs(b.wavelength_nm - 550), i) for i, b in enumerate(bands) if b.wavelength_nm is not None]
    seeing = [i for i, b in enumerate(bands) if not b.name.lower().startswith(_THERMAL)]
    return min(known)[1] if known else next(iter(seeing), 0)


def rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """fixed_to_moving between undistorted pixels from metadata alone; None where it does not tell."""
    if reference.to_rig is None or moving.to_rig is None:
        return None
    return geometry.normalised(geometry.compose(geometry.invert(moving.to_rig), reference.to_rig))


# ---- for the cameras


def band_of(path: Path, info: RasterInfo, name: str, index: int = 1) -> Band:
    """A band with what its file's raster says."""
    return Band(
        name=name,
        path=path,
        band_index=index,
        width_px=info.width_px,
        height_px=info.height_px,
        dtype=info.dtypes[index - 1],
        nodata=info.nodata[index - 1],
        has_mask=info.has_mask,
        saturation_value=largest_value(info.dtypes[index - 1]),
        georeference=info.georeference,
        scale_offset=info.scales_offsets[index - 1] if info.scales_offsets else (1.0, 0.0),
        overviews=info.overviews,
    )


def colour_bands(
    path: Path, info: RasterInfo, lens: Lens | None = None, to_rig: Matrix | None = None
) -> tuple[Band, ...]:
    """The bands of the colour photograph that a camera takes beside its narrow ones."""
    names = [f"RGB {colour}" for colour in _COLOURS] if len(info.dtypes) >= 3 else ["RGB"]
    return tuple(
        replace(band_of(path, info, name, i), lens=lens, to_rig=to_rig, one_lens=True, companion=True)
        for i, name in enumerate(names, start=1)
    )


def largest_value(dtype: str) -> float | None:
    """The value at which an integer type saturates; None for floats."""
    return {"uint8": 255.0, "uint16": 65535.0, "int16": 32767.0}.get(dtype)


def rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    """R = Rx(a) Ry(b) Rz(c), right-handed, angles in degrees."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.radians([a_deg, b_deg, c_deg])), np.cos(np.radians([a_deg, b_deg, c_deg]))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z)


def rig_rotation(tags: Tags) -> Matrix:
    """R of Camera:RigRelatives in degrees; no rotation where they are missing."""
    angles = tags.numbers("Camera", "RigRelatives")
    return rotation(*angles) if len(angles) == 3 else np.eye(3)


def rays_to_rig(lens: Lens | None, camera_to_rig: Matrix) -> Matrix | None:
    """to_rig of a band whose camera is turned by R: R K^-1; None where the tags make no camera."""
    try:
        return None if lens is None else np.asarray(camera_to_rig @ geometry.invert(lens.matrix))
    except GeometryError:
        return None


def perspective_lens(tags: Tags) -> Lens | None:
    """K = [f r, f r, ppx r, ppy r] with r in px/mm; Camera:PerspectiveDistortion is k1, k2, k3, p1, p2."""
    density = tags.pixels_per_mm
    focal = tags.number("Camera", "PerspectiveFocalLength")
    centre = tags.numbers("Camera", "PrincipalPoint")
    if focal is None or focal <= 0 or len(centre) != 2:
        return None
    if density is None:
        return None
    focal_px = focal if tags.focal_length_is_in_px else focal * density
    k = tags.numbers("Camera", "PerspectiveDistortion")
    distortion = (k[0], k[1], k[3], k[4], k[2]) if len(k) == 5 else ()
    return Lens(focal_px, focal_px, centre[0] * density, centre[1] * density, distortion)


def spectral(band: Band, tags: Tags) -> Band:
    """The band with the wavelength and width that its tags give, nm."""
    return replace(
        band,
        wavelength_nm=tags.number("Camera", "CentralWavelength"),
        bandwidth_nm=tags.number("Camera", "WavelengthFWHM"),
    )
