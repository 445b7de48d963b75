"""Status of a band pair from the issues of its alignment. The worst error is a wrong alignment called `aligned`."""

from collections.abc import Sequence

from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.choices import PairStatus
from agalign.values.geometry import Matrix
from agalign.values.issues import Issue
from agalign.values.pixel_units import FixedImagePx

_MIN_SEED_COVERAGE = 0.3
"""Minimum share of windows with a measured shift for a seed with status `seed_only`."""
_MAX_SEED_MEDIAN_PX = 8.0
"""Maximum median residual of such a seed: rig tags have errors of a few px (docs/cameras.md)."""
_MAX_UNCHANGED_PX = 0.25
"""Maximum displacement of a corner, px of the file, for aligned input to be returned unchanged: resampling would cost
more sharpness than the correction gains."""
_MAX_UNCHANGED_STD = 3.0
"""The same limit in standard errors of the least certain corner."""


def status_of(issues: Sequence[Issue], residual: Residual[FixedImagePx], *, seed: bool) -> PairStatus:
    """Return `aligned` without issues, else `seed_only` for a usable `seed` with a small `residual`, else `failed`."""
    if not issues:
        return "aligned"
    return "seed_only" if seed and seed_fits(residual) else "failed"


def seed_fits(residual: Residual[FixedImagePx]) -> bool:
    """Return True if the residual of a seed is small enough for the status `seed_only`."""
    return residual.coverage >= _MIN_SEED_COVERAGE and residual.median_px <= _MAX_SEED_MEDIAN_PX


def is_unchanged(joint: JointResult[FixedImagePx], given: Matrix, size_px: tuple[int, int], scale: float = 1.0) -> bool:
    """Return True if a result on an image (width, height) does not differ from the mapping `given` by the files.

    `scale` is the size of the image relative to its file.
    """
    change = geometry.compose(geometry.invert(given), joint.fixed_to_moving)
    change_px = FixedImagePx(geometry.corner_error_px(change, geometry.identity(), *size_px))
    return change_px <= min(FixedImagePx(_MAX_UNCHANGED_PX * scale), joint.corner_std_px * _MAX_UNCHANGED_STD)
