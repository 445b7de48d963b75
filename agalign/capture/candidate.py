"""Candidates: the mappings that a band may get, each with its error and the windows that verify it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agalign.capture.band_pair import BandPair
from agalign.capture.seeding import seed_to_use
from agalign.capture.warped_pair import WarpedPair
from agalign.pixels.band_resampling import channel_mean
from agalign.values.alignment import BY_WINDOWS, JointResult, Seed
from agalign.values.choices import Geometry, ReliefUse, SeedKind
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Raster, Tile
from agalign.values.issues import BY_PARALLAX, OTHER_GEOMETRY, PREDICTED_WITH, SEED_ASKED_FOR, UNREADABLE, Issue
from agalign.values.lens_shapes import CORNERS
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.mapping_error import ErrorOnGrid, MappingError
from agalign.values.residual import Residual, decrease_in_standard_errors
from agalign.verify.checks import is_unchanged, issues_of, seed_fits
from agalign.verify.coverage import pixels_in_frame, points_in_frame


@dataclass(frozen=True)
class Candidate:
    """A mapping that a band may get, px of the images. `decision.decide` chooses one for each band."""

    pair: BandPair
    mapping: PixelMapping
    error: MappingError
    residual: Residual
    """Windows without their own part in the fit, by the rule of `fit.held_out`; descriptors and rig contribute to each
    fit of a homography, and the homography below a displacement field is fitted to all windows. Under a relief, windows
    in other fields than those of the fit, without the displacement field.
    """
    joint: JointResult | None = None
    """Evidence of descriptors or windows; None for a prediction by the rig."""
    images: WarpedPair | None = None
    """The images under the mapping, with the relief of other bands if it has one; None omits checks that use pixels."""
    other_residual: Residual | None = None
    """More windows, which also have to pass the checks: with a displacement field, those of the homography's fit, or of
    the images in which it was fitted."""
    held_out_p95_px: Mapping[Geometry, float] = field(default_factory=dict)
    """p95 of the shifts of held-out windows by each geometry that was fitted; empty if only a homography was. That of a
    field on a relief is under the relief of all bands."""
    refined_from: "Candidate | None" = None
    """The candidate that it refines."""
    given_issues: tuple[Issue, ...] | None = None
    """Its issues, instead of those that the checks find: of an earlier candidate that remain, as windows see a part of
    the image only; none in an observation of the rig, for which some issues do not matter.
    """

    @classmethod
    def of(cls, warped: WarpedPair, joint: JointResult, residual: Residual | None = None) -> "Candidate":
        """Return the candidate with the homography and covariance of a result, and with the mapping of `warped`, whose
        windows verify it unless others are given.
        """
        residual = warped.residual if residual is None else residual
        error = mapping_error(warped.pair, warped.mapping, joint.covariance_px2, residual)
        return cls(warped.pair, warped.mapping, error, residual, joint, warped)

    @cached_property
    def issues(self) -> tuple[Issue, ...]:
        """What the checks find; empty if it passes verification."""
        if self.given_issues is not None:
            return self.given_issues
        issues = self.issues_of_windows or self._issues_of_pixels
        if issues or self.other_residual is None:
            return issues
        return self._issues_by(self.other_residual, replace(self.error, residual=self.other_residual))

    @cached_property
    def issues_of_windows(self) -> tuple[Issue, ...]:
        """What the checks without pixels find by the windows of `residual`."""
        return self._issues_by(self.residual, self.error)

    def _issues_by(self, residual: Residual, error: MappingError) -> tuple[Issue, ...]:
        """What the checks without pixels find by some windows."""
        pixel_px = self.pair.file_pixel_size_px
        return issues_of(self.mapping, error, residual, self.joint, self.common_px, pixel_px)

    @property
    def _issues_of_pixels(self) -> tuple[Issue, ...]:
        """What the checks of pixels find, which are costly."""
        return () if self.images is None else self.images.issues

    @property
    def issues_of_prediction(self) -> tuple[Issue, ...]:
        """Its issues, with those of the pixels also if there are others."""
        pixels = () if self.given_issues is not None else self._issues_of_pixels
        return (*self.issues, *(issue for issue in pixels if issue not in self.issues))

    @property
    def may_predict(self) -> bool:
        """True if the images confirm the mapping, though not everywhere: it predicts the others."""
        found = self.issues_of_prediction if self.given_issues is None else ()
        return all(issue.kind in PREDICTED_WITH for issue in found) and math.isfinite(self.std_px)

    @cached_property
    def std_px(self) -> float:
        """Standard error: the RMS of the expected error over the common area, px of the fixed image."""
        if self.pair.is_georeferenced:
            return self.error.rms_px(self.common_px if len(self.common_px) else self.residual.centres_px)
        size_px = self.pair.fixed.size_px
        is_common = pixels_in_frame(self.mapping, *self.pair.sizes_px)
        if not is_common.any():
            return self.error.rms_px(self.residual.centres_px)
        error_px = ErrorOnGrid.of(self.error, size_px).on_tile(Tile(0, 0, *size_px))[is_common]
        return float(np.sqrt(np.square(error_px).mean(dtype=np.float64)))

    def with_relief_std_px(self, relief_std_px: float) -> "Candidate":
        """Return the candidate with at least this spread of the relief where no window is near, px."""
        relief_std_px = max(relief_std_px, self.error.relief_std_px)
        return replace(self, error=replace(self.error, relief_std_px=relief_std_px))

    @property
    def with_second_layer(self) -> "Candidate":
        """The candidate with at least the RMS shift of a second layer of the images, if they have one, as its error."""
        layer = None if self.images is None or self.given_issues is not None else self.images.second_layer
        lacking_px2 = 0.0 if layer is None else layer.rms_px**2 - self.std_px**2
        if not lacking_px2 > 0:
            return self
        return replace(self, error=replace(self.error, rig_std_px=math.hypot(self.error.rig_std_px, lacking_px2**0.5)))

    @cached_property
    def common_px(self) -> Points:
        """Points (n, 2) of a grid over the reference that the moving image covers."""
        if self.images is not None:
            return self.images.common_px
        if self.refined_from is not None:
            return self.refined_from.common_px
        return points_in_frame(self.mapping, *self.pair.sizes_px)


def mapping_error(
    pair: BandPair,
    mapping: PixelMapping,
    covariance_px2: NDArray[np.float64],
    residual: Residual,
    lens_field: DisplacementField | None = None,
    baseline_std: float = 0.0,
) -> MappingError:
    """Return the error of a mapping that was estimated on the images of a pair.

    Unknown lens shapes are part of it, unless the covariance (12, 12) contains them, and so is the relief of the flight
    if the mapping has none. The displacement field beyond that of the lenses,
    `lens_field`, by default that of the rig, continues by chance where no window is near.
    """
    spread_px, lens_field = 0.0, pair.field if lens_field is None else lens_field
    if mapping.field is not None and residual.is_measured.any():
        displacements_px = mapping.field(residual.measured_px)
        if lens_field is not None:
            displacements_px = displacements_px - lens_field(residual.measured_px)
        spread_px = float(np.sqrt(displacements_px.var(axis=0).sum()))
    return MappingError(
        pair.fixed.size_px,
        covariance_px2,
        residual,
        lens_std_px=pair.unknown_lens_std_px if len(covariance_px2) == CORNERS else None,
        field_std_px=spread_px,
        relief_std_px=0.0 if mapping.parallax is not None else pair.relief_std_px,
        parallax=mapping.parallax,
        baseline_std=baseline_std,
    )


@dataclass(frozen=True)
class RefinedBand:
    """A band with its windows under the result of the joint optimisation, or under its seed.

    After the MAP estimation, `joint` is its result, and the windows are still those under the mapping before it.
    """

    joint: JointResult
    """Without evidence of descriptors, at the seed, if the optimisation has no result."""
    warped: WarpedPair
    by_fold: Sequence[Matrix | None] = ()
    """The homographies without each fold of the windows, by the others, descriptors and rig, None where these determine
    none; empty before the MAP estimation.
    """

    @classmethod
    def of(cls, pair: BandPair, seed: Seed, result: JointResult | Issue) -> "RefinedBand":
        """Measure the windows with the homography of a result, or with the seed if there is none."""
        joint = without_descriptors(seed.fixed_to_moving) if isinstance(result, Issue) else result
        return cls(joint, WarpedPair.of(pair, pair.mapping(joint.fixed_to_moving)))

    @property
    def pair(self) -> BandPair:
        """The pair of the band."""
        return self.warped.pair

    @property
    def verified(self) -> WarpedPair:
        """The images under the result, with the residual of each window under that without its fold."""
        warped = self.warped.with_mapping(self.pair.mapping(self.joint.fixed_to_moving))
        return warped.cross_validated(self.by_fold) if self.by_fold else warped

    def candidates(self, use: ReliefUse) -> Iterator[Candidate]:
        """Yield the homography, then the same with a displacement field if that passes too.

        A field is fitted if parallax may cause all issues of the homography, or if there are none and no rig contains
        the distortion of the lenses; with `use` "always" also if one does, with "never" not at all. With "auto", input
        that is aligned already only gets a field that improves it.
        """
        band = self._unchanged_if_aligned
        joint, verified = band.joint, band.verified
        plane = Candidate.of(verified, joint)
        # Without a rig a field is fitted whatever the costly checks of the pixels find, which check its result too.
        issues = plane.issues if self.pair.is_lens_known else plane.issues_of_windows
        is_wanted = use == "always" or (use == "auto" and (not self.pair.is_lens_known or bool(issues)))
        if is_wanted and all(issue.kind in BY_PARALLAX for issue in issues):
            yield from _with_field(plane, verified, joint, is_aligned_input=use == "auto" and band is not self)
        else:
            yield plane

    @property
    def _unchanged_if_aligned(self) -> "RefinedBand":
        """The band with the mapping given by the files, if its own differs by little.

        Input that is aligned already is returned unchanged instead of resampled by a small shift, which its windows
        and thereby its expected error contain.
        """
        pair, joint = self.pair, self.joint
        kinds: tuple[SeedKind, ...] = ("geo", "identity")
        for given in (pair.seed_matrices[kind] for kind in kinds if kind in pair.seed_matrices):
            if pair.mapping(given).is_curved:
                continue  # with lens distortion the files are not aligned
            if is_unchanged(joint, given, pair.fixed.size_px, max(pair.scales.fixed)):
                return replace(self, joint=replace(joint, fixed_to_moving=given), by_fold=())
        return self

    def warped_moving(self, mapping: PixelMapping) -> Raster:
        """Warp the moving image; under the mapping of `warped`, that is done."""
        return self.warped.warped if mapping is self.warped.mapping else self.pair.warped_moving(mapping)


def _with_field(
    plane: Candidate, warped: WarpedPair, joint: JointResult, *, is_aligned_input: bool
) -> Iterator[Candidate]:
    """Yield the homography with the p95 of both geometries, then the same with a displacement field, verified by
    windows that the field is not fitted to.

    The field is left out if it increases their p95 too much, or if only the homography passes. Input that is aligned
    already, and passes, gets one only if it decreases the shifts by more than chance.
    """
    min_decrease = 4.0  # standard errors, as that of a relief
    pair = plane.pair
    displacement = pair.reference.displacement_field.refine(channel_mean(pair.moving_image), plane.mapping)
    if displacement is None:
        yield plane
        return
    p95_px: dict[Geometry, float] = {"homography": displacement.before.p95_px, "field": displacement.held_out.p95_px}
    yield replace(plane, held_out_p95_px=p95_px)
    decrease = decrease_in_standard_errors(displacement.before, displacement.held_out)
    is_chance = is_aligned_input and not plane.issues and decrease < min_decrease
    if displacement.field is None or is_chance:
        return
    displaced = WarpedPair.of(pair, replace(plane.mapping, field=displacement.field), warped.windows)
    held_out = Candidate.of(displaced, joint, displacement.held_out)
    with_field = replace(held_out, other_residual=displaced.residual, held_out_p95_px=p95_px)
    if not with_field.issues or plane.issues:
        yield with_field


def without_descriptors(fixed_to_moving: Matrix) -> JointResult:
    """Return a result without evidence of descriptors, with an infinite standard error."""
    return JointResult(
        fixed_to_moving,
        loss=math.nan,
        retrieval=0.0,
        chance=0.0,
        iterations=0,
        levels=(1.0,),
        recipe=BY_WINDOWS,
        model_family="homography",
        last_step_px=0.0,
        corner_std_xy_px=((math.inf, math.inf),) * 4,
    )


@dataclass
class BandCandidates:
    """All that the estimators found for a band."""

    pair: BandPair
    found: Seed | Issue
    """The seed with the highest score, at which descriptors start, or another from which they found the band; or why
    there is none."""
    issue: Issue | None = None
    """Why the last optimisation has no result, that the user asked for the seed only, or that pixels are unreadable."""
    candidates: list[Candidate] = field(default_factory=list)
    """Without those under a relief, in the order in which they were made."""
    refined: RefinedBand | None = None
    """The last result of the optimisation, before it is combined with those of other bands and the rig; None before any
    optimisation.
    """

    @cached_property
    def seed(self) -> Seed:
        """The seed of windows and of bands without a result: that of tags or flight if it contradicts the one found."""
        return seed_to_use(self.pair, self.found, is_asked_for=self._is_asked_for)

    def seed_of(self, candidate: Candidate) -> Seed:
        """Return the seed that a candidate was estimated from: descriptors start at the one that was found."""
        estimated = candidate.joint
        if estimated is not None and candidate.mapping.parallax is not None and self.refined is not None:
            estimated = self.refined.joint  # from which the relief was estimated
        is_by_descriptors = estimated is not None and estimated.recipe != BY_WINDOWS
        return self.found if is_by_descriptors and isinstance(self.found, Seed) else self.seed

    @cached_property
    def at_seed(self) -> WarpedPair | None:
        """The images and windows under the seed; None if there is none."""
        if isinstance(self.found, Issue):
            return None
        return WarpedPair.of(self.pair, self.pair.mapping(self.seed.fixed_to_moving))

    @property
    def is_seed_trusted(self) -> bool:
        """True if the seed may be used unchanged, provided that it fits the windows."""
        return not isinstance(self.found, Issue) and (self.seed.trusted or self._is_asked_for)

    @property
    def does_seed_fit(self) -> bool:
        """True if the windows agree with the seed."""
        return self.at_seed is not None and seed_fits(self.at_seed.residual)

    @property
    def is_unreadable(self) -> bool:
        """True if pixels of the band cannot be read, as `issue` says."""
        return self.issue is not None and self.issue.kind == UNREADABLE

    @property
    def accepted(self) -> Candidate | None:
        """The last candidate without issues; None without one."""
        return next((candidate for candidate in reversed(self.candidates) if not candidate.issues), None)

    @property
    def rejected(self) -> tuple[Issue, ...]:
        """Why the last estimate of the images was not accepted; not empty for a band without an accepted one."""
        if isinstance(self.found, Issue):
            return (self.found,)
        if self.issue is not None:
            return (self.issue,)
        # Without any candidate, the band was only under a relief that is not chosen: nothing verifies its seed.
        return self.candidates[-1].issues if self.candidates else (Issue(OTHER_GEOMETRY),)

    @property
    def joint(self) -> JointResult | None:
        """The result of the last candidate: of the optimisation, of windows alone, or of tiles of the files."""
        return self.candidates[-1].joint if self.candidates else None

    @property
    def _is_asked_for(self) -> bool:
        return self.issue is not None and self.issue.kind == SEED_ASKED_FOR
