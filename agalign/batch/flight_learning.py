"""Learn the model of a flight: one network for all its captures, from a few of them, and its rig."""

import logging
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from agalign.batch.capture_task import in_one_thread
from agalign.batch.learning_tasks import (
    LearningCapture,
    choose_and_refine,
    initial_network,
    load_capture,
    logged_failure,
    observe_rig,
    portable,
)
from agalign.batch.workers import RunTasks, in_order, serially
from agalign.capture.by_rig import DELIVERED_STD_PX
from agalign.config import Settings
from agalign.fit.displacement_field import common_field
from agalign.flight.groups import flight_camera, flight_lenses
from agalign.flight.learn_rig import learn_rig
from agalign.flight.model import FlightModel
from agalign.flight.rig import MIN_CAPTURES, Observation, Rig, median_mapping
from agalign.flight.rig_prediction import contradicts, predict_band
from agalign.host.process_pool import A, R
from agalign.host.text import some_of
from agalign.method.descriptor import Descriptor
from agalign.method.device import keep_freed_memory, one_memory_error, one_thread
from agalign.method.fast import learn
from agalign.method.state import JointState, Progress
from agalign.pixels.gdal import without_warnings
from agalign.values.capture import Capture, relative_parallax
from agalign.values.geometry import Matrix
from agalign.values.lens_shapes import lens_std_px
from agalign.values.residual import Residual
from agalign.verify.coverage import unmodelled_std_px

_MIN_RIG_CAPTURES, _MAX_RIG_CAPTURES = 6, 48
"""The factors of the rig need the minimum; more than the maximum do not improve it."""


@one_thread()
@one_memory_error()
@without_warnings()
def learn_flight(
    captures: Sequence[Capture],
    settings: Settings,
    progress: Progress,
    start: FlightModel | None = None,
    run_tasks: RunTasks = serially,
    threads: int = 1,
    timeout_s: float | None = None,
) -> FlightModel | None:
    """Return a model learned from a few captures spread over the flight, without its fingerprint; None if none of three
    or more could be aligned and there is no `start`. The network of fewer captures is not trained on them.

    `run_tasks` processes single captures, and `threads` train the network; the result does not depend on them. Captures
    that exceed the time limit are not learned from.
    `start` is an earlier model. It is returned if it still aligns captures of this flight as its rig predicts.
    Otherwise its network initialises theta; weights of bands that it lacks start from those of its last band. Its rig
    is that of a flight that determines none, unless a capture contradicts it.
    """
    keep_freed_memory()
    captures = [capture.with_absolute_paths() for capture in captures]

    learned = _FlightLearner(captures, settings, progress, start, run_tasks, threads, timeout_s).learned()
    if learned is None:
        return None
    times = sorted(c.known_time for c in captures if c.known_time)
    return replace(
        learned,
        folder=Path(os.path.commonpath([c.folder for c in captures])).as_posix(),
        captured_at=tuple(dict.fromkeys((times[0], times[-1]))) if times else (),
    )


def captures_to_learn_from(captures: Sequence[Capture]) -> list[Capture]:
    """Return the captures whose images `learn_flight` may read, with the alternatives to those that are not usable."""
    stretches, others = _stretches_and_others(captures)
    groups = *stretches, *others, _spread(captures, _rig_captures(captures)), _to_test_a_model(captures)
    return list({capture.label: capture for group in groups for capture in group}.values())


