"""Check of the joint optimisation: the descriptors recognise held-out patches, and the corners are certain."""

from collections.abc import Iterator

from agalign.values.alignment import MIN_RETRIEVAL, MIN_TIMES_CHANCE
from agalign.values.issues import RETRIEVAL, TEXTURELESS, Issue, IssueKind
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

CORNER_STD_PX = IssueKind("corner_std_px", "the corners are known to {value:.1f} px only", TEXTURELESS)
_MAX_CORNER_STD_PX = 2.0
"""Standard deviation of the least certain mapped corner: beyond, the windows in the middle verify nothing there."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    joint = evidence.joint
    minimum = max(MIN_RETRIEVAL, MIN_TIMES_CHANCE * joint.chance)
    # Both are written so that nan does not pass.
    if not joint.retrieval >= minimum:
        yield Issue(RETRIEVAL, joint.retrieval, minimum)
    if not joint.corner_std_px <= _MAX_CORNER_STD_PX:
        yield Issue(CORNER_STD_PX, joint.corner_std_px, _MAX_CORNER_STD_PX)


CHECK = Check((CORNER_STD_PX,), _issues)
