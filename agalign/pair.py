"""The band pairs of one capture: seeded, aligned together, each one checked."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from agalign import geometry
from agalign.check import is_as_it_was, verdict
from agalign.choices import SeedKind
from agalign.config import CheckSettings, Settings
from agalign.flight import FlightModel, align_from_scratch, refine_with
from agalign.geometry import Matrix
from agalign.images import Candidates, bands_of_the_references_lens, read_pairs
from agalign.joint import Subject
from agalign.local import LocalRefiner
from agalign.mapping import Mapping as PixelMapping
from agalign.match import with_match
from agalign.metrics import FixedSimilarity
from agalign.records import Alignment, Band, Capture, JointResult, LocalField, LocalResult, Raster, Seed
from agalign.residuals import FixedWindows
from agalign.seed import best_seed, is_trusted, overlay, single, warped
from agalign.structure import textured

PairProgress = Callable[[str, str, float], None]
"""Called with the band's name, the stage, and the share of the stage that is behind."""

_AS_FILES_LIE: tuple[SeedKind, ...] = ("geo", "identity")
"""Seeds that change nothing: an input aligned already is left untouched, not resampled by a hundredth of a pixel."""


@dataclass(frozen=True)
class Pair:
    """A moving image beside the reference, and where to start."""

    name: str
    fixed: Raster
    moving: Raster
    candidates: Candidates
    """fixed_to_moving homographies between undistorted pixels, in order of trust."""
    seed: Seed
    trusted: bool

    @property
    def space(self) -> Literal["pixel", "undistorted"]:
        """What the homographies are between."""
        return "pixel" if self.fixed.lens is None else "undistorted"


def align_capture_bands(
    capture: Capture, settings: Settings, model: FlightModel | None, progress: PairProgress
) -> dict[str, Alignment]:
    """Align every moving band of a capture, by name; a band that cannot be read is `failed` and stops no other.

    Raises UnreadableFileError where the reference cannot be read.
    """
    reference = capture.reference
    progress(reference.name, "reading", 0.0)
    pairs, unreadable = read_pairs(capture, settings, None if model is None else model.mappings)
    images = [(p.name, p.fixed, p.moving, p.candidates) for p in pairs]
    aligned = align_images(images, settings, progress, model)
    found: dict[str, Alignment] = {}
    for band in bands_of_the_references_lens(capture):
        unmoved = Seed("identity", geometry.identity(), 0.0)
        found[band.name] = Alignment(unmoved.fixed_to_moving, "pixel", "aligned", None, unmoved, None, None, 0.0)
    for pair in pairs:
        alignment = _in_file_px(aligned[pair.name], *pair.scales)
        shared = replace(alignment, seconds=alignment.seconds / len(pair.moving_bands))
        found |= dict.fromkeys((b.name for b in pair.moving_bands), shared)
    for band in capture.moving:
        if band.name in unreadable:
            found[band.name] = _failed(Seed("identity", overlay(reference, band), 0.0), unreadable[band.name])
    return {band.name: found[band.name] for band in capture.moving}


def align_images(
    images: Sequence[tuple[str, Raster, Raster, Candidates]], settings: Settings, progress: PairProgress,
    model: FlightModel | None = None,
) -> dict[str, Alignment]:  # fmt: skip
    """Align images (name, fixed, moving, candidates) of one capture, which share the pixels of the reference.

    Those that the flight's network cannot align are learnt from scratch, together.
    """
    if not images:
        return {}
    found: dict[str, Alignment] = {}
    yardsticks = Yardsticks(single(images[0][1]), settings.check)
    clock = time.perf_counter()

    def spent(count: int) -> float:
        nonlocal clock
        seconds, clock = (time.perf_counter() - clock) / max(count, 1), time.perf_counter()
        return seconds

    pairs: list[Pair] = []
    for name, fixed, moving, candidates in images:
        progress(name, "seeding", 0.0)
        learnt, side = (None, 1) if model is None else (model.net, model.side(name) or 1)
        candidates = with_match(candidates, fixed, moving, settings.seed, learnt, side)
        pair = _seeded(name, fixed, moving, candidates, settings)
        if isinstance(pair, Pair):
            pairs.append(pair)
        else:
            found[name] = pair
    seeding = spent(len(images))
    seconds = dict.fromkeys((p.name for p in pairs), seeding)
    remaining = pairs
    if settings.seed.only:
        for pair in pairs:
            found[pair.name] = _checked(pair, "only the seed was asked for", yardsticks, settings)
        share = spent(len(images))
        return {name: replace(a, seconds=share) for name, a in found.items()}
    if model is not None and settings.joint.recipe == "fast":
        known = [p for p in pairs if model.side(p.name) is not None]
        results = _frozen(known, model, settings, progress)
        share = spent(len(known))
        for pair in known:
            progress(pair.name, "checking", 0.0)
            alignment = _checked(pair, results[pair.name], yardsticks, settings)
            seconds[pair.name] += share + spent(1)
            if alignment.status == "aligned":
                found[pair.name] = replace(alignment, seconds=seconds[pair.name])
        remaining = [p for p in pairs if p.name not in found]
    results = _from_scratch(remaining, settings, progress)
    share = spent(len(remaining))
    for pair in remaining:
        progress(pair.name, "checking", 0.0)
        alignment = _checked(pair, results[pair.name], yardsticks, settings)
        found[pair.name] = replace(alignment, seconds=seconds[pair.name] + share + spent(1))
    return found


