"""The interface of a camera, and functions that the modules of the cameras share.

A new camera is one module with one subclass of `Camera`, listed in `known_cameras`, and one entry in
`tests/cameras/test_vendors.py`.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from agalign.cameras.metadata import Tags
from agalign.cameras.sun import Sun
from agalign.cameras.tag_text import iso_time
from agalign.cameras.xmp import Name
from agalign.errors import GeometryError
from agalign.values import geometry
from agalign.values.band_names import no_such_band, own_stem
from agalign.values.capture import Band, CaptureTime, Pose, Position
from agalign.values.geometry import Matrix
from agalign.values.lens import Lens
from agalign.values.spectrum import ROLES, band_key


class Camera(ABC):
    """A family of cameras: its names of files and bands, and the tags of its lenses and rig."""

    name: str
    capture_ids: tuple[Name, ...] = ()
    """The XMP values that identify a capture, tried in turn."""
    flight_ids: tuple[Name, ...] = ()
    """The XMP values that identify a flight, tried in turn."""
    band_in_name: re.Pattern[str]
    """The part of a file's name, without suffix, that differs between the bands of a capture: the first match. Apps and
    users may add to the names of a camera."""
    has_free_names = False
    """True if users choose the names of its files."""
    clock_is_utc = False
    """True if its Exif times are in UTC."""
    utc_times: tuple[Name, ...] = ()
    """The XMP values of the time in UTC, tried in turn."""

    @abstractmethod
    def recognises(self, tags: Tags) -> bool:
        """Return True for files of this camera."""

    @abstractmethod
    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        """Return the bands in one of its files, with lens and `to_rig`; `stored` is from `pixels.raster.probe`."""

    def has_one_lens(self, tags: Tags) -> bool:
        """Return True for a camera with one lens for all bands of a file, also of more than 8 bits."""
        return False

    def capture_name(self, path: Path) -> str:
        """Return the part of a file name that all bands of a capture share."""
        return self.band_in_name.sub("", own_stem(path), count=1)

    def name_end(self, path: Path) -> str:
        """Return the end of a file's name that differs between the bands of a capture, without separators."""
        stem, capture = own_stem(path), self.capture_name(path)
        shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(stem, capture, strict=False)))
        rest = capture[shared:]  # what follows the band in the name
        if rest and len(stem) > len(capture) and stem.endswith(rest):
            return stem[shared : len(stem) - len(rest)].strip("_- ")
        return stem.removeprefix(capture).strip("_- ")

    def capture_key(self, path: Path, tags: Tags) -> str:
        """Return a text that is the same for all files of a capture, and unique for a camera and folder."""
        return tags.first_text(self.capture_ids) or self.capture_name(path)

    def with_shared_rig(self, bands: Sequence[Band], tags: Sequence[Tags]) -> list[Band]:
        """Return the bands of a capture, with `to_rig` from the tags of another file if their own tags lack it."""
        return list(bands)

    def pose(self, tags: Tags) -> Pose | None:
        """Return the camera's orientation and height; None if the tags lack them."""
        return None

    def captured_at(self, tags: Tags) -> str:
        """Return the time as `Capture.captured_at`, in UTC if the camera writes that; empty if the tags lack it."""
        utc = CaptureTime.of(
            iso_time(tags.first_text(self.utc_times)) or (tags.captured_at if self.clock_is_utc else "")
        )
        return tags.captured_at if utc is None else utc.utc.isoformat()

    def elevation_deg(self, tags: Tags) -> float | None:
        """Return the angle of the optical axis above the horizon, -90 straight down; None if the tags lack it."""
        if (pose := self.pose(tags)) is None:
            return None
        return -math.degrees(math.asin(math.cos(math.radians(pose.pitch_deg)) * math.cos(math.radians(pose.roll_deg))))

    def other_position(self, tags: Tags) -> Position | None:
        """Return the position by other tags than those of Exif; None if the tags lack it."""
        return None

    def contradictions(self, tags: Tags) -> Iterator[str]:
        """Yield, in words, which tags of a file contradict each other."""
        yield from ()

    def sun(self, tags: Tags) -> Sun | None:
        """Return the position of the sun by its light sensor; None if the tags lack it."""
        return None

    def motion(self, tags: Tags) -> tuple[float, float] | None:
        """Return the velocity (right, down) of the ground in the image, focal lengths per second; None if unknown."""
        return None

    def capture_folder(self, path: Path) -> Path:
        """Return the folder of the capture that a file belongs to."""
        return path.parent


def default_reference(bands: Sequence[Band]) -> int:
    """Return the index of the green band, else of the band nearest to 550 nm, else of the first band.

    Thermal bands are considered only if there are no others.
    """
    reflective = [i for i, b in enumerate(bands) if not is_thermal(b)]
    for index in reflective:
        if re.split(r"[-_ ]", bands[index].name.lower())[0] in ROLES["green"].names:
            return index
    green_nm = 550.0
    known = [(abs(nm - green_nm), i) for i in reflective if (nm := bands[i].wavelength_nm) is not None]
    return min(known)[1] if known else next(iter(reflective), 0)


def reference_index(bands: Sequence[Band], wanted: str | None, path: Path, option: str = "--reference") -> int:
    """Return the index of the band with the name `wanted` in any spelling; of the default if it is None or 'auto'.

    Raises NoSuchBandError, which names `path` and the command-line `option`, if no band has the name.
    """
    if wanted is None or wanted.lower() == "auto":
        return default_reference(bands)
    for index, band in enumerate(bands):
        if band_key(band.name) == band_key(wanted):
            return index
    raise no_such_band(path, wanted, (b.name for b in bands), by=option)


def is_thermal(band: Band) -> bool:
    """Return True for a thermal infrared band: those at shorter wavelengths record reflected sunlight."""
    by_wavelength = band.wavelength_nm is not None and band.wavelength_nm >= 3000.0
    return by_wavelength or band.name.lower().startswith(("lwir", "thermal"))


# ---- for the modules of the cameras


def colour_bands(stored: Sequence[Band], lens: Lens | None = None, to_rig: Matrix | None = None) -> tuple[Band, ...]:
    """Return the bands of the colour photograph that a camera takes with its multispectral bands."""
    names = ["RGB Red", "RGB Green", "RGB Blue"] if len(stored) >= 3 else ["RGB"]
    return tuple(
        replace(band, name=name, lens=lens, to_rig=to_rig, one_lens=True, is_from_photograph=True)
        for band, name in zip(stored, names, strict=False)
    )


def rotation(a_deg: float, b_deg: float, c_deg: float) -> Matrix:
    """Return R = Rx(a) Ry(b) Rz(c) (3, 3), right-handed, angles in degrees."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.radians([a_deg, b_deg, c_deg])), np.cos(np.radians([a_deg, b_deg, c_deg]))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z)


def rays_to_rig(lens: Lens | None, camera_to_rig: Matrix) -> Matrix | None:
    """Return `to_rig` = R K^-1 (3, 3), given the rotation R of a camera; None without a lens or if K is singular."""
    try:
        return None if lens is None else np.asarray(camera_to_rig @ geometry.invert(lens.matrix))
    except GeometryError:
        return None
