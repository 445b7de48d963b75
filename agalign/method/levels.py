"""The images of one capture at one resolution, and the keypoints that may be drawn from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from agalign.method.patches import FOOTPRINT_PX, Keypoints, bilinear, footprint_radius, transform
from agalign.pixels.resample import shrink
from agalign.pixels.structure import gradient_magnitude
from agalign.values import geometry, lens
from agalign.values.alignment import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.image import FloatImage, Mask, Raster
from agalign.values.lens import Lens
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

_HELD_OUT_CELLS = 8
"""Cells along the longer side; every fifth cell, in a diagonal pattern, is kept from training."""
_FIELD_COLUMNS = 65
_MIN_GRADIENT = 0.05
"""Keypoints are drawn where the gradient of the standardised image is larger than this, per px (paper, Sec. 5.3)."""
_MIN_CELL_PX = 4 * FOOTPRINT_PX
"""Less than this across, a cell has no room for the patches of recipe fast, twice the smallest one's size."""
_POOL = 16_384
"""Positions kept of each kind: enough for any run, and each is undistorted only once."""
_TRIES = 4
"""Keypoints drawn for each that is wanted: some have patches that reach too far."""


@dataclass(frozen=True)
class LevelImage:
    """One image at one level, standardised. Positions are given undistorted: the image is sampled through its lens."""

    image: Tensor
    """(C, H, W), mean 0 and standard deviation 1 over the valid pixels, 0 elsewhere."""
    room_px: Tensor
    """(H, W) distance from each pixel to the nearest invalid one or to the border."""
    scale: PixelScale = SAME_PIXELS
    """Size (x, y) relative to the image that it was reduced from."""
    lens: Lens | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return int(self.image.shape[2]), int(self.image.shape[1])

    def raw(self, points: Tensor) -> Tensor:
        """Raw pixel positions of undistorted ones, (..., 2)."""
        if self.lens is None or not lens.is_distorting(self.lens):
            return points
        return torch.stack(lens.distorted(self.lens, points[..., 0], points[..., 1]), dim=-1)

    def patches(self, positions: Tensor) -> Tensor:
        """Undistorted sample positions (N, 16, 16, 2) -> (N, C, 16, 16)."""
        return bilinear(self.image, self.raw(positions))

    def room_at(self, points: Tensor) -> Tensor:
        """Distance to the nearest invalid pixel from undistorted positions (N, 2); 0 outside."""
        width, height = self.size_px
        column, row = self.raw(points).nan_to_num(-1.0).round().clamp(-2, 1e9).long().unbind(dim=1)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        room = self.room_px[torch.where(inside, row, 0), torch.where(inside, column, 0)]
        return torch.where(inside, room, 0.0)


@dataclass(frozen=True)
class Pool:
    """Where keypoints may lie."""

    xy: Tensor
    """(M, 2) undistorted positions."""
    reach_px: Tensor
    """(M,) how far a patch around each may reach; infinity where only the image bounds it."""

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True)
class Level:
    """I and one or more I' at one resolution, and where in I keypoints may lie."""

    fixed: LevelImage
    moving: tuple[LevelImage, ...]
    trainable: Pool
    """Positions with contrast enough from which theta is learnt."""
    held_out: Pool
    """The same in cells of the image that theta never sees: patches around the ones share none with patches
    around the others."""
    anywhere: Pool
    """Both together, their patches unbounded."""
    fields: tuple[Tensor | None, ...] = ()
    """(1, 2, rows, columns) for a moving image before whose homography positions of I are displaced: px of the level
    on a lattice from corner to corner of I; empty where none is.
    """

    def with_fields(self, fields: "Sequence[DisplacementField | None]") -> "Level":
        """The same level with displacements, px of the image that I was reduced from."""
        width, height = self.fixed.size_px
        nodes = geometry.lattice(width, height, _FIELD_COLUMNS, round(_FIELD_COLUMNS * height / width) + 1)
        shape = (-1, _FIELD_COLUMNS, 2)

        def on_lattice(field: DisplacementField) -> Tensor:
            shift = field.rescaled(self.fixed.scale)(nodes)
            values = np.moveaxis(shift.reshape(shape), -1, 0)[None].astype(np.float32)
            return torch.from_numpy(np.ascontiguousarray(values)).to(self.fixed.image.device)

        return replace(self, fields=tuple(None if f is None else on_lattice(f) for f in fields))

    def displacement(self, band: int, xy: Tensor) -> Tensor | None:
        """(N, 2) px by which positions (N, 2) of I are displaced before a moving image's homography; None for none."""
        field = self.fields[band] if self.fields else None
        if field is None:
            return None
        size = xy.new_tensor(self.fixed.size_px) - 1
        at = (2 * self.fixed.raw(xy) / size - 1)[None, :, None]
        result = functional.grid_sample(field, at, padding_mode="border", align_corners=True)
        return result[0, :, :, 0].T

    def homography(self, matrix: Matrix, band: int) -> Tensor:
        """A full-resolution fixed_to_moving matrix of a moving image as one between the level's, (3, 3) float32."""
        scaled = geometry.rescale(matrix, self.fixed.scale, self.moving[band].scale)
        return torch.tensor(scaled, dtype=torch.float32, device=self.fixed.image.device)

    def full_matrix(self, homography: Tensor, band: int) -> Matrix:
        """The inverse of `homography`."""
        up, moving_up = self.fixed.scale.inverse, self.moving[band].scale.inverse
        return geometry.rescale(homography.cpu().double().numpy(), up, moving_up)


