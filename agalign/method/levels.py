"""The images of one capture at one resolution, their homographies, and random sampling of keypoints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from agalign.errors import NoContrastError
from agalign.method.descriptor import REFERENCE, Descriptor
from agalign.method.device import to_float64
from agalign.method.gauss_newton import Step
from agalign.method.patches import FOOTPRINT_PX, Keypoints, bilinear, footprint_radius, patch_positions, transform
from agalign.method.state import JointState, MovingImage
from agalign.pixels.band_resampling import shrink
from agalign.pixels.structure import gradient_magnitude
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix
from agalign.values.image import FloatImage, Mask, Raster
from agalign.values.lens import Lens
from agalign.values.mapping import DisplacementField
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size

_FIELD_COLUMNS = 65
"""Columns of the grid on which displacement fields are sampled."""
_MAX_POSITIONS = 16_384
"""Positions in a pool: enough for any run, and each is undistorted only once."""


@dataclass(frozen=True)
class LevelImage:
    """One standardised image at one level. Its methods take undistorted positions and apply the lens model."""

    image: Tensor
    """(C, H, W), mean 0 and standard deviation 1 over the valid pixels, 0 elsewhere."""
    clearance_px: Tensor
    """(H, W) distance from each pixel to the nearest invalid pixel or the border."""
    scale: PixelScale = SAME_PIXELS
    """Size (x, y) relative to the image at full resolution."""
    lens: Lens | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return int(self.image.shape[2]), int(self.image.shape[1])

    def raw(self, points: Tensor) -> Tensor:
        """Convert undistorted positions (..., 2) to raw pixel positions."""
        if self.lens is None or not lens.is_distorting(self.lens):
            return points
        return torch.stack(lens.distorted(self.lens, points[..., 0], points[..., 1]), dim=-1)

    def patches(self, positions: Tensor) -> Tensor:
        """Sample patches at undistorted positions, (N, 16, 16, 2) -> (N, C, 16, 16)."""
        return bilinear(self.image, self.raw(positions))

    def describe(self, net: Descriptor, keypoints: Keypoints, side: int = REFERENCE) -> Tensor:
        """Return the descriptors (N, 256) of keypoints of this image by a side of the network."""
        f: Tensor = net(self.patches(patch_positions(keypoints)), side)
        return f

    def clearance_at(self, points: Tensor) -> Tensor:
        """Return the distance (N,) px from undistorted positions (N, 2) to the nearest invalid pixel; 0 outside."""
        width, height = self.size_px
        column, row = self.raw(points).nan_to_num(-1.0).round().clamp(-2, 1e9).long().unbind(dim=1)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        clearance = self.clearance_px[torch.where(inside, row, 0), torch.where(inside, column, 0)]
        return torch.where(inside, clearance, 0.0)


@dataclass(frozen=True)
class Pool:
    """Candidate positions of keypoints."""

    xy: Tensor
    """(M, 2) undistorted positions."""
    max_radius_px: Tensor
    """(M,) largest radius of a patch around each; infinity where only the valid area limits it."""

    def __len__(self) -> int:
        return len(self.xy)


@dataclass
class LevelBand:
    """A moving image I' at one resolution, and its alignment with the image I of the reference."""

    moving: MovingImage
    fixed_view: LevelImage
    """I."""
    view: LevelImage
    """I'."""
    h: Tensor
    """(3, 3) float32, fixed_to_moving in px of the level; the optimisation updates it."""
    field: Tensor | None
    """Displacement field (1, 2, rows, columns): px of the level at the nodes of a grid over I, added to positions of I
    before the homography."""
    retrieval: float | None = None
    """Held-out retrieval at the last test; None without any, as too few patches can be drawn."""
    distinguished: bool = False
    """True once held-out retrieval has reached MIN_RETRIEVAL, which steps on psi require."""
    converged: bool = False
    """True after the first short step on psi; updates continue until those of all images are short."""

    def is_inside_moving(self, keypoints: Keypoints) -> Tensor:
        """Return (N,) True for each keypoint of I with a patch of only valid pixels in I'."""
        magnification = self.h[:2, :2].det().abs().sqrt()
        clearance = self.view.clearance_at(transform(self.h, keypoints.xy))
        return clearance > (footprint_radius(keypoints.scale) + 1) * magnification

    def overlaps(self, keypoints: Keypoints) -> Tensor:
        """Return (N,) True for each keypoint of I with a patch of only valid pixels in both images."""
        inside_fixed = self.fixed_view.clearance_at(keypoints.xy) > footprint_radius(keypoints.scale) + 1
        return inside_fixed & self.is_inside_moving(keypoints)

    def patches(self, keypoints: Keypoints) -> Tensor:
        """Return B(w(x; psi); I'), (N, C, 16, 16); the homography maps each sample position, not only the keypoint."""
        positions = patch_positions(keypoints)
        if self.field is not None:
            size = keypoints.xy.new_tensor(self.fixed_view.size_px) - 1
            at = (2 * self.fixed_view.raw(keypoints.xy) / size - 1)[None, :, None]
            displacement = functional.grid_sample(self.field, at, padding_mode="border", align_corners=True)
            positions = positions + displacement[0, :, :, 0].T[:, None, None]
        return self.view.patches(transform(self.h, positions))

    def describe(self, net: Descriptor, keypoints: Keypoints) -> Tensor:
        """Return f(w(x; psi)) for keypoints x of I, (N, 256)."""
        f_prime: Tensor = net(self.patches(keypoints), self.moving.side)
        return f_prime

    def update(self, step: Step, factor: float = 1.0) -> None:
        """Replace H by H @ change, with the change of psi, which is linear in it, scaled by a factor."""
        identity = torch.eye(3, dtype=step.change.dtype, device=step.change.device)
        self.h = (to_float64(self.h) @ (identity + factor * (step.change - identity))).to(self.h)

    @property
    def fixed_to_moving(self) -> Matrix:
        """The homography in px of the full resolution. Raises GeometryError if it cannot be inverted."""
        up, moving_up = self.fixed_view.scale.inverse, self.view.scale.inverse
        return geometry.rescale(self.h.cpu().double().numpy(), up, moving_up)


