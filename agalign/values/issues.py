"""Reasons for not accepting an alignment: what was measured, the limit, in words, and a suggestion for the user."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Remedy:
    """Cause of some kinds of issues, and a suggestion for the user."""

    cause: str
    advice: str


@dataclass(frozen=True)
class IssueKind:
    """A kind of issue. `verify.checks.KINDS` has all of them by code."""

    code: str
    """Identifies the kind in sidecars; it must not change."""
    sentence: str
    """Template of the reason, without a full stop: `value`, `limit` and `detail` are filled in."""
    remedy: Remedy


@dataclass(frozen=True)
class Issue:
    """One reason for not accepting an alignment."""

    kind: IssueKind
    value: float | None = None
    """Measured value, in the unit of the kind: px, a share, a count."""
    limit: float | None = None
    """Minimum or maximum accepted value."""
    detail: str = ""
    """A file's error, the seed that was requested, or the distance that a share refers to."""

    @property
    def code(self) -> str:
        """Code of the kind."""
        return self.kind.code


def sentence(issue: Issue) -> str:
    """Return the reason in words, without a full stop."""
    return issue.kind.sentence.format(value=issue.value, limit=issue.limit, detail=issue.detail)


# ---- remedies that kinds in several modules share

TEXTURELESS = Remedy(
    "too little common structure: water, fog, blur or noise in one of the bands",
    "align all bands together: such bands are predicted if three captures of the flight have texture; otherwise give "
    "--model OUT/models/… of an earlier flight",
)
UNLIKE = Remedy(
    "the bands do not show the same scene",
    "look at the picture: did the scene move, is a band blurred or from another place? --seed match finds large "
    "offsets; --model OUT/models/… uses the rig of an earlier flight",
)
MOSAICS = Remedy(
    "the mosaics differ by more than a pixel of REFERENCE, or show too little in common",
    "resample both mosaics to the pixel size that you need (gdalwarp -r average -tr 0.1 0.1); compare a band in which "
    "the field changed little (--reference)",
)
"""For georeferenced rasters instead of remedies that concern cameras and flights."""
MISSING_BAND = Remedy("a band is missing that other captures of this camera have", "copy the files from the card again")
OTHER_REFERENCE = Remedy(
    "another reference band than in most captures of the flight: pixels are on the grid of that band",
    "copy missing files from the card again, or give --reference with a band that all captures have",
)

# ---- kinds of issues that reading, seeding and estimation report; a check defines its own

_BLANK = Remedy(
    "a blank band", "look at the file (covered lens, defective sensor, wrong exposure); --bands omits a band"
)
_ASKED = Remedy("only the seed was requested", "omit --seed and --only-seed")

UNREADABLE = IssueKind(
    "unreadable",
    "{detail}",
    Remedy("a file cannot be read", "copy it from the card again; the other bands are aligned without it"),
)
BLANK_REFERENCE = IssueKind("blank_reference", "the reference band is constant or all invalid", _BLANK)
BLANK_MOVING = IssueKind("blank_moving", "the moving band is constant or all invalid", _BLANK)
NO_SUCH_SEED = IssueKind("no_such_seed", "this band has no {detail} seed; omit --seed", _ASKED)
SEED_ASKED_FOR = IssueKind("seed_asked_for", "only the seed was requested", _ASKED)
NO_CONTRAST = IssueKind("no_contrast", "no pixel of the reference band has enough contrast to learn from", TEXTURELESS)
FEW_KEYPOINTS = IssueKind(
    "few_keypoints", "only {value:.0f} keypoints are in the area that both bands show", TEXTURELESS
)
NOT_INVERTIBLE = IssueKind("not_invertible", "the optimisation diverged to a mapping that cannot be inverted", UNLIKE)
CORNERS_UNKNOWN = IssueKind(
    "corners_unknown", "the patches do not determine the mapping at the corners of the image", TEXTURELESS
)
RETRIEVAL = IssueKind(
    "retrieval", "the descriptors do not distinguish held-out patches (retrieval {value:.2f})", TEXTURELESS
)
"""Reported by the descriptor check, and by an estimation that stops early."""
SEED_DOES_NOT_FIT = IssueKind("seed_does_not_fit", "but the seed does not fit either", UNLIKE)
"""Added to the issues of a result if its seed cannot be used instead."""

OTHER_GEOMETRY = IssueKind(
    "other_geometry",
    "the relief that aligns the other bands does not align this one",
    Remedy(
        "a band was exposed at another time, or parts of the scene moved",
        "look at the picture; --bands omits the band, --relief never aligns all bands without a relief",
    ),
)
"""Reported for a band that only a homography or displacement field aligns, in a capture with a relief."""

KINDS = (
    UNREADABLE,
    BLANK_REFERENCE,
    BLANK_MOVING,
    NO_SUCH_SEED,
    SEED_ASKED_FOR,
    NO_CONTRAST,
    FEW_KEYPOINTS,
    NOT_INVERTIBLE,
    CORNERS_UNKNOWN,
    RETRIEVAL,
    OTHER_GEOMETRY,
)
