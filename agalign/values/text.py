"""Escaping of texts from files for terminals and spreadsheets."""

import unicodedata
from contextlib import suppress


def counted(number: int, what: str) -> str:
    """Return a number with its noun: 1 capture, 2 captures."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


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


def without_formula(value: object) -> object:
    """Return a value for a table; a text that a spreadsheet would evaluate as a formula is quoted."""
    if not isinstance(value, str):
        return value
    text = escape_controls(value)
    with suppress(ValueError):
        float(text)  # a number may have a sign
        return text
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
