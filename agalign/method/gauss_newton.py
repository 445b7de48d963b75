"""One Gauss-Newton step on psi: minimise sum_i w_i || f(x_i) - f(w(x_i; psi)) ||^2 (the paper's L0, squared).

A small change of the homography acts on a patch as a shift of its centre. The residual's Jacobian with respect to psi
is therefore the descriptor's gradient with respect to a shift, (256, 2), times the shift's Jacobian with respect to
psi, (2, 8).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agalign.method.device import to_float64
from agalign.method.patches import ALPHA, FAMILY_PARAMETERS, Keypoints, homography_from_psi, transform
from agalign.values import geometry
from agalign.values.choices import ModelFamily

_DAMPING = 1e-4
"""Levenberg-Marquardt damping, as a share of the diagonal of the normal equations."""
_CELL_PX = 48
"""Patches with centres in one cell of this side overlap: the covariance treats them as one cluster."""
_MAX_CORNER_STD_PX = 0.5
"""Above this standard error of the least certain corner, px of the level, a simpler family has a smaller error."""
_MAX_STEP_PX = 4.0
"""Maximum step, px of the level: the descriptors are approximately linear in a shift of up to this length."""


@dataclass(frozen=True)
class Step:
    """An update of a mapping on the fixed side: H <- H @ change."""

    change: Tensor
    """(3, 3) homography on fixed pixels, float64."""
    length_px: float
    """Largest displacement of a corner, px of the level."""
    corner_std_xy_px: tuple[tuple[float, float], ...]
    """Standard errors (x, y) of the mapped corners, clockwise from the top left, px of the level."""
    family: ModelFamily
    corner_covariance_px2: Tensor
    """(8, 8) covariance of (x, y) of the mapped corners in turn, px of the level squared. It is computed for a
    homography even if `family` is simpler, so that directions without texture have a large variance."""

    @property
    def corner_std_px(self) -> float:
        """Standard error (radial) of the least certain corner, px of the level."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)


def shift_gradient(describe: Callable[[Keypoints], Tensor], keypoints: Keypoints, half_width_px: float) -> Tensor:
    """Return central differences of the descriptors with respect to a shift of the keypoints, (N, 256, 2) per px."""
    e = half_width_px
    along_x = describe(keypoints.moved(e, 0)) - describe(keypoints.moved(-e, 0))
    along_y = describe(keypoints.moved(0, e)) - describe(keypoints.moved(0, -e))
    return torch.stack([along_x, along_y], dim=2) / (2 * e)


