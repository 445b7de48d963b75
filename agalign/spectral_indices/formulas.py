"""Spectral indices, their formulas, and the choice of their bands by wavelength or name.

Formulas such as (N-R)/(N+R) are parsed as Python and evaluated without executing code.
"""

import ast
import json
import math
import re
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from agalign.errors import ConfigurationError, InputError
from agalign.host.text import did_you_mean
from agalign.values.image import FloatImage
from agalign.values.spectrum import ROLES, Role, role_of

_MAX_LENGTH = 300
"""Characters of a formula: longer ones could exhaust Python's recursion limit."""
_OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
}
_FUNCTIONS: Mapping[str, Callable[[Any], Any]] = {"sqrt": np.sqrt, "log": np.log, "exp": np.exp, "abs": np.abs}
_NOISE = 0.02
"""Noise of reflectance relative to its value: a difference below this share of its terms has no certain sign."""
_OF_USER = "formula of the user"
_ROLE_OF_SYMBOL = {symbol: role for role, spectral_range in ROLES.items() for symbol in spectral_range.symbols}


def symbols_of(formula: str) -> tuple[str, ...]:
    """Return the different names in a formula, in the order of their first use.

    Allowed are names, numbers, + - * / ** (or ^), parentheses, and sqrt, log, exp and abs. Raises ConfigurationError
    for anything else.
    """
    # The evaluation adds an entry for each name that it reads.
    used: dict[str, FloatImage] = defaultdict(lambda: np.ones((1, 1), np.float32))
    evaluate(formula, used)
    return tuple(used)


def evaluate(formula: str, values: Mapping[str, FloatImage]) -> FloatImage:
    """Return the value (height, width) of a formula, given an array of that shape for each name.

    Not finite where it is undefined. Raises ConfigurationError for anything but arithmetic.
    """
    with np.errstate(all="ignore"):
        return np.asarray(_value(_parsed(formula), values), np.float32)


def _parsed(formula: str) -> ast.expr:
    if len(formula) > _MAX_LENGTH:
        raise ConfigurationError(f"the formula has {len(formula)} characters; at most {_MAX_LENGTH} are allowed")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Python, such as that a number is not callable
            return ast.parse(formula.strip().replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ConfigurationError(f"'{formula}' is not a formula; write one like (N-R)/(N+R)") from None


def _value(node: ast.expr, values: Mapping[str, FloatImage]) -> Any:
    max_number = 1e30  # numbers must fit into float32
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int() | float() as value) if abs(value) < max_number and not isinstance(value, bool):
            # float32 overflows to infinity; Python's integers would grow without limit, as in 9**9**9.
            return np.float32(value)
        case ast.BinOp(left, ast.Div(), right):
            return _value(left, values) / _divisor(right, values)
        case ast.BinOp(base, ast.Pow(), right) if _is_number(right):
            power = _value(right, values)
            return np.float32(1) / _divisor(base, values, -power) if power < 0 else _value(base, values) ** power
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand, values))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](_value(argument, values))
    raise ConfigurationError(
        f"'{ast.unparse(node)}' is not allowed in a formula; use band letters, numbers, + - * / **, parentheses, "
        f"{', '.join(_FUNCTIONS)}"
    )


def _is_number(node: ast.expr) -> bool:
    """Return True for a part of a formula without names, also of functions."""
    return not any(isinstance(part, ast.Name) for part in ast.walk(node))


def _divisor(node: ast.expr, values: Mapping[str, FloatImage], power: Any = 1) -> Any:
    """Return the value of a power of a denominator. If it has bands, it is nan where it is not positive, not finite, or
    near zero.
    """
    value, _, is_certain = _parts(node, values)
    divisor = value**power
    if _is_number(node):
        return divisor
    return np.where(is_certain & (divisor > 0) & (divisor < np.inf), divisor, np.float32(np.nan))


