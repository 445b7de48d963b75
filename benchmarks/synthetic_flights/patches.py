"""Flat patches in space, their materials, and exact ray casting onto them through the lenses of a synthetic camera.

Every object of a scene with depth is made of patches: floors, faces of boxes, leaves. World coordinates are those of
`agalign.synthetic.cameras`: metres east, south and down.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from agalign.synthetic.cameras import BandSpec, Pose, place_and_rays
from agalign.synthetic.ground import Field
from agalign.values import lens
from agalign.values.geometry import Matrix, Points
from agalign.values.lens import Lens
from agalign.values.mapping import splined

Floats = NDArray[np.floating[Any]]
Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, the ends excluded."""

_ROWS = 256
"""Rows of rays that are cast at a time: a floor in a large image needs little memory."""
_MARGIN_PX = 4.0
"""Around the projected corners of a patch. The lens bends its edges by less."""
_BENT_SHARE = 0.03
"""Of the size of the box, for edges across the whole image."""


@dataclass(frozen=True)
class Patch:
    """A flat rectangle or leaf."""

    centre_m: tuple[float, float, float]
    u_m: tuple[float, float, float]
    """From the centre to the middle of one edge."""
    v_m: tuple[float, float, float]
    """From the centre to the middle of the next edge, perpendicular to `u_m`."""
    material: str
    shape: Literal["rectangle", "leaf"] = "rectangle"
    texture_m: tuple[float, float] = (0.0, 0.0)
    """Position of the centre on the material's texture."""
    contrast: float = 1.0
    """Share of the material's contrast."""
    shade: float = 1.0
    """Factor of the reflectance: light that depends on the direction of the face."""
    group: int = 0
    """The plant that it belongs to; the wind moves a plant as a whole."""
    gloss: float = 0.0
    """Strength of the mirror-like reflection."""

    def moved(self, by_m: Sequence[float]) -> "Patch":
        """The same patch at another place."""
        return replace(self, centre_m=tuple(np.add(self.centre_m, by_m).tolist()))


@dataclass(frozen=True)
class Eye:
    """One band's camera at one pose."""

    band: BandSpec
    pose: Pose
    size_px: tuple[int, int]

    @cached_property
    def model(self) -> Lens:
        return self.band.lens(*self.size_px)

    @cached_property
    def place_m(self) -> Points:
        """Position of the lens in the world."""
        return place_and_rays(self.band, self.pose, self.size_px)[0]

    @cached_property
    def attitude(self) -> Matrix:
        """Rotation from the camera's axes (right, down in the image, along the optical axis) to the world's."""
        return place_and_rays(self.band, self.pose, self.size_px)[1] @ self.model.matrix

    def to_camera(self, world_m: Points) -> Points:
        """World points (..., 3) in the camera's axes, with the lens at the origin."""
        return (world_m - self.place_m) @ self.attitude

    def to_world(self, camera_m: Points) -> Points:
        """Points (..., 3) in the camera's axes in the world."""
        return camera_m @ self.attitude.T + self.place_m

    def project(self, camera_m: Points) -> Points:
        """Raw pixels (..., 2) of points (..., 3) in the camera's axes."""
        straight = camera_m[..., :2] / camera_m[..., 2:] * self.model.fx_px + (self.model.cx_px, self.model.cy_px)
        # Far outside the image the lens polynomial turns back. Points there stay outside.
        return lens.distort(self.model, np.clip(straight, *np.outer((-0.4, 1.4), self.size_px)))

    def rays(self, samples: int = 1) -> tuple[Floats, Floats]:
        """(x, y) (height, width) of the ray of each pixel, with z = 1 in the camera's axes; `samples` x `samples` rays
        a pixel.
        """
        return _rays(self.band, self.size_px, samples)


@lru_cache(maxsize=2)
def _rays(band: BandSpec, size_px: tuple[int, int], samples: int) -> tuple[Floats, Floats]:
    model = band.lens(*size_px)
    x_px, y_px = ((np.arange(n * samples) + 0.5) / samples - 0.5 for n in size_px)
    dtype = np.float64 if samples == 1 else np.float32
    straight = splined(lambda raw_px: lens.undistort(model, raw_px), x_px, y_px, dtype=dtype)
    x, y = ((straight[..., k] - c) / model.fx_px for k, c in enumerate((model.cx_px, model.cy_px)))
    return x.astype(dtype), y.astype(dtype)


