"""Tasks of learning a flight, one for each capture, in this process or on a worker."""

import copy
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from agalign.batch.capture_task import quiet
from agalign.capture.align_bands import CaptureEstimation
from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.by_rig import observed
from agalign.capture.candidate import BandCandidates
from agalign.capture.seeding import find_seed, image_groups
from agalign.config import Settings
from agalign.errors import AgalignError
from agalign.flight.model import FlightModel
from agalign.flight.rig import Observation
from agalign.method.descriptor import Descriptor, start_from
from agalign.method.device import choose_device
from agalign.method.joint import Results, refine_with
from agalign.method.refine import FLIGHT_PATCHES
from agalign.method.state import ImageGroup, JointState
from agalign.pixels.capture_pixels import CapturePixels
from agalign.pixels.raster import with_facts_of_pixels
from agalign.values.alignment import JointResult, Seed
from agalign.values.capture import Capture
from agalign.values.geometry import Matrix
from agalign.values.residual import Residual


@contextmanager
def logged_failure(message: str) -> Iterator[None]:
    """Log why a capture cannot be used for learning, and end the block; it is reported when it is aligned.

    Raises MemoryError.
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        is_defect = not isinstance(error, AgalignError)
        logging.getLogger(__name__).debug("%s: %s", message, error, exc_info=is_defect)


def portable(model: FlightModel) -> FlightModel:
    """Return the model with its network on the CPU, as a worker may have other devices."""
    return replace(model, net=copy.deepcopy(model.net).cpu())


def _on_device(model: FlightModel, settings: Settings) -> FlightModel:
    return replace(model, net=model.net.to(choose_device(settings.joint.device)))


@dataclass(frozen=True)
class RefinedPair:
    """The seed of a pair and its mapping refined by a flight's network, from the images of this pair alone."""

    seed: Seed
    result: JointResult
    fixed_to_moving: Matrix
    """The mapping of the result, px of the files."""


@dataclass(frozen=True)
class LearningCapture:
    """A capture from which the network or the rig is learned, aligned by a network without a rig."""

    capture: Capture
    refined: Mapping[str, RefinedPair]
    """Mappings of all bands before they were combined."""
    aligned: frozenset[str]
    """The aligned bands."""
    observation: Observation
    """The mappings for the rig, also inaccurate ones: together, the captures of a flight are more accurate."""
    residuals: Mapping[str, Residual]
    """Shifts of windows under these mappings, px of the files."""
    is_aligned: bool
    """True if all bands that could be read are aligned."""

    @classmethod
    def of(cls, capture: Capture, estimation: CaptureEstimation) -> "LearningCapture":
        """Collect the results for the pairs of a capture."""
        result, pairs = estimation.decided(), estimation.pairs
        aligned = frozenset(name for name, alignment in result.items() if alignment.status == "aligned")
        observation = observed(pairs, result, capture)
        in_file_px = {p.name: result[p.name].in_file_px(p.scales, p.reference_file_px) for p in pairs}
        residuals = {
            b: a.residual for b, a in in_file_px.items() if b in observation.mappings and a.residual is not None
        }
        refined = {
            name: RefinedPair(band.found, joint, band.pair.scales.between_files(joint.fixed_to_moving))
            for name, band in estimation.bands.items()
            if isinstance(band.found, Seed) and band.refined and (joint := band.refined.joint) and band.issue is None
        }
        return cls(capture, refined, aligned, observation, residuals, is_aligned=len(aligned) == len(pairs))

    @property
    def mappings(self) -> dict[str, Matrix]:
        """Refined mappings of the bands with distinguishable held-out patches, px of the files."""
        return {band: pair.fixed_to_moving for band, pair in self.refined.items() if pair.result.is_retrieved}


