"""Names of bands in texts such as file names, and the parts of file names.

Texts from tags are limited in length first: the expressions are linear in the length of usual names only.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from agalign.errors import ConfigurationError, NoSuchBandError
from agalign.host.text import did_you_mean

WORD = (
    r"(?:coastal|blue|green|red[ _-]?edge|near[ _-]?infra[ _-]?red|infra[ _-]?red|red|nir|swir|pan|panchro|lwir|"
    r"thermal|gre|reg|rgb|grn|blu|vis|ms)"
)
"""Regular expression of the words for bands in names."""
BAND = rf"{WORD}[_-]?\d*|\d{{3,4}}[ _-]?nm"
"""Regular expression of the names of bands: a word with or without a number, or a wavelength."""
SHORT = "re|[bgrn]"
"""Regular expression of abbreviations that are bands only in certain places."""
_SUFFIX = re.compile(
    rf"^(?P<capture>.*?)(?:(?:^|(?<=.)[_\-. ]+)(?P<band>{BAND}|b?\d{{1,2}}|{SHORT})"
    rf"|(?<=[0-9a-z])(?P<glued>(?-i:Blue|Green|RedEdge|Red|NIR|GRE|REG|RED|BLUE|GREEN)|\d{{3,4}}nm))$",
    re.IGNORECASE | re.DOTALL,
)
"""A band at the end of a file name, after a separator, or `glued` to the name of the capture as in DJI_0001NIR."""
_PREFIX = re.compile(rf"(?P<band>{WORD}|{SHORT})(?:[_\- ]|(?=\d))(?P<capture>.+)", re.IGNORECASE | re.DOTALL)
"""A band at the beginning of a file name, as in NIR01 or Red_IMG_0001."""


def no_such_band(path: Path, wanted: str, known: Iterable[str], *, kind: str = "band", by: str = "") -> NoSuchBandError:
    """Return the error of an unknown name of a band in a file or folder, which an option (`by`) asks for."""
    names, asked = list(dict.fromkeys(known)), f", as {by} asks" if by else ""
    what = f"no {kind} '{wanted}'{asked}{did_you_mean(wanted, names)}"
    return NoSuchBandError(f"{path}: {what}; choose from {', '.join(names)}")


def is_band_name(text: str) -> bool:
    """Return True for a text that is the name of a spectral band, such as nir, R or 550nm, and nothing else."""
    return bool(re.fullmatch(rf"(?!(?:rgb|vis|ms)[_-]?\d*$)(?:ms[ _-])?(?:{BAND}|{SHORT})", text, re.IGNORECASE))


def split_end(stem: str) -> tuple[str, str]:
    """Return (capture, band) of a file name without suffix that ends in a band; no band for other names."""
    # The last number of a date at the end of a name is a day, not a band.
    has_date = re.search(r"(?:19|20)\d\d([-_.])\d{1,2}\1\d{1,2}$", stem)
    match = None if has_date else _SUFFIX.fullmatch(stem)
    return (match["capture"].rstrip("_-. "), match["band"] or match["glued"]) if match else (stem, "")


def split_start(stem: str) -> tuple[str, str] | None:
    """Return (capture, band) of a file name that begins with a band; None for other names."""
    match = _PREFIX.fullmatch(stem)
    return (match["capture"], match["band"]) if match else None


def own_stem(path: Path) -> str:
    """Return the name of a file without suffix, and without the end that copies have, such as ' (1)' or ' - Copy'."""
    end = r" ?\((?:\d+|copy)\)$|(?: ?[-\N{EN DASH}]| ) ?(?:copy|kopie|copie|copia)(?: ?\(?\d+\)?)?$"
    return re.sub(end, "", path.stem, flags=re.IGNORECASE) or path.stem


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
    bands = (WORD, r"[^\W\d_]+") if "{band}{capture}" in pattern else (BAND, "[^/]+?")
    whole = (escaped.replace(r"\{band\}", f"(?P<band>{band})") for band in bands)
    return tuple(re.compile(one, re.IGNORECASE | re.DOTALL) for one in whole)


def wavelength_in(name: str) -> float | None:
    """Return the wavelength of a name that is one, such as 840nm; None for other names."""
    match = re.fullmatch(r"(\d{3,4})[ _-]?nm", name, re.IGNORECASE)
    return float(match.group(1)) if match else None