class Hits(NamedTuple):
    """Where rays (height, width) meet a patch."""

    depth_m: Floats
    """Along the optical axis; inf where a ray misses."""
    u: Floats
    v: Floats
    """Position on the patch, -1 to 1."""


def hits_of(patch: Patch, eye: Eye, x: Floats, y: Floats) -> Hits:
    """The patch as rays (x, y, 1) of the eye meet it."""
    u, v = (np.array(axis) @ eye.attitude for axis in (patch.u_m, patch.v_m))
    centre = eye.to_camera(np.array(patch.centre_m))
    normal = np.cross(u, v)

    def along(axis: Points) -> Floats:
        a, b, c = axis.tolist()
        return x * a + y * b + c

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = float(normal @ centre) / along(normal)
        at_u, at_v = (depth * along(axis / (axis @ axis)) - float(centre @ axis / (axis @ axis)) for axis in (u, v))
        limit = 1 if patch.shape == "rectangle" else 1 - at_u * at_u
        inside = (np.abs(at_u) <= 1) & (np.abs(at_v) <= limit) & (depth > 0)
    return Hits(np.where(inside, depth, np.inf), at_u, at_v)


def boxes_of(patches: Sequence[Patch], eye: Eye, samples: int = 1, farther_px: float = 0.0) -> list[Box]:
    """The box of each patch in an image of `samples` x `samples` rays a pixel, larger by `farther_px` on each side."""
    centre, u, v = (np.array([getattr(p, name) for p in patches]) for name in ("centre_m", "u_m", "v_m"))
    corners_px = eye.project(eye.to_camera(np.stack([centre + a * u + b * v for a in (-1, 1) for b in (-1, 1)])))
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    margin = farther_px + _MARGIN_PX + _BENT_SHARE * (high - low)
    ends = np.clip(np.hstack([low - margin, high + margin + 1]), 0, np.tile(eye.size_px, 2))
    return [tuple(row) for row in np.rint(ends * samples).astype(int).tolist()]


def nearer(
    patches: Sequence[Patch], eye: Eye, x: Floats, y: Floats, boxes: Sequence[Box], depth_m: Floats
) -> Iterator[tuple[int, Hits, tuple[slice, slice], NDArray[np.bool_]]]:
    """Yield (index of the patch, hits, their rows and columns, where they are nearer than those before) and update
    `depth_m`, which is inf for rays that meet nothing.
    """
    for index, (patch, (left, top, right, bottom)) in enumerate(zip(patches, boxes, strict=True)):
        for row in range(top, bottom, _ROWS):
            window = slice(row, min(row + _ROWS, bottom)), slice(left, right)
            hits = hits_of(patch, eye, x[window], y[window])
            closer = hits.depth_m < depth_m[window]
            if closer.any():
                depth_m[window][closer] = hits.depth_m[closer]
                yield index, hits, window, closer


def nearest(
    patches: Sequence[Patch], eye: Eye, x: Floats, y: Floats, boxes: Sequence[Box]
) -> tuple[Floats, NDArray[np.int32]]:
    """(depth along the optical axis in m, index of the patch) of what each ray meets first; inf and -1 for nothing."""
    depth, index = np.full(x.shape, np.inf), np.full(x.shape, -1, np.int32)
    for number, _, window, closer in nearer(patches, eye, x, y, boxes, depth):
        index[window][closer] = number
    return depth, index


# ---- materials: periodic, band-limited textures in each band

_SIDE_IN_WIDTHS = 3.0
"""Texels of a tile for each pixel of the image's width. A texel is half a pixel at the nearest range, so a tile covers
nearly the whole image at twice that range.
"""
_GRAINS_TEXELS = (7.0, 18.0, 70.0)
"""Widths of the blobs of a texture: the finest one is 3.5 px at the nearest range, and has no aliasing at three times
that range with the renderer's samples."""
_ROWS_A_TILE = 14
"""Crop rows on a tile."""
_MIN_GRAIN_TEXELS = 6.0
"""Coarser noise is made on fewer texels and interpolated."""
_NIR_NM = 700.0

