"""Maximum a posteriori (MAP) estimate of the bands of a capture from its images and the flight's rig.

The unknowns are delta_b (8,), the displacements of the corners of band b relative to the mapping by the descriptors.
Three sources are combined:

    descriptors   0 = delta_b + N(0, k_b C_b)             the last step of the method, with its covariance
    windows       s_i = D(x_i) delta_b + noise            residual shifts of the structure
    rig           delta_b = r_b + t(0, S_b)               its prediction from the capture's other bands

k_b >= 1 is chi^2 / 8 of the difference between descriptors and windows. Where these contradict each other, the windows
are right: patches of water or noise hold the descriptors near their seed. Bands whose descriptors fail are estimated
from the other two. Bands with little texture depend on the other bands and the rig. The residuals of the rig have a
Student's t distribution, so a band that contradicts it by many standard deviations is not biased by it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.by_rig import RigPrediction, observation, rig_prediction
from agalign.capture.candidate import RefinedBand
from agalign.fit.held_out import chessboard, remaining
from agalign.fit.window_fit import WindowFit, fit_windows
from agalign.flight.rig import Rig, lattice
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.least_squares import Robust, least_squares
from agalign.values.lens_shapes import CORNERS
from agalign.values.residual import Residual

_MAX_CORRECTION_PX = 4.0
"""Of a corner, by windows; larger ones contradict the mapping, or are of the next crop row."""


def with_map_estimates(
    bands: Sequence[RefinedBand], rig: Rig | None, capture: Capture | None = None
) -> list[RefinedBand]:
    """Return the bands of a `capture` with the MAP estimates of all windows, and with those without each fold of them.

    The windows of a band are ignored, also without a fold, if all together are too few or their correction is too
    large. Bands without any information have their result.
    """
    residuals = [band.warped.residual for band in bands]
    sides_px = [band.warped.windows.side for band in bands]
    parts = (remaining(r, chessboard(r), side_px) for r, side_px in zip(residuals, sides_px, strict=True))
    without_fold = zip(*parts, strict=True)
    fits, *by_fold = ([_fit(b, r) for b, r in zip(bands, some, strict=True)] for some in (residuals, *without_fold))
    is_used = [fit is not None and fit.max_px <= _MAX_CORRECTION_PX for fit in fits]
    estimates, *without = (
        _estimates(bands, [fit if used else None for fit, used in zip(some, is_used, strict=True)], rig, capture)
        for some in (fits, *by_fold)
    )
    return [
        replace(band, joint=joint, by_fold=[_homography(one) for one in others])
        for band, joint, *others in zip(bands, estimates, *without, strict=True)
    ]


def _homography(estimate: JointResult) -> Matrix | None:
    """Return the homography; None if neither descriptors nor windows determine it."""
    return None if estimate.corner_covariance_px2 is None else estimate.fixed_to_moving


def _fit(band: RefinedBand, residual: Residual) -> WindowFit | None:
    """Fit windows of a band, measured under its result; None if they determine nothing."""
    return fit_windows(band.pair.mapping(band.joint.fixed_to_moving), residual, band.pair.fixed.size_px)


def _estimates(
    bands: Sequence[RefinedBand], fits: Sequence[WindowFit | None], rig: Rig | None, capture: Capture | None
) -> list[JointResult]:
    """Return the estimates of bands with fits to their windows, or without them."""
    pairs = [band.pair for band in bands]
    estimates = {
        band.pair.name: band.joint if fit is None else _with_windows(band.pair, band.joint, fit)
        for band, fit in zip(bands, fits, strict=True)
    }
    if rig is not None:
        by_images = {name: joint for name, joint in estimates.items() if joint.corner_covariance_px2 is not None}
        # Only bands whose descriptors are retrieved predict the other bands.
        known = observation(pairs, {name: joint for name, joint in by_images.items() if joint.is_retrieved}, capture)
        for pair in pairs:
            if pair.name in by_images and pair.name in rig.mean and pair.has_rig_pixels:
                estimates[pair.name] = _with_prior(pair, by_images[pair.name], rig_prediction(pair, rig, known))
    return list(estimates.values())


def _with_windows(pair: BandPair, result: JointResult, fit: WindowFit) -> JointResult:
    """Combine the result of the descriptors, if they have one, with a fit to windows under it."""
    of_windows, covariance = np.linalg.inv(fit.covariance_px2), fit.covariance_px2
    if (known := result.corner_covariance_px2) is not None:
        chi2 = float(fit.corners_px @ np.linalg.solve(known + fit.covariance_px2, fit.corners_px))
        covariance = np.linalg.inv(np.linalg.inv(known * max(1.0, chi2 / CORNERS)) + of_windows)
    return _displaced(pair, result, covariance @ of_windows @ fit.corners_px, covariance)


def _with_prior(pair: BandPair, result: JointResult, prior: RigPrediction) -> JointResult:
    """Combine a result with the rig's prediction. Errors of the prediction with equal mean square over the image are
    equally likely.
    """
    assert result.corner_covariance_px2 is not None
    size_px, to_fixed = pair.fixed.size_px, geometry.invert(result.fixed_to_moving)
    corners = geometry.corners(*size_px)
    expected = geometry.apply(prior.fixed_to_moving, corners)
    delta_px = (geometry.apply(to_fixed, expected) - corners).ravel()
    std_px = prior.std_px(result.fixed_to_moving)
    over = geometry.over_corners(lattice(size_px)[0], *size_px)
    information = CORNERS / std_px**2 * np.einsum("nki,nkj->ij", over, over) / len(over)
    whitening = np.linalg.cholesky(information).T
    degrees_of_freedom = 4.0  # of the t distribution: heavy tails, as a lens may have moved
    robust = Robust(degrees_of_freedom**0.5, iterations=20)
    first_weight = np.ones(1)  # that of a residual of 0 would start at the rig and may stay there
    # Of a multivariate t distribution: (nu + 8) / (nu + r^2).
    weight = (1 + CORNERS / degrees_of_freedom) * first_weight
    of_images = np.asarray(np.linalg.inv(result.corner_covariance_px2), np.float64)
    of_rig = whitening[None], (whitening @ delta_px)[None], weight
    estimate = least_squares(*of_rig, of_images, robust=robust, first_weights=first_weight)
    # Rounding removes the last bits, which depend on the machine's order of summation.
    combined = _displaced(pair, result, np.round(estimate.mean, 6), np.round(estimate.covariance, 12))
    return replace(combined, by_images=result)


def _displaced(
    pair: BandPair, result: JointResult, delta_px: NDArray[np.float64], covariance: NDArray[np.float64]
) -> JointResult:
    moved = geometry.moving_corners(delta_px, *pair.fixed.size_px)
    return result.with_homography(geometry.compose(result.fixed_to_moving, moved), covariance)
