"""Learning a flight: one network on a few of its captures, to be frozen for all of them."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agalign.capture.align import align_pairs, verify_together
from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.prediction import observed, with_predictions
from agalign.capture.seeding import find_seed, image_groups
from agalign.config import Settings
from agalign.errors import AgalignError
from agalign.flight.factors import median_mapping
from agalign.flight.fingerprint import fingerprint, hashed
from agalign.flight.groups import flight_camera, flight_lenses
from agalign.flight.learn_rig import learn_rig
from agalign.flight.model import FlightModel
from agalign.flight.rig import MIN_CAPTURES, Observation, Rig
from agalign.method.descriptor import Descriptor
from agalign.method.device import keep_freed_memory, one_memory_error, one_thread
from agalign.method.fast import DEFAULT_SCHEDULE, learn
from agalign.method.joint import Results, refine_with
from agalign.method.refine import FLIGHT_PATCHES, PATCHES
from agalign.method.starter import start_from
from agalign.method.state import ImageGroup, JointState, Progress
from agalign.pixels.raster import without_warnings
from agalign.values import geometry
from agalign.values.alignment import MIN_RETRIEVAL, Alignment, JointResult, Residual, Seed
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.pixel_units import FixedFilePx, FixedImagePx, MovingFilePx
from agalign.verify.displacement_field import common_field
from agalign.verify.extrapolation_check import unobserved_quarters
from agalign.verify.lens_shapes import unmodelled_std_px

_LOG = logging.getLogger(__name__)
_NETWORK_CAPTURES = 3
"""The network is learned on so many captures: what two do not show, a third mostly does, and each one costs seconds."""
_RIG_SHARE = 8
"""The rig is learned on one capture of so many: neighbours see the same heights and speeds,"""
_MIN_RIG_CAPTURES, _MAX_RIG_CAPTURES = 6, 48
"""but on no fewer than its factors need, and on no more than make it better."""


@one_thread()
@one_memory_error()
@without_warnings()
def learn_flight(
    captures: Sequence[Capture], settings: Settings, progress: Progress, start: FlightModel | None = None,
    at_once: int = 1,
) -> FlightModel | None:  # fmt: skip
    """Learn one network on a few captures spread over the flight; None where none of them could be aligned.

    So many captures are worked on at a time, each in a thread; on how many, nothing depends. `start` is the flight's
    model where some captures are aligned by it as its rig expects; else its network is where theta starts, and its last
    side where bands start that it does not know.
    """
    keep_freed_memory()
    fingerprint_now = learning_fingerprint(captures, settings)
    # Displacements of single captures are neither the network's nor the rig's.
    plain = settings.model_copy(update={"relief": settings.relief.model_copy(update={"use": "never"})})
    if start is not None and _still_holds(start, captures, plain, at_once):
        return replace(start, fingerprint=fingerprint_now)
    bands = flight_lenses(captures)
    loaded = _load(captures, bands, plain, start, at_once)
    network = _learn_network(loaded, bands, plain, progress, start, at_once)
    if network is None:
        return None
    net, known = network
    size = captures[0].reference.size_px
    mappings = {name: median_mapping(of, size) for name, of in _recognised(known).items()}
    if not mappings:
        return None
    model = FlightModel(net, flight_camera(captures), bands, mappings, fingerprint_now)
    rig = _learn_rig(captures, plain, model, {r.loaded.capture.label: r for r in known}, progress, at_once)
    if rig is None:
        rig = None if start is None else start.rig
    return replace(model, rig=rig, mappings=mappings if rig is None else {**mappings, **rig.mean})


def _learn_network(
    loaded: Sequence["_Loaded"], bands: Sequence[str], settings: Settings, progress: Progress,
    start: FlightModel | None, at_once: int,
) -> tuple[Descriptor, list["_Refined"]] | None:  # fmt: skip
    """(the network, the captures with their mappings refined by it); None where it cannot be learned from them."""
    if not loaded:
        return None
    state = JointState(settings.joint, progress)
    groups = [group for one in loaded for _, group in one.groups]
    net = state.fast_descriptor([1] * (1 + len(bands)))
    if start is not None:
        # A model of this camera may have bands that the flight lacks: weights go to the bands of the same names.
        sides = [0, *(start.side(band) or len(start.bands) for band in bands)] if start.camera else None
        start_from(net, start.net.state_dict(), sides)

    patches = FLIGHT_PATCHES if len(loaded) >= MIN_CAPTURES else PATCHES

    def refined() -> list[Results]:
        with ThreadPoolExecutor(at_once) as pool:
            return list(pool.map(lambda group: refine_with(net, group, settings.joint, progress, patches), groups))

    try:
        # The network that learning would start from is often good enough.
        results = refined() if net.is_trained and all(all(group.trusted) for group in groups) else []
        if not results or not all(map(_is_good_enough, results)):
            for group, of_group in zip(groups, results, strict=False):
                _move_to(group, of_group)
            learn(state, groups, net, at_once)
            results = refined()
    except Exception as why_not:
        # What one capture does to the others' learning must not cost the flight: each is learned alone then.
        _only_logged("the flight cannot be learned from", why_not)
        return None
    in_turn = iter(results)
    return net, [_Refined(one, one.in_order(in_turn)) for one in loaded]


def _is_good_enough(results: Results) -> bool:
    """True where a network needs no learning for a capture with these results."""
    enough = DEFAULT_SCHEDULE.enough_retrieval
    return all(isinstance(result, JointResult) and result.retrieval > enough for result in results)


def _move_to(group: ImageGroup, results: Results) -> None:
    """Start the pairs of a group with distinguishable patches where the network has moved them."""
    for band, result in enumerate(results):
        if isinstance(result, JointResult) and result.retrieval >= MIN_RETRIEVAL:
            group.mappings[band] = result.fixed_to_moving


def _recognised(refined: Sequence["_Refined"]) -> dict[str, list[Matrix]]:
    """The mappings of each band, between files, in the captures with distinguishable held-out patches."""
    mappings: dict[str, list[Matrix]] = {}
    for one in refined:
        for pair, result in zip(one.loaded.pairs, one.results, strict=True):
            if isinstance(result, JointResult) and result.retrieval >= MIN_RETRIEVAL:
                mappings.setdefault(pair.name, []).append(pair.scales.between_files(result.fixed_to_moving))
    return mappings


def _still_holds(model: FlightModel, captures: Sequence[Capture], settings: Settings, at_once: int) -> bool:
    """True where captures of a flight can be aligned, and a model's rig predicts each of their bands from the others
    well enough for a lost one to count as delivered.
    """
    rig, bands = model.rig, flight_lenses(captures)
    if rig is None or not set(bands) <= set(model.bands):
        return False

    def fits(capture: Capture) -> tuple[int, int]:
        """(bands that are aligned, those among them that the rig predicts)."""
        try:
            pairs, _ = read_pairs(capture, settings.seed, model)
            result = align_pairs(pairs, settings, lambda *_: None, model, scratch=False)
            checked = with_predictions(pairs, result, rig, capture)
        except Exception as why_not:
            _only_logged(f"{capture.label} is not aligned by the model", why_not)
            return 0, 0
        aligned = [checked[name] for name, a in result.items() if a.status == "aligned"]
        limit_px = settings.check.accept_predicted_px
        predicted = [a for a in aligned if a.prediction is not None and a.prediction.std_px <= limit_px]
        return len(aligned), len(predicted)

    with ThreadPoolExecutor(at_once) as pool:
        some = [captures[len(captures) * k // 3] for k in (1, 2)]
        counts = list(pool.map(fits, some))
    return sum(aligned for aligned, _ in counts) >= len(bands) and all(a == p for a, p in counts)


def _learn_rig(
    captures: Sequence[Capture], settings: Settings, model: FlightModel, known: Mapping[str, "_Refined"],
    progress: Progress, at_once: int,
) -> Rig | None:  # fmt: skip
    """What captures spread over the flight, refined with its network, have in common; some, by label, are already."""
    if len(captures) < MIN_CAPTURES:
        return None
    shown = _shown_by_enough(captures, settings, model, known, progress, at_once)
    size = captures[0].reference.size_px
    rig = learn_rig([s.observation for s in shown], size, _layout(captures))
    if rig is None:
        return None
    residuals = {band: [s.residuals[band] for s in shown if band in s.residuals] for band in rig.mean}
    with ThreadPoolExecutor(at_once) as pool:
        fields = list(pool.map(lambda of_band: common_field(of_band, size), residuals.values()))
    extrapolation_px = _extrapolation_px(rig, residuals, calibrated=captures[0].reference.lens is not None)
    return replace(
        rig, extrapolation_px=extrapolation_px,
        fields={
            band: field
            for band, field in zip(residuals, fields, strict=True)
            if field is not None and band not in extrapolation_px
        },
    )  # fmt: skip


def _extrapolation_px(
    rig: Rig, residuals: Mapping[str, Sequence[Residual[FixedFilePx]]], *, calibrated: bool
) -> dict[str, MovingFilePx]:
    """What the lenses may leave in bands with a quarter of the image that no capture shows, px of their files."""
    result: dict[str, MovingFilePx] = {}
    for band, of_band in residuals.items():
        centres_px = np.concatenate([r.measured_px for r in of_band])
        if unobserved_quarters(centres_px, rig.size_px):
            ratio = abs(float(geometry.local_scale(rig.mean[band], *rig.size_px)[-1]))
            std_px = unmodelled_std_px(centres_px, rig.size_px, calibrated=calibrated)
            result[band] = MovingFilePx(std_px * ratio)
    return result


def _shown_by_enough(
    captures: Sequence[Capture], settings: Settings, model: FlightModel, known: Mapping[str, "_Refined"],
    progress: Progress, at_once: int,
) -> list["_Shown"]:  # fmt: skip
    """What captures show of the rig, until enough of them have shown every band that any of them has."""
    count = min(_MAX_RIG_CAPTURES, max(_MIN_RIG_CAPTURES, len(captures) // _RIG_SHARE))

    def look_at(capture: Capture) -> "_Shown | None":
        try:
            return _shown(capture, settings, model, known.get(capture.label))
        except Exception as why_not:
            _only_logged(f"{capture.label} does not determine the rig", why_not)
            return None

    result: list[_Shown] = []
    counts: Counter[str] = Counter()
    with ThreadPoolExecutor(at_once) as pool:
        # The network's captures cost less than others: they come first where they may be enough, else last.
        quick = [c for c in captures if c.label in known]
        slow = [c for c in _spread(captures, count) if c.label not in known]
        for shown in pool.map(look_at, [*quick, *slow] if len(captures) > count else [*slow, *quick]):
            if shown is None:
                continue
            result.append(shown)
            counts.update(list(shown.residuals))
            progress("the rig", min(1.0, len(result) / count))
            if counts and min(counts.values()) >= count:
                break
    return result


def _spread(captures: Sequence[Capture], count: int) -> list[Capture]:
    """So many captures all over a flight, then as many between them, for where some of the first show nothing."""
    places = np.unique(np.linspace(0, len(captures) - 1, 2 * count - 1).round().astype(int))
    return [captures[i] for i in (*places[::2], *places[1::2])]


def _layout(captures: Iterable[Capture]) -> dict[str, tuple[float, float]]:
    """Where the lenses are relative to the reference's, as far as the camera has it."""
    result: dict[str, tuple[float, float]] = {}
    for capture in captures:
        here = capture.reference.parallax
        for band in capture.moving:
            if here is not None and band.parallax is not None:
                result.setdefault(band.name, (band.parallax[0] - here[0], band.parallax[1] - here[1]))
    return result