@dataclass(frozen=True)
class _FlightLearner:
    """The steps of `learn_flight`."""

    captures: Sequence[Capture]
    settings: Settings
    progress: Progress
    start: FlightModel | None
    run_tasks: RunTasks
    threads: int
    timeout_s: float | None

    def learned(self) -> FlightModel | None:
        """Return the model, without its times and folder."""
        start, rig = self.start, self._start_rig
        if start is not None and rig is not None and set(self._bands) <= set(start.bands):
            observations = self._observed(start)
            if _contradict(rig, observations):
                return replace(self, start=replace(start, rig=None)).learned()
            if self._holds(rig, observations):
                return start
        are_enough = len(self.captures) >= MIN_CAPTURES
        if are_enough and (learned := self._from_captures()) is not None:
            return learned
        if self.start is None and (are_enough or self.settings.joint.recipe == "scratch"):
            return None  # a network is learned for each capture that needs it
        # The rig of an earlier model predicts the bands of captures that nothing can be learned from, as over water.
        # Learning takes as long as aligning one or two captures, and those that need it are learned from alone.
        net, rig = initial_network(self._bands, self.settings, self.start), self._start_rig
        known_mappings = {} if rig is None else rig.mean
        camera = flight_camera(self.captures)
        return FlightModel(net, camera, self._bands, known_mappings, "", rig)

    def _from_captures(self) -> FlightModel | None:
        """Learn network and rig from MIN_CAPTURES captures or more; None if no band of them can be aligned."""
        network = self._network()
        if network is None:
            return None
        net, known = network
        mappings = defaultdict[str, list[Matrix]](list)
        for name, matrix in (pair for one in known for pair in one.mappings.items()):
            mappings[name].append(matrix)
        if not mappings:
            return None
        medians = {name: median_mapping(of_band, self._size_px) for name, of_band in mappings.items()}
        model = FlightModel(net, flight_camera(self.captures), self._bands, medians, "")
        observations = self._observations(model, known)
        rig = self._rig(observations) or self._start_rig
        if rig is None:
            # A second refinement from the medians reduces the errors.
            return model
        return replace(model, rig=rig, mappings={**medians, **rig.mean})

    def _apply(self, function: Callable[[A], R], arguments: Sequence[A]) -> Iterator[R]:
        """Call a function with each argument, and yield the results in order."""
        return in_order(self.run_tasks, partial(in_one_thread, function), arguments)

    def _from_each(
        self, function: Callable[[A], LearningCapture | None], arguments: Sequence[A], captures: int = 1
    ) -> Iterator[LearningCapture | None]:
        """Call a function with each argument, of up to this many captures; yield the results in order, and None for one
        that exceeds the time limit.
        """

        def no_result(argument: A) -> LearningCapture | None:
            some = argument if isinstance(argument, tuple) else (argument,)
            names = some_of(capture.label for capture in some if isinstance(capture, Capture))
            logging.getLogger(__name__).warning("agalign: %s: not learned from, as it exceeds --timeout", names)
            return None

        in_thread, timeout_s = partial(in_one_thread, function), self.timeout_s
        limit_s = None if timeout_s is None else captures * timeout_s
        return in_order(self.run_tasks, in_thread, arguments, timeout_s=limit_s, if_late=no_result)

    @property
    def _bands(self) -> tuple[str, ...]:
        return flight_lenses(self.captures)

    @property
    def _start_rig(self) -> Rig | None:
        return None if self.start is None else self.start.rig

    @property
    def _size_px(self) -> tuple[int, int]:
        return self.captures[0].reference.size_px

    def _observed(self, model: FlightModel) -> list[LearningCapture]:
        """Return two captures, or the only one, aligned by a model without its rig; empty if one of them cannot be."""
        some = _to_test_a_model(self.captures)
        without_rig = replace(portable(model), rig=None)
        tests = list(filter(None, self._from_each(partial(observe_rig, without_rig, self.settings), some)))
        return tests if len(tests) == len(some) else []

    def _holds(self, rig: Rig, observations: Sequence[LearningCapture]) -> bool:
        """Return True if an earlier model with this rig fits the flight, so that none must be learned.

        It does if half of the bands of the observations are aligned, and its rig predicts each of them from the others
        with a standard error of at most DELIVERED_STD_PX.
        """
        known = _known(rig, observations)
        is_accurate = all(predict_band(rig, band, o).std_px <= DELIVERED_STD_PX for band, o in known)
        return bool(observations) and 2 * len(known) >= len(observations) * len(self._bands) and is_accurate

    def _network(self) -> tuple[Descriptor, list[LearningCapture]] | None:
        """Return (the network, captures with mappings refined by it); None if no capture can be used.

        The initial network is trained on the captures in which it does not align all bands. Training on a band that
        shows nothing would impair it, so the result is used only if it aligns more bands of these captures.
        """
        stretches, others = _stretches_and_others(self.captures)
        start = None if self.start is None else portable(self.start)
        task = partial(choose_and_refine, self._bands, self.settings, start)
        refined = []
        for one in self._from_each(task, [*stretches, *others], max(map(len, stretches))):
            refined.append(one)
            self.progress("the network", len(refined) / (len(stretches) + len(others)))
        chosen = [one for one in refined[: len(stretches)] if one is not None]
        if not chosen:
            return None
        usable = {one.capture.label: one for one in refined if one is not None}
        unaligned = [one for one in chosen if not one.is_aligned]
        if unaligned:
            net = initial_network(self._bands, self.settings, self.start)
            trained = self._trained(net, unaligned)
            if sum(len(one.aligned) for one in trained) > sum(len(one.aligned) for one in unaligned):
                return net, [*(one for one in usable.values() if one.is_aligned), *trained]
        return initial_network(self._bands, self.settings, self.start), list(usable.values())

    def _trained(self, net: Descriptor, chosen: Sequence[LearningCapture]) -> list[LearningCapture]:
        """Train a network on captures, from the mappings that are already refined; return them refined by it.

        Empty if learning fails; a network is then learned for each capture that needs it.
        """
        settings = self.settings
        read = [load_capture(one.capture, self._bands, settings, self.start, one.refined) for one in chosen]
        loaded = [capture for capture in read if capture is not None]
        groups = [group for capture in loaded for group in capture.groups]
        with logged_failure("the flight cannot be learned from"):
            learn(JointState(settings.joint, self.progress), groups, net, self.threads)
            with ThreadPoolExecutor(self.threads) as pool:
                return list(pool.map(lambda capture: capture.refined_by(net), loaded))
        return []

    def _observations(self, model: FlightModel, known: Sequence[LearningCapture]) -> list[LearningCapture]:
        """Return observations of the rig, in the order of the captures, until each aligned band is in enough of them.

        `known` are the captures that the network has refined. Those with bands that are not aligned come first, because
        the model's mappings are better initial alignments than seeds.
        """
        count = _rig_captures(self.captures)
        result = {one.capture.label: one for one in known}
        unaligned = [one.capture for one in known if not one.is_aligned]
        waiting = [*unaligned, *(c for c in _spread(self.captures, count) if c.label not in result)]
        task = partial(observe_rig, portable(model), self.settings)
        while waiting and (missing := count - _min_observations(result.values())) > 0:
            some, waiting = waiting[:missing], waiting[missing:]
            for one in self._from_each(task, some):
                if one is not None:
                    earlier = result.get(one.capture.label, one)
                    result[one.capture.label] = max(earlier, one, key=lambda o: len(o.aligned))
                self.progress("the rig", min(1.0, len(result) / count))
        return [result[c.label] for c in self.captures if c.label in result]

    def _rig(self, observations: Sequence[LearningCapture]) -> Rig | None:
        """Return the rig, with the displacement fields of the lenses; None if the captures do not determine it."""
        rig = learn_rig([o.observation for o in observations], self._size_px, _layout(self.captures), self._apply)
        if rig is None:
            return None
        residuals = {band: [o.residuals[band] for o in observations if band in o.residuals] for band in rig.mean}
        fit = partial(common_field, size_px=self._size_px)
        fields = list(self._apply(fit, list(residuals.values())))
        calibrated = self.captures[0].reference.lens is not None
        extrapolation_px = _extrapolation_px(rig, residuals, calibrated=calibrated)
        known = {
            band: field
            for band, field in zip(residuals, fields, strict=True)
            if field is not None and band not in extrapolation_px
        }
        return replace(rig, extrapolation_px=extrapolation_px, fields=known)


