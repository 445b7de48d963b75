"""The method: learn a descriptor on the very images to be aligned while the homographies are optimised (paper, Sec. 4).

Names follow the paper: I and I' are `fixed` and `moving`, theta the network's weights, psi the parameters of a
homography, L0 and L1 the losses. Two recipes share the levels, the keypoints, the patches and the network:

* `paper`: SGD on theta and psi together through the contrastive loss, coarse to fine, one pair at a time.
* `fast`: Adam on theta through in-batch negatives; every few steps one Gauss-Newton step on psi minimises L0 squared.
  One theta for as many captures as are given, each pair with its own psi (the paper's future work).
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace

import cv2
import torch
from torch import Tensor

from agalign import geometry, losses
from agalign.config import FastRecipe, JointSettings
from agalign.descriptor import REFERENCE, Descriptor
from agalign.errors import ConfigurationError, GeometryError, NotEnoughTextureError
from agalign.gauss_newton import Step
from agalign.geometry import Matrix
from agalign.levels import Level, Sampler, make_level
from agalign.patches import (
    FAMILY_PARAMETERS,
    far_apart,
    homography_from_psi,
    patch_grid,
    psi_from_homography,
    transform,
    translation,
    warp_keypoints,
)
from agalign.records import JointResult, Raster
from agalign.refine import (
    LEAST_KEYPOINTS,
    best_shift,
    describe_fixed,
    make_anchors,
    moving_patches,
    psi_step,
    refine,
    retrieval,
)
from agalign.starter import start_from_starter

Progress = Callable[[str, float], None]
"""Called with the name of what is being done and the share of it that is behind, 0 to 1."""


def choose_device(name: str) -> torch.device:
    """`auto` is CUDA where there is one, else the CPU. Raises ConfigurationError where `name` cannot be had."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigurationError(f"device '{name}' cannot be used here: {str(error).splitlines()[0]}") from None
    return device


def limit_threads(count: int) -> None:
    """Let torch and OpenCV use this many threads from now on."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


@contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread inside: the networks are too small to gain from more, and sums do not depend on how many
    processes share the machine.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass
class Subject:
    """The images of one capture and where their alignment stands."""

    fixed: Raster
    moving: Sequence[Raster]
    mappings: list[Matrix]
    """fixed_to_moving of each moving image, undistorted px; moved along by the optimisation."""
    sides: Sequence[int]
    """Which of the network's sides describes each moving image."""
    trusted: Sequence[bool]
    """Seeds that are good to a few pixels: recipe fast leaves the coarse levels out."""


@dataclass
class Pairs:
    """Some moving images of a subject at one level, with their psi as homographies of that level."""

    subject: Subject
    bands: Sequence[int]
    level: Level
    h: list[Tensor] = field(init=False)
    settled: list[bool] = field(init=False)
    """Those whose psi has been at rest once; it is moved on all the same."""
    told_apart: bool = False
    """Held-out patches of some image have been, so that its psi could move."""

    def __post_init__(self) -> None:
        self.settled = [False] * len(self.bands)
        self.h = [self.level.homography(self.subject.mappings[b], i) for i, b in enumerate(self.bands)]

    def side(self, index: int) -> int:
        """The network's side of one of these images."""
        return self.subject.sides[self.bands[index]]

    def hand_on(self) -> None:
        """Give what was found to the subject; a homography that cannot be inverted is not handed on."""
        for i, b in enumerate(self.bands):
            with suppress(GeometryError):
                self.subject.mappings[b] = self.level.full_matrix(self.h[i], i)


