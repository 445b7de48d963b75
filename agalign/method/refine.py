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
from agalign.method.descriptor import REFERENCE, Descriptor, distance, retrieval
from agalign.method.device import to_float64
from agalign.method.gauss_newton import PatchEquations, Step, shift_gradient, solve
from agalign.method.levels import Level, footprints_inside, footprints_inside_moving
from agalign.method.patches import Keypoints, far_apart, patch_positions, transform
from agalign.method.state import ImageGroup, JointState
from agalign.values.alignment import MIN_RETRIEVAL, JointResult
from agalign.values.choices import ModelFamily
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NOT_INVERTIBLE, RETRIEVAL, Issue
from agalign.values.pixel_units import FixedImagePx

MIN_KEYPOINTS = 16
"""Minimum number of patches in both images for a step on psi or a test of retrieval."""
TEST_KEYPOINTS = 256
"""Keypoints that measure held-out retrieval: chance is 0.004, the standard error of the share 0.03."""
CONVERGED_PX = 0.5
"""While learning, psi has converged if a step displaces no corner by more than this, px of the level."""
PATCHES, FLIGHT_PATCHES = 400, 256
"""Patches in a Gauss-Newton step at full resolution: for a single capture, and for a capture of a flight, where the
rig contributes to the estimate. Half as many are used while the steps are longer than CONVERGED_PX."""
_FINAL_OCTAVES = 0.3
"""Range of log2 of their scales: small patches localise better."""
_FINAL_CONVERGED_PX = 0.06
"""psi has converged if a step displaces no corner by more than this, px: steps shrink by more than half, so the
remaining displacement is smaller than the systematic error."""
_SYSTEMATIC_STD_PX = 0.035
"""Added in quadrature to the standard errors along x and y: errors that the covariance does not contain, such as a
bias between two modalities. Measured on synthetic flights."""
_PRESELECTION_PATCHES, _CANDIDATE_SHIFTS = 24, 64
"""Patches with which all shifts of a search are compared, and number of best shifts compared with all patches."""
_MAX_RATIO = 0.6
"""Maximum ratio of successive steps for the extrapolation of a geometric series: above it, errors of the ratio dominate
the sum."""
_MIN_GAIN_SIGMA = 3.0
"""Minimum decrease of the mean loss by a shift, in standard errors of the decrease."""


