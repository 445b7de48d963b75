"""Descriptor learning without labels: pairs are aligned, and one network is trained on those that pass verification.

The keypoints are SIFT's, the positives their patches warped by the estimated homographies (paper, Sec. 6.2).
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import torch

from agalign.capture.align_bands import align_pairs
from agalign.capture.band_pair import BandPair, SeedMatrices
from agalign.capture.reference import Reference
from agalign.config import Settings
from agalign.errors import InputError, NoContrastError, NotEnoughTextureError
from agalign.evaluation.image_pairs import find_pairs, read_image
from agalign.flight.fingerprint import hashed
from agalign.flight.model import FlightModel
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.device import one_memory_error, one_thread
from agalign.method.fast import BATCH, LEARNING_RATE, in_batch_loss
from agalign.method.learned_matches import sift_keypoints, visible_in_both
from agalign.method.levels import Level, make_level
from agalign.method.patches import Keypoints, far_apart, patch_positions
from agalign.method.state import JointState, MovingImage
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.geometry import Matrix

_Example = tuple[Level, Keypoints]
"""A pair at full resolution, and the keypoints of the first image that both show."""


def learn_descriptor(
    pairs: Sequence[BandPair],
    settings: Settings,
    *,
    steps_a_pair: int = 200,
    on_pair: Callable[[str, Alignment], None] = lambda *_: None,
) -> FlightModel:
    """Return a model with one network for all pairs, which must have the same numbers of channels.

    `on_pair` gets the name and the alignment of each pair; the network is trained on those with status `aligned`.

    Raises InputError if no pair can be aligned or their channels differ.
    """
    channels = {(p.fixed.channels, p.moving.channels) for p in pairs}
    if len(channels) > 1:
        raise InputError(f"the pairs have different channels {sorted(channels)}; learn them one kind at a time")
    state = JointState(settings.joint, lambda *_: None)
    examples = []
    with one_thread(), one_memory_error():
        for pair in pairs:
            result = align_pairs([pair], settings, lambda *_: None)[pair.name]
            on_pair(pair.name, result)
            if result.status == "aligned":
                with suppress(NoContrastError, NotEnoughTextureError):
                    examples.append(_example(state, pair, result.fixed_to_moving))
        if not examples:
            raise InputError("no pair could be aligned, so there is nothing to learn from")
        net = state.fast_descriptor([*channels.pop()])
        _learn(net, examples, state, steps_a_pair * len(examples))
    weights = (value.cpu().numpy() for value in net.state_dict().values())
    return FlightModel(net, None, ("moving",), {}, hashed(*weights))


def _example(state: JointState, pair: BandPair, fixed_to_moving: Matrix) -> _Example:
    level = make_level(state, pair.fixed, [MovingImage(pair.moving, fixed_to_moving)], 1.0)
    keypoints = visible_in_both(sift_keypoints(pair.fixed), fixed_to_moving, pair.fixed, pair.moving)
    minimum = 2
    if len(keypoints) < minimum:
        raise NotEnoughTextureError(len(keypoints), minimum)
    return level, keypoints.to(state.device)


def _learn(net: Descriptor, examples: Sequence[_Example], state: JointState, steps: int) -> None:
    """Optimise theta with Adam and fixed psi, one pair per step; the learning rate decreases to 0 along a cosine."""
    generator = state.generator
    optimiser = torch.optim.Adam(net.parameters(), LEARNING_RATE)
    annealing = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step in range(steps):
        level, keypoints = examples[step % len(examples)]
        rows = torch.randint(len(keypoints), (BATCH,), generator=generator)
        k = keypoints[rows.to(state.device)]
        # Data augmentation: random orientations and scales in addition to those of SIFT.
        rotation = 2 * math.pi * torch.rand(len(k), generator=generator)
        zoom = 2 ** (torch.rand(len(k), generator=generator) - 0.5)
        k = Keypoints(k.xy, k.angle + rotation.to(k.angle), k.scale * zoom.to(k.scale))
        (moving,) = level.bands
        patches = [level.fixed.patches(patch_positions(k)), moving.patches(k)]
        f, f_prime = net.describe(patches, [REFERENCE, moving.moving.side])
        loss = in_batch_loss(f, f_prime, far_apart(k))
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        annealing.step()


def read_rough_pairs(source: Path) -> list[BandPair]:
    """Return the pairs of a CSV file or folder (`find_pairs`), with their homographies as seeds.

    Without a homography, any rotation, scale and shift is searched, as by `agalign.align`. Raises InputError.
    """
    result = []
    for files in find_pairs(source):
        fixed, moving = read_image(files.fixed), read_image(files.moving)
        known = files.fixed_to_moving
        overlay: SeedMatrices = {"identity": geometry.overlay(fixed.size_px, moving.size_px)}
        result.append(BandPair(files.name, Reference(fixed), moving, overlay if known is None else {"user": known}))
    return result
