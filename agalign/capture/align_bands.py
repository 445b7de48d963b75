"""Alignment of the band pairs of one capture: seeds, joint estimation, verification of each pair."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.by_relief import aligned_by_relief
from agalign.capture.by_rig import bands_to_learn, with_predictions
from agalign.capture.by_windows import aligned_by_windows, without_extrapolated
from agalign.capture.candidate import Candidate
from agalign.capture.decision import at_seed, decided, of_one_geometry, verified, without_result
from agalign.capture.full_resolution import at_full_resolution
from agalign.capture.map_estimate import map_estimate
from agalign.capture.seeding import find_seed, image_groups
from agalign.capture.warped_pair import with_metrics
from agalign.config import Settings
from agalign.fit.occlusion import occluded
from agalign.flight.fingerprint import refinement_key
from agalign.flight.model import FlightModel
from agalign.method.device import one_thread
from agalign.method.joint import Results, align_from_scratch, refine_with
from agalign.method.refine import FLIGHT_PATCHES, PATCHES
from agalign.method.state import ImageGroup
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, RefinedPair, Seed
from agalign.values.capture import Band, Capture
from agalign.values.issues import SEED_ASKED_FOR, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import FixedFilePx, FixedImagePx

PairProgress = Callable[[str, str, float], None]
"""Called with the name of the band, the stage and its completed share, 0 to 1."""
Start = tuple[BandPair, Seed]
_Align = Callable[[ImageGroup, Callable[[str, float], None]], Results]


class _Timer:
    """Processing time by band; time for several bands is divided equally among them."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, names: Sequence[str]) -> Iterator[None]:
        """Measure the time of a block for these bands."""
        start = time.perf_counter()
        yield
        for name in names:
            self._seconds[name] = self._seconds.get(name, 0.0) + (time.perf_counter() - start) / len(names)

    def added_to(self, result: dict[str, Alignment[FixedImagePx]]) -> dict[str, Alignment[FixedImagePx]]:
        """Return the alignments with the measured times added."""
        return {name: replace(a, seconds=a.seconds + self._seconds.get(name, 0.0)) for name, a in result.items()}


def align_capture_bands(
    capture: Capture, settings: Settings, model: FlightModel | None, progress: PairProgress
) -> dict[str, Alignment[FixedFilePx]]:
    """Align every moving band of a capture; return the alignments by band, px of the files.

    A band that cannot be read is `failed`; the others are aligned. Raises UnreadableFileError if the reference cannot
    be read.
    """
    progress(capture.reference.name, "reading", 0.0)
    pairs, unusable = read_pairs(capture, settings.seed, model)
    aligned = align_pairs(pairs, settings, progress, model, capture)
    if model is not None and model.rig is not None and not settings.seed.only:
        aligned = with_predictions(pairs, aligned, model.rig, capture)
    if not settings.seed.only:
        aligned = without_extrapolated(pairs, aligned, None if model is None else model.rig)
    aligned = _with_metrics(pairs, aligned, progress, with_ties=settings.write.tie_points)
    result: dict[str, Alignment[FixedFilePx]] = {}
    for pair in pairs:
        result |= _between_files(capture, pair, aligned[pair.name])
    size_px = capture.reference.size_px
    for band in capture.moving:
        if band.name not in result:
            overlay = Seed("identity", geometry.overlay(size_px, band.size_px), 0.0)
            issues = (unusable[band.name],) if band.name in unusable else ()  # none in a band of the reference's lens
            mapping = PixelMapping(overlay.fixed_to_moving)
            result[band.name] = decided(Alignment(mapping, size_px, "failed", issues, overlay))
    reliefs = (a.mapping.parallax.relief for a in result.values() if a.mapping.parallax is not None)
    relief = next((relief.on_pixels(size_px) for relief in reliefs), None)  # the same in all bands
    return {band.name: _as_written(result[band.name], band, relief) for band in capture.moving}


def _as_written(alignment: Alignment[FixedFilePx], band: Band, relief: Relief | None) -> Alignment[FixedFilePx]:
    """Return the alignment of a band with the relief that is written: a reader of the sidecar has the same mapping."""
    mapping = alignment.mapping
    if relief is not None and mapping.parallax is not None:
        baseline = mapping.parallax.baseline
        mapping = mapping.with_parallax(Parallax(relief, baseline, occluded(relief, baseline)))
    return replace(alignment, mapping=mapping, moving_size_px=band.size_px)


def _between_files(
    capture: Capture, pair: BandPair, aligned: Alignment[FixedImagePx]
) -> dict[str, Alignment[FixedFilePx]]:
    """Convert the alignment of a pair to px of the files of its bands; refine it if the files have more pixels."""
    alignment = aligned.in_file_px(pair.scales, capture.reference.size_px)
    if pair.is_reduced and alignment.status == "aligned":
        alignment = at_full_resolution(capture.reference, pair.bands[0], alignment)
    shared = replace(alignment, seconds=alignment.seconds / len(pair.bands))
    return dict.fromkeys((b.name for b in pair.bands), shared)


