"""The groups of failed bands in the terminal. The module imports nothing that the alignment needs, so that
`agalign report` takes half the memory.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agalign.values.text import counted

if TYPE_CHECKING:
    from agalign.cli.terminal import Terminal
    from agalign.products.report.facts import FailureGroup


def explain(failures: "Sequence[FailureGroup]", terminal: "Terminal") -> None:
    """Print each group of failures: number of bands, cause, captures, and remedy."""
    max_named = 3
    for group in failures:
        status, first = group.status.replace("_", " "), group.bands[0]
        if len(group.bands) == 1:
            text, named = f"{first.capture} {first.band}: {status}: {first.reason}", []
        else:
            bands, captures = counted(len(group.bands), "band"), counted(group.captures, "capture")
            text = f"{status}: {bands} of {captures}: {group.remedy.cause}"
            names = [f"{b.capture} {b.band}" for b in group.bands]
            more = f" and {len(names) - max_named} more" if len(names) > max_named else ""
            named = [f"{', '.join(names[:max_named])}{more}: {first.reason}"]
        counts = {"bands": len(group.bands), "captures": group.captures}
        terminal.problem(text, (*named, f"try: {group.advice}"), status=group.status, **counts, advice=group.advice)
