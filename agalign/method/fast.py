"""Recipe fast: Adam on theta through in-batch negatives, and every few steps one Gauss-Newton step on psi.

One theta for as many captures as are given, each pair with its own psi (the paper's future work).
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from agalign.errors import GeometryError, NotEnoughTextureError
from agalign.method.adam import Adam
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.levels import Level
from agalign.method.patches import far_apart, patch_positions, translation
from agalign.method.refine import (
    MIN_KEYPOINTS,
    REST_PX,
    TEST_KEYPOINTS,
    MovingBand,
    Solver,
    best_shift,
    describe_fixed,
    describe_reference,
    held_out_retrieval,
    moved,
)
from agalign.method.state import ImageGroup, JointState
from agalign.values.alignment import MIN_RETRIEVAL

BATCH = 128
"""Keypoints of a step on theta, all negatives of each other."""
LEARNING_RATE = 2e-3
_TEMPERATURE = 0.07
"""Of the in-batch loss (He et al. 2020, Sec. 3.3)."""
_LEARN_PX = 640
"""Longer side of the images on which theta is learnt, but at least half of the full resolution: what is learnt at this
scale holds at full resolution, at a quarter of the cost."""
_COARSEST_PX = 200
"""The coarsest level, where an untrusted seed starts, is between this and twice this on its longer side."""
_SEARCH_SHARE = 0.22
"""How far around an untrusted seed the loss is searched at the coarsest level, in longer sides."""
_SEARCH_STEP_PX = 3.0
"""Between neighbouring translations that are tried, px of that level: within reach of a Gauss-Newton step."""
_SEARCH_PATCHES = 64
_OCTAVES = 1.0
"""Patch scales are drawn from [1, 2**octaves] px between samples."""
_WARM_UP_STEPS = 50
"""Steps on random weights before psi may move."""
_FIRST_UPDATES = 5
"""Steps on psi before the first on weights that are not random; twice as many where those suffice."""
_STEPS_BETWEEN_UPDATES = 10
_HOPELESS_STEPS = 30
"""Steps after which a level is abandoned where no held-out patches could be retrieved."""
_PATCHES = 300
"""Patches in a Gauss-Newton step: the cost of a step grows with them, its error falls with their square root."""


@dataclass(frozen=True)
class Schedule:
    """How long theta is learnt at each level."""

    learning_rate: float = LEARNING_RATE
    max_steps: int = 150
    """Of each capture."""
    enough_retrieval: float = 0.6
    """Held-out retrieval at which learning may stop once psi is at rest."""


DEFAULT_SCHEDULE = Schedule()


def learn(
    state: JointState, groups: Sequence[ImageGroup], net: Descriptor, at_once: int = 1,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> tuple[int, float]:  # fmt: skip
    """Learn theta and every psi of all groups, coarse to fine; theta is carried from level to level.

    The psi of `at_once` groups move at a time, each group in a thread; the result does not depend on it. Returns the
    number of steps on theta and the last loss, NaN without a step. Raises NoContrastError.
    """
    scales = learn_scales(max(max(g.fixed.size_px) for g in groups))
    steps, loss = 0, math.nan
    # Each group has its own random numbers: what is drawn for one does not depend on the others.
    states = [JointState(state.settings, state.progress) for _ in groups]
    with ThreadPoolExecutor(at_once) as pool:

        def move_psi(some: Sequence[_GroupAtLevel]) -> list[bool]:
            return list(pool.map(_move_psi, some))

        for scale in scales:
            at_level = [
                _GroupAtLevel(own, net, group, bands, own.level(group, scale, bands), schedule)
                for own, group in zip(states, groups, strict=True)
                if (bands := _bands_at(group, is_finest=scale == scales[-1]))
            ]
            if not at_level:
                continue
            if scale == scales[0] and net.learnt:
                list(pool.map(_search, at_level))
            if not net.learnt or not _converges(at_level, move_psi):
                taken, loss = _train(state, net, at_level, schedule, move_psi)
                steps += taken
            for group in at_level:
                group.hand_on()
    return steps, loss


def _bands_at(group: ImageGroup, *, is_finest: bool) -> list[int]:
    """The moving images that take part at a level: those with a trusted seed only at the finest one."""
    return [b for b in group.active if is_finest or not group.trusted[b]]


def learn_scales(longer_side_px: int) -> list[float]:
    """Resolutions at which theta is learnt, coarse to fine."""
    scales = [min(1.0, max(0.5, _LEARN_PX / longer_side_px))]
    while scales[0] * longer_side_px >= 2 * _COARSEST_PX:
        scales.insert(0, scales[0] / 2)
    return scales


@dataclass
class _GroupAtLevel:
    """Some moving images of a group at one level, with their psi as homographies of that level."""

    state: JointState
    """The group's own."""
    net: Descriptor
    group: ImageGroup
    which: Sequence[int]
    """Indices of the moving images in the group."""
    level: Level
    schedule: Schedule
    h: list[Tensor] = field(init=False)
    converged: list[bool] = field(init=False)
    """True once psi has been at rest; it is moved on all the same."""
    distinguished: list[bool] = field(init=False)
    """True once held-out patches could be retrieved, so that psi could move."""
    retrieved: list[float] = field(init=False)
    """Share of the held-out patches that were retrieved at the last test."""

    def __post_init__(self) -> None:
        self.converged, self.distinguished = ([False] * len(self.which) for _ in range(2))
        self.retrieved = [0.0] * len(self.which)
        self.h = [self.level.homography(self.group.mappings[b], i) for i, b in enumerate(self.which)]

    @property
    def bands(self) -> list[MovingBand]:
        return [MovingBand(self.net, self.level, i, self.group.sides[b]) for i, b in enumerate(self.which)]

    @property
    def needs_only_steps(self) -> bool:
        """True where the descriptors are good enough for every psi that has not converged: steps on psi suffice."""
        enough = self.schedule.enough_retrieval
        return all(r > enough for r, converged in zip(self.retrieved, self.converged, strict=True) if not converged)

    def hand_on(self) -> None:
        """Write the result into the group; a homography that cannot be inverted is left out."""
        self.group.dropped |= {b: self.retrieved[i] for i, b in enumerate(self.which) if not self.distinguished[i]}
        for i, b in enumerate(self.which):
            with suppress(GeometryError):
                self.group.mappings[b] = self.level.full_matrix(self.h[i], i)


