"""The seed of a pair: candidates from tags, flight and landmarks are scored on the images, and the best one is kept."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair, Candidates
from agalign.capture.corner_fit import corner_correction
from agalign.capture.verification import WarpedPair
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.flight.model import FlightModel
from agalign.method.descriptor import Descriptor
from agalign.method.match import match_seed, starter_for_matching
from agalign.method.state import ImageGroup
from agalign.pixels.grey import channel_mean
from agalign.pixels.landmarks import LANDMARK_INPUTS, landmarks, matched_homography
from agalign.pixels.resample import textured, warped
from agalign.pixels.structure import Peak, correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Residual, Seed
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.issues import BLANK_MOVING, BLANK_REFERENCE, NO_SUCH_SEED, Issue
from agalign.values.pixel_units import FixedImagePx
from agalign.verify.acceptance import seed_fits

_CERTAIN_SIGMA = 120.0
"""Correlation peak that only images reach which agree everywhere: images rotated by one degree have one of 60 to 120,
by three degrees of 17."""
_TRUSTED_SIGMA = 12.0
"""Correlation peak of a seed that is good to a few pixels. Unrelated images reach 9."""
_TRUSTED_RATIO = 1.5
"""Ratio of a trusted seed's peak to the second highest: a repetitive scene has several of one height."""
_MIN_OVERLAP = 0.2
"""Share of the reference that the moving image must cover: on a sliver of common area the correlation peak means
nothing, and the correlation is circular, so that its peak may put the images next to each other."""
_MIN_SHIFT_PX = 0.25
"""Structure shifts below this, in px of the reduced images, are noise and leave a candidate as it is."""
_SAME_PEAK_PX = 2.0
"""A candidate no farther from the peak than this, in px of the reduced images, is on its flank."""
_CLOSE_PX = 3.0
"""95th percentile of the residual under a match, below which no better one is looked for."""
_MIN_WINDOWS = 12
"""Windows that correct a match: fewer than for an estimate, as they must agree better with the corrected one."""
_MAX_ROTATION_DEGREES, _MAX_SCALE_CHANGE = 1.0, 0.02
"""Difference of a band from its rig that temperature and mounting explain."""
_FROM_TAGS: Set[SeedKind] = frozenset({"rig", "centre", "geo", "model", "user"})
"""Candidates of known scale."""
_SCALES = tuple(1.02**k for k in range(-18, 19) if k)
"""Scales relative to the overlay of the two images, 0.7 to 1.4: 2 % away from the right one, the correlation peak of a
thermal and a blue image falls to three quarters."""
_MAX_KEYPOINTS = 1000
"""Matching all keypoints of a full image by learnt descriptors, the last resort, takes seconds."""


def find_seed(pair: BandPair, settings: SeedSettings, model: FlightModel | None = None) -> Seed | Issue:
    """The best seed of a pair, or why it can have none. `model` has the network that a `match` is found with."""
    if not pair.reference.is_textured:
        return Issue(BLANK_REFERENCE)
    if not textured(pair.moving):
        return Issue(BLANK_MOVING)
    candidates = pair.candidates
    # A forced kind is for the captures that a flight is learned from: the others start from the flight's own mapping.
    force = None if "model" in candidates else settings.force
    if force == "match":
        result = match_seed(_network(pair, model), pair.fixed, pair.moving)
        if result is None:
            return Issue(NO_SUCH_SEED, detail="match")
        candidates = {"match": result}
    best = best_seed(pair, candidates, force)
    # A mapping from the flight or the user, or a forced seed: anything found elsewhere would be wrong.
    is_given = force is not None or pair.is_known_to_a_rig or "user" in pair.candidates
    if best.score >= _CERTAIN_SIGMA or is_given:
        return best
    if not best.trusted and not _FROM_TAGS & pair.candidates.keys():
        best = max((best, *_at_other_scales(pair)), key=lambda seed: seed.score)
    residual = _residual_under(pair, best.fixed_to_moving)
    # A peak at the mapping of the tags verifies the middle of the image; the windows verify the corners.
    if best.trusted and pair.is_expected(best.fixed_to_moving) and seed_fits(residual):
        return best
    return _best_match(pair, model, best, residual)


