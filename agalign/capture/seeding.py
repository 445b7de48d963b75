"""Where a pair's alignment starts: candidates scored on the images, the best kept; and the method's subject of it."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair, Candidates
from agalign.capture.corner_fit import fit_corners
from agalign.capture.verification import WarpedPair
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.flight.model import FlightModel
from agalign.method.descriptor import Descriptor
from agalign.method.match import match_seed, starter_for_matching
from agalign.method.state import ImageGroup
from agalign.pixels.grey import channel_mean
from agalign.pixels.landmarks import LANDMARK_INPUTS, agreed_homography, landmarks
from agalign.pixels.resample import textured, warped
from agalign.pixels.structure import correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.values import geometry, lens
from agalign.values.alignment import Residual, Seed
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.issues import Issue
from agalign.verify.acceptance import seed_fits

_PLAIN_SIGMA = 120.0
"""A peak that only images reach which lie on each other everywhere: turned by one degree they have one of 60 to 120, by
three degrees of 17."""
_CLOSE_PX = 3.0
"""Where nearly all windows lie this close under a match, no better one is looked for."""
_MIN_WINDOWS = 12
_MAX_TURN_DEGREES, _MAX_SCALE = 1.0, 0.02
"""By which a band may lie otherwise than a rig has it."""
_MAX_KEYPOINTS = 1000
"""Where learnt descriptors are the last resort."""
_SAME_PEAK_PX = 2.0
"""A candidate no farther from the peak than this, in working px, is on its flank."""


def find_seed(pair: BandPair, model: FlightModel | None = None) -> Seed | Issue:
    """The best seed of a pair, or why it can have none. `model` is the network that a `match` is found with."""
    if not pair.reference.is_textured:
        return Issue("blank_reference")
    if not textured(pair.moving):
        return Issue("blank_moving")
    candidates = pair.candidates
    if _forced_kind(pair) == "match":
        result = match_seed(_network(pair, model), pair.fixed, pair.moving)
        if result is None:
            return Issue("no_such_seed", detail="match")
        candidates = {"match": result}
    best = best_seed(pair, candidates)
    if best.score >= _PLAIN_SIGMA or _is_known(pair):
        return best
    shown = _windows_under(pair, best)
    # Tags that a peak agrees with say no more of the middle than of the corners: the windows do.
    expected = best.trusted and pair.is_expected(best.fixed_to_moving)
    if expected and seed_fits(shown, pair.reference.settings.check):
        return best
    for result in _matched(pair, model, by_learnt_descriptors=not best.trusted):
        there = _windows_under(pair, matched := _at_its_place(pair, result))
        sharpened = _sharpened(pair, result, there)
        if sharpened is not None:
            again = _windows_under(pair, other := _at_its_place(pair, sharpened))
            if again.is_better_than(there):
                matched, there = other, again
        if seed_fits(there, pair.reference.settings.check) and there.is_better_than(shown):
            best, shown = replace(matched, trusted=True), there
        if best.kind == "match" and shown.p95_px <= _CLOSE_PX:
            break
    return best


def find_rotated(pair: BandPair, fixed_to_moving: Matrix, under: Residual) -> Matrix | None:
    """A mapping that landmarks of both images agree on, and their windows better than `under` the one that is given,
    and that is turned or scaled beside it, as no rigid camera's bands are; None where there is none. One that is merely
    shifted may be a scene that repeats.
    """
    if seed_fits(under, pair.reference.settings.check):
        return None
    for result in _matched(pair, None, by_learnt_descriptors=False):
        there = WarpedPair.at(pair, pair.mapping(result)).residual
        fits = seed_fits(there, pair.reference.settings.check) and there.is_better_than(under)
        if fits and _is_rotated_or_scaled(
            geometry.compose(geometry.invert(fixed_to_moving), result), pair.fixed.size_px
        ):
            return result
    return None


def _is_rotated_or_scaled(matrix: Matrix, size_px: tuple[int, int]) -> bool:
    """By what a homography does to a step right and a step down in the middle of the image."""
    middle = (np.array(size_px) - 1) / 2
    here, right, down = geometry.apply(matrix, middle + np.array([(0, 0), (1, 0), (0, 1)]))
    angle = np.degrees(np.arctan2(*(right - here)[::-1]))
    scale = np.sqrt(abs(np.linalg.det([right - here, down - here])))
    return bool(abs(angle) > _MAX_TURN_DEGREES or abs(scale - 1) > _MAX_SCALE)


def _sharpened(pair: BandPair, fixed_to_moving: Matrix, shown: Residual) -> Matrix | None:
    """A mapping moved to where most of the windows have it; None where they are few."""
    known = np.isfinite(shown.shifts_px[:, 0])
    if known.sum() < _MIN_WINDOWS:
        return None
    at, there = (
        lens.undistort(pair.fixed.lens, p[known]) for p in (shown.centres_px, shown.centres_px + shown.shifts_px)
    )
    fit = fit_corners(at, there - at, shown.peaks_sigma[known], pair.fixed.size_px)
    try:
        return geometry.compose(fixed_to_moving, geometry.moving_corners(fit.mean_px, *pair.fixed.size_px))
    except GeometryError:
        return None


def _is_known(pair: BandPair) -> bool:
    """True where it is told, by the flight or by the user, where a pair lies: what is found elsewhere is wrong."""
    return _forced_kind(pair) is not None or pair.is_known_to_a_rig or "user" in pair.candidates


def _forced_kind(pair: BandPair) -> SeedKind | None:
    """The only kind of seed to be used. It is for the captures that a flight is learned from: the others start from
    the flight's own mapping.
    """
    return None if "model" in pair.candidates else pair.reference.settings.seed.force


def _matched(pair: BandPair, model: FlightModel | None, *, by_learnt_descriptors: bool) -> Iterator[Matrix]:
    """Mappings, however turned, scaled or far apart, that landmarks or learnt descriptors of both images agree on."""
    for source in LANDMARK_INPUTS:
        here = pair.reference.landmarks(source).undistorted(pair.fixed.lens)
        there = landmarks(pair.moving, source).undistorted(pair.moving.lens)
        result = agreed_homography(here, there, pair.fixed.size_px)
        if result is not None:
            yield result
    if by_learnt_descriptors:
        result = match_seed(_network(pair, model), pair.fixed, pair.moving, _MAX_KEYPOINTS)
        if result is not None:
            yield result


def _windows_under(pair: BandPair, seed: Seed) -> Residual:
    return WarpedPair.at(pair, pair.mapping(seed.fixed_to_moving)).residual


def _network(pair: BandPair, model: FlightModel | None) -> Descriptor:
    channels = pair.fixed.channels, pair.moving.channels
    return starter_for_matching(channels) if model is None else model.matching_network(pair.name, channels)


def image_groups(
    pairs: Sequence[BandPair], seeds: Sequence[Seed], sides: Sequence[int] = ()
) -> list[tuple[list[int], ImageGroup]]:
    """What the method works on: the pairs of a capture that see one image of the reference in one space, with their
    seeds and the network's side for each, by default counted; and which of the pairs those are.
    """
    groups: dict[tuple[int, Space], list[int]] = {}
    for place, pair in enumerate(pairs):
        groups.setdefault((id(pair.reference), pair.space), []).append(place)
    return [
        (
            places,
            _subject([pairs[i] for i in places], [seeds[i] for i in places],
                     [sides[i] for i in places] if sides else range(1, len(places) + 1)),
        )
        for places in groups.values()
    ]  # fmt: skip


def _subject(pairs: Sequence[BandPair], seeds: Sequence[Seed], sides: Sequence[int]) -> ImageGroup:
    mappings = [s.fixed_to_moving for s in seeds]
    fields = [p.field for p in pairs]
    return ImageGroup(
        pairs[0].fixed, [p.moving for p in pairs], mappings, sides, [s.trusted for s in seeds],
        [p.reach_px for p in pairs], fields=fields if any(f is not None for f in fields) else (),
    )  # fmt: skip


def best_seed(pair: BandPair, candidates: Candidates) -> Seed:
    """The candidate under which the structures agree best, or one shifted onto the peak of their correlation.

    Each is scored at no shift and at its best shift; a candidate whose best shift is below `min_shift_px` stays as it
    is. Where the flight's own mapping leaves no doubt, the others are not looked at.
    """
    scored: list[Seed] = []
    for kind, matrix in candidates.items():
        scored += _scored(pair, kind, matrix)
        best = max(scored, key=lambda seed: seed.score)
        if kind == "model" and best.trusted:
            return best
    forced = [s for s in scored if s.kind == _forced_kind(pair)]
    return max(forced or scored, key=lambda seed: seed.score)


def _at_its_place(pair: BandPair, fixed_to_moving: Matrix) -> Seed:
    """A match as it is, with what the structures say of it."""
    return _scored(pair, "match", fixed_to_moving)[0]


def _scored(pair: BandPair, kind: SeedKind, fixed_to_moving: Matrix) -> list[Seed]:
    """The candidate itself first and, where the structures agree better a shift away, its `structure` variant.

    On a sliver of common area the peak of the correlation means nothing: such a candidate scores 0.
    """
    reference, settings = pair.reference, pair.reference.settings.seed
    size, scale = reference.seed_size_px, reference.seed_scale
    small_moving = warped(channel_mean(pair.moving), pair.mapping(fixed_to_moving), size, scale)
    if small_moving.valid.mean() < settings.min_overlap:
        return [Seed(kind, fixed_to_moving, 0.0)]
    spectrum = windowed_spectra(structure_field(small_moving, settings.smoothing_px))
    surface = correlation_surfaces(reference.seed_spectrum, spectrum)
    # Where a candidate's place is known to some px, a period farther away is another place.
    within_px = max(_SAME_PEAK_PX, pair.reach_px * max(scale)) if kind == "user" else np.inf
    peak = find_peak(surface, apart_px=max(size) // 16, within_px=within_px)

    def seed(kind: SeedKind, matrix: Matrix, sigma: float, rival: float) -> Seed:
        return Seed(kind, matrix, sigma, sigma, rival, _is_unambiguous(sigma, rival, settings))

    if np.hypot(*peak.shift_px) < settings.min_shift_px:
        return [seed(kind, fixed_to_moving, peak.sigma, peak.runner_up_sigma)]
    shift = geometry.translation(peak.shift_px[0] / scale[0], peak.shift_px[1] / scale[1])
    shifted = geometry.compose(fixed_to_moving, shift)
    # Where the peak is another place, it is what this candidate has to stand up to.
    rival = peak.sigma if np.hypot(*peak.shift_px) > _SAME_PEAK_PX else peak.runner_up_sigma
    unmoved = seed(kind, fixed_to_moving, peak.sigma_at_zero, rival)
    # The correlation is circular: its peak may lay the images beside each other.
    points = pair.mapping(shifted)(geometry.lattice(*pair.fixed.size_px, 16, 12))
    within = ((points >= 0) & (points <= np.subtract(pair.moving.size_px, 1))).all(axis=1)
    if within.mean() < settings.min_overlap:
        return [unmoved]
    return [unmoved, seed("structure", shifted, peak.sigma, peak.runner_up_sigma)]


def _is_unambiguous(sigma: float, rival: float, settings: SeedSettings) -> bool:
    return sigma >= max(settings.trusted_sigma, settings.trusted_ratio * rival)


def unscored(pair: BandPair) -> Seed:
    """The first candidate, where none can be scored."""
    kind, matrix = next(iter(pair.candidates.items()))
    return Seed(kind, matrix, 0.0)
