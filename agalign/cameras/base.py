"""The interface of a camera, and the functions that the cameras share.

A new camera is one module with one subclass of `Camera`, listed in `known_cameras`, and one entry in the vendors' test.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import TagTransfer
from agalign.cameras.xmp import Name
from agalign.errors import GeometryError, NoSuchBandError
from agalign.pixels.raster import RasterInfo
from agalign.values import geometry
from agalign.values.capture import Band, Pose
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens

_PREFERRED_REFERENCES = ("green", "gre", "g")
_GREEN_NM = 550.0
_THERMAL = ("lwir", "thermal")
_MIN_THERMAL_NM = 3000.0
"""Below, cameras see reflected sunlight."""
_COLOURS = ("Red", "Green", "Blue")


class Camera(ABC):
    """How one family of cameras groups and names its bands, and how its tags describe lenses and rig."""

    name: str
    capture_ids: tuple[Name, ...] = ()
    """The XMP values that identify a capture, tried in turn."""
    flight_ids: tuple[Name, ...] = ()
    """The XMP values that identify a flight, tried in turn."""
    tag_transfer: TagTransfer = TagTransfer()
    """What becomes of its tags when a band is written on the reference's grid."""

    @abstractmethod
    def recognises(self, tags: Tags) -> bool:
        """True for files of this camera."""

    @abstractmethod
    def bands(self, path: Path, tags: Tags, info: RasterInfo) -> tuple[Band, ...]:
        """The bands in one of its files, with their lens and their place in the rig."""

    @abstractmethod
    def capture_name(self, path: Path) -> str:
        """The part of a file's name that the bands of its capture share."""

    def capture_key(self, path: Path, tags: Tags) -> str:
        """Files with the same key (and the same camera and folder) are one capture."""
        return tags.first_text(self.capture_ids) or self.capture_name(path)

    def with_shared_rig(self, bands: Sequence[Band], tags: Sequence[Tags]) -> list[Band]:
        """The bands of a capture, with `to_rig` where only the tags of another of its files hold it."""
        return list(bands)

    def pose(self, tags: Tags) -> Pose | None:
        """The camera's orientation and height; None where the tags do not hold them."""
        return None

    def elevation_deg(self, tags: Tags) -> float | None:
        """Angle of the optical axis above the horizon, -90 straight down; None where the tags do not give it."""
        pose = self.pose(tags)
        return None if pose is None else elevation_of(pose.pitch_deg, pose.roll_deg)

    def motion(self, tags: Tags) -> tuple[float, float] | None:
        """Speed of the ground through the image, right and down, in focal lengths per second; None where the tags do
        not hold it.
        """
        return None

    def capture_folder(self, path: Path) -> Path:
        """The folder of the capture that a file belongs to."""
        return path.parent


def elevation_of(pitch_deg: float, roll_deg: float) -> float:
    """Return the elevation of the optical axis, degrees, after these rotations of a camera that looks straight down."""
    towards_nadir = math.cos(math.radians(pitch_deg)) * math.cos(math.radians(roll_deg))
    return -math.degrees(math.asin(towards_nadir))


def default_reference(bands: Sequence[Band]) -> int:
    """Index of the green band; else of the one nearest to 550 nm; else the first. A thermal one only if all are."""
    reflective = [i for i, b in enumerate(bands) if not is_thermal(b)]
    for index in reflective:
        if re.split(r"[-_ ]", bands[index].name.lower())[0] in _PREFERRED_REFERENCES:
            return index
    known = [(abs(nm - _GREEN_NM), i) for i in reflective if (nm := bands[i].wavelength_nm) is not None]
    return min(known)[1] if known else next(iter(reflective), 0)


def reference_index(bands: Sequence[Band], wanted: str | None, path: Path) -> int:
    """Index of the band with the name `wanted`, in any case; of the default where that is None or 'auto'.

    Raises NoSuchBandError, with `path`, where no band has the name.
    """
    if wanted is None or wanted.lower() == "auto":
        return default_reference(bands)
    for index, band in enumerate(bands):
        if band.name.lower() == wanted.lower():
            return index
    raise NoSuchBandError(f"{path}: no band '{wanted}' for the reference; this capture has {listed(bands)}")


def listed(bands: Sequence[Band]) -> str:
    """The names of some bands, for a message."""
    return ", ".join(b.name for b in bands)


def is_thermal(band: Band) -> bool:
    """True for a band of the thermal infrared."""
    long = band.wavelength_nm is not None and band.wavelength_nm >= _MIN_THERMAL_NM
    return long or band.name.lower().startswith(_THERMAL)


def rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """fixed_to_moving between undistorted pixels from metadata alone; None where the tags do not hold it."""
    return _through_rig(reference.to_rig, moving.to_rig)


def other_rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """The same by the second set of tags that some makers write; None where both bands lack it."""
    if reference.other_to_rig is None and moving.other_to_rig is None:
        return None
    return _through_rig(*(b.to_rig if b.other_to_rig is None else b.other_to_rig for b in (reference, moving)))


def _through_rig(reference: Matrix | None, moving: Matrix | None) -> Matrix | None:
    if reference is None or moving is None:
        return None
    return geometry.normalised(geometry.compose(geometry.invert(moving), reference))


# ---- for the cameras


def band_of(path: Path, info: RasterInfo, name: str, index: int = 1) -> Band:
    """A band with the properties of its raster."""
    return Band(
        name=name,
        path=path,
        band_index=index,
        width_px=info.width_px,
        height_px=info.height_px,
        dtype=info.dtypes[index - 1],
        nodata=info.nodata[index - 1],
        has_mask=info.has_mask,
        saturation_value=max_value(info.dtypes[index - 1]),
        georeference=info.georeference,
        scale_offset=info.scales_offsets[index - 1] if info.scales_offsets else (1.0, 0.0),
        overviews=info.overviews,
    )


def colour_bands(
    path: Path, info: RasterInfo, lens: Lens | None = None, to_rig: Matrix | None = None
) -> tuple[Band, ...]:
    """The bands of the colour photograph that a camera takes with its multispectral bands."""
    names = [f"RGB {colour}" for colour in _COLOURS] if len(info.dtypes) >= 3 else ["RGB"]
    return tuple(
        replace(band_of(path, info, name, i), lens=lens, to_rig=to_rig, one_lens=True, companion=True)
        for i, name in enumerate(names, start=1)
    )


def max_value(dtype: str) -> float | None:
    """The value at which an integer type saturates; None for floats."""
    return {"uint8": 255.0, "uint16": 65535.0, "int16": 32767.0}.get(dtype)


def rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    """R = Rx(a) Ry(b) Rz(c), right-handed, angles in degrees."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.radians([a_deg, b_deg, c_deg])), np.cos(np.radians([a_deg, b_deg, c_deg]))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z)


def rays_to_rig(lens: Lens | None, camera_to_rig: Matrix) -> Matrix | None:
    """to_rig of a band with a camera rotated by R: R K^-1; None without a lens or where K is singular."""
    try:
        return None if lens is None else np.asarray(camera_to_rig @ geometry.invert(lens.matrix))
    except GeometryError:
        return None
