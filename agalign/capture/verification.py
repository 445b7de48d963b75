"""A pair's alignment with everything that speaks for and against it, measured on the images laid on each other."""

import math
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.config import CheckSettings, Settings
from agalign.pixels.grey import channel_mean
from agalign.pixels.resample import shrink
from agalign.pixels.structure import structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Alignment, DisplacementResult, JointResult, Prediction, Residual, Seed
from agalign.values.choices import SeedKind, Space
from agalign.values.image import Raster
from agalign.values.issues import Issue
from agalign.values.mapping import PixelMapping
from agalign.verify.acceptance import is_as_it_was, issues_of, seed_fits, status_of
from agalign.verify.repetition import alias_peak
from agalign.verify.residuals import residual_under

_AS_FILES_LIE: tuple[SeedKind, ...] = ("geo", "identity")
"""Seeds that change nothing: an input aligned already is left untouched, not resampled by a hundredth of a pixel."""

_ALL_BUT_EQUAL_PX = 0.15
"""Mappings no farther apart leave shifts that differ by that, to a hundredth of a px: what interpolation does to the
windows' shifts is a tenth to a quarter of how far they lie from whole pixels."""


def without_result(seed: Seed, space: Space, issue: Issue) -> Alignment:
    """The failed alignment of a pair that could not be tried."""
    return Alignment(seed.fixed_to_moving, space, "failed", (issue,), seed, None, None, 0.0)


@dataclass(frozen=True)
class WarpedPair:
    """A pair laid on each other by a mapping, and what its windows show there."""

    pair: BandPair
    mapping: PixelMapping
    warped: Raster
    """The moving image, one channel, on the reference's pixels."""
    residual: Residual

    @classmethod
    def at(cls, pair: BandPair, mapping: PixelMapping) -> "WarpedPair":
        """Laid now."""
        warped = pair.warped_moving(mapping)
        return cls(pair, mapping, warped, pair.reference.windows.residuals(warped))

    def under(self, mapping: PixelMapping) -> "WarpedPair":
        """Under another mapping: where the two are all but equal, without looking again."""
        if mapping.local is self.mapping.local:
            corners = geometry.corners(*self.pair.fixed.size_px)
            apart_px = float(np.linalg.norm(mapping(corners) - self.mapping(corners), axis=1).max())
            if apart_px <= _ALL_BUT_EQUAL_PX:
                return replace(self, mapping=mapping, residual=residual_under(self.residual, self.mapping, mapping))
        return WarpedPair.at(self.pair, mapping)


def verified(
    pair: BandPair, seed: Seed, result: JointResult | Issue, settings: Settings, warped_pair: WarpedPair | None = None
) -> Alignment:
    """The alignment with its verdict, px of the images. A result that is doubted leaves the seed.

    `look` is one at the pair under a mapping that may be near the result's.
    """
    check, size_px = settings.check, pair.fixed.size_px
    joint: JointResult | None = None
    local: DisplacementResult | None = None
    issues: tuple[Issue, ...] = (result,) if isinstance(result, Issue) else ()
    if isinstance(result, JointResult):
        joint = _snapped(result, pair, check)
        results = pair.mapping(joint.fixed_to_moving)
        warped_pair = WarpedPair.at(pair, results) if warped_pair is None else warped_pair.under(results)
        issues = issues_of(joint, warped_pair.residual, size_px, check) or _repetition(joint, warped_pair, check)
        if settings.local.is_wanted_for(issues, rig_known=pair.is_known_to_a_rig):
            local, displaced = _with_displacements(pair, joint, results, check)
            if displaced is None and issues:
                # What stands close together, such as the leaves of large plants, needs a finer field.
                local, displaced = _with_displacements(pair, joint, results, check, finer=True)
            if displaced is not None:
                warped_pair, issues = displaced, ()
    if warped_pair is None or issues:
        warped_pair = WarpedPair.at(pair, pair.mapping(seed.fixed_to_moving))
    usable = seed.trusted or settings.seed.only
    status = status_of(issues, warped_pair.residual, check, seed=usable)
    if usable and issues and not seed_fits(warped_pair.residual, check):
        issues = (*issues, Issue("seed_does_not_fit"))
    return Alignment(
        warped_pair.mapping.fixed_to_moving, pair.space, status, issues, seed, joint, warped_pair.residual, 0.0,
        local=local, field=warped_pair.mapping.local,
    )  # fmt: skip


def _with_displacements(
    pair: BandPair, joint: JointResult, result: PixelMapping, check: CheckSettings, *, finer: bool = False
) -> tuple[DisplacementResult, WarpedPair | None]:
    """A field of displacements over a mapping, and the pair under it where nothing speaks against that."""
    refiner = pair.reference.finer_local if finer else pair.reference.local
    local = refiner.refine(channel_mean(pair.moving_image), result)
    if local.field is None:
        return local, None
    displaced = WarpedPair.at(pair, replace(result, local=local.field))
    # The verdict is asked again: what a field makes worse, or no better, is not aligned by it.
    if issues_of(joint, displaced.residual, pair.fixed.size_px, check) or _repetition(joint, displaced, check):
        return replace(local, field=None), None
    return local, displaced


def as_predicted(alignment: Alignment, pair: BandPair, prediction: Prediction) -> Alignment:
    """The alignment of a pair whose own images do not say where it lies, by what the rig says, px of the images."""
    residual = WarpedPair.at(pair, pair.mapping(prediction.fixed_to_moving)).residual
    return replace(
        alignment, fixed_to_moving=prediction.fixed_to_moving, status="predicted", residual=residual, local=None,
        field=pair.field, prediction=prediction,
    )  # fmt: skip


def with_metrics(alignment: Alignment, pair: BandPair) -> Alignment:
    """The alignment with how alike the two images are before, as their files lie, and after."""
    similarity = pair.reference.similarity
    before = pair.warped_moving(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    after = pair.warped_moving(pair.mapping(alignment.fixed_to_moving, alignment.field))
    return replace(alignment, before=similarity.to(before), after=similarity.to(after))


def _repetition(joint: JointResult, warped_pair: WarpedPair, check: CheckSettings) -> tuple[Issue, ...]:
    """A doubt where another place fits nearly as well and nothing that was known beforehand rules it out."""
    pair = warped_pair.pair
    small = shrink(warped_pair.warped, pair.reference.seed_size_px)
    spectrum = windowed_spectra(structure_field(small, pair.reference.settings.seed.smoothing_px))
    rival = alias_peak(pair.reference.seed_spectrum, spectrum)
    if rival.share <= check.max_alias_peak:
        return ()
    x, y = (s / scale for s, scale in zip(rival.shift_px, pair.reference.seed_scale, strict=True))
    if pair.is_expected(joint.fixed_to_moving) and not pair.is_expected(joint.fixed_to_moving, (x, y)):
        return ()
    return (Issue("repeats", math.hypot(x, y)),)


def _snapped(joint: JointResult, pair: BandPair, settings: CheckSettings) -> JointResult:
    for given in (pair.candidates[kind] for kind in _AS_FILES_LIE if kind in pair.candidates):
        if pair.mapping(given).is_curved:
            continue  # the files do not lie that way
        if is_as_it_was(joint, given, pair.fixed.size_px, settings, max(pair.scales[0])):
            return replace(joint, fixed_to_moving=given)
    return joint
