"""Check of the joint optimisation: the descriptors recognise held-out patches, and the corners are certain.

Where they recognise nothing, a result by windows is checked by the windows left out of its fit, more strictly.
"""

from collections.abc import Iterator

import numpy as np

from agalign.values.alignment import MIN_RETRIEVAL, MIN_TIMES_CHANCE
from agalign.values.issues import RETRIEVAL, TEXTURELESS, Issue, IssueKind
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

CORNER_STD_PX = IssueKind(
    "corner_std_px", "the standard error at the corners of the image is {value:.1f} px", TEXTURELESS
)  # fmt: skip
_MAX_CORNER_STD_PX = 2.0
"""Standard deviation of the least certain mapped corner: beyond, the windows in the middle verify nothing there."""
BY_WINDOWS = "windows"
"""Recipe of a result that is fitted to windows; its residual is that of the windows left out of the fit."""
_MIN_HELD_OUT = 12
"""Of these, windows with a measured shift: of unrelated images, one in a thousand is within a px by chance."""
_MIN_COVERAGE = 0.8
"""Share of these in which a shift can be measured: the windows are the only evidence."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    joint = evidence.joint
    minimum = max(MIN_RETRIEVAL, MIN_TIMES_CHANCE * joint.chance)
    is_confirmed = joint.recipe == BY_WINDOWS and _is_confirmed(evidence)
    # Both are written so that nan does not pass.
    if not (joint.retrieval >= minimum or is_confirmed):
        yield Issue(RETRIEVAL, joint.retrieval, minimum)
    if not joint.corner_std_px <= _MAX_CORNER_STD_PX:
        yield Issue(CORNER_STD_PX, joint.corner_std_px, _MAX_CORNER_STD_PX)


def _is_confirmed(evidence: Evidence[FixedPx]) -> bool:
    residual = evidence.residual
    measured = int(np.isfinite(residual.shifts_px[:, 0]).sum())
    return measured >= _MIN_HELD_OUT and residual.coverage >= _MIN_COVERAGE


CHECK = Check((CORNER_STD_PX,), _issues)
