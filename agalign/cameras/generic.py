"""Any other GeoTIFF: multiband files, and files of single bands with any naming scheme."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from agalign.cameras.base import Camera, colour_bands, own_stem
from agalign.cameras.known import named_by_camera
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import NAMESPACE, listed_bands
from agalign.errors import ConfigurationError
from agalign.pixels.raster import suffix_format
from agalign.values.capture import Band
from agalign.values.text import shortened

_WORD = (
    r"(?:coastal|blue|green|red[ _-]?edge|near[ _-]?infra[ _-]?red|infra[ _-]?red|red|nir|swir|pan|panchro|lwir|"
    r"thermal|gre|reg|rgb|grn|blu|vis|ms)"
)
_BAND = rf"{_WORD}[_-]?\d*|\d{{3,4}}[ _-]?nm"
_SHORT = "re|[bgrn]"
"""Abbreviations that are bands only in certain places."""
_SUFFIX = re.compile(
    rf"^(?P<capture>.*?)(?:(?:^|(?<=.)[_\-. ]+)(?P<band>{_BAND}|b?\d{{1,2}}|{_SHORT})"
    rf"|(?<=[0-9a-z])(?P<glued>(?-i:Blue|Green|RedEdge|Red|NIR|GRE|REG|RED|BLUE|GREEN)|\d{{3,4}}nm))$",
    re.IGNORECASE | re.DOTALL,
)
"""A band at the end of a file name, after a separator, or `glued` to the name of the capture as in DJI_0001NIR."""
_PREFIX = re.compile(rf"(?P<band>{_WORD}|{_SHORT})(?:[_\- ]|(?=\d))(?P<capture>.+)", re.IGNORECASE | re.DOTALL)
"""A band at the beginning of a file name, as in NIR01 or Red_IMG_0001."""


def is_band_name(text: str) -> bool:
    """Return True for a text that is the name of a spectral band, such as nir, R or 550nm, and nothing else."""
    return bool(re.fullmatch(rf"(?!(?:rgb|vis|ms)[_-]?\d*$)(?:ms[ _-])?(?:{_BAND}|{_SHORT})", text, re.IGNORECASE))


Layout = Literal["end", "start", "folder"]
"""Where the name of a band is: at the end or the beginning of the file's name, or in that of its folder."""


class Generic(Camera):
    """Files that no vendor's module recognises. `pattern` has {capture} and {band}, as in '{capture}_{band}.tif', and
    may have folders, as in '{band}/{capture}.tif'. Without a pattern, names have the `layout`.
    """

    name = "generic"

    def __init__(self, pattern: str | None = None, layout: Layout = "end") -> None:
        self._patterns, self._layout = compile_pattern(pattern) if pattern else (), layout
        self.has_free_names = not pattern
        self._folders = pattern.count("/") if pattern else int(layout == "folder")

    def recognises(self, tags: Tags) -> bool:
        return True

    def bands(self, path: Path, tags: Tags, stored: Sequence[Band]) -> tuple[Band, ...]:
        if suffix_format(path) in ("JPEG", "PNG"):
            if not self.is_named_as_band(path):  # a photograph; another PNG has no band
                return colour_bands(stored) if suffix_format(path) == "JPEG" else ()
            # A number in the name of a picture is not a band. Of three equal channels, the first is read.
            name = self.split(path)[1]
            return (replace(stored[0], name=name, wavelength_nm=_wavelength_in(name)),)
        if len(stored) > 1:
            listed = listed_bands(tags, stored)
            own = [named_by_camera(b.name)[1] for b in listed]
            names = own if all(own) and len(set(own)) == len(own) else [b.name for b in listed]
            named = zip(listed, names, strict=True)
            return tuple(replace(b, name=name or b.colour or f"band_{b.band_index}") for b, name in named)
        (band,) = stored
        described, in_tags = (spectral_part(text) for text in (band.name, tags.text(NAMESPACE, "BandName")))
        own_name = in_tags or tags.text(NAMESPACE, "BandName") or self.split(path)[1]
        file_wavelength_nm = tags.number(NAMESPACE, "CentralWavelength") or _wavelength_in(own_name)
        # A description may be the name of the file that another program has read.
        name = described or own_name or band.name or f"band_{band.band_index}"
        return (replace(band, name=name, wavelength_nm=band.wavelength_nm or file_wavelength_nm),)

    def is_named_as_band(self, path: Path) -> bool:
        """Return True for a picture with the name of a band, and not of a photograph."""
        name = self.split(path)[1]
        return is_band_name(name) or bool(name and self._patterns)

    def capture_key(self, path: Path, tags: Tags) -> str:
        return self.split(path)[0]

    def capture_name(self, path: Path) -> str:
        # `red.tif` and `nir.tif` in a folder are a capture with the name of the folder.
        return self.split(path)[0] or path.absolute().parent.name

    def capture_folder(self, path: Path) -> Path:
        return path.parents[self._folders]

    def split(self, path: Path) -> tuple[str, str]:
        """Return (capture, band) from the file name; the band is empty if the name contains none."""
        name = "/".join(path.parts[-1 - self._folders :])
        for pattern in self._patterns:
            if match := pattern.fullmatch(name):
                return match["capture"], match["band"]
        if self._patterns:
            return path.stem, ""
        return split_elsewhere(path, self._layout) or split_stem(own_stem(path))


