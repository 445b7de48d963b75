"""Why an alignment is not believed: what was measured beside what it should have been, and that in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

DoubtKind = Literal[
    "unreadable", "blank_reference", "blank_moving", "no_such_seed", "seed_asked_for",
    "no_contrast", "few_keypoints", "not_invertible", "corners_unknown",
    "folds", "retrieval", "corner_std_px", "few_windows", "coverage", "close_windows", "cluster", "residual_px",
    "seed_does_not_fit", "unexpected_px", "repeats",
]  # fmt: skip


@dataclass(frozen=True)
class Doubt:
    """One thing that speaks against an alignment."""

    kind: DoubtKind
    value: float | None = None
    """What was measured, in the unit of the kind: px, a share, a count."""
    limit: float | None = None
    """What it should have been at least, or at most."""
    detail: str = ""
    """A file's own fault, the seed that was asked for, or what the share is of."""


_SENTENCES: dict[DoubtKind, str] = {
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


def sentence(doubt: Doubt) -> str:
    """A doubt in words, without a full stop."""
    return _SENTENCES[doubt.kind].format(value=doubt.value, limit=doubt.limit, detail=doubt.detail)


def explanation(doubts: Sequence[Doubt]) -> str | None:
    """The first of some doubts, which is what to look at, in words; None where there is none."""
    return sentence(doubts[0]) if doubts else None