@dataclass(frozen=True)
class Level:
    """I and one or more I' at one resolution, and the candidate positions of keypoints in I."""

    fixed: LevelImage
    bands: tuple[LevelBand, ...]
    trainable: Pool
    """Positions with texture in the cells on which theta is trained."""
    held_out: Pool
    """Positions with texture in the held-out cells. Their patches share no pixels with those of `trainable`."""
    anywhere: Pool
    """Both, without a limit on the radius of a patch."""
    generator: torch.Generator

    def draw(self, pool: Pool, count: int, octaves: float, spacing_px: float = 1.0) -> tuple[Keypoints, Tensor]:
        """Draw up to `count` keypoints with patches in the valid area of I and of at least one I'.

        Returns the keypoints and (N, bands) True for each I' that contains the patch; keypoints in most bands come
        first. An I' that contains few of these, as it shows another part of I, has up to a quarter of `count` in
        addition. The orientation is uniform in [0, 2 pi], log2(scale / spacing_px) is uniform in [0, octaves] (paper,
        Sec. 5.3).
        """
        tries_per_keypoint = 4  # keypoints are drawn in excess, because patches that leave the valid area are rejected
        tries, device = tries_per_keypoint * count if len(pool) else 0, pool.xy.device
        rows = torch.randint(max(1, len(pool)), (tries,), generator=self.generator).to(device)
        angle = torch.rand(tries, generator=self.generator) * (2 * math.pi)
        scale = spacing_px * 2 ** (torch.rand(tries, generator=self.generator) * octaves)
        keypoints = Keypoints(pool.xy[rows], angle.to(device), scale.to(device))
        inside = torch.stack([band.overlaps(keypoints) for band in self.bands], dim=1)
        inside &= (footprint_radius(keypoints.scale) + 1 < pool.max_radius_px[rows])[:, None]
        bands = inside.sum(dim=1)
        order = torch.argsort(bands, descending=True, stable=True)
        order = order[bands[order] > 0]
        chosen, others = order[:count], order[count:]
        for of_band in inside.T:
            missing = max(0, count // 4 - int(of_band[chosen].sum()))
            added = others[of_band[others]][:missing]
            chosen, others = torch.cat([chosen, added]), others[~torch.isin(others, added)]
        return keypoints[chosen], inside[chosen]


def make_level_image(raster: Raster, scale: float, device: torch.device) -> LevelImage:
    """Reduce a raster by `scale` (1 is full resolution) and standardise each channel."""
    width, height = raster.size_px
    small = shrink(raster, (max(1, round(width * scale)), max(1, round(height * scale))))
    mask = small.valid.astype(np.uint8)
    image = np.empty(small.planes.shape, np.float32)
    for plane, standard in zip(small.planes, image, strict=True):
        mean, deviation = (float(v.item()) for v in cv2.meanStdDev(plane, mask=mask))
        np.multiply(plane - np.float32(mean), np.float32(1 / max(deviation, 1e-12)), out=standard)
        standard[~small.valid] = 0
    relative = PixelScale.between(raster.size_px, small.size_px)
    clearance_px = torch.from_numpy(_clearance_px(small.valid)).to(device)
    return LevelImage(torch.from_numpy(image).to(device), clearance_px, relative, small.lens)


def make_level(state: JointState, fixed: Raster, moving: Sequence[MovingImage], scale: float) -> Level:
    """Reduce the images of a capture by `scale`. Raises NoContrastError."""
    fixed_view = make_level_image(fixed, scale, state.device)
    bands = tuple(_level_band(m, fixed.size_px, fixed_view, scale, state.device) for m in moving)
    gradient = _gradient_magnitude(fixed_view.image.cpu().numpy())
    # Keypoints are drawn where the gradient of the standardised image is larger than this (paper, Sec. 5.3).
    min_gradient_per_px = 0.05
    has_texture = (gradient > min_gradient_per_px) & (fixed_view.clearance_px.cpu().numpy() > FOOTPRINT_PX)
    trainable, held_out = (
        _pool(has_texture, max_radius_px, fixed_view.lens, state)
        for max_radius_px in _training_and_held_out_radii(*fixed_view.size_px)
    )
    if len(trainable) == 0:
        raise NoContrastError
    xy = torch.cat([trainable.xy, held_out.xy])
    anywhere = Pool(xy, torch.full_like(xy[:, 0], math.inf))
    return Level(fixed_view, bands, trainable, held_out, anywhere, state.generator)


def _level_band(
    moving: MovingImage, fixed_size_px: Size, fixed_view: LevelImage, scale: float, device: torch.device
) -> LevelBand:
    """Reduce a moving image so that the magnification of its mapping is 1, but never enlarge it."""
    magnification = float(np.median(np.abs(geometry.local_scale(moving.fixed_to_moving, *fixed_size_px))))
    usable = np.isfinite(magnification) and magnification > 0
    view = make_level_image(moving.raster, min(1.0, scale / magnification) if usable else scale, device)
    h = torch.tensor(geometry.rescale(moving.fixed_to_moving, fixed_view.scale, view.scale), dtype=torch.float32)
    field = None if moving.field is None else _on_grid(moving.field, fixed_view).to(device)
    return LevelBand(moving, fixed_view, view, h.to(device), field)


def _on_grid(field: DisplacementField, fixed_view: LevelImage) -> Tensor:
    """Return `LevelBand.field` of a displacement field, which is in px at full resolution."""
    width, height = fixed_view.size_px
    nodes = geometry.lattice(width, height, _FIELD_COLUMNS, round(_FIELD_COLUMNS * height / width) + 1)
    shift = field.rescaled(fixed_view.scale)(nodes).reshape(-1, _FIELD_COLUMNS, 2)
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(shift, -1, 0)[None].astype(np.float32)))


