"""One network for a whole flight: learnt once on a few captures of a camera, then frozen for all of them.

The captures of a flight share their cameras, so what tells the bands' patches apart on a few of them does on all. Each
capture keeps its own psi (what the paper leaves as future work).
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from agalign import geometry
from agalign._version import __version__
from agalign.config import JointSettings, Settings
from agalign.descriptor import Descriptor
from agalign.errors import AgalignError, GeometryError, InputError, NotEnoughTextureError, OutputError
from agalign.fingerprint import fingerprint, hashed
from agalign.geometry import Matrix
from agalign.images import PairImages, moving_lenses, read_pairs
from agalign.joint import JointAligner, Progress, Subject
from agalign.match import with_match
from agalign.raster import read_for_alignment
from agalign.records import Capture, JointResult
from agalign.seed import best_seed, is_trusted
from agalign.starter import start_from

_FORMAT = "agalign-model/1"


@dataclass(frozen=True)
class FlightModel:
    """A learnt network and the mappings that it found, for one camera."""

    net: Descriptor
    camera: str
    """As `camera_key` has it; empty for one that was learnt on pairs of any cameras."""
    bands: tuple[str, ...]
    """Names of the moving bands; the network's side of one is its place here, counted from 1."""
    mappings: Mapping[str, Matrix]
    """Median fixed_to_moving of the bands whose held-out patches were told apart, undistorted px of the files."""
    fingerprint: str
    """Of what it was learnt from, and how."""

    def side(self, band: str) -> int | None:
        """The network's side for a moving band; None where it knows none of that name."""
        return self.bands.index(band) + 1 if band in self.bands else None


def camera_key(capture: Capture) -> str:
    """Captures with the same key were taken by the same camera, with the same bands and reference."""
    camera = capture.camera
    bands = ", ".join(f"{b.name} {b.width_px}x{b.height_px}" for b in (capture.reference, *capture.moving))
    return f"{camera.make} {camera.model} {camera.serial}".strip() + f" [{bands}]"


def flights_of(captures: Iterable[Capture]) -> list[list[Capture]]:
    """The captures grouped by camera and flight, in their order."""
    groups: dict[tuple[str, str], list[Capture]] = {}
    for capture in captures:
        groups.setdefault((camera_key(capture), capture.flight_id), []).append(capture)
    return list(groups.values())


def model_names(groups: Sequence[Sequence[Capture]]) -> list[str]:
    """A file name for each group's model: the camera, and a number where one camera has several."""
    names: list[str] = []
    seen: Counter[str] = Counter()
    for group in groups:
        camera = group[0].camera
        stem = re.sub(r"[^\w.+-]+", "_", f"{camera.model} {camera.serial}".strip()) or "camera"
        seen[stem] += 1
        names.append(f"{stem}.safetensors" if seen[stem] == 1 else f"{stem}-{seen[stem]}.safetensors")
    return names


# ---- learning


def learn_flight(
    captures: Sequence[Capture], settings: Settings, progress: Progress,
    start: FlightModel | None = None,
) -> FlightModel | None:  # fmt: skip
    """Learn one network on a few captures spread over the flight; None where none of them could be aligned.

    With `start`, its network is where theta starts; its last side is where bands start that it does not know.
    """
    chosen = _choose(captures, settings.flight.captures)
    loaded = [s for c in chosen if (s := read_subject(c, settings, start)) is not None]
    if not loaded:
        return None
    aligner = JointAligner(settings.joint, progress)
    subjects = [subject for subject, _ in loaded]
    bands = moving_names(captures[0])
    net = aligner.fast_descriptor([1] * (1 + len(bands)))
    if start is not None:
        start_from(net, start.net.state_dict())
    try:
        aligner.learn(subjects, net)
        results = [aligner.refine(net, subject) for subject in subjects]
    except NotEnoughTextureError:
        return None
    found: dict[str, list[Matrix]] = {}
    for (_, pairs), subject_results in zip(loaded, results, strict=True):
        for pair, result in zip(pairs, subject_results, strict=True):
            if isinstance(result, JointResult) and result.retrieval >= settings.joint.fast.step_gate:
                found.setdefault(pair.name, []).append(pair.in_file_px(result.fixed_to_moving))
    if not found:
        return None
    size = captures[0].reference.size_px
    mappings = {name: median_mapping(matrices, size) for name, matrices in found.items()}
    return FlightModel(net, camera_key(captures[0]), bands, mappings, learning_fingerprint(captures, settings))


def learning_fingerprint(captures: Sequence[Capture], settings: Settings) -> str:
    """Changes when the captures that would be learnt from, or the settings, do."""
    stages = settings.joint, settings.seed, settings.flight
    return hashed(camera_key(captures[0]), *(fingerprint(c, *stages) for c in captures))


def median_mapping(matrices: Sequence[Matrix], size_px: tuple[int, int]) -> Matrix:
    """The homography through the median of where each point of a lattice is sent."""
    if len(matrices) == 1:
        return matrices[0]
    points = geometry.lattice(*size_px, 9, 7)
    there = np.median([geometry.apply(m, points) for m in matrices], axis=0)
    fitted, _ = cv2.findHomography(points, there, 0)
    return geometry.normalised(fitted)


