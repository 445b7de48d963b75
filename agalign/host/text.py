"""Texts from files: limited, and escaped for terminals and spreadsheets."""

import sys
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from difflib import SequenceMatcher


def counted(number: int, what: str) -> str:
    """Return a number with its noun: 1 capture, 2 captures."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def some_of(names: Iterable[str], max_names: int = 6) -> str:
    """Return the first of several names, and the number of the others, for a message."""
    known = list(names)
    more = len(known) - max_names
    return ", ".join(map(shortened, known[:max_names])) + (f" and {more:,} more" if more > 0 else "")


def did_you_mean(text: str, choices: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" with the choice that is most similar, ignoring case; empty if none is similar."""

    def similarity(choice: str) -> float:
        return SequenceMatcher(None, text.lower(), choice.lower()).ratio()

    # `difflib.get_close_matches` returns the last of equally similar words: ndwi for nvdi.
    best = max(choices, key=similarity, default="")
    min_similarity = 0.7  # of a suggestion: a quarter of the letters of a word of four may differ
    return f" (did you mean '{best}'?)" if best and similarity(best) >= min_similarity else ""


def name_problem(path: object) -> str:
    """Return why libraries cannot open a path, and the remedy: bytes of a name that Python could not decode are
    surrogates. Empty if there are none.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        encoding = sys.getfilesystemencoding()
        also = "" if encoding == "utf-8" else ", or set LC_ALL=C.UTF-8"
        return f"{path}: its name is not valid {encoding.upper()}; rename it{also}"
    return ""


def escape_controls(text: str) -> str:
    r"""Return the text on one line, with control characters (terminal escapes, changes of text direction) escaped as
    `\x1b`.
    """
    if text.isprintable():
        return text
    is_safe = [c.isprintable() or unicodedata.category(c) == "Zs" for c in text]
    escaped = (c if safe else c.encode("unicode_escape").decode() for c, safe in zip(text, is_safe, strict=True))
    return "".join(escaped)


def without_controls(text: str) -> str:
    """Return the text of a tag without control characters, changes of text direction and ends of lines."""
    dropped = "Cc", "Cf", "Cs", "Zl", "Zp"
    return text if text.isprintable() else "".join(c for c in text if unicodedata.category(c) not in dropped)


def shortened(text: str, max_length: int = 200) -> str:
    """Return a name from a file with at most 200 characters: a damaged tag or file may contain megabytes."""
    return text if len(text) <= max_length else f"{text[: max_length - 1]}…"


def without_formula(value: object) -> object:
    """Return a value for a table; a text that a spreadsheet would evaluate as a formula is quoted."""
    if not isinstance(value, str):
        return value
    text = escape_controls(value)
    with suppress(ValueError):
        float(text)  # a number may have a sign
        return text
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
