"""Which of its candidates a band gets, and the status that follows.

The estimators leave out what they reject themselves: displacement fields that increase the p95 of held-out windows by
more than a twentieth, and reliefs that fit fewer than half of the bands. `decide` chooses among the other candidates.
For each band, the first row that applies:

| chosen                                    | if                                               | status      |
|-------------------------------------------|--------------------------------------------------|-------------|
| the candidate under the relief            | the capture has a relief, and the band has one   | (1)         |
| the last candidate without issues         | there is one                                     | (2)         |
| the candidate of the least standard error | the images confirm it in parts (`may_predict`)   | `predicted` |
| the seed                                  | it is trusted or requested, and fits the windows | `seed_only` |
| the seed                                  | otherwise                                        | `failed`    |

A capture has a relief if one fits half of the bands that it is estimated from better than their homographies, and of
several the one by which the images deliver most bands: all bands of its reference image then have this geometry. (1)
The candidate under it is `aligned` without issues, else `predicted`. (2) A candidate without issues is `aligned`, but
beside a relief it is `predicted`, as indices would mix two geometries. Every standard error is the RMS of
`Candidate.error`.
`Alignment.status` follows from the issues and the prediction that are set here.

The prediction of the rig of the flight replaces what contradicts it, seeds, what has failed, and predictions that are
less certain or show another scene in a part of the image. If an accepted mapping contradicts it, or one that is
confirmed in parts and certain, which of the two is right is unknown: their distance is part of the error. An image that
is rotated or scaled relative to its rig does not fit it: it has `failed`, and the rig does not replace it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from agalign.capture.by_relief import UnderRelief
from agalign.capture.by_rig import DELIVERED_STD_PX, RigPrediction
from agalign.capture.candidate import BandCandidates, Candidate
from agalign.values.alignment import STD_DECIMALS, Alignment, Alignments, Prediction
from agalign.values.issues import OTHER_CONTENT, OTHER_GEOMETRY, SEED_DOES_NOT_FIT, UNEXPECTED_PX, Issue
from agalign.verify.checks import MAX_UNEXPECTED_PX, max_expected_px, rig_issues


def decide(
    bands: Sequence[BandCandidates],
    reliefs: Sequence[UnderRelief] = (),
    predictions: Mapping[str, RigPrediction] | None = None,
) -> Alignments:
    """Return the alignments of the bands of a capture by name, px of the images.

    `predictions` are those of the rig by band.
    """
    return _aligned(bands, _of_several_reliefs(bands, reliefs), predictions or {})


def _of_several_reliefs(bands: Sequence[BandCandidates], reliefs: Sequence[UnderRelief]) -> UnderRelief:
    """Return the relief of the capture, chosen by its images alone, as predictions by the rig have it; empty without
    one.
    """

    def delivered(relief: UnderRelief) -> tuple[int, int]:
        alignments = _aligned(bands, relief, {}).values()
        return sum(a.is_usable(DELIVERED_STD_PX) for a in alignments), sum(a.status == "aligned" for a in alignments)

    return max(reliefs, key=delivered) if len(reliefs) > 1 else next(iter(reliefs), {})


def _aligned(
    bands: Sequence[BandCandidates], relief: UnderRelief, predictions: Mapping[str, RigPrediction]
) -> Alignments:
    """Return the alignments with one relief, or with none if it is empty."""
    result: Alignments = {}
    for band in bands:
        choice, of_rig = _of_images(band, relief), predictions.get(band.pair.name)
        if of_rig is not None and not choice.is_seed_refused:
            choice = _against_rig(choice, of_rig)
        result[band.pair.name] = choice.alignment
    return result


@dataclass(frozen=True)
class _Choice:
    """The mapping that a band gets."""

    band: BandCandidates
    candidate: Candidate | None
    """None for the seed."""
    issues: tuple[Issue, ...]
    compared: Prediction | None = None
    """The prediction by the rig, with the distance of the band's own mapping from it."""
    is_seed_refused: bool = False
    """True if the seed must not be used, although it is trusted and fits."""

    @property
    def alignment(self) -> Alignment:
        """The alignment: this is the only place that makes those of pairs of images."""
        band, chosen = self.band, self.candidate
        pair = band.pair
        if chosen is None:
            is_usable = band.is_seed_trusted and band.does_seed_fit and not self.is_seed_refused
            is_misfit = band.is_seed_trusted and not band.does_seed_fit and not self.is_seed_refused
            return Alignment(
                pair.mapping(band.seed.fixed_to_moving),
                pair.fixed.size_px,
                (*self.issues, Issue(SEED_DOES_NOT_FIT)) if is_misfit else self.issues,
                band.seed,
                joint=band.joint,
                residual=None if self.is_seed_refused or band.at_seed is None else band.at_seed.residual,
                held_out_p95_px=band.candidates[-1].held_out_p95_px if band.candidates else {},
                is_seed_usable=is_usable,
            )
        return Alignment(
            chosen.mapping,
            pair.fixed.size_px,
            self.issues,
            band.seed_of(chosen),
            joint=band.joint if chosen.joint is None else chosen.joint,
            residual=chosen.residual,
            held_out_p95_px=chosen.held_out_p95_px,
            prediction=_prediction(chosen, self.compared) if self.issues else self.compared,
            error=chosen.error,
            std_px=chosen.std_px,
        )


