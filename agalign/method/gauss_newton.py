"""One Gauss-Newton step on psi: minimise sum_i w_i || f(x_i) - f(w(x_i; psi)) ||^2 (the paper's L0, squared).

A small change of the homography acts on a patch as a shift of its centre. The residual's Jacobian with respect to psi
is therefore the descriptor's gradient with respect to a shift, (256, 2), times the shift's Jacobian with respect to
psi, (2, 8).
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agalign.method.device import to_float64
from agalign.method.patches import ALPHA, FAMILY_PARAMETERS, homography_from_psi, transform
from agalign.values import geometry
from agalign.values.choices import ModelFamily

_DAMPING = 1e-4
"""Levenberg-Marquardt damping, as a share of the diagonal of the normal equations."""
_CELL_PX = 48
"""Patches with centres in one cell of this side overlap: the covariance treats them as one cluster."""
_MAX_CORNER_STD_PX = 0.5
"""Above this standard error of the least certain corner, px of the level, a simpler family has a smaller error."""
_MAX_STEP_PX = 4.0
"""Maximum step before its extrapolation, px of the level: the descriptors are approximately linear in a shift of up to
this length."""


@dataclass(frozen=True)
class Step:
    """An update of a mapping on the fixed side: H <- H @ change."""

    change: Tensor
    """(3, 3) homography on fixed pixels, float64."""
    length_px: float
    """Largest displacement of a corner before the step is cut, px of the level."""
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


def solve(
    xy: Tensor, residual: Tensor, shift_gradient: Tensor, size_px: tuple[int, int], family: ModelFamily | None
) -> Step:
    """Solve for the step by iteratively reweighted least squares; it is cut to _MAX_STEP_PX.

    `xy` (N, 2) px are the centres of patches in the fixed image (width, height), `residual` (N, 256) is f(x) - f'(w(x))
    and `shift_gradient` (N, 256, 2) the derivative of f with respect to a shift, per px. With `family` None, select the
    first of FAMILY_PARAMETERS with a standard error of the corners of at most _MAX_CORNER_STD_PX, else the last.
    """
    # The mean residual of all patches is the constant difference between the modalities.
    centred, g = to_float64(residual - residual.mean(dim=0)), to_float64(shift_gradient)
    gradient, hessian = torch.einsum("ndk,nd->nk", g, centred), torch.einsum("ndk,ndl->nkl", g, g)
    equations = to_float64(xy), gradient, hessian, centred.square().sum(dim=1), size_px
    families = tuple(FAMILY_PARAMETERS) if family is None else (family,)
    step = first = _solve_family(*equations, families[0])
    for simpler in families[1:]:
        if step.corner_std_px <= _MAX_CORNER_STD_PX:
            break
        step = _solve_family(*equations, simpler)
    return replace(step, corner_covariance_px2=first.corner_covariance_px2)


def _solve_family(
    xy: Tensor, gradient: Tensor, hessian: Tensor, energy: Tensor, size_px: tuple[int, int], family: ModelFamily
) -> Step:
    """Solve for the parameters of one family. All tensors are float64.

    The squared residual of each patch is a quadratic function of a small shift s of its centre `xy` (N, 2) px:

        energy - 2 gradient.s + s.hessian.s

    `gradient` (N, 2) is minus half its first derivative, `hessian` (N, 2, 2) half the second one, `energy` is (N,).
    """
    parameters = list(FAMILY_PARAMETERS[family])
    j = shift_over_psi(xy, *size_px)[:, :, parameters]
    patch_normals = torch.einsum("nki,nkl,nlj->nij", j, hessian, j)
    patch_gradients = torch.einsum("nki,nk->ni", j, gradient)
    delta = gradient.new_zeros(len(parameters))
    reweightings = 4  # iterations of reweighted least squares
    for _ in range(reweightings):
        shift = torch.einsum("nki,i->nk", j, delta)
        squared = energy - 2 * (shift * gradient).sum(dim=1) + torch.einsum("nk,nkl,nl->n", shift, hessian, shift)
        # Cauchy weights, as in `values.least_squares.cauchy_weights`, from squared residuals.
        weight = 1 / (1 + squared.clamp_min(0) / squared.median().clamp_min(1e-12))
        normal = torch.einsum("n,nij->ij", weight, patch_normals)
        normal = normal + torch.diag(_DAMPING * normal.diagonal() + 1e-12)
        delta = torch.linalg.solve(normal, torch.einsum("n,ni->i", weight, patch_gradients))
    score = weight[:, None] * (patch_gradients - torch.einsum("nij,j->ni", patch_normals, delta))
    column, row = (xy / _CELL_PX).floor().long().clamp_min(0).unbind(dim=1)
    covariances = _covariances(normal, score, row * (size_px[0] // _CELL_PX + 2) + column)

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
    elif length_px > _MAX_STEP_PX:
        change = homography_from_psi(psi * (_MAX_STEP_PX / length_px), *size_px)
    return Step(change, length_px, std_xy, family, corner_covariance)


def _covariances(normal: Tensor, score: Tensor, cell: Tensor) -> Tensor:
    """Return two sandwich covariances of the parameters, (2, P, P), from the scores (N, P) of the patches.

    The first treats patches as independent. The second is clustered by the cell (N,) of the image (Liang & Zeger 1986),
    because overlapping patches share pixels; with few cells it may underestimate the variance. Each patch has two
    coordinates, of which the parameters take their number (MacKinnon & White 1985, HC1).
    """
    patches, parameters = score.shape
    of_few = patches / max(patches - parameters / 2, 1.0)
    of_cells = score.new_zeros((int(cell.max()) + 1, score.shape[1])).index_add_(0, cell, score)
    inverse = torch.linalg.inv(normal)
    return of_few * torch.stack([inverse @ (s.T @ s) @ inverse for s in (score, of_cells)])