def _parts(node: ast.expr, values: Mapping[str, FloatImage]) -> tuple[Any, Any, Any]:
    """Return the value of a part of a denominator, the sum of the absolute values of its terms, with sums in products
    multiplied out, and True where all factors of the part are beyond the noise of their terms.

    Each part is calculated once: the time of nested denominators would otherwise double with each level.
    """
    match node:
        case ast.BinOp(left=left, op=(ast.Add() | ast.Sub()) as op, right=right):
            one, other = _parts(left, values), _parts(right, values)
            value, magnitude = _OPERATORS[type(op)](one[0], other[0]), one[1] + other[1]
            return value, magnitude, np.abs(value) > _NOISE * magnitude
        case ast.BinOp(left, ast.Mult(), right):
            one, other = _parts(left, values), _parts(right, values)
            return one[0] * other[0], one[1] * other[1], one[2] & other[2]
        case ast.BinOp(left, ast.Div(), right):
            one, divisor = _parts(left, values), _divisor(right, values)
            return one[0] / divisor, one[1] / np.abs(divisor), one[2]
        case ast.BinOp(base, ast.Pow(), right) if _is_number(right):
            if (power := _value(right, values)) < 0:
                inverse = np.float32(1) / _divisor(base, values, -power)
                return inverse, np.abs(inverse), np.bool_(True)
            value, magnitude, is_certain = _parts(base, values)
            return value**power, magnitude**power, is_certain
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            value, magnitude, is_certain = _parts(operand, values)
            return _OPERATORS[type(op)](value), magnitude, is_certain
        case ast.Call(func=ast.Name(id="abs" | "sqrt" as name), args=[argument], keywords=[]):
            value, magnitude, is_certain = _parts(argument, values)
            return _FUNCTIONS[name](value), _FUNCTIONS[name](magnitude), is_certain
    value = _value(node, values)
    return value, np.abs(value), np.bool_(True)


@dataclass(frozen=True)
class Index:
    """A spectral index of reflectances."""

    name: str
    formula: str
    """Arithmetic of the bands B, G, R, RE and N, and of `constants`."""
    span: tuple[float, float] | None = None
    """Range of the colour scale of a picture; None for the 2nd and 98th percentile of the values."""
    source: str = ""
    constants: tuple[tuple[str, float], ...] = ()
    any_unit: bool = True
    """False if the value depends on the unit of the bands, which should be reflectance."""

    @property
    def is_of_user(self) -> bool:
        """True for a formula of the user, which may be of bands in any unit, whatever its value then means."""
        return self.source == _OF_USER

    @cached_property
    def symbols(self) -> tuple[str, ...]:
        """The bands in the formula, in the order of their first use."""
        return tuple(s for s in symbols_of(self.formula) if s not in dict(self.constants))

    @property
    def roles(self) -> tuple[Role, ...]:
        """The roles of `symbols`."""
        return tuple(_ROLE_OF_SYMBOL[s.upper()] for s in self.symbols)


INDICES: Mapping[str, Index] = {
    index.name: index
    for index in (
        Index("ndvi", "(N - R) / (N + R)", (-0.2, 1.0), "Rouse et al. 1974"),
        Index("ndre", "(N - RE) / (N + RE)", (-0.2, 0.8), "Gitelson and Merzlyak 1994"),
        Index("gndvi", "(N - G) / (N + G)", (-0.2, 1.0), "Gitelson et al. 1996"),
        Index("ndwi", "(G - N) / (G + N)", (-1.0, 0.5), "McFeeters 1996"),
        Index("cire", "N / RE - 1", (0.0, 4.0), "Gitelson et al. 2003"),
        Index("cig", "N / G - 1", (0.0, 10.0), "Gitelson et al. 2003"),
        Index("vari", "(G - R) / (G + R - B)", (-0.5, 0.5), "Gitelson et al. 2002"),
        Index("savi", "1.5 * (N - R) / (N + R + 0.5)", (-0.2, 1.0), "Huete 1988", any_unit=False),
        Index("osavi", "(N - R) / (N + R + 0.16)", (-0.2, 1.0), "Rondeaux et al. 1996", any_unit=False),
        Index(
            "msavi",
            "(2 * N + 1 - sqrt((2 * N + 1) ** 2 - 8 * (N - R))) / 2",
            (-0.2, 1.0),
            "Qi et al. 1994",
            any_unit=False,
        ),
        Index("evi", "2.5 * (N - R) / (N + 6 * R - 7.5 * B + 1)", (-0.2, 1.0), "Huete et al. 2002", any_unit=False),
    )
}


def chosen_indices(names: Sequence[str] | None, formulas: Sequence[str] = ()) -> list[Index]:
    """Return the indices of names and formulas; without either, if `names` is None, that is ndvi.

    Raises ConfigurationError for an unknown or a repeated one.
    """
    if names is None:
        names = () if formulas else ("ndvi",)
    chosen = [index_named(name) for name in names] + [index_of_formula(f) for f in formulas]
    repeated = [one.name for i, one in enumerate(chosen) if one.name in [c.name for c in chosen[:i]]]
    if repeated:
        raise ConfigurationError(f"index '{repeated[0]}' is given twice; give it once, and formulas as 'name=N/R'")
    return chosen


