"""Why an alignment is not believed: what was measured and what it should have been, in words, and what to try."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

IssueKind = Literal[
    "unreadable", "blank_reference", "blank_moving", "no_such_seed", "seed_asked_for",
    "no_contrast", "few_keypoints", "not_invertible", "corners_unknown",
    "folds", "retrieval", "corner_std_px", "few_windows", "coverage", "close_windows", "cluster", "residual_px",
    "seed_does_not_fit", "unexpected_px", "repeats",
]  # fmt: skip


@dataclass(frozen=True)
class Issue:
    """One thing that speaks against an alignment."""

    kind: IssueKind
    value: float | None = None
    """What was measured, in the unit of the kind: px, a share, a count."""
    limit: float | None = None
    """What it should have been at least, or at most."""
    detail: str = ""
    """A file's own fault, the seed that was asked for, or what the share is of."""


_SENTENCES: dict[IssueKind, str] = {
    "unreadable": "{detail}",
    "blank_reference": "the reference band is constant or all invalid",
    "blank_moving": "the moving band is constant or all invalid",
    "no_such_seed": "there is no {detail} seed for it; leave --seed out",
    "seed_asked_for": "only the seed was asked for",
    "no_contrast": "no pixel of the reference band has contrast enough to learn from",
    "few_keypoints": "only {value:.0f} keypoints lie on the common valid area",
    "not_invertible": "the optimisation ended in a mapping that cannot be inverted",
    "corners_unknown": "the patches do not say where the corners lie",
    "folds": "the mapping folds or stretches the image",
    "retrieval": "descriptors do not tell held-out patches apart (retrieval {value:.2f})",
    "corner_std_px": "the corners are known to {value:.1f} px only",
    "few_windows": "too little structure in common to check the result",
    "coverage": "the structures agree in only {value:.0%} of the windows",
    "close_windows": "the structures lie within {detail} in only {value:.0%} of the windows",
    "cluster": "{value:.0%} of the windows, beside each other, lie apart",
    "residual_px": "the structures still lie {value:.1f} px apart",
    "seed_does_not_fit": "but it does not fit either",
    "repeats": "the scene repeats: {value:.0f} px away it fits nearly as well, and nothing says which place is right",
    "unexpected_px": "it lies {value:.1f} px from where the rig of the flight has it",
}


def sentence(issue: Issue) -> str:
    """A doubt in words, without a full stop."""
    return _SENTENCES[issue.kind].format(value=issue.value, limit=issue.limit, detail=issue.detail)


def explanation(issues: Sequence[Issue]) -> str | None:
    """The first of some doubts, which is what to look at, in words; None where there is none."""
    return sentence(issues[0]) if issues else None


@dataclass(frozen=True)
class Remedy:
    """Doubts that come of one cause, as somebody reads of them who has a flight to deliver."""

    cause: str
    advice: str


_UNREADABLE = Remedy("a file cannot be read", "copy it from the card again; the other bands do not need it")
_BLANK = Remedy(
    "a band shows nothing: all its pixels are one value, or invalid",
    "look at the file: a covered lens, a dead sensor or wrong exposure; --bands leaves a band out",
)
_ASKED = Remedy("only the first guess was asked for", "leave --seed and --only-seed out")
_TEXTURELESS = Remedy(
    "too little in common to hold on to: water, fog, blur or noise in one of the bands",
    "take part with all bands and the default reference, which hold most; where three captures of the flight have "
    "texture its rig places such bands, and --model OUT/models/… of an earlier flight does so from the first on",
)
_UNLIKE = Remedy(
    "the bands do not show the same thing",
    "look at the picture: did the scene move between the exposures, is one band blurred or of another place? --seed "
    "match finds images that lie far apart; --model OUT/models/… brings what an earlier flight knows of the camera",
)
_RELIEF = Remedy(
    "a part of the image lies apart: trees, buildings or terraces near the camera", "--local follows the relief"
)
_REPEATING = Remedy(
    "the scene repeats, and nothing says which place is the right one",
    "keep the camera's metadata in the files (no --ignore-metadata), or give --model OUT/models/… of an earlier flight",
)
_ELSEWHERE = Remedy(
    "it lies elsewhere than the rig of the flight has it",
    "if a lens was knocked or changed, align without --model; else look at the picture",
)
MISSING_BAND = Remedy("a band is missing that other captures of this camera have", "copy the files from the card again")
_REMEDIES: dict[IssueKind, Remedy] = {
    "unreadable": _UNREADABLE,
    "blank_reference": _BLANK, "blank_moving": _BLANK,
    "no_such_seed": _ASKED, "seed_asked_for": _ASKED,
    "no_contrast": _TEXTURELESS, "few_keypoints": _TEXTURELESS, "few_windows": _TEXTURELESS,
    "corners_unknown": _TEXTURELESS, "corner_std_px": _TEXTURELESS, "retrieval": _TEXTURELESS,
    "not_invertible": _UNLIKE, "folds": _UNLIKE, "coverage": _UNLIKE, "residual_px": _UNLIKE,
    "seed_does_not_fit": _UNLIKE,
    "close_windows": _RELIEF, "cluster": _RELIEF,
    "repeats": _REPEATING, "unexpected_px": _ELSEWHERE,
}  # fmt: skip


def remedy(kind: IssueKind) -> Remedy:
    """What a doubt of this kind mostly comes of, and what to try."""
    return _REMEDIES[kind]
