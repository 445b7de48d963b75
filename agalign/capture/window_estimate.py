"""A homography by the windows alone, where the descriptors recognise nothing: blurred, noisy or saturated images.

The windows are divided like the fields of a chessboard. One half is fitted, the other half verifies the result.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.corner_fit import CornerFit, corner_correction, with_corners
from agalign.capture.verification import WarpedPair
from agalign.errors import GeometryError
from agalign.values.alignment import Alignment, JointResult, Residual
from agalign.values.geometry import Points
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NO_CONTRAST, RETRIEVAL
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.acceptance import seed_fits
from agalign.verify.check import Evidence
from agalign.verify.checks import issues_of
from agalign.verify.descriptor_check import BY_WINDOWS

_SILENT = frozenset({RETRIEVAL, FEW_KEYPOINTS, NO_CONTRAST, CORNERS_UNKNOWN})
"""Issues of descriptors that recognise nothing. Any other result of theirs contradicts the windows."""
_MIN_WINDOWS = 12
"""Windows of a fit: half as many again as the eight unknowns."""
_ROUNDS = 4
"""Shifts are found in steps: windows that overlap better have sharper peaks."""
_REST_PX = 0.05
"""A step that moves no corner by more is the last one."""
_MAX_STEP_PX = 16.0
"""Displacement of a corner beyond which the windows contradict the seed instead of refining it."""


def by_windows(pair: BandPair, alignment: Alignment[FixedImagePx]) -> Alignment[FixedImagePx]:
    """The alignment by windows, where the descriptors are silent and the windows left out of the fit confirm it; else
    the alignment as it is.
    """
    if not _is_silent(alignment) or alignment.residual is None or not seed_fits(alignment.residual):
        return alignment
    fitted = _fitted(pair, alignment)
    if fitted is None:
        return alignment
    warped_pair, fit = fitted
    held_out = _some(warped_pair.residual, is_for_fit=False)
    joint = _joint(alignment, warped_pair, fit)
    if issues_of(Evidence(joint, held_out, pair.fixed.size_px, images=warped_pair, file_px=pair.file_px)):
        return alignment
    return replace(
        alignment, fixed_to_moving=joint.fixed_to_moving, status="aligned", issues=(), joint=joint, residual=held_out,
        local=None, field=pair.field,
    )  # fmt: skip


def _is_silent(alignment: Alignment[FixedImagePx]) -> bool:
    return alignment.status != "aligned" and any(issue.kind in _SILENT for issue in alignment.issues)


def _fitted(pair: BandPair, alignment: Alignment[FixedImagePx]) -> tuple[WarpedPair, CornerFit] | None:
    """The pair under the homography that half of its windows suggest, and the last step; None where they are few."""
    size_px, reach_px = pair.fixed.size_px, min(_MAX_STEP_PX, pair.reach_px)
    warped_pair = WarpedPair.of(pair, pair.mapping(alignment.fixed_to_moving))
    result: tuple[WarpedPair, CornerFit] | None = None
    for _ in range(_ROUNDS):
        residual = _some(warped_pair.residual, is_for_fit=True)
        fit = corner_correction(warped_pair.mapping, residual, size_px, _MIN_WINDOWS)
        if fit is None or not fit.max_px <= reach_px:
            return None
        try:
            step = fit.applied_to(warped_pair.mapping.fixed_to_moving, size_px)
        except GeometryError:
            return None
        warped_pair = WarpedPair.of(pair, pair.mapping(step))
        result = warped_pair, fit
        if fit.max_px <= _REST_PX:
            break
    return result


def _joint(
    alignment: Alignment[FixedImagePx], warped_pair: WarpedPair, fit: CornerFit
) -> JointResult[FixedImagePx]:  # fmt: skip
    """The result in the form that checks and sidecars take; its retrieval is that of the descriptors."""
    retrieval, chance = (0.0, 0.0) if alignment.joint is None else (alignment.joint.retrieval, alignment.joint.chance)
    result = JointResult[FixedImagePx](
        warped_pair.mapping.fixed_to_moving, float("nan"), retrieval, chance, 0, (1.0,), BY_WINDOWS, "homography",
        fit.max_px, (),
    )  # fmt: skip
    return with_corners(result, result.fixed_to_moving, fit.covariance_px2)


def _some(residual: Residual[FixedImagePx], *, is_for_fit: bool) -> Residual[FixedImagePx]:
    """The black fields of the chessboard, which are fitted, or the white ones, which verify."""
    which = _is_black(residual.centres_px) == is_for_fit
    return Residual[FixedImagePx].of(
        residual.centres_px[which], residual.shifts_px[which], residual.peaks_sigma[which]
    )  # fmt: skip


def _is_black(centres_px: Points) -> NDArray[np.bool_]:
    column, row = (np.unique(centres_px[:, axis], return_inverse=True)[1] for axis in (0, 1))
    return np.asarray((column + row) % 2 == 0)
