"""Recipe fast: Adam on theta with in-batch negatives, and every few steps one Gauss-Newton step on psi.

All given captures share one theta; each image pair has its own psi (the paper proposes this as future work).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

from agalign.errors import GeometryError, NotEnoughTextureError
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.levels import Level
from agalign.method.patches import far_apart, patch_positions, translation
from agalign.method.refine import (
    CONVERGED_PX,
    MIN_KEYPOINTS,
    TEST_KEYPOINTS,
    MovingBand,
    Solver,
    best_shift,
    describe_fixed,
    describe_reference,
    held_out_retrieval,
    updated,
)
from agalign.method.state import ImageGroup, JointState
from agalign.values.alignment import MIN_RETRIEVAL
from agalign.values.choices import Recipe


class Adam:
    """Optimiser of a network's weights, tensors of any shape."""

    def __init__(self, weights: Iterable[nn.Parameter], learning_rate: float) -> None:
        self.weights = list(weights)
        self.learning_rate = learning_rate
        self._moments = [(torch.zeros_like(w), torch.zeros_like(w)) for w in self.weights]
        self._steps = [0] * len(self.weights)

    @torch.no_grad()
    def step(self, loss: Tensor) -> None:
        """Take one step down the gradient of a scalar loss.

        Weights that the loss does not depend on, and their moments, are unchanged.
        """
        for weight in self.weights:
            weight.grad = None
        torch.autograd.backward(loss)
        beta_1, beta_2, epsilon = 0.9, 0.999, 1e-8  # as in torch.optim
        for i, (weight, (first, second)) in enumerate(zip(self.weights, self._moments, strict=True)):
            if weight.grad is None:
                continue
            self._steps[i] += 1
            first.lerp_(weight.grad, 1 - beta_1)
            second.mul_(beta_2).addcmul_(weight.grad, weight.grad, value=1 - beta_2)
            denominator = (second / (1 - beta_2 ** self._steps[i])).sqrt_().add_(epsilon)
            weight.addcdiv_(first, denominator, value=-self.learning_rate / (1 - beta_1 ** self._steps[i]))


BATCH = 128
"""Keypoints in a step on theta; each is a negative for the others."""
LEARNING_RATE = 2e-3
"""Of Adam."""
_TEMPERATURE = 0.07
"""Temperature of the in-batch loss (He et al. 2020, Sec. 3.3)."""
_COARSEST_PX = 200
"""The longer side of the coarsest level, where an untrusted seed starts, is between this and twice this."""
_SEARCH_STEP_PX = 3.0
"""Spacing of the translations that are searched, px of that level: a Gauss-Newton step can bridge it."""
_OCTAVES = 1.0
"""Patch scales are drawn from [1, 2**_OCTAVES] px between samples."""
_FIRST_UPDATES = 5
"""Steps on psi before learned weights are trained further; twice as many if psi converges without training."""
_PATCHES = 300
"""Patches in a Gauss-Newton step. Its cost is proportional to their number n, its error to 1 / sqrt(n)."""


@dataclass(frozen=True)
class Schedule:
    """Learning rate and stopping rule of theta at each level."""

    learning_rate: float = LEARNING_RATE
    max_steps: int = 150
    """Per capture."""
    enough_retrieval: float = 0.6
    """Held-out retrieval above which learning stops once psi has converged. With 0.5, fields and trees are as accurate,
    but captures of water no longer determine the rig of their flight."""
    max_steps_without_retrieval: int = 30
    """Per capture: a level is abandoned after them if no held-out patches can be retrieved."""


SCHEDULES: dict[Recipe, Schedule] = {
    "fast": Schedule(),
    "scratch": Schedule(max_steps=600, enough_retrieval=0.9, max_steps_without_retrieval=100),
}


def learn(
    state: JointState, groups: Sequence[ImageGroup], net: Descriptor, threads: int = 1, schedule: Schedule | None = None
) -> tuple[int, float]:
    """Learn theta and every psi of all groups, coarse to fine; theta is carried from level to level.

    The homographies are written into the groups. `threads` groups update their psi at the same time; the result does
    not depend on it. `schedule` is by default that of the recipe. Returns the number of steps on theta and the last
    loss, NaN without a step. Raises NoContrastError.
    """
    scales = learn_scales(max(max(g.fixed.size_px) for g in groups))
    steps, loss, schedule = 0, math.nan, schedule or SCHEDULES[state.settings.recipe]
    # Each group has its own random generator, so its samples do not depend on the other groups.
    states = [JointState(state.settings, state.progress) for _ in groups]
    with ThreadPoolExecutor(threads) as pool:

        def update_psi(some: Sequence[_GroupAtLevel]) -> list[bool]:
            return list(pool.map(_update_psi, some))

        for scale in scales:
            at_level = [
                _GroupAtLevel(own_state, net, group, bands, own_state.level(group, scale, bands), schedule)
                for own_state, group in zip(states, groups, strict=True)
                if (bands := _learned_bands(group, is_finest=scale == scales[-1]))
            ]
            if not at_level:
                continue
            if scale == scales[0]:
                list(pool.map(_search, at_level))
            if not _converges(at_level, update_psi):
                level_steps, loss = _train(state, net, at_level, schedule, update_psi)
                steps += level_steps
            for group in at_level:
                group.store()
    return steps, loss