def _seeded(name: str, fixed: Raster, moving: Raster, candidates: Candidates, settings: Settings) -> Pair | Alignment:
    if not (textured(fixed) and textured(moving)):
        blank = "reference" if not textured(fixed) else "moving"
        kind, matrix = next(iter(candidates.items()))
        failed = _failed(Seed(kind, matrix, 0.0), f"the {blank} band is constant or all invalid")
        return failed if fixed.lens is None else replace(failed, space="undistorted")
    seed = best_seed(fixed, moving, candidates, settings.seed)
    return Pair(name, fixed, moving, candidates, seed, is_trusted(seed, settings.seed))


def _failed(seed: Seed, reason: str) -> Alignment:
    return Alignment(seed.fixed_to_moving, "pixel", "failed", reason, seed, None, None, 0.0)


def _frozen(
    pairs: Sequence[Pair], model: FlightModel, settings: Settings, progress: PairProgress
) -> dict[str, JointResult | str]:
    results: dict[str, JointResult | str] = {}
    for group in _by_lens(pairs):
        sides = [model.side(p.name) or 0 for p in group]
        found = refine_with(model, _subject(group, sides), settings.joint, _of(group, progress))
        results |= dict(zip((p.name for p in group), found, strict=True))
    return results


def _from_scratch(pairs: Sequence[Pair], settings: Settings, progress: PairProgress) -> dict[str, JointResult | str]:
    results: dict[str, JointResult | str] = {}
    for group in _by_lens(pairs):
        subject = _subject(group, list(range(1, len(group) + 1)))
        found = align_from_scratch(subject, settings.joint, _of(group, progress))
        results |= dict(zip((p.name for p in group), found, strict=True))
    return results


def _by_lens(pairs: Sequence[Pair]) -> list[list[Pair]]:
    """Pairs that share the reference's undistorted pixels, and those that share its raw ones."""
    groups = [[p for p in pairs if (p.fixed.lens is None) == raw] for raw in (False, True)]
    return [g for g in groups if g]


def _subject(pairs: Sequence[Pair], sides: Sequence[int]) -> Subject:
    return Subject(
        pairs[0].fixed, [p.moving for p in pairs], [p.seed.fixed_to_moving for p in pairs], sides,
        [p.trusted for p in pairs],
    )  # fmt: skip


def _of(pairs: Sequence[Pair], progress: PairProgress) -> Callable[[str, float], None]:
    """Progress of pairs that advance together, told as the first one's."""
    return lambda stage, share: progress(pairs[0].name, stage, share)


class Yardsticks:
    """What the moving bands of one reference are measured against, on the pixel grid on which they are written."""

    def __init__(self, fixed: Raster, settings: CheckSettings) -> None:
        self.fixed = fixed
        self.windows = FixedWindows(fixed, settings)
        self.similarity = FixedSimilarity(fixed)
        self._refiner: LocalRefiner | None = None

    def refiner(self, settings: Settings) -> LocalRefiner:
        """Small windows for local displacements, cut when they are first asked for."""
        if self._refiner is None:
            self._refiner = LocalRefiner(self.fixed, settings.local, settings.check)
        return self._refiner


