"""Verification of a pair: its alignment with every reason for and against it, measured on the warped images."""

import math
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.config import Settings
from agalign.pixels.grey import channel_mean
from agalign.pixels.resample import shrink
from agalign.pixels.structure import Field, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Alignment, DisplacementResult, JointResult, Prediction, Residual, Seed
from agalign.values.choices import ReliefUse, SeedKind, Space
from agalign.values.image import Raster
from agalign.values.issues import SEED_DOES_NOT_FIT, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx, FixedPx, PixelScale
from agalign.verify.acceptance import is_unchanged, seed_fits, status_of
from agalign.verify.check import Evidence
from agalign.verify.checks import issues_of
from agalign.verify.extrapolation_check import points_in_frame, unobserved_quarters
from agalign.verify.residuals import residual_under
from agalign.verify.window_check import CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX

_UNCHANGED: tuple[SeedKind, ...] = ("geo", "identity")
"""Seeds that change nothing: an input aligned already is left untouched, not resampled by a hundredth of a pixel."""

_SAME_PX = 0.15
"""Mappings no farther apart leave shifts that differ by that, to a hundredth of a px: interpolation changes the
windows' shifts by a tenth to a quarter of their distance from whole pixels."""

_MENDABLE = frozenset({CLOSE_WINDOWS, CLUSTER, RESIDUAL_PX})
"""Issues that parallax causes and a displacement field removes."""


def without_result(seed: Seed, space: Space, issue: Issue) -> Alignment[FixedPx]:
    """The failed alignment of a pair that could not be tried."""
    return Alignment(seed.fixed_to_moving, space, "failed", (issue,), seed, None, None, 0.0)