def _choose(captures: Sequence[Capture], count: int) -> list[Capture]:
    """Of each of `count` stretches of the flight, the most textured of three captures."""
    chosen = []
    for stretch in np.array_split(np.arange(len(captures)), min(count, len(captures))):
        some = stretch[np.unique(np.linspace(0, len(stretch) - 1, 3).round().astype(int))]
        candidates = [captures[i] for i in some]
        chosen.append(candidates[0] if len(candidates) == 1 else max(candidates, key=_texture))
    return chosen


def _texture(capture: Capture) -> float:
    """Median gradient of the reference relative to its spread; 0 where it cannot be read."""
    try:
        raster = read_for_alignment(capture.reference, 640)
    except AgalignError:
        return 0.0
    if raster.valid.mean() < 0.5:
        return 0.0
    inside = raster.pixels[raster.valid]
    gx, gy = (cv2.Sobel(raster.pixels, cv2.CV_32F, *d, scale=1 / 8) for d in ((1, 0), (0, 1)))
    return float(np.median(cv2.magnitude(gx, gy)[raster.valid]) / max(float(inside.std()), 1e-12))


def read_subject(
    capture: Capture, settings: Settings, start: FlightModel | None = None
) -> tuple[Subject, list[PairImages]] | None:
    """A capture to learn from and its pairs; None where there is none that can be read.

    `start` is the network with which a seed of kind `match` is found.
    """
    try:
        pairs, _ = read_pairs(capture, settings)
    except AgalignError:
        return None
    undistorted = capture.reference.lens is not None
    pairs = [p for p in pairs if (p.moving.lens is not None) == undistorted]
    if not pairs:
        return None
    names = moving_names(capture)
    seeds = []
    for pair in pairs:
        learnt, side = (None, 1) if start is None else (start.net, start.side(pair.name) or 1)
        candidates = with_match(pair.candidates, pair.fixed, pair.moving, settings.seed, learnt, side)
        seeds.append(best_seed(pair.fixed, pair.moving, candidates, settings.seed))
    subject = Subject(
        pairs[0].fixed, [p.moving for p in pairs], [s.fixed_to_moving for s in seeds],
        [names.index(p.name) + 1 for p in pairs], [is_trusted(s, settings.seed) for s in seeds],
    )  # fmt: skip
    return subject, pairs


def moving_names(capture: Capture) -> tuple[str, ...]:
    """Of the moving bands that get a side of the network: one for each lens."""
    return tuple(bands[0].name for bands in moving_lenses(capture))


# ---- using


def refine_with(
    model: FlightModel, subject: Subject, joint: JointSettings, progress: Progress
) -> list[JointResult | str]:
    """Every psi of a capture with the flight's theta frozen."""
    results = JointAligner(joint, progress).refine(model.net, subject)
    return [r if isinstance(r, str) else replace(r, recipe="flight") for r in results]


def align_from_scratch(subject: Subject, joint: JointSettings, progress: Progress) -> list[JointResult | str]:
    """Theta and every psi of one capture by itself."""
    aligner = JointAligner(joint, progress)
    results: list[JointResult | str] = []
    if joint.recipe == "paper":
        for moving, seed in zip(subject.moving, subject.mappings, strict=True):
            try:
                results.append(aligner.paper(subject.fixed, moving, seed)[1])
            except (NotEnoughTextureError, GeometryError) as why_not:
                results.append(str(why_not))
        return results
    channels = [r.channels for r in (subject.fixed, *subject.moving)]
    net = aligner.fast_descriptor(channels)
    try:
        steps, loss = aligner.learn([subject], net)
        results = aligner.refine(net, subject)
    except NotEnoughTextureError as why_not:
        return [str(why_not)] * len(subject.moving)
    return [r if isinstance(r, str) else replace(r, loss=loss, iterations=steps) for r in results]


# ---- files


def save_model(model: FlightModel, path: Path) -> None:
    """Write a model, complete or not at all. Raises OutputError."""
    tensors = {f"theta.{k}": v.detach().cpu().contiguous() for k, v in model.net.state_dict().items()}
    tensors |= {f"mapping.{k}": torch.tensor(m) for k, m in model.mappings.items()}
    facts = {
        "format": _FORMAT, "agalign": __version__, "camera": model.camera, "bands": json.dumps(model.bands),
        "sharing": model.net.sharing, "channels": json.dumps(model.net.channels), "fingerprint": model.fingerprint,
    }  # fmt: skip
    partial = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, partial, facts)
        partial.replace(path)
    except (OSError, SafetensorError) as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written ({error})") from None


def load_model(path: Path, device: Callable[[], torch.device]) -> FlightModel:
    """Raises InputError, naming the file, where it is not a model of this program."""
    try:
        with safe_open(path, framework="pt") as file:
            facts = file.metadata() or {}
            if facts.get("format") != _FORMAT:
                raise InputError(f"{path}: is no model of agalign; give a file of an earlier run's models folder")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        bands = tuple(json.loads(facts["bands"]))
        channels = json.loads(facts["channels"])
        net = Descriptor(facts["sharing"], channels, half_rectified=True, unit_length=True)
        net.load_state_dict({k.removeprefix("theta."): v for k, v in tensors.items() if k.startswith("theta.")})
        net.learnt = True
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as a model ({str(error).splitlines()[0]})") from None
    mappings = {k.removeprefix("mapping."): v.numpy() for k, v in tensors.items() if k.startswith("mapping.")}
    return FlightModel(net.to(device()), facts["camera"], bands, mappings, facts["fingerprint"])
