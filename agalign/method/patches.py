"""Keypoints, their warp under a homography, and the patches around them (paper, Sec. 5.1 to 5.3).

Positions are in pixels of the given image: x right, y down, (0, 0) is the centre of the top-left pixel.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from agalign.method.descriptor import PATCH_PX
from agalign.values.choices import ModelFamily

ALPHA = 64.0
"""Scale of the homography's parameters (paper, Sec. 5.1)."""

FOOTPRINT_PX = (PATCH_PX - 1) / 2 * math.sqrt(2.0)
"""Distance from a keypoint to the farthest sample of its patch at 1 px between samples."""

_MIN_NEGATIVE_PX = 8.0
"""Recipe fast: patches of keypoints closer than half a patch are similar, so they are not negatives of each other."""

FAMILY_PARAMETERS: dict[ModelFamily, tuple[int, ...]] = {
    "homography": (0, 1, 2, 3, 4, 5, 6, 7),
    "affine": (0, 1, 2, 3, 4, 5),
    "translation": (4, 5),
}
"""Indices of the elements of psi that are free parameters of a model family, in the order of preference."""


_ROWS, _COLUMNS = [0, 0, 1, 1, 0, 1, 2, 2], [0, 1, 0, 1, 2, 2, 0, 1]
"""Places of the elements of psi in H - 1."""


def homography_from_psi(psi: Tensor, width_px: int, height_px: int) -> Tensor:
    """Return H (3, 3) of psi (8,) = alpha [h11-1, h12, h21, h22-1, h13/w, h23/h, h31 w, h32 h] (paper, Sec. 5.1)."""
    factor, divisor = _size_factors(psi, width_px, height_px)
    result = torch.eye(3, dtype=psi.dtype, device=psi.device)
    result[_ROWS, _COLUMNS] += psi / ALPHA * factor / divisor
    return result


def psi_from_homography(homography: Tensor, width_px: int, height_px: int) -> Tensor:
    """Return psi (8,) of H (3, 3); the inverse of `homography_from_psi`."""
    factor, divisor = _size_factors(homography, width_px, height_px)
    identity = torch.eye(3, dtype=homography.dtype, device=homography.device)
    return ALPHA * ((homography / homography[2, 2] - identity)[_ROWS, _COLUMNS] / factor * divisor)


def _size_factors(like: Tensor, width_px: int, height_px: int) -> tuple[Tensor, Tensor]:
    """Return the factors and divisors (8,) of psi in px, of the type and on the device of another tensor."""
    return like.new_tensor([1, 1, 1, 1, width_px, height_px, 1, 1]), like.new_tensor([1] * 6 + [width_px, height_px])


def transform(homography: Tensor, points: Tensor) -> Tensor:
    """Map points (..., 2) by H (3, 3)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


@dataclass(frozen=True)
class Keypoints:
    """Oriented, scaled positions in one image."""

    xy: Tensor
    """(N, 2) px."""
    angle: Tensor
    """(N,) radians from the x axis towards the y axis."""
    scale: Tensor
    """(N,) px between neighbouring samples of the patch."""

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, rows: Tensor) -> "Keypoints":
        return Keypoints(self.xy[rows], self.angle[rows], self.scale[rows])

    def to(self, device: torch.device) -> "Keypoints":
        """Return the keypoints on a device."""
        return Keypoints(self.xy.to(device), self.angle.to(device), self.scale.to(device))

    def moved(self, dx_px: float, dy_px: float) -> "Keypoints":
        """Return the keypoints shifted by (dx_px, dy_px)."""
        return Keypoints(self.xy + self.xy.new_tensor([dx_px, dy_px]), self.angle, self.scale)


def warp_keypoints(keypoints: Keypoints, homography: Tensor) -> Keypoints:
    """Map N keypoints of the fixed image to the moving image (the paper's w_k) by H (3, 3), fixed to moving px.

    v = s (cos phi, sin phi); v' = [h11 v0 + h12 v1, h21 v0 + h22 v1] / (h31 x + h32 y + 1);
    phi' = atan2(v1', v0'), s' = |v'|.
    """
    h = homography / homography[2, 2]
    v = keypoints.scale[:, None] * torch.stack([keypoints.angle.cos(), keypoints.angle.sin()], dim=1)
    denominator = keypoints.xy @ h[2, :2] + 1
    v_prime = (v @ h[:2, :2].T) / denominator[:, None]
    return Keypoints(transform(h, keypoints.xy), torch.atan2(v_prime[:, 1], v_prime[:, 0]), v_prime.norm(dim=1))


def patch_positions(keypoints: Keypoints, side: int = PATCH_PX) -> Tensor:
    """Return the sample positions of each keypoint's patch, (N, side, side, 2) px (paper, Eq. 6), centred on it.

    The patch has the same extent for every `side`; only the number of samples differs.
    """
    offset = torch.arange(side, dtype=keypoints.xy.dtype, device=keypoints.xy.device) - (side - 1) / 2
    offset = offset * (PATCH_PX / side)
    v, u = torch.meshgrid(offset, offset, indexing="ij")
    cos = (keypoints.angle.cos() * keypoints.scale)[:, None, None]
    sin = (keypoints.angle.sin() * keypoints.scale)[:, None, None]
    x = keypoints.xy[:, 0, None, None] + cos * u - sin * v
    y = keypoints.xy[:, 1, None, None] + sin * u + cos * v
    return torch.stack([x, y], dim=-1)


def bilinear(image: Tensor, positions: Tensor) -> Tensor:
    """Sample an image (C, H, W) at positions (N, n, n, 2) px -> (N, C, n, n) (B(p; I) of the paper, Eq. 6).

    Positions outside have the value of the nearest border pixel.
    """
    height, width = image.shape[-2:]
    count, rows, columns, _ = positions.shape
    last_px = positions.new_tensor([width - 1, height - 1])
    grid = (2 * positions / last_px - 1).reshape(1, count * rows, columns, 2)
    sampled = functional.grid_sample(image[None], grid, padding_mode="border", align_corners=True)
    return sampled[0].reshape(len(image), count, rows, columns).transpose(0, 1)


def footprint_radius(scale: Tensor) -> Tensor:
    """Return the distances (N,), px, from keypoints of scales (N,) to the farthest samples of their patches."""
    return scale * FOOTPRINT_PX


def far_apart(keypoints: Keypoints) -> Tensor:
    """Return (N, N) True where two keypoints are far apart, so that they may be negatives, and on the diagonal."""
    is_far = torch.cdist(keypoints.xy, keypoints.xy) >= _MIN_NEGATIVE_PX
    return is_far.fill_diagonal_(True)