def _known(rig: Rig, observations: Iterable[LearningCapture]) -> list[tuple[str, Observation]]:
    """Return the aligned bands of the rig, each with all mappings of its capture."""
    return [(band, one.observation) for one in observations for band in one.aligned if band in rig.mean]


def _contradict(rig: Rig, observations: Iterable[LearningCapture]) -> bool:
    """Return True if an aligned band contradicts its prediction by a rig."""
    return any(contradicts(rig, band, observation) for band, observation in _known(rig, observations))


def _min_observations(observations: Iterable[LearningCapture]) -> int:
    """Return the number of observations of the aligned band with the fewest."""
    counts = Counter(band for o in observations for band in o.aligned)
    return min(counts.values(), default=0)


def _extrapolation_px(rig: Rig, residuals: Mapping[str, Sequence[Residual]], *, calibrated: bool) -> dict[str, float]:
    """Return the standard error (px of the reference's file) from the lens in parts of the image without measurements.

    Only bands with such parts are in the result.
    """
    max_covered_px = 0.15  # windows in all parts leave less unknown
    result: dict[str, float] = {}
    for band, of_band in residuals.items():
        std_px = unmodelled_std_px(
            Residual.joined(of_band), rig.size_px, lens_std_px(rig.size_px, calibrated=calibrated)
        )
        if std_px > max_covered_px:
            result[band] = std_px
    return result


