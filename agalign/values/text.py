"""Texts from files, shown where some characters would do something."""

import unicodedata

_FORMULA = ("=", "+", "-", "@")


def counted(number: int, what: str) -> str:
    """A number of things: 1 capture, 2 captures."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def harmless(text: str) -> str:
    r"""The text on one line, with what a terminal would act on (escape sequences, turns of the writing's direction)
    written out: `\x1b`.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else _written_out(c) for c in text)


def without_controls(text: str) -> str:
    """The text without control characters, as a tag is meant that has some."""
    return text if text.isprintable() else "".join(c for c in text if unicodedata.category(c) not in ("Cc", "Cs"))


def without_formula(value: object) -> object:
    """A value for a table: a text that a spreadsheet would calculate is quoted, as names come from cards."""
    if not isinstance(value, str):
        return value
    text = harmless(value)
    return f"'{text}" if text.startswith(_FORMULA) else text


def _written_out(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
