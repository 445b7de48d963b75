"""Optimisation of psi with theta frozen: inverse-compositional Gauss-Newton on L0 squared.

The descriptors of the reference and their gradient are computed once for all moving bands and all steps (Baker &
Matthews 2004, Sec. 3.2). A step costs one forward pass of the moving band's patches.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from agalign.errors import GeometryError, NotEnoughTextureError
from agalign.method.descriptor import Descriptor, distance, retrieval
from agalign.method.gauss_newton import Step, solve
from agalign.method.levels import Level, LevelBand, make_level
from agalign.method.patches import Keypoints, far_apart
from agalign.method.state import ImageGroup, JointState
from agalign.values.alignment import MIN_RETRIEVAL, JointResult
from agalign.values.choices import ModelFamily
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NOT_INVERTIBLE, RETRIEVAL, Issue

MIN_KEYPOINTS = 16
"""Minimum number of patches in both images for a step on psi or a test of retrieval."""
TEST_KEYPOINTS = 256
"""Keypoints that measure held-out retrieval: chance is 0.004, the standard error of the share 0.03."""
CONVERGED_PX = 0.5
"""While learning, psi has converged if a step displaces no corner by more than this, px of the level."""
PATCHES, FLIGHT_PATCHES = 400, 256
"""Patches in a Gauss-Newton step at full resolution: for a single capture, and for a capture of a flight, where
other captures contribute to network or rig. Half as many are used while the steps are longer than CONVERGED_PX."""
_FINAL_OCTAVES = 0.3
"""Range of log2 of their scales: small patches localise better."""
_FINAL_CONVERGED_PX = 0.06
"""psi has converged if a step displaces no corner by more than this, px: where the images have structure in common,
steps shrink by more than half, so the remaining displacement is smaller than the systematic error."""
_SYSTEMATIC_STD_PX = 0.06
"""Added in quadrature to the standard errors along x and y: errors that the covariance does not contain, such as a
bias between two modalities. With this value, descriptors alone claim the errors that they have at tie points of sharp
images: an RMS of 0.03 to 0.08 px over the image (53 bands of two flights and two captures)."""
_SEARCH_STEP_PX = 3.0
"""Spacing of the translations that are searched, px of the level: a Gauss-Newton step can bridge it."""
_PRESELECTION_PATCHES, _CANDIDATE_SHIFTS = 24, 64
"""Patches with which all shifts of a search are compared, and number of best shifts compared with all patches."""
_MAX_RATIO = 0.6
"""Maximum ratio of successive steps for the extrapolation of a geometric series: above it, errors of the ratio dominate
the sum."""
_MIN_GAIN_SIGMA = 3.0
"""Minimum decrease of the mean loss by a shift, in standard errors of the decrease."""


@dataclass(frozen=True)
class ReferencePatches:
    """Descriptors of patches of the reference, and their gradient."""

    keypoints: Keypoints
    f: Tensor
    """(N, 256) descriptors."""
    gradient: Tensor
    """(N, 256, 2) derivative of the descriptors with respect to a shift, per px."""

    @classmethod
    @torch.no_grad()
    def of(cls, net: Descriptor, level: Level, keypoints: Keypoints) -> "ReferencePatches":
        """Compute the descriptors of keypoints of I and their gradient, by central differences."""
        e = 0.75  # px: half the step of the differences

        def difference(dx_px: float, dy_px: float) -> Tensor:
            ahead, behind = keypoints.moved(dx_px, dy_px), keypoints.moved(-dx_px, -dy_px)
            return level.fixed.describe(net, ahead) - level.fixed.describe(net, behind)

        gradient = torch.stack([difference(e, 0), difference(0, e)], dim=2) / (2 * e)
        return cls(keypoints, level.fixed.describe(net, keypoints), gradient)

    def head(self, count: int) -> "ReferencePatches":
        """Return the first `count` patches."""
        rows = torch.arange(min(count, len(self.f)), device=self.f.device)
        return ReferencePatches(self.keypoints[rows], self.f[rows], self.gradient[rows])


@torch.no_grad()
def step_from(net: Descriptor, band: LevelBand, patches: ReferencePatches, family: ModelFamily | None) -> Step:
    """Compute one Gauss-Newton step on psi, by `gauss_newton.solve`.

    Raises NotEnoughTextureError if too few patches are inside both images.
    """
    rows = band.overlaps(patches.keypoints).nonzero()[:, 0]
    if len(rows) < MIN_KEYPOINTS:
        raise NotEnoughTextureError(len(rows), MIN_KEYPOINTS)
    p = patches.keypoints[rows]
    residual = patches.f[rows] - band.describe(net, p)
    return solve(p.xy, residual, patches.gradient[rows], band.fixed_view.size_px, family)


def converge(net: Descriptor, band: LevelBand, all_patches: ReferencePatches, family: ModelFamily | None) -> Step:
    """Take steps on psi, at most ten, until no corner moves by more than `_FINAL_CONVERGED_PX`; return the last one.

    Long steps use half of the patches, if these are enough. Steps with all patches shrink by a constant ratio, so every
    second one is extended by the sum of the geometric series (Aitken 1926). A step of infinite length is the last one
    and is not applied: the patches do not determine the mapping.
    """
    patches, previous_px = all_patches.head(len(all_patches.f) // 2), math.inf
    max_final_steps = 10  # maximum number of steps at full resolution
    for _ in range(max_final_steps):
        try:
            step = step_from(net, band, patches, family)
        except NotEnoughTextureError:
            if patches is all_patches:
                raise
            patches = all_patches
            continue
        if not math.isfinite(step.length_px):
            break
        ratio = min(step.length_px / previous_px, _MAX_RATIO)
        band.update(step, 1 / (1 - ratio))
        if step.length_px < _FINAL_CONVERGED_PX and patches is all_patches:
            break
        previous_px = step.length_px if patches is all_patches and ratio == 0 else math.inf
        if step.length_px < CONVERGED_PX:
            patches = all_patches
    return step


@torch.no_grad()
def held_out_retrieval(net: Descriptor, band: LevelBand, keypoints: Keypoints, f: Tensor) -> tuple[float, float]:
    """Return the held-out retrieval of the keypoints visible in both images, and its value by chance.

    `f` (N, 256) are the descriptors of the keypoints in I.
    """
    rows = band.overlaps(keypoints).nonzero()[:, 0]
    if len(rows) < MIN_KEYPOINTS:
        return 0.0, 1.0
    p = keypoints[rows]
    return retrieval(f[rows], band.describe(net, p), far_apart(p)), 1 / len(rows)


@torch.no_grad()
def best_shift(net: Descriptor, level: Level, band: LevelBand, keypoints: Keypoints, radius_px: float) -> Tensor:
    """Search the translation (2,) of the fixed side, up to `radius_px` long, with the smallest mean L0.

    Only patches inside both images count. Returns zeros if the decrease of L0 is less than _MIN_GAIN_SIGMA standard
    errors over the patches that are visible with and without the shift.
    """
    no_shift = band.h.new_zeros(2)
    if len(keypoints) < MIN_KEYPOINTS:
        return no_shift
    f = level.fixed.describe(net, keypoints)
    count = int(radius_px / _SEARCH_STEP_PX)
    offsets = torch.arange(-count, count + 1) * _SEARCH_STEP_PX
    shifts = torch.cartesian_prod(offsets, offsets).to(band.h)
    shifts = shifts[shifts.norm(dim=1) <= radius_px]
    few = torch.arange(min(_PRESELECTION_PATCHES, len(keypoints)), device=band.h.device)
    means = _means(_shifted_losses(net, band, keypoints[few], f[few], shifts))
    candidates = torch.cat([no_shift[None], shifts[means.argsort()[:_CANDIDATE_SHIFTS]]])
    losses = _shifted_losses(net, band, keypoints, f, candidates)
    means = _means(losses)
    best = int(means.argmin())
    gain = losses[0] - losses[best]
    gain = gain[gain.isfinite()]
    if not bool(means[best].isfinite()) or len(gain) < MIN_KEYPOINTS:
        return no_shift
    is_significant = float(gain.mean()) > _MIN_GAIN_SIGMA * float(gain.std()) / math.sqrt(len(gain))
    return candidates[best] if is_significant else no_shift


def _shifted_losses(net: Descriptor, band: LevelBand, keypoints: Keypoints, f: Tensor, shifts: Tensor) -> Tensor:
    """Return L0 (S, N) of each keypoint with each shift (S, 2) of the fixed side, NaN where its patch leaves I'."""
    shifts_per_batch = 16  # limits the memory of a search
    losses = []
    for batch in torch.split(shifts, shifts_per_batch):
        xy, count = (keypoints.xy + batch[:, None]).reshape(-1, 2), len(batch)
        shifted = Keypoints(xy, keypoints.angle.repeat(count), keypoints.scale.repeat(count))
        loss = distance(f.repeat(count, 1), band.describe(net, shifted))
        losses.append(loss.masked_fill(~band.is_inside_moving(shifted), float("nan")).reshape(count, -1))
    return torch.cat(losses)