def _stretches_and_others(captures: Sequence[Capture]) -> tuple[list[tuple[Capture, ...]], list[tuple[Capture, ...]]]:
    """Return captures to learn the network from and other captures for the rig, each with its alternatives.

    The network is learned from the middle of each stretch of the flight, or from its start or end.
    """
    # Each capture takes seconds. A third one mostly shows the structure that two lack.
    parts = np.array_split(np.arange(len(captures)), min(3, len(captures)))
    places = [dict.fromkeys(part[[len(part) // 2, 0, -1]].tolist()) for part in parts]
    stretches = [tuple(captures[i] for i in of_part) for of_part in places]
    # Refined at the same time as those of the network, the others occupy all workers.
    first = {stretch[0].label for stretch in stretches}
    spread = [c for c in _spread(captures, _MIN_RIG_CAPTURES) if c.label not in first]
    return stretches, [(c,) for c in spread[: _MIN_RIG_CAPTURES - len(stretches)]]


def _rig_captures(captures: Sequence[Capture]) -> int:
    """Return the number of captures that the rig is learned from, if the flight has as many."""
    captures_per_rig_capture = 8  # neighbours have about the same height and speed
    return min(_MAX_RIG_CAPTURES, max(_MIN_RIG_CAPTURES, len(captures) // captures_per_rig_capture))


def _to_test_a_model(captures: Sequence[Capture]) -> list[Capture]:
    """Return two captures with which an earlier model is tested, or the only one."""
    return [captures[k] for k in dict.fromkeys(len(captures) * third // 3 for third in (1, 2))]


def _spread(captures: Sequence[Capture], count: int) -> list[Capture]:
    """Return `count` captures evenly spread over the flight, then those halfway between them as replacements."""
    places = np.unique(np.linspace(0, len(captures) - 1, 2 * count - 1).round().astype(int))
    return [captures[i] for i in (*places[::2], *places[1::2])]


def _layout(captures: Iterable[Capture]) -> dict[str, tuple[float, float]]:
    """Return the directions of parallax relative to the reference, where the metadata contains them."""
    known = [(band.name, relative_parallax(capture.reference, band)) for capture in captures for band in capture.moving]
    return {name: direction for name, direction in reversed(known) if direction is not None}
