"""Maximum a posteriori (MAP) estimate of all bands of a capture from its images and the flight's rig.

The unknowns are delta_b (8,), the displacements of the corners of band b relative to the mapping by the descriptors,
and the factors nu of the capture, which are common to all bands. Four sources are combined:

    descriptors   0 = delta_b + N(0, C_b)                 the last step of the method, with its covariance
    windows       s_i = D(x_i) delta_b + noise            residual shifts of the structure
    rig           delta_b = c_b + K_b nu + N(0, S_b)      the flight's mean, shifted along the band's baseline
    factors       nu = N(0, F)

The estimate is the solution of a linear system. Bands with little texture depend on the other bands and the rig. The
rig's residuals have a Student's t distribution, so a band that contradicts the rig by many standard deviations is not
biased by it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from agalign.capture.band_pair import BandPair
from agalign.fit.adjustment import fit_windows
from agalign.flight.rig import FACTOR_STD_PX, FACTORS, MIN_STD_PX, Rig, lattice
from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.geometry import Matrix
from agalign.values.least_squares import Robust, least_squares
from agalign.values.pixel_units import FixedImagePx

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Expectation:
    """Prior distribution of the displacements of the reference's corners between a mapping of a band and the rig's.

    The mean is corners + by_factor @ f for the factors f (5,) of a capture. Displacements are (x, y) of the corners in
    turn, clockwise from the top left, px of the reference.
    """

    corners: Array
    """(8,) displacements for factors of 0."""
    by_factor: Array
    """(8, 5) derivative with respect to the factors."""
    covariance: Array
    """(8, 8) for known factors, px squared."""


def map_estimate(
    pairs: Sequence[BandPair],
    results: Mapping[str, JointResult[FixedImagePx]],
    residuals: Mapping[str, Residual[FixedImagePx]],
    rig: Rig | None,
) -> dict[str, JointResult[FixedImagePx]]:
    """Return the results by band with the MAP estimates of the homographies and their covariances.

    `residuals` are those of the results. Results without a covariance are returned unchanged.
    """
    known = [p for p in pairs if p.name in results and results[p.name].corner_covariance_px2 is not None]
    likelihoods = [_likelihood(pair, results[pair.name], residuals[pair.name]) for pair in known]
    priors = [_prior(pair, results[pair.name], rig) for pair in known]
    estimates = dict(results)
    for pair, (delta, covariance) in zip(known, _solve(likelihoods, priors), strict=True):
        result, size = results[pair.name], pair.fixed.size_px
        mapping = geometry.compose(result.fixed_to_moving, geometry.moving_corners(delta, *size))
        estimates[pair.name] = result.with_homography(mapping, covariance)
    return estimates


def _solve(
    likelihoods: Sequence[tuple[Array, Array]], priors: Sequence[Expectation | None]
) -> list[tuple[Array, Array]]:
    """Return delta (8,) and its covariance (8, 8) of each band."""
    blocks = [slice(8 * b, 8 * b + 8) for b in range(len(likelihoods))]
    information = block_diag(*(of_images for of_images, _ in likelihoods), np.diag(1 / np.square(FACTOR_STD_PX)))
    mean = np.concatenate([*(of_images for _, of_images in likelihoods), np.zeros(FACTORS)])
    # The residuals of the rig, in standard deviations.
    design, values = np.zeros((len(blocks), 8, len(mean))), np.zeros((len(blocks), 8))
    for band, (block, prior) in enumerate(zip(blocks, priors, strict=True)):
        if prior is not None:
            whitening = np.linalg.cholesky(np.linalg.inv(prior.covariance)).T
            design[band, :, block], design[band, :, -FACTORS:] = whitening, -whitening @ prior.by_factor
            values[band] = whitening @ prior.corners
    degrees_of_freedom = 4.0  # of the t distribution: heavy tails, as a lens may have moved
    robust = Robust(degrees_of_freedom**0.5, iterations=20)
    first_weights = np.ones(len(blocks))  # those of a residual of 0 would start at the rig and may stay there
    weights = (1 + 8 / degrees_of_freedom) * first_weights  # of a multivariate t distribution: (nu + 8) / (nu + r^2)
    system = design, values, weights, information, mean
    solution = least_squares(*system, robust=robust, first_weights=first_weights)
    # Rounding removes the last bits, which depend on the machine's order of summation.
    return [(np.round(solution.mean[s], 6), np.round(solution.covariance[s, s], 12)) for s in blocks]


def _likelihood(
    pair: BandPair, result: JointResult[FixedImagePx], residual: Residual[FixedImagePx]
) -> tuple[Array, Array]:
    """Return the information (8, 8) on delta by descriptors and windows, and their mean (8,).

    The windows are ignored if they are too few or their correction is too large.
    """
    assert result.corner_covariance_px2 is not None
    information = np.asarray(np.linalg.inv(result.corner_covariance_px2))
    fit = fit_windows(pair.mapping(result.fixed_to_moving), residual, pair.fixed.size_px)
    max_correction_px = 1.0  # of a corner; larger ones contradict the mapping
    if fit is None or not fit.max_px <= max_correction_px:
        return information, np.zeros(8)
    of_windows = np.linalg.inv(fit.covariance_px2)
    return information + of_windows, np.linalg.solve(information + of_windows, of_windows @ fit.corners_px)


def _prior(pair: BandPair, result: JointResult[FixedImagePx], rig: Rig | None) -> Expectation | None:
    """Return the prior of delta by the rig; None if it does not contain the band."""
    if rig is None or pair.name not in rig.mean or not pair.has_rig_pixels:
        return None
    return expected_corners(rig, pair.name, pair.scales.between_files(result.fixed_to_moving), pair.scales.fixed)


def expected_corners(rig: Rig, band: str, fixed_to_moving: Matrix, scale: Sequence[float] = (1, 1)) -> Expectation:
    """Return the prior of the corner displacements of a band relative to `fixed_to_moving`, for unknown factors.

    They are in px of an image that is larger than the reference's file by `scale` (x, y). The covariance distributes
    the cross-validated error over all homographies: those with equal mean square are equally likely.
    """
    (points, g), up = lattice(rig.size_px), np.tile(scale, 4)
    at_corners = [0, 6, 34, 28]  # of the lattice, clockwise from the top left
    corners, to_fixed = points[at_corners], geometry.invert(fixed_to_moving)
    # (5, 4, 2) changes of the corners in the moving image by 1 px of each factor.
    changes_px = np.einsum("nk,akf->fna", g[at_corners], rig.design(band))
    moving = geometry.apply(rig.mean[band], corners) + np.concatenate([np.zeros((1, 4, 2)), changes_px])
    moved = up[:, None] * (geometry.apply(to_fixed, moving) - corners).reshape(-1, 8).T
    over = geometry.over_corners(points, *rig.size_px)
    std_px = max(rig.from_bands_px[band], MIN_STD_PX) / geometry.local_scale(fixed_to_moving, *rig.size_px)[-1]
    covariance = std_px**2 / 8 * np.linalg.inv(np.einsum("nki,nkj->ij", over, over) / len(over))
    return Expectation(moved[:, 0], moved[:, 1:] - moved[:, :1], np.outer(up, up) * covariance)
