"""Parts of the spectrum that bands are from, by wavelength and name, and when two names mean the same band."""

import re
from collections.abc import Mapping
from typing import Literal, NamedTuple

from agalign.values.capture import Band

Role = Literal["blue", "green", "red", "red edge", "nir"]
"""The part of the spectrum that a band of an index is from."""


class SpectralRange(NamedTuple):
    """The bands of a role."""

    shortest_nm: float
    nominal_nm: float
    longest_nm: float
    """Limits of the centre wavelength."""
    symbols: tuple[str, ...]
    """Names in formulas, as in the catalogue Awesome Spectral Indices."""
    names: tuple[str, ...]
    """Names of bands, as `band_key`."""


ROLES: Mapping[Role, SpectralRange] = {
    "blue": SpectralRange(430, 475, 510, ("B",), ("blue", "blu", "b")),
    "green": SpectralRange(520, 560, 590, ("G",), ("green", "gre", "grn", "g")),
    "red": SpectralRange(620, 668, 695, ("R",), ("red", "r")),
    "red edge": SpectralRange(697, 717, 760, ("RE", "RE1"), ("rededge", "reg", "re")),
    "nir": SpectralRange(765, 840, 920, ("N",), ("nir", "nearinfrared", "n")),
}


def band_key(name: str) -> str:
    """Return a text that is equal for all spellings of a band's name, such as "Red edge", "RedEdge" and "RED_EDGE "."""
    return re.sub(r"[\s_-]", "", name).lower()


def with_wavelength(name: str, wavelength_nm: float | None) -> str:
    """Return the name of a band, with its wavelength if that is known, for a message."""
    return name if wavelength_nm is None else f"{name} ({wavelength_nm:g} nm)"


def role_of(name: str, wavelength_nm: float | None) -> Role | None:
    """Return the role of a band by its wavelength if that is known, else by its name; None for a band without one, and
    for a band with a name that contradicts its wavelength.
    """
    if name.lower().startswith(("pan", "rgb", "lwir", "thermal")):  # whatever the centre wavelength
        return None
    if wavelength_nm is None:
        return _role_of_name(name)
    return None if contradicts(name, wavelength_nm) else role_of_wavelength(wavelength_nm)


def is_spectral(name: str, wavelength_nm: float | None) -> bool:
    """Return True for a band with a wavelength or the name of a part of the spectrum, also with a number."""
    word = re.sub(r"[\s_-]*\(?\d.*$", "", name)
    has_name = word.lower().startswith(("pan", "lwir", "thermal", "infrared")) or (
        _role_of_name(name if len(word) < 2 else word) is not None  # "N" is one, "B4" may be any fourth band
    )
    return wavelength_nm is not None or has_name


def role_of_wavelength(wavelength_nm: float) -> Role | None:
    """Return the role with this centre wavelength; None for wavelengths between the roles."""
    return next((role for role, r in ROLES.items() if r.shortest_nm <= wavelength_nm <= r.longest_nm), None)


def contradicts(name: str, wavelength_nm: float) -> bool:
    """Return True if a band has the name of one role and the wavelength of another; "Red edge-705" is a red edge."""
    roles = _role_of_name(re.sub(r"[ _-]\d+$", "", name)), role_of_wavelength(wavelength_nm)
    return None not in roles and roles[0] != roles[1]


def role_of_band(band: Band) -> Role | None:
    """Return the role of a band; None for a band without one, and for those of the colour photograph."""
    return None if band.is_from_photograph else role_of(band.name, band.wavelength_nm)


def _role_of_name(name: str) -> Role | None:
    return next((role for role, r in ROLES.items() if band_key(name) in r.names), None)