class JointAligner:
    """The state of a joint optimisation: theta, and the random numbers."""

    def __init__(self, settings: JointSettings, progress: Progress) -> None:
        self.settings = settings
        self.progress = progress
        self.device = choose_device(settings.device)
        self.sampler = Sampler(torch.Generator().manual_seed(settings.rng_seed))
        self.family = None if settings.model_family == "auto" else settings.model_family

    # ---- what both recipes use

    def level(self, subject: Subject, scale: float, bands: Sequence[int]) -> Level:
        """The subject's reference and some of its moving images at a resolution."""
        level = make_level(
            subject.fixed, [subject.moving[b] for b in bands], [subject.mappings[b] for b in bands], scale,
            self.settings.paper.least_gradient, self.sampler.generator, self.device,
        )  # fmt: skip
        if len(level.trainable) == 0:
            raise NotEnoughTextureError("no pixel of the reference band has contrast enough to learn from")
        return level

    def new_descriptor(self, channels: Sequence[int], *, half_rectified: bool, unit_length: bool) -> Descriptor:
        """F with random weights that depend on nothing but the settings' rng_seed."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.settings.rng_seed)
            net = Descriptor(self.settings.sharing, channels, half_rectified=half_rectified, unit_length=unit_length)
        return net.to(self.device)

    def fast_descriptor(self, channels: Sequence[int]) -> Descriptor:
        """F of recipe fast where theta starts."""
        net = self.new_descriptor(channels, half_rectified=True, unit_length=True)
        if self.settings.fast.start == "starter":
            start_from_starter(net)
        return net

    # ---- recipe paper

    def paper(self, fixed: Raster, moving: Raster, seed: Matrix) -> tuple[Descriptor, JointResult]:
        """SGD on theta and psi through one loss, level by level; theta starts anew at each, psi is handed on."""
        recipe = self.settings.paper
        subject = Subject(fixed, [moving], [seed], [1], [False])
        halvings = max(0, round(math.log2(max(fixed.size_px) / recipe.coarsest_px)))
        scales = tuple(0.5**k for k in range(halvings, -1, -1))
        steps = 0
        for number, scale in enumerate(scales):
            level = self.level(subject, scale, [0])
            channels = len(level.fixed.image), len(level.moving[0].image)
            net = self.new_descriptor(channels, half_rectified=False, unit_length=False)

            def report(share: float, number: int = number) -> None:
                self.progress("learning", (number + share) / len(scales))

            subject.mappings[0], level_steps, loss, last_step_px = self.descend(net, level, subject.mappings[0], report)
            steps += level_steps
        found = self.refine(net, subject, move=False)[0]
        if isinstance(found, str):
            raise NotEnoughTextureError(found)
        return net, replace(
            found, fixed_to_moving=subject.mappings[0], loss=loss, iterations=steps, levels=scales, recipe="paper",
            last_step_px=last_step_px,
        )  # fmt: skip

    def descend(
        self, net: Descriptor, level: Level, start: Matrix, report: Callable[[float], None], *, move: bool = True
    ) -> tuple[Matrix, int, float, float]:
        """Argmin over theta and psi of sum L0(x; psi, theta) + sum L1(x, x'; theta) (paper, Eq. 5).

        Without `move` over theta alone, with psi known (paper, Eq. 3). Returns the mapping, the steps taken, the mean
        loss a keypoint of the last pass and the last step's length in px of the level.
        """
        recipe = self.settings.paper
        width, height = level.fixed.size_px
        fixed, moving = level.fixed, level.moving[0]
        h = level.homography(start, 0)
        psi = psi_from_homography(h.double(), width, height).float().requires_grad_()
        movable = torch.zeros(8, device=self.device)
        if move:
            movable[list(FAMILY_PARAMETERS[self.family or "homography"])] = 1.0

        p, _ = self.sampler.draw(level, level.trainable, [h], recipe.keypoints, recipe.octaves, recipe.spacing_px)
        if len(p) < recipe.batch:
            raise NotEnoughTextureError(f"only {len(p)} keypoints lie on the common valid area")
        # The negatives are drawn once: each keypoint of I with a random other one's place in I'.
        order = torch.randperm(len(p), generator=self.sampler.generator).to(self.device)
        negatives = warp_keypoints(p[order], h)
        is_negative = (negatives.xy - transform(h, p.xy)).norm(dim=1) >= recipe.least_negative_px

        batches = len(p) // recipe.batch
        steps = recipe.epochs * batches
        optimiser = torch.optim.SGD([*net.parameters(), psi], recipe.learning_rate, recipe.momentum)
        annealing = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        loss_value, before = float("nan"), psi.detach().clone()
        for _ in range(recipe.epochs):
            shuffled = torch.randperm(len(p), generator=self.sampler.generator).to(self.device)
            pass_loss = 0.0
            for rows in torch.split(shuffled[: batches * recipe.batch], recipe.batch):
                h = homography_from_psi(psi, width, height)
                f = net(fixed.patches(patch_grid(p[rows])), REFERENCE)
                f_true = net(moving.patches(patch_grid(warp_keypoints(p[rows], h))), 1)
                f_false = net(moving.patches(patch_grid(negatives[rows])), 1)
                apart = losses.distance(f, f_false)[is_negative[rows]]
                loss = losses.contrastive(losses.distance(f, f_true), apart, recipe.margin)
                optimiser.zero_grad()
                torch.autograd.backward(loss)
                assert psi.grad is not None
                psi.grad *= movable
                before = psi.detach().clone()
                optimiser.step()
                annealing.step()
                pass_loss += float(loss.detach())
            loss_value = pass_loss / (batches * recipe.batch)
            report(annealing.last_epoch / steps)
        h, h_before = (homography_from_psi(q, width, height).detach() for q in (psi, before))
        corner_points = torch.tensor(geometry.corners(width, height), dtype=h.dtype, device=self.device)
        last_step = (transform(h, corner_points) - transform(h_before, corner_points)).norm(dim=1).max()
        return level.full_matrix(h, 0), steps, loss_value, float(last_step)

    # ---- recipe fast

    def learn(self, subjects: Sequence[Subject], net: Descriptor) -> tuple[int, float]:
        """Theta and every psi of all subjects, coarse to fine; theta is carried from level to level.

        Returns the steps taken and the last loss. Raises NotEnoughTextureError where a reference has no contrast.
        """
        scales = self.learn_scales(max(max(s.fixed.size_px) for s in subjects))
        steps, loss = 0, float("nan")
        for number, scale in enumerate(scales):
            last = number == len(scales) - 1
            wanted = [(s, [b for b in range(len(s.moving)) if last or not s.trusted[b]]) for s in subjects]
            pairs = [Pairs(s, bands, self.level(s, scale, bands)) for s, bands in wanted if bands]
            if number == 0 and net.learnt:
                for p in pairs:
                    self.search(net, p)
            if pairs:
                taken, loss = self.learn_level(net, pairs)
                steps += taken
            for p in pairs:
                p.hand_on()
        return steps, loss

    def learn_scales(self, longer_side_px: int) -> list[float]:
        """Resolutions at which theta is learnt, coarse to fine."""
        recipe = self.settings.fast
        scales = [min(1.0, max(0.5, recipe.learn_px / longer_side_px))]
        while scales[0] * longer_side_px >= 2 * recipe.coarsest_px:
            scales.insert(0, scales[0] / 2)
        return scales

    @torch.no_grad()
    def search(self, net: Descriptor, pairs: Pairs) -> None:
        """Move each untrusted psi by the translation under which the patches' loss is least.

        Around the truth the loss is a funnel (paper, Fig. 2) that is wider than what one Gauss-Newton step sees.
        """
        recipe, level = self.settings.fast, pairs.level
        p, _ = self.sampler.draw(level, level.anywhere, pairs.h, recipe.search_patches, recipe.octaves)
        for b, h in enumerate(pairs.h):
            if pairs.subject.trusted[pairs.bands[b]]:
                continue
            reach = recipe.search_share * max(level.fixed.size_px)
            shift = best_shift(net, level, b, pairs.side(b), h, p, reach, recipe.search_step_px)
            pairs.h[b] = h @ translation(shift).to(h)

    def learn_level(self, net: Descriptor, pairs: Sequence[Pairs]) -> tuple[int, float]:
        """Theta by Adam, a capture at a time; each psi by Gauss-Newton once held-out patches are told apart.

        A network that is learnt already needs no step where its first ones on psi are enough.
        """
        recipe = self.settings.fast
        optimiser = torch.optim.Adam(net.parameters(), recipe.learning_rate)
        loss_value = float("nan")
        most_steps = recipe.most_steps * len(pairs)
        between = recipe.steps_between_updates * len(pairs)
        warm_up = 0 if net.learnt else recipe.warm_up_steps
        if net.learnt:
            for _ in range(recipe.first_updates):
                settled = [self.move_psi(net, p) for p in pairs]
                if all(settled):
                    return 0, loss_value
        for step in range(1, most_steps + 1):
            loss = self.loss(net, pairs[step % len(pairs)])
            if loss is not None:
                optimiser.zero_grad()
                torch.autograd.backward(loss)
                optimiser.step()
                loss_value = float(loss.detach())
            if step < warm_up or step % between:
                continue
            self.progress("learning", step / most_steps)
            settled = [self.move_psi(net, p) for p in pairs]
            if all(settled):
                break
            if step >= warm_up + recipe.hopeless_steps * len(pairs) and not any(p.told_apart for p in pairs):
                break
        net.learnt = True
        return step, loss_value

    def loss(self, net: Descriptor, pairs: Pairs) -> Tensor | None:
        """The in-batch loss of one capture's pairs on keypoints that are drawn anew; None where none can be drawn."""
        recipe, level = self.settings.fast, pairs.level
        p, inside = self.sampler.draw(level, level.trainable, pairs.h, recipe.batch, recipe.octaves)
        rows = [inside[:, b].nonzero()[:, 0] for b in range(len(pairs.h))]
        taking_part = [b for b, r in enumerate(rows) if len(r) >= LEAST_KEYPOINTS]
        if not taking_part:
            return None
        patches = [level.fixed.patches(patch_grid(p))]
        patches += [moving_patches(level, b, pairs.h[b], p[rows[b]]) for b in taking_part]
        f, *f_primes = net.describe(patches, [REFERENCE, *(pairs.side(b) for b in taking_part)])
        apart = far_apart(p, recipe.least_negative_px)
        terms = [
            losses.in_batch(f[rows[b]], f_prime, apart[rows[b]][:, rows[b]], recipe.temperature)
            for b, f_prime in zip(taking_part, f_primes, strict=True)
        ]
        return torch.stack(terms).mean()

    @torch.no_grad()
    def move_psi(self, net: Descriptor, pairs: Pairs) -> bool:
        """One step on each psi of a capture whose held-out patches are retrieved; True where all have settled."""
        recipe, level = self.settings.fast, pairs.level
        test, _ = self.sampler.draw(level, level.held_out, pairs.h, recipe.test_keypoints, recipe.octaves)
        p, _ = self.sampler.draw(level, level.anywhere, pairs.h, recipe.learn_patches, recipe.octaves)
        if len(p) < LEAST_KEYPOINTS:
            return True
        f_test = describe_fixed(net, level, test)
        anchors = make_anchors(net, level, p, recipe.difference_px)
        for b, h in enumerate(pairs.h):
            retrieved, _ = retrieval(net, level, b, pairs.side(b), h, test, f_test, recipe)
            if retrieved < recipe.step_gate:
                continue
            pairs.told_apart = True
            with suppress(NotEnoughTextureError):
                step = psi_step(net, level, b, pairs.side(b), h, anchors, self.family, recipe)
                pairs.h[b] = (h.double() @ step.change).float()
                pairs.settled[b] |= retrieved > recipe.enough_retrieval and step.length_px < recipe.rest_px
        return all(pairs.settled)

    @torch.no_grad()
    def refine(self, net: Descriptor, subject: Subject, *, move: bool = True) -> list[JointResult | str]:
        """Every psi of a capture at full resolution with theta frozen; a text says why a pair has none.

        Without `move` psi stays where it is, and what is said of it is how sure it is.
        """
        recipe = self.settings.fast
        level = self.level(subject, 1.0, range(len(subject.moving)))
        h = [level.homography(matrix, b) for b, matrix in enumerate(subject.mappings)]
        p, _ = self.sampler.draw(level, level.anywhere, h, recipe.final_patches, recipe.final_octaves)
        test, _ = self.sampler.draw(level, level.held_out, h, recipe.test_keypoints, recipe.final_octaves)
        if len(p) < LEAST_KEYPOINTS:
            return [f"only {len(p)} keypoints lie on the common valid area"] * len(h)
        anchors = make_anchors(net, level, p, recipe.difference_px)
        f_test = describe_fixed(net, level, test)
        results: list[JointResult | str] = []
        for b, side in enumerate(subject.sides):
            try:
                if move:
                    found, step = refine(net, level, b, side, h[b], anchors, self.family, recipe)
                else:
                    found, step = h[b], psi_step(net, level, b, side, h[b], anchors, self.family, recipe)
                matrix = level.full_matrix(found, b)
            except NotEnoughTextureError as why_not:
                results.append(str(why_not))
                continue
            except GeometryError:
                results.append("the optimisation ended in a mapping that cannot be inverted")
                continue
            std = _complete_std(step, recipe)
            if not all(math.isfinite(x) for x in (step.length_px, *itertools.chain(*std))):
                results.append("the patches do not say where the corners lie")
                continue
            held_out, chance = retrieval(net, level, b, side, found, test, f_test, recipe)
            results.append(
                JointResult(
                    matrix, math.nan, held_out, chance, 0, (1.0,), "fast", step.family,
                    step.length_px, std,
                )
            )  # fmt: skip
        return results


def _complete_std(step: Step, recipe: FastRecipe) -> tuple[tuple[float, float], ...]:
    """Random and systematic parts together."""
    systematic = recipe.systematic_std_px
    return tuple((math.hypot(x, systematic), math.hypot(y, systematic)) for x, y in step.corner_std_xy_px)
