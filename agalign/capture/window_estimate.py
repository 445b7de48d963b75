"""Estimation of a homography from windows alone, for blurred, noisy or saturated images in which descriptors fail.

The windows form a chessboard: the homography is fitted to those of one colour and verified with those of the other.
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

_DESCRIPTORS_FAILED = frozenset({RETRIEVAL, FEW_KEYPOINTS, NO_CONTRAST, CORNERS_UNKNOWN})
"""Issues for which windows are tried; with other issues the descriptors have a result that may contradict them."""
_MIN_WINDOWS = 12
"""Minimum number of windows of a fit: 1.5 times the eight parameters."""
_ROUNDS = 4
"""Rounds of warping and fitting: correlation peaks are sharper when windows overlap better."""
_CONVERGED_PX = 0.05
"""The fit has converged if no corner moves by more than this."""
_MAX_STEP_PX = 16.0
"""Maximum displacement of a corner; larger ones contradict the seed."""


def by_windows(pair: BandPair, alignment: Alignment[FixedImagePx]) -> Alignment[FixedImagePx]:
    """Return an alignment fitted to windows if the descriptors failed and held-out windows confirm it.

    Else return the alignment unchanged.
    """
    if not _descriptors_failed(alignment) or alignment.residual is None or not seed_fits(alignment.residual):
        return alignment
    fitted = _fitted(pair, alignment)
    if fitted is None:
        return alignment
    warped_pair, fit = fitted
    held_out = _half(warped_pair.residual, is_for_fit=False)
    joint = _joint(alignment, warped_pair, fit)
    if issues_of(Evidence(joint, held_out, pair.fixed.size_px, images=warped_pair, file_px=pair.file_px)):
        return alignment
    return replace(
        alignment, mapping=warped_pair.mapping, status="aligned", issues=(), joint=joint, residual=held_out,
    )  # fmt: skip


def _descriptors_failed(alignment: Alignment[FixedImagePx]) -> bool:
    return alignment.status != "aligned" and any(issue.kind in _DESCRIPTORS_FAILED for issue in alignment.issues)


def _fitted(pair: BandPair, alignment: Alignment[FixedImagePx]) -> tuple[WarpedPair, CornerFit] | None:
    """Fit the homography to half of the windows; return the warped pair and the last step, or None.

    None if too few windows are measured or a step is too large.
    """
    size_px, max_step_px = pair.fixed.size_px, min(_MAX_STEP_PX, pair.max_shift_px)
    warped_pair = WarpedPair.of(pair, pair.mapping(alignment.fixed_to_moving))
    result: tuple[WarpedPair, CornerFit] | None = None
    for _ in range(_ROUNDS):
        residual = _half(warped_pair.residual, is_for_fit=True)
        fit = corner_correction(warped_pair.mapping, residual, size_px, _MIN_WINDOWS)
        if fit is None or not fit.max_px <= max_step_px:
            return None
        try:
            step = fit.applied_to(warped_pair.mapping.fixed_to_moving, size_px)
        except GeometryError:
            return None
        warped_pair = WarpedPair.of(pair, pair.mapping(step))
        result = warped_pair, fit
        if fit.max_px <= _CONVERGED_PX:
            break
    return result


def _joint(
    alignment: Alignment[FixedImagePx], warped_pair: WarpedPair, fit: CornerFit
) -> JointResult[FixedImagePx]:  # fmt: skip
    """Return the result in the form of a joint optimisation; its retrieval is that of the descriptors."""
    retrieval, chance = (0.0, 0.0) if alignment.joint is None else (alignment.joint.retrieval, alignment.joint.chance)
    result = JointResult[FixedImagePx](
        warped_pair.mapping.fixed_to_moving, float("nan"), retrieval, chance, 0, (1.0,), BY_WINDOWS, "homography",
        fit.max_px, (),
    )  # fmt: skip
    return with_corners(result, result.fixed_to_moving, fit.covariance_px2)


def _half(residual: Residual[FixedImagePx], *, is_for_fit: bool) -> Residual[FixedImagePx]:
    """Return the black windows of the chessboard, which are fitted, or the white ones, which verify the fit."""
    mask = _is_black(residual.centres_px) == is_for_fit
    return Residual[FixedImagePx].of(residual.centres_px[mask], residual.shifts_px[mask], residual.peaks_sigma[mask])


def _is_black(centres_px: Points) -> NDArray[np.bool_]:
    """Return (n,) True for alternate windows of the grid along both axes."""
    column, row = (np.unique(centres_px[:, axis], return_inverse=True)[1] for axis in (0, 1))
    return np.asarray((column + row) % 2 == 0)
