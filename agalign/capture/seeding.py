"""Initial alignment (seed) of a pair: candidates from tags, flight and landmarks are scored on the images."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from agalign.capture.band_pair import BandPair, SeedMatrices, blank_issue
from agalign.capture.reference import Reference, is_coarse, longest_for
from agalign.capture.warped_pair import WarpedPair
from agalign.config import SeedSettings
from agalign.fit.window_fit import fit_in_rounds
from agalign.flight.model import FlightModel
from agalign.method.descriptor import Descriptor
from agalign.method.learned_matches import match_seed, matching_network, starter_for_matching
from agalign.method.state import ImageGroup, MovingImage
from agalign.pixels.band_resampling import channel_mean, shrink, textured, warped
from agalign.pixels.landmarks import LANDMARK_INPUTS, landmarks, matched_homography
from agalign.pixels.structure import Peak, correlation_surfaces, find_peak, structure_field, windowed_spectra
from agalign.values import geometry
from agalign.values.alignment import Seed
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import Matrix, PairScales
from agalign.values.issues import BLANK_MOVING, BLANK_REFERENCE, NO_SUCH_SEED, Issue
from agalign.verify.checks import seed_fits

_MIN_OVERLAP = 0.2
"""Minimum share of the reference that the moving image covers: the correlation is circular and meaningless for small
overlaps."""
_SAME_PEAK_PX = 2.0
"""Maximum distance, px of the reduced images, of a candidate from a peak that it belongs to."""
_SCALES = tuple(1.02**k for k in range(-18, 19) if k)
"""Scales relative to the overlay of the two images, 0.7 to 1.4. An error of 2 % reduces the correlation peak of a
thermal and a blue image to three quarters."""


def find_seed(pair: BandPair, settings: SeedSettings, model: FlightModel | None = None) -> Seed | Issue:
    """Return the best seed of a pair, or the issue that prevents one, such as a forced kind that it lacks.

    With `force` "match", descriptors of the network of `model` are matched.
    """
    if not pair.reference.is_textured:
        return blank_issue(pair.reference.image, BLANK_REFERENCE)
    if not textured(pair.moving):
        return blank_issue(pair.moving, BLANK_MOVING)
    matrices = pair.seed_matrices
    # With a flight's mapping, the forced kind was already used in the captures from which the flight was learned.
    force = None if "model" in matrices else settings.force
    if force == "match":
        result = match_seed(_network(pair, model), pair.fixed, pair.moving)
        if result is None:
            return Issue(NO_SUCH_SEED, detail="match")
        matrices = {"match": result}
    elif force not in (None, "structure", *matrices):  # the peaks of other kinds are structure
        return Issue(NO_SUCH_SEED, detail=str(force))
    best = best_seed(pair, matrices, force)
    is_given = settings.force is not None or pair.has_rig  # excludes other positions
    # Correlation peak of images that are aligned everywhere. A rotation by 1 degree reduces it to 60 to 120, by 3
    # degrees to 17.
    certain_sigma = 120.0
    if best.score >= certain_sigma or is_given:
        return best
    has_scale = bool(pair.seed_matrices.keys() & {"rig", "centre", "geo", "model", "user"})
    if not best.trusted and not has_scale:
        best = max((best, *_at_other_scales(pair)), key=lambda seed: seed.score)
    given = WarpedPair.of(pair, pair.mapping(best.fixed_to_moving))
    if "user" in pair.seed_matrices:
        return best if seed_fits(given.residual) else _near_seed_of_user(given, best)
    # The mapping of the tags confirms the image centre, the windows confirm the corners.
    is_confirmed = pair.is_expected(best.fixed_to_moving) and seed_fits(given.residual)
    return best if best.trusted and is_confirmed else _best_match(given, best, is_confirmed=is_confirmed)


def _near_seed_of_user(given: WarpedPair, best: Seed) -> Seed:
    """Return a seed that the windows confirm, where they do not confirm that of the user: its correction by windows, or
    a match, with no corner farther from it than its standard error allows; itself without either.
    """
    pair = given.pair
    to_given = geometry.invert(pair.seed_matrices["user"])

    def is_near(seed: Seed) -> bool:
        moved = geometry.compose(to_given, seed.fixed_to_moving)
        return geometry.corner_error_px(moved, geometry.identity(), *pair.fixed.size_px) <= pair.max_shift_px

    by_windows = corrected(pair, best)
    if by_windows is not None and is_near(by_windows):
        return by_windows
    match = _best_match(given, best, is_confirmed=False)
    return match if is_near(match) else best


def _best_match(given: WarpedPair, best: Seed, *, is_confirmed: bool) -> Seed:
    """Return a match with a smaller residual than the pair has with the best seed, or that seed.

    If tags and windows confirm the seed, a match also needs a higher correlation peak: equal plants in a square grid
    match after a quarter turn too, with a smaller residual where there is parallax.
    """
    pair = given.pair
    for mapping in _matches(pair):
        for match in _with_corrected(pair, mapping):
            if not seed_fits(match.residual) or not match.is_better_than(given):
                continue
            # The match has its own score: it is not shifted to the correlation peak.
            scored = replace(_scored(pair, "match", match.mapping.fixed_to_moving)[0], trusted=True)
            if not is_confirmed or scored.score > best.score:
                best, given = scored, match
        close_px = 3.0  # the search ends here
        if best.kind == "match" and given.residual.p95_px <= close_px:
            break
    return best


def seed_to_use(pair: BandPair, found: Seed | Issue, *, is_asked_for: bool = False) -> Seed:
    """Return the seed that was found; that of tags or flight if there is none, or if it contradicts them and the user
    did not ask for it.
    """
    expected = pair.expected_kind
    if isinstance(found, Issue):
        kind, matrix = next(iter(pair.seed_matrices.items()))
        return Seed(kind, matrix, 0.0)
    if expected is None or is_asked_for or pair.is_expected(found.fixed_to_moving):
        return found
    return Seed(expected, pair.seed_matrices[expected], 0.0, trusted=True)


def corrected(pair: BandPair, seed: Seed) -> Seed | None:
    """Return the seed of a pair corrected by windows: the scale of tags may be wrong by several px at the corners.

    None if the windows do not determine a correction, or if it does not fit them better.
    """
    given, *others = _with_corrected(pair, seed.fixed_to_moving)
    for other in others:
        if seed_fits(other.residual) and other.is_better_than(given):
            return replace(seed, fixed_to_moving=other.mapping.fixed_to_moving)
    return None


def _with_corrected(pair: BandPair, fixed_to_moving: Matrix) -> Iterator[WarpedPair]:
    """Yield the pair with a mapping, then with its correction by its windows if these are enough."""
    warped_pair = WarpedPair.of(pair, pair.mapping(fixed_to_moving))
    yield warped_pair
    fitted = fit_in_rounds(warped_pair.mapping, lambda _: warped_pair.residual, pair.fixed.size_px, rounds=1)
    if fitted is not None:
        yield WarpedPair.of(pair, pair.mapping(fitted[0].fixed_to_moving))


def find_rotated(given: WarpedPair) -> Matrix | None:
    """Return a mapping by landmarks that is rotated or scaled relative to that of the pair; None without one.

    Its residual is better than the given one. The bands of a rigid camera are not rotated relative to their rig; a
    mapping that is only shifted may be an alias in a repetitive scene and is ignored.
    """
    pair = given.pair
    if seed_fits(given.residual):
        return None
    for result in _matches(pair):
        match = WarpedPair.of(pair, pair.mapping(result))
        change = geometry.compose(geometry.invert(given.mapping.fixed_to_moving), result)
        is_moved = _is_rotated_or_scaled(change, pair.fixed.size_px)
        if is_moved and seed_fits(match.residual) and match.is_better_than(given):
            return result
    return None


def _is_rotated_or_scaled(matrix: Matrix, size_px: tuple[int, int]) -> bool:
    """Return True if a homography rotates or scales the centre of an image (width, height) beyond the limits."""
    max_rotation_degrees, max_scale_change = 1.0, 0.02  # deviation of a band from its rig by temperature and mounting
    centre = (np.array(size_px) - 1) / 2
    origin, right, down = geometry.apply(matrix, centre + np.array([(0, 0), (1, 0), (0, 1)]))
    angle = np.degrees(np.arctan2(*(right - origin)[::-1]))
    scale = np.sqrt(abs(np.linalg.det([right - origin, down - origin])))
    return bool(abs(angle) > max_rotation_degrees or abs(scale - 1) > max_scale_change)


def _matches(pair: BandPair) -> Iterator[Matrix]:
    """Yield mappings from landmarks; any rotation, scale and shift is possible."""
    for source in LANDMARK_INPUTS:
        fixed = pair.reference.landmarks(source).undistorted(pair.fixed.lens)
        moving = landmarks(pair.moving, source).undistorted(pair.moving.lens)
        result = matched_homography(fixed, moving, pair.fixed.size_px)
        if result is not None:
            yield result


def _network(pair: BandPair, model: FlightModel | None) -> Descriptor:
    channels = pair.fixed.channels, pair.moving.channels
    if model is None:
        return starter_for_matching(channels)
    return matching_network(model.net, model.side(pair.name) or 1, channels)


def image_groups(
    pairs: Iterable[BandPair], seeds: Mapping[str, Seed], sides: Mapping[str, int] | None = None
) -> list[ImageGroup]:
    """Group the images of the pairs that have a seed by reference image and space, as input of the joint method.

    `seeds` and the network's `sides` are by band; by default, the sides are 1, 2, … in each group.
    """
    groups: dict[tuple[int, Space], list[BandPair]] = {}
    for pair in pairs:
        if pair.name in seeds:
            groups.setdefault((id(pair.reference), pair.space), []).append(pair)

    def moving(pair: BandPair, number: int) -> MovingImage:
        seed, side = seeds[pair.name], number if sides is None else sides[pair.name]
        state = pair.moving, seed.fixed_to_moving, side, seed.trusted
        return MovingImage(*state, pair.max_shift_px, pair.field, name=pair.name)

    return [ImageGroup(g[0].fixed, [moving(pair, k) for k, pair in enumerate(g, 1)]) for g in groups.values()]


def best_seed(pair: BandPair, matrices: SeedMatrices, force: SeedKind | None = None) -> Seed:
    """Return the candidate with the highest score, or a candidate shifted to the correlation peak.

    Those of the kind `force` are preferred to all others. If the flight's mapping is trusted, the others are not
    scored.
    """
    scored: list[Seed] = []
    for kind, matrix in matrices.items():
        scored += _scored(pair, kind, matrix)
        best = max(scored, key=lambda seed: seed.score)
        if kind == "model" and best.trusted:
            return best
    forced = [s for s in scored if s.kind == force]
    return max(forced or scored, key=lambda seed: seed.score)


def _at_other_scales(pair: BandPair) -> Iterator[Seed]:
    """Yield the trusted seeds that overlay the images at other scales.

    Without tags the fields of view are unknown: that of a thermal camera may be a fifth wider than the others.
    """
    overlay, centre = pair.seed_matrices["identity"], (np.array(pair.fixed.size_px) - 1) / 2
    for scale in _SCALES:
        about_centre = geometry.compose(
            geometry.translation(*centre), np.diag([scale, scale, 1.0]), geometry.translation(*-centre)
        )
        yield from (s for s in _scored(pair, "structure", geometry.compose(overlay, about_centre)) if s.trusted)


def _scored(pair: BandPair, kind: SeedKind, fixed_to_moving: Matrix) -> list[Seed]:
    """Return a candidate with its score, followed by the candidate shifted to the correlation peak, if different.

    The shifted candidate has the kind `structure`. A candidate with too small an overlap has score 0.
    """
    scale = pair.reference.seed_scale
    peak = _peak(pair, kind, fixed_to_moving)
    if peak is None:
        return [Seed(kind, fixed_to_moving, 0.0)]

    def seed(kind: SeedKind, matrix: Matrix, sigma: float, runner_up: float) -> Seed:
        min_sigma = 12.0  # unrelated images have up to 9
        min_ratio = 1.5  # a repetitive scene has several similar peaks
        is_trusted = sigma >= max(min_sigma, min_ratio * runner_up)
        return Seed(kind, matrix, sigma, sigma, runner_up, is_trusted)

    min_shift_px = 0.25  # of the reduced images; smaller shifts are noise
    if np.hypot(*peak.shift_px) < min_shift_px:
        return [seed(kind, fixed_to_moving, peak.sigma, peak.runner_up_sigma)]
    # If the unshifted candidate does not belong to the highest peak, that peak is its runner-up.
    runner_up = peak.sigma if np.hypot(*peak.shift_px) > _SAME_PEAK_PX else peak.runner_up_sigma
    unshifted = seed(kind, fixed_to_moving, peak.sigma_at_zero, runner_up)
    shift = geometry.translation(peak.shift_px[0] / scale[0], peak.shift_px[1] / scale[1])
    shifted = geometry.compose(fixed_to_moving, shift)
    points = pair.mapping(shifted)(geometry.lattice(*pair.fixed.size_px, 16, 12))
    is_inside = ((points >= 0) & (points <= np.subtract(pair.moving.size_px, 1))).all(axis=1)
    if is_inside.mean() < _MIN_OVERLAP:
        return [unshifted]
    return [unshifted, seed("structure", shifted, peak.sigma, peak.runner_up_sigma)]


def _peak(pair: BandPair, kind: SeedKind, fixed_to_moving: Matrix) -> Peak | None:
    """Return the correlation peak of the reduced structures for a candidate; None if the overlap is too small."""
    size, scale = pair.reference.seed_size_px, pair.reference.seed_scale
    small_moving = warped(channel_mean(pair.moving), pair.mapping(fixed_to_moving), size, scale)
    if small_moving.valid.mean() < _MIN_OVERLAP:
        return None
    surface = correlation_surfaces(pair.reference.seed_spectrum, windowed_spectra(structure_field(small_moving)))
    # Peaks farther from the user's candidate than its standard error allows are aliases.
    max_shift_px = max(_SAME_PEAK_PX, pair.max_shift_px * max(scale)) if kind == "user" else np.inf
    return find_peak(surface, exclusion_px=max(size) // 16, max_shift_px=max_shift_px)


def with_reduced_reference(pair: BandPair, settings: SeedSettings) -> BandPair:
    """Return a pair of arrays with one initial mapping, with the reference reduced for a moving image with much larger
    pixels, as of a thermal camera.

    Without a seed of the user, a small image may also show a part of the other: the seed that is found decides.
    """
    ((kind, start),) = pair.seed_matrices.items()
    size_px = pair.fixed.size_px
    if not is_coarse(size_px, start):
        return pair
    found = Seed("user", start, 0.0) if kind == "user" else find_seed(pair, settings, None)
    if isinstance(found, Issue) or not is_coarse(size_px, found.fixed_to_moving):
        return pair
    width, height = (max(1, round(side * longest_for(size_px, start) / max(size_px))) for side in size_px)
    image = shrink(pair.fixed, (width, height))
    scales = PairScales.of(pair.sizes_px, (image.size_px, pair.moving_image.size_px))
    matrices: SeedMatrices = {kind: scales.between_images(start)}
    std_px = {kind: px * scales.fixed.mean for kind, px in pair.seed_std_px.items()}
    reduced = replace(pair, reference=Reference(image), seed_matrices=matrices, scales=scales, seed_std_px=std_px)
    return replace(reduced, is_coarse=True)
