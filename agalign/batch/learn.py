"""Learn the model of a flight: one network for all its captures, from a few of them, and its rig."""

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
"""Number of captures that the network is learned from; each takes seconds. A third capture mostly shows the structure
that two lack."""
_CAPTURES_PER_RIG_CAPTURE = 8
"""The rig is learned from one of this many captures: neighbours have about the same height and speed."""
_MIN_RIG_CAPTURES, _MAX_RIG_CAPTURES = 6, 48
"""The factors of the rig need the minimum; more than the maximum do not improve it."""


@one_thread()
@one_memory_error()
@without_warnings()
def learn_flight(
    captures: Sequence[Capture], settings: Settings, progress: Progress, start: FlightModel | None = None,
    at_once: int = 1,
) -> FlightModel | None:  # fmt: skip
    """Return a model learned from a few captures spread over the flight; None if none of them could be aligned.

    `at_once` captures are processed at a time, each in a thread; the result does not depend on it. `start` is an
    earlier model. It is returned if it still aligns captures of this flight as its rig predicts. Otherwise its network
    initialises theta; weights of bands that it lacks start from those of its last band.
    """
    keep_freed_memory()
    fingerprint_now = learning_fingerprint(captures, settings)
    # Neither the network nor the rig models the displacements of single captures.
    without_relief = settings.model_copy(update={"relief": settings.relief.model_copy(update={"use": "never"})})
    if start is not None and _still_holds(start, captures, without_relief, at_once):
        return replace(start, fingerprint=fingerprint_now)
    bands = flight_lenses(captures)
    loaded = _load(captures, bands, without_relief, start, at_once)
    network = _learn_network(loaded, bands, without_relief, progress, start, at_once)
    if network is None:
        return None
    net, known = network
    size = captures[0].reference.size_px
    mappings = {name: median_mapping(of, size) for name, of in _recognised(known).items()}
    if not mappings:
        return None
    model = FlightModel(net, flight_camera(captures), bands, mappings, fingerprint_now)
    refined = {r.loaded.capture.label: r for r in known}
    rig = _learn_rig(captures, without_relief, model, refined, progress, at_once)
    if rig is None:
        rig = None if start is None else start.rig
    return replace(model, rig=rig, mappings=mappings if rig is None else {**mappings, **rig.mean})


def _learn_network(
    loaded: Sequence["_Loaded"], bands: Sequence[str], settings: Settings, progress: Progress,
    start: FlightModel | None, at_once: int,
) -> tuple[Descriptor, list["_Refined"]] | None:  # fmt: skip
    """Return (the network, the captures with mappings refined by it); None if learning fails."""
    if not loaded:
        return None
    state = JointState(settings.joint, progress)
    groups = [group for one in loaded for _, group in one.groups]
    net = state.fast_descriptor([1] * (1 + len(bands)))
    if start is not None:
        # A model of this camera may have bands that the flight lacks: match the weights by band name.
        sides = [0, *(start.side(band) or len(start.bands) for band in bands)] if start.camera else None
        start_from(net, start.net.state_dict(), sides)

    patches = FLIGHT_PATCHES if len(loaded) >= MIN_CAPTURES else PATCHES

    def refined() -> list[Results]:
        with ThreadPoolExecutor(at_once) as pool:
            return list(pool.map(lambda group: refine_with(net, group, settings.joint, progress, patches), groups))

    try:
        # The initial network is often good enough.
        results = refined() if net.is_trained and all(all(group.trusted) for group in groups) else []
        if not results or not all(map(_is_good_enough, results)):
            for group, of_group in zip(groups, results, strict=False):
                _move_to(group, of_group)
            learn(state, groups, net, at_once)
            results = refined()
    except Exception as error:
        # One capture may make learning from all of them fail; a network is then learned for each capture alone.
        _log_failure("the flight cannot be learned from", error)
        return None
    in_turn = iter(results)
    return net, [_Refined(one, one.in_order(in_turn)) for one in loaded]


def _is_good_enough(results: Results) -> bool:
    """True if a network needs no more learning for a capture with these results."""
    enough = DEFAULT_SCHEDULE.enough_retrieval
    return all(isinstance(result, JointResult) and result.retrieval > enough for result in results)


