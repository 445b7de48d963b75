"""One second-order step on psi: minimise sum_i w_i || f(x_i) - f(w(x_i; psi)) ||^2 (the paper's L0, squared).

A patch feels a small change of the homography as a shift of its centre, so the residual's Jacobian with respect to
psi is the descriptor's gradient with respect to a shift, (256, 2), times the shift's with respect to psi, (2, 8).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agalign.method.device import exact
from agalign.method.patches import ALPHA, FAMILY_PARAMETERS, Keypoints, homography_from_psi, transform
from agalign.values import geometry
from agalign.values.choices import ModelFamily

_REWEIGHTINGS = 4
_DAMPING = 1e-4
_CELL_PX = 48
"""Patches with centres in one cell of this side overlap: the covariance takes them as one observation."""
_RICH_ENOUGH_STD_PX = 0.5
"""A model family is rich enough while its least certain corner is known this well, px of the level: beyond it a simpler
family has the smaller error."""
_MAX_STEP_PX = 4.0
"""Longest step, px of the level: the descriptors are linear in a shift over about this distance."""
FAMILIES: tuple[ModelFamily, ...] = ("homography", "affine", "translation")


@dataclass(frozen=True)
class Step:
    """An update of the mapping, to be composed on the fixed side: H <- H @ change."""

    change: Tensor
    """(3, 3) homography on fixed pixels, float64."""
    length_px: float
    """Largest movement of a corner, px of the level."""
    corner_std_xy_px: tuple[tuple[float, float], ...]
    """Standard deviations along x and y of where each corner is mapped to, clockwise from the top left, px of the
    level."""
    family: ModelFamily
    corner_covariance_px2: Tensor
    """(8, 8) of (x, y) of the corners in turn, always of a homography, so that directions that the patches do not
    determine have a large variance even where a simpler family was taken."""

    @property
    def corner_std_px(self) -> float:
        """Root mean square distance of the least certain corner from where it is mapped to, px of the level."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)


def shift_gradient(describe: Callable[[Keypoints], Tensor], keypoints: Keypoints, half_width_px: float) -> Tensor:
    """Central differences of the descriptors over a shift of the keypoints, (N, 256, 2) per px."""
    e = half_width_px
    along_x = describe(keypoints.moved(e, 0)) - describe(keypoints.moved(-e, 0))
    along_y = describe(keypoints.moved(0, e)) - describe(keypoints.moved(0, -e))
    return torch.stack([along_x, along_y], dim=2) / (2 * e)


