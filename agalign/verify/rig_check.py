"""Check against the flight's rig, which detects aliasing in repetitive scenes."""

from collections.abc import Iterator

from agalign.values.issues import Issue, IssueKind, Remedy
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

UNEXPECTED_PX = IssueKind(
    "unexpected_px", "the result is {value:.1f} px from the position that the rig of the flight predicts",
    Remedy(
        "the result contradicts the rig of the flight",
        "if a lens was replaced or moved, align without --model; otherwise look at the picture",
    ),
)  # fmt: skip
MAX_UNEXPECTED_PX = 3.0
"""Distance from the prediction, px of the moving file, that is always accepted, as relief may cause it."""
_MAX_UNEXPECTED_STD = 5.0
"""Larger distances are accepted up to this multiple of the prediction's standard error."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    prediction = evidence.prediction
    if prediction is None or prediction.off_px is None:
        return
    limit_px = max(MAX_UNEXPECTED_PX, _MAX_UNEXPECTED_STD * prediction.std_px)
    # The negation also rejects NaN.
    if not prediction.off_px <= limit_px:
        yield Issue(UNEXPECTED_PX, prediction.off_px, limit_px)


CHECK = Check((UNEXPECTED_PX,), _issues)