def _move_to(group: ImageGroup, results: Results) -> None:
    """Set the initial mappings of a group's pairs with distinguishable patches to the results of the network."""
    for band, result in enumerate(results):
        if isinstance(result, JointResult) and result.retrieval >= MIN_RETRIEVAL:
            group.mappings[band] = result.fixed_to_moving


def _recognised(refined: Sequence["_Refined"]) -> dict[str, list[Matrix]]:
    """Return the mappings (file px) of each band, from captures with distinguishable held-out patches."""
    mappings: dict[str, list[Matrix]] = {}
    for one in refined:
        for pair, result in zip(one.loaded.pairs, one.results, strict=True):
            if isinstance(result, JointResult) and result.retrieval >= MIN_RETRIEVAL:
                mappings.setdefault(pair.name, []).append(pair.scales.between_files(result.fixed_to_moving))
    return mappings


def _still_holds(model: FlightModel, captures: Sequence[Capture], settings: Settings, at_once: int) -> bool:
    """True if two captures of the flight can be aligned, and the model's rig predicts each aligned band from the
    others with a standard error of at most `accept_predicted_px`.
    """
    rig, bands = model.rig, flight_lenses(captures)
    if rig is None or not set(bands) <= set(model.bands):
        return False

    def fits(capture: Capture) -> tuple[int, int]:
        """Return the number of aligned bands, and of those among them that the rig predicts."""
        try:
            pairs, _ = read_pairs(capture, settings.seed, model)
            result = align_pairs(pairs, settings, lambda *_: None, model, scratch=False)
            checked = with_predictions(pairs, result, rig, capture)
        except Exception as error:
            _log_failure(f"{capture.label} is not aligned by the model", error)
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
    """Return the rig of captures spread over the flight; `known` are those, by label, that the network has refined."""
    if len(captures) < MIN_CAPTURES:
        return None
    observations = _observe_rig(captures, settings, model, known, progress, at_once)
    size = captures[0].reference.size_px
    rig = learn_rig([o.observation for o in observations], size, _layout(captures))
    if rig is None:
        return None
    residuals = {band: [o.residuals[band] for o in observations if band in o.residuals] for band in rig.mean}
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
    """Return the standard error (px of the band's file) from the lens in a quarter of the image without measurements.

    Only bands with such a quarter are in the result.
    """
    result: dict[str, MovingFilePx] = {}
    for band, of_band in residuals.items():
        centres_px = np.concatenate([r.measured_px for r in of_band])
        if unobserved_quarters(centres_px, rig.size_px):
            ratio = abs(float(geometry.local_scale(rig.mean[band], *rig.size_px)[-1]))
            std_px = unmodelled_std_px(centres_px, rig.size_px, calibrated=calibrated)
            result[band] = MovingFilePx(std_px * ratio)
    return result


