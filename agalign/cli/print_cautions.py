"""What to check in the results of a run, in the terminal. The module imports nothing that the alignment needs, so that
`agalign report` takes half the memory.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agalign.host.text import counted

if TYPE_CHECKING:
    from agalign.cli.terminal import Terminal
    from agalign.report.facts import CautionGroup


def explain(groups: "Sequence[CautionGroup]", terminal: "Terminal") -> None:
    """Print what to check, the largest effect first: number of bands, cause, size, captures, and remedy."""
    max_named = 3
    if groups:
        terminal.event("check", "Check these, the largest effect first:", causes=len(groups))
    for group in groups:
        status, first = group.status.replace("_", " "), group.bands[0]
        if len(group.bands) == 1:
            name = f"{first.capture} {first.band}".rstrip()
            text, named = f"{name}: {status}: {first.reason}", []
        else:
            bands, captures = counted(len(group.bands), "band"), counted(group.captures, "capture")
            what = captures if group.status == "no_result" else f"{bands} of {captures}"
            size = f" ({group.size})" if group.size else ""
            text = f"{status}: {what}: {group.remedy.cause}{size}"
            names = [f"{b.capture} {b.band}".rstrip() for b in group.bands]
            more = f" and {len(names) - max_named} more" if len(names) > max_named else ""
            named = [f"{', '.join(names[:max_named])}{more}: {first.reason}"]
        facts = {"bands": len(group.bands), "captures": group.captures, "advice": group.advice}
        facts |= {"cause": group.remedy.cause, "size": group.size, "effect": round(group.effect, 4)}
        terminal.problem(text, (*named, f"try: {group.advice}"), status=group.status, **facts)