def learning_fingerprint(captures: Sequence[Capture], settings: Settings) -> str:
    """Changes when the captures that would be learnt from, or the settings, do."""
    stages = settings.joint, settings.seed, settings.flight
    return hashed(flight_camera(captures), *(fingerprint(c, *stages) for c in captures))


@dataclass(frozen=True)
class _Loaded:
    """A capture to learn from."""

    capture: Capture
    groups: list[tuple[list[int], ImageGroup]]
    """Each with the places of its pairs."""
    pairs: list[BandPair]
    seeds: list[Seed]

    def in_order(self, refined: Iterator[Results]) -> Results:
        """The results of its pairs, from those of its subjects."""
        result = {i: r for places, _ in self.groups for i, r in zip(places, next(refined), strict=True)}
        return [result[i] for i in range(len(self.pairs))]

    @property
    def shows(self) -> float:
        """How plainly its bands show the same, in standard deviations of their seeds' peaks."""
        return float(np.median([s.peak_sigma for s in self.seeds]))


@dataclass(frozen=True)
class _Refined:
    """A capture that was learnt from, with what was found."""

    loaded: _Loaded
    results: Results


@dataclass(frozen=True)
class _Shown:
    """Observation of the rig by one capture: its mappings, and the residual shifts of its windows."""

    observation: Observation
    residuals: dict[str, Residual[FixedFilePx]]


