"""Psi with theta frozen: inverse-compositional Gauss-Newton on L0 squared.

The descriptors of the reference and their gradient over a shift are computed once and serve every moving band and
every step (Baker & Matthews 2004, Sec. 3.2): a step costs one pass of the moving band's patches.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agalign.errors import GeometryError, NotEnoughTextureError
from agalign.method.descriptor import REFERENCE, Descriptor, distance, retrieval
from agalign.method.device import exact
from agalign.method.gauss_newton import PatchEquations, Step, shift_gradient, solve
from agalign.method.levels import Level, footprints_inside, footprints_inside_moving
from agalign.method.patches import Keypoints, far_apart, patch_positions, transform
from agalign.method.state import ImageGroup, JointState
from agalign.values.alignment import MIN_RETRIEVAL, JointResult
from agalign.values.choices import ModelFamily
from agalign.values.issues import CORNERS_UNKNOWN, FEW_KEYPOINTS, NOT_INVERTIBLE, RETRIEVAL, Issue
from agalign.values.pixel_units import FixedImagePx

MIN_KEYPOINTS = 16
TEST_KEYPOINTS = 256
"""Held-out keypoints among which retrieval is measured: chance is then 0.004, the standard error of a share 0.03."""
REST_PX = 0.5
"""psi is at rest when a step moves no corner by more than this, px of the level."""
PATCHES, FLIGHT_PATCHES = 400, 256
"""Patches in a Gauss-Newton step at full resolution: of a capture alone, and of one of a flight, where the rig takes
part in the estimate. Half as many serve while psi is not at rest."""
_FINAL_OCTAVES = 0.3
"""Range of their scales: small patches place themselves more exactly."""
_FINAL_STEPS = 10
_FINAL_REST_PX = 0.06
"""psi has converged when a step moves no corner by more than this, px: steps shrink by more than half, so that less
than the systematic error remains."""
_SYSTEMATIC_STD_PX = 0.035
"""Added in quadrature to the standard deviations along x and y: what the curvature cannot see, such as a bias between
two modalities. Measured on synthetic flights."""
_DIFFERENCE_PX = 0.75
"""Half width of the central differences that give a descriptor's gradient."""
_FIRST_PATCHES, _LIKELY_SHIFTS, _AT_ONCE = 24, 64, 16
_MAX_RATIO = 0.6
"""Largest ratio of a step to the one before at which the steps are taken as a geometric series: above it the sum would
be dominated by the error of the ratio."""
_MIN_GAIN_SIGMA = 3.0
"""Standard errors by which the loss of a shift must be less than without it."""


