"""Mappings fitted to windows where descriptors do not suffice: candidates for `decision`.

* Blurred, noisy or saturated images: the homography is fitted to half of the windows and verified with the others.
* Bands with few pixels, such as thermal ones: often only a third of the windows have structure in common with another
  band. If nearly all of these agree with a trusted seed, they predict the mapping with its standard error.
* Images without common structure in one part: differences of lens distortion cause errors of the homography there that
  no residual contains. The lens shapes are estimated too, and the alignment becomes a prediction.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.warped_pair import WarpedPair, result_of_windows
from agalign.fit.window_fit import WindowFit, fit_in_rounds
from agalign.values import geometry
from agalign.values.alignment import Alignment, Alignments, Residual
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NO_CONTRAST, RETRIEVAL
from agalign.values.mapping import PixelMapping
from agalign.verify.checks import PREDICTED_WITH, seed_fits
from agalign.verify.expected_error import points_in_frame

_MAX_STEP_PX = 16.0
"""Maximum displacement of a corner; larger ones contradict the seed."""


def fitted_to_windows(pair: BandPair, alignment: Alignment) -> Alignment | None:
    """Return an alignment fitted to half of the windows and verified with the others; None if these do not confirm it,
    or if the descriptors have a result.
    """
    # With other issues, the descriptors of sharp images have a result that may contradict the windows.
    of_descriptors = {RETRIEVAL, FEW_KEYPOINTS, NO_CONTRAST, CORNERS_UNKNOWN}
    descriptors_failed = pair.is_blurred or any(issue.kind in of_descriptors for issue in alignment.issues)
    if not descriptors_failed or alignment.residual is None or not seed_fits(alignment.residual):
        return None
    max_step_px = min(_MAX_STEP_PX, pair.max_shift_px)
    start = WarpedPair.of(pair, pair.mapping(alignment.fixed_to_moving))
    fitted = fit_in_rounds(
        start.mapping,
        lambda mapping: WarpedPair.of(pair, mapping, start.windows).residual.chessboard_half(even=True),
        pair.fixed.size_px,
        lambda fit: fit.max_px <= max_step_px,
    )
    if fitted is None:
        return None
    mapping, fit = fitted
    warped_pair = WarpedPair.of(pair, mapping, start.windows)
    held_out = warped_pair.residual.chessboard_half(even=False)
    retrieval, chance = (0.0, 0.0) if alignment.joint is None else (alignment.joint.retrieval, alignment.joint.chance)
    joint = result_of_windows(mapping.fixed_to_moving).with_homography(mapping.fixed_to_moving, fit.covariance_px2)
    joint = replace(joint, retrieval=retrieval, chance=chance, last_step_px=fit.max_px)
    verified = replace(warped_pair, residual=held_out)
    issues = verified.issues(joint)
    if not all(issue.kind in PREDICTED_WITH for issue in issues):
        return None
    lens_std_px = pair.unknown_lens_std_px
    result = replace(alignment, mapping=mapping, issues=issues, joint=joint, residual=held_out, lens_std_px=lens_std_px)
    return pair.predicted_alignment(result, verified.std_px(joint)) if issues else result


def agreeing_with_seed(pair: BandPair, alignment: Alignment) -> Alignment | None:
    """Return the prediction of a coarse band by windows that agree with its seed; None if few do."""
    return fitted_with_lens_shapes(pair, alignment, pair.mapping(alignment.seed.fixed_to_moving), _is_consistent)


def _is_consistent(fit: WindowFit) -> bool:
    """Return True if the windows of a coarse band, which overlap by half, agree with their fit."""
    min_windows = 16  # twice the parameters of a homography
    # Px of the reduced reference, 1.5 px of the band. By chance, one in a hundred windows of at least 56 px is closer.
    max_close_px, min_close_share = 3.0, 0.85
    count = len(fit.residuals_px)
    return count >= min_windows and bool((fit.residuals_px <= max_close_px).sum() >= min_close_share * count)


def shifts_by_range_px(pairs: Sequence[BandPair], result: Alignments) -> dict[str, float]:
    """Return by band the shift of the aligned scene, at its range, from one at an infinite distance.

    The rig tags contain the mappings at infinity. Their errors have no common direction: the shift is the part of the
    bands' differences from them that is proportional to the layout of the lenses.
    """
    layouts, offsets_px = {}, []
    for pair in pairs:
        if pair.layout is None or "rig" not in pair.seed_matrices or result[pair.name].joint is None:
            continue
        centre = (np.array(pair.reference_file_px) - 1) / 2
        found, at_infinity = result[pair.name].fixed_to_moving, pair.seed_matrices["rig"]
        at_centre = [geometry.apply(pair.scales.between_files(m), centre) for m in (found, at_infinity)]
        layouts[pair.name] = np.array(pair.layout)
        offsets_px.append(at_centre[0] - at_centre[1])
    along, known = np.ravel(offsets_px), np.ravel(list(layouts.values()))
    common_px = max(0.0, float(along @ known)) / max(float(known @ known), 1e-12)
    return {name: float(common_px * float(np.linalg.norm(layout))) for name, layout in layouts.items()}


def fitted_with_lens_shapes(
    pair: BandPair, alignment: Alignment, start: PixelMapping, is_accepted: Callable[[WindowFit], bool] = lambda _: True
) -> Alignment | None:
    """Return the alignment as `predicted` by a homography and lens shapes, which replace the field of `start`."""
    size_px, to_file = pair.fixed.size_px, pair.scales.fixed.inverse
    fitted = fit_in_rounds(
        replace(start, field=None), lambda mapping: _measured(pair, mapping), size_px, is_accepted, pair.lens_std_px
    )
    if fitted is None:
        return None
    mapping, fit = fitted
    to_file_px = np.r_[np.tile(to_file, 4), np.full(4, to_file.mean)]
    std_px = float(fit.std_px(points_in_frame(mapping, *pair.sizes_px)))
    prediction = pair.prediction_of(mapping, std_px, fit.covariance_px2 * np.outer(to_file_px, to_file_px))
    residual = WarpedPair.of(pair, mapping).residual
    return replace(alignment, mapping=mapping, residual=residual, prediction=prediction)


def _measured(pair: BandPair, mapping: PixelMapping) -> Residual:
    if pair.is_coarse:
        return pair.reference.overlapping_windows.residuals(pair.warped_moving(mapping))
    return WarpedPair.of(pair, mapping).residual
