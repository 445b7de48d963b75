"""An image file with its tags and bands, and problems of files."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from agalign.cameras.base import Camera
from agalign.cameras.metadata import Tags
from agalign.errors import AgalignError, InputError
from agalign.values.capture import Band
from agalign.values.pixel_units import SAME_PIXELS, PixelScale


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
    """True for a file with the same bytes, or the same capture id, name and size, as another one, which takes part, and
    for a file used with fewer tags."""

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
    def is_whole_capture(self) -> bool:
        """True for a file of several bands with a lens each."""
        return len(self.bands) > 1 and not self.bands[0].one_lens


def natural_order(name: str) -> list[tuple[bool, int, str]]:
    """Return a sort key that puts `_2` before `_10`."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part.lower()) for part in parts]