@dataclass(frozen=True)
class MovingBand:
    """One moving image I' of a level, and the side of the network that describes it."""

    net: Descriptor
    level: Level
    index: int
    """Of the moving image in the level."""
    side: int

    def visible_rows(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """Return the indices (M,) of the keypoints of I with patches inside both images."""
        return footprints_inside(self.level, self.index, keypoints, homography).nonzero()[:, 0]

    def patches(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """Return B(w(x; psi); I'), (N, C, 16, 16); the homography maps each sample position, not only the keypoint."""
        positions = patch_positions(keypoints)
        displacement = self.level.displacement(self.index, keypoints.xy)
        if displacement is not None:
            positions = positions + displacement[:, None, None]
        return self.level.moving[self.index].patches(transform(homography, positions))

    def describe(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """Return f(w(x; psi)) for keypoints x of I, (N, 256)."""
        f_prime: Tensor = self.net(self.patches(keypoints, homography), self.side)
        return f_prime


@dataclass(frozen=True)
class ReferencePatches:
    """Descriptors of patches of the reference, and their gradient."""

    keypoints: Keypoints
    f: Tensor
    """(N, 256) descriptors."""
    gradient: Tensor
    """(N, 256, 2) derivative of the descriptors with respect to a shift, per px."""

    def head(self, count: int) -> "ReferencePatches":
        """Return the first `count` patches."""
        rows = torch.arange(min(count, len(self.f)), device=self.f.device)
        return ReferencePatches(self.keypoints[rows], self.f[rows], self.gradient[rows])


def describe_fixed(net: Descriptor, level: Level, keypoints: Keypoints) -> Tensor:
    """Return f(x) for keypoints x of I, (N, 256)."""
    f: Tensor = net(level.fixed.patches(patch_positions(keypoints)), REFERENCE)
    return f


@torch.no_grad()
def describe_reference(net: Descriptor, level: Level, keypoints: Keypoints) -> ReferencePatches:
    """Compute the descriptors of keypoints of I and their gradient."""

    def describe(k: Keypoints) -> Tensor:
        return describe_fixed(net, level, k)

    difference_px = 0.75  # half the step of the central differences that approximate a descriptor's gradient
    return ReferencePatches(keypoints, describe(keypoints), shift_gradient(describe, keypoints, difference_px))


@dataclass(frozen=True)
class Solver:
    """Gauss-Newton optimisation of psi for one model family."""

    family: ModelFamily | None
    """None to select the family in each step, as `gauss_newton.solve` does."""

    @torch.no_grad()
    def step(self, band: MovingBand, homography: Tensor, reference_patches: ReferencePatches) -> Step:
        """Compute one Gauss-Newton step from H (3, 3), fixed to moving px.

        Raises NotEnoughTextureError if too few patches are inside both images.
        """
        rows = band.visible_rows(reference_patches.keypoints, homography)
        if len(rows) < MIN_KEYPOINTS:
            raise NotEnoughTextureError(len(rows), MIN_KEYPOINTS)
        p = reference_patches.keypoints[rows]
        residual = reference_patches.f[rows] - band.describe(p, homography)
        equations = PatchEquations.of(p, residual, reference_patches.gradient[rows], band.level.fixed.size_px)
        return solve(equations, self.family)

    def converge(self, band: MovingBand, start: Tensor, reference_patches: ReferencePatches) -> tuple[Tensor, Step]:
        """Take steps until no corner moves by more than `_FINAL_CONVERGED_PX`; return (homography, last step).

        Long steps use half of the patches. Steps with all patches shrink by a constant ratio, so every second one is
        extended by the sum of the geometric series (Aitken 1926). A step of infinite length is the last one and is
        not applied: the patches do not determine the mapping.
        """
        h, patches, previous_px = start, reference_patches.head(len(reference_patches.f) // 2), math.inf
        max_final_steps = 10  # maximum number of steps at full resolution
        for _ in range(max_final_steps):
            step = self.step(band, h, patches)
            if not math.isfinite(step.length_px):
                break
            ratio = min(step.length_px / previous_px, _MAX_RATIO)
            h = updated(h, step, 1 / (1 - ratio))
            if step.length_px < _FINAL_CONVERGED_PX and patches is reference_patches:
                break
            previous_px = step.length_px if patches is reference_patches and ratio == 0 else math.inf
            if step.length_px < CONVERGED_PX:
                patches = reference_patches
        return h, step


def updated(homography: Tensor, step: Step, factor: float = 1.0) -> Tensor:
    """Return H @ change, (3, 3) float32, with the change of psi, which is linear in it, scaled by a factor."""
    identity = torch.eye(3, dtype=step.change.dtype, device=step.change.device)
    return (to_float64(homography) @ (identity + factor * (step.change - identity))).to(homography)


@torch.no_grad()
def held_out_retrieval(band: MovingBand, homography: Tensor, keypoints: Keypoints, f: Tensor) -> tuple[float, float]:
    """Return the held-out retrieval of the keypoints visible in both images, and its value by chance.

    `f` (N, 256) are the descriptors of the keypoints in I.
    """
    rows = band.visible_rows(keypoints, homography)
    if len(rows) < MIN_KEYPOINTS:
        return 0.0, 1.0
    p = keypoints[rows]
    f_prime = band.describe(p, homography)
    return retrieval(f[rows], f_prime, far_apart(p)), 1 / len(rows)


@torch.no_grad()
def best_shift(band: MovingBand, homography: Tensor, keypoints: Keypoints, radius_px: float, step_px: float) -> Tensor:
    """Search the translation (2,) of the fixed side, up to `radius_px` long, with the smallest mean L0.

    Only patches inside both images count. Returns zeros if the decrease of L0 is less than _MIN_GAIN_SIGMA standard
    errors over the patches that are visible with and without the shift.
    """
    if len(keypoints) < MIN_KEYPOINTS:
        return homography.new_zeros(2)
    f = describe_fixed(band.net, band.level, keypoints)
    count = int(radius_px / step_px)
    offsets = torch.arange(-count, count + 1) * step_px
    shifts = torch.cartesian_prod(offsets, offsets).to(homography)
    shifts = shifts[shifts.norm(dim=1) <= radius_px]

    def losses_of(some: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the losses (S, count) of shifts (S, 2) with the first keypoints, and their means (S,), inf where too
        few patches are visible.
        """
        p = keypoints[torch.arange(min(count, len(keypoints)), device=homography.device)]
        shifts_per_batch = 16  # limits the memory of a search
        batches = torch.split(some, shifts_per_batch)
        losses = torch.cat([_shifted_losses(band, homography, p, f[: len(p)], batch) for batch in batches])
        enough = losses.isfinite().sum(dim=1) >= MIN_KEYPOINTS
        return losses, losses.nanmean(dim=1).masked_fill(~enough, float("inf"))

    _, means = losses_of(shifts, _PRESELECTION_PATCHES)
    candidates = shifts[means.argsort()[:_CANDIDATE_SHIFTS]]
    losses, means = losses_of(torch.cat([homography.new_zeros(1, 2), candidates]), len(keypoints))
    best = int(means.argmin())
    gain = losses[0] - losses[best]
    gain = gain[gain.isfinite()]
    if not bool(means[best].isfinite()) or len(gain) < MIN_KEYPOINTS:
        return homography.new_zeros(2)
    is_significant = float(gain.mean()) > _MIN_GAIN_SIGMA * float(gain.std()) / math.sqrt(len(gain))
    return candidates[best - 1] if is_significant and best > 0 else homography.new_zeros(2)


def _shifted_losses(band: MovingBand, homography: Tensor, keypoints: Keypoints, f: Tensor, shifts: Tensor) -> Tensor:
    """Return L0 (S, N) of each keypoint with each shift (S, 2) of the fixed side, NaN where its patch leaves I'."""
    count = len(shifts)
    xy = (keypoints.xy + shifts[:, None]).reshape(-1, 2)
    shifted = Keypoints(xy, keypoints.angle.repeat(count), keypoints.scale.repeat(count))
    losses = distance(f.repeat(count, 1), band.describe(shifted, homography))
    inside = footprints_inside_moving(band.level, band.index, shifted, homography)
    return losses.masked_fill(~inside, float("nan")).reshape(count, -1)


@torch.no_grad()
def refine(
    state: JointState, net: Descriptor, group: ImageGroup, *, update_psi: bool = True, patches: int = PATCHES
) -> list[JointResult[FixedImagePx] | Issue]:
    """Refine every psi of a capture at full resolution with theta frozen.

    Returns a result per moving image, or the issue that prevents one. A step uses up to `patches` patches. Without
    `update_psi`, psi is not changed and only its retrieval and standard errors are computed. Raises NoContrastError.
    """
    level = state.level(group, 1.0, range(len(group.moving)))
    h = [level.homography(matrix, b) for b, matrix in enumerate(group.mappings)]
    p, _ = state.sampler.draw(level, level.anywhere, h, patches, _FINAL_OCTAVES)
    test, _ = state.sampler.draw(level, level.held_out, h, TEST_KEYPOINTS, _FINAL_OCTAVES)
    if len(p) < MIN_KEYPOINTS:
        return [Issue(FEW_KEYPOINTS, len(p), MIN_KEYPOINTS)] * len(h)
    reference_patches = describe_reference(net, level, p)
    f_test = describe_fixed(net, level, test)
    solver = Solver(state.family)

    def result(band: MovingBand, start: Tensor) -> JointResult[FixedImagePx] | Issue:
        try:
            if update_psi:
                homography, step = solver.converge(band, start, reference_patches)
            else:
                homography, step = start, solver.step(band, start, reference_patches)
            matrix = level.full_matrix(homography, band.index)
        except NotEnoughTextureError as error:
            return Issue(FEW_KEYPOINTS, error.keypoints, error.minimum)
        except GeometryError:
            return Issue(NOT_INVERTIBLE)
        s = _SYSTEMATIC_STD_PX
        std = tuple((math.hypot(x, s), math.hypot(y, s)) for x, y in step.corner_std_xy_px)
        if not all(math.isfinite(x) for x in (step.length_px, *itertools.chain(*std))):
            return Issue(CORNERS_UNKNOWN)
        held_out, chance = held_out_retrieval(band, homography, test, f_test)
        random = step.corner_covariance_px2.cpu().numpy()
        covariance_px2 = random + s**2 * np.eye(8) if np.isfinite(random).all() else None
        of_step = step.family, step.length_px, std, covariance_px2
        return JointResult(matrix, math.nan, held_out, chance, 0, (1.0,), "fast", *of_step)

    return [
        Issue(RETRIEVAL, group.dropped[b], MIN_RETRIEVAL)
        if b in group.dropped
        else result(MovingBand(net, level, b, side), h[b])
        for b, side in enumerate(group.sides)
    ]
