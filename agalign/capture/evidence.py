"""A pair's alignment with everything that speaks for and against it, measured on the images laid on each other."""

import math
from dataclasses import replace

from agalign.capture.band_pair import BandPair
from agalign.config import CheckSettings, Settings
from agalign.judge.repeats import rival_of
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


def without_result(seed: Seed, space: Space, doubt: Doubt) -> Alignment:
    """The failed alignment of a pair that could not be tried."""
    return Alignment(seed.fixed_to_moving, space, "failed", (doubt,), seed, None, None, 0.0)


def judged(pair: BandPair, seed: Seed, result: JointResult | Doubt, settings: Settings) -> Alignment:
    """The alignment with its verdict and metrics, px of the images. A result that is doubted leaves the seed."""
    check, size_px = settings.check, pair.fixed.size_px
    joint: JointResult | None = None
    local: LocalResult | None = None
    doubts: tuple[Doubt, ...] = (result,) if isinstance(result, Doubt) else ()
    mapping = pair.mapping(seed.fixed_to_moving)
    if isinstance(result, JointResult):
        joint = _snapped(result, pair, check)
        found = pair.mapping(joint.fixed_to_moving)
        there, residual = _laid(pair, found)
        doubts = doubts_of(joint, residual, size_px, check) or _repeats(pair, joint, there, check)
        if settings.local.is_wanted_for(doubts, rig_known=pair.is_known_to_a_rig):
            local = pair.reference.local.refine(single(pair.moving_image), found)
            if local.field is not None:
                bent = replace(found, local=local.field)
                laid, left = _laid(pair, bent)
                still = doubts_of(joint, left, size_px, check) or _repeats(pair, joint, laid, check)
                # The verdict is asked again: what a field makes worse, or no better, is not aligned by it.
                if still:
                    local = LocalResult(None, local.before_p95_px, local.after_p95_px)
                else:
                    there, residual, found, doubts = laid, left, bent, ()
        mapping = mapping if doubts else found
    if doubts:
        there, residual = _laid(pair, mapping)
    usable = seed.trusted or settings.seed.only
    status = status_of(doubts, residual, check, seed=usable)
    if usable and doubts and not seed_fits(residual, check):
        doubts = (*doubts, Doubt("seed_does_not_fit"))
    alignment = Alignment(
        mapping.fixed_to_moving, pair.space, status, doubts, seed, joint, residual, 0.0, local=local,
        field=mapping.local,
    )  # fmt: skip
    return _with_metrics(alignment, pair, there)


def windows_under(pair: BandPair, joint: JointResult) -> Residual:
    """The shifts that the windows of a pair show under a result."""
    return _laid(pair, pair.mapping(joint.fixed_to_moving))[1]


def as_predicted(alignment: Alignment, pair: BandPair, prediction: Prediction) -> Alignment:
    """The alignment of a pair whose own images do not say where it lies, by what the rig says, px of the images."""
    there, residual = _laid(pair, pair.mapping(prediction.fixed_to_moving))
    moved = replace(
        alignment, fixed_to_moving=prediction.fixed_to_moving, status="predicted", residual=residual, local=None,
        field=pair.field, prediction=prediction,
    )  # fmt: skip
    return _with_metrics(moved, pair, there)


def _repeats(pair: BandPair, joint: JointResult, there: Raster, check: CheckSettings) -> tuple[Doubt, ...]:
    """A doubt where another place fits nearly as well and nothing that was known beforehand rules it out."""
    small = shrink(there, pair.reference.seed_size_px)
    spectrum = windowed_spectra(structure_field(small, pair.reference.settings.seed.smoothing_px))
    rival = rival_of(pair.reference.seed_spectrum, spectrum)
    if rival.share <= check.most_rival:
        return ()
    x, y = (s / scale for s, scale in zip(rival.shift_px, pair.reference.seed_scale, strict=True))
    if pair.is_expected(joint.fixed_to_moving) and not pair.is_expected(joint.fixed_to_moving, (x, y)):
        return ()
    return (Doubt("repeats", math.hypot(x, y)),)


def _with_metrics(alignment: Alignment, pair: BandPair, there: Raster) -> Alignment:
    before = pair.laid(PixelMapping(geometry.overlay(pair.fixed.size_px, pair.moving_image.size_px)))
    similarity = pair.reference.similarity
    return replace(alignment, before=similarity.to(before), after=similarity.to(there))


def _laid(pair: BandPair, mapping: PixelMapping) -> tuple[Raster, Residual]:
    there = pair.laid(mapping)
    return there, pair.reference.windows.residuals(there)


def _snapped(joint: JointResult, pair: BandPair, settings: CheckSettings) -> JointResult:
    for given in (pair.candidates[kind] for kind in _AS_FILES_LIE if kind in pair.candidates):
        if pair.mapping(given).bends:
            continue  # the files do not lie that way
        if is_as_it_was(joint, given, pair.fixed.size_px, settings, max(pair.scales[0])):
            return replace(joint, fixed_to_moving=given)
    return joint