def _observe_rig(
    captures: Sequence[Capture], settings: Settings, model: FlightModel, known: Mapping[str, "_Refined"],
    progress: Progress, at_once: int,
) -> list["_RigObservation"]:  # fmt: skip
    """Return observations of the rig, until every observed band is in enough of them."""
    count = min(_MAX_RIG_CAPTURES, max(_MIN_RIG_CAPTURES, len(captures) // _CAPTURES_PER_RIG_CAPTURE))

    def observe(capture: Capture) -> "_RigObservation | None":
        try:
            return _rig_observation(capture, settings, model, known.get(capture.label))
        except Exception as error:
            _log_failure(f"{capture.label} does not determine the rig", error)
            return None

    result: list[_RigObservation] = []
    counts: Counter[str] = Counter()
    with ThreadPoolExecutor(at_once) as pool:
        # Captures that the network was learned from take less time: they come first if there may be enough of them.
        quick = [c for c in captures if c.label in known]
        slow = [c for c in _spread(captures, count) if c.label not in known]
        for observation in pool.map(observe, [*quick, *slow] if len(captures) > count else [*slow, *quick]):
            if observation is None:
                continue
            result.append(observation)
            counts.update(list(observation.residuals))
            progress("the rig", min(1.0, len(result) / count))
            if counts and min(counts.values()) >= count:
                break
    return result


def _spread(captures: Sequence[Capture], count: int) -> list[Capture]:
    """Return `count` captures evenly spread over the flight, then those halfway between them as replacements."""
    places = np.unique(np.linspace(0, len(captures) - 1, 2 * count - 1).round().astype(int))
    return [captures[i] for i in (*places[::2], *places[1::2])]


def _layout(captures: Iterable[Capture]) -> dict[str, tuple[float, float]]:
    """Return the positions of the lenses relative to the reference's, where the metadata contains them."""
    result: dict[str, tuple[float, float]] = {}
    for capture in captures:
        reference = capture.reference.parallax
        for band in capture.moving:
            if reference is not None and band.parallax is not None:
                result.setdefault(band.name, (band.parallax[0] - reference[0], band.parallax[1] - reference[1]))
    return result


def learning_fingerprint(captures: Sequence[Capture], settings: Settings) -> str:
    """Return a hash of everything that a learned model depends on: the captures and the settings."""
    stages = settings.joint, settings.seed, settings.flight
    return hashed(flight_camera(captures), *(fingerprint(c, *stages) for c in captures))


@dataclass(frozen=True)
class _Loaded:
    """A capture to learn from."""

    capture: Capture
    groups: list[tuple[list[int], ImageGroup]]
    """Groups of images, each with the indices of its pairs in `pairs`."""
    pairs: list[BandPair]
    seeds: list[Seed]

    def in_order(self, refined: Iterator[Results]) -> Results:
        """The results in the order of `pairs`, from those of `groups`."""
        result = {i: r for places, _ in self.groups for i, r in zip(places, next(refined), strict=True)}
        return [result[i] for i in range(len(self.pairs))]

    @property
    def similarity_sigma(self) -> float:
        """Median height of the correlation peaks of the seeds, in standard deviations."""
        return float(np.median([s.peak_sigma for s in self.seeds]))


@dataclass(frozen=True)
class _Refined:
    """A capture that the network was learned from, with its refined mappings."""

    loaded: _Loaded
    results: Results


@dataclass(frozen=True)
class _RigObservation:
    """Observation of the rig by one capture: its mappings, and the residual shifts of its windows."""

    observation: Observation
    residuals: dict[str, Residual[FixedFilePx]]


def _rig_observation(
    capture: Capture, settings: Settings, model: FlightModel, known: _Refined | None
) -> _RigObservation:
    """Observe the rig in one capture. Raises UnreadableFileError if the reference cannot be read."""
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
    return _RigObservation(observed(pairs, result, capture), good)


def _load(
    captures: Sequence[Capture], bands: Sequence[str], settings: Settings, start: FlightModel | None, at_once: int
) -> list[_Loaded]:
    """Return one capture from each third of the flight: the first of three with trusted seeds for all bands, else the
    one with the highest correlation peaks. Captures without common structure, as of water or fog, are not usable.
    """

    def best_of(stretch: NDArray[np.intp]) -> _Loaded | None:
        best: _Loaded | None = None
        for k in dict.fromkeys((len(stretch) // 2, 0, len(stretch) - 1)):
            result = _read(captures[stretch[k]], bands, settings, start)
            if result is not None and (best is None or result.similarity_sigma > best.similarity_sigma):
                best = result
            if best is not None and all(s.trusted for s in best.seeds):
                break
        return best

    stretches = np.array_split(np.arange(len(captures)), min(_NETWORK_CAPTURES, len(captures)))
    with ThreadPoolExecutor(at_once) as pool:
        return [best for best in pool.map(best_of, stretches) if best is not None]


def _read(capture: Capture, bands: Sequence[str], settings: Settings, start: FlightModel | None) -> _Loaded | None:
    """Read a capture and find its seeds; None if no band can be used.

    Bands have their index in `bands` as index in the network. Seeds of kind `match` use the network of `start`.
    """
    try:
        pairs, _ = read_pairs(capture, settings.seed)
        seeds_of = [(p, find_seed(p, settings.seed, start)) for p in pairs if p.has_rig_pixels]
        result = [(p, seed) for p, seed in seeds_of if isinstance(seed, Seed)]
        if not result:
            return None
        usable, seeds = [p for p, _ in result], [seed for _, seed in result]
        return _Loaded(capture, image_groups(usable, seeds, [bands.index(p.name) + 1 for p in usable]), usable, seeds)
    except Exception as error:
        _log_failure(f"{capture.label} cannot be learned from", error)
        return None


def _log_failure(message: str, error: Exception) -> None:
    """Log why a capture cannot be used for learning; it is reported when it is aligned. Raises MemoryError again."""
    if isinstance(error, MemoryError):
        raise error
    _LOG.debug("%s: %s", message, error, exc_info=not isinstance(error, AgalignError))