def _learned_bands(group: ImageGroup, *, is_finest: bool) -> list[int]:
    """Return the moving images that take part at a level; those with a trusted seed do so at the finest level only."""
    return [b for b in group.active if is_finest or not group.trusted[b]]


def learn_scales(longer_side_px: int) -> list[float]:
    """Return the scales of the levels on which theta is learned, coarse to fine; 1 is full resolution."""
    # Longer side of the images on which theta is learned, but at least half of the full resolution. These weights
    # are also used at full resolution; learning there costs four times as much.
    learn_px = 640
    scales = [min(1.0, max(0.5, learn_px / longer_side_px))]
    while scales[0] * longer_side_px >= 2 * _COARSEST_PX:
        scales.insert(0, scales[0] / 2)
    return scales


@dataclass
class _GroupAtLevel:
    """Some moving images of a group at one level, and their homographies."""

    state: JointState
    """With the random generator of this group."""
    net: Descriptor
    group: ImageGroup
    indices: Sequence[int]
    """Of the moving images in the group."""
    level: Level
    schedule: Schedule
    h: list[Tensor] = field(init=False)
    """(3, 3) fixed_to_moving of each moving image, px of the level."""
    converged: list[bool] = field(init=False)
    """True after the first step on psi shorter than CONVERGED_PX; updates continue until all psi have converged."""
    distinguished: list[bool] = field(init=False)
    """True once held-out retrieval has reached MIN_RETRIEVAL, which steps on psi require."""
    retrieved: list[float] = field(init=False)
    """Held-out retrieval at the last test."""

    def __post_init__(self) -> None:
        self.converged, self.distinguished = ([False] * len(self.indices) for _ in range(2))
        self.retrieved = [0.0] * len(self.indices)
        self.h = [self.level.homography(self.group.mappings[b], i) for i, b in enumerate(self.indices)]

    @property
    def bands(self) -> list[MovingBand]:
        """The moving images with their sides of the network."""
        return [MovingBand(self.net, self.level, i, self.group.sides[b]) for i, b in enumerate(self.indices)]

    @property
    def needs_no_training(self) -> bool:
        """True where retrieval is high enough for every psi that has not converged: steps on psi suffice."""
        enough = self.schedule.enough_retrieval
        return all(r > enough for r, converged in zip(self.retrieved, self.converged, strict=True) if not converged)

    def store(self) -> None:
        """Write the homographies that can be inverted into the group, and the moving images that are dropped."""
        self.group.dropped |= {b: self.retrieved[i] for i, b in enumerate(self.indices) if not self.distinguished[i]}
        for i, b in enumerate(self.indices):
            with suppress(GeometryError):
                self.group.mappings[b] = self.level.full_matrix(self.h[i], i)


_UpdatePsi = Callable[[Sequence[_GroupAtLevel]], list[bool]]
"""Take one step on each psi of some groups; return True for each group in which all psi have converged."""


@torch.no_grad()
def _search(g: _GroupAtLevel) -> None:
    """Shift each untrusted mapping by the translation with the smallest loss of the patches.

    The loss decreases towards the true position (paper, Fig. 2) over a larger distance than a Gauss-Newton step covers.
    """
    search_patches = 64  # patches with which the translations are compared
    p, _ = g.state.sampler.draw(g.level, g.level.anywhere, g.h, search_patches, _OCTAVES)
    # Radius of the search around an untrusted seed at the coarsest level, as a share of the longer side.
    search_radius_share = 0.22
    for i, band in enumerate(g.bands):
        if g.group.trusted[g.indices[i]]:
            continue
        radius_px = search_radius_share * max(g.level.fixed.size_px)
        if g.group.max_shift_px:
            radius_px = min(radius_px, g.group.max_shift_px[g.indices[i]] * g.level.fixed.scale[0])
        shift = best_shift(band, g.h[i], p, radius_px, _SEARCH_STEP_PX)
        g.h[i] = g.h[i] @ translation(shift).to(g.h[i])