def shift_over_psi(xy: Tensor, width_px: int, height_px: int) -> Tensor:
    """Return the Jacobian of warped positions with respect to psi at psi = 0, (N, 2) -> (N, 2, 8) float64.

    `geometry.over_corners` is the Jacobian with respect to the displacements of the corners, in numpy. This function
    runs on the device of the descriptors.
    """
    x, y = to_float64(xy).unbind(dim=1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    along_x = [x, y, zero, zero, one * width_px, zero, -x * x / width_px, -x * y / height_px]
    along_y = [zero, zero, x, y, zero, one * height_px, -x * y / width_px, -y * y / height_px]
    return torch.stack([torch.stack(along_x, dim=1), torch.stack(along_y, dim=1)], dim=1) / ALPHA


@dataclass(frozen=True)
class PatchEquations:
    """The squared residual of each patch as a quadratic function of a small shift s of its centre:

        energy - 2 gradient.s + s.hessian.s

    `gradient` is minus half the first derivative, `hessian` half the second one. All tensors are float64.
    """

    xy: Tensor
    """(N, 2) centres, px."""
    gradient: Tensor
    """(N, 2) per px."""
    hessian: Tensor
    """(N, 2, 2) per px squared."""
    energy: Tensor
    """(N,) squared residual at s = 0."""
    size_px: tuple[int, int]
    """(width, height) of the fixed image."""

    @classmethod
    def of(
        cls, keypoints: Keypoints, residual: Tensor, shift_gradient: Tensor, size_px: tuple[int, int]
    ) -> "PatchEquations":
        """Build the equations from residuals f(x) - f'(w(x)), (N, 256), and the shift gradient of f, (N, 256, 2).

        The mean residual of all patches is removed: it is the constant difference between the modalities.
        """
        centred, g = to_float64(residual - residual.mean(dim=0)), to_float64(shift_gradient)
        gradient = torch.einsum("ndk,nd->nk", g, centred)
        hessian = torch.einsum("ndk,ndl->nkl", g, g)
        return cls(to_float64(keypoints.xy), gradient, hessian, centred.square().sum(dim=1), size_px)

    @property
    def cell(self) -> Tensor:
        """(N,) index of the image cell that contains the centre of each patch."""
        column, row = (self.xy / _CELL_PX).floor().long().clamp_min(0).unbind(dim=1)
        return row * (self.size_px[0] // _CELL_PX + 2) + column


def solve(
    equations: PatchEquations,
    family: ModelFamily | None,
    *,
    max_corner_std_px: float = _MAX_CORNER_STD_PX,
    max_step_px: float = _MAX_STEP_PX,
) -> Step:
    """Solve for the step by iteratively reweighted least squares; it is cut to `max_step_px`.

    With `family` None, select the first of FAMILY_PARAMETERS with a standard error of the corners of at most
    `max_corner_std_px`, else the last.
    """
    families = tuple(FAMILY_PARAMETERS) if family is None else (family,)
    step = first = _solve_family(equations, families[0], max_step_px)
    for simpler in families[1:]:
        if step.corner_std_px <= max_corner_std_px:
            break
        step = _solve_family(equations, simpler, max_step_px)
    return replace(step, corner_covariance_px2=first.corner_covariance_px2)


def _solve_family(equations: PatchEquations, family: ModelFamily, max_step_px: float) -> Step:
    gradient, hessian, size_px = equations.gradient, equations.hessian, equations.size_px
    parameters = list(FAMILY_PARAMETERS[family])
    j = shift_over_psi(equations.xy, *size_px)[:, :, parameters]
    patch_normals = torch.einsum("nki,nkl,nlj->nij", j, hessian, j)
    patch_gradients = torch.einsum("nki,nk->ni", j, gradient)
    delta = gradient.new_zeros(len(parameters))
    reweightings = 4  # iterations of reweighted least squares
    for _ in range(reweightings):
        shift = torch.einsum("nki,i->nk", j, delta)
        squared = (
            equations.energy - 2 * (shift * gradient).sum(dim=1) + torch.einsum("nk,nkl,nl->n", shift, hessian, shift)
        )
        # Cauchy weights, as in `values.least_squares.cauchy_weights`, from squared residuals.
        weight = 1 / (1 + squared.clamp_min(0) / squared.median().clamp_min(1e-12))
        normal = torch.einsum("n,nij->ij", weight, patch_normals)
        normal = normal + torch.diag(_DAMPING * normal.diagonal() + 1e-12)
        delta = torch.linalg.solve(normal, torch.einsum("n,ni->i", weight, patch_gradients))
    score = weight[:, None] * (patch_gradients - torch.einsum("nij,j->ni", patch_normals, delta))
    covariances = _covariances(normal, score, equations.cell)

    psi = gradient.new_zeros(8)
    psi[parameters] = delta
    corners = gradient.new_tensor(geometry.corners(*size_px))
    corner_jacobian = shift_over_psi(corners, *size_px)[:, :, parameters].reshape(8, -1)
    corner_covariance = max(
        (corner_jacobian @ c @ corner_jacobian.T for c in covariances), key=lambda c: float(c.trace())
    )
    std_xy = tuple((float(x), float(y)) for x, y in corner_covariance.diagonal().clamp_min(0).sqrt().reshape(4, 2))

    change = homography_from_psi(psi, *size_px)
    length_px = float((transform(change, corners) - corners).norm(dim=1).max())
    if not math.isfinite(length_px):
        change, length_px = torch.eye(3, dtype=torch.float64, device=psi.device), math.inf
    elif length_px > max_step_px:
        change = homography_from_psi(psi * (max_step_px / length_px), *size_px)
    return Step(change, length_px, std_xy, family, corner_covariance)


def _covariances(normal: Tensor, score: Tensor, cell: Tensor) -> Tensor:
    """Return two sandwich covariances of the parameters, (2, P, P), from the scores (N, P) of the patches.

    The first treats patches as independent. The second is clustered by cells of the image (Liang & Zeger 1986),
    because overlapping patches share pixels; with few cells it may underestimate the variance.
    """
    of_cells = score.new_zeros((int(cell.max()) + 1, score.shape[1])).index_add_(0, cell, score)
    inverse = torch.linalg.inv(normal)
    return torch.stack([inverse @ (s.T @ s) @ inverse for s in (score, of_cells)])
