"""The maximum a posteriori estimate of all bands of a capture, from its images and from the flight's rig.

Unknown are, for every band b, the displacements of the reference's corners relative to the mapping that the descriptors
give, delta_b (8,), and the capture's factors nu, which all bands share. There are four sources:

    descriptors   0 = delta_b + N(0, C_b)                 the last step of the method, with its covariance
    windows       s_i = D(x_i) delta_b + noise            residual shifts of the structure under the mapping
    rig           delta_b = c_b + K_b nu + N(0, S_b)      the flight's mean, moved along the band's baseline
    factors       nu = N(0, F)

The maximum a posteriori is a linear system. A band with little texture depends on the others and on the flight; one
with much texture does not. A band that contradicts the rig by many standard deviations is not pulled: its weight falls
as that of a Student's t does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.corner_fit import corner_correction, with_corners
from agalign.flight.factors import FACTOR_STD_PX
from agalign.flight.rig import Rig
from agalign.flight.rig_prediction import Expectation, expected_corners
from agalign.values import geometry
from agalign.values.alignment import JointResult, Residual
from agalign.values.pixel_units import FixedImagePx

Array = NDArray[np.float64]

_MAX_WINDOWS_PX = 1.0
"""Displacement of a corner beyond which windows do not correct a mapping: they contradict it."""
_REWEIGHTINGS = 6
"""A fixed number, enough for the weights to settle."""
_FREEDOM = 4.0
"""Of the t distribution of a band's distance from the rig: heavy tails, a band may be knocked."""


@dataclass(frozen=True)
class InformationForm:
    """Gaussian knowledge of delta (8,), px of the reference's image."""

    information: Array
    """(8, 8) inverse covariance."""
    pull: Array
    """(8,) information times mean."""

    def __add__(self, other: "InformationForm") -> "InformationForm":
        return InformationForm(self.information + other.information, self.pull + other.pull)

    @classmethod
    def of(cls, mean: Array, covariance: Array) -> "InformationForm":
        information = np.asarray(np.linalg.inv(covariance))
        return cls(information, information @ mean)


def map_estimate(
    pairs: Sequence[BandPair],
    results: Mapping[str, JointResult[FixedImagePx]],
    residuals: Mapping[str, Residual[FixedImagePx]],
    rig: Rig | None,
) -> dict[str, JointResult[FixedImagePx]]:
    """Each result, by band, moved to the maximum a posteriori of all, with its covariance.

    `residuals` are those of the windows under the results.
    """
    known = [p for p in pairs if p.name in results and results[p.name].corner_covariance_px2 is not None]
    own = []
    for pair in known:
        windows = _of_windows(pair, results[pair.name], residuals[pair.name])
        descriptors = _of_descriptors(results[pair.name])
        own.append(descriptors if windows is None else descriptors + windows)
    priors = [_expectation(pair, results[pair.name], rig) for pair in known]
    moved = dict(results)
    for pair, (delta, covariance) in zip(known, _solve(own, priors), strict=True):
        result, size = results[pair.name], pair.fixed.size_px
        mapping = geometry.compose(result.fixed_to_moving, geometry.moving_corners(delta, *size))
        moved[pair.name] = with_corners(result, mapping, covariance)
    return moved


def _solve(own: Sequence[InformationForm], priors: Sequence[Expectation | None]) -> list[tuple[Array, Array]]:
    """(delta (8,), its covariance (8, 8)) of each band, all together."""
    factors = 8 * len(own) + np.arange(len(FACTOR_STD_PX))
    weights = np.ones(len(own))
    for _ in range(_REWEIGHTINGS):
        normal = np.zeros((factors[-1] + 1, factors[-1] + 1))
        pull = np.zeros(len(normal))
        normal[factors, factors] = 1 / np.square(FACTOR_STD_PX)
        for b, (information, prior) in enumerate(zip(own, priors, strict=True)):
            band = 8 * b + np.arange(8)
            normal[np.ix_(band, band)] += information.information
            pull[band] += information.pull
            if prior is not None:
                rows = np.concatenate([band, factors])
                design = np.hstack([np.eye(8), -prior.by_factor])
                weighted = weights[b] * design.T @ np.linalg.inv(prior.covariance)
                normal[np.ix_(rows, rows)] += weighted @ design
                pull[rows] += weighted @ prior.corners
        covariance = np.linalg.inv(normal)
        solution = covariance @ pull
        for b, prior in enumerate(priors):
            if prior is not None:
                off = solution[8 * b : 8 * b + 8] - prior.corners - prior.by_factor @ solution[factors]
                apart = float(off @ np.linalg.solve(prior.covariance, off))
                weights[b] = (_FREEDOM + 8) / (_FREEDOM + apart)
    blocks = [slice(8 * b, 8 * b + 8) for b in range(len(own))]
    # The order of sums depends on the machine: their last bits must not reach the outputs.
    return [(np.round(solution[s], 6), np.round(covariance[s, s], 12)) for s in blocks]


def _of_descriptors(result: JointResult[FixedImagePx]) -> InformationForm:
    assert result.corner_covariance_px2 is not None
    return InformationForm.of(np.zeros(8), result.corner_covariance_px2)


def _of_windows(
    pair: BandPair, result: JointResult[FixedImagePx], residual: Residual[FixedImagePx]
) -> InformationForm | None:
    """The corners by the windows' shifts; None where these are few or too large."""
    fit = corner_correction(pair.mapping(result.fixed_to_moving), residual, pair.fixed.size_px)
    if fit is None or not fit.max_px <= _MAX_WINDOWS_PX:
        return None
    return InformationForm.of(fit.mean_px, fit.covariance_px2)


def _expectation(pair: BandPair, result: JointResult[FixedImagePx], rig: Rig | None) -> Expectation | None:
    if rig is None or pair.name not in rig.mean or not pair.has_rig_pixels:
        return None
    return expected_corners(rig, pair.name, pair.scales.between_files(result.fixed_to_moving)).rescaled(
        pair.scales.fixed
    )