def _converges(at_level: Sequence[_GroupAtLevel], update_psi: _UpdatePsi) -> bool:
    """Update every psi without training the network; return True if all converge."""
    remaining = at_level
    for update in range(1, 2 * _FIRST_UPDATES + 1):
        remaining = [g for g, converged in zip(remaining, update_psi(remaining), strict=True) if not converged]
        if not remaining:
            return True
        is_blocked = update > 1 and not all(all(g.distinguished) for g in remaining)
        if is_blocked or (update >= _FIRST_UPDATES and not all(g.needs_no_training for g in remaining)):
            return False
    return False


def _train(
    state: JointState, net: Descriptor, at_level: Sequence[_GroupAtLevel], schedule: Schedule, update_psi: _UpdatePsi
) -> tuple[int, float]:
    """Learn theta with Adam, one group per step; every few steps update each psi by Gauss-Newton.

    Returns the number of steps and the last loss.
    """
    loss_value, count = math.nan, len(at_level)
    max_steps = schedule.max_steps * count
    optimiser = Adam(net.parameters(), schedule.learning_rate)
    steps_between_updates = 10  # steps on theta per capture between two steps on psi
    for step in range(1, max_steps + 1):
        loss = _loss(at_level[step % count])
        if loss is not None:
            optimiser.step(loss)
            loss_value = float(loss.detach())
        if step % (steps_between_updates * count):
            continue
        state.progress("learning", step / max_steps)
        if all(update_psi(at_level)):
            break
        if step >= schedule.max_steps_without_retrieval * count and not any(any(g.distinguished) for g in at_level):
            break
    return step, loss_value


def _loss(g: _GroupAtLevel) -> Tensor | None:
    """Return the mean in-batch loss of the pairs of a capture on new keypoints; None if too few can be drawn."""
    p, inside = g.state.sampler.draw(g.level, g.level.trainable, g.h, BATCH, _OCTAVES)
    visible = [inside[:, i].nonzero()[:, 0] for i in range(len(g.h))]
    bands = [band for band in g.bands if len(visible[band.index]) >= MIN_KEYPOINTS]
    if not bands:
        return None
    patches = [g.level.fixed.patches(patch_positions(p))]
    patches += [band.patches(p[visible[band.index]], g.h[band.index]) for band in bands]
    f, *f_primes = g.net.describe(patches, [REFERENCE, *(band.side for band in bands)])
    allowed = far_apart(p)
    losses = []
    for band, f_prime in zip(bands, f_primes, strict=True):
        rows = visible[band.index]
        losses.append(in_batch_loss(f[rows], f_prime, allowed[rows][:, rows]))
    return torch.stack(losses).mean()


def in_batch_loss(f: Tensor, f_prime: Tensor, allowed: Tensor) -> Tensor:
    """Return the symmetric InfoNCE loss with the other rows of the batch as negatives, a scalar.

    `f` and `f_prime` are (N, D) descriptors of unit length; row i of one matches row i of the other. `allowed` (N, N)
    is False where two keypoints are too close to be negatives of each other; its diagonal is ignored.
    Source: van den Oord et al. 2018, Eq. 4.
    """
    logits = f @ f_prime.T / _TEMPERATURE
    keep = allowed | torch.eye(len(f), dtype=torch.bool, device=f.device)
    logits = logits.masked_fill(~keep, float("-inf"))
    target = torch.arange(len(f), device=f.device)
    return 0.5 * (functional.cross_entropy(logits, target) + functional.cross_entropy(logits.T, target))


@torch.no_grad()
def _update_psi(g: _GroupAtLevel) -> bool:
    """Take one step on each psi of a capture that passes held-out retrieval; return True if all have converged."""
    test, _ = g.state.sampler.draw(g.level, g.level.held_out, g.h, TEST_KEYPOINTS, _OCTAVES)
    p, _ = g.state.sampler.draw(g.level, g.level.anywhere, g.h, _PATCHES, _OCTAVES)
    if len(p) < MIN_KEYPOINTS:
        return True
    f_test = describe_fixed(g.net, g.level, test)
    reference_patches = describe_reference(g.net, g.level, p)
    solver = Solver(g.state.family)
    for i, band in enumerate(g.bands):
        g.retrieved[i], _ = held_out_retrieval(band, g.h[i], test, f_test)
        if g.retrieved[i] < MIN_RETRIEVAL:
            continue
        g.distinguished[i] = True
        with suppress(NotEnoughTextureError):
            step = solver.step(band, g.h[i], reference_patches)
            g.h[i] = updated(g.h[i], step)
            g.converged[i] |= g.retrieved[i] > g.schedule.enough_retrieval and step.length_px < CONVERGED_PX
    return all(g.converged)
