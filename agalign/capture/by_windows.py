"""Bands that are fitted to windows, where descriptors do not suffice.

* Blurred, noisy or saturated images: the MAP estimate is by windows and the rig.
* Bands with few pixels, such as thermal ones: often only a third of the windows have structure in common with another
  band. If nearly all of these agree with a trusted seed, they predict the mapping.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand, mapping_error, without_descriptors
from agalign.capture.warped_pair import WarpedPair
from agalign.fit.held_out import one_by_one
from agalign.fit.window_fit import cross_fitted, fit_in_rounds
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NO_CONTRAST, RETRIEVAL
from agalign.values.mapping import PixelMapping
from agalign.values.residual import Residual

_MAX_MOVED_PX = 16.0
"""Maximum distance of a corner from that of the seed, px of the reduced reference; larger ones contradict it."""


def fitted_to_windows(band: BandCandidates) -> RefinedBand | None:
    """Return a band with the windows under the homography that they determine, for a MAP estimate without descriptors;
    None if the descriptors of a sharp band have a result, if its seed does not fit the windows, or if these determine
    no homography.
    """
    pair, start, known = band.pair, band.at_seed, band.joint
    # With other issues, the descriptors of sharp images have a result that may contradict the windows.
    of_descriptors = {RETRIEVAL, FEW_KEYPOINTS, NO_CONTRAST, CORNERS_UNKNOWN}
    descriptors_failed = pair.is_blurred or any(issue.kind in of_descriptors for issue in band.rejected)
    if not descriptors_failed or start is None or not band.does_seed_fit:
        return None
    last = start

    def measured(mapping: PixelMapping) -> Residual:
        nonlocal last
        last = last if mapping is last.mapping else WarpedPair.of(pair, mapping, last.windows)
        return last.residual

    max_moved_px = min(_MAX_MOVED_PX, pair.max_shift_px)
    fitted = fit_in_rounds(last.mapping, measured, pair.fixed.size_px, max_moved_px=max_moved_px)
    if fitted is None:
        return None
    retrieval, chance = (0.0, 0.0) if known is None else (known.retrieval, known.chance)
    joint = replace(without_descriptors(last.mapping.fixed_to_moving), retrieval=retrieval, chance=chance)
    return RefinedBand(replace(joint, last_step_px=fitted[1].max_px), last)


def in_windows_that_agree(band: BandCandidates) -> Candidate | None:
    """Return the candidate of a coarse band by windows that agree with its trusted seed; None if few do, or in a
    repetitive scene.
    """
    pair = band.pair
    if not (pair.is_coarse and band.is_seed_trusted):
        return None
    start = pair.mapping(band.seed.fixed_to_moving)
    windows = pair.reference.overlapping_windows
    fitted = cross_fitted(
        replace(start, field=None),
        lambda mapping: WarpedPair.of(pair, mapping, windows).residual,
        pair.fixed.size_px,
        one_by_one,
        windows.side,
        is_accepted=lambda fit: _are_consistent(fit.residuals_px),
        lens_std_px=pair.lens_std_px,
        max_moved_px=min(_MAX_MOVED_PX, pair.max_shift_px),
    )
    if fitted is None or not _are_consistent(fitted.held_out.lengths_px):
        return None
    mapping, held_out = fitted.mapping, fitted.held_out
    warped = WarpedPair.of(pair, mapping, windows)
    if warped.alias_peaks:
        return None
    error = mapping_error(pair, mapping, fitted.fit.covariance_px2, held_out, mapping.field)
    return Candidate(pair, mapping, error, held_out, band.joint, warped, given_issues=band.rejected)


def _are_consistent(residuals_px: NDArray[np.float64]) -> bool:
    """Return True if the windows of a coarse band, which overlap by half, agree with a mapping."""
    min_windows = 16  # twice the eight parameters of a homography; the lens shapes have a prior
    # Px of the reduced reference, 1.5 px of the band. By chance, one in a hundred windows of at least 56 px is closer.
    max_close_px, min_close_share = 3.0, 0.85
    count = len(residuals_px)
    return count >= min_windows and bool((residuals_px <= max_close_px).sum() >= min_close_share * count)
