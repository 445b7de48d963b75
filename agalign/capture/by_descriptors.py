"""Candidates by the descriptors, combined with windows and rig: a homography, and a displacement field on top of it."""

from collections.abc import Iterator
from dataclasses import replace

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import Candidate, RefinedBand
from agalign.capture.warped_pair import WarpedPair
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import JointResult
from agalign.values.choices import Geometry, ReliefUse, SeedKind
from agalign.verify.checks import BY_PARALLAX, is_unchanged


def by_descriptors(band: RefinedBand, use: ReliefUse) -> Iterator[Candidate]:
    """Yield the homography of a band, then the same with a displacement field, or with the p95 of both if the field is
    rejected.

    A field is fitted if parallax may cause all issues of the homography, or if there are none and no rig contains the
    distortion of the lenses; always with `use` "always", not with "never".
    """
    pair = band.pair
    joint = _unchanged_if_aligned(band.joint, pair)
    warped = band.warped.with_mapping(pair.mapping(joint.fixed_to_moving))
    if band.by_halves is not None and joint is band.joint:
        warped = warped.cross_validated(band.by_halves)
    plane = Candidate.of(warped, joint)
    yield plane
    is_wanted = use == "always" or (use == "auto" and (bool(plane.issues) or not pair.has_rig))
    if is_wanted and all(issue.kind in BY_PARALLAX for issue in plane.issues):
        yield from _with_field(plane, warped, joint)


def _with_field(plane: Candidate, warped: WarpedPair, joint: JointResult) -> Iterator[Candidate]:
    """Yield the candidate with a displacement field, verified by windows that it is not fitted to; the same without one
    if the field does not reduce their shifts, or if only the homography passes.
    """
    pair = plane.pair
    displacement = pair.reference.displacement_field.refine(channel_mean(pair.moving_image), plane.mapping)
    if displacement is None:
        return
    p95_px: dict[Geometry, float] = {"homography": displacement.before_p95_px, "field": displacement.after_p95_px}
    without = replace(plane, held_out_p95_px=p95_px)
    if displacement.field is None:
        yield without
        return
    displaced = WarpedPair.of(pair, replace(plane.mapping, field=displacement.field), warped.windows)
    held_out = Candidate.of(displaced, joint, displacement.held_out)
    with_field = replace(held_out, other_residual=displaced.residual, held_out_p95_px=p95_px)
    yield without if with_field.issues and not plane.issues else with_field


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