def split_elsewhere(path: Path, layout: Layout) -> tuple[str, str] | None:
    """Return (capture, band) of a file with the band in its folder or at the beginning of its name, or None."""
    stem = own_stem(path)
    (capture, band), prefixed = split_stem(stem), _PREFIX.fullmatch(stem)
    if layout == "folder" and is_band_name(path.parent.name):
        return (capture, band) if is_band_name(band) else (stem, path.parent.name)
    if layout == "start" and prefixed and not (capture and is_band_name(band)):
        return prefixed["capture"], prefixed["band"]
    return None


def split_stem(stem: str) -> tuple[str, str]:
    """Return (capture, band) of a file name without suffix; the band is empty if the name contains none."""
    if (own := named_by_camera(stem))[1]:
        return own
    # The last number of a date at the end of a name is a day, not a band.
    has_date = re.search(r"(?:19|20)\d\d([-_.])\d{1,2}\1\d{1,2}$", stem)
    match = None if has_date else _SUFFIX.fullmatch(stem)
    return (match["capture"].rstrip("_-. "), match["band"] or match["glued"]) if match else (stem, "")


def spectral_part(text: str) -> str:
    """Return the name of the spectral band in a text: all of it, or its end as that of a file name; empty if none."""
    text = shortened(text)
    band = split_stem(text)[1]
    return text if is_band_name(text) else band if is_band_name(band) or named_by_camera(text)[1] else ""


def compile_pattern(pattern: str) -> tuple[re.Pattern[str], ...]:
    """Return the regular expressions of a --pattern, to be tried in this order.

    A name may match in several ways. The first expression matches known names of bands (`red_edge` in
    `IMG_0007_red_edge`), the second the shortest band (`1` in `IMG_0007_1`). Next to the capture a band has no digits.
    Raises ConfigurationError if {capture} or {band} is missing.
    """
    if pattern.count("{capture}") != 1 or pattern.count("{band}") != 1:
        raise ConfigurationError(
            f"pattern '{pattern}' needs {{capture}} and {{band}} once each, as in '{{capture}}_{{band}}.tif'"
        )
    escaped = re.escape(pattern).replace(r"\{capture\}", "(?P<capture>.+)").replace(r"\*", ".*")
    bands = (_WORD, r"[^\W\d_]+") if "{band}{capture}" in pattern else (_BAND, "[^/]+?")
    whole = (escaped.replace(r"\{band\}", f"(?P<band>{band})") for band in bands)
    return tuple(re.compile(one, re.IGNORECASE | re.DOTALL) for one in whole)


def _wavelength_in(name: str) -> float | None:
    match = re.fullmatch(r"(\d{3,4})[ _-]?nm", name, re.IGNORECASE)
    return float(match.group(1)) if match else None