def _with_metrics(
    pairs: Sequence[BandPair], result: dict[str, Alignment[FixedImagePx]], progress: PairProgress, *, with_ties: bool
) -> dict[str, Alignment[FixedImagePx]]:
    """Return the alignments with similarity metrics."""
    timer, measured = _Timer(), {}
    for pair in pairs:
        progress(pair.name, "measuring", 0.0)
        with timer.measure([pair.name]):
            measured[pair.name] = with_metrics(result[pair.name], pair, with_ties=with_ties)
    return timer.added_to(measured)


@one_thread()
def align_pairs(
    pairs: Sequence[BandPair],
    settings: Settings,
    progress: PairProgress,
    model: FlightModel | None = None,
    capture: Capture | None = None,
) -> dict[str, Alignment[FixedImagePx]]:
    """Align the pairs of one `capture`; return the alignments by name, px of the images.

    Pairs that the flight's network cannot align are learned from scratch, with a rig only those without an accurate
    prediction. A capture that the model was learned from has refined mappings in the model.
    """
    aligner = PairAligner(settings, model, progress)
    if capture is not None and model is not None:
        known = model.refined.get(refinement_key(capture, settings), {})
        if aligner.verify_refined(pairs, known):
            return aligner.timed_result()
    return aligner.align(pairs, capture)


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
    result: dict[str, Alignment[FixedImagePx]] = field(default_factory=dict)
    """Alignments by band."""
    timer: _Timer = field(default_factory=_Timer)

    def align(
        self, pairs: Sequence[BandPair], capture: Capture | None, *, scratch: bool = True
    ) -> dict[str, Alignment[FixedImagePx]]:
        """Take all steps. Without `scratch`, no pair that the flight's network contains is learned from scratch."""
        starts = self.seed(pairs)
        if self.settings.seed.only:
            self.keep_seeds(starts)
            return self.timed_result()
        self.refine(starts)
        remaining = [s for s in starts if not self.is_done(s)]
        if not scratch:
            remaining = [s for s in remaining if s[0].name not in self.result]
        if remaining and capture is not None:
            names = self.bands_to_learn(pairs, capture)
            remaining = [s for s in remaining if s[0].name in names]
        self.learn(remaining)
        self.align_by_windows(starts)
        self.result = of_one_geometry(pairs, self.result)
        return self.timed_result()

    def verify_refined(self, pairs: Sequence[BandPair], known: Mapping[str, RefinedPair]) -> bool:
        """Verify mappings that were refined when the flight was learned; False unless all pairs are aligned by them."""
        if not all(p.name in known and known[p.name].sizes_px == p.sizes_px for p in pairs):
            return False
        starts = [(pair, known[pair.name].seed) for pair in pairs]
        self.progress(pairs[0].name if pairs else "", "checking", 0.0)
        self._verify(starts, [known[pair.name].result for pair in pairs])
        if all(a.status == "aligned" for a in self.result.values()):
            return True
        self.result = {}
        return False

    def timed_result(self) -> dict[str, Alignment[FixedImagePx]]:
        """Return the alignments with their processing times."""
        return self.timer.added_to(self.result)

    def is_done(self, start: Start) -> bool:
        """Return True if the pair is aligned or predicted."""
        name = start[0].name
        return name in self.result and self.result[name].status in ("aligned", "predicted")

    def seed(self, pairs: Sequence[BandPair]) -> list[Start]:
        """Return the pairs with a seed; the other pairs are failed."""
        starts: list[Start] = []
        with self.timer.measure([p.name for p in pairs]):
            for pair in pairs:
                self.progress(pair.name, "seeding", 0.0)
                seed = find_seed(pair, self.settings.seed, self.model)
                if isinstance(seed, Issue):
                    self.result[pair.name] = without_result(
                        pair, Seed(*next(iter(pair.seed_matrices.items())), 0.0), seed
                    )
                else:
                    starts.append((pair, seed))
        return starts

    def keep_seeds(self, starts: Sequence[Start]) -> None:
        """Use the seeds as results, as the user requested."""
        for pair, seed in starts:
            with self.timer.measure([pair.name]):
                self.result[pair.name] = at_seed(pair, seed, (Issue(SEED_ASKED_FOR),), seed_only=True)

    def refine(self, starts: Sequence[Start]) -> None:
        """Align the pairs of the bands that the flight's network contains with this network."""
        model = self.model
        if model is None or self.settings.joint.recipe == "paper":
            return
        known = [s for s in starts if model.side(s[0].name) is not None]
        sides = [model.side(pair.name) or 0 for pair, _ in known]
        patches = PATCHES if model.rig is None else FLIGHT_PATCHES
        self._align(
            known, sides, lambda group, report: refine_with(model.net, group, self.settings.joint, report, patches)
        )

    def bands_to_learn(self, pairs: Sequence[BandPair], capture: Capture) -> set[str]:
        """Return the bands to learn from scratch; all without a rig."""
        if self.model is None or self.model.rig is None:
            return {pair.name for pair in pairs}
        return bands_to_learn(pairs, self.result, self.model.rig, capture, self.settings.check.accept_predicted_px)

    def learn(self, starts: Sequence[Start]) -> None:
        """Align pairs with networks that are learned from scratch."""
        self._align(starts, [], lambda group, report: align_from_scratch(group, self.settings.joint, report))

    def align_by_windows(self, starts: Sequence[Start]) -> None:
        """Align by windows the pairs without retrieval of held-out patches."""
        if not _may_be_homography(self.settings):
            return
        for pair, _ in starts:
            if pair.name in self.result:
                with self.timer.measure([pair.name]):
                    self.result[pair.name] = aligned_by_windows(pair, self.result[pair.name])

    def _align(self, starts: Sequence[Start], sides: Sequence[int], align: _Align) -> None:
        with self.timer.measure([pair.name for pair, _ in starts]):
            results = _results(starts, sides, align, self.progress)
        self._verify(starts, results)

    def _verify(self, starts: Sequence[Start], results: Results) -> None:
        self.refined |= refined_pairs(starts, results)
        self.result |= verify_together(
            starts, results, self.model, self.settings, self.progress, self.timer, is_observation=self.is_observation
        )


