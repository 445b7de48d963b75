"""Check of the joint optimisation: retrieval of held-out patches, and standard errors of the corners.

A result that was fitted to windows may instead be confirmed by the windows that were left out of the fit.
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
"""Maximum standard error of the least certain mapped corner: windows near the centre do not verify the corners."""
BY_WINDOWS = "windows"
"""Recipe of a result that is fitted to windows; its residual contains the windows that were left out of the fit."""
_MIN_HELD_OUT_WINDOWS = 12
"""Minimum number of held-out windows with a measured shift; in unrelated images one in a thousand is within 1 px."""
_MIN_COVERAGE = 0.8
"""Minimum share of held-out windows with a measured shift, as they are the only evidence."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    joint = evidence.joint
    minimum = max(MIN_RETRIEVAL, MIN_TIMES_CHANCE * joint.chance)
    is_confirmed = joint.recipe == BY_WINDOWS and _is_confirmed(evidence)
    # The negations also reject NaN.
    if not (joint.retrieval >= minimum or is_confirmed):
        yield Issue(RETRIEVAL, joint.retrieval, minimum)
    if not joint.corner_std_px <= _MAX_CORNER_STD_PX:
        yield Issue(CORNER_STD_PX, joint.corner_std_px, _MAX_CORNER_STD_PX)


def _is_confirmed(evidence: Evidence[FixedPx]) -> bool:
    residual = evidence.residual
    measured = int(np.isfinite(residual.shifts_px[:, 0]).sum())
    return measured >= _MIN_HELD_OUT_WINDOWS and residual.coverage >= _MIN_COVERAGE


CHECK = Check((CORNER_STD_PX,), _issues)
