"""Conversion of a band's raw numbers to radiance and reflectance, and how far its values can be trusted."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from pydantic import dataclasses as validated

from agalign.values.fields import RECORD, Name, Number3
from agalign.values.pixel_units import PixelScale

Quantity = Literal["radiance", "relative radiance", "reflectance", "relative reflectance", "temperature"]
"""Radiance in W / m^2 / sr / nm, reflectance 0 to 1, temperature in degrees Celsius; `relative` is up to a factor that
all bands share.
"""
MAX_REFLECTANCE = 2.0
"""Maximum median of a band: fresh snow and panels are below 1, so that a median above 1 is named, and a tilted sensor
measures as little as half of the light. Single pixels, as of sun glint, are brighter. The raw numbers of any sensor
exceed it.
"""
RadiometrySource = Literal["camera calibration", "light sensor", "panel", "panel and light sensor"]


@validated.dataclass(frozen=True, config=RECORD)
class RadiometricError:
    """A part of the expected error of a band's radiance or reflectance.

    Examples
    --------
    >>> band = agalign.discover("flight").captures[0].bands[0]
    >>> [part.name for part in band.radiometry.errors]
    ['factory calibration']
    """

    name: Name
    """What the values depend on, such as `light sensor`."""
    std_percent: Number3
    """Standard error (1 sigma) that it causes, percent of the value."""
    state: Literal["expected", "missing", "contradicted"] = "expected"
    """`missing`: the tags lack it, so that the values are not corrected for it. `contradicted`: two sources differ."""


Errors = tuple[RadiometricError, ...]


def total_percent(errors: Iterable[RadiometricError]) -> float:
    """Return the standard error of a value, percent: the root of the sum of the squares of its parts."""
    return math.sqrt(sum(part.std_percent**2 for part in errors))


def are_raw_numbers(dtype: str, scale: float) -> bool:
    """Return True for the pixels of a file that are raw numbers unless a tag states their quantity: integers without a
    scale, for which files have 1.
    """
    return dtype.startswith(("u", "i")) and scale == 1.0


@dataclass(frozen=True)
class ReflectanceFactor:
    """Factor from radiance to reflectance."""

    value: float
    quantity: Quantity = "reflectance"
    source: RadiometrySource = "light sensor"
    panel_age_s: float | None = None
    """Time between the capture and the nearest panel; None without a panel, or if one of their clocks was not set."""
    errors: Errors = ()
    """Parts of the expected error of the factor."""

    @property
    def irradiance(self) -> float:
        """Irradiance on a horizontal plane, W / m^2 / nm, or relative."""
        return (math.pi if self.quantity == "reflectance" else 1.0) / self.value


@dataclass(frozen=True)
class Radiometry:
    """Radiometric calibration of a band's raw values; `pixels.radiometry` has the equation."""

    quantity: Quantity
    black_level: float
    full_scale: float
    gain: float
    vignetting_centre_px: tuple[float, float] = (0.0, 0.0)
    vignetting: tuple[float, ...] = ()
    """k1 ... k6, per px, px^2 ..."""
    vignetting_divides: bool = True
    row_gradient: float = 0.0
    """Relative increase of the signal from each row to the next."""
    by_sun: ReflectanceFactor | None = None
    """Factor by the light sensor."""
    source: RadiometrySource = "camera calibration"
    """Source of the factor from radiance to reflectance."""
    factor: float = 1.0
    """The factor from radiance to reflectance, which `gain` includes."""
    panel_age_s: float | None = None
    """Time between the capture and the nearest panel, if `source` includes a panel and it is known."""
    raw_step: int = 1
    """Common divisor of all raw numbers of the camera, such as 16 for 12 bits in the upper bits of 16; 1 if none is
    known."""
    tags: Mapping[str, float] = field(default_factory=dict)
    """The values of tags that `gain` is calculated from, with the names of `pixels.radiometry`."""
    errors: Errors = ()
    """Parts of the expected error of the values."""
    cell_means: tuple[tuple[float, ...], ...] = ()
    """Mean of the values in each of 12 x 16 equal cells of the band's own image, row by row; NaN where all are invalid.
    Empty if they were not measured, or if the image is too dark for a comparison."""

    def rescaled(self, scale: PixelScale) -> "Radiometry":
        """Return the calibration of the image resized by `scale`, which is nearly the same along both axes."""
        x, y = scale.positions(self.vignetting_centre_px).tolist()
        vignetting = tuple(k / scale.mean**power for power, k in enumerate(self.vignetting, start=1))
        gradient = self.row_gradient / scale.y
        return replace(self, vignetting_centre_px=(x, y), vignetting=vignetting, row_gradient=gradient)

    @property
    def irradiance(self) -> float | None:
        """Irradiance by the light sensor, W / m^2 / nm, or relative."""
        return None if self.by_sun is None else self.by_sun.irradiance

    @property
    def is_of_light(self) -> bool:
        """True for radiance, which can be converted to reflectance."""
        return self.quantity in ("radiance", "relative radiance")

    @property
    def std_percent(self) -> float:
        """Expected error (1 sigma) of the values, percent."""
        return total_percent(self.errors)

    @property
    def uncorrected(self) -> tuple[str, ...]:
        """What the values are not corrected for, because the tags lack it."""
        return tuple(part.name for part in self.errors if part.state == "missing")