def _best_match(pair: BandPair, model: FlightModel | None, best: Seed, residual: Residual[FixedImagePx]) -> Seed:
    """A match under which the windows agree better than under the best seed so far, or that seed."""
    for mapping in _matches(pair, model, by_learnt_descriptors=not best.trusted):
        match, match_residual = _unshifted(pair, mapping), _residual_under(pair, mapping)
        corrected = _corrected(pair, mapping, match_residual)
        if corrected is not None:
            corrected_residual = _residual_under(pair, corrected)
            if corrected_residual.is_better_than(match_residual):
                match, match_residual = _unshifted(pair, corrected), corrected_residual
        if seed_fits(match_residual) and match_residual.is_better_than(residual):
            best, residual = replace(match, trusted=True), match_residual
        if best.kind == "match" and residual.p95_px <= _CLOSE_PX:
            break
    return best


def find_rotated(pair: BandPair, fixed_to_moving: Matrix, under: Residual[FixedImagePx]) -> Matrix | None:
    """A mapping by landmarks that is rotated or scaled relative to the given one, as no band of a rigid camera is.

    The windows must agree better with it than they do `under` the given mapping. None where there is none: a mapping
    that is merely shifted may be another place of a repetitive scene.
    """
    if seed_fits(under):
        return None
    for result in _matches(pair, None, by_learnt_descriptors=False):
        residual = _residual_under(pair, result)
        change = geometry.compose(geometry.invert(fixed_to_moving), result)
        if seed_fits(residual) and residual.is_better_than(under) and _is_rotated_or_scaled(change, pair.fixed.size_px):
            return result
    return None


def _is_rotated_or_scaled(matrix: Matrix, size_px: tuple[int, int]) -> bool:
    """By the images of a step right and a step down in the middle of an image (width, height)."""
    middle = (np.array(size_px) - 1) / 2
    origin, right, down = geometry.apply(matrix, middle + np.array([(0, 0), (1, 0), (0, 1)]))
    angle = np.degrees(np.arctan2(*(right - origin)[::-1]))
    scale = np.sqrt(abs(np.linalg.det([right - origin, down - origin])))
    return bool(abs(angle) > _MAX_ROTATION_DEGREES or abs(scale - 1) > _MAX_SCALE_CHANGE)


def _corrected(pair: BandPair, fixed_to_moving: Matrix, residual: Residual[FixedImagePx]) -> Matrix | None:
    """A mapping corrected by the windows under it; None where these are few."""
    fit = corner_correction(pair.mapping(fixed_to_moving), residual, pair.fixed.size_px, _MIN_WINDOWS)
    try:
        return None if fit is None else fit.applied_to(fixed_to_moving, pair.fixed.size_px)
    except GeometryError:
        return None


def _matches(pair: BandPair, model: FlightModel | None, *, by_learnt_descriptors: bool) -> Iterator[Matrix]:
    """Mappings, however rotated, scaled or shifted, that landmarks or learnt descriptors of both images agree on."""
    for source in LANDMARK_INPUTS:
        fixed = pair.reference.landmarks(source).undistorted(pair.fixed.lens)
        moving = landmarks(pair.moving, source).undistorted(pair.moving.lens)
        result = matched_homography(fixed, moving, pair.fixed.size_px)
        if result is not None:
            yield result
    if by_learnt_descriptors:
        result = match_seed(_network(pair, model), pair.fixed, pair.moving, _MAX_KEYPOINTS)
        if result is not None:
            yield result


def _residual_under(pair: BandPair, fixed_to_moving: Matrix) -> Residual[FixedImagePx]:
    return WarpedPair.of(pair, pair.mapping(fixed_to_moving)).residual


def _network(pair: BandPair, model: FlightModel | None) -> Descriptor:
    channels = pair.fixed.channels, pair.moving.channels
    return starter_for_matching(channels) if model is None else model.matching_network(pair.name, channels)


def image_groups(
    pairs: Sequence[BandPair], seeds: Sequence[Seed], sides: Sequence[int] = ()
) -> list[tuple[list[int], ImageGroup]]:
    """The inputs of the joint method: (indices of pairs with one reference image and one space, these as a group).

    `sides` are the network's side for each pair, by default counted within each group.
    """
    groups: dict[tuple[int, Space], list[int]] = {}
    for index, pair in enumerate(pairs):
        groups.setdefault((id(pair.reference), pair.space), []).append(index)
    return [
        (
            indices,
            _image_group([pairs[i] for i in indices], [seeds[i] for i in indices],
                         [sides[i] for i in indices] if sides else range(1, len(indices) + 1)),
        )
        for indices in groups.values()
    ]  # fmt: skip


def _image_group(pairs: Sequence[BandPair], seeds: Sequence[Seed], sides: Sequence[int]) -> ImageGroup:
    mappings = [s.fixed_to_moving for s in seeds]
    fields = [p.field for p in pairs]
    return ImageGroup(
        pairs[0].fixed, [p.moving for p in pairs], mappings, sides, [s.trusted for s in seeds],
        [p.reach_px for p in pairs], fields=fields if any(f is not None for f in fields) else (),
    )  # fmt: skip


