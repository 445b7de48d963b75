"""A capture estimated whole: what its images say and what the flight knows, each weighed by what it is worth.

Unknown are, for every band b, by how much the corners of the reference move beside the mapping that the descriptors
found, delta_b (8,), and the capture's factors nu, which all bands share. Four witnesses speak of them:

    descriptors   0 = delta_b + N(0, C_b)                 the last step of the method, with its covariance
    windows       s_i = D(x_i) delta_b + noise            shifts of the structure that the mapping leaves
    rig           delta_b = c_b + K_b nu + N(0, S_b)      the flight's mean, moved along the band's baseline
    heights       nu = N(0, F)

The maximum a posteriori is a linear system. A band with little texture leans on the others and on the flight; one with
much is free of them, and one that contradicts the rig by many standard deviations is not pulled: its weight falls as
that of a Student's t does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.corner_fit import fit_corners
from agalign.flight.factors import FACTOR_STD_PX
from agalign.flight.rig import Rig
from agalign.flight.rig_prediction import Expectation, expected_corners
from agalign.values import geometry, lens
from agalign.values.alignment import JointResult, Residual

Array = NDArray[np.float64]

_WINDOWS_STD_PX = 0.01
"""What all windows have in common, along x and y, beside what they disagree by."""
_MIN_WINDOWS = 16
_FARTHEST_PX = 1.0
"""Windows that would move a corner farther do not correct a mapping: they contradict it."""
_REWEIGHTINGS = 6
_FREEDOM = 4.0
"""Of the t distribution by which a band may lie beside where the rig has it."""


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
    pairs: Sequence[BandPair], results: Mapping[str, JointResult], residuals: Mapping[str, Residual], rig: Rig | None
) -> dict[str, JointResult]:
    """Each result, by band, moved to the maximum a posteriori of all, with what is known of its corners then.

    `residuals` are what the windows show under the results.
    """
    known = [p for p in pairs if p.name in results and results[p.name].corner_covariance_px2 is not None]
    own = [_of_descriptors(results[p.name]) for p in known]
    for k, pair in enumerate(known):
        shown = _of_windows(pair, residuals[pair.name])
        if shown is not None:
            own[k] = own[k] + shown
    priors = [_expectation(pair, results[pair.name], rig) for pair in known]
    moved = dict(results)
    for pair, (delta, covariance) in zip(known, _solve(own, priors), strict=True):
        result, size = results[pair.name], pair.fixed.size_px
        std = np.sqrt(np.diag(covariance)).reshape(4, 2)
        moved[pair.name] = replace(
            result,
            fixed_to_moving=geometry.compose(result.fixed_to_moving, geometry.moving_corners(delta, *size)),
            corner_std_xy_px=tuple((float(x), float(y)) for x, y in std), corner_covariance_px2=covariance,
        )  # fmt: skip
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
    # In which order sums are taken is the machine's: the last bits must not reach what is written.
    return [(np.round(solution[s], 6), np.round(covariance[s, s], 12)) for s in blocks]


def _of_descriptors(result: JointResult) -> InformationForm:
    assert result.corner_covariance_px2 is not None
    return InformationForm.of(np.zeros(8), result.corner_covariance_px2)


def _of_windows(pair: BandPair, residual: Residual) -> InformationForm | None:
    """What the windows' shifts say of the corners; None where they are few or far off."""
    some = np.isfinite(residual.shifts_px[:, 0])
    if some.sum() < _MIN_WINDOWS:
        return None
    at, there = (_undistorted(pair, p) for p in (residual.centres_px, residual.centres_px + residual.shifts_px))
    fit = fit_corners(at[some], (there - at)[some], residual.peaks_sigma[some], pair.fixed.size_px)
    if not np.abs(fit.mean_px).max() <= _FARTHEST_PX:
        return None
    return InformationForm.of(fit.mean_px, fit.covariance_px2 + _WINDOWS_STD_PX**2 * np.eye(8))


def _undistorted(pair: BandPair, raw_px: Array) -> Array:
    """Pixels of the reference as the homography sees them."""
    bent = raw_px if pair.field is None else raw_px + pair.field(raw_px)
    return lens.undistort(pair.fixed.lens, bent)


def _expectation(pair: BandPair, result: JointResult, rig: Rig | None) -> Expectation | None:
    if rig is None or pair.name not in rig.mean or not pair.is_the_rigs:
        return None
    return expected_corners(rig, pair.name, pair.in_file_px(result.fixed_to_moving)).rescaled(pair.scales[0])