def make_level_image(raster: Raster, scale: float, device: torch.device) -> LevelImage:
    """A raster as the networks see it, reduced by `scale` (1 is its own resolution)."""
    width, height = raster.size_px
    small = shrink(raster, (max(1, round(width * scale)), max(1, round(height * scale))))
    planes = small.pixels if small.pixels.ndim == 3 else small.pixels[None]
    mask = small.valid.astype(np.uint8)
    image = np.empty(planes.shape, np.float32)
    for plane, standard in zip(planes, image, strict=True):
        mean, deviation = (float(v.item()) for v in cv2.meanStdDev(plane, mask=mask))
        np.multiply(plane - np.float32(mean), np.float32(1 / max(deviation, 1e-12)), out=standard)
        standard[~small.valid] = 0
    relative = PixelScale.between(raster.size_px, small.size_px)
    room = torch.from_numpy(_room_px(small.valid)).to(device)
    return LevelImage(torch.from_numpy(image).to(device), room, relative, small.lens)


def make_level(
    fixed: Raster, moving: Sequence[Raster], mappings: Sequence[Matrix], scale: float,
    generator: torch.Generator, device: torch.device,
) -> Level:  # fmt: skip
    """The images reduced by `scale`, a moving one so that its mapping's magnification becomes 1 where it is larger."""
    fixed_view = make_level_image(fixed, scale, device)
    views = []
    for raster, matrix in zip(moving, mappings, strict=True):
        magnification = float(np.median(np.abs(geometry.local_scale(matrix, *fixed.size_px))))
        usable = np.isfinite(magnification) and magnification > 0
        views.append(make_level_image(raster, min(1.0, scale / magnification) if usable else scale, device))
    gradient = _gradient_magnitude(fixed_view.image.cpu().numpy())
    room = fixed_view.room_px.cpu().numpy()
    usable_px = (gradient > _MIN_GRADIENT) & (room > FOOTPRINT_PX)
    trainable, held_out = (
        _pool(usable_px, reach_px, fixed_view.lens, generator, device)
        for reach_px in _reach_within_cells(*fixed_view.size_px)
    )
    xy = torch.cat([trainable.xy, held_out.xy])
    anywhere = Pool(xy, torch.full_like(xy[:, 0], math.inf))
    return Level(fixed_view, tuple(views), trainable, held_out, anywhere)


