"""The band pairs of one capture: seeded, aligned together, each one checked."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.full_resolution import at_full_resolution
from agalign.capture.map_estimate import map_estimate
from agalign.capture.prediction import with_predictions, worth_learning
from agalign.capture.seeding import find_seed, image_groups, unscored
from agalign.capture.verification import WarpedPair, verified, with_metrics, without_result
from agalign.config import Settings
from agalign.flight.model import FlightModel
from agalign.method.device import one_thread
from agalign.method.joint import Results, align_from_scratch, refine_with
from agalign.method.state import ImageGroup
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Seed
from agalign.values.capture import Capture
from agalign.values.issues import Issue

PairProgress = Callable[[str, str, float], None]
"""Called with the band's name, the stage, and the share of the stage that is behind."""
Start = tuple[BandPair, Seed]
_Align = Callable[[ImageGroup, Callable[[str, float], None]], Results]


def align_capture_bands(
    capture: Capture, settings: Settings, model: FlightModel | None, progress: PairProgress
) -> dict[str, Alignment]:
    """Align every moving band of a capture, by name; a band that cannot be read is `failed` and stops no other.

    Raises UnreadableFileError where the reference cannot be read.
    """
    reference = capture.reference
    progress(reference.name, "reading", 0.0)
    pairs, left_out = read_pairs(capture, settings, model)
    aligned = align_pairs(pairs, settings, progress, model, capture)
    if model is not None and model.rig is not None and not settings.seed.only:
        aligned = with_predictions(pairs, aligned, model.rig, capture, settings.check)
    aligned = _measured(pairs, aligned, progress)
    result: dict[str, Alignment] = {}
    for band in capture.bands_of_the_references_lens:
        unmoved = Seed("identity", geometry.identity(), 0.0)
        result[band.name] = Alignment(unmoved.fixed_to_moving, "pixel", "aligned", (), unmoved, None, None, 0.0)
    for pair in pairs:
        alignment = aligned[pair.name].between_files(*pair.scales)
        if pair.is_reduced and alignment.status == "aligned":
            alignment = at_full_resolution(reference, pair.bands[0], alignment, settings.check)
        shared = replace(alignment, seconds=alignment.seconds / len(pair.bands))
        result |= dict.fromkeys((b.name for b in pair.bands), shared)
    for band in capture.moving:
        if band.name in left_out:
            lying = Seed("identity", geometry.overlay(reference.size_px, band.size_px), 0.0)
            result[band.name] = without_result(lying, "pixel", left_out[band.name])
    return {band.name: result[band.name] for band in capture.moving}


def verify_together(
    starts: Sequence[Start], results: Sequence[JointResult | Issue], model: FlightModel | None, settings: Settings
) -> Iterator[tuple[str, Alignment]]:
    """The alignments of a capture's pairs, by name, of which these results were found: moved to what is most probable
    of all bands together, each one checked.
    """
    warped_pairs = [
        WarpedPair.at(pair, pair.mapping(result.fixed_to_moving)) if isinstance(result, JointResult) else None
        for (pair, _), result in zip(starts, results, strict=True)
    ]
    better = _whole(starts, results, warped_pairs, model, settings)
    for (pair, seed), result, warped_pair in zip(starts, better, warped_pairs, strict=True):
        yield pair.name, verified(pair, seed, result, settings, warped_pair)


def _measured(pairs: Sequence[BandPair], result: dict[str, Alignment], progress: PairProgress) -> dict[str, Alignment]:
    """With metrics, whose time is the pair's too."""
    watch, measured = _Watch(), {}
    for pair in pairs:
        progress(pair.name, "measuring", 0.0)
        measured[pair.name] = with_metrics(result[pair.name], pair)
        watch.lap([pair.name])
    return watch.added_to(measured)


