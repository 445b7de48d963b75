"""Reasons for not accepting an alignment: what was measured, the limit, in words, and a suggestion for the user."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler
from pydantic import dataclasses as validated
from pydantic_core import CoreSchema, core_schema

from agalign.values.fields import RECORD, Measured, Message


@dataclass(frozen=True)
class Remedy:
    """Cause of some kinds of issues, and a suggestion for the user."""

    cause: str
    advice: str


@dataclass(frozen=True)
class IssueKind:
    """A kind of issue. `KINDS` has all of them by code."""

    code: str
    """Identifies the kind in sidecars; it must not change."""
    sentence: str
    """Template of the reason, without a full stop: `value`, `limit` and `detail` are filled in."""
    remedy: Remedy


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
    "the mosaics differ by more than a pixel of REFERENCE, or have too little common structure",
    "resample both mosaics to larger pixels, of the size that you need (gdalwarp -r average -tr SIZE SIZE); compare a "
    "band in which the field changed little (--band)",
)
"""For georeferenced rasters instead of remedies that concern cameras and flights."""
MISSING_BAND = Remedy("a band of this camera is missing", "copy the files from the card; apps may not list all of them")
OTHER_REFERENCE = Remedy(
    "the reference band differs from that of most captures of the flight: pixels are on its grid",
    "copy missing files from the card again, or give --reference with a band that all captures have",
)

# ---- kinds of issues that reading, seeding and estimation report

_BLANK = Remedy(
    "a blank band", "look at the file (covered lens, defective sensor, wrong exposure); --bands omits a band"
)
_ASKED = Remedy("only the seed was requested", "omit --seed and --only-seed")

UNREADABLE_BAND = Remedy("a file cannot be read", "copy it from the card again; the other bands are aligned without it")
UNREADABLE = IssueKind("unreadable", "{detail}", UNREADABLE_BAND)
BLANK_REFERENCE = IssueKind("blank_reference", "the reference band is constant or all invalid", _BLANK)
BLANK_MOVING = IssueKind("blank_moving", "the moving band is constant or all invalid", _BLANK)
FEW_VALID = IssueKind(
    "few_valid",
    "only {value:.2%} of the {detail} band is valid",
    Remedy(
        "too few valid pixels: nodata, an alpha band or saturation masks the rest",
        "crop the file to its data (gdal_translate -projwin), and look at its nodata value and its alpha band",
    ),
)
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
        "look at the picture; --bands omits the band, --relief never aligns all bands without a parallax map",
    ),
)
"""Reported for a band that only a homography or displacement field aligns, in a capture with a relief."""

OF_FILES = frozenset((UNREADABLE, BLANK_REFERENCE, BLANK_MOVING, FEW_VALID))
"""Kinds of issues of a single file, with remedies that hold for mosaics too."""

# ---- kinds of issues that checks report

_PARALLAX = Remedy(
    "parallax (trees, buildings, terraces), or motion between the exposures",
    "fly higher or slower, do not use --relief never; --bands omits a band",
)
FOLDS = IssueKind("folds", "the mapping folds or stretches the image", UNLIKE)
INACCURATE = IssueKind(
    "inaccurate",
    "the expected error is above {detail} in {value:.0%} of the image",
    Remedy(
        "blur, noise, parallax, or a part of the image without common structure",
        "look at --error-map; give --model OUT/models/… of a flight that shows the whole image",
    ),
)
UNMEASURED = IssueKind(
    "unmeasured",
    "no shift can be measured in {value:.0%} of the windows under the relief of the other bands",
    _PARALLAX,
)
OTHER_CONTENT = IssueKind(
    "other_content",
    "an area with {value:.0%} of the windows shows a different scene in this band",
    Remedy(
        "a part of the image shows a different scene (an incomplete file, an object near the camera, waves)",
        "look at the picture; copy the file from the card again; --bands omits a band",
    ),
)
FEW_WINDOWS = IssueKind("few_windows", "too little common structure to verify the result", TEXTURELESS)
COVERAGE = IssueKind("coverage", "a shift can be measured in only {value:.1%} of the windows", UNLIKE)
CLOSE_WINDOWS = IssueKind("close_windows", "only {value:.1%} of the windows are aligned within {detail}", _PARALLAX)
CLUSTER = IssueKind("cluster", "an area with {value:.0%} of the windows is misaligned", _PARALLAX)
UNEXPECTED_PX = IssueKind(
    "unexpected_px",
    "the result is {value:.1f} px from the position that the rig of the flight predicts",
    Remedy(
        "the result contradicts the rig of the flight",
        "if a lens was replaced or moved, align without --model; otherwise look at the picture",
    ),
)
REPEATS = IssueKind(
    "repeats",
    "the scene is repetitive: a shift of {value:.0f} px fits nearly as well, and no prior information decides",
    Remedy(
        "a repetitive scene (plant rows, solar panels)",
        "keep the metadata of the camera, without --ignore-metadata, or give --model OUT/models/… of an earlier flight",
    ),
)

KINDS: Mapping[str, IssueKind] = {k.code: k for k in list(globals().values()) if isinstance(k, IssueKind)}
"""Every kind of issue that a sidecar may contain, by code: all that are defined above."""


def _kind_of(code: str) -> IssueKind:
    if code not in KINDS:
        raise ValueError(f"unknown kind of issue {code!r}")
    return KINDS[code]


class _ByCode:
    """A kind of issue, which JSON holds as its code."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        code = core_schema.literal_schema(list(KINDS))
        return core_schema.json_or_python_schema(
            core_schema.no_info_after_validator_function(_kind_of, code),
            core_schema.is_instance_schema(IssueKind),
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda kind: kind.code, return_schema=code, when_used="json"
            ),
        )


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
