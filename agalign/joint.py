"""The method: learn a descriptor on the very pair to be aligned while the homography is optimised (paper, Sec. 4).

Names follow the paper: I and I' are `fixed` and `moving`, theta the network's weights, psi the parameters of the
homography, L0 and L1 the losses. Two recipes share the levels, the keypoints, the patches and the network:

* `paper`: SGD on theta and psi together through the contrastive loss, coarse to fine.
* `fast`: Adam on theta through in-batch negatives; every few steps one Gauss-Newton step on psi minimises L0 squared.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from agalign import geometry, losses
from agalign.config import JointSettings
from agalign.descriptor import Descriptor
from agalign.errors import ConfigurationError, NotEnoughTextureError
from agalign.gauss_newton import Step, shift_gradient, solve
from agalign.geometry import Matrix
from agalign.levels import Level, Sampler, make_level
from agalign.patches import (
    FAMILY_PARAMETERS,
    Keypoints,
    bilinear,
    far_apart,
    homography_from_psi,
    patch_grid,
    psi_from_homography,
    transform,
    warp_keypoints,
)
from agalign.records import JointResult, Raster

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


def align_jointly(
    fixed: Raster, moving: Raster, seed: Matrix, settings: JointSettings, *, trusted: bool, progress: Progress
) -> tuple[JointResult, Descriptor]:
    """Learn theta and psi on one pair, starting from `seed` (fixed_to_moving at full resolution).

    A `trusted` seed is good to a few pixels, so recipe fast leaves the coarse levels out. Raises NotEnoughTextureError
    where there is nothing to learn from.
    """
    aligner = JointAligner(fixed, moving, settings, progress)
    if settings.recipe == "paper":
        return aligner.paper(seed)
    return aligner.fast(seed, trusted)


class JointAligner:
    """The state of one joint optimisation: the two images, theta, and the current mapping."""

    def __init__(self, fixed: Raster, moving: Raster, settings: JointSettings, progress: Progress) -> None:
        self.images = fixed, moving
        self.settings = settings
        self.progress = progress
        self.device = choose_device(settings.device)
        self.sampler = Sampler(torch.Generator().manual_seed(settings.rng_seed))
        self.family = None if settings.model_family == "auto" else settings.model_family

    # ---- what both recipes use

    def level(self, scale: float, seed: Matrix) -> Level:
        """Both images at a resolution; the moving one reduced so that the seed's magnification is near 1."""
        fixed, moving = self.images
        magnification = float(np.median(np.abs(geometry.local_scale(seed, *fixed.size_px))))
        moving_scale = min(1.0, scale / magnification) if np.isfinite(magnification) and magnification > 0 else scale
        least_gradient = self.settings.paper.least_gradient
        level = make_level(fixed, moving, scale, moving_scale, least_gradient, self.device)
        if len(level.trainable) == 0:
            raise NotEnoughTextureError("no pixel of the reference band has contrast enough to learn from")
        return level

    def new_descriptor(self, channels: tuple[int, int], *, half_rectified: bool, unit_length: bool) -> Descriptor:
        """F with random weights that depend on nothing but the settings' rng_seed."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.settings.rng_seed)
            net = Descriptor(self.settings.sharing, *channels, half_rectified=half_rectified, unit_length=unit_length)
        return net.to(self.device)

    def to_level(self, matrix: Matrix, level: Level) -> Tensor:
        """A full-resolution fixed_to_moving matrix as one between the level's images, (3, 3) float32."""
        scaled = geometry.rescale(matrix, *self._scales(level))
        return torch.tensor(scaled, dtype=torch.float32, device=self.device)

    def to_full(self, homography: Tensor, level: Level) -> Matrix:
        """The inverse of `to_level`."""
        fixed_scale, moving_scale = self._scales(level)
        inverse = [(1 / s[0], 1 / s[1]) for s in (fixed_scale, moving_scale)]
        return geometry.rescale(homography.double().cpu().numpy(), inverse[0], inverse[1])

    def _scales(self, level: Level) -> tuple[tuple[float, float], tuple[float, float]]:
        scales = [
            (view.size_px[0] / image.size_px[0], view.size_px[1] / image.size_px[1])
            for view, image in zip((level.fixed, level.moving), self.images, strict=True)
        ]
        return scales[0], scales[1]

    # ---- recipe paper

    def paper(self, seed: Matrix) -> tuple[JointResult, Descriptor]:
        """SGD on theta and psi through one loss, level by level; theta starts anew at each, psi is handed on."""
        recipe = self.settings.paper
        mapping = seed
        longer_side = max(self.images[0].size_px)
        halvings = max(0, round(math.log2(longer_side / recipe.coarsest_px)))
        scales = tuple(0.5**k for k in range(halvings, -1, -1))
        steps = 0
        for number, scale in enumerate(scales):
            level = self.level(scale, mapping)
            channels = len(level.fixed.image), len(level.moving.image)
            net = self.new_descriptor(channels, half_rectified=False, unit_length=False)

            def report(share: float, number: int = number) -> None:
                self.progress("learning", (number + share) / len(scales))

            mapping, level_steps, loss, last_step_px = self.descend(net, level, mapping, report)
            steps += level_steps
        h = self.to_level(mapping, level)
        held_out, chance = self.held_out_retrieval(net, level, h)
        with torch.no_grad():
            curvature = self.gauss_newton(net, level, h, self.settings.fast.final_patches)
        family = self.family or "homography"
        result = JointResult(
            mapping, loss, held_out, chance, steps, scales, "paper", family, last_step_px, curvature.corner_std_px
        )
        return result, net

    def descend(
        self, net: Descriptor, level: Level, start: Matrix, report: Callable[[float], None]
    ) -> tuple[Matrix, int, float, float]:
        """Argmin over theta and psi of sum L0(x; psi, theta) + sum L1(x, x'; theta) (paper, Eq. 5)."""
        recipe = self.settings.paper
        width, height = level.fixed.size_px
        h = self.to_level(start, level)
        psi = psi_from_homography(h.double(), width, height).float().requires_grad_()
        movable = torch.zeros(8, device=self.device)
        movable[list(FAMILY_PARAMETERS[self.family or "homography"])] = 1.0

        p = self.sampler.draw(level, level.trainable, h, recipe.keypoints, recipe.octaves, recipe.spacing_px)
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
            for rows in torch.split(shuffled[: batches * recipe.batch], recipe.batch):
                h = homography_from_psi(psi, width, height)
                f = net(bilinear(level.fixed.image, patch_grid(p[rows])), "fixed")
                f_true = net(bilinear(level.moving.image, patch_grid(warp_keypoints(p[rows], h))), "moving")
                f_false = net(bilinear(level.moving.image, patch_grid(negatives[rows])), "moving")
                apart = losses.distance(f, f_false)[is_negative[rows]]
                loss = losses.contrastive(losses.distance(f, f_true), apart, recipe.margin)
                optimiser.zero_grad()
                torch.autograd.backward(loss)
                assert psi.grad is not None
                psi.grad *= movable
                before = psi.detach().clone()
                optimiser.step()
                annealing.step()
            loss_value = float(loss.detach()) / recipe.batch
            report(annealing.last_epoch / steps)
        h, h_before = (homography_from_psi(q, width, height).detach() for q in (psi, before))
        corner_points = torch.tensor(geometry.corners(width, height), dtype=h.dtype, device=self.device)
        last_step = (transform(h, corner_points) - transform(h_before, corner_points)).norm(dim=1).max()
        return self.to_full(h, level), steps, loss_value, float(last_step)

    # ---- recipe fast

    def fast(self, seed: Matrix, trusted: bool) -> tuple[JointResult, Descriptor]:
        """Theta is carried from level to level; at full resolution only psi moves."""
        psi = seed
        net: Descriptor | None = None
        steps_taken, loss = 0, float("nan")
        scales = self.learn_scales()
        scales = scales[-1:] if trusted else scales
        for scale in scales:
            level = self.level(scale, psi)
            if net is None:
                channels = len(level.fixed.image), len(level.moving.image)
                net = self.new_descriptor(channels, half_rectified=True, unit_length=True)
            psi, steps, loss = self.learn(net, level, psi)
            steps_taken += steps
        assert net is not None
        level = self.level(1.0, psi)
        psi, step = self.refine(net, level, psi)
        held_out, chance = self.held_out_retrieval(net, level, self.to_level(psi, level))
        result = JointResult(
            psi, loss, held_out, chance, steps_taken, (*scales, 1.0), "fast", step.family,
            step.length_px, step.corner_std_px,
        )  # fmt: skip
        return result, net

    def learn_scales(self) -> list[float]:
        """Resolutions at which theta is learnt, coarse to fine."""
        recipe = self.settings.fast
        longer_side = max(self.images[0].size_px)
        scales = [min(1.0, max(0.5, recipe.learn_px / longer_side))]
        while scales[0] * longer_side >= 2 * recipe.coarsest_px:
            scales.insert(0, scales[0] / 2)
        return scales

    def learn(self, net: Descriptor, level: Level, seed: Matrix) -> tuple[Matrix, int, float]:
        """Theta by Adam; psi by Gauss-Newton once held-out patches are told apart."""
        recipe = self.settings.fast
        optimiser = torch.optim.Adam(net.parameters(), recipe.learning_rate)
        h = self.to_level(seed, level)
        loss_value = float("nan")
        for step in range(1, recipe.most_steps + 1):
            p = self.sampler.draw(level, level.trainable, h, recipe.batch, recipe.octaves)
            if len(p) < recipe.batch // 4:
                raise NotEnoughTextureError(f"only {len(p)} keypoints lie on the common valid area")
            f, f_prime = self.describe(net, level, h, p)
            loss = losses.in_batch(f, f_prime, far_apart(p, recipe.least_negative_px), recipe.temperature)
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
            if step < recipe.warm_up_steps or step % recipe.steps_between_updates:
                continue
            self.progress("learning", step / recipe.most_steps)
            loss_value = float(loss.detach())
            retrieved, _ = self.held_out_retrieval(net, level, h)
            if retrieved < recipe.step_gate:
                continue
            update = self.gauss_newton(net, level, h, recipe.learn_patches)
            h = (h.double() @ update.change).float()
            if retrieved > recipe.enough_retrieval and update.length_px < recipe.rest_px:
                break
        return self.to_full(h, level), step, loss_value

    def refine(self, net: Descriptor, level: Level, start: Matrix) -> tuple[Matrix, Step]:
        """Gauss-Newton steps on psi with theta frozen, until they are short."""
        recipe = self.settings.fast
        h = self.to_level(start, level)
        for number in range(recipe.final_steps):
            self.progress("refining", number / recipe.final_steps)
            step = self.gauss_newton(net, level, h, recipe.final_patches)
            h = (h.double() @ step.change).float()
            if step.length_px < recipe.final_rest_px:
                break
        return self.to_full(h, level), step

    @torch.no_grad()
    def gauss_newton(self, net: Descriptor, level: Level, h: Tensor, patches: int) -> Step:
        """One step on psi. The gradient is the mean of both sides', which makes the step second-order accurate."""
        recipe = self.settings.fast
        p = self.sampler.draw(level, level.anywhere, h, patches, recipe.octaves)
        if len(p) < 16:
            raise NotEnoughTextureError(f"only {len(p)} keypoints lie on the common valid area")

        def fixed_side(k: Keypoints) -> Tensor:
            return self.describe_fixed(net, level, k)

        def moving_side(k: Keypoints) -> Tensor:
            return self.describe_moving(net, level, h, k)

        e = recipe.difference_px
        gradient = 0.5 * (shift_gradient(fixed_side, p, e) + shift_gradient(moving_side, p, e))
        residual = fixed_side(p) - moving_side(p)
        return solve(
            p, residual, gradient, level.fixed.size_px, self.family,
            recipe.most_corner_std_px, recipe.longest_step_px,
        )  # fmt: skip

    def describe(self, net: Descriptor, level: Level, h: Tensor, p: Keypoints) -> tuple[Tensor, Tensor]:
        """f(x) and f(w(x; psi)) for keypoints of I, (N, 256) each."""
        return self.describe_fixed(net, level, p), self.describe_moving(net, level, h, p)

    def describe_fixed(self, net: Descriptor, level: Level, p: Keypoints) -> Tensor:
        out: Tensor = net(bilinear(level.fixed.image, patch_grid(p)), "fixed")
        return out

    def describe_moving(self, net: Descriptor, level: Level, h: Tensor, p: Keypoints) -> Tensor:
        """Every sample of the patch goes through the homography, not only the keypoint's frame."""
        out: Tensor = net(bilinear(level.moving.image, transform(h, patch_grid(p))), "moving")
        return out

    @torch.no_grad()
    def held_out_retrieval(self, net: Descriptor, level: Level, h: Tensor) -> tuple[float, float]:
        """Retrieval on keypoints of cells that theta never saw, and what guessing would give."""
        recipe = self.settings.fast
        p = self.sampler.draw(level, level.held_out, h, recipe.test_keypoints, recipe.octaves)
        if len(p) < 16:
            return 0.0, 1.0
        f, f_prime = self.describe(net, level, h, p)
        return losses.retrieval(f, f_prime, far_apart(p, recipe.least_negative_px)), 1 / len(p)
