"""Any other GeoTIFF: multiband files, and files of single bands with any naming scheme."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agalign.cameras.base import Camera, colour_bands
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import NAMESPACE, listed_bands
from agalign.errors import ConfigurationError
from agalign.pixels.raster import suffix_format
from agalign.values.capture import Band

_BAND = (
    r"(?:coastal|blue|green|red[ _-]?edge|near[ _-]?infra[ _-]?red|infra[ _-]?red|red|nir|swir|pan|panchro|lwir|"
    r"thermal|gre|reg|rgb|grn|blu|vis|ms)[_-]?\d*|\d{3,4} ?nm"
)
_SUFFIX = re.compile(
    rf"^(?P<capture>.*?)(?:(?:^|(?<=.)[_\-. ]+)(?P<band>{_BAND}|b?\d{{1,2}}|re|[bgrn])"
    rf"|(?<=[0-9a-z])(?P<glued>(?-i:Blue|Green|RedEdge|Red|NIR|GRE|REG|RED|BLUE|GREEN)|\d{{3,4}}nm))$",
    re.IGNORECASE | re.DOTALL,
)
"""A band at the end of a file name, after a separator, or `glued` to the name of the capture as in DJI_0001NIR."""


class Generic(Camera):
    """Files that no vendor's module recognises. `pattern` has {capture} and {band}, as in '{capture}_{band}.tif'."""

    name = "generic"

    def __init__(self, pattern: str | None = None) -> None:
        self._patterns = compile_pattern(pattern) if pattern else ()

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
            return tuple(replace(b, name=b.name or b.colour or f"band_{b.band_index}") for b in listed)
        own_name = tags.text(NAMESPACE, "BandName") or self.split(path)[1]
        file_wavelength_nm = tags.number(NAMESPACE, "CentralWavelength") or _wavelength_in(own_name)
        (band,) = stored
        name = band.name or own_name or f"band_{band.band_index}"
        return (replace(band, name=name, wavelength_nm=band.wavelength_nm or file_wavelength_nm),)

    def is_named_as_band(self, path: Path) -> bool:
        """Return True for a picture with the name of a band, and not of a photograph."""
        name = self.split(path)[1]
        is_spectral = re.fullmatch(rf"(?!rgb|vis|ms)(?:{_BAND}|re|[bgrn])", name, re.IGNORECASE)
        return bool(name and (self._patterns or is_spectral))

    def capture_key(self, path: Path, tags: Tags) -> str:
        return self.split(path)[0]

    def capture_name(self, path: Path) -> str:
        # `red.tif` and `nir.tif` in a folder are a capture with the name of the folder.
        return self.split(path)[0] or path.absolute().parent.name

    def split(self, path: Path) -> tuple[str, str]:
        """Return (capture, band) from the file name; the band is empty if the name contains none."""
        for pattern in self._patterns:
            match = pattern.fullmatch(path.name)
            if match:
                return match["capture"], match["band"]
        # The last number of a date at the end of a name is a day, not a band.
        has_date = re.search(r"(?:19|20)\d\d([-_.])\d{1,2}\1\d{1,2}$", path.stem)
        match = None if self._patterns or has_date else _SUFFIX.fullmatch(path.stem)
        if match:
            return match["capture"].rstrip("_-. "), match["band"] or match["glued"]
        return path.stem, ""


def compile_pattern(pattern: str) -> tuple[re.Pattern[str], ...]:
    """Return the regular expressions of a --pattern, to be tried in this order.

    A name may match in several ways. The first expression matches known names of bands (`red_edge` in
    `IMG_0007_red_edge`), the second the shortest band (`1` in `IMG_0007_1`).
    Raises ConfigurationError if {capture} or {band} is missing.
    """
    if pattern.count("{capture}") != 1 or pattern.count("{band}") != 1:
        raise ConfigurationError(
            f"pattern '{pattern}' needs {{capture}} and {{band}} once each, as in '{{capture}}_{{band}}.tif'"
        )
    escaped = re.escape(pattern).replace(r"\{capture\}", "(?P<capture>.+)").replace(r"\*", ".*")
    whole = (escaped.replace(r"\{band\}", f"(?P<band>{band})") for band in (_BAND, "[^/]+?"))
    return tuple(re.compile(one, re.IGNORECASE | re.DOTALL) for one in whole)


def _wavelength_in(name: str) -> float | None:
    match = re.fullmatch(r"(\d{3,4}) ?nm", name, re.IGNORECASE)
    return float(match.group(1)) if match else None