@dataclass(frozen=True)
class WarpedPair:
    """A pair with the moving image on the reference's pixels, and the residual of its windows."""

    pair: BandPair
    mapping: PixelMapping
    warped: Raster
    """The moving image, one channel, on the reference's pixels."""
    residual: Residual[FixedImagePx]

    @classmethod
    def of(cls, pair: BandPair, mapping: PixelMapping) -> "WarpedPair":
        """Warped and measured."""
        warped = pair.warped_moving(mapping)
        return cls(pair, mapping, warped, _residual_of(pair, mapping, warped))

    def under(self, mapping: PixelMapping) -> "WarpedPair":
        """The pair under another mapping; where the two are all but equal, it is not measured again."""
        if mapping.local is self.mapping.local:
            corners = geometry.corners(*self.pair.fixed.size_px)
            apart_px = float(np.linalg.norm(mapping(corners) - self.mapping(corners), axis=1).max())
            if apart_px <= _SAME_PX:
                return replace(self, mapping=mapping, residual=residual_under(self.residual, self.mapping, mapping))
        return WarpedPair.of(self.pair, mapping)

    @property
    def reduced_scale(self) -> PixelScale:
        """(x, y) of the reduced images relative to the fixed image."""
        return self.pair.reference.seed_scale

    def reduced_spectra(self) -> tuple[Field, Field]:
        """Windowed spectra (height, width) of the structure of the reduced fixed image, and of the moving image."""
        small = shrink(self.warped, self.pair.reference.seed_size_px)
        return self.pair.reference.seed_spectrum, windowed_spectra(structure_field(small))

    def is_expected(self, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """True where the pair's candidates expect the mapping after a shift (x, y), px of the fixed image."""
        return self.pair.is_expected(self.mapping.fixed_to_moving, shift_px)

    def issues(self, joint: JointResult[FixedImagePx]) -> tuple[Issue, ...]:
        """Of the result that this mapping is from."""
        file_px = self.pair.file_px
        return issues_of(Evidence(joint, self.residual, self.pair.fixed.size_px, images=self, file_px=file_px))


def _residual_of(pair: BandPair, mapping: PixelMapping, warped: Raster) -> Residual[FixedImagePx]:
    """The residual of the windows; of smaller ones where the usual ones do not fit into some quarter of the common
    frame, and the smaller ones show more quarters.
    """
    size_px = pair.fixed.size_px
    residual = pair.reference.windows.residuals(warped)
    in_frame_px = points_in_frame(mapping, size_px, pair.moving_image.size_px)
    if not unobserved_quarters(residual.centres_px, size_px, in_frame_px):
        return residual
    smaller = pair.reference.small_windows.residuals(warped)
    counts = [len(unobserved_quarters(r.measured_px, size_px, in_frame_px)) for r in (residual, smaller)]
    return smaller if counts[1] < counts[0] else residual


def verified(
    pair: BandPair,
    seed: Seed,
    result: JointResult[FixedImagePx] | Issue,
    settings: Settings,
    warped_pair: WarpedPair | None = None,
) -> Alignment[FixedImagePx]:
    """The alignment with its status, px of the images. A result with issues leaves the seed.

    `warped_pair` is the pair under a mapping that may be close to the result's: it saves measuring again.
    """
    joint: JointResult[FixedImagePx] | None = None
    local: DisplacementResult[FixedImagePx] | None = None
    issues: tuple[Issue, ...] = ()
    is_displaced = False
    if isinstance(result, JointResult):
        joint = _snapped(result, pair)
        mapping = pair.mapping(joint.fixed_to_moving)
        warped_pair = WarpedPair.of(pair, mapping) if warped_pair is None else warped_pair.under(mapping)
        warped_pair, issues, local = _verified(warped_pair, joint, settings.relief.use)
        is_displaced = local is not None and local.field is not None
    else:
        issues = (result,)
    if warped_pair is None or (issues and not is_displaced):
        warped_pair = WarpedPair.of(pair, pair.mapping(seed.fixed_to_moving))
    usable = seed.trusted or settings.seed.only
    status = status_of(issues, warped_pair.residual, seed=usable)
    if usable and issues and not is_displaced and not seed_fits(warped_pair.residual):
        issues = (*issues, Issue(SEED_DOES_NOT_FIT))
    alignment = Alignment(
        warped_pair.mapping.fixed_to_moving, pair.space, status, issues, seed, joint, warped_pair.residual, 0.0,
        local=local, field=warped_pair.mapping.local,
    )  # fmt: skip
    return _predicted_by_windows(alignment, pair) if issues and is_displaced else alignment


def _predicted_by_windows(alignment: Alignment[FixedImagePx], pair: BandPair) -> Alignment[FixedImagePx]:
    """An alignment by a displacement field that misses too many of the windows left out of its fit: far better than
    the seed, with the error that these windows show.
    """
    assert alignment.residual is not None
    lengths = np.linalg.norm(alignment.residual.shifts_px, axis=1)
    std_px = FixedImagePx(np.sqrt(np.nanmean(lengths**2)))
    matrix = alignment.fixed_to_moving
    prediction = Prediction(pair.scales.between_files(matrix), "windows", pair.in_moving_file_px(std_px, matrix))
    return replace(alignment, status="predicted", prediction=prediction)


def _verified(
    warped_pair: WarpedPair, joint: JointResult[FixedImagePx], use: ReliefUse
) -> tuple[WarpedPair, tuple[Issue, ...], DisplacementResult[FixedImagePx] | None]:
    """(the pair under the result, with a displacement field where one is wanted and helps; its issues; the field)."""
    issues = warped_pair.issues(joint)
    if not _is_field_wanted(use, issues, rig_known=warped_pair.pair.is_known_to_a_rig):
        return warped_pair, issues, None
    coarse = _with_displacements(warped_pair, joint)
    if coarse.passes or not issues:
        return coarse.instead_of(warped_pair, issues)
    # Close neighbours at different heights, such as the leaves of large plants, need a finer field.
    fine = _with_displacements(warped_pair, joint, finer=True)
    better = fine if fine.passes or fine.p95_px < coarse.p95_px else coarse
    return better.instead_of(warped_pair, issues)


def _is_field_wanted(use: ReliefUse, issues: tuple[Issue, ...], *, rig_known: bool) -> bool:
    """True where a displacement field is to be tried for a result with these issues.

    `auto` tries one where parallax may be the only issue, and where no rig knows the distortion that the lenses leave.
    """
    mendable = all(issue.kind in _MENDABLE for issue in issues)
    return mendable and (use == "always" or (use == "auto" and (bool(issues) or not rig_known)))


@dataclass(frozen=True)
class _Displaced:
    """A pair with a displacement field over its mapping, after verification."""

    local: DisplacementResult[FixedImagePx]
    pair: WarpedPair | None = None
    """With the residual of the windows held out; None without a field, or where checks fail that no field mends."""
    issues: tuple[Issue, ...] = ()
    """Of the windows held out."""

    @property
    def passes(self) -> bool:
        return self.pair is not None and not self.issues

    @property
    def p95_px(self) -> FixedImagePx:
        return FixedImagePx(math.inf) if self.pair is None else self.pair.residual.p95_px

    def instead_of(
        self, plane: WarpedPair, issues: tuple[Issue, ...]
    ) -> tuple[WarpedPair, tuple[Issue, ...], DisplacementResult[FixedImagePx]]:
        """With the field where it helps; a pair that passes without one takes only a field that passes too."""
        if self.pair is None or (self.issues and not issues):
            return plane, issues, replace(self.local, field=None)
        return self.pair, self.issues, self.local


def _with_displacements(
    warped_pair: WarpedPair, joint: JointResult[FixedImagePx], *, finer: bool = False
) -> _Displaced:
    """A pair with a displacement field over its mapping."""
    pair, mapping = warped_pair.pair, warped_pair.mapping
    estimator = pair.reference.finer_local if finer else pair.reference.local
    local = estimator.refine(channel_mean(pair.moving_image), mapping, verify=True)
    if local.field is None:
        return _Displaced(local)
    displaced = WarpedPair.of(pair, replace(mapping, local=local.field))
    held_out = displaced if local.held_out is None else replace(displaced, residual=local.held_out)
    # All checks run again, and those of windows also on windows that the field was not fitted to.
    issues = held_out.issues(joint)
    if displaced.issues(joint) or any(issue.kind not in _MENDABLE for issue in issues):
        return _Displaced(local)
    return _Displaced(local, held_out, issues)


def as_predicted(alignment: Alignment[FixedImagePx], pair: BandPair, prediction: Prediction) -> Alignment[FixedImagePx]:
    """The alignment of a pair by its rig's prediction: px of the images, of the files for the prediction itself."""
    fixed_to_moving = pair.scales.between_images(prediction.fixed_to_moving)
    residual = WarpedPair.of(pair, pair.mapping(fixed_to_moving)).residual
    return replace(
        alignment, fixed_to_moving=fixed_to_moving, status="predicted", residual=residual, local=None,
        field=pair.field, prediction=prediction,
    )  # fmt: skip


def with_metrics(alignment: Alignment[FixedImagePx], pair: BandPair) -> Alignment[FixedImagePx]:
    """The alignment with the similarity of the two images before, with outer edges coinciding, and after."""
    similarity = pair.reference.similarity
    before = pair.warped_moving(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    after = pair.warped_moving(pair.mapping(alignment.fixed_to_moving, alignment.field, alignment.parallax))
    return replace(alignment, before=similarity.to(before), after=similarity.to(after))


def _snapped(joint: JointResult[FixedImagePx], pair: BandPair) -> JointResult[FixedImagePx]:
    """The result, or the mapping that the files came with where it does not differ from that."""
    for given in (pair.candidates[kind] for kind in _UNCHANGED if kind in pair.candidates):
        if pair.mapping(given).is_curved:
            continue  # a lens is to be corrected: the files are not aligned as they are
        if is_unchanged(joint, given, pair.fixed.size_px, max(pair.scales.fixed)):
            return replace(joint, fixed_to_moving=given)
    return joint
