"""Predictions of the bands of a capture by the flight's rig: candidates for `decision`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import Candidate
from agalign.capture.seeding import find_rotated
from agalign.capture.warped_pair import WarpedPair
from agalign.config import CheckSettings
from agalign.flight.rig import Observation, Rig, distance_px, expected_square, lattice
from agalign.flight.rig_prediction import predict_band
from agalign.values.alignment import Alignment, Alignments, JointResult, Prediction
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.issues import INACCURATE
from agalign.values.lens_shapes import variance_px2
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.parallax import Parallax

DELIVERED_STD_PX = CheckSettings().accept_predicted_px
"""Standard error of a prediction, px of the band, up to which the estimation counts a band as delivered: the default,
because an estimate must not depend on a setting that later commands may change."""


@dataclass(frozen=True)
class RigPrediction:
    """The prediction of a band by the rig of the flight.

    A rig is between px of the files, and the bands of a capture are aligned between px of the images: this module
    converts between them.
    """

    pair: BandPair
    of_plane: Prediction
    """Of the reference plane."""
    parallax: Parallax | None = None
    """The relief of the capture, with the baseline of the rig."""
    baseline_std: float = 0.0
    """Standard error of that baseline, px per px of parallax; that of the relief is in `parallax`."""
    relief_std_px: float = 0.0
    """Error by the relief that a mapping without one lacks, px of the fixed image."""

    @property
    def fixed_to_moving(self) -> Matrix:
        """The predicted homography between the images."""
        return self.pair.scales.between_images(self.of_plane.fixed_to_moving)

    @property
    def mapping(self) -> PixelMapping:
        """The predicted mapping between the images, with the relief of the capture."""
        return self.pair.mapping(self.fixed_to_moving).with_parallax(self.parallax)

    @cached_property
    def candidate(self) -> Candidate:
        """The predicted mapping; the windows under it say nothing about it, as the band did not pass verification."""
        return Candidate(self.pair, self._warped.mapping, self.error, self._warped.residual)

    @property
    def error(self) -> MappingError:
        """Its error: of the reference plane, of the baseline or the missing relief, and of the relief."""
        std_px = math.hypot(self.std_px(self.fixed_to_moving), self.relief_std_px)
        size_px, baseline_std = self.pair.fixed.size_px, self.baseline_std
        return MappingError(size_px, rig_std_px=std_px, parallax=self.parallax, baseline_std=baseline_std)

    @property
    def is_delivered(self) -> bool:
        """True if the standard error of the predicted mapping allows its delivery."""
        std_px = self.pair.in_moving_file_px(self.candidate.std_px, self.fixed_to_moving)
        return std_px <= DELIVERED_STD_PX

    @cached_property
    def rotated(self) -> Matrix | None:
        """The homography of an image that is rotated or scaled relative to its rig; None of one that is not."""
        return find_rotated(self._warped)

    @cached_property
    def _warped(self) -> WarpedPair:
        return WarpedPair.of(self.pair, self.mapping)

    def std_px(self, fixed_to_moving: Matrix) -> float:
        """Return the standard error, px of the fixed image, for a homography between the images."""
        return self.of_plane.std_px / self.pair.in_moving_file_px(1.0, fixed_to_moving)

    def compared(self, fixed_to_moving: Matrix) -> Prediction:
        """Return the prediction with its distance from a homography between the images."""
        return replace(self.of_plane, off_px=self.distance_px(fixed_to_moving))

    def contradicted(self, compared: Prediction) -> Candidate:
        """Return the predicted mapping if the images confirm another one: which of them is right is unknown, so their
        distance is part of the error.
        """
        assert compared.off_px is not None
        distance_px = compared.off_px / self.pair.in_moving_file_px(1.0, self.fixed_to_moving)
        error = self.candidate.error
        return replace(self.candidate, error=replace(error, rig_std_px=math.hypot(error.rig_std_px, distance_px)))

    def distance_px(self, fixed_to_moving: Matrix) -> float:
        """Return the RMS distance of a homography between the images from the prediction, px of the moving file."""
        own = self.pair.scales.between_files(fixed_to_moving)
        return distance_px(own, self.of_plane.fixed_to_moving, self.pair.reference_file_px)


def observation(
    pairs: Sequence[BandPair], joints: Mapping[str, JointResult], capture: Capture | None = None
) -> Observation:
    """Return the results by band, between the images, as an observation of the rig.

    Bands between other pixels than those of the rig are omitted.
    """
    mappings, std_px = dict[str, Matrix](), dict[str, float]()
    for pair in pairs:
        if pair.has_rig_pixels and pair.name in joints:
            joint = joints[pair.name]
            mappings[pair.name] = pair.scales.between_files(joint.fixed_to_moving)
            size_px = pair.fixed.size_px
            variances_px2 = variance_px2(lattice(size_px)[0], joint.covariance_px2, size_px)
            std_px[pair.name] = pair.in_reference_file_px(math.sqrt(variances_px2.mean()))
    if capture is None:
        return Observation(None, mappings, std_px)
    return Observation(capture.time_s, mappings, std_px, capture.altitude_m, capture.motion)


def _is_inaccurate(alignment: Alignment) -> bool:
    """Return True for a mapping that the windows of the images confirm, but not accurately enough."""
    is_by_windows = alignment.prediction is not None and alignment.prediction.source == "windows"
    return is_by_windows and {issue.kind for issue in alignment.issues} == {INACCURATE}


def observed(pairs: Sequence[BandPair], result: Alignments, capture: Capture) -> Observation:
    """Return the mappings of a capture by its images as an observation of the rig, without what they contain of it.

    The covariance of inaccurate ones is too small: their standard errors are those of the whole mapping, which contain
    the shifts of held-out windows.
    """
    known = {
        name: a.joint.by_images or replace(a.joint, fixed_to_moving=a.fixed_to_moving)
        for name, a in result.items()
        if a.joint is not None and (a.status == "aligned" or _is_inaccurate(a))
    }
    of_images = observation(pairs, known, capture)
    std_px, parallax_px = dict(of_images.std_px), dict[str, float]()
    for pair in (p for p in pairs if p.name in of_images.mappings):
        alignment = result[pair.name]
        if _is_inaccurate(alignment):
            std_px[pair.name] = max(std_px[pair.name], pair.in_reference_file_px(alignment.std_px))
        if (parallax := alignment.mapping.parallax) is not None:
            rms_px = parallax.relief.rms_px * math.hypot(*parallax.baseline)
            parallax_px[pair.name] = pair.in_reference_file_px(rms_px)
    return replace(of_images, std_px=std_px, parallax_px=parallax_px)


def rig_prediction(pair: BandPair, rig: Rig, known: Observation) -> RigPrediction:
    """Return the prediction of a band from the `known` bands of the capture, without relief."""
    return RigPrediction(pair, predict_band(rig, pair.name, known))


def rig_predictions(
    pairs: Sequence[BandPair], result: Alignments, rig: Rig, capture: Capture
) -> dict[str, RigPrediction]:
    """Return the prediction of each band of the rig from the other bands of a capture, with its relief."""
    known = observed(pairs, result, capture)
    covered = [p for p in pairs if p.name in rig.mean and p.has_rig_pixels]
    parallaxes = [(p, result[p.name].mapping.parallax) for p in covered if p.name in known.mappings]
    predictions: dict[str, RigPrediction] = {}
    for pair in covered:
        parallax, baseline_std = _parallax_by_rig(pair, parallaxes, rig)
        # A homography does not follow the relief that captures of the flight have.
        relief_std_px = pair.relief_std_px if parallax is None else 0.0
        # The plane of a result, which is compared with the prediction, is not displaced by the relief.
        predictions[pair.name] = replace(
            rig_prediction(pair, rig, known), parallax=parallax, baseline_std=baseline_std, relief_std_px=relief_std_px
        )
    return predictions


def _parallax_by_rig(
    pair: BandPair, parallaxes: Sequence[tuple[BandPair, Parallax | None]], rig: Rig
) -> tuple[Parallax | None, float]:
    """Return the relief of the other bands with the baseline of the rig, and the standard error of this baseline. The
    result is None and 0 without a relief, or if its bands do not determine the baseline.

    t_b and d_b of a rig with delays are orthogonal (`learn_rig`), and the baselines of its lenses are s t_b + d_b k, in
    which s and k (2,) are equal for all bands.
    """
    others = {
        other.name: parallax
        for other, parallax in parallaxes
        if parallax is not None and other is not pair and other.reference is pair.reference
    }
    if not others:
        return None, 0.0
    relief = next(iter(others.values())).relief
    seen = np.ravel([parallax.baseline for parallax in others.values()])
    design = np.concatenate([rig.baseline_design(name) for name in others])
    solution, _, rank, _ = np.linalg.lstsq(design, seen, rcond=None)
    if rank < len(solution):
        return None, 0.0
    degrees_of_freedom = len(seen) - int(rank)
    mean_square = float(np.square(seen - design @ solution).sum()) / degrees_of_freedom
    variance = float(expected_square(mean_square, degrees_of_freedom))
    own = rig.baseline_design(pair.name)
    std = math.sqrt(variance * (2 + float(np.trace(own @ np.linalg.inv(design.T @ design) @ own.T))))
    x, y = (own @ solution).tolist()
    return Parallax(relief, (x, y)).with_occlusions(), std