def _checked(pair: Pair, joint: JointResult | str, yardsticks: Yardsticks, settings: Settings) -> Alignment:
    """The alignment with its verdict and metrics, in px of the images."""
    why_not = joint if isinstance(joint, str) else ""
    found = None if isinstance(joint, str) else _snapped(joint, pair, settings.check)
    matrix = pair.seed.fixed_to_moving if found is None else found.fixed_to_moving
    there = _laid_on_reference(pair, matrix)
    residual = yardsticks.windows.residuals(there)
    size = pair.fixed.size_px
    usable = pair.trusted or settings.seed.only
    status, doubt = verdict(pair.seed, usable, found, why_not, residual, size, settings.check)
    if status != "aligned" and found is not None:
        matrix = pair.seed.fixed_to_moving
        there = _laid_on_reference(pair, matrix)
        residual = yardsticks.windows.residuals(there)
    fits = residual.coverage >= settings.check.least_seed_coverage
    if status == "seed_only" and not (fits and residual.median_px <= settings.check.most_seed_residual_px):
        status, doubt = "failed", f"{doubt}, but it does not fit either"
    local = None
    if settings.local.use and status == "aligned":
        local = yardsticks.refiner(settings).refine(single(pair.moving), _mapping(pair, matrix))
        there = warped(single(pair.moving), _mapping(pair, matrix, local), size)
        residual = yardsticks.windows.residuals(there)
    before, after = (yardsticks.similarity.to(r) for r in (_laid_as_files_lie(pair), there))
    return Alignment(matrix, pair.space, status, doubt, pair.seed, found, residual, 0.0, before, after, local)


def _snapped(joint: JointResult, pair: Pair, settings: CheckSettings) -> JointResult:
    for given in (pair.candidates[kind] for kind in _AS_FILES_LIE if kind in pair.candidates):
        if PixelMapping(given, pair.fixed.lens, pair.moving.lens).bends:
            continue  # the files do not lie that way
        if is_as_it_was(joint, given, pair.fixed.size_px, settings):
            return replace(joint, fixed_to_moving=given)
    return joint


def _laid_as_files_lie(pair: Pair) -> Raster:
    scale = np.divide(pair.moving.size_px, pair.fixed.size_px)
    lying = PixelMapping(geometry.resolution_change(float(scale[0]), float(scale[1])))
    return warped(single(pair.moving), lying, pair.fixed.size_px)


def _laid_on_reference(pair: Pair, matrix: Matrix) -> Raster:
    return warped(single(pair.moving), _mapping(pair, matrix), pair.fixed.size_px)


def _mapping(pair: Pair, matrix: Matrix, local: LocalResult | None = None) -> PixelMapping:
    return PixelMapping(matrix, pair.fixed.lens, pair.moving.lens, local=local.field if local is not None else None)


def _in_file_px(alignment: Alignment, fixed_scale: tuple[float, float], moving_scale: tuple[float, float]) -> Alignment:
    """An alignment of reduced images as one of their files."""
    if fixed_scale == moving_scale == (1.0, 1.0):
        return alignment
    up, there = ((1 / x, 1 / y) for x, y in (fixed_scale, moving_scale))
    joint, residual, seed = alignment.joint, alignment.residual, alignment.seed
    if joint is not None:
        std = tuple((x * up[0], y * up[1]) for x, y in joint.corner_std_xy_px)
        joint = replace(joint, corner_std_xy_px=std, last_step_px=joint.last_step_px * up[0])
    if residual is not None:
        residual = replace(
            residual, centres_px=(residual.centres_px + 0.5) * up - 0.5, shifts_px=residual.shifts_px * up,
            median_px=residual.median_px * up[0], p95_px=residual.p95_px * up[0],
        )  # fmt: skip
    seed = replace(seed, fixed_to_moving=geometry.rescale(seed.fixed_to_moving, up, there))
    matrix = geometry.rescale(alignment.fixed_to_moving, up, there)
    local = alignment.local
    if local is not None and local.field is not None:
        # The lattice's first node lies at the centre of a pixel; half a reduced pixel is nothing to a smooth field.
        larger = LocalField(local.field.step_px * up[0], local.field.displacements_px * up)
        local = LocalResult(larger, local.before_p95_px * up[0], local.after_p95_px * up[0])
    return replace(alignment, fixed_to_moving=matrix, seed=seed, joint=joint, residual=residual, local=local)


def mapping_of(reference: Band, moving: Band, alignment: Alignment) -> PixelMapping:
    """The complete mapping between the raw pixels of the two files."""
    local = None if alignment.local is None else alignment.local.field
    if alignment.space == "pixel":
        return PixelMapping(alignment.fixed_to_moving, local=local)
    return PixelMapping(alignment.fixed_to_moving, reference.lens, moving.lens, local=local)
