"""The ground of a synthetic flight: parcels with crop rows, bare soil, tracks and trees."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from agalign.synthetic import cameras
from agalign.synthetic.cameras import REDEDGE, BandSpec, CameraSpec, Pose, place_and_rays
from agalign.values import lens
from agalign.values.geometry import Points

Field = NDArray[np.float32]


@dataclass(frozen=True)
class Ground:
    """The painted ground: shares of materials and textures on a square grid centred on the origin."""

    crop: Field
    tree: Field
    brightness: Field
    vigour: Field
    metres_per_px: float
    height_m: Field | None = None
    """Height above the plane; None for flat ground."""
    overlay: Field | None = None
    """Reflectance of objects on the ground, equal in all bands; nan elsewhere."""


def paint_ground(
    rng: np.random.Generator, poses: Sequence[Pose], size_px: tuple[int, int], camera: CameraSpec = REDEDGE
) -> Ground:
    """Return a ground with parcels, rows, tracks and trees, large and fine enough for all bands at all poses."""
    focal = cameras.FOCAL_LENGTH_MM * cameras.PIXELS_PER_MM * size_px[0] / 1280
    lowest, highest = min(p.altitude_m for p in poses), max(p.altitude_m for p in poses)
    # The highest angular resolution and the widest field of view of a band, as multiples of the RedEdge-M's.
    sharpest, widest = max(b.size_ratio[0] / b.view for b in camera.bands), max(b.view for b in camera.bands)
    # The pixels of the ground must not be visible in the images.
    map_px_per_image_px = 1.25
    metres_per_px = lowest / focal / sharpest / map_px_per_image_px
    seen_m = 0.62 * highest * np.hypot(*size_px) / focal * widest
    radius_m = max(np.hypot(p.east_m, p.north_m) for p in poses) + seen_m
    side = 2 * int(np.ceil(radius_m / metres_per_px))
    metre = 1 / metres_per_px
    count = max(6, round((side / metre / 9) ** 2))
    parcel, edge = _parcels(rng, side, count)
    angle, spacing = rng.uniform(0, np.pi, count), rng.uniform(0.45, 0.85, count) * metre
    density = np.where(rng.random(count) < 0.15, -9.0, rng.uniform(-0.4, 0.4, count))
    across_x = (2 * np.pi * np.cos(angle) / spacing).astype(np.float32)[parcel]
    across_y = (2 * np.pi * np.sin(angle) / spacing).astype(np.float32)[parcel]
    axis = np.arange(side, dtype=np.float32)
    wobble = 0.06 * metre * _noise(rng, side, 1.5 * metre)
    rows = np.cos(across_x * (axis[None, :] + wobble) + across_y * (axis[:, None] + wobble))
    leaves = 0.7 * _noise(rng, side, 0.05 * metre) + 0.5 * _noise(rng, side, 0.25 * metre)
    crop = expit(6 * (rows + leaves + density.astype(np.float32)[parcel]))
    gaps = _noise(rng, side, 0.6 * metre) > 1.5
    crop = np.where(gaps, crop * 0.15, crop)
    crop = np.where(edge < 0.35 * metre, 0.03, crop)
    tree = _trees(rng, side, metre)
    crop = crop * (1 - tree)
    ruts = np.clip(1.5 - np.abs(edge - 0.18 * metre) / (0.05 * metre), 0, 1)
    brightness = 1 + 0.22 * _noise(rng, side, 2.5 * metre) + 0.16 * _noise(rng, side, 0.08 * metre)
    vigour = 0.5 * _noise(rng, side, 3 * metre) + 0.45 * _noise(rng, side, 0.12 * metre)
    # Clods and leaves are painted if they are large enough in the images.
    min_grain_px = 3.0
    for grain_m in (0.02, 0.005):
        if grain_m * metre >= min_grain_px:
            brightness = brightness + 0.12 * _noise(rng, side, grain_m * metre)
            vigour = vigour + 0.3 * _noise(rng, side, grain_m * metre)
    brightness = np.clip(brightness + 0.25 * (edge < 0.35 * metre) - 0.3 * ruts, 0.3, 2.2)
    crop, brightness = crop.astype(np.float32), brightness.astype(np.float32)
    return Ground(crop, tree, brightness, np.clip(vigour, -1.5, 1.5).astype(np.float32), metres_per_px)


def reflectance(ground: Ground, band: BandSpec) -> Field:
    """Return the reflectance (height, width) of the ground in a band: vigour raises it in infrared, lowers it in
    visible light.
    """
    bright = 1 if band.wavelength_nm > 700 else -0.5
    crop = band.crop * (1 + 0.35 * bright * ground.vigour)
    soil = band.soil * ground.brightness
    bare = 1 - ground.crop - ground.tree
    result = soil * bare + crop * ground.crop + band.tree * (1 + 0.5 * ground.vigour) * ground.tree
    if ground.overlay is not None:
        result = np.where(np.isnan(ground.overlay), result, ground.overlay)
    return np.asarray(result, np.float32)


def on_ground(ground: Ground, band: BandSpec, pose: Pose, size_px: tuple[int, int], raw_px: Points) -> Points:
    """Return the points (..., 3) on the ground, metres east, south and down, that raw pixels (..., 2) show."""
    undistorted = lens.undistort(band.lens(*size_px), raw_px)
    place, rays = place_and_rays(band, pose, size_px)
    direction = np.concatenate([undistorted, np.ones_like(undistorted[..., :1])], axis=-1) @ rays.T
    down = np.zeros(direction.shape[:-1])
    seen = place + direction * ((down - place[2]) / direction[..., 2])[..., None]
    # Intersect the rays with the relief: each step uses the height below the previous point.
    steps = 40
    for _ in range(0 if ground.height_m is None else steps):
        at = map_px(ground, seen[..., :2]).astype(np.float32).reshape(len(seen), -1, 2)
        height = cv2.remap(ground.height_m, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        down = -height.reshape(down.shape).astype(np.float64)
        seen = place + direction * ((down - place[2]) / direction[..., 2])[..., None]
    return np.asarray(seen)


def map_px(ground: Ground, metres: Points) -> Points:
    """Return positions in metres east and south as pixels of the painted ground."""
    return metres / ground.metres_per_px + (len(ground.crop) - 1) / 2


def _parcels(rng: np.random.Generator, side: int, count: int) -> tuple[NDArray[np.int64], Field]:
    """Return the parcel index of each pixel, and its distance from the parcel's edge, px: a Voronoi diagram.

    Calculated on every fourth pixel; the tracks along the edges conceal the steps.
    """
    small = side // 4 + 1
    axis = np.arange(small, dtype=np.float32) * 4
    sites = rng.uniform(0, side, (count, 2)).astype(np.float32)
    nearest = np.full((small, small), np.inf, np.float32)
    second = nearest.copy()
    index = np.zeros((small, small), np.int64)
    for number, (site_x, site_y) in enumerate(sites):
        distance = np.hypot(axis[None, :] - site_x, axis[:, None] - site_y)
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        nearest = np.where(closer, distance, nearest)
        index[closer] = number
    edge = cv2.resize((second - nearest) / 2, (4 * small, 4 * small), interpolation=cv2.INTER_LINEAR)
    full = np.repeat(np.repeat(index, 4, axis=0), 4, axis=1)
    return full[:side, :side], np.asarray(edge[:side, :side], np.float32)


def _trees(rng: np.random.Generator, side: int, metre: float) -> Field:
    cover = np.zeros((side, side), np.float32)
    ragged = 0.35 * _noise(rng, side, 0.3 * metre)
    for _ in range(max(3, round((side / metre / 10) ** 2))):
        radius = rng.uniform(0.5, 1.2) * metre
        column, row = rng.uniform(0, side, 2)
        margin = 2 * radius
        x = np.arange(max(0, int(column - margin)), min(side, int(column + margin)))
        y = np.arange(max(0, int(row - margin)), min(side, int(row + margin)))
        window = np.ix_(y, x)
        inside = 1.2 * (1 - np.hypot(x[None, :] - column, y[:, None] - row) / radius) + ragged[window]
        cover[window] = np.maximum(cover[window], np.clip(4 * inside, 0, 1))
    return cover


def _noise(rng: np.random.Generator, side: int, grain_px: float) -> Field:
    """Return Gaussian noise (side, side) of mean 0 and standard deviation 1 with blobs `grain_px` wide."""
    reduction = max(1.0, grain_px / 2)
    small = max(8, int(np.ceil(side / reduction)))
    white = rng.normal(size=(small, small)).astype(np.float32)
    coarse = cv2.GaussianBlur(white, (0, 0), max(0.5, grain_px / reduction / 2))
    field = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray((field - field.mean()) / field.std(), np.float32)
