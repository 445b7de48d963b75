"""Recipe paper: SGD on theta and psi with a single loss, level by level, as published (paper, Sec. 4 and 5).

Names follow the paper: I and I' are `fixed` and `moving`, f is the descriptor, theta are the network's weights, psi
the parameters of a homography, L0 and L1 the losses. The constants are those of Sec. 5.3 unless stated otherwise.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from agalign.errors import NotEnoughTextureError
from agalign.method.descriptor import Descriptor, distance
from agalign.method.device import to_float64
from agalign.method.levels import Level, Pool, make_level
from agalign.method.patches import (
    FAMILY_PARAMETERS,
    Keypoints,
    homography_from_psi,
    patch_positions,
    psi_from_homography,
    transform,
    warp_keypoints,
)
from agalign.method.refine import refine
from agalign.method.state import ImageGroup, JointState
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.issues import Issue
from agalign.values.pixel_units import Size

_COARSEST_PX = 80
"""Longer side of the coarsest level. With 64, where few patches fit, psi moves half as far."""
_OCTAVES = 4.0
"""log2 of the patch scale s is uniform in [0, _OCTAVES]."""
_MARGIN = 1.0
"""Of the hinge loss L1."""
_MIN_NEGATIVE_PX = 16.0
"""tau: minimum distance of a negative from the true position. Not given in the paper."""
_BATCH = 64
"""Keypoints per step of SGD."""


@dataclass(frozen=True)
class Training:
    """How long recipe paper trains at each level."""

    keypoints: int = 4000
    epochs: int = 100
    """Passes over the keypoints at the coarsest level, half as many at each next one: psi has farthest to go at the
    coarsest. Not given in the paper; its 90 s a pair on a GTX 1080 Ti are about 100 at each level."""


DEFAULT_TRAINING = Training()


def pyramid(longer_side_px: int) -> tuple[float, ...]:
    """Return the scales of the levels, coarse to fine, each about half of the next; 1 is full resolution."""
    octaves = max(0.0, math.log2(longer_side_px / _COARSEST_PX))
    return tuple(np.exp2(np.linspace(-octaves, 0.0, round(octaves) + 1)).tolist()) if round(octaves) else (1.0,)


def align_by_paper(
    state: JointState, group: ImageGroup, training: Training = DEFAULT_TRAINING
) -> tuple[Descriptor, JointResult | Issue]:
    """Align a group of one moving image; return the network and the result.

    Coarse to fine: theta is reinitialised at each level, psi is kept. Raises NotEnoughTextureError, NoContrastError,
    and GeometryError if the final matrix is not invertible.
    """
    moving = group.moving[0]
    channels = group.fixed.channels, moving.raster.channels
    scales = pyramid(max(group.fixed.size_px))
    steps = 0
    for number, scale in enumerate(scales):
        level = make_level(state, group.fixed, group.moving, scale)
        # The last theta measures the held-out retrieval, so it must not be trained on the held-out cells.
        pool = level.trainable if scale == 1.0 else level.anywhere
        net = state.random_descriptor(channels)
        at_level = replace(training, epochs=max(1, training.epochs >> number))
        shares = number / len(scales), (number + 1) / len(scales)
        level_steps, loss, last_step_px = descend(state, net, level, pool, at_level, shares=shares)
        moving.fixed_to_moving = level.bands[0].fixed_to_moving
        steps += level_steps
    result = refine(state, net, group, update_psi=False)[0]
    if isinstance(result, Issue):
        return net, result
    return net, replace(
        result,
        fixed_to_moving=moving.fixed_to_moving,
        loss=loss,
        iterations=steps,
        levels=scales,
        recipe="paper",
        last_step_px=last_step_px,
    )


def descend(
    state: JointState,
    net: Descriptor,
    level: Level,
    pool: Pool,
    training: Training,
    *,
    shares: tuple[float, float] = (0.0, 1.0),
    update_psi: bool = True,
) -> tuple[int, float, float]:
    """Minimise sum L0(x; psi, theta) + sum L1(x, x'; theta) over theta and psi (paper, Eq. 5).

    Keypoints x are drawn from `pool`. Without `update_psi`, only theta is learned (paper, Eq. 4). The homography of the
    moving image is updated. `shares` are the completed shares of the whole work before and after. Returns (number of
    steps, mean loss per keypoint over the last epoch, largest displacement of a corner in the last step, px of the
    level). Raises NotEnoughTextureError.
    """
    size_px, band = level.fixed.size_px, level.bands[0]
    psi = psi_from_homography(to_float64(band.h), *size_px).to(level.fixed.image).requires_grad_()
    is_free, steps, momentum = torch.zeros_like(psi), 0, 0.9
    if update_psi:
        is_free[list(FAMILY_PARAMETERS[state.family or "homography"])] = 1.0
    learning_rate = 1e-4  # annealed by a cosine to 0 within each level
    optimiser = torch.optim.SGD([*net.parameters(), psi], learning_rate, momentum)
    annealing = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, training.epochs)
    loss_value, before = float("nan"), psi.detach().clone()
    for epoch in range(training.epochs):
        band.h = homography_from_psi(psi.detach(), *size_px)
        x, x_false, is_negative = _draw(level, pool, training.keypoints)
        batches = torch.split(torch.arange(len(x) // _BATCH * _BATCH), _BATCH)
        epoch_loss = 0.0
        for rows in batches:
            h = homography_from_psi(psi, *size_px)
            loss = _loss(net, level, h, x[rows], x_false[rows], is_negative[rows])
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            assert psi.grad is not None
            psi.grad *= is_free
            before = psi.detach().clone()
            optimiser.step()
            epoch_loss += float(loss.detach())
        annealing.step()
        steps += len(batches)
        loss_value = epoch_loss / (len(batches) * _BATCH)
        state.progress("learning", float(np.interp(epoch + 1, (0, training.epochs), shares)))
    band.h, h_before = (homography_from_psi(q, *size_px).detach() for q in (psi, before))
    return steps, loss_value, _largest_px(band.h, h_before, size_px)


def _largest_px(h: Tensor, h_before: Tensor, size_px: Size) -> float:
    """The largest displacement of a corner by a change of the homography."""
    corners = torch.tensor(geometry.corners(*size_px)).to(h)
    return float((transform(h, corners) - transform(h_before, corners)).norm(dim=1).max())


def _draw(level: Level, pool: Pool, count: int) -> tuple[Keypoints, Keypoints, Tensor]:
    """Draw the keypoints x of a pass, N non-matching keypoints x' of I', and (N,) False where x' is too close to the
    true position to serve as a negative. A negative is the warped position of another random keypoint.
    """
    # Distance between a patch's samples at s = 1: patches are 4 to 64 px wide. Not given in the paper.
    spacing_px = 0.25
    x, _ = level.draw(pool, count, _OCTAVES, spacing_px)
    if len(x) < _BATCH:
        raise NotEnoughTextureError(len(x), _BATCH)
    h = level.bands[0].h
    order = torch.randperm(len(x), generator=level.generator).to(h.device)
    x_false = warp_keypoints(x[order], h)
    return x, x_false, (x_false.xy - transform(h, x.xy)).norm(dim=1) >= _MIN_NEGATIVE_PX


def _loss(net: Descriptor, level: Level, h: Tensor, x: Keypoints, x_false: Keypoints, is_negative: Tensor) -> Tensor:
    """Return the sum of L0(x, w_k(x; psi)) and of L1(x, x') (paper, Eq. 3)."""
    f = level.fixed.describe(net, x)
    band = level.bands[0]
    positions = torch.cat([patch_positions(warp_keypoints(x, h)), patch_positions(x_false)])
    f_true, f_false = net(band.view.patches(positions), band.moving.side).chunk(2)
    return contrastive_loss(distance(f, f_true), distance(f, f_false)[is_negative])


def contrastive_loss(positive: Tensor, negative: Tensor) -> Tensor:
    """Return the contrastive loss (paper, Eq. 3), a scalar.

    The sum of L0 over positive pairs and of L1 = max(0, margin - L0) over negative pairs. `positive` (P,) and
    `negative` (N,) are distances of descriptors.
    """
    return positive.sum() + functional.relu(_MARGIN - negative).sum()
