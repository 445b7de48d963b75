"""A pair's alignment with everything that speaks for and against it, measured on the images laid on each other."""

import math
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.config import CheckSettings, Settings
from agalign.judge.repeats import rival_of
from agalign.judge.residuals import moved
from agalign.judge.verdict import doubts_of, is_as_it_was, seed_fits, status_of
from agalign.pixels.resample import shrink, single
from agalign.pixels.structure import structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, LocalResult, Prediction, Residual, Seed
from agalign.values.choices import SeedKind, Space
from agalign.values.doubts import Doubt
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

_AS_FILES_LIE: tuple[SeedKind, ...] = ("geo", "identity")
"""Seeds that change nothing: an input aligned already is left untouched, not resampled by a hundredth of a pixel."""

_ALL_BUT_EQUAL_PX = 0.15
"""Mappings no farther apart leave shifts that differ by that, to a hundredth of a px: what interpolation does to the
windows' shifts is a tenth to a quarter of how far they lie from whole pixels."""


def without_result(seed: Seed, space: Space, doubt: Doubt) -> Alignment:
    """The failed alignment of a pair that could not be tried."""
    return Alignment(seed.fixed_to_moving, space, "failed", (doubt,), seed, None, None, 0.0)


@dataclass(frozen=True)
class Look:
    """A pair laid on each other by a mapping, and what its windows show there."""

    pair: BandPair
    mapping: PixelMapping
    there: Raster
    """The moving image, one channel, on the reference's pixels."""
    residual: Residual

    @classmethod
    def at(cls, pair: BandPair, mapping: PixelMapping) -> "Look":
        """Laid now."""
        there = pair.laid(mapping)
        return cls(pair, mapping, there, pair.reference.windows.residuals(there))

    def under(self, mapping: PixelMapping) -> "Look":
        """Under another mapping: where the two are all but equal, without looking again."""
        if mapping.local is self.mapping.local:
            corners = geometry.corners(*self.pair.fixed.size_px)
            apart_px = float(np.linalg.norm(mapping(corners) - self.mapping(corners), axis=1).max())
            if apart_px <= _ALL_BUT_EQUAL_PX:
                return replace(self, mapping=mapping, residual=moved(self.residual, self.mapping, mapping))
        return Look.at(self.pair, mapping)


def judged(
    pair: BandPair, seed: Seed, result: JointResult | Doubt, settings: Settings, look: Look | None = None
) -> Alignment:
    """The alignment with its verdict, px of the images. A result that is doubted leaves the seed.

    `look` is one at the pair under a mapping that may be near the result's.
    """
    check, size_px = settings.check, pair.fixed.size_px
    joint: JointResult | None = None
    local: LocalResult | None = None
    doubts: tuple[Doubt, ...] = (result,) if isinstance(result, Doubt) else ()
    if isinstance(result, JointResult):
        joint = _snapped(result, pair, check)
        found = pair.mapping(joint.fixed_to_moving)
        look = Look.at(pair, found) if look is None else look.under(found)
        doubts = doubts_of(joint, look.residual, size_px, check) or _repeats(joint, look, check)
        if settings.local.is_wanted_for(doubts, rig_known=pair.is_known_to_a_rig):
            local, bent = _bent(pair, joint, found, check)
            if bent is None and doubts:
                # What stands close together, such as the leaves of large plants, needs a finer field.
                local, bent = _bent(pair, joint, found, check, finer=True)
            if bent is not None:
                look, doubts = bent, ()
    if look is None or doubts:
        look = Look.at(pair, pair.mapping(seed.fixed_to_moving))
    usable = seed.trusted or settings.seed.only
    status = status_of(doubts, look.residual, check, seed=usable)
    if usable and doubts and not seed_fits(look.residual, check):
        doubts = (*doubts, Doubt("seed_does_not_fit"))
    return Alignment(
        look.mapping.fixed_to_moving, pair.space, status, doubts, seed, joint, look.residual, 0.0, local=local,
        field=look.mapping.local,
    )  # fmt: skip


def _bent(
    pair: BandPair, joint: JointResult, found: PixelMapping, check: CheckSettings, *, finer: bool = False
) -> tuple[LocalResult, Look | None]:
    """A field of displacements over a mapping, and the pair under it where nothing speaks against that."""
    refiner = pair.reference.finer_local if finer else pair.reference.local
    local = refiner.refine(single(pair.moving_image), found)
    if local.field is None:
        return local, None
    bent = Look.at(pair, replace(found, local=local.field))
    # The verdict is asked again: what a field makes worse, or no better, is not aligned by it.
    if doubts_of(joint, bent.residual, pair.fixed.size_px, check) or _repeats(joint, bent, check):
        return replace(local, field=None), None
    return local, bent


def as_predicted(alignment: Alignment, pair: BandPair, prediction: Prediction) -> Alignment:
    """The alignment of a pair whose own images do not say where it lies, by what the rig says, px of the images."""
    residual = Look.at(pair, pair.mapping(prediction.fixed_to_moving)).residual
    return replace(
        alignment, fixed_to_moving=prediction.fixed_to_moving, status="predicted", residual=residual, local=None,
        field=pair.field, prediction=prediction,
    )  # fmt: skip


def with_metrics(alignment: Alignment, pair: BandPair) -> Alignment:
    """The alignment with how alike the two images are before, as their files lie, and after."""
    similarity = pair.reference.similarity
    before = pair.laid(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    after = pair.laid(pair.mapping(alignment.fixed_to_moving, alignment.field))
    return replace(alignment, before=similarity.to(before), after=similarity.to(after))


def _repeats(joint: JointResult, look: Look, check: CheckSettings) -> tuple[Doubt, ...]:
    """A doubt where another place fits nearly as well and nothing that was known beforehand rules it out."""
    pair = look.pair
    small = shrink(look.there, pair.reference.seed_size_px)
    spectrum = windowed_spectra(structure_field(small, pair.reference.settings.seed.smoothing_px))
    rival = rival_of(pair.reference.seed_spectrum, spectrum)
    if rival.share <= check.most_rival:
        return ()
    x, y = (s / scale for s, scale in zip(rival.shift_px, pair.reference.seed_scale, strict=True))
    if pair.is_expected(joint.fixed_to_moving) and not pair.is_expected(joint.fixed_to_moving, (x, y)):
        return ()
    return (Doubt("repeats", math.hypot(x, y)),)


def _snapped(joint: JointResult, pair: BandPair, settings: CheckSettings) -> JointResult:
    for given in (pair.candidates[kind] for kind in _AS_FILES_LIE if kind in pair.candidates):
        if pair.mapping(given).bends:
            continue  # the files do not lie that way
        if is_as_it_was(joint, given, pair.fixed.size_px, settings, max(pair.scales[0])):
            return replace(joint, fixed_to_moving=given)
    return joint
