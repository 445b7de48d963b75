"""Recipe fast: Adam on theta with in-batch negatives, and every few steps one Gauss-Newton step on psi.

All given captures share one theta; each image pair has its own psi (the paper proposes this as future work).
"""

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from agalign.errors import GeometryError, NoContrastError, NotEnoughTextureError
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.levels import Level, make_level
from agalign.method.patches import far_apart, patch_positions
from agalign.method.refine import (
    CONVERGED_PX,
    MIN_KEYPOINTS,
    TEST_KEYPOINTS,
    ReferencePatches,
    best_shift,
    held_out_retrieval,
    step_from,
)
from agalign.method.state import ImageGroup, JointState
from agalign.values import geometry
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
    steps, loss = 0, math.nan
    # Each group has its own random generator, so its samples do not depend on the other groups.
    states = [JointState(state.settings, state.progress) for _ in groups]
    with ThreadPoolExecutor(threads) as pool:
        learner = _Learner(state, net, schedule or SCHEDULES[state.settings.recipe], pool)
        for scale in scales:
            levels = _levels(states, groups, scale, is_finest=scale == scales[-1])
            if not levels:
                continue
            if scale == scales[0]:
                list(pool.map(learner.search, levels))
            if not learner.converges(levels):
                level_steps, loss = learner.train(levels)
                steps += level_steps
            for level in levels:
                _store(level)
    return steps, loss


def _levels(
    states: Sequence[JointState], groups: Sequence[ImageGroup], scale: float, *, is_finest: bool
) -> list[Level]:
    """Return the levels of the captures at a scale, without those that have no room for patches there, as between
    saturated areas. Raises NoContrastError if none has at the finest scale.
    """
    levels, error = list[Level](), None
    for state, group in zip(states, groups, strict=True):
        moving = [m for m in group.moving if m.dropped_at is None and (is_finest or not m.trusted)]
        try:
            levels += [make_level(state, group.fixed, moving, scale)] if moving else []
        except NoContrastError as without_room:
            error = without_room
    if is_finest and not levels and error is not None:
        raise error
    return levels


def _store(level: Level) -> None:
    """Write the homographies that can be inverted into the moving images, and the retrieval of those to be dropped."""
    for band in level.bands:
        band.moving.dropped_at = None if band.distinguished else band.retrieval
        with suppress(GeometryError):
            band.moving.fixed_to_moving = band.fixed_to_moving


def learn_scales(longer_side_px: int) -> list[float]:
    """Return the scales of the levels on which theta is learned, coarse to fine; 1 is full resolution."""
    # Longer side of the images on which theta is learned, but at least half of the full resolution. These weights
    # are also used at full resolution; learning there costs four times as much.
    learn_px = 640
    scales = [min(1.0, max(0.5, learn_px / longer_side_px))]
    while scales[0] * longer_side_px >= 2 * _COARSEST_PX:
        scales.insert(0, scales[0] / 2)
    return scales


