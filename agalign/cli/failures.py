"""Failures of a run on the terminal, grouped by cause, with remedies."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agalign.cli.terminal import Terminal
from agalign.values.text import counted

if TYPE_CHECKING:
    from agalign.products.report.facts import FailureGroup

_MAX_NAMED = 3


def explain(failures: "Sequence[FailureGroup]", terminal: Terminal) -> None:
    """Print each group of failures: number of bands, cause, captures, and remedy."""
    for group in failures:
        status, first = group.status.replace("_", " "), group.bands[0]
        if len(group.bands) == 1:
            text, named = f"{first.capture} {first.band}: {status}: {first.reason}", []
        else:
            bands, captures = counted(len(group.bands), "band"), counted(group.captures, "capture")
            text = f"{status}: {bands} of {captures}: {group.remedy.cause}"
            names = [f"{b.capture} {b.band}" for b in group.bands]
            more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
            named = [f"{', '.join(names[:_MAX_NAMED])}{more}: {first.reason}"]
        terminal.problem(
            text, (*named, f"try: {group.advice}"),
            status=group.status, bands=len(group.bands), captures=group.captures, advice=group.advice,
        )  # fmt: skip