def _prediction(chosen: Candidate, compared: Prediction | None) -> Prediction:
    """Return a candidate as a prediction with its standard error: that of the rig, or if there is none, of windows."""
    fixed_to_moving = chosen.mapping.fixed_to_moving
    std_px = round(chosen.pair.in_moving_file_px(chosen.std_px, fixed_to_moving), STD_DECIMALS)
    if compared is not None:
        return replace(compared, std_px=std_px)
    return Prediction(chosen.pair.scales.between_files(fixed_to_moving), "windows", std_px)


def _of_images(band: BandCandidates, relief: UnderRelief) -> _Choice:
    """Choose from what the images of the capture show; nothing if the pixels of the band cannot be read."""
    if band.is_unreadable:
        return _Choice(band, None, band.rejected, is_seed_refused=True)
    under = relief.get(band.pair.name)
    if under is not None:
        if not under.issues:
            return _Choice(band, under, ())
        return _Choice(band, under.with_second_layer, (Issue(OTHER_GEOMETRY), *under.issues_of_prediction))
    if (accepted := band.accepted) is not None:
        is_beside = any(other.pair.reference is band.pair.reference for other in relief.values())
        return _Choice(band, accepted, (Issue(OTHER_GEOMETRY),) if is_beside else ())
    predicting = [candidate for candidate in band.candidates if candidate.may_predict]
    if predicting:
        best = min(predicting, key=lambda candidate: candidate.with_second_layer.std_px)
        return _Choice(band, best.with_second_layer, best.issues_of_prediction)
    return _Choice(band, None, band.rejected)


def _against_rig(choice: _Choice, of_rig: RigPrediction) -> _Choice:
    """Return the choice as compared with the prediction of the rig, or this prediction."""
    own = choice.candidate
    # Windows of another scene contribute to the mapping of the band, but not to the rig's.
    is_mixed = any(issue.kind == OTHER_CONTENT for issue in choice.issues)
    if own is not None and not is_mixed:
        compared = of_rig.compared(own.mapping.fixed_to_moving)
        contradictions = tuple(rig_issues(compared))
        if not contradictions and not choice.issues:
            return replace(choice, compared=compared)
        if not contradictions and own.std_px <= of_rig.candidate.std_px:
            return choice
        if not choice.issues and own.refined_from is not None:  # the refinement on the files contradicts the rig
            return _against_rig(replace(choice, candidate=own.refined_from), of_rig)
        own_std_px = own.pair.in_moving_file_px(own.std_px, own.mapping.fixed_to_moving)
        if contradictions and (not choice.issues or (compared.off_px or 0.0) > max_expected_px(own_std_px)):
            issues = (*contradictions, *choice.issues)
            if of_rig.rotated is None:
                return replace(choice, candidate=of_rig.contradicted(compared), issues=issues, compared=compared)
            choice = replace(choice, issues=issues)
    if of_rig.rotated is not None:
        unexpected = Issue(UNEXPECTED_PX, of_rig.distance_px(of_rig.rotated), MAX_UNEXPECTED_PX)
        return _Choice(choice.band, None, (unexpected, *choice.issues), is_seed_refused=True)
    return replace(choice, candidate=of_rig.candidate, compared=of_rig.of_plane)
