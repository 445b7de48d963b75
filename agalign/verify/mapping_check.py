"""Check of the homography itself: an image of a flat scene is neither folded nor stretched by much."""

from collections.abc import Iterator

from agalign.values import geometry
from agalign.values.issues import UNLIKE, Issue, IssueKind
from agalign.values.pixel_units import FixedPx
from agalign.verify.check import Check, Evidence

FOLDS = IssueKind("folds", "the mapping folds or stretches the image", UNLIKE)
_MAX_STRETCH = 4.0
"""Largest over smallest magnification within an image: more is a degenerate homography, not a perspective."""


def _issues(evidence: Evidence[FixedPx]) -> Iterator[Issue]:
    scale = geometry.local_scale(evidence.joint.fixed_to_moving, *evidence.size_px)
    # Written so that nan does not pass.
    if not (scale.min() > 0 and scale.max() <= _MAX_STRETCH * scale.min()):
        yield Issue(FOLDS, float(scale.max() / scale.min()), _MAX_STRETCH)


CHECK = Check((FOLDS,), _issues)