_MovePsi = Callable[[Sequence[_GroupAtLevel]], list[bool]]
"""One step on each psi of some groups; True for each group in which all psi have converged."""


@torch.no_grad()
def _search(at: _GroupAtLevel) -> None:
    """Move each untrusted psi by the translation under which the patches' loss is least.

    Around the truth the loss is a funnel (paper, Fig. 2) that is wider than what one Gauss-Newton step sees.
    """
    state, level = at.state, at.level
    p, _ = state.sampler.draw(level, level.anywhere, at.h, _SEARCH_PATCHES, _OCTAVES)
    for i, band in enumerate(at.bands):
        if at.group.trusted[at.which[i]]:
            continue
        reach = _SEARCH_SHARE * max(level.fixed.size_px)
        if at.group.reach_px:
            reach = min(reach, at.group.reach_px[at.which[i]] * level.fixed.scale[0])
        shift = best_shift(band, at.h[i], p, reach, _SEARCH_STEP_PX)
        at.h[i] = at.h[i] @ translation(shift).to(at.h[i])


def _converges(at_level: Sequence[_GroupAtLevel], move_psi: _MovePsi) -> bool:
    """Move every psi with the network as it is; True where all converge, so that no step on theta is needed."""
    remaining = at_level
    for update in range(1, 2 * _FIRST_UPDATES + 1):
        remaining = [g for g, converged in zip(remaining, move_psi(remaining), strict=True) if not converged]
        if not remaining:
            return True
        cannot_move = update > 1 and not all(all(g.distinguished) for g in remaining)
        if cannot_move or (update >= _FIRST_UPDATES and not all(g.needs_only_steps for g in remaining)):
            return False
    return False


