"""Predictions of the bands of a capture by the flight's rig: candidates for `decision`; the bands to learn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.flight.rig import Observation, Rig
from agalign.flight.rig_prediction import predict_band
from agalign.values.alignment import MIN_TIMES_CHANCE, Alignments, Prediction
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax


def observed(pairs: Sequence[BandPair], result: Alignments, capture: Capture) -> Observation:
    """Return the aligned mappings of a capture, between pixels that the rig relates, as an observation of the rig."""
    mappings, std_px, parallax_px = dict[str, Matrix](), dict[str, float](), dict[str, float]()
    for pair in (p for p in pairs if p.has_rig_pixels and p.name in result):
        alignment = result[pair.name]
        if alignment.status != "aligned" or alignment.joint is None:
            continue
        matrix, parallax = alignment.fixed_to_moving, alignment.mapping.parallax
        mappings[pair.name] = pair.scales.between_files(matrix)
        std_px[pair.name] = pair.in_moving_file_px(alignment.joint.corner_std_px, matrix)
        if parallax is not None:
            rms_px = float(parallax.relief.rms_px * math.hypot(*parallax.baseline))
            parallax_px[pair.name] = pair.in_moving_file_px(rms_px, matrix)
    return Observation(capture.time_s, mappings, std_px, capture.altitude_m, capture.motion, parallax_px)


@dataclass(frozen=True)
class RigPrediction:
    """The prediction of a band by the rig, and what its own result is compared with."""

    of_plane: Prediction
    """Of the reference plane."""
    of_scene: Prediction
    """The same, with the error of the relief of the scene."""
    mapping: PixelMapping
    """The predicted mapping between the images, with the relief of the capture."""
    observed: Matrix | None
    """The homography of the band's own result between the files; None if it is not aligned."""
    size_px: tuple[int, int]
    """(width, height) of the reference's file."""


def rig_predictions(
    pairs: Sequence[BandPair], result: Alignments, rig: Rig, known: Observation
) -> dict[str, RigPrediction]:
    """Return the prediction of each band of the rig from the `known` mappings of the capture."""
    covered = [p for p in pairs if p.name in rig.mean and p.has_rig_pixels]
    parallaxes = [(p, result[p.name].mapping.parallax) for p in covered if p.name in known.mappings]
    predictions: dict[str, RigPrediction] = {}
    for pair in covered:
        parallax, parallax_std_px = _parallax_by_rig(pair, parallaxes, rig)
        prediction = predict_band(rig, pair.name, known)
        matrix = pair.scales.between_images(prediction.fixed_to_moving)
        of_plane = _with_added_error(prediction, pair.in_moving_file_px(parallax_std_px, matrix))
        # A homography does not follow the relief that captures of the flight have. The plane of a result, which is
        # compared with the prediction, is not displaced by it.
        relief_px = rig.parallax_px.get(pair.name, 0.0) if parallax is None else 0.0
        mapping, own = pair.mapping(matrix).with_parallax(parallax), known.mappings.get(pair.name)
        of_scene = _with_added_error(of_plane, relief_px)
        predictions[pair.name] = RigPrediction(of_plane, of_scene, mapping, own, rig.size_px)
    return predictions


def _parallax_by_rig(
    pair: BandPair, parallaxes: Sequence[tuple[BandPair, Parallax | None]], rig: Rig
) -> tuple[Parallax | None, float]:
    """Return the relief of the other bands with the baseline of the rig, scaled to theirs, and its standard error.

    The error is that of the baseline and of the relief in half of the pixels; the error map has those at depth edges.
    None and 0 without a relief.
    """
    others = {
        other.name: parallax
        for other, parallax in parallaxes
        if parallax is not None and other is not pair and other.reference is pair.reference
    }
    if not others:
        return None, 0.0
    relief = next(iter(others.values())).relief
    seen = np.array([parallax.baseline for parallax in others.values()])
    of_rig = np.array([rig.baselines[name] for name in others])
    scale = float((seen * of_rig).sum() / max((of_rig**2).sum(), 1e-12))
    error = float(np.sqrt(((seen - scale * of_rig) ** 2).sum(axis=1).mean()))
    x, y = (scale * np.array(rig.baselines[pair.name])).tolist()
    of_relief = 0.0 if relief.std_px is None else float(np.median(relief.std_px)) * relief.unit * math.hypot(x, y)
    return Parallax(relief, (x, y)).with_occlusions(), float(math.hypot(error * relief.rms_px, of_relief))


def _with_added_error(prediction: Prediction, error_px: float) -> Prediction:
    return replace(prediction, std_px=math.hypot(prediction.std_px, error_px))


def bands_to_learn(
    pairs: Sequence[BandPair], result: Alignments, rig: Rig, capture: Capture, accept_predicted_px: float
) -> set[str]:
    """Return the bands to learn from scratch if the flight's network did not align them.

    Bands are skipped if the rig predicts them with a standard error of at most `accept_predicted_px`, or if they have
    no structure in common with the reference, as over water. Learning helps, for example, in captures from a lower
    height than those of the flight's network.
    """
    known = observed(pairs, result, capture)
    has_relief = any(alignment.mapping.parallax is not None for alignment in result.values())

    def is_skipped(pair: BandPair) -> bool:
        alignment = result.get(pair.name)
        if alignment is None or pair.name not in rig.mean or not pair.has_rig_pixels:
            return False
        joint = alignment.joint
        is_retrieved = joint is not None and joint.retrieval >= MIN_TIMES_CHANCE * joint.chance
        has_common_structure = alignment.seed.trusted or is_retrieved
        prediction = predict_band(rig, pair.name, known)
        if not has_relief:
            prediction = _with_added_error(prediction, rig.parallax_px.get(pair.name, 0.0))
        return not has_common_structure or prediction.std_px <= accept_predicted_px

    return {pair.name for pair in pairs if not is_skipped(pair)}
