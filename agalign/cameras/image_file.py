"""An image file with its tags and bands, and problems of files."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from agalign.cameras.base import Camera
from agalign.cameras.metadata import Tags
from agalign.errors import AgalignError, InputError
from agalign.values.capture import Band
from agalign.values.pixel_units import SAME_PIXELS, PixelScale
from agalign.values.spectrum import band_key


@dataclass(frozen=True)
class Problem:
    """A file or capture that is skipped, or used with fewer tags, and the reason.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("flight/IMG_0009_1.tif").write_bytes(b"")
    >>> (problem,) = agalign.discover("flight").problems
    >>> problem.text, problem.is_harmless
    ('flight/IMG_0009_1.tif: is empty; copy it from the card again', False)
    """

    path: Path
    """The file."""
    error: AgalignError
    """The reason."""
    is_harmless: bool = False
    """True if the flight lacks no image by it: a copy of a file that takes part, a mask, a thumbnail, a result of
    agalign, or a file used with fewer tags."""

    @property
    def text(self) -> str:
        """The message, one line with the file and the remedy."""
        return str(self.error)


def problem_of(path: Path, text: str, *, is_harmless: bool = False) -> Problem:
    """Return the problem of a file or folder with this text after its path."""
    return Problem(path, InputError(f"{path}: {text}"), is_harmless)


class OwnFile(Problem):
    """A file that agalign wrote: a result, not an image of a camera."""


class Doubt(NamedTuple):
    """A fact that two sources in a file give differently."""

    text: str
    """What contradicts what, in words."""
    advice: str
    """What follows, and what to do; doubts with the same advice are reported together."""


@dataclass(frozen=True)
class ImageFile:
    """One image file with its tags and bands."""

    path: Path
    camera: Camera
    tags: Tags
    bands: tuple[Band, ...]
    """Empty if the file contains no band that takes part."""
    scale: PixelScale = SAME_PIXELS
    """Size of the image relative to that of the camera, by EXIF, from which the tags in pixels were rescaled."""
    has_other_lens: bool = False
    """True if the lens in the tags is not that of the image; it is left out with what depends on it."""
    doubts: tuple[Doubt, ...] = ()
    """Facts that two sources in the file give differently."""

    @property
    def name_end(self) -> str:
        """The end of its name that differs between the bands of a capture, without separators."""
        return self.camera.name_end(self.path)

    @property
    def capture_id(self) -> str:
        """The id of its capture in the tags; empty without one."""
        return self.tags.first_text(self.camera.capture_ids)

    @property
    def unit(self) -> tuple[str, ...]:
        """Its camera: make, model and serial number; the folder of the capture without a serial number."""
        serial = self.tags.serial or str(self.camera.capture_folder(self.path))
        return self.camera.name, self.tags.make, self.tags.model, serial

    @property
    def is_whole_capture(self) -> bool:
        """True for a file of several bands with a lens each."""
        return len(self.bands) > 1 and not self.bands[0].one_lens


def with_one_spelling(files: Sequence[ImageFile]) -> list[ImageFile]:
    """Return the files with one spelling of each band's name in the files of a camera, or of a folder without tags: the
    first. Multiband files are apart from those of single bands.
    """
    spellings: dict[tuple[object, ...], str] = {}
    result = []
    for file in files:
        camera = file.tags.make, file.tags.model or file.camera.capture_folder(file.path), len(file.bands) > 1
        names = [spellings.setdefault((*camera, band_key(b.name)), b.name.strip()) for b in file.bands]
        is_unique = len(set(names)) == len({b.name for b in file.bands})
        bands = tuple(replace(b, name=name) for b, name in zip(file.bands, names, strict=True))
        result.append(replace(file, bands=bands) if is_unique else file)
    return result


def natural_order(name: str) -> list[tuple[bool, int, str]]:
    """Return a sort key that puts `_2` before `_10`."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part.lower()) for part in parts]
