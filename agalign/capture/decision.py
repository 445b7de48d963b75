"""Which mapping a band gets: the one place that chooses between the candidates of a capture.

The status follows from the evidence for the mapping that is chosen (`Alignment.status`): `aligned` without issues,
`predicted` with issues and a standard error, else `seed_only` or `failed`. These are the candidates, in the order in
which they are made; each replaces the one before it if its row applies.

| candidate                                  | decided by          | used if                                           |
|--------------------------------------------|---------------------|---------------------------------------------------|
| homography of descriptors, windows and rig | `verified`          | all issues are in PREDICTED_WITH (none: aligned)  |
| the same with a displacement field         | `_with_field`       | it has fewer issues or a smaller standard error  |
| relief of the capture                      | `by_relief`         | it fits half of the bands better; for all bands   |
| seed                                       | `fall_back_to_seed` | the result has other issues                       |
| windows without descriptors                | `by_windows`        | the result is the seed, and held-out windows fit |
| homography beside the relief of the others | `with_one_geometry` | as prediction: indices would mix two geometries   |
| prediction by the rig of the flight        | `against_rig`       | it contradicts the result, or is more certain     |
| homography with lens shapes                | `with_lens_shapes`  | a part of the image has no windows                |

A seed that contradicts the tags or the flight is replaced by their mapping: an image of another capture, for example,
is confirmed at its own position, far from that of its band.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from agalign.capture.band_pair import BandPair
from agalign.capture.by_rig import RigPrediction, observed, rig_predictions
from agalign.capture.by_windows import (
    agreeing_with_seed,
    fitted_to_windows,
    fitted_with_lens_shapes,
    shifts_by_range_px,
)
from agalign.capture.seeding import find_rotated
from agalign.capture.warped_pair import Candidate, WarpedPair
from agalign.flight.rig import Rig
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import Alignment, Alignments, JointResult, Seed
from agalign.values.capture import Capture
from agalign.values.choices import Geometry, ReliefUse, SeedKind
from agalign.values.issues import INACCURATE, OTHER_CONTENT, OTHER_GEOMETRY, SEED_DOES_NOT_FIT, UNEXPECTED_PX, Issue
from agalign.verify.checks import (
    BY_PARALLAX,
    MAX_ALIAS_PEAK,
    MAX_UNEXPECTED_PX,
    PREDICTED_WITH,
    is_unchanged,
    rig_issues,
    seed_fits,
)
from agalign.verify.expected_error import points_in_frame, unobserved_quarters

_RELIEF_SHARE = 0.15
"""Standard deviation of the relief of ground without common structure, as a share of its range: crops and trees at low
altitude, plants and booms at a metre."""


def verified(candidate: Candidate, use: ReliefUse) -> Alignment:
    """Verify a candidate; return its alignment with status, px of the images.

    With issues it has the mapping of the seed. `use` is "never" for no displacement field.
    """
    pair, seed = candidate.pair, candidate.seed
    if candidate.issue is not None:
        return fall_back_to_seed(pair, seed, [candidate.issue])
    joint = _unchanged_if_aligned(candidate.joint, pair)
    plane = candidate.warped.with_mapping(pair.mapping(joint.fixed_to_moving))
    if candidate.by_halves is not None and joint is candidate.joint:
        plane = plane.cross_validated(candidate.by_halves)
    chosen, issues, p95_px = plane, plane.issues(joint), dict[Geometry, float]()
    if _needs_field(use, issues, has_rig=pair.has_rig):
        chosen, issues, p95_px = _with_field(plane, joint, issues)
    if not all(issue.kind in PREDICTED_WITH for issue in issues):
        return replace(fall_back_to_seed(pair, seed, issues), joint=joint, candidates=p95_px)
    alignment = replace(
        pair.seed_alignment(seed),
        mapping=chosen.mapping,
        issues=issues,
        joint=joint,
        residual=chosen.residual,
        lens_std_px=pair.unknown_lens_std_px,
        relief_std_px=pair.relief_std_px,
        candidates=p95_px,
    )
    return pair.predicted_alignment(alignment, chosen.std_px(joint)) if issues else alignment


def _with_field(
    plane: WarpedPair, joint: JointResult, issues: tuple[Issue, ...]
) -> tuple[WarpedPair, tuple[Issue, ...], dict[Geometry, float]]:
    """Return the pair with a displacement field, its issues, and the p95 of held-out windows by geometry.

    With a field, the residual is that of held-out windows, or of the homography if these, which are smaller, do not
    pass. The pair and its issues are returned unchanged if it has no field, or one with issues and no smaller standard
    error.
    """
    pair = plane.pair
    displacement = pair.reference.displacement_field.refine(channel_mean(pair.moving_image), plane.mapping)
    p95_px: dict[Geometry, float] = {"homography": displacement.before_p95_px, "field": displacement.after_p95_px}
    if displacement.field is not None:
        displaced = WarpedPair.of(pair, replace(plane.mapping, field=displacement.field), plane.windows)
        held_out = displaced if displacement.held_out is None else replace(displaced, residual=displacement.held_out)
        # All checks run again, those of windows on the held-out ones and on all windows.
        remaining = held_out.issues(joint) or displaced.issues(joint)
        if not remaining or (
            issues
            and all(issue.kind in PREDICTED_WITH for issue in remaining)
            and held_out.std_px(joint) < plane.std_px(joint)
        ):
            return held_out, remaining, p95_px
        if not issues and not displaced.issues(joint):
            # The homography is verified, and the field reduces the shifts of held-out windows.
            return replace(displaced, residual=plane.residual), issues, p95_px
    return plane, issues, p95_px


def _needs_field(use: ReliefUse, issues: tuple[Issue, ...], *, has_rig: bool) -> bool:
    """Return True if a displacement field is fitted for a result with these issues.

    With `auto`, it is fitted if all issues may be caused by parallax, and without issues if no rig contains the
    residual lens distortion.
    """
    only_parallax = all(issue.kind in BY_PARALLAX for issue in issues)
    return only_parallax and (use == "always" or (use == "auto" and (bool(issues) or not has_rig)))


def _unchanged_if_aligned(joint: JointResult, pair: BandPair) -> JointResult:
    """Replace the mapping by the one given by the files if it does not differ significantly.

    Input that is aligned already is returned unchanged instead of resampled by a small shift.
    """
    kinds: tuple[SeedKind, ...] = ("geo", "identity")
    for given in (pair.seed_matrices[kind] for kind in kinds if kind in pair.seed_matrices):
        if pair.mapping(given).is_curved:
            continue  # with lens distortion the files are not aligned
        if is_unchanged(joint, given, pair.fixed.size_px, max(pair.scales.fixed)):
            return replace(joint, fixed_to_moving=given)
    return joint


def fall_back_to_seed(pair: BandPair, seed: Seed, issues: Sequence[Issue], *, seed_only: bool = False) -> Alignment:
    """Return an alignment with the mapping of the seed, which is usable if it is trusted or with `seed_only`."""
    known = min(
        ((std_px, kind) for kind, std_px in pair.seed_std_px.items() if kind in pair.seed_matrices), default=None
    )
    if known is not None and not seed_only and not pair.is_expected(seed.fixed_to_moving):
        seed = Seed(known[1], pair.seed_matrices[known[1]], 0.0, trusted=True)
    result = pair.seed_alignment(seed, *issues)
    residual = WarpedPair.of(pair, result.mapping).residual
    if not (seed.trusted or seed_only):
        return replace(result, residual=residual)
    if not seed_fits(residual):
        return replace(result, residual=residual, issues=(*issues, Issue(SEED_DOES_NOT_FIT)))
    return replace(result, residual=residual, is_seed_usable=True)


def by_windows(pair: BandPair, alignment: Alignment) -> Alignment:
    """Return an alignment by windows if the descriptors failed and held-out windows confirm it.

    Else return the prediction of a coarse band by windows that agree with its trusted seed, or else `alignment`.
    """
    if alignment.status in ("aligned", "predicted"):
        return alignment
    result = fitted_to_windows(pair, alignment)
    if result is None and pair.is_coarse and alignment.seed.trusted:
        result = agreeing_with_seed(pair, alignment)
        if result is not None and WarpedPair.of(pair, result.mapping).alias_peak().ratio > MAX_ALIAS_PEAK:
            result = None
    return result or alignment


def with_one_geometry(pairs: Sequence[BandPair], result: Alignments) -> Alignments:
    """Return the alignments by name: if a capture has a relief, homographies that are `aligned` become `predicted`.

    Thermal bands, which have another reference image, keep theirs.
    """
    known = [(pair, result[pair.name]) for pair in pairs if pair.name in result]
    with_relief = {id(pair.reference) for pair, alignment in known if alignment.mapping.parallax is not None}
    mixed: Alignments = {}
    for pair, alignment in known:
        is_homography = alignment.status == "aligned" and alignment.mapping.parallax is None
        if is_homography and alignment.joint is not None and id(pair.reference) in with_relief:
            std_px = WarpedPair.of(pair, alignment.mapping).std_px(alignment.joint)
            mixed[pair.name] = pair.predicted_alignment(alignment, std_px, Issue(OTHER_GEOMETRY))
    return {**result, **mixed}


def against_rig(pairs: Sequence[BandPair], result: Alignments, rig: Rig, capture: Capture) -> Alignments:
    """Return the alignments with the rig's predictions, px of the files; the prediction replaces failed alignments.

    It also replaces results that contradict the rig, because of aliasing in repetitive scenes, and those under a relief
    that are extrapolated over a quarter of the image. A rotated or scaled image does not fit the rig; its alignment
    gets an issue and is not replaced. Predictions follow the relief of the capture, if it has one.
    """
    known = observed(pairs, result, capture)
    predictions = rig_predictions(pairs, result, rig, known)
    decided = {n: _against_rig(result[n], p, is_known=n in known.mappings) for n, p in predictions.items()}
    return {**result, **decided}


def _against_rig(alignment: Alignment, of_rig: RigPrediction, *, is_known: bool) -> Alignment:
    """Return the alignment with its distance from the rig's prediction, which replaces it if that contradicts it or is
    more certain.
    """
    off_px = None
    if is_known and alignment.joint is not None and alignment.residual is not None:
        off_px = of_rig.distance_px(alignment.fixed_to_moving)
        prediction = replace(of_rig.of_plane, off_px=off_px)
        # The other checks have passed.
        issues = tuple(rig_issues(prediction))
        if not issues:
            return replace(alignment, prediction=prediction)
        alignment = replace(alignment, issues=issues)
    prediction = replace(of_rig.of_scene, off_px=off_px)
    # Windows of another scene contribute to the mapping of the band, but not to the rig's.
    is_mixed = any(issue.kind == OTHER_CONTENT for issue in alignment.issues)
    own = None if is_mixed else alignment.prediction
    is_certain = own is not None and own.std_px <= prediction.std_px
    if is_certain and of_rig.distance_px(alignment.fixed_to_moving) <= MAX_UNEXPECTED_PX:
        return alignment
    by_rig = WarpedPair.of(of_rig.pair, of_rig.mapping)
    rotated = find_rotated(by_rig)
    if rotated is None:
        return replace(alignment, mapping=by_rig.mapping, residual=by_rig.residual, prediction=prediction)
    unexpected = Issue(UNEXPECTED_PX, of_rig.distance_px(rotated), MAX_UNEXPECTED_PX), *alignment.issues
    at_seed = replace(alignment, mapping=alignment.seed_mapping, issues=unexpected, is_seed_usable=False)
    return replace(at_seed, prediction=None, residual=None)


def with_lens_shapes(pairs: Sequence[BandPair], result: Alignments, rig: Rig | None = None) -> Alignments:
    """Return the alignments; those that are predicted with a quarter of the image without windows get lens shapes.

    A homography does not extrapolate relief: the spread of that of the flight, or of unknown relief at the range of the
    capture, is part of the standard error.
    """
    decided, of_range_px = dict(result), shifts_by_range_px(pairs, result)
    for pair in pairs:
        alignment = result[pair.name]
        own, residual = alignment.prediction, alignment.residual
        is_inaccurate = own is not None and [i.kind for i in alignment.issues] == [INACCURATE]
        if not is_inaccurate or own is None or residual is None or alignment.mapping.parallax is not None:
            continue
        plane, size_px = alignment.mapping.without_parallax, pair.fixed.size_px
        if "geo" in pair.seed_matrices or not unobserved_quarters(
            residual.measured_px, size_px, points_in_frame(plane, *pair.sizes_px)
        ):
            continue
        again = fitted_with_lens_shapes(pair, alignment, plane)
        better = (
            alignment if again is None or again.prediction is None or own.std_px < again.prediction.std_px else again
        )
        of_flight_px = 0.0 if rig is None else rig.parallax_px.get(pair.name, 0.0)
        of_relief_px = max(of_flight_px, _RELIEF_SHARE * of_range_px.get(pair.name, 0.0))
        if better.prediction is not None and of_relief_px > 0.0:
            std_px = math.hypot(better.prediction.std_px, of_relief_px)
            better = replace(better, prediction=replace(better.prediction, std_px=std_px, covariance_px2=None))
        decided[pair.name] = better
    return decided
