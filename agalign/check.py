"""Whether an alignment can be believed. A wrong one called `aligned` is the worst this program could do."""

import numpy as np

from agalign import geometry
from agalign.choices import PairStatus
from agalign.config import CheckSettings
from agalign.geometry import Matrix
from agalign.records import JointResult, Residual, Seed


def verdict(
    seed: Seed, seed_trusted: bool, joint: JointResult | None, why_not: str, residual: Residual | None,
    size_px: tuple[int, int], settings: CheckSettings,
) -> tuple[PairStatus, str | None]:  # fmt: skip
    """(`aligned`, None), or (`seed_only` or `failed`, why not). `why_not` says why `joint` is None."""
    doubt = why_not if joint is None else _doubt(joint, residual, size_px, settings)
    if doubt is None:
        return "aligned", None
    if seed_trusted:
        return "seed_only", f"{doubt}; the {seed.kind} seed is used as it is"
    return "failed", doubt


def _doubt(
    joint: JointResult, residual: Residual | None, size_px: tuple[int, int], settings: CheckSettings
) -> str | None:
    scale = geometry.local_scale(joint.fixed_to_moving, *size_px)
    # Written so that nan passes nowhere.
    if not (scale.min() > 0 and scale.max() <= 4 * scale.min()):
        return "the mapping folds or stretches the image"
    if not joint.retrieval >= max(settings.least_retrieval, settings.least_times_chance * joint.chance):
        return f"descriptors do not tell held-out patches apart (retrieval {joint.retrieval:.2f})"
    if not joint.corner_std_px <= settings.most_corner_std_px:
        return f"the corners are known to {joint.corner_std_px:.1f} px only"
    if residual is None or len(residual.centres_px) < settings.least_windows:
        return "too little structure in common to check the result"
    if residual.coverage < settings.least_coverage:
        return f"the structures agree in only {residual.coverage:.0%} of the windows"
    close = np.linalg.norm(residual.shifts_px, axis=1) <= settings.most_residual_px
    if not close.mean() >= settings.least_close:
        return f"the structures lie within {settings.most_residual_px:g} px in only {close.mean():.0%} of the windows"
    if not residual.median_px <= settings.most_residual_px:
        return f"the structures still lie {residual.median_px:.1f} px apart"
    return None


def is_as_it_was(joint: JointResult, given: Matrix, size_px: tuple[int, int], settings: CheckSettings) -> bool:
    """True where the result cannot be told from the mapping that the files came with: they were aligned already."""
    moved_px = geometry.corner_error_px(joint.fixed_to_moving, given, *size_px)
    return moved_px <= min(settings.most_snap_px, 3 * joint.corner_std_px)
