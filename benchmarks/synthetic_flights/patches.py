"""Flat patches in space, and exact ray casting onto them through the lenses of a synthetic camera.

Every object of a scene with depth is made of patches: floors, faces of boxes, leaves. World coordinates are those of
`agalign.synthetic.cameras`: metres east, south and down.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agalign.synthetic.cameras import BandSpec, Pose, place_and_rays
from agalign.values import lens
from agalign.values.geometry import Matrix, Points
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
        x, y, z = (a + float(b) for a, b in zip(self.centre_m, by_m, strict=True))
        return replace(self, centre_m=(x, y, z))


@dataclass(frozen=True)
class Eye:
    """One band's camera at one pose."""

    band: BandSpec
    pose: Pose
    size_px: tuple[int, int]

    @cached_property
    def place_m(self) -> Points:
        """Position of the lens in the world."""
        return place_and_rays(self.band, self.pose, self.size_px)[0]

    @cached_property
    def attitude(self) -> Matrix:
        """Rotation from the camera's axes (right, down in the image, along the optical axis) to the world's."""
        rays = place_and_rays(self.band, self.pose, self.size_px)[1]
        return np.asarray(rays @ self.band.lens(*self.size_px).matrix)

    def to_camera(self, world_m: Points) -> Points:
        """World points (..., 3) in the camera's axes, with the lens at the origin."""
        return np.asarray((world_m - self.place_m) @ self.attitude)

    def to_world(self, camera_m: Points) -> Points:
        """Points (..., 3) in the camera's axes in the world."""
        return np.asarray(camera_m @ self.attitude.T + self.place_m)

    def project(self, camera_m: Points) -> Points:
        """Raw pixels (..., 2) of points (..., 3) in the camera's axes."""
        model = self.band.lens(*self.size_px)
        straight = camera_m[..., :2] / camera_m[..., 2:] * model.fx_px + (model.cx_px, model.cy_px)
        # Far outside the image the lens polynomial turns back. Points there stay outside.
        width, height = self.size_px
        limited = np.clip(straight, (-0.4 * width, -0.4 * height), (1.4 * width, 1.4 * height))
        return lens.distort(model, limited)

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
        a, b, c = (float(value) for value in axis)
        return np.asarray(x * a + y * b + c)

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = float(normal @ centre) / along(normal)
        at_u, at_v = (depth * along(axis / (axis @ axis)) - float(centre @ axis / (axis @ axis)) for axis in (u, v))
        limit = 1 if patch.shape == "rectangle" else 1 - at_u * at_u
        inside = (np.abs(at_u) <= 1) & (np.abs(at_v) <= limit) & (depth > 0)
    return Hits(np.where(inside, depth, np.inf), at_u, at_v)


def boxes_of(patches: Sequence[Patch], eye: Eye, samples: int = 1, farther_px: float = 0.0) -> list[Box]:
    """The box of each patch in an image of `samples` x `samples` rays a pixel, larger by `farther_px` on each side."""
    centre, u, v = (np.array([getattr(p, name) for p in patches]) for name in ("centre_m", "u_m", "v_m"))
    corners = np.stack([centre + a * u + b * v for a in (-1, 1) for b in (-1, 1)])
    corners_px = eye.project(eye.to_camera(corners))
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    margin = farther_px + _MARGIN_PX + _BENT_SHARE * (high - low)
    ends = np.clip(np.hstack([low - margin, high + margin + 1]), 0, np.tile(eye.size_px, 2))
    return [tuple(row) for row in np.rint(ends * samples).astype(int).tolist()]  # type: ignore[misc]


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
    depth = np.full(x.shape, np.inf)
    index = np.full(x.shape, -1, np.int32)
    for number, _, window, closer in nearer(patches, eye, x, y, boxes, depth):
        index[window][closer] = number
    return depth, index
