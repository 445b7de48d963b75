"""The status that follows from the issues of an alignment. A wrong alignment called `aligned` is the worst error."""

from collections.abc import Sequence

from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.choices import PairStatus
from agalign.values.geometry import Matrix
from agalign.values.issues import Issue
from agalign.values.pixel_units import FixedImagePx

_MIN_SEED_COVERAGE = 0.3
"""Share of the windows in which a shift can be measured under a seed that is used as it is: a start, not a result."""
_MAX_SEED_MEDIAN_PX = 8.0
"""Median residual of a seed that is used as it is: rig tags are off by a few px (docs/cameras.md)."""
_MAX_SNAP_PX = 0.25
"""An input that is aligned already is left untouched where the result moves no corner by more, px of the file: a
resampling would cost more sharpness than that gains,"""
_MAX_SNAP_STD = 3.0
"""nor by more than this many standard deviations of the least certain corner."""


def status_of(issues: Sequence[Issue], residual: Residual[FixedImagePx], *, seed: bool) -> PairStatus:
    """`aligned` without issues; else `seed_only` where the `seed` is usable and its `residual` small enough, or
    `failed`.
    """
    if not issues:
        return "aligned"
    return "seed_only" if seed and seed_fits(residual) else "failed"


def seed_fits(residual: Residual[FixedImagePx]) -> bool:
    """True where the residual under a seed is small enough for the seed to be used as it is."""
    return residual.coverage >= _MIN_SEED_COVERAGE and residual.median_px <= _MAX_SEED_MEDIAN_PX


def is_unchanged(joint: JointResult[FixedImagePx], given: Matrix, size_px: tuple[int, int], scale: float = 1.0) -> bool:
    """True where a result on an image (width, height) does not differ from the mapping that the files came with.

    `scale` is the size of the image relative to its file.
    """
    change = geometry.compose(geometry.invert(given), joint.fixed_to_moving)
    moved_px = FixedImagePx(geometry.corner_error_px(change, geometry.identity(), *size_px))
    return moved_px <= min(FixedImagePx(_MAX_SNAP_PX * scale), joint.corner_std_px * _MAX_SNAP_STD)
