"""What the flight's rig says of each band of a capture: where it lies, and whether its images are to be believed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from agalign.capture.band_pair import BandPair
from agalign.capture.seeding import find_rotated
from agalign.capture.verification import as_predicted
from agalign.config import CheckSettings
from agalign.flight.factors import distance_px
from agalign.flight.rig import Observation, Rig
from agalign.flight.rig_prediction import predict_band
from agalign.values import geometry
from agalign.values.alignment import MIN_TIMES_CHANCE, Alignment, Prediction
from agalign.values.capture import Capture
from agalign.values.issues import Issue


def observed(pairs: Sequence[BandPair], result: Mapping[str, Alignment], capture: Capture) -> Observation:
    """The mappings of a capture that are aligned, as the rig takes them."""
    good = {p.name: (p, a) for p in pairs if (a := result[p.name]).status == "aligned" and a.joint is not None}
    return Observation(
        capture.time_s,
        {name: pair.in_file_px(a.fixed_to_moving) for name, (pair, a) in good.items()},
        {name: _std_there_px(pair, a) for name, (pair, a) in good.items()},
        None if capture.position is None else capture.position.altitude_m,
        capture.motion,
    )


def _std_there_px(pair: BandPair, alignment: Alignment) -> float:
    """How well a mapping is known, px of the moving file, which the rig's errors are in."""
    assert alignment.joint is not None
    scale = geometry.local_scale(pair.in_file_px(alignment.fixed_to_moving), *pair.reference_file_px)[-1]
    return alignment.joint.corner_std_px / min(pair.scales[0]) * abs(float(scale))


def with_predictions(
    pairs: Sequence[BandPair], result: Mapping[str, Alignment], rig: Rig, capture: Capture, check: CheckSettings
) -> dict[str, Alignment]:
    """Each alignment with what the rig says beside it; a band that is not aligned lies where the rig says.

    A band that lies where the rig has it impossible is not aligned either: of a scene that repeats, the images agree
    whole periods away. One whose image shows itself turned or scaled is not of this rig, and stays as it was found.
    """
    known = observed([p for p in pairs if p.is_the_rigs], result, capture)
    checked = dict(result)
    for pair in pairs:
        alignment = checked[pair.name]
        if pair.name not in rig.mean or not pair.is_the_rigs:
            continue
        prediction = predict_band(rig, pair.name, known)
        if pair.name in known.mappings:
            off_px = distance_px(known.mappings[pair.name], prediction.fixed_to_moving, rig.size_px)
            prediction = replace(prediction, off_px=off_px)
            limit_px = max(check.max_unexpected_px, check.max_unexpected_std * prediction.std_px)
            if off_px <= limit_px:
                checked[pair.name] = replace(alignment, prediction=_in_image_px(prediction, pair))
                continue
            alignment = replace(alignment, issues=(Issue("unexpected_px", off_px, limit_px),))
        predicted = as_predicted(alignment, pair, _in_image_px(prediction, pair))
        assert predicted.residual is not None
        turned = find_rotated(pair, predicted.fixed_to_moving, predicted.residual)
        if turned is not None:
            off_px = distance_px(pair.in_file_px(turned), prediction.fixed_to_moving, rig.size_px)
            issue = Issue("unexpected_px", off_px, check.max_unexpected_px)
            checked[pair.name] = replace(alignment, issues=(issue, *alignment.issues))
            continue
        checked[pair.name] = predicted
    return checked


def worth_learning(
    pairs: Sequence[BandPair], result: Mapping[str, Alignment], rig: Rig, capture: Capture, check: CheckSettings
) -> set[str]:
    """The bands that are to be learnt from scratch where the flight's network did not align them: those that show
    something in common with the reference, and that the rig does not place well enough. A low capture shows much that
    the flight has not seen; water shows nothing, and the rig knows where blurred bands lie.
    """
    known = observed([p for p in pairs if p.is_the_rigs and p.name in result], result, capture)
    worth = set()
    for pair in pairs:
        tried = result.get(pair.name)
        if (
            tried is None
            or pair.name not in rig.mean
            or not pair.is_the_rigs
            or (predict_band(rig, pair.name, known).std_px > check.accept_predicted_px and _shows_something(tried))
        ):
            worth.add(pair.name)
    return worth


def _shows_something(alignment: Alignment) -> bool:
    joint = alignment.joint
    return alignment.seed.trusted or (joint is not None and joint.retrieval >= MIN_TIMES_CHANCE * joint.chance)


def _in_image_px(prediction: Prediction, pair: BandPair) -> Prediction:
    return replace(prediction, fixed_to_moving=geometry.rescale(prediction.fixed_to_moving, *pair.scales))
