"""Vegetation indices from the bands of a capture, found by their wavelengths or names."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from agalign.errors import ConfigurationError, InputError
from agalign.values.image import FloatImage

Role = Literal["blue", "green", "red", "red edge", "nir"]
_NOMINAL_NM: dict[Role, tuple[float, float, float]] = {
    "blue": (430, 475, 510), "green": (520, 560, 590), "red": (620, 668, 695), "red edge": (697, 717, 760),
    "nir": (765, 840, 920),
}  # fmt: skip
"""Shortest, nominal and longest centre wavelength of what a role is."""
_NAMES: dict[Role, tuple[str, ...]] = {
    "blue": ("blue", "blu", "b"), "green": ("green", "gre", "grn", "g"), "red": ("red", "r"),
    "red edge": ("red edge", "rededge", "red_edge", "red-edge", "reg", "re"),
    "nir": ("nir", "near infrared", "near infra-red", "near-infrared", "n"),
}  # fmt: skip


_NOT_NARROW = ("pan", "rgb", "lwir", "thermal")
"""Bands of these names lie within a role's wavelengths by accident."""


@dataclass(frozen=True)
class Index:
    """A vegetation index of reflectances."""

    name: str
    roles: tuple[Role, ...]
    formula: Callable[..., FloatImage]
    """Of the bands in the order of `roles`; division by zero may give anything that is not finite."""
    span: tuple[float, float]
    """Values between which a picture shows it."""
    any_unit: bool = True
    """False where constants in the formula make sense for reflectance only."""
    source: str = ""


def _difference(a: FloatImage, b: FloatImage) -> FloatImage:
    return np.asarray((a - b) / (a + b))


_ALL = (
    Index("ndvi", ("nir", "red"), _difference, (-0.2, 1.0), source="Rouse et al. 1974"),
    Index("ndre", ("nir", "red edge"), _difference, (-0.2, 0.8), source="Gitelson and Merzlyak 1994"),
    Index("gndvi", ("nir", "green"), _difference, (-0.2, 1.0), source="Gitelson et al. 1996"),
    Index("ndwi", ("green", "nir"), _difference, (-1.0, 0.5), source="McFeeters 1996"),
    Index("cire", ("nir", "red edge"), lambda n, e: n / e - 1, (0.0, 4.0), source="Gitelson et al. 2003"),
    Index("cig", ("nir", "green"), lambda n, g: n / g - 1, (0.0, 10.0), source="Gitelson et al. 2003"),
    Index("vari", ("green", "red", "blue"), lambda g, r, b: (g - r) / (g + r - b), (-0.5, 0.5),
          source="Gitelson et al. 2002"),
    Index("savi", ("nir", "red"), lambda n, r: 1.5 * (n - r) / (n + r + 0.5), (-0.2, 1.0), False, "Huete 1988"),
    Index("osavi", ("nir", "red"), lambda n, r: 1.16 * (n - r) / (n + r + 0.16), (-0.2, 1.0), False,
          "Rondeaux et al. 1996"),
    Index("msavi", ("nir", "red"), lambda n, r: (2 * n + 1 - np.sqrt((2 * n + 1) ** 2 - 8 * (n - r))) / 2, (-0.2, 1.0),
          False, "Qi et al. 1994"),
    Index("evi", ("nir", "red", "blue"), lambda n, r, b: 2.5 * (n - r) / (n + 6 * r - 7.5 * b + 1), (-0.2, 1.0), False,
          "Huete et al. 2002"),
)  # fmt: skip
INDICES: Mapping[str, Index] = {index.name: index for index in _ALL}


def index_named(name: str) -> Index:
    """Raises ConfigurationError for a name that there is not."""
    try:
        return INDICES[name.strip().lower()]
    except KeyError:
        raise ConfigurationError(f"'{name}' is no index; there are {', '.join(INDICES)}") from None


def bands_for(index: Index, names: Sequence[str], wavelengths_nm: Sequence[float | None]) -> list[int]:
    """Which of some bands are the index's, by wavelength where one is known, else by name.

    Raises InputError that says which is missing.
    """
    result = []
    narrow = [not name.lower().startswith(_NOT_NARROW) for name in names]
    for role in index.roles:
        shortest, nominal, longest = _NOMINAL_NM[role]
        near = [
            (abs(w - nominal), i)
            for i, w in enumerate(wavelengths_nm)
            if w is not None and narrow[i] and shortest <= w <= longest
        ]
        named = [i for i, n in enumerate(names) if wavelengths_nm[i] is None and n.lower() in _NAMES[role]]
        if not near and not named:
            raise InputError(f"{index.name} needs a {role} band; there are {', '.join(names)}")
        result.append(min(near)[1] if near else named[0])
    return result


def role_of(name: str, wavelength_nm: float | None) -> Role | None:
    """What a narrow band is for vegetation, by its wavelength where that is known, else by name."""
    if name.lower().startswith(_NOT_NARROW):
        return None
    for role, (shortest, _, longest) in _NOMINAL_NM.items():
        if name.lower() in _NAMES[role] if wavelength_nm is None else shortest <= wavelength_nm <= longest:
            return role
    return None


def compute(index: Index, bands: Sequence[FloatImage]) -> FloatImage:
    """The index of reflectances (H, W), nan where a band is nan or the formula divides by zero."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        value = index.formula(*bands)
    return np.where(np.isfinite(value), value, np.float32(np.nan)).astype(np.float32)