def _train(
    state: JointState, net: Descriptor, at_level: Sequence[_GroupAtLevel], schedule: Schedule, move_psi: _MovePsi
) -> tuple[int, float]:
    """Theta by Adam, one group a step; every few steps Gauss-Newton on each psi with retrieved held-out patches.

    Returns the number of steps and the last loss.
    """
    loss_value, count = math.nan, len(at_level)
    max_steps = schedule.max_steps * count
    warm_up = 0 if net.learnt else _WARM_UP_STEPS
    optimiser = Adam(net.parameters(), schedule.learning_rate)
    for step in range(1, max_steps + 1):
        loss = _loss(at_level[step % count])
        if loss is not None:
            optimiser.step(loss)
            loss_value = float(loss.detach())
        if step < warm_up or step % (_STEPS_BETWEEN_UPDATES * count):
            continue
        state.progress("learning", step / max_steps)
        if all(move_psi(at_level)):
            break
        if step >= warm_up + _HOPELESS_STEPS * count and not any(any(g.distinguished) for g in at_level):
            break
    net.learnt = True
    return step, loss_value


def _loss(at: _GroupAtLevel) -> Tensor | None:
    """The in-batch loss of one capture's pairs on newly drawn keypoints; None where none can be drawn."""
    state, level = at.state, at.level
    p, inside = state.sampler.draw(level, level.trainable, at.h, BATCH, _OCTAVES)
    rows = [inside[:, i].nonzero()[:, 0] for i in range(len(at.h))]
    visible = [band for band in at.bands if len(rows[band.index]) >= MIN_KEYPOINTS]
    if not visible:
        return None
    patches = [level.fixed.patches(patch_positions(p))]
    patches += [band.patches(p[rows[band.index]], at.h[band.index]) for band in visible]
    f, *f_primes = at.net.describe(patches, [REFERENCE, *(band.side for band in visible)])
    apart = far_apart(p)
    terms = []
    for band, f_prime in zip(visible, f_primes, strict=True):
        mine = rows[band.index]
        terms.append(in_batch_loss(f[mine], f_prime, apart[mine][:, mine]))
    return torch.stack(terms).mean()


def in_batch_loss(f: Tensor, f_prime: Tensor, allowed: Tensor) -> Tensor:
    """InfoNCE in both directions with the other rows of the batch as negatives, a scalar.

    `f` and `f_prime` are (N, D) of unit length, row i of one matching row i of the other; `allowed` (N, N) is False
    where two keypoints are too close to count as negatives of each other (its diagonal does not matter).
    van den Oord et al. 2018, Eq. 4, symmetrised.
    """
    logits = f @ f_prime.T / _TEMPERATURE
    keep = allowed | torch.eye(len(f), dtype=torch.bool, device=f.device)
    logits = logits.masked_fill(~keep, float("-inf"))
    target = torch.arange(len(f), device=f.device)
    return 0.5 * (functional.cross_entropy(logits, target) + functional.cross_entropy(logits.T, target))


@torch.no_grad()
def _move_psi(at: _GroupAtLevel) -> bool:
    """One step on each psi of a capture with held-out patches that are retrieved; True where all have converged."""
    state, level = at.state, at.level
    test, _ = state.sampler.draw(level, level.held_out, at.h, TEST_KEYPOINTS, _OCTAVES)
    p, _ = state.sampler.draw(level, level.anywhere, at.h, _PATCHES, _OCTAVES)
    if len(p) < MIN_KEYPOINTS:
        return True
    f_test = describe_fixed(at.net, level, test)
    reference_patches = describe_reference(at.net, level, p)
    solver = Solver(state.family)
    for i, band in enumerate(at.bands):
        retrieved, _ = held_out_retrieval(band, at.h[i], test, f_test)
        at.retrieved[i] = retrieved
        if retrieved < MIN_RETRIEVAL:
            continue
        at.distinguished[i] = True
        with suppress(NotEnoughTextureError):
            step = solver.step(band, at.h[i], reference_patches)
            at.h[i] = moved(at.h[i], step)
            at.converged[i] |= retrieved > at.schedule.enough_retrieval and step.length_px < REST_PX
    return all(at.converged)
