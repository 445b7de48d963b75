"""A pair of images at one resolution, and the keypoints that may be drawn from it."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agalign.descriptor import PATCH_PX
from agalign.patches import Keypoints, footprint_radius, transform
from agalign.records import Mask, Raster
from agalign.structure import shrink

_HELD_OUT_CELLS = 8
"""Cells along the longer side; every fifth cell, in a diagonal pattern, is kept from training."""


@dataclass(frozen=True)
class View:
    """One image at one level, standardised."""

    image: Tensor
    """(C, H, W), mean 0 and standard deviation 1 over the valid pixels, 0 elsewhere."""
    room_px: Tensor
    """(H, W) distance from each pixel to the nearest invalid one or to the border."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return int(self.image.shape[2]), int(self.image.shape[1])


@dataclass(frozen=True)
class Level:
    """I and I' at one resolution, and where in I keypoints may lie."""

    scale: float
    """Size relative to the full resolution."""
    fixed: View
    moving: View
    trainable: Tensor
    """(M, 2) integer positions in I with contrast enough, from which theta is learnt."""
    held_out: Tensor
    """(K, 2) the same in cells of the image that theta never sees."""

    @property
    def anywhere(self) -> Tensor:
        """All positions with contrast enough."""
        return torch.cat([self.trainable, self.held_out])


def make_view(raster: Raster, device: torch.device) -> View:
    """A raster as the networks see it."""
    planes = raster.pixels if raster.pixels.ndim == 3 else raster.pixels[None]
    inside = planes[:, raster.valid].astype(np.float64)
    mean = inside.mean(axis=1) if inside.size else np.zeros(len(planes))
    deviation = inside.std(axis=1) if inside.size else np.ones(len(planes))
    standard = (planes - mean[:, None, None]) / np.maximum(deviation, 1e-12)[:, None, None]
    image = np.where(raster.valid, standard, 0.0).astype(np.float32)
    room = _room_px(raster.valid)
    return View(torch.from_numpy(image).to(device), torch.from_numpy(room).to(device))


def make_level(
    fixed: Raster, moving: Raster, scale: float, moving_scale: float, least_gradient: float, device: torch.device
) -> Level:
    """Both images reduced by their scales (1 is full resolution), with the candidate positions of keypoints."""
    small_fixed, small_moving = _reduced(fixed, scale), _reduced(moving, moving_scale)
    fixed_view, moving_view = make_view(small_fixed, device), make_view(small_moving, device)
    gradient = _gradient_magnitude(fixed_view.image.cpu().numpy())
    room = fixed_view.room_px.cpu().numpy()
    usable = (gradient > least_gradient) & (room > footprint_radius(torch.tensor(1.0)).item())
    reserved = _reserved_cells(*small_fixed.size_px)
    inner = cv2.erode(reserved.astype(np.uint8), np.ones((PATCH_PX // 2 + 1,) * 2, np.uint8)) > 0
    return Level(
        scale, fixed_view, moving_view, _positions(usable & ~reserved, device), _positions(usable & inner, device)
    )


@dataclass
class Sampler:
    """Draws random keypoints; the only source of randomness besides the initial weights."""

    generator: torch.Generator

    def draw(
        self, level: Level, pool: Tensor, fixed_to_moving: Tensor, count: int, octaves: float, spacing_px: float = 1.0
    ) -> Keypoints:
        """Up to `count` keypoints of I from `pool` whose patches lie in the valid area of both images.

        Orientation is uniform in [0, 2 pi], log2 of the scale in units of `spacing_px` uniform in [0, octaves]
        (paper, Sec. 5.3).
        """
        tries = 4 * count if len(pool) else 0
        rows = torch.randint(max(1, len(pool)), (tries,), generator=self.generator).to(pool.device)
        angle = torch.rand(tries, generator=self.generator) * (2 * math.pi)
        scale = spacing_px * 2 ** (torch.rand(tries, generator=self.generator) * octaves)
        keypoints = Keypoints(pool[rows].float(), angle.to(pool.device), scale.to(pool.device))
        inside = footprints_inside(level, keypoints, fixed_to_moving)
        return keypoints[inside.nonzero()[:count, 0]]


def footprints_inside(level: Level, keypoints: Keypoints, fixed_to_moving: Tensor) -> Tensor:
    """(N,) True where a keypoint's patch touches only valid pixels in both images."""
    radius = footprint_radius(keypoints.scale) + 1
    there = transform(fixed_to_moving, keypoints.xy)
    jacobian_scale = fixed_to_moving[:2, :2].det().abs().sqrt()
    return (_room_at(level.fixed, keypoints.xy) > radius) & (_room_at(level.moving, there) > radius * jacobian_scale)


def _room_at(view: View, points: Tensor) -> Tensor:
    width, height = view.size_px
    column, row = points.nan_to_num(-1.0).round().clamp(-2, 1e9).long().unbind(dim=1)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    room = view.room_px[torch.where(inside, row, 0), torch.where(inside, column, 0)]
    return torch.where(inside, room, 0.0)


def _reduced(raster: Raster, scale: float) -> Raster:
    width, height = raster.size_px
    return shrink(raster, (max(1, round(width * scale)), max(1, round(height * scale))))


def _room_px(valid: Mask) -> NDArray[np.float32]:
    bordered = np.pad(valid.astype(np.uint8), 1)
    return np.asarray(cv2.distanceTransform(bordered, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1], np.float32)


def _gradient_magnitude(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Largest gradient over the channels, per pixel of distance."""
    gradients = [
        np.hypot(cv2.Sobel(p, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(p, cv2.CV_32F, 0, 1, scale=1 / 8))
        for p in planes
    ]
    return np.asarray(np.max(gradients, axis=0))


def _reserved_cells(width_px: int, height_px: int) -> Mask:
    cell = max(width_px, height_px) / _HELD_OUT_CELLS
    column, row = np.arange(width_px) // cell, np.arange(height_px) // cell
    return np.asarray((column[None, :] + 2 * row[:, None]) % 5 == 0)


def _positions(mask: Mask, device: torch.device) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.argwhere(mask)[:, ::-1])).to(device)
