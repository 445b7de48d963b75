"""Alignment of the band pairs of one capture: seeds, joint estimation, verification of each pair."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.by_relief import aligned_by_relief
from agalign.capture.by_rig import bands_to_learn
from agalign.capture.decision import (
    against_rig,
    by_windows,
    fall_back_to_seed,
    verified,
    with_lens_shapes,
    with_one_geometry,
)
from agalign.capture.full_resolution import at_full_resolution
from agalign.capture.map_estimate import map_estimate
from agalign.capture.seeding import SeededPair, corrected, find_seed, image_groups
from agalign.capture.warped_pair import Candidate, with_metrics
from agalign.config import SeedSettings, Settings
from agalign.flight.model import FlightModel
from agalign.method.device import one_thread
from agalign.method.joint import Results, align_from_scratch, refine_with
from agalign.method.refine import FLIGHT_PATCHES, PATCHES
from agalign.method.state import ImageGroup, Progress
from agalign.pixels.raster import ReadTile
from agalign.values import geometry
from agalign.values.alignment import (
    MIN_RETRIEVAL,
    MIN_TIMES_CHANCE,
    Alignment,
    Alignments,
    JointResult,
    RefinedPair,
    Residual,
    Seed,
)
from agalign.values.capture import Capture
from agalign.values.issues import SEED_ASKED_FOR, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief

PairProgress = Callable[[str, str, float], None]
"""Called with the name of the band, the stage and its completed share, 0 to 1."""


def align_capture_bands(
    capture: Capture,
    settings: Settings,
    model: FlightModel | None,
    progress: PairProgress,
    read: ReadTile | None = None,
) -> dict[str, Alignment]:
    """Align every moving band of a capture; return the alignments by band, px of the files.

    A band that cannot be read is `failed`; the others are aligned. `read` reads the pixels of the files, by default
    `read_tile`. Raises UnreadableFileError if the reference cannot be read.
    """
    start_s = time.perf_counter()
    progress(capture.reference.name, "reading", 0.0)
    pairs, unusable = read_pairs(capture, settings.seed, model, read)
    aligned = align_pairs(pairs, settings, progress, model, capture)
    rig = None if model is None else model.rig
    if rig is not None and not settings.seed.only:
        aligned = against_rig(pairs, aligned, rig, capture)
    if not settings.seed.only:
        aligned = with_lens_shapes(pairs, aligned, rig)
    size_px = capture.reference.size_px
    between_files = {pair.name: _between_files(capture, pair, aligned[pair.name]) for pair in pairs}
    reliefs = (a.mapping.parallax.relief for a in between_files.values() if a.mapping.parallax is not None)
    relief = next((relief.on_pixels(size_px) for relief in reliefs), None)  # the same in all bands
    result: dict[str, Alignment] = {}
    for pair in pairs:
        progress(pair.name, "measuring", 0.0)
        measured = with_metrics(_as_written(between_files[pair.name], relief), pair)
        result |= {band.name: replace(measured, moving_size_px=band.size_px) for band in pair.bands}
    for band in capture.moving:
        if band.name not in result:
            overlay = Seed("identity", geometry.overlay(size_px, band.size_px), 0.0)
            issues = (unusable[band.name],) if band.name in unusable else ()  # none in a band of the reference's lens
            mapping = PixelMapping(overlay.fixed_to_moving)
            result[band.name] = Alignment(mapping, size_px, issues, overlay, moving_size_px=band.size_px)
    seconds = (time.perf_counter() - start_s) / max(1, len(capture.moving))  # most steps are for all bands together
    return {b.name: replace(result[b.name], seconds=seconds) for b in capture.moving}


def _as_written(alignment: Alignment, relief: Relief | None) -> Alignment:
    """Return an alignment with the relief that is written: a reader of the sidecar has the same mapping."""
    if relief is None or alignment.mapping.parallax is None:
        return alignment
    parallax = Parallax(relief, alignment.mapping.parallax.baseline).with_occlusions()
    return replace(alignment, mapping=alignment.mapping.with_parallax(parallax))


def _between_files(capture: Capture, pair: BandPair, aligned: Alignment) -> Alignment:
    """Convert the alignment of a pair to px of the files of its bands; refine it if the files have more pixels."""
    alignment = aligned.in_file_px(pair.scales, capture.reference.size_px)
    if pair.is_reduced and alignment.status == "aligned":
        return at_full_resolution(capture.reference, pair.bands[0], alignment)
    return alignment


def tie_windows(
    capture: Capture, settings: SeedSettings, alignments: Mapping[str, Alignment], read: ReadTile | None = None
) -> dict[str, Residual]:
    """Return windows of the moving bands that did not fail, measured under their alignments, by band, px of the files.

    They cover the whole image, with those that a mapping was fitted to: small ones if parallax varies within large
    ones. Raises UnreadableFileError if the reference cannot be read.
    """
    result: dict[str, Residual] = {}
    for pair in read_pairs(capture, settings, read=read)[0]:
        alignment = alignments[pair.bands[0].name]
        if alignment.status != "failed":
            mapping = alignment.mapping.rescaled(pair.scales.fixed, pair.scales.moving)
            windows = pair.windows if mapping.parallax is None else pair.reference.tie_windows
            residual = windows.residuals(pair.warped_moving(mapping)).in_file_px(pair.scales)
            result |= dict.fromkeys((band.name for band in pair.bands), residual)
    return result


@one_thread()
def align_pairs(
    pairs: Sequence[BandPair],
    settings: Settings,
    progress: PairProgress,
    model: FlightModel | None = None,
    capture: Capture | None = None,
) -> Alignments:
    """Align the pairs of one `capture`; return the alignments by name, px of the images."""
    return PairAligner(settings, model, progress).align(pairs, capture)


@dataclass
class PairAligner:
    """The steps of `align_pairs`; each adds its alignments to `result`."""

    settings: Settings
    model: FlightModel | None
    progress: PairProgress
    is_observation: bool = False
    """True while a flight is learned: residual lens distortion is fitted to all its captures together."""
    refined: dict[str, RefinedPair] = field(default_factory=dict)
    """Results by band of the last optimisation, before they are combined with those of other bands and the rig."""
    result: Alignments = field(default_factory=dict)
    """Alignments by band."""

    def align(self, pairs: Sequence[BandPair], capture: Capture | None, *, scratch: bool = True) -> Alignments:
        """Take all steps; return the alignments.

        Pairs that the flight's network cannot align are learned from scratch, with a rig only those without an accurate
        prediction; without `scratch`, only pairs that the network does not contain.
        """
        starts = self._seeded(pairs)
        if self.settings.seed.only:
            self._keep_seeds(starts)
        else:
            self.refine(starts)
            self._learn(starts, capture, scratch=scratch)
            self._align_by_windows(starts)
            self.result = with_one_geometry(pairs, self.result)
        return self.result

    def _seeded(self, pairs: Sequence[BandPair]) -> list[SeededPair]:
        """Return the pairs with a seed; the other pairs are failed."""
        starts: list[SeededPair] = []
        for pair in pairs:
            self.progress(pair.name, "seeding", 0.0)
            seed = find_seed(pair, self.settings.seed, self.model)
            if isinstance(seed, Issue):
                kind, matrix = next(iter(pair.seed_matrices.items()))
                self.result[pair.name] = pair.seed_alignment(Seed(kind, matrix, 0.0), seed)
            else:
                starts.append((pair, seed))
        return starts

    def _keep_seeds(self, starts: Sequence[SeededPair]) -> None:
        """Use the seeds as results, as the user requested."""
        for pair, seed in starts:
            self.result[pair.name] = fall_back_to_seed(pair, seed, (Issue(SEED_ASKED_FOR),), seed_only=True)

    def refine(self, starts: Sequence[SeededPair]) -> None:
        """Align the pairs of the bands that the flight's network contains with this network."""
        model = self.model
        if model is None or self.settings.joint.recipe == "paper":
            return
        known = [s for s in starts if model.side(s[0].name) is not None]
        sides = [model.side(pair.name) or 0 for pair, _ in known]
        patches = PATCHES if model.rig is None else FLIGHT_PATCHES

        def optimised(some: Sequence[SeededPair], of_sides: Sequence[int]) -> Results:
            return self._optimised(
                some,
                of_sides,
                lambda group, report: refine_with(model.net, group, self.settings.joint, report, patches),
            )

        results = optimised(known, sides)
        # Tags may have the wrong scale: descriptors that do not align a seed may align it once windows correct it.
        again = {k: start for k, r in enumerate(results) if not is_retrieved(r) and (start := corrected(known[k]))}
        for k, result in zip(again, optimised(list(again.values()), [sides[k] for k in again]), strict=True):
            results[k] = result if is_retrieved(result) else results[k]
        self.verify(known, results)

    def _learn(self, starts: Sequence[SeededPair], capture: Capture | None, *, scratch: bool) -> None:
        """Align pairs with networks that are learned from scratch."""
        limit_px = self.settings.check.accept_predicted_px
        done = {name for name, a in self.result.items() if not scratch or is_delivered(a, limit_px)}
        remaining = [s for s in starts if s[0].name not in done]
        rig = None if self.model is None else self.model.rig
        if remaining and capture is not None and rig is not None:
            pairs = [pair for pair, _ in starts]
            names = bands_to_learn(pairs, self.result, rig, capture, limit_px)
            remaining = [s for s in remaining if s[0].name in names]
        results = self._optimised(
            remaining, [], lambda group, report: align_from_scratch(group, self.settings.joint, report)
        )
        if all(alignment.mapping.parallax is None for alignment in self.result.values()):
            self.verify(remaining, results)
            return
        # All bands have one relief: it is estimated again, and used if it delivers more of them.
        before, learned = dict(self.result), {pair.name: r for (pair, _), r in zip(remaining, results, strict=True)}
        known = [s for s in starts if s[0].name in learned or s[0].name in self.refined]
        self.verify(known, [learned.get(pair.name) or self.refined[pair.name].result for pair, _ in known])
        if sum(is_delivered(a, limit_px) for a in self.result.values()) <= sum(
            is_delivered(a, limit_px) for a in before.values()
        ):
            self.result = before

    def _align_by_windows(self, starts: Sequence[SeededPair]) -> None:
        """Align by windows the pairs without retrieval of held-out patches."""
        if self._may_be_homography:
            for pair, _ in starts:
                self.result[pair.name] = by_windows(pair, self.result[pair.name])

    def _optimised(
        self, starts: Sequence[SeededPair], sides: Sequence[int], align: Callable[[ImageGroup, Progress], Results]
    ) -> Results:
        """Return the results of the pairs, by image group, with the network's `sides`."""
        if not starts:
            return []
        report = partial(self.progress, starts[0][0].name)  # with the name of the first pair
        report("refining", 0.0)
        return aligned_groups(image_groups(starts, sides), lambda group: align(group, report))

    def verify(self, starts: Sequence[SeededPair], results: Results) -> None:
        """Combine the results of a capture by MAP estimation and verify each one.

        For an observation of the rig, no displacement fields are fitted. A model family that the user chose is not
        replaced by a relief or a displacement field.
        """
        self.refined |= {
            pair.name: RefinedPair(seed, result, pair.sizes_px)
            for (pair, seed), result in zip(starts, results, strict=True)
            if isinstance(result, JointResult)
        }
        use = self.settings.relief.use if self._may_be_homography else "never"
        candidates = self.candidates([Candidate.of(*start, r) for start, r in zip(starts, results, strict=True)])
        self.progress(starts[0][0].name if starts else "", "relief", 0.0)
        alignments, along_a_line = aligned_by_relief(candidates, use, is_observation=self.is_observation)
        for name, candidate in ((c.pair.name, c) for c in candidates if c.pair.name not in alignments):
            self.progress(name, "checking", 0.0)
            alignments[name] = verified(candidate, "never" if self.is_observation or name in along_a_line else use)
        self.result |= with_one_geometry([pair for pair, _ in starts], alignments)

    def candidates(self, measured: Sequence[Candidate]) -> list[Candidate]:
        """Return candidates after the MAP estimation of all bands of the capture."""
        if not self._may_be_homography:  # as the MAP estimate is
            return list(measured)
        pairs, joint = [c.pair for c in measured], {c.pair.name: c.joint for c in measured}
        residuals = {c.pair.name: c.warped.residual for c in measured}
        halves = (
            {name: r.chessboard_half(even=is_even_cell) for name, r in residuals.items()}
            for is_even_cell in (True, False)
        )
        rig = None if self.model is None else self.model.rig
        estimates, black, white = (map_estimate(pairs, joint, some, rig) for some in (residuals, *halves))
        return [
            replace(c, joint=estimates[n], by_halves=(black[n].fixed_to_moving, white[n].fixed_to_moving))
            for n, c in zip(joint, measured, strict=True)
        ]

    @property
    def _may_be_homography(self) -> bool:
        """False if the user chose a model family with fewer parameters."""
        return self.settings.joint.model_family in ("auto", "homography")


def is_delivered(alignment: Alignment, limit_px: float) -> bool:
    """Return True if a band is aligned, or predicted with a standard error of at most the limit."""
    if alignment.status == "predicted" and alignment.prediction is not None:
        return alignment.prediction.std_px <= limit_px
    return alignment.status == "aligned"


def is_retrieved(result: JointResult | Issue) -> bool:
    """Return True if the descriptors distinguish held-out patches."""
    return isinstance(result, JointResult) and result.retrieval >= max(MIN_RETRIEVAL, MIN_TIMES_CHANCE * result.chance)


def aligned_groups(groups: Sequence[tuple[list[int], ImageGroup]], align: Callable[[ImageGroup], Results]) -> Results:
    """Align groups of images, each with the indices of its pairs; return the results in the order of the pairs."""
    results: dict[int, JointResult | Issue] = {}
    for indices, group in groups:
        results |= zip(indices, align(group), strict=True)
    return [results[i] for i in sorted(results)]