@dataclass(frozen=True)
class _Learner:
    """The steps of `learn` at a level of all captures."""

    state: JointState
    net: Descriptor
    schedule: Schedule
    pool: ThreadPoolExecutor

    @torch.no_grad()
    def search(self, level: Level) -> None:
        """Shift each untrusted mapping by the translation with the smallest loss of the patches.

        The loss decreases towards the true position (paper, Fig. 2) over a larger distance than a Gauss-Newton step
        covers.
        """
        search_patches = 64  # patches with which the translations are compared
        p, _ = level.draw(level.anywhere, search_patches, _OCTAVES)
        # Radius of the search around an untrusted seed at the coarsest level, as a share of the longer side.
        search_radius_share = 0.22
        for band in (b for b in level.bands if not b.moving.trusted):
            max_shift_px = band.moving.max_shift_px * level.fixed.scale[0]
            radius_px = min(search_radius_share * max(level.fixed.size_px), max_shift_px)
            shift = best_shift(self.net, level, band, p, radius_px)
            band.h = band.h @ torch.from_numpy(geometry.translation(*map(float, shift))).to(band.h)

    def converges(self, levels: Sequence[Level]) -> bool:
        """Update every psi without training the network; return True if all converge."""
        remaining = levels
        for update in range(1, 2 * _FIRST_UPDATES + 1):
            converged = self._update_psi(remaining)
            remaining = [level for level, is_done in zip(remaining, converged, strict=True) if not is_done]
            if not remaining:
                return True
            bands = [band for level in remaining for band in level.bands]
            is_blocked = update > 1 and not all(b.distinguished for b in bands)
            # Steps on psi suffice where retrieval is high enough.
            needs_no_training = all(b.converged or (b.retrieval or 0.0) > self.schedule.enough_retrieval for b in bands)
            if is_blocked or (update >= _FIRST_UPDATES and not needs_no_training):
                return False
        return False

    def train(self, levels: Sequence[Level]) -> tuple[int, float]:
        """Learn theta with Adam, one capture per step; every few steps update each psi by Gauss-Newton.

        Returns the number of steps and the last loss.
        """
        loss_value, count = math.nan, len(levels)
        max_steps = self.schedule.max_steps * count
        optimiser = Adam(self.net.parameters(), self.schedule.learning_rate)
        steps_between_updates = 10  # steps on theta per capture between two steps on psi
        for step in range(1, max_steps + 1):
            loss = _loss(self.net, levels[step % count])
            if loss is not None:
                optimiser.step(loss)
                loss_value = float(loss.detach())
            if step % (steps_between_updates * count):
                continue
            self.state.progress("learning", step / max_steps)
            if all(self._update_psi(levels)):
                break
            is_hopeless = not any(band.distinguished for level in levels for band in level.bands)
            if is_hopeless and step >= self.schedule.max_steps_without_retrieval * count:
                break
        return step, loss_value

    def _update_psi(self, levels: Sequence[Level]) -> list[bool]:
        """Take one step on each psi; return True for each capture in which all have converged."""
        return list(self.pool.map(self._update_psi_of, levels))

    @torch.no_grad()
    def _update_psi_of(self, level: Level) -> bool:
        """Take one step on each psi of a capture that passes held-out retrieval; return True if all have converged."""
        test, _ = level.draw(level.held_out, TEST_KEYPOINTS, _OCTAVES)
        p, _ = level.draw(level.anywhere, _PATCHES, _OCTAVES)
        if len(p) < MIN_KEYPOINTS:
            return True
        f_test = level.fixed.describe(self.net, test)
        patches = ReferencePatches.of(self.net, level, p)
        for band in level.bands:
            band.retrieval, _ = held_out_retrieval(self.net, band, test, f_test)
            if band.retrieval < MIN_RETRIEVAL:
                continue
            band.distinguished = True
            with suppress(NotEnoughTextureError):
                step = step_from(self.net, band, patches, self.state.family)
                band.update(step)
                is_enough = band.retrieval > self.schedule.enough_retrieval
                band.converged |= is_enough and step.length_px < CONVERGED_PX
        return all(band.converged for band in level.bands)


def _loss(net: Descriptor, level: Level) -> Tensor | None:
    """Return the mean in-batch loss of the pairs of a capture on new keypoints; None if too few can be drawn."""
    p, inside = level.draw(level.trainable, BATCH, _OCTAVES)
    visible = [of_band.nonzero()[:, 0] for of_band in inside.unbind(dim=1)]
    used = [(band, rows) for band, rows in zip(level.bands, visible, strict=True) if len(rows) >= MIN_KEYPOINTS]
    if not used:
        return None
    patches = [level.fixed.patches(patch_positions(p)), *(band.patches(p[rows]) for band, rows in used)]
    f, *f_primes = net.describe(patches, [REFERENCE, *(band.moving.side for band, _ in used)])
    allowed = far_apart(p)
    losses = [
        in_batch_loss(f[rows], f_prime, allowed[rows][:, rows])
        for (_, rows), f_prime in zip(used, f_primes, strict=True)
    ]
    return torch.stack(losses).mean()


def in_batch_loss(f: Tensor, f_prime: Tensor, allowed: Tensor) -> Tensor:
    """Return the symmetric InfoNCE loss with the other rows of the batch as negatives, a scalar.

    `f` and `f_prime` are (N, D) descriptors of unit length; row i of one matches row i of the other. `allowed` (N, N)
    is False where two keypoints are too close to be negatives of each other; its diagonal is True.
    Source: van den Oord et al. 2018, Eq. 4.
    """
    logits = (f @ f_prime.T / _TEMPERATURE).masked_fill(~allowed, float("-inf"))
    target = torch.arange(len(f), device=f.device)
    return 0.5 * (functional.cross_entropy(logits, target) + functional.cross_entropy(logits.T, target))
