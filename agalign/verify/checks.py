"""All checks of an alignment, and all kinds of issues by code. A new check is one module and one line here."""

from collections.abc import Mapping

from agalign.values import issues
from agalign.values.issues import Issue, IssueKind
from agalign.values.pixel_units import FixedPx
from agalign.verify import descriptor_check, extrapolation_check, mapping_check, repetition, rig_check, window_check
from agalign.verify.check import Check, Evidence

CHECKS: tuple[Check, ...] = (
    mapping_check.CHECK, descriptor_check.CHECK, window_check.CHECK, rig_check.CHECK, repetition.CHECK,
)  # fmt: skip
"""In the order in which their issues are listed; the first issue is the reason in the sidecar."""

KINDS: Mapping[str, IssueKind] = {
    kind.code: kind
    for kind in (
        *issues.KINDS,
        *(kind for check in CHECKS for kind in check.kinds),
        extrapolation_check.EXTRAPOLATED,
        issues.SEED_DOES_NOT_FIT,
    )
}
"""Every kind of issue that a sidecar may contain, by code."""


def issues_of(evidence: Evidence[FixedPx]) -> tuple[Issue, ...]:
    """Return every reason for not accepting a result; empty if it passes verification."""
    result = tuple(i for check in CHECKS if not check.is_costly for i in check.issues(evidence))
    return result or tuple(i for check in CHECKS if check.is_costly for i in check.issues(evidence))