def _means(losses: Tensor) -> Tensor:
    """Return the means (S,) of losses (S, N) that are not NaN, infinite where these are too few."""
    enough = losses.isfinite().sum(dim=1) >= MIN_KEYPOINTS
    return losses.nanmean(dim=1).masked_fill(~enough, float("inf"))


@torch.no_grad()
def refine(
    state: JointState, net: Descriptor, group: ImageGroup, *, update_psi: bool = True, patches: int = PATCHES
) -> list[JointResult | Issue]:
    """Refine every psi of a capture at full resolution with theta frozen.

    Returns a result per moving image, or the issue that prevents one. A step uses up to `patches` patches. Without
    `update_psi`, psi is not changed and only its retrieval and standard errors are computed. Raises NoContrastError.
    """
    level = make_level(state, group.fixed, group.moving, 1.0)
    p, _ = level.draw(level.anywhere, patches, _FINAL_OCTAVES)
    test, _ = level.draw(level.held_out, TEST_KEYPOINTS, _FINAL_OCTAVES)
    if len(p) < MIN_KEYPOINTS:
        return [Issue(FEW_KEYPOINTS, len(p), MIN_KEYPOINTS)] * len(group.moving)
    reference_patches = ReferencePatches.of(net, level, p)
    f_test = level.fixed.describe(net, test)

    def result(band: LevelBand) -> JointResult | Issue:
        if band.moving.dropped_at is not None:
            return Issue(RETRIEVAL, band.moving.dropped_at, MIN_RETRIEVAL)
        try:
            step = (converge if update_psi else step_from)(net, band, reference_patches, state.family)
            matrix = band.fixed_to_moving
        except NotEnoughTextureError as error:
            return Issue(FEW_KEYPOINTS, error.keypoints, error.minimum)
        except GeometryError:
            return Issue(NOT_INVERTIBLE)
        s = _SYSTEMATIC_STD_PX
        std = tuple((math.hypot(x, s), math.hypot(y, s)) for x, y in step.corner_std_xy_px)
        if not all(math.isfinite(x) for x in (step.length_px, *itertools.chain(*std))):
            return Issue(CORNERS_UNKNOWN)
        held_out, chance = held_out_retrieval(net, band, test, f_test)
        random = step.corner_covariance_px2.cpu().numpy()
        covariance_px2 = random + s**2 * np.eye(8) if np.isfinite(random).all() else None
        of_step = step.family, step.length_px, std, covariance_px2
        return JointResult(matrix, math.nan, held_out, chance, 0, (1.0,), "fast", *of_step)

    return [result(band) for band in level.bands]