_MADE = {
    "concrete": ((0.60, 0.48), 0.25, 0.04),
    "bench": ((0.80, 0.60), 0.12, 0.03),
    "box": ((1.25, 0.75), 0.06, 0.30),
    "plastic": ((0.22, 0.12), 0.15, 0.03),
}
"""Reflectance in visible bands and in near infra-red bands, as a multiple of the brighter of soil and crop, to which
the band's exposure is set; standard deviation of the brightness, and of the print, which is dark in visible bands and
bright in near infra-red ones."""


@dataclass(frozen=True)
class Textures:
    """Noise on a square tile that repeats."""

    brightness: Field
    vigour: Field
    rows: Field
    """Share of crop."""
    waves: tuple[Field, Field]
    """Slopes of a glossy surface along u and v, of standard deviation 1."""
    texel_m: float


def make_textures(rng: np.random.Generator, texel_m: float, width_px: int) -> Textures:
    """Textures with texels of a given size, for images of a given width."""
    side = 2 ** int(np.ceil(np.log2(_SIDE_IN_WIDTHS * width_px)))
    brightness, vigour, leaves = (_octaves(rng, side) for _ in range(3))
    column = np.arange(side, dtype=np.float32) * (2 * np.pi * _ROWS_A_TILE / side)
    wobble = 0.5 * _noise(rng, side, 150.0)
    gaps = expit(4 * (_noise(rng, side, 60.0) - 1.3))
    rows = expit(4 * (np.cos(column + wobble) + 0.7 * leaves - 0.1)) * (1 - gaps)
    along_v, along_u = np.gradient(_noise(rng, side, 30.0))
    waves = tuple(np.asarray(slope / slope.std(), np.float32) for slope in (along_u, along_v))
    return Textures(brightness, vigour, np.asarray(rows, np.float32), waves, texel_m)


def reflectances(textures: Textures, band: BandSpec) -> dict[str, Field]:
    """The tile (n, n) of each material in a band: plants turn from darker than soil to brighter beyond 700 nm."""
    infrared = band.wavelength_nm > _NIR_NM
    soil = band.soil * (1 + 0.3 * textures.brightness)
    leaf = band.crop * (1 + 0.35 * (1 if infrared else -0.5) * textures.vigour)
    result = {"soil": soil, "leaf": leaf, "field": leaf * textures.rows + soil * (1 - textures.rows)}
    for name, (levels, brightness, printed) in _MADE.items():
        level, sign = levels[infrared] * max(band.soil, band.crop), 1 if infrared else -1
        result[name] = level * (1 + brightness * textures.brightness + sign * printed * textures.vigour)
    return {name: np.asarray(np.clip(tile, 0.002, None), np.float32) for name, tile in result.items()}


def sample(tile: Field, u_m: Field, v_m: Field, texel_m: float) -> Field:
    """A periodic tile at positions in m (height, width), no farther than some tiles from its origin."""
    x, y = (np.asarray(p * np.float32(1 / texel_m), np.float32) for p in (u_m, v_m))
    return np.asarray(cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _octaves(rng: np.random.Generator, side: int) -> Field:
    """Noise of three grains, standard deviation 1, without the rare values that would saturate a sensor."""
    parts = [weight * _noise(rng, side, grain) for weight, grain in zip((0.65, 0.6, 0.45), _GRAINS_TEXELS, strict=True)]
    return np.asarray(np.clip(sum(parts), -2.2, 2.2), np.float32)


def _noise(rng: np.random.Generator, tile_side: int, grain_texels: float) -> Field:
    """Periodic Gaussian noise of mean 0 and standard deviation 1 with blobs of the given width."""
    reduction = 2 ** max(0, int(np.log2(grain_texels / _MIN_GRAIN_TEXELS)))
    side, sigma = tile_side // reduction, grain_texels / reduction / 2
    border = int(4 * sigma) + 4
    noise = np.pad(rng.standard_normal((side, side), dtype=np.float32), border, mode="wrap")
    blurred = cv2.GaussianBlur(noise, (0, 0), sigma)
    large = cv2.resize(blurred, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_CUBIC)
    field = large[border * reduction :, border * reduction :][:tile_side, :tile_side]
    return np.asarray((field - field.mean()) / field.std(), np.float32)