@dataclass(frozen=True)
class LoadedCapture:
    """The images of a capture to learn the network from."""

    capture: Capture
    estimation: CaptureEstimation
    """With the seeds, as an observation of the rig."""
    groups: list[ImageGroup]

    @property
    def similarity_sigma(self) -> float:
        """Median height of the correlation peaks of the seeds, in standard deviations."""
        return float(np.median([seed.peak_sigma for seed in self.estimation.seeds.values()]))

    @property
    def is_trusted(self) -> bool:
        """True if all seeds are confirmed by the images."""
        return all(seed.trusted for seed in self.estimation.seeds.values())

    def refined_by(self, net: Descriptor) -> LearningCapture:
        """Refine the pairs by a network and verify them, as observations of the rig; return them without images."""
        results: Results = {}
        for group in self.groups:
            results |= refine_with(net, group, self.estimation.settings.joint, quiet, FLIGHT_PATCHES)
        self.estimation.add(results)
        return LearningCapture.of(self.capture, self.estimation)


def load_capture(
    capture: Capture,
    bands: Sequence[str],
    settings: Settings,
    start: FlightModel | None,
    known: Mapping[str, RefinedPair],
) -> LoadedCapture | None:
    """Read a capture and find its seeds, or use those of the `known` pairs by band; None if no band can be used.

    Initial mappings are those of known pairs with distinguishable patches, else the seeds. Bands have their index in
    `bands` as index in the network. Seeds of kind `match` use the network of `start`.
    """
    with logged_failure(f"{capture.label} cannot be learned from"):
        pairs = [p for p in _pairs_of(capture, settings) if p.has_rig_pixels]
        found = [(p, known[p.name].seed if p.name in known else find_seed(p, settings.seed, start)) for p in pairs]
        usable = {p.name: BandCandidates(p, seed) for p, seed in found if isinstance(seed, Seed)}
        if usable:
            estimation = CaptureEstimation(settings, None, quiet, is_observation=True, bands=usable)
            groups = image_groups(pairs, estimation.seeds, {name: bands.index(name) + 1 for name in usable})
            for moving in (image for group in groups for image in group.moving):
                if moving.name in known and known[moving.name].result.is_retrieved:
                    moving.fixed_to_moving = known[moving.name].result.fixed_to_moving
            return LoadedCapture(capture, estimation, groups)
    return None


def _pairs_of(capture: Capture, settings: Settings, model: FlightModel | None = None) -> list[BandPair]:
    """Return the pairs of a capture that can be read."""
    read = CapturePixels().read
    return read_pairs(with_facts_of_pixels(capture, read), settings.seed, model, read)[0]


def initial_network(bands: Sequence[str], settings: Settings, start: FlightModel | None) -> Descriptor:
    """Return the network before learning: that of the package, or of `start`, an earlier model."""
    net = JointState(settings.joint, quiet).fast_descriptor([1] * (1 + len(bands)))
    if start is not None:
        # A model of this camera may have bands that the flight lacks: match the weights by band name.
        sides = [0, *(start.side(band) or len(start.bands) for band in bands)] if start.camera else None
        start_from(net, start.net.state_dict(), sides)
    return net


def choose_and_refine(
    bands: tuple[str, ...], settings: Settings, start: FlightModel | None, captures: Sequence[Capture]
) -> LearningCapture | None:
    """Choose the best of some captures to learn from, and refine it by the initial network.

    The chosen one is the first with trusted seeds for all bands, else the one with the highest correlation peaks.
    Captures without common structure, as of water or fog, are not usable; without any other, the result is None.
    """
    start = None if start is None else _on_device(start, settings)
    best: LoadedCapture | None = None
    for capture in captures:
        loaded = load_capture(capture, bands, settings, start, known={})
        if loaded is not None and (best is None or loaded.similarity_sigma > best.similarity_sigma):
            best = loaded
        if best is not None and best.is_trusted:
            break
    if best is None:
        return None
    with logged_failure(f"{best.capture.label} cannot be learned from"):
        return best.refined_by(initial_network(bands, settings, start))
    return None


def observe_rig(model: FlightModel, settings: Settings, capture: Capture) -> LearningCapture | None:
    """Align a capture by a model, without its rig's predictions; None if that fails."""
    with logged_failure(f"{capture.label} does not determine the rig"):
        pairs = [p for p in _pairs_of(capture, settings, model) if p.has_rig_pixels]
        estimation = CaptureEstimation(settings, _on_device(model, settings), quiet, is_observation=True)
        estimation.align(pairs, None, relearn=False)
        return LearningCapture.of(capture, estimation)
    return None