def _shown(capture: Capture, settings: Settings, model: FlightModel, known: _Refined | None) -> _Shown:
    """Raises UnreadableFileError where the reference cannot be read."""
    result: Mapping[str, Alignment[FixedImagePx]] = {}
    if known is not None:
        pairs = known.loaded.pairs
        starts = list(zip(pairs, known.loaded.seeds, strict=True))
        result = verify_together(starts, known.results, model, settings)
    if not result or any(
        a.status != "aligned" and a.joint is not None and a.joint.retrieval >= MIN_RETRIEVAL for a in result.values()
    ):
        # The model's mappings are better initial alignments than those that the network was learned from.
        pairs, _ = read_pairs(capture, settings.seed, model)
        result = align_pairs(pairs, settings, lambda *_: None, model, scratch=False)
    pairs = [p for p in pairs if p.has_rig_pixels]
    in_file_px = {p.name: result[p.name].in_file_px(p.scales) for p in pairs}
    good = {b: a.residual for b, a in in_file_px.items() if a.status == "aligned" and a.residual is not None}
    return _Shown(observed(pairs, result, capture), good)


def _load(
    captures: Sequence[Capture], bands: Sequence[str], settings: Settings, start: FlightModel | None, at_once: int
) -> list[_Loaded]:
    """Of each stretch of the flight, one capture: the first of three with bands that plainly show the same, else the
    one that shows it best. Water and fog teach nothing.
    """

    def best_of(stretch: NDArray[np.intp]) -> _Loaded | None:
        best: _Loaded | None = None
        for k in dict.fromkeys((len(stretch) // 2, 0, len(stretch) - 1)):
            result = _read(captures[stretch[k]], bands, settings, start)
            if result is not None and (best is None or result.shows > best.shows):
                best = result
            if best is not None and all(s.trusted for s in best.seeds):
                break
        return best

    stretches = np.array_split(np.arange(len(captures)), min(_NETWORK_CAPTURES, len(captures)))
    with ThreadPoolExecutor(at_once) as pool:
        return [best for best in pool.map(best_of, stretches) if best is not None]


def _read(capture: Capture, bands: Sequence[str], settings: Settings, start: FlightModel | None) -> _Loaded | None:
    """None where there is nothing that can be read. The network's side of a band is its place among `bands`.

    `start` is the network with which a seed of kind `match` is found.
    """
    try:
        pairs, _ = read_pairs(capture, settings.seed)
        seeds_of = [(p, find_seed(p, settings.seed, start)) for p in pairs if p.has_rig_pixels]
        result = [(p, seed) for p, seed in seeds_of if isinstance(seed, Seed)]
        if not result:
            return None
        usable, seeds = [p for p, _ in result], [seed for _, seed in result]
        return _Loaded(capture, image_groups(usable, seeds, [bands.index(p.name) + 1 for p in usable]), usable, seeds)
    except Exception as why_not:
        _only_logged(f"{capture.label} cannot be learned from", why_not)
        return None


def _only_logged(what: str, why_not: Exception) -> None:
    """A capture that cannot be learned from costs the flight nothing, whatever is wrong with it: it is reported when it
    is aligned. Raises MemoryError, which is the machine's.
    """
    if isinstance(why_not, MemoryError):
        raise why_not
    _LOG.debug("%s: %s", what, why_not, exc_info=not isinstance(why_not, AgalignError))
