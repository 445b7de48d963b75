"""Numbers and times in the texts of tags, as cameras and programs of any locale write them."""

import re
from collections.abc import Sequence

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_WITH_UNIT = re.compile(rf"({_NUMBER})(?:/({_NUMBER}))?[A-Za-z%°µ²^/]*")
"""A number or a ratio of two, and its unit."""
_UNIT = re.compile(r"[A-Za-z%°µ²^/]+(?<!nan)(?<!inf)(?<!ind)", re.IGNORECASE)
_MAX_NUMBER = 1e15
"""Larger than times in microseconds; the squares of damaged values would overflow."""
_TIME = re.compile(
    r"(\d{4})[-:/.](\d\d)[-:/.](\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d+))?\s*(?:(Z)|([+-](?:0\d|1[0-4])):?([0-5]\d))?"
)


def numbers_in(items: Sequence[str], count: int | None = None) -> tuple[float, ...]:
    """Return the numbers in a value of one or several items; none if one of them is not a number, such as `1.#QNAN`.

    Commas separate numbers; in texts without a point they may be decimal commas: `count`, the usual length of the
    value, decides, else the spaces or items that separate the numbers.
    """
    chunks = [chunk.strip(",()[]") for item in items for chunk in re.split(r"[;\s]+|(?<=\)),", item.strip())]
    chunks = [chunk for chunk in chunks if chunk]
    chunks = [chunk for k, chunk in enumerate(chunks) if k == 0 or not _UNIT.fullmatch(chunk)]
    parts = [part for chunk in chunks for part in chunk.split(",") if part]
    if any(mark in item for item in items for mark in ".("):  # a point, or pairs in brackets
        return _all_of(parts)
    has_decimal_commas = len(items) > 1 or _has_decimal_commas(chunks, len(parts), count)
    if has_decimal_commas:  # every second comma, beginning with the first
        parts = [part.replace(",", ".") for chunk in chunks for part in re.findall(r"[^,]+(?:,[^,]+)?", chunk)]
    return _all_of(parts)


def _has_decimal_commas(chunks: Sequence[str], parts: int, count: int | None) -> bool:
    """True if commas in chunks, which are separated by spaces and contain no point, are decimal commas."""
    commas = [chunk.count(",") for chunk in chunks]
    if not any(commas) or parts == count:
        return False
    is_one_each = max(commas) == 1
    if count is not None:
        return parts == 2 * count or (is_one_each and len(chunks) == count)
    return is_one_each and len(chunks) > 1


def _all_of(texts: Sequence[str]) -> tuple[float, ...]:
    matches = [_WITH_UNIT.fullmatch(text) for text in texts]
    if not all(matches):
        return ()
    terms = [(float(m[1]), float(m[2] or 1.0)) for m in matches if m is not None]
    numbers = tuple(n / divisor for n, divisor in terms if divisor)
    return numbers if len(numbers) == len(terms) and all(abs(n) < _MAX_NUMBER for n in numbers) else ()


def iso_time(text: str, fraction: str = "", zone: str = "") -> str:
    """Return a time as ISO 8601, given as Exif's `2021:08:27 19:34:57` or with other separators; else an empty text.

    A `fraction` of the second and a time `zone` as in Exif's tags are added if the text has none, and are plausible.
    """
    found = _TIME.fullmatch(text.strip())
    if found is None:
        return ""
    year, month, day, clock, own_fraction, utc, hours, minutes = found.groups()
    of_tag = re.fullmatch(r"[+-](?:0\d|1[0-4]):[0-5]\d", zone)
    own_zone = "+00:00" if utc else f"{hours}:{minutes}" if hours else of_tag[0] if of_tag else ""
    digits = own_fraction or (fraction if fraction.isdigit() else "")
    return f"{year}-{month}-{day}T{clock}{f'.{digits}' if digits else ''}{own_zone}"