def index_named(name: str) -> Index:
    """Return an index by name: one of `INDICES`, or of the catalogue of spyndex if that is installed.

    Raises ConfigurationError for an unknown name, or for an index of bands that drone cameras do not have.
    """
    wanted = name.strip().lower()
    if wanted in INDICES:
        return INDICES[wanted]
    entries = _data_of_spyndex("spectral-indices-dict.json").get("SpectralIndices", {})
    catalogue = {key.lower(): entry for key, entry in entries.items()}
    if wanted in catalogue:
        return _of_catalogue(wanted, catalogue[wanted])
    more = "a name in the catalogue of spyndex" if catalogue else "install more in a checkout: pip install '.[indices]'"
    similar = did_you_mean(wanted, [*INDICES, *catalogue])
    raise ConfigurationError(f"unknown index '{name}'{similar}; choose from {', '.join(INDICES)}, or {more}")


def index_of_formula(text: str) -> Index:
    """Return the index of a text 'name=(N-R)/(N+R)'; the default name is 'formula'. Raises ConfigurationError."""
    name, equals, formula = text.partition("=")
    name, formula = (name.strip().lower(), formula) if equals else ("formula", text)
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", name) or name in INDICES:
        allowed = "a letter, then up to 30 letters, digits or _, and not the name of an index"
        raise ConfigurationError(f"'{name}' cannot name a formula; use {allowed}")
    return _checked(Index(name, formula.strip(), source=_OF_USER))


@cache
def _data_of_spyndex(file: str) -> dict[str, Any]:
    """The data of spyndex, read without executing its code; empty if it is not installed."""
    try:
        path = Path(str(metadata.distribution("spyndex").locate_file(f"spyndex/data/{file}")))
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (metadata.PackageNotFoundError, OSError, ValueError):
        return {}


def _of_catalogue(name: str, entry: Mapping[str, Any]) -> Index:
    formula = str(entry["formula"])
    defaults = {k: v.get("default") for k, v in _data_of_spyndex("constants.json").items()}
    constants = tuple((s, float(defaults[s])) for s in symbols_of(formula) if defaults.get(s) is not None)
    return _checked(Index(name, formula, source=str(entry.get("reference", "")), constants=constants))


def _checked(index: Index) -> Index:
    """Return an index with `any_unit` by its formula: True if the same factor in all bands does not change its value.

    Raises ConfigurationError if the formula has no band, or a name that is not that of a band.
    """
    unknown = [s for s in index.symbols if s.upper() not in _ROLE_OF_SYMBOL]
    if unknown or not index.symbols:
        used = ", ".join(unknown) or "no band"
        raise ConfigurationError(f"index '{index.name}', {index.formula}, uses {used}; the bands are B, G, R, RE and N")
    # No sums and differences of which a divisor could be made are equal.
    bands = [np.array([0.07 * k + 0.013 * k * k, 0.5 / k], np.float32) for k in range(1, len(index.symbols) + 1)]
    scaled = [b * np.float32(1000) for b in bands]
    any_unit = np.allclose(compute(index, bands), compute(index, scaled), rtol=1e-4, equal_nan=True)
    return replace(index, any_unit=bool(any_unit))


def bands_for(index: Index, wavelengths_nm: Mapping[str, float | None]) -> list[str]:
    """Return the names of the bands of an index, in the order of `index.symbols`, given the wavelengths of bands.

    If several bands have a role, that nearest to the nominal wavelength is used. Raises InputError, which names the
    missing role.
    """
    result = []
    for role in index.roles:
        # Bands with a known wavelength first; of two with the same wavelength that with the name of the role.
        distances = {
            name: (math.inf if nm is None else abs(nm - ROLES[role].nominal_nm), role_of(name, None) != role)
            for name, nm in wavelengths_nm.items()
            if role_of(name, nm) == role
        }
        if not distances:
            raise InputError(f"{index.name} needs a {role} band; there are {', '.join(wavelengths_nm)}")
        result.append(min(distances, key=distances.__getitem__))
    return result


def compute(index: Index, bands: Sequence[FloatImage]) -> FloatImage:
    """Return the index (height, width) of its bands.

    It is nan where a band is nan or negative, which no reflectance is, and where a denominator is not positive beyond
    its noise.
    """
    values: dict[str, FloatImage] = {
        symbol: np.where(band >= 0, band, np.float32(np.nan)) for symbol, band in zip(index.symbols, bands, strict=True)
    }
    values |= {name: np.asarray(number, np.float32) for name, number in index.constants}
    value = evaluate(index.formula, values)
    return np.where(np.isfinite(value), value, np.float32(np.nan))
