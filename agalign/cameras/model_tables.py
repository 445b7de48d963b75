"""What is known of the cameras: the bands of each, their wavelengths, and what names of files and tags call them."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from agalign.values.capture import Band
from agalign.values.spectrum import band_key

KnownBands = Mapping[str, tuple[str, float]]
"""(name that the firmware writes, centre wavelength in nm or nan) by the part of a file's name, or its number, that
tells the bands of a capture apart; by another text if the part is unknown.
"""
MAVIC_3: KnownBands = {"G": ("Green", 560), "R": ("Red", 650), "RE": ("RedEdge", 730), "NIR": ("NIR", 860)}
PHANTOM_4 = {"1": ("Blue", 450), "2": ("Green", 560), "3": ("Red", 650), "4": ("RedEdge", 730), "5": ("NIR", 840)}
SEQUOIA: KnownBands = {"GRE": ("Green", 550), "RED": ("Red", 660), "REG": ("Red edge", 735), "NIR": ("NIR", 790)}
_6X = {"0": ("Blue", 475), "1": ("Green", 550), "2": ("Red", 670), "3": ("RedEdge", 715), "4": ("NIR", 840)}
_REDEDGE = {"1": ("Blue", 475), "2": ("Green", 560), "3": ("Red", 668), "4": ("NIR", 840), "5": ("Red edge", 717)}
_UNKNOWN_NM = math.nan  # of bands of the Altum, whose names are known
_ALTUM = {"1": ("Blue", _UNKNOWN_NM), "2": ("Green", _UNKNOWN_NM), "3": ("Red", _UNKNOWN_NM), "4": ("NIR", _UNKNOWN_NM)}
_ALTUM |= {"5": ("Red edge", _UNKNOWN_NM), "6": ("LWIR", 11000)}
_UNNUMBERED = "pan", "thermal"  # in place of the numbers of two files of the Altum-PT, which are unknown
_ALTUM_PT = {part: band for part, band in _ALTUM.items() if part != "6"}
_ALTUM_PT |= dict(zip(_UNNUMBERED, (("Pan", _UNKNOWN_NM), ("LWIR", 11000)), strict=True))
# The second half of a dual camera has the model of the first.
_REDEDGE_BLUE = {"6": ("Blue-444", 444), "7": ("Green-531", 531), "8": ("Red-650", 650)}
_REDEDGE_BLUE |= {"9": ("Red edge-705", 705), "10": ("Red edge-740", 740)}
_KNOWN: Sequence[tuple[str, KnownBands]] = (
    *(("M3M", MAVIC_3), ("FC6360", PHANTOM_4), ("Sequoia", SEQUOIA)),
    *((".*6X", _6X), ("RedEdge", _REDEDGE), ("RedEdge-M", _REDEDGE_BLUE)),
    *(("Altum$", _ALTUM), ("Altum-PT", _ALTUM_PT)),
)
"""(regular expression of the beginning of EXIF's model, bands) of the cameras with a file for each band."""

_SIZES_PX = (
    *(("M3M", ((2592, 1944), (5280, 3956))), ("FC6360", ((1600, 1300),)), ("Sequoia", ((1280, 960),))),
    *(("RedEdge-P", ((1456, 1088), (2464, 2056))), ("RedEdge(?!-P)", ((1280, 960),))),
    *(("Altum$", ((2064, 1544), (160, 120))), ("Altum-PT", ((2064, 1544), (4112, 3008), (320, 256)))),
)
"""(regular expression of the beginning of EXIF's model, (width, height) of its images): those of the bands, then of the
panchromatic, the thermal one, and the photograph.
"""
_RAW_STEPS = (("RedEdge(?!-P)", 16), ("FC6360", 64), ("Sequoia", 64))
"""(regular expression of the beginning of EXIF's model, common divisor of the raw numbers in 16 bits): sensors of 12
and 10 bits, as the files of seven cameras show; that of other models is unknown.
"""

Channels = Mapping[int, tuple[str, float]]
"""{channel of a photograph, from 1: (band, centre wavelength in nm)}."""
SENTERA_FILTERS: Mapping[str, Channels] = {
    "NDRE": {1: ("Red edge", 720.0), 3: ("NIR", 840.0)},
    "NDVI": {1: ("Red", 625.0), 3: ("NIR", 850.0)},
}
SURVEY3_FILTERS: Mapping[str, Channels] = {
    "RGN": {1: ("Red", 660.0), 2: ("Green", 550.0), 3: ("NIR", 850.0)},
    "OCN": {1: ("Orange", 615.0), 2: ("Cyan", 490.0), 3: ("NIR", 808.0)},
    "NGB": {1: ("NIR", 850.0), 2: ("Green", 550.0), 3: ("Blue", 475.0)},
    "RGB": {1: ("Red", 660.0), 2: ("Green", 550.0), 3: ("Blue", 475.0)},
}


def survey3_filter(model: str) -> str:
    """Return the filter in the model of a MAPIR Survey3, such as RGN; empty for other models."""
    name, _, of_filter = model.upper().rpartition("_")
    return of_filter if name.startswith("SURVEY3") else ""


def filter_channels(model: str) -> Channels:
    """Return the bands in the channels of a MAPIR Survey3 by the filter in its model; empty for other models."""
    return SURVEY3_FILTERS.get(survey3_filter(model), {})


def filtered_bands(channels: Channels, stored: Sequence[Band]) -> tuple[Band, ...]:
    """Return the bands behind a filter in the channels of a photograph, without channels that have none."""
    known = [(band, *channels[band.band_index]) for band in stored if band.band_index in channels]
    return tuple(replace(band, name=name, wavelength_nm=nm) for band, name, nm in known)


def sizes_px(model: str) -> tuple[tuple[int, int], ...]:
    """Return the sizes (width, height) of the images that a camera of this model writes; empty if they are unknown."""
    return next((sizes for start, sizes in _SIZES_PX if re.match(start, model, re.IGNORECASE)), ())


def raw_step(model: str) -> int:
    """Return the common divisor of all raw numbers of a camera of this model in 16 bits; 1 if it is unknown."""
    return next((step for start, step in _RAW_STEPS if re.match(start, model, re.IGNORECASE)), 1)


SAME_BAND_NM = 8.0
"""Largest difference of the wavelengths that firmware versions write for a band (840 and 842 nm); those of the two
halves of a dual camera differ by 12 nm.
"""


MAVIC_3_PART = rf"_MS_({'|'.join(sorted(MAVIC_3, reverse=True))})(?![a-z0-9])"
SEQUOIA_PART = rf"(?<=_\d{{6}}_\d{{6}}_\d{{4}})_({'|'.join(SEQUOIA)})(?![a-z0-9])"
_OWN_NAMING = ((re.compile(MAVIC_3_PART, re.IGNORECASE), MAVIC_3), (re.compile(SEQUOIA_PART, re.IGNORECASE), SEQUOIA))
"""The part of a file's name, by which a camera distinguishes its bands, that no other name has."""


def named_by_camera(text: str) -> tuple[str, str]:
    """Return (text without the band, band) of a text with a camera's own name of a file; no band for other texts."""
    for pattern, bands in _OWN_NAMING:
        if match := pattern.search(text):  # in linear time, because the text may be a damaged tag
            return text[: match.start()] + text[match.end() :], bands[match[1].upper()][0]
    return text, ""


def band_at(model: str, part: str) -> str:
    """Return the name of the band that a camera of this model records in the files with this part in their names; empty
    if it is unknown.
    """
    known = (bands for start, bands in _KNOWN if re.match(start, model, re.IGNORECASE))
    return next((bands[part][0] for bands in known if part in bands), "")


def lacking(model: str, own: Sequence[tuple[str, Band]]) -> list[str]:
    """Return the names of the bands that a camera of this model records and a capture lacks, given its bands with the
    end of the file's name. The half of a dual camera without any band lacks none.
    """
    keys, nms = {_kind(b.name) for _, b in own}, [b.wavelength_nm for _, b in own if b.wavelength_nm]
    unnamed = {part for part, b in own if b.wavelength_nm is None}
    result: list[str] = []
    for known in (bands for start, bands in _KNOWN if re.match(start, model, re.IGNORECASE)):
        # A file without tags and of another number may be a band whose number is unknown.
        found = unnamed if unnamed <= known.keys() else {*unnamed, *_UNNUMBERED}
        named = {p: name for p, (name, _) in known.items() if p not in found and _kind(name) not in keys}
        missing = [name for p, name in named.items() if not any(abs(known[p][1] - nm) <= SAME_BAND_NM for nm in nms)]
        result += missing if len(missing) < len(known) else []
    return result


def _kind(name: str) -> str:
    """A text that is equal for all names of a band; panchromatic and thermal bands have several."""
    key = band_key(name)
    return next((kind for start, kind in _KINDS if key.startswith(start)), key)


_KINDS = (("pan", "pan"), ("thermal", "lwir"), ("lwir", "lwir"))
"""(beginning of a name, as `band_key`, kind of the band)."""
