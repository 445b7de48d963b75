"""Check of the homography: it does not fold the image, and its magnification varies by a limited ratio."""

from collections.abc import Iterator

from agalign.values import geometry
from agalign.values.issues import UNLIKE, Issue, IssueKind
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

FOLDS = IssueKind("folds", "the mapping folds or stretches the image", UNLIKE)
_MAX_STRETCH = 4.0
"""Maximum ratio of the largest and the smallest magnification: beyond it, a homography is degenerate."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    scale = geometry.local_scale(evidence.joint.fixed_to_moving, *evidence.size_px)
    # The negation also rejects NaN.
    if not (scale.min() > 0 and scale.max() <= _MAX_STRETCH * scale.min()):
        yield Issue(FOLDS, float(scale.max() / scale.min()), _MAX_STRETCH)


CHECK = Check((FOLDS,), _issues)
