"""Reasons for not accepting an alignment: what was measured, the limit, and in words."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler
from pydantic import dataclasses as validated
from pydantic_core import CoreSchema, core_schema

from agalign.values import remedies
from agalign.values.fields import RECORD, Measured, Message, in_file_schema


@dataclass(frozen=True)
class IssueKind:
    """A kind of issue. `KINDS` has all of them by code."""

    code: str
    """Identifies the kind in sidecars; it must not change."""
    sentence: str
    """Template of the reason, without a full stop: `value`, `limit` and `detail` are filled in."""
    remedy: remedies.Remedy


# ---- kinds of issues that reading, seeding and estimation report

UNREADABLE = IssueKind("unreadable", "{detail}", remedies.UNREADABLE_BAND)
BLANK_REFERENCE = IssueKind("blank_reference", "the reference band is constant or all invalid", remedies.BLANK)
BLANK_MOVING = IssueKind("blank_moving", "the moving band is constant or all invalid", remedies.BLANK)
FEW_VALID = IssueKind("few_valid", "only {value:.2%} of the {detail} band is valid", remedies.FEW_VALID)
NO_SUCH_SEED = IssueKind("no_such_seed", "this band has no {detail} seed; omit --seed", remedies.ASKED)
SEED_ASKED_FOR = IssueKind("seed_asked_for", "only the seed was requested", remedies.ASKED)
NO_CONTRAST = IssueKind(
    "no_contrast", "no valid patch of the reference has enough contrast to learn from", remedies.TEXTURELESS
)
FEW_KEYPOINTS = IssueKind(
    "few_keypoints", "only {value:.0f} keypoints are in the area that both bands show", remedies.TEXTURELESS
)
NOT_INVERTIBLE = IssueKind(
    "not_invertible", "the optimisation diverged to a mapping that cannot be inverted", remedies.UNLIKE
)
CORNERS_UNKNOWN = IssueKind(
    "corners_unknown", "the patches do not determine the mapping at the corners of the image", remedies.TEXTURELESS
)
RETRIEVAL = IssueKind(
    "retrieval", "the descriptors do not distinguish held-out patches (retrieval {value:.2f})", remedies.TEXTURELESS
)
"""Reported by the descriptor check, and by an estimation that stops early."""
SEED_DOES_NOT_FIT = IssueKind("seed_does_not_fit", "but the seed does not fit either", remedies.UNLIKE)
"""Added to the issues of a result if its seed cannot be used instead."""

OTHER_GEOMETRY = IssueKind(
    "other_geometry", "the relief that aligns the other bands does not align this one", remedies.OTHER_GEOMETRY
)
"""Reported for a band that only a homography or displacement field aligns, in a capture with a relief."""

OF_FILES = frozenset((UNREADABLE, BLANK_REFERENCE, BLANK_MOVING, FEW_VALID))
"""Kinds of issues of a single file, with remedies that hold for mosaics too."""

# ---- kinds of issues that checks report

FOLDS = IssueKind("folds", "the mapping folds or stretches the image", remedies.UNLIKE)
INACCURATE = IssueKind(
    "inaccurate", "the expected error is above {detail} in {value:.0%} of the image", remedies.UNCERTAIN
)
UNMEASURED = IssueKind(
    "unmeasured",
    "no shift can be measured in {value:.0%} of the windows under the relief of the other bands",
    remedies.PARALLAX,
)
OTHER_CONTENT = IssueKind(
    "other_content",
    "an area with {value:.0%} of the windows shows a different scene in this band",
    remedies.OTHER_CONTENT,
)
FEW_WINDOWS = IssueKind("few_windows", "too little common structure to verify the result", remedies.TEXTURELESS)
COVERAGE = IssueKind("coverage", "a shift can be measured in only {value:.1%} of the windows", remedies.UNLIKE)
CLOSE_WINDOWS = IssueKind(
    "close_windows", "only {value:.1%} of the windows are aligned within {detail}", remedies.PARALLAX
)
CLUSTER = IssueKind("cluster", "an area with {value:.0%} of the windows is misaligned", remedies.PARALLAX)
SECOND_LAYER = IssueKind("second_layer", "about {value:.0%} of the structure is off by {detail}", remedies.PARALLAX)
UNEXPECTED_PX = IssueKind(
    "unexpected_px",
    "the result is {value:.1f} px from the position that the rig of the flight predicts",
    remedies.CONTRADICTS_RIG,
)
REPEATS = IssueKind(
    "repeats",
    "the scene is repetitive: a shift of {value:.0f} px fits nearly as well, and no prior information decides",
    remedies.REPETITIVE,
)

BY_PARALLAX = frozenset((CLOSE_WINDOWS, CLUSTER, INACCURATE, UNMEASURED, SECOND_LAYER))
"""Kinds of issues that parallax may cause, which a relief or a displacement field removes."""
PREDICTED_WITH = frozenset((*BY_PARALLAX, OTHER_CONTENT))
"""Kinds of issues of a mapping that the images confirm, but not everywhere: it predicts, with its standard error."""

KINDS: Mapping[str, IssueKind] = {k.code: k for k in list(globals().values()) if isinstance(k, IssueKind)}
"""Every kind of issue that a sidecar may contain, by code: all that are defined above."""


class _ByCode:
    """A kind of issue, which JSON holds as its code."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        code = core_schema.literal_schema(list(KINDS))
        read = core_schema.no_info_after_validator_function(KINDS.__getitem__, code)
        return in_file_schema(code, lambda kind: kind.code, read, core_schema.is_instance_schema(IssueKind))


@validated.dataclass(frozen=True, config=RECORD)
class Issue:
    """One reason for not accepting an alignment."""

    kind: Annotated[IssueKind, _ByCode()]
    """Code of the reason."""
    value: Annotated[float, Measured()] | None = None
    """Measured value: px, a share or a count."""
    limit: Annotated[float, Measured()] | None = None
    """Minimum or maximum accepted value."""
    detail: Message = ""
    """Error of a file, requested seed, or distance that a share refers to."""

    @property
    def code(self) -> str:
        """Code of the kind."""
        return self.kind.code


def sentence(issue: Issue) -> str:
    """Return the reason in words, without a full stop."""
    return issue.kind.sentence.format(value=issue.value, limit=issue.limit, detail=issue.detail)