def refined_pairs(starts: Sequence[Start], results: Results) -> dict[str, RefinedPair]:
    """Return the refined mappings of the pairs that have one, by name."""
    return {
        pair.name: RefinedPair(seed, result, pair.sizes_px)
        for (pair, seed), result in zip(starts, results, strict=True)
        if isinstance(result, JointResult)
    }


def _may_be_homography(settings: Settings) -> bool:
    """Return False if the user chose a model family with fewer parameters."""
    return settings.joint.model_family in ("auto", "homography")


def _quiet(band: str, stage: str, share: float) -> None:
    """Ignore progress."""


def verify_together(
    starts: Sequence[Start],
    results: Results,
    model: FlightModel | None,
    settings: Settings,
    progress: PairProgress = _quiet,
    timer: _Timer | None = None,
    *,
    is_observation: bool = False,
) -> dict[str, Alignment[FixedImagePx]]:
    """Combine the results of a capture by MAP estimation and verify each one; return the alignments by name.

    For an observation of the rig, no displacement fields are fitted. A model family that the user chose is not replaced
    by a relief or a displacement field.
    """
    timer = timer or _Timer()
    use = settings.relief.use if _may_be_homography(settings) else "never"
    with timer.measure([pair.name for pair, _ in starts]):
        candidates = _candidates(starts, results, model, settings)
        progress(starts[0][0].name if starts else "", "relief", 0.0)
        lost = [start for start, result in zip(starts, results, strict=True) if isinstance(result, Issue)]
        relief = aligned_by_relief(list(candidates.values()), use, lost=lost, is_observation=is_observation)
    alignments = relief.alignments
    for (pair, seed), result in zip(starts, results, strict=True):
        if pair.name in alignments:
            continue
        progress(pair.name, "checking", 0.0)
        with timer.measure([pair.name]):
            if isinstance(result, Issue):
                alignments[pair.name] = at_seed(pair, seed, (result,))
            else:
                field_use = "never" if is_observation or pair.name in relief.along_a_line else use
                alignments[pair.name] = verified(candidates[pair.name], field_use)
    return of_one_geometry([pair for pair, _ in starts], alignments)


def _candidates(
    starts: Sequence[Start], results: Results, model: FlightModel | None, settings: Settings
) -> dict[str, Candidate]:
    """Return the pairs with a result, by name, after the MAP estimation of all bands of the capture."""
    measured = [
        Candidate.of(pair, seed, result)
        for (pair, seed), result in zip(starts, results, strict=True)
        if isinstance(result, JointResult)
    ]
    pairs, joint = [c.pair for c in measured], {c.pair.name: c.joint for c in measured}
    residuals = {c.pair.name: c.warped.residual for c in measured}
    halves = ({name: r.half(black=is_black) for name, r in residuals.items()} for is_black in (True, False))
    # The MAP estimate is a homography, which may not be of the family that the user chose.
    rig = None if model is None else model.rig
    estimates, black, white = (
        map_estimate(pairs, joint, some, rig) if _may_be_homography(settings) else joint
        for some in (residuals, *halves)
    )
    return {
        name: replace(c, joint=estimates[name], by_halves=(black[name].fixed_to_moving, white[name].fixed_to_moving))
        for name, c in zip(joint, measured, strict=True)
    }


def _results(
    starts: Sequence[Start], sides: Sequence[int], align: _Align, progress: PairProgress
) -> list[JointResult[FixedImagePx] | Issue]:
    """Align the pairs by image group, with the network's `sides`; return the results in the order of the pairs."""
    result: dict[int, JointResult[FixedImagePx] | Issue] = {}
    for indices, group in image_groups([p for p, _ in starts], [s for _, s in starts], sides):
        first = starts[indices[0]][0].name

        def report(stage: str, share: float, first: str = first) -> None:
            """Report the progress of the group with the name of its first pair."""
            progress(first, stage, share)

        report("refining", 0.0)
        result |= dict(zip(indices, align(group, report), strict=True))
    return [result[i] for i in range(len(starts))]
