"""What went wrong in a run, on the terminal: once for each cause, with the remedy."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agalign.cli.terminal import Terminal

if TYPE_CHECKING:
    from agalign.products.failures import FailureGroup

_MAX_NAMED = 3


def explain(failures: "Sequence[FailureGroup]", terminal: Terminal) -> None:
    """The gravest first: how many bands, why, in what captures, and the remedy."""
    for short in failures:
        status, first = short.status.replace("_", " "), short.bands[0]
        if len(short.bands) == 1:
            text, named = f"{first.capture} {first.band}: {status}: {first.reason}", []
        else:
            bands, captures = _count(len(short.bands), "band"), _count(short.captures, "capture")
            text = f"{status}: {bands} of {captures}: {short.remedy.cause}"
            names = [f"{b.capture} {b.band}" for b in short.bands]
            more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
            named = [f"{', '.join(names[:_MAX_NAMED])}{more}: {first.reason}"]
        terminal.problem(
            text, (*named, f"try: {short.advice}"),
            status=short.status, bands=len(short.bands), captures=short.captures, advice=short.advice,
        )  # fmt: skip


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
