"""Psi with theta frozen: Gauss-Newton on L0 squared, inverse-compositional.

The descriptors of the reference and their gradient over a shift are worked out once and serve every moving band and
every step (Baker & Matthews 2004, Sec. 3.2): a step costs one pass of the moving band's patches.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from agalign import losses
from agalign.choices import ModelFamily
from agalign.config import FastRecipe
from agalign.descriptor import REFERENCE, Descriptor
from agalign.errors import NotEnoughTextureError
from agalign.gauss_newton import Step, shift_gradient, solve
from agalign.levels import Level, footprints_inside
from agalign.patches import Keypoints, far_apart, patch_grid, transform, translation

LEAST_KEYPOINTS = 16
_PLAIN_GAIN = 3.0
"""Standard errors by which a loss must be less to count."""


@dataclass(frozen=True)
class Anchors:
    """Patches of the reference as the network describes them."""

    keypoints: Keypoints
    f: Tensor
    """(N, 256) descriptors."""
    gradient: Tensor
    """(N, 256, 2) their derivative over a shift, per px."""

    def head(self, count: int) -> "Anchors":
        """The first `count` of them."""
        rows = torch.arange(min(count, len(self.f)), device=self.f.device)
        return Anchors(self.keypoints[rows], self.f[rows], self.gradient[rows])


def describe_fixed(net: Descriptor, level: Level, keypoints: Keypoints) -> Tensor:
    """f(x) for keypoints of I, (N, 256)."""
    out: Tensor = net(level.fixed.patches(patch_grid(keypoints)), REFERENCE)
    return out


def moving_patches(level: Level, band: int, homography: Tensor, keypoints: Keypoints) -> Tensor:
    """B(w(x; psi); I'), (N, C, 16, 16): every sample goes through the homography, not only the keypoint's frame."""
    return level.moving[band].patches(transform(homography, patch_grid(keypoints)))


@torch.no_grad()
def make_anchors(net: Descriptor, level: Level, keypoints: Keypoints, difference_px: float) -> Anchors:
    """Descriptors and gradient of the reference's patches."""

    def describe(k: Keypoints) -> Tensor:
        return describe_fixed(net, level, k)

    return Anchors(keypoints, describe(keypoints), shift_gradient(describe, keypoints, difference_px))


@torch.no_grad()
def psi_step(
    net: Descriptor, level: Level, band: int, side: int, homography: Tensor, anchors: Anchors,
    family: ModelFamily | None, recipe: FastRecipe,
) -> Step:  # fmt: skip
    """One Gauss-Newton step. Raises NotEnoughTextureError where too few patches lie in both images."""
    rows = footprints_inside(level, band, anchors.keypoints, homography).nonzero()[:, 0]
    if len(rows) < LEAST_KEYPOINTS:
        raise NotEnoughTextureError(f"only {len(rows)} keypoints lie on the common valid area")
    p = anchors.keypoints[rows]
    residual = anchors.f[rows] - net(moving_patches(level, band, homography, p), side)
    return solve(
        p, residual, anchors.gradient[rows], level.fixed.size_px, family,
        recipe.most_corner_std_px, recipe.longest_step_px,
    )  # fmt: skip


def refine(
    net: Descriptor, level: Level, band: int, side: int, start: Tensor, anchors: Anchors,
    family: ModelFamily | None, recipe: FastRecipe,
) -> tuple[Tensor, Step]:  # fmt: skip
    """Steps from `start` until one moves no corner by more than `final_rest_px`.

    While the steps are long, a part of the anchors tells where to go.
    """
    h, some = start, anchors.head(recipe.first_patches)
    for _ in range(recipe.final_steps):
        step = psi_step(net, level, band, side, h, some, family, recipe)
        h = (h.double() @ step.change).float()
        if step.length_px < recipe.final_rest_px and some is anchors:
            break
        if step.length_px < recipe.rest_px:
            some = anchors
    return h, step


@torch.no_grad()
def retrieval(
    net: Descriptor, level: Level, band: int, side: int, homography: Tensor, keypoints: Keypoints, f: Tensor,
    recipe: FastRecipe,
) -> tuple[float, float]:  # fmt: skip
    """How often the nearest descriptor in I' is the right one among the keypoints that lie in both images, and what
    guessing would give. `f` (N, 256) are the reference's descriptors.
    """
    rows = footprints_inside(level, band, keypoints, homography).nonzero()[:, 0]
    if len(rows) < LEAST_KEYPOINTS:
        return 0.0, 1.0
    p = keypoints[rows]
    f_prime = net(moving_patches(level, band, homography, p), side)
    return losses.retrieval(f[rows], f_prime, far_apart(p, recipe.least_negative_px)), 1 / len(rows)


@torch.no_grad()
def best_shift(
    net: Descriptor, level: Level, band: int, side: int, homography: Tensor, keypoints: Keypoints, reach_px: float,
    step_px: float,
) -> Tensor:  # fmt: skip
    """The translation (2,) of the fixed side, up to `reach_px` long, at which the mean L0 of the patches that lie in
    both images is least; none where that is not plainly less than without, for the patches that both have.
    """
    if len(keypoints) < LEAST_KEYPOINTS:
        return homography.new_zeros(2)
    f = describe_fixed(net, level, keypoints)
    count = int(reach_px / step_px)
    along = torch.arange(-count, count + 1, device=homography.device) * step_px
    shifts = torch.cartesian_prod(along, along).to(homography)
    lengths = shifts.norm(dim=1)
    shifts = shifts[lengths <= reach_px]

    def loss(shift: Tensor) -> Tensor:
        """L0 of each keypoint, nan where its patch leaves an image."""
        moved = homography @ translation(shift)
        apart = losses.distance(f, net(moving_patches(level, band, moved, keypoints), side))
        return apart.masked_fill(~footprints_inside(level, band, keypoints, moved), float("nan"))

    table = torch.stack([loss(s) for s in shifts])
    enough = table.isfinite().sum(dim=1) >= LEAST_KEYPOINTS
    means = table.nanmean(dim=1).masked_fill(~enough, float("inf"))
    best, start = int(means.argmin()), int(lengths[lengths <= reach_px].argmin())
    gain = table[start] - table[best]
    gain = gain[gain.isfinite()]
    if not bool(enough[best]) or len(gain) < LEAST_KEYPOINTS:
        return homography.new_zeros(2)
    plain = float(gain.mean()) > _PLAIN_GAIN * float(gain.std()) / math.sqrt(len(gain))
    return shifts[best] if plain else homography.new_zeros(2)
