"""Maximum a posteriori (MAP) estimate of the bands of a capture from its images and the flight's rig.

The unknowns are delta_b (8,), the displacements of the corners of band b relative to the mapping by the descriptors.
Three sources are combined:

    descriptors   0 = delta_b + N(0, C_b)                 the last step of the method, with its covariance
    windows       s_i = D(x_i) delta_b + noise            residual shifts of the structure
    rig           delta_b = r_b + t(0, S_b)               its prediction from the capture's other bands

Bands with little texture depend on the other bands and the rig. The residuals of the rig have a Student's t
distribution, so a band that contradicts it by many standard deviations is not biased by it.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.by_rig import RigPrediction, observation, rig_prediction
from agalign.fit.window_fit import fit_windows
from agalign.flight.rig import Rig, lattice
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.least_squares import Robust, least_squares
from agalign.values.residual import Residual


def map_estimate(
    pairs: Sequence[BandPair], results: Mapping[str, JointResult], residuals: Mapping[str, Residual], rig: Rig | None
) -> dict[str, JointResult]:
    """Return the results by band with the MAP estimates of the homographies and their covariances.

    `residuals` are those of the results. Results without a covariance are returned unchanged.
    """
    by_images = {
        pair.name: _by_images(pair, results[pair.name], residuals[pair.name])
        for pair in pairs
        if pair.name in results and results[pair.name].corner_covariance_px2 is not None
    }
    estimates = {**results, **by_images}
    if rig is not None:
        known = observation(pairs, by_images)
        for pair in pairs:
            if pair.name in known.mappings and pair.name in rig.mean:
                estimates[pair.name] = _with_prior(pair, by_images[pair.name], rig_prediction(pair, rig, known))
    return estimates


def _by_images(pair: BandPair, result: JointResult, residual: Residual) -> JointResult:
    """Combine descriptors and windows. The windows are ignored if they are too few or their correction is too large."""
    assert result.corner_covariance_px2 is not None
    fit = fit_windows(pair.mapping(result.fixed_to_moving), residual, pair.fixed.size_px)
    max_correction_px = 1.0  # of a corner; larger ones contradict the mapping
    if fit is None or not fit.max_px <= max_correction_px:
        return result
    information, of_windows = np.linalg.inv(result.corner_covariance_px2), np.linalg.inv(fit.covariance_px2)
    covariance = np.linalg.inv(information + of_windows)
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
    information = 8 / std_px**2 * np.einsum("nki,nkj->ij", over, over) / len(over)
    whitening = np.linalg.cholesky(information).T
    degrees_of_freedom = 4.0  # of the t distribution: heavy tails, as a lens may have moved
    robust = Robust(degrees_of_freedom**0.5, iterations=20)
    first_weight = np.ones(1)  # that of a residual of 0 would start at the rig and may stay there
    weight = (1 + 8 / degrees_of_freedom) * first_weight  # of a multivariate t distribution: (nu + 8) / (nu + r^2)
    of_images = np.asarray(np.linalg.inv(result.corner_covariance_px2), np.float64)
    of_rig = whitening[None], (whitening @ delta_px)[None], weight
    estimate = least_squares(*of_rig, of_images, robust=robust, first_weights=first_weight)
    # Rounding removes the last bits, which depend on the machine's order of summation.
    return _displaced(pair, result, np.round(estimate.mean, 6), np.round(estimate.covariance, 12))


def _displaced(
    pair: BandPair, result: JointResult, delta_px: NDArray[np.float64], covariance: NDArray[np.float64]
) -> JointResult:
    moved = geometry.moving_corners(delta_px, *pair.fixed.size_px)
    return result.with_homography(geometry.compose(result.fixed_to_moving, moved), covariance)