def shift_over_psi(xy: Tensor, width_px: int, height_px: int) -> Tensor:
    """Derivative of a warped position over psi at psi = 0, (N, 2, 8), float64.

    `geometry.over_corners` is the same derivative over the displacements of the corners, in numpy: a linear change of
    parameters apart. This one stays on the device of the descriptors.
    """
    x, y = exact(xy).unbind(dim=1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    along_x = [x, y, zero, zero, one * width_px, zero, -x * x / width_px, -x * y / height_px]
    along_y = [zero, zero, x, y, zero, one * height_px, -x * y / width_px, -y * y / height_px]
    return torch.stack([torch.stack(along_x, dim=1), torch.stack(along_y, dim=1)], dim=1) / ALPHA


@dataclass(frozen=True)
class PatchEquations:
    """The squared residual of each patch over a small shift s of its centre, to second order:

        energy - 2 pull.s + s.stiffness.s

    All tensors are float64.
    """

    xy: Tensor
    """(N, 2) centres, px."""
    pull: Tensor
    """(N, 2)"""
    stiffness: Tensor
    """(N, 2, 2)"""
    energy: Tensor
    """(N,)"""
    size_px: tuple[int, int]
    """(width, height) of the fixed image."""

    @classmethod
    def of(cls, keypoints: Keypoints, residual: Tensor, gradient: Tensor, size_px: tuple[int, int]) -> "PatchEquations":
        """`residual` is f(x) - f'(w(x)), (N, 256), `gradient` that of f over a shift of x, (N, 256, 2).

        The mean of the residuals over the patches is the constant difference of the two modalities: it is removed.
        """
        centred, g = exact(residual - residual.mean(dim=0)), exact(gradient)
        pull = torch.einsum("ndk,nd->nk", g, centred)
        stiffness = torch.einsum("ndk,ndl->nkl", g, g)
        return cls(exact(keypoints.xy), pull, stiffness, centred.square().sum(dim=1), size_px)

    @property
    def cell(self) -> Tensor:
        """(N,) index of the cell of the image that contains the centre of a patch."""
        column, row = (self.xy / _CELL_PX).floor().long().clamp_min(0).unbind(dim=1)
        return row * (self.size_px[0] // _CELL_PX + 2) + column


def solve(
    equations: PatchEquations, family: ModelFamily | None, *, rich_enough_std_px: float = _RICH_ENOUGH_STD_PX,
    max_step_px: float = _MAX_STEP_PX,
) -> Step:  # fmt: skip
    """The step that the patches agree on, cut to `max_step_px`.

    With `family` None the richest family is taken that gives the corners a standard error of at most
    `rich_enough_std_px`.
    """
    families = FAMILIES if family is None else (family,)
    step = richest = _solve_family(equations, families[0], max_step_px)
    for simpler in families[1:]:
        if step.corner_std_px <= rich_enough_std_px:
            break
        step = _solve_family(equations, simpler, max_step_px)
    return replace(step, corner_covariance_px2=richest.corner_covariance_px2)


def _solve_family(equations: PatchEquations, family: ModelFamily, max_step_px: float) -> Step:
    pull, stiffness, size_px = equations.pull, equations.stiffness, equations.size_px
    parameters = list(FAMILY_PARAMETERS[family])
    j = shift_over_psi(equations.xy, *size_px)[:, :, parameters]
    per_patch_normal = torch.einsum("nki,nkl,nlj->nij", j, stiffness, j)
    per_patch_pull = torch.einsum("nki,nk->ni", j, pull)
    delta = pull.new_zeros(len(parameters))
    for _ in range(_REWEIGHTINGS):
        shift = torch.einsum("nki,i->nk", j, delta)
        squared = (
            equations.energy - 2 * (shift * pull).sum(dim=1) + torch.einsum("nk,nkl,nl->n", shift, stiffness, shift)
        )
        # Cauchy weights, as `values.robust.cauchy_weights`, of residuals that are known by their squares.
        weight = 1 / (1 + squared.clamp_min(0) / squared.median().clamp_min(1e-12))
        normal = torch.einsum("n,nij->ij", weight, per_patch_normal)
        normal = normal + torch.diag(_DAMPING * normal.diagonal() + 1e-12)
        delta = torch.linalg.solve(normal, torch.einsum("n,ni->i", weight, per_patch_pull))
    score = weight[:, None] * (per_patch_pull - torch.einsum("nij,j->ni", per_patch_normal, delta))
    covariances = _covariances(normal, score, equations.cell)

    psi = pull.new_zeros(8)
    psi[parameters] = delta
    corner_points = pull.new_tensor(geometry.corners(*size_px))
    corner_jacobian = shift_over_psi(corner_points, *size_px)[:, :, parameters]
    over_corners = corner_jacobian.reshape(8, -1)
    of_corners = max((over_corners @ c @ over_corners.T for c in covariances), key=lambda c: float(c.trace()))
    std_xy = tuple((float(x), float(y)) for x, y in of_corners.diagonal().clamp_min(0).sqrt().reshape(4, 2))

    change = homography_from_psi(psi, *size_px)
    length_px = float((transform(change, corner_points) - corner_points).norm(dim=1).max())
    if not math.isfinite(length_px):
        change, length_px = torch.eye(3, dtype=torch.float64, device=psi.device), math.inf
    elif length_px > max_step_px:
        change = homography_from_psi(psi * (max_step_px / length_px), *size_px)
    return Step(change, length_px, std_xy, family, of_corners)


def _covariances(normal: Tensor, score: Tensor, cell: Tensor) -> Tensor:
    """(2, P, P) sandwich covariances: the scatter of the patches sets the uncertainty, not a noise model.

    Patches that overlap share pixels, so the second is clustered by cells of the image (Liang & Zeger 1986); where
    there are few cells the first, by single patches, may be larger. `score` (N, P) is the gradient of each patch.
    """
    of_cells = score.new_zeros((int(cell.max()) + 1, score.shape[1])).index_add_(0, cell, score)
    inverse = torch.linalg.inv(normal)
    return torch.stack([inverse @ (s.T @ s) @ inverse for s in (score, of_cells)])
