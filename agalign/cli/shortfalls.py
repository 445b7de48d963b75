"""What fell short in a run, on the terminal: once for each cause, with what to try."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agalign.cli.terminal import Voice

if TYPE_CHECKING:
    from agalign.products.shortfalls import Shortfall

_MOST_NAMED = 3


def explain(shortfalls: "Sequence[Shortfall]", voice: Voice) -> None:
    """The gravest first: how many bands, why, of which captures, and what to do."""
    for short in shortfalls:
        bands, captures = _count(len(short.bands), "band"), _count(short.captures, "capture")
        status = short.status.replace("_", " ")
        named = list(dict.fromkeys(f"{b.capture} {b.band}" for b in short.bands))
        more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
        voice.problem(
            f"{status}: {bands} of {captures}: {short.remedy.cause}",
            (f"{', '.join(named[:_MOST_NAMED])}{more}: {short.bands[0].reason}", f"try: {short.advice}"),
            status=short.status, bands=len(short.bands), captures=short.captures, advice=short.advice,
        )  # fmt: skip


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
