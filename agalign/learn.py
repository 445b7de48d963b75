"""Automatic descriptor learning: pairs are aligned without labels, and those that pass the checks teach one network.

The keypoints are SIFT's, the positives their patches warped by the estimated homographies (paper, Sec. 6.2).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from agalign import geometry, losses
from agalign.choices import SeedKind
from agalign.config import Settings
from agalign.descriptor import REFERENCE, Descriptor
from agalign.detect import sift_keypoints, visible_in_both
from agalign.errors import InputError, NotEnoughTextureError
from agalign.fingerprint import hashed
from agalign.flight import FlightModel
from agalign.geometry import Matrix
from agalign.image_pairs import find_pairs, read_image
from agalign.joint import JointAligner, Subject, one_thread
from agalign.levels import Level
from agalign.pair import align_images
from agalign.patches import Keypoints, far_apart, patch_grid
from agalign.records import Raster
from agalign.refine import moving_patches

_MOVING_BAND = "moving"


@dataclass(frozen=True)
class CoarsePair:
    """Two images and a rough mapping between them."""

    name: str
    fixed: Raster
    moving: Raster
    start: Matrix
    """fixed_to_moving, px."""


@dataclass(frozen=True)
class Lesson:
    """What became of a pair: whether it was aligned, and so teaches."""

    name: str
    status: str
    reason: str


@dataclass(frozen=True)
class _Example:
    level: Level
    homography: torch.Tensor
    keypoints: Keypoints


def learn_descriptor(
    pairs: Sequence[CoarsePair], settings: Settings, *, steps_a_pair: int = 200,
    on_pair: Callable[[Lesson], None] = lambda _: None,
) -> FlightModel:  # fmt: skip
    """One network for all pairs, whose fixed images have the same channels, and whose moving images have.

    Raises InputError where no pair can be aligned or their channels differ.
    """
    channels = {(p.fixed.channels, p.moving.channels) for p in pairs}
    if len(channels) > 1:
        raise InputError(f"the pairs have different channels {sorted(channels)}; learn them one kind at a time")
    aligner = JointAligner(settings.joint, lambda *_: None)
    examples = []
    for pair in pairs:
        start: dict[SeedKind, Matrix] = {"user": pair.start}
        with one_thread():
            found = align_images([(pair.name, pair.fixed, pair.moving, start)], settings, lambda *_: None)[pair.name]
        on_pair(Lesson(pair.name, found.status, found.reason or ""))
        if found.status == "aligned":
            try:
                examples.append(_example(aligner, pair, found.fixed_to_moving))
            except NotEnoughTextureError:
                continue
    if not examples:
        raise InputError("no pair could be aligned, so there is nothing to learn from")
    net = aligner.fast_descriptor([*channels.pop()])
    with one_thread():
        _learn(net, examples, aligner, steps_a_pair * len(examples))
    weights = b"".join(value.cpu().numpy().tobytes() for value in net.state_dict().values())
    return FlightModel(net, "", (_MOVING_BAND,), {}, hashed(weights))


def _example(aligner: JointAligner, pair: CoarsePair, fixed_to_moving: Matrix) -> _Example:
    subject = Subject(pair.fixed, [pair.moving], [fixed_to_moving], [1], [True])
    level = aligner.level(subject, 1.0, [0])
    keypoints = sift_keypoints(pair.fixed)
    keypoints = visible_in_both(keypoints, fixed_to_moving, pair.fixed, pair.moving)
    if len(keypoints) < 2:
        raise NotEnoughTextureError("too few keypoints lie in both images")
    return _Example(level, level.homography(fixed_to_moving, 0), keypoints.to(aligner.device))


def _learn(net: Descriptor, examples: Sequence[_Example], aligner: JointAligner, steps: int) -> None:
    """Theta by Adam with psi known, a pair at a time; the rate falls to nothing along a cosine."""
    recipe, generator = aligner.settings.fast, aligner.sampler.generator
    optimiser = torch.optim.Adam(net.parameters(), recipe.learning_rate)
    annealing = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step in range(steps):
        example = examples[step % len(examples)]
        rows = torch.randint(len(example.keypoints), (recipe.batch,), generator=generator)
        k = example.keypoints[rows.to(aligner.device)]
        # SIFT's own scale and orientation are one of many that a patch may have: the network is to know all.
        turn = 2 * math.pi * torch.rand(len(k), generator=generator)
        zoom = 2 ** (torch.rand(len(k), generator=generator) - 0.5)
        k = Keypoints(k.xy, k.angle + turn.to(k.angle), k.scale * zoom.to(k.scale))
        patches = [example.level.fixed.patches(patch_grid(k)), moving_patches(example.level, 0, example.homography, k)]
        f, f_prime = net.describe(patches, [REFERENCE, 1])
        loss = losses.in_batch(f, f_prime, far_apart(k, recipe.least_negative_px), recipe.temperature)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        annealing.step()


def read_coarse_pairs(source: Path) -> list[CoarsePair]:
    """The pairs of a CSV file or folder, as `find_pairs` has them, their homographies taken as rough ones; without one
    the images are laid on each other. Raises InputError.
    """
    found = []
    for pair in find_pairs(source):
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        scale = np.divide(moving.size_px, fixed.size_px)
        start = pair.fixed_to_moving
        if start is None:
            start = geometry.resolution_change(float(scale[0]), float(scale[1]))
        found.append(CoarsePair(pair.name, fixed, moving, start))
    return found