def _clearance_px(valid: Mask) -> NDArray[np.float32]:
    """Return the distance of each pixel to the nearest invalid pixel or the border."""
    if valid.all():
        column, row = (np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) for n in valid.shape[::-1])
        return np.minimum(column[None, :], row[:, None]).astype(np.float32)
    bordered = np.pad(valid.astype(np.uint8), 1)
    return np.asarray(cv2.distanceTransform(bordered, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1], np.float32)


def _gradient_magnitude(planes: FloatImage) -> FloatImage:
    """Return the largest gradient magnitude over the channels, (C, H, W) -> (H, W), per px."""
    gradients = [
        gradient_magnitude(cv2.Sobel(p, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(p, cv2.CV_32F, 0, 1, scale=1 / 8))
        for p in planes
    ]
    return np.asarray(np.max(gradients, axis=0))


@lru_cache(maxsize=2)
def _training_and_held_out_radii(width_px: int, height_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return, for the training cells and for the held-out cells, (height, width) px distances to the cells of the
    other kind; 0 in the cells of the other kind.
    """
    # Cells along the longer side; every fifth cell of each row, on diagonals, is held out from training.
    held_out_cells = 8
    # Minimum width of a cell, so that it can contain the largest patches of recipe fast, 2 px between samples.
    min_cell_px = 4 * FOOTPRINT_PX
    cell_px = max(max(width_px, height_px) / held_out_cells, min_cell_px)
    column, row = (np.arange(n) // cell_px % 5 for n in (width_px, height_px))
    is_held_out = column[None, :] == (-2 * row % 5)[:, None]
    training, held_out = (
        np.asarray(cv2.distanceTransform(c.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
        for c in (~is_held_out, is_held_out)
    )
    return training, held_out


def _pool(has_texture: Mask, max_radius_px: NDArray[np.float32], model: Lens | None, state: JointState) -> Pool:
    """Select at random up to _MAX_POSITIONS pixels with texture around which the smallest patch fits."""
    flat = np.flatnonzero(has_texture & (max_radius_px > FOOTPRINT_PX + 1))
    if len(flat) > _MAX_POSITIONS:
        flat = flat[torch.randint(len(flat), (_MAX_POSITIONS,), generator=state.generator).numpy()]
    row, column = np.divmod(flat, has_texture.shape[1])
    xy = lens.undistort(model, np.stack([column, row], axis=1)).astype(np.float32)
    radius_px = max_radius_px[row, column].astype(np.float32)
    return Pool(torch.from_numpy(xy).to(state.device), torch.from_numpy(radius_px).to(state.device))