@one_thread()
def align_pairs(
    pairs: Sequence[BandPair], settings: Settings, progress: PairProgress, model: FlightModel | None = None,
    capture: Capture | None = None, *, scratch: bool = True,
) -> dict[str, Alignment]:  # fmt: skip
    """Align the pairs of one `capture`, which share a reference, by name.

    Those that the flight's network cannot align are learnt from scratch, together; with a rig at hand only those that
    are worth it, and without `scratch` none.
    """
    watch = _Watch()
    result: dict[str, Alignment] = {}
    starts: list[Start] = []
    for pair in pairs:
        progress(pair.name, "seeding", 0.0)
        seed = find_seed(pair, model)
        if isinstance(seed, Issue):
            result[pair.name] = without_result(unscored(pair), pair.space, seed)
        else:
            starts.append((pair, seed))
    watch.lap([p.name for p in pairs])
    if settings.seed.only:
        asked = Issue("seed_asked_for")
        result |= {pair.name: verified(pair, seed, asked, settings) for pair, seed in starts}
        watch.lap([pair.name for pair, _ in starts])
        return watch.added_to(result)

    def attempt(some: Sequence[Start], sides: Sequence[int], align: _Align) -> None:
        results = _results(some, sides, align, progress)
        watch.lap([pair.name for pair, _ in some])
        verified_pairs = verify_together(some, results, model, settings)
        for pair, _ in some:
            progress(pair.name, "checking", 0.0)
            name, result[name] = next(verified_pairs)
            watch.lap([name])

    if model is not None and settings.joint.recipe == "fast":
        net = model.net
        known = [s for s in starts if model.side(s[0].name) is not None]
        sides = [model.side(pair.name) or 0 for pair, _ in known]
        attempt(known, sides, lambda group, report: refine_with(net, group, settings.joint, report))
    left = [s for s in starts if s[0].name not in result or result[s[0].name].status != "aligned"]
    if left and model is not None and model.rig is not None and capture is not None:
        worth = worth_learning(pairs, result, model.rig, capture, settings.check)
        left = [s for s in left if s[0].name in worth]
    if not scratch:
        left = [s for s in left if s[0].name not in result]
    attempt(left, [], lambda group, report: align_from_scratch(group, settings.joint, report))
    return watch.added_to(result)


def _results(
    starts: Sequence[Start], sides: Sequence[int], align: _Align, progress: PairProgress
) -> list[JointResult | Issue]:
    """In the order of the pairs; those that share a subject are aligned together, with the network's `sides`."""
    result: dict[int, JointResult | Issue] = {}
    for places, group in image_groups([p for p, _ in starts], [s for _, s in starts], sides):
        first = starts[places[0]][0].name

        def report(stage: str, share: float, first: str = first) -> None:
            """Pairs that advance together are told as the first one."""
            progress(first, stage, share)

        report("refining", 0.0)
        result |= dict(zip(places, align(group, report), strict=True))
    return [result[i] for i in range(len(starts))]


def _whole(
    starts: Sequence[Start], results: Sequence[JointResult | Issue], warped_pairs: Sequence[WarpedPair | None],
    model: FlightModel | None, settings: Settings,
) -> list[JointResult | Issue]:  # fmt: skip
    """The results moved to what is most probable of all bands of the capture together."""
    if settings.joint.model_family not in ("auto", "homography"):
        return list(results)  # what was asked for is not left
    names = [pair.name for pair, _ in starts]
    result = {name: r for name, r in zip(names, results, strict=True) if isinstance(r, JointResult)}
    shown = {
        name: warped_pair.residual
        for name, warped_pair in zip(names, warped_pairs, strict=True)
        if warped_pair is not None
    }
    rig = None if model is None else model.rig
    better = map_estimate([pair for pair, _ in starts], result, shown, rig)
    return [better[name] if isinstance(r, JointResult) else r for name, r in zip(names, results, strict=True)]


class _Watch:
    """Seconds by name; what is done for several together is shared by them."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, names: Sequence[str]) -> None:
        """The time since the last lap was theirs."""
        now = time.perf_counter()
        for name in names:
            self._seconds[name] = self._seconds.get(name, 0.0) + (now - self._since) / len(names)
        self._since = now

    def added_to(self, result: dict[str, Alignment]) -> dict[str, Alignment]:
        return {name: replace(a, seconds=a.seconds + self._seconds.get(name, 0.0)) for name, a in result.items()}
