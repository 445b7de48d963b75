"""The status of a band: the only place that gives one.

| status    | the first row that applies                                                                  |
|-----------|---------------------------------------------------------------------------------------------|
| aligned   | no check found an issue                                                                     |
| predicted | the mapping is a prediction with a standard error: by windows, the capture's relief, the rig |
| seed_only | the mapping is that of a seed that is confirmed by images or tags and fits the windows       |
| failed    | otherwise                                                                                   |

A seed that contradicts the tags or the flight is replaced by their mapping: an image of another capture, for example,
is confirmed at its own position, far from that of its band.
"""

from collections.abc import Sequence
from dataclasses import replace

from agalign.capture.band_pair import BandPair
from agalign.capture.warped_pair import Candidate, WarpedPair
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import Alignment, Alignments, JointResult, Seed
from agalign.values.choices import Geometry, PairStatus, ReliefUse, SeedKind
from agalign.values.issues import OTHER_GEOMETRY, SEED_DOES_NOT_FIT, Issue
from agalign.verify.checks import BY_PARALLAX, PREDICTED_WITH, is_unchanged, seed_fits


def decided(alignment: Alignment, *, is_seed_usable: bool = False) -> Alignment:
    """Return the alignment with its status.

    A `prediction` together with issues is one of the mapping. `is_seed_usable` is for the mapping of a seed.
    """
    status: PairStatus = "failed"
    issues: tuple[Issue, ...] = alignment.issues
    if not issues:
        status = "aligned"
    elif alignment.prediction is not None:
        status = "predicted"
    elif is_seed_usable and alignment.residual is not None and seed_fits(alignment.residual):
        status = "seed_only"
    if is_seed_usable and status == "failed":
        issues += (Issue(SEED_DOES_NOT_FIT),)
    return replace(alignment, status=status, issues=issues)


def failed_at_seed(pair: BandPair, seed: Seed, *issues: Issue) -> Alignment:
    """Return a failed alignment with the mapping of a seed."""
    return decided(Alignment(pair.mapping(seed.fixed_to_moving), pair.fixed.size_px, "failed", issues, seed))


def fall_back_to_seed(pair: BandPair, seed: Seed, issues: Sequence[Issue], *, seed_only: bool = False) -> Alignment:
    """Return an alignment with the mapping of the seed, which is usable if it is trusted or with `seed_only`."""
    expected = min(
        ((std_px, kind) for kind, std_px in pair.seed_std_px.items() if kind in pair.seed_matrices), default=None
    )
    if expected is not None and not seed_only and not pair.is_expected(seed.fixed_to_moving):
        seed = Seed(expected[1], pair.seed_matrices[expected[1]], 0.0, trusted=True)
    result = failed_at_seed(pair, seed, *issues)
    result = replace(result, residual=WarpedPair.of(pair, result.mapping).residual)
    return decided(result, is_seed_usable=seed.trusted or seed_only)


def predicted(alignment: Alignment, pair: BandPair, std_px: float, *issues: Issue) -> Alignment:
    """Return as `predicted`, with this standard error, an alignment that its windows do not confirm everywhere.

    `issues` precede its own.
    """
    prediction = pair.prediction_of(alignment.mapping, std_px)
    return decided(replace(alignment, issues=(*issues, *alignment.issues), prediction=prediction))


def with_one_geometry(pairs: Sequence[BandPair], result: Alignments) -> Alignments:
    """Return the alignments by name: if a capture has a relief, homographies that are `aligned` become `predicted`.

    A spectral index would mix two geometries otherwise. Thermal bands, which have another reference image, keep theirs.
    """
    known = [(pair, result[pair.name]) for pair in pairs if pair.name in result]
    with_relief = {id(pair.reference) for pair, alignment in known if alignment.mapping.parallax is not None}
    mixed: Alignments = {}
    for pair, alignment in known:
        is_homography = alignment.status == "aligned" and alignment.mapping.parallax is None
        if is_homography and alignment.joint is not None and id(pair.reference) in with_relief:
            std_px = WarpedPair.of(pair, alignment.mapping).std_px(alignment.joint)
            mixed[pair.name] = predicted(alignment, pair, std_px, Issue(OTHER_GEOMETRY))
    return {**result, **mixed}


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
        failed_at_seed(pair, seed),
        mapping=chosen.mapping,
        issues=issues,
        joint=joint,
        residual=chosen.residual,
        lens_std_px=pair.unknown_lens_std_px,
        relief_std_px=pair.relief_std_px,
        candidates=p95_px,
    )
    return predicted(alignment, pair, chosen.std_px(joint)) if issues else decided(alignment)


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