@dataclass
class Sampler:
    """Draws random keypoints; the only source of randomness besides the initial weights."""

    generator: torch.Generator

    def draw(
        self, level: Level, pool: Pool, homographies: Sequence[Tensor], count: int, octaves: float,
        spacing_px: float = 1.0,
    ) -> tuple[Keypoints, Tensor]:  # fmt: skip
        """Up to `count` keypoints of I from `pool` with patches in the valid area of I and of some I', and in
        which I' they do, (N, bands) bool. Those that lie in the most come first.

        Orientation is uniform in [0, 2 pi], log2 of the scale in units of `spacing_px` uniform in [0, octaves]
        (paper, Sec. 5.3).
        """
        tries, device = _TRIES * count if len(pool) else 0, pool.xy.device
        rows = torch.randint(max(1, len(pool)), (tries,), generator=self.generator).to(device)
        angle = torch.rand(tries, generator=self.generator) * (2 * math.pi)
        scale = spacing_px * 2 ** (torch.rand(tries, generator=self.generator) * octaves)
        keypoints = Keypoints(pool.xy[rows], angle.to(device), scale.to(device))
        inside = torch.stack([footprints_inside(level, b, keypoints, h) for b, h in enumerate(homographies)], dim=1)
        inside &= (footprint_radius(keypoints.scale) + 1 < pool.reach_px[rows])[:, None]
        bands = inside.sum(dim=1)
        order = torch.argsort(bands, descending=True, stable=True)[:count]
        order = order[bands[order] > 0]
        return keypoints[order], inside[order]


def footprints_inside(level: Level, band: int, keypoints: Keypoints, homography: Tensor) -> Tensor:
    """(N,) True where a keypoint's patch touches only valid pixels in both images."""
    here = level.fixed.room_at(keypoints.xy) > footprint_radius(keypoints.scale) + 1
    return here & footprints_inside_moving(level, band, keypoints, homography)


def footprints_inside_moving(level: Level, band: int, keypoints: Keypoints, homography: Tensor) -> Tensor:
    """(N,) the same in the moving image alone."""
    there = transform(homography, keypoints.xy)
    jacobian_scale = homography[:2, :2].det().abs().sqrt()
    return level.moving[band].room_at(there) > (footprint_radius(keypoints.scale) + 1) * jacobian_scale


def _room_px(valid: Mask) -> NDArray[np.float32]:
    if valid.all():
        column, row = (np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) for n in valid.shape[::-1])
        return np.minimum(column[None, :], row[:, None]).astype(np.float32)
    bordered = np.pad(valid.astype(np.uint8), 1)
    return np.asarray(cv2.distanceTransform(bordered, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1], np.float32)


def _gradient_magnitude(planes: FloatImage) -> FloatImage:
    """Largest gradient over the channels, per pixel of distance."""
    gradients = [
        gradient_magnitude(cv2.Sobel(p, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(p, cv2.CV_32F, 0, 1, scale=1 / 8))
        for p in planes
    ]
    return np.asarray(np.max(gradients, axis=0))


def _reserved_cells(width_px: int, height_px: int) -> Mask:
    cell = max(max(width_px, height_px) / _HELD_OUT_CELLS, _MIN_CELL_PX)
    column, row = (np.arange(n) // cell % 5 for n in (width_px, height_px))
    # Within a row of cells, those of one column in five.
    return np.asarray(column[None, :] == (-2 * row % 5)[:, None])


@lru_cache(maxsize=2)
def _reach_within_cells(width_px: int, height_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Distance from each pixel, (height, width), to the nearest one of the other kind of cells: in the cells for
    training, and in the reserved ones; 0 elsewhere.
    """
    reserved = _reserved_cells(width_px, height_px)
    training, held_out = (
        np.asarray(cv2.distanceTransform(c.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
        for c in (~reserved, reserved)
    )
    return training, held_out


def _pool(
    usable: Mask, reach_px: NDArray[np.float32], model: Lens | None, generator: torch.Generator, device: torch.device
) -> Pool:
    """Up to _POOL of the usable pixels from which the smallest patch, and some more, can reach so far."""
    result = np.flatnonzero(usable & (reach_px > FOOTPRINT_PX + 1))
    if len(result) > _POOL:
        result = result[torch.randint(len(result), (_POOL,), generator=generator).numpy()]
    row, column = np.divmod(result, usable.shape[1])
    xy = lens.undistort(model, np.stack([column, row], axis=1)).astype(np.float32)
    return Pool(torch.from_numpy(xy).to(device), torch.from_numpy(reach_px[row, column].astype(np.float32)).to(device))