@dataclass(frozen=True)
class MovingBand:
    """One moving image I' of a level, as its side of the network describes it."""

    net: Descriptor
    level: Level
    index: int
    """Which of the level's moving images."""
    side: int

    def sees(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """(M,) rows of the keypoints of I with patches in both images."""
        return footprints_inside(self.level, self.index, keypoints, homography).nonzero()[:, 0]

    def patches(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """B(w(x; psi); I'), (N, C, 16, 16): every sample goes through the homography, not only the keypoint's frame."""
        positions = patch_positions(keypoints)
        displacement = self.level.displacement(self.index, keypoints.xy)
        if displacement is not None:
            positions = positions + displacement[:, None, None]
        return self.level.moving[self.index].patches(transform(homography, positions))

    def describe(self, keypoints: Keypoints, homography: Tensor) -> Tensor:
        """f(w(x; psi)) for keypoints x of I, (N, 256)."""
        out: Tensor = self.net(self.patches(keypoints, homography), self.side)
        return out


@dataclass(frozen=True)
class ReferencePatches:
    """Patches of the reference as the network describes them."""

    keypoints: Keypoints
    f: Tensor
    """(N, 256) descriptors."""
    gradient: Tensor
    """(N, 256, 2) their derivative over a shift, per px."""

    def head(self, count: int) -> "ReferencePatches":
        """The first `count` of them."""
        rows = torch.arange(min(count, len(self.f)), device=self.f.device)
        return ReferencePatches(self.keypoints[rows], self.f[rows], self.gradient[rows])


def describe_fixed(net: Descriptor, level: Level, keypoints: Keypoints) -> Tensor:
    """f(x) for keypoints of I, (N, 256)."""
    out: Tensor = net(level.fixed.patches(patch_positions(keypoints)), REFERENCE)
    return out


@torch.no_grad()
def describe_reference(net: Descriptor, level: Level, keypoints: Keypoints) -> ReferencePatches:
    """Descriptors and gradient of the reference's patches."""

    def describe(k: Keypoints) -> Tensor:
        return describe_fixed(net, level, k)

    return ReferencePatches(keypoints, describe(keypoints), shift_gradient(describe, keypoints, _DIFFERENCE_PX))


@dataclass(frozen=True)
class Solver:
    """How psi is moved: by which family of mappings (None for as rich a one as the patches allow)."""

    family: ModelFamily | None

    @torch.no_grad()
    def step(self, band: MovingBand, homography: Tensor, reference_patches: ReferencePatches) -> Step:
        """One Gauss-Newton step. Raises NotEnoughTextureError where too few patches lie in both images."""
        rows = band.sees(reference_patches.keypoints, homography)
        if len(rows) < MIN_KEYPOINTS:
            raise NotEnoughTextureError(len(rows), MIN_KEYPOINTS)
        p = reference_patches.keypoints[rows]
        residual = reference_patches.f[rows] - band.describe(p, homography)
        equations = PatchEquations.of(p, residual, reference_patches.gradient[rows], band.level.fixed.size_px)
        return solve(equations, self.family)

    def converge(self, band: MovingBand, start: Tensor, reference_patches: ReferencePatches) -> tuple[Tensor, Step]:
        """Steps from `start` until one moves no corner by more than `_FINAL_REST_PX`; returns (homography, last step).

        While the steps are long, some of the patches are enough. Steps of all patches become shorter by a constant
        ratio, so every second one is lengthened by what the steps to come would add (Aitken 1926). A step of infinite
        length moves nothing and is the last: the patches do not determine where the corners are mapped to.
        """
        h, some, before = start, reference_patches.head(len(reference_patches.f) // 2), math.inf
        for _ in range(_FINAL_STEPS):
            step = self.step(band, h, some)
            if not math.isfinite(step.length_px):
                break
            ratio = min(step.length_px / before, _MAX_RATIO)
            h = moved(h, step, 1 / (1 - ratio))
            if step.length_px < _FINAL_REST_PX and some is reference_patches:
                break
            before = step.length_px if some is reference_patches and ratio == 0 else math.inf
            if step.length_px < REST_PX:
                some = reference_patches
        return h, step


def moved(homography: Tensor, step: Step, times: float = 1.0) -> Tensor:
    """H <- H @ change, (3, 3) float32; psi, in which the change is linear, scaled by a factor."""
    unmoved = torch.eye(3, dtype=step.change.dtype, device=step.change.device)
    return (exact(homography) @ (unmoved + times * (step.change - unmoved))).to(homography)


@torch.no_grad()
def held_out_retrieval(band: MovingBand, homography: Tensor, keypoints: Keypoints, f: Tensor) -> tuple[float, float]:
    """(share of the keypoints visible in both images with their own as nearest descriptor in I', chance).

    `f` (N, 256) are the descriptors of the reference.
    """
    rows = band.sees(keypoints, homography)
    if len(rows) < MIN_KEYPOINTS:
        return 0.0, 1.0
    p = keypoints[rows]
    f_prime = band.describe(p, homography)
    return retrieval(f[rows], f_prime, far_apart(p)), 1 / len(rows)


@torch.no_grad()
def best_shift(band: MovingBand, homography: Tensor, keypoints: Keypoints, reach_px: float, step_px: float) -> Tensor:
    """The translation (2,) of the fixed side, up to `reach_px` long, at which the mean L0 of the patches that lie in
    both images is least; none where that is not plainly less than without, for the patches that both have.
    """
    if len(keypoints) < MIN_KEYPOINTS:
        return homography.new_zeros(2)
    f = describe_fixed(band.net, band.level, keypoints)
    count = int(reach_px / step_px)
    along = torch.arange(-count, count + 1) * step_px
    shifts = torch.cartesian_prod(along, along).to(homography)
    lengths = shifts.norm(dim=1)
    shifts = shifts[lengths <= reach_px]

    def table_of(some: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """(losses (shifts, count) of the first keypoints, nan where a patch leaves an image; their means)."""
        p = keypoints[torch.arange(min(count, len(keypoints)), device=homography.device)]
        table = torch.cat([_losses_moved(band, homography, p, f[: len(p)], s) for s in torch.split(some, _AT_ONCE)])
        enough = table.isfinite().sum(dim=1) >= MIN_KEYPOINTS
        return table, table.nanmean(dim=1).masked_fill(~enough, float("inf"))

    # Some of the patches select the shifts that are tried with all of them.
    _, rough = table_of(shifts, _FIRST_PATCHES)
    likely = shifts[rough.argsort()[:_LIKELY_SHIFTS]]
    table, means = table_of(torch.cat([homography.new_zeros(1, 2), likely]), len(keypoints))
    best = int(means.argmin())
    gain = table[0] - table[best]
    gain = gain[gain.isfinite()]
    if not bool(means[best].isfinite()) or len(gain) < MIN_KEYPOINTS:
        return homography.new_zeros(2)
    plain = float(gain.mean()) > _MIN_GAIN_SIGMA * float(gain.std()) / math.sqrt(len(gain))
    return likely[best - 1] if plain and best > 0 else homography.new_zeros(2)


def _losses_moved(band: MovingBand, homography: Tensor, keypoints: Keypoints, f: Tensor, shifts: Tensor) -> Tensor:
    """L0 of each keypoint under each shift (K, 2) of the fixed side, (K, N), nan where its patch leaves an image."""
    count = len(shifts)
    xy = (keypoints.xy + shifts[:, None]).reshape(-1, 2)
    shifted = Keypoints(xy, keypoints.angle.repeat(count), keypoints.scale.repeat(count))
    apart = distance(f.repeat(count, 1), band.describe(shifted, homography))
    inside = footprints_inside_moving(band.level, band.index, shifted, homography)
    return apart.masked_fill(~inside, float("nan")).reshape(count, -1)


@torch.no_grad()
def refine(
    state: JointState, net: Descriptor, group: ImageGroup, *, move: bool = True, patches: int = PATCHES
) -> list[JointResult[FixedImagePx] | Issue]:
    """Refine every psi of a capture at full resolution with theta frozen; an issue is why a pair has no result.

    A step uses up to `patches`. Without `move` psi stays as it is: only its retrieval and uncertainty are measured.
    Raises NoContrastError.
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
            if move:
                homography, step = solver.converge(band, start, reference_patches)
            else:
                homography, step = start, solver.step(band, start, reference_patches)
            matrix = level.full_matrix(homography, band.index)
        except NotEnoughTextureError as error:
            return Issue(FEW_KEYPOINTS, error.keypoints, error.minimum)
        except GeometryError:
            return Issue(NOT_INVERTIBLE)
        std = _complete_std(step)
        if not all(math.isfinite(x) for x in (step.length_px, *itertools.chain(*std))):
            return Issue(CORNERS_UNKNOWN)
        held_out, chance = held_out_retrieval(band, homography, test, f_test)
        return JointResult(
            matrix, math.nan, held_out, chance, 0, (1.0,), "fast", step.family, step.length_px, std,
            _complete_covariance(step),
        )  # fmt: skip

    return [
        Issue(RETRIEVAL, group.dropped[b], MIN_RETRIEVAL)
        if b in group.dropped
        else result(MovingBand(net, level, b, side), h[b])
        for b, side in enumerate(group.sides)
    ]


def _complete_std(step: Step) -> tuple[tuple[float, float], ...]:
    """Random and systematic parts together."""
    s = _SYSTEMATIC_STD_PX
    return tuple((math.hypot(x, s), math.hypot(y, s)) for x, y in step.corner_std_xy_px)


def _complete_covariance(step: Step) -> NDArray[np.float64] | None:
    """The same of all corners together; None where it is not finite."""
    random = step.corner_covariance_px2.cpu().numpy()
    return random + _SYSTEMATIC_STD_PX**2 * np.eye(8) if np.isfinite(random).all() else None
