"""Predictions of the flight's rig for the bands of a capture: checks, replacements, and selection of bands to learn."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.decision import decided
from agalign.capture.seeding import find_rotated
from agalign.capture.warped_pair import WarpedPair
from agalign.flight.rig import Observation, Rig, distance_px
from agalign.flight.rig_prediction import predict_band
from agalign.values.alignment import MIN_TIMES_CHANCE, Alignment, Alignments, Prediction
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.issues import OTHER_CONTENT, UNEXPECTED_PX, Issue
from agalign.values.parallax import Parallax
from agalign.verify.checks import MAX_UNEXPECTED_PX, rig_issues


def observed(pairs: Sequence[BandPair], result: Alignments, capture: Capture) -> Observation:
    """Return the aligned mappings of a capture as an observation of the rig."""
    mappings, std_px, parallax_px = dict[str, Matrix](), dict[str, float](), dict[str, float]()
    for pair in pairs:
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


def with_predictions(pairs: Sequence[BandPair], result: Alignments, rig: Rig, capture: Capture) -> Alignments:
    """Return the alignments with the rig's predictions, px of the files; the prediction replaces failed alignments.

    It also replaces results that contradict the rig, because of aliasing in repetitive scenes, and those under a relief
    that are extrapolated over a quarter of the image. A rotated or scaled image does not fit the rig; its alignment
    gets an issue and is not replaced. Predictions follow the relief of the capture, if it has one.
    """
    known = observed([p for p in pairs if p.has_rig_pixels], result, capture)
    covered = [p for p in pairs if p.name in rig.mean and p.has_rig_pixels]
    parallaxes = [(p, result[p.name].mapping.parallax) for p in covered if p.name in known.mappings]
    predicted = {
        p.name: _with_prediction(p, result[p.name], rig, known, *_parallax_by_rig(p, parallaxes, rig)) for p in covered
    }
    return {**result, **predicted}


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


def _with_prediction(
    pair: BandPair,
    alignment: Alignment,
    rig: Rig,
    known: Observation,
    parallax: Parallax | None,
    parallax_std_px: float,
) -> Alignment:
    """Return the alignment with its distance from the rig's prediction, which replaces it if that contradicts it or is
    more certain.
    """
    prediction = predict_band(rig, pair.name, known)
    matrix = pair.scales.between_images(prediction.fixed_to_moving)
    prediction = _with_added_error(prediction, pair.in_moving_file_px(parallax_std_px, matrix))
    if pair.name in known.mappings and alignment.joint is not None and alignment.residual is not None:
        off_px = distance_px(known.mappings[pair.name], prediction.fixed_to_moving, rig.size_px)
        prediction = replace(prediction, off_px=off_px)
        # The other checks have passed.
        issues = tuple(rig_issues(prediction))
        if not issues:
            return replace(alignment, prediction=prediction)
        alignment = replace(alignment, issues=issues)
    if parallax is None:
        # A homography does not follow the relief that captures of the flight have. The plane of a result, which the
        # check above compares, is not displaced by it.
        prediction = _with_added_error(prediction, rig.parallax_px.get(pair.name, 0.0))
    # Windows of another scene contribute to the mapping of the band, but not to the rig's.
    is_mixed = any(issue.kind == OTHER_CONTENT for issue in alignment.issues)
    own = None if is_mixed else alignment.prediction
    if own is not None and own.std_px <= prediction.std_px:
        by_windows = pair.scales.between_files(alignment.fixed_to_moving)
        if distance_px(by_windows, prediction.fixed_to_moving, rig.size_px) <= MAX_UNEXPECTED_PX:
            return alignment
    return _predicted(pair, alignment, prediction, parallax)


def _predicted(pair: BandPair, alignment: Alignment, prediction: Prediction, parallax: Parallax | None) -> Alignment:
    """Return the alignment with the mapping of the prediction, unless the image is rotated or scaled relative to it."""
    mapping = pair.mapping(pair.scales.between_images(prediction.fixed_to_moving))
    by_rig = WarpedPair.of(pair, mapping.with_parallax(parallax))
    rotated = find_rotated(by_rig)
    if rotated is None:
        residual = by_rig.residual
        return decided(replace(alignment, mapping=by_rig.mapping, residual=residual, prediction=prediction))
    off_px = distance_px(pair.scales.between_files(rotated), prediction.fixed_to_moving, pair.reference_file_px)
    issues = Issue(UNEXPECTED_PX, off_px, MAX_UNEXPECTED_PX), *alignment.issues
    return decided(replace(alignment, mapping=alignment.seed_mapping, issues=issues, prediction=None, residual=None))


def _with_added_error(prediction: Prediction, error_px: float) -> Prediction:
    return replace(prediction, std_px=float(math.hypot(prediction.std_px, error_px)))


def bands_to_learn(
    pairs: Sequence[BandPair], result: Alignments, rig: Rig, capture: Capture, accept_predicted_px: float
) -> set[str]:
    """Return the bands to learn from scratch if the flight's network did not align them.

    Bands are skipped if the rig predicts them with a standard error of at most `accept_predicted_px`, or if they have
    no structure in common with the reference, as over water. Learning helps, for example, in captures from a lower
    height than those of the flight's network.
    """
    known = observed([p for p in pairs if p.has_rig_pixels and p.name in result], result, capture)
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