def best_seed(pair: BandPair, candidates: Candidates, force: SeedKind | None = None) -> Seed:
    """The candidate under which the structures agree best, or one shifted onto the peak of their correlation.

    A candidate of the kind to `force` wins whatever its score. Where the flight's own mapping is trusted, the others
    are not scored.
    """
    scored: list[Seed] = []
    for kind, matrix in candidates.items():
        scored += _scored(pair, kind, matrix)
        best = max(scored, key=lambda seed: seed.score)
        if kind == "model" and best.trusted:
            return best
    forced = [s for s in scored if s.kind == force]
    return max(forced or scored, key=lambda seed: seed.score)


def first_candidate(pair: BandPair) -> Seed:
    """The candidate of highest trust, without a score."""
    kind, matrix = next(iter(pair.candidates.items()))
    return Seed(kind, matrix, 0.0)


def _at_other_scales(pair: BandPair) -> Iterator[Seed]:
    """The trusted ones among the seeds that overlay the images at other scales.

    Without tags the two fields of view are unknown: a thermal camera's may be a fifth wider than that of the others.
    """
    overlay, middle = pair.candidates["identity"], (np.array(pair.fixed.size_px) - 1) / 2
    for scale in _SCALES:
        about_middle = geometry.compose(
            geometry.translation(*middle), np.diag([scale, scale, 1.0]), geometry.translation(*-middle)
        )
        yield from (s for s in _scored(pair, "structure", geometry.compose(overlay, about_middle)) if s.trusted)


def _unshifted(pair: BandPair, fixed_to_moving: Matrix) -> Seed:
    """A match as it is, with its score."""
    return _scored(pair, "match", fixed_to_moving)[0]


def _scored(pair: BandPair, kind: SeedKind, fixed_to_moving: Matrix) -> list[Seed]:
    """The candidate itself first and, where the structures agree better a shift away, its `structure` variant.

    A candidate with too little common area scores 0.
    """
    scale = pair.reference.seed_scale
    peak = _peak(pair, kind, fixed_to_moving)
    if peak is None:
        return [Seed(kind, fixed_to_moving, 0.0)]

    def seed(kind: SeedKind, matrix: Matrix, sigma: float, runner_up: float) -> Seed:
        is_trusted = sigma >= max(_TRUSTED_SIGMA, _TRUSTED_RATIO * runner_up)
        return Seed(kind, matrix, sigma, sigma, runner_up, is_trusted)

    if np.hypot(*peak.shift_px) < _MIN_SHIFT_PX:
        return [seed(kind, fixed_to_moving, peak.sigma, peak.runner_up_sigma)]
    # Where the peak is another place, it is the unshifted candidate's rival.
    rival = peak.sigma if np.hypot(*peak.shift_px) > _SAME_PEAK_PX else peak.runner_up_sigma
    unmoved = seed(kind, fixed_to_moving, peak.sigma_at_zero, rival)
    shift = geometry.translation(peak.shift_px[0] / scale[0], peak.shift_px[1] / scale[1])
    shifted = geometry.compose(fixed_to_moving, shift)
    points = pair.mapping(shifted)(geometry.lattice(*pair.fixed.size_px, 16, 12))
    within = ((points >= 0) & (points <= np.subtract(pair.moving.size_px, 1))).all(axis=1)
    if within.mean() < _MIN_OVERLAP:
        return [unmoved]
    return [unmoved, seed("structure", shifted, peak.sigma, peak.runner_up_sigma)]


def _peak(pair: BandPair, kind: SeedKind, fixed_to_moving: Matrix) -> Peak | None:
    """The correlation peak of the reduced structures under a candidate; None where too little is common to both."""
    size, scale = pair.reference.seed_size_px, pair.reference.seed_scale
    small_moving = warped(channel_mean(pair.moving), pair.mapping(fixed_to_moving), size, scale)
    if small_moving.valid.mean() < _MIN_OVERLAP:
        return None
    surface = correlation_surfaces(pair.reference.seed_spectrum, windowed_spectra(structure_field(small_moving)))
    # Where the user knows a candidate to some px, a peak a period away is another place.
    within_px = max(_SAME_PEAK_PX, pair.reach_px * max(scale)) if kind == "user" else np.inf
    return find_peak(surface, exclusion_px=max(size) // 16, max_shift_px=within_px)
