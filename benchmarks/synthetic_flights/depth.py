"""A synthetic capture of a scene with depth: what each lens sees, its files, and the exact truth per pixel.

A point of a scene has one place in each band's image, found by projection, so the truth needs no image. Lenses have
their own places, angles and distortion. A pixel is the mean of several rays, and each ray meets the nearest patch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.synthetic.cameras import BANDS, REFERENCE, BandSpec, CameraSpec, Exposure, MicaSenseCamera, Pose
from agalign.synthetic.flight import recorded
from agalign.synthetic.ground import Field
from synthetic_flights.patches import Eye, Hits, Patch, Textures, boxes_of, nearer, nearest, reflectances, sample

Mask = NDArray[np.bool_]

_SAMPLES = 4
"""Rays along each side of a pixel: the position of an edge is right to 1/8 px even along the pixel axes."""
_BLUR_PX = 0.45
"""Standard deviation of the lens's blur, which keeps sharp edges from aliasing."""
_SAME_SURFACE = 1e-6
"""Relative difference of depth below which two hits are the same point."""
_SUN = (0.35, -0.25, -0.90)
"""Direction to the light: east, south, down."""
_GLINT_POWER, _GLINT_SLOPE = 300.0, 0.05
"""Sharpness of a mirror-like reflection, and the slope of a glossy surface's waves (standard deviation)."""
_SEEN_THROUGH = 0.02
"""A pixel that a hand covers by more than this share does not show the scene."""

# Lens positions of a RedEdge-M, from the movement of its bands against Green.
_PLACES_M = (-0.030, 0.0), (0.0, 0.0), (0.0, -0.021), (-0.030, -0.021), (-0.015, -0.0105)
_BANDS = tuple(replace(band, baseline_m=place_m) for band, place_m in zip(BANDS, _PLACES_M, strict=True))
CLOSE_RANGE = MicaSenseCamera("RedEdge-M", _BANDS, REFERENCE)


@dataclass(frozen=True)
class Hand:
    """A large unsharp object just in front of one lens."""

    centre: tuple[float, float]
    """In shares of width and height."""
    radius: float
    """In shares of the width."""
    reflectance: float

    def cover(self, size_px: tuple[int, int]) -> Field:
        """Share (height, width) of the light that it takes from each pixel."""
        width, height = size_px
        x = np.arange(width) / width - self.centre[0]
        y = ((np.arange(height) / height - self.centre[1]) * height / width)[:, None]
        # Fingers: the outline is not a circle.
        outline = self.radius * (1 + 0.25 * np.sin(5 * np.arctan2(y, x)))
        return np.clip((outline - np.hypot(x, y)) / (0.4 * self.radius) + 0.5, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class Scene:
    """What a rig sees at one capture. Band names are the keys of the exceptions."""

    patches: tuple[Patch, ...]
    textures: Textures
    pose: Pose
    moved_m: Mapping[str, Mapping[int, tuple[float, float, float]]] = field(default_factory=dict)
    """How far each group of patches is from its place when a band is exposed."""
    poses: Mapping[str, Pose] = field(default_factory=dict)
    """Bands exposed from elsewhere."""
    others: Mapping[str, "Scene"] = field(default_factory=dict)
    """Bands that see another scene."""
    hands: Mapping[str, Hand] = field(default_factory=dict)

    def eye(self, band: BandSpec, size_px: tuple[int, int]) -> Eye:
        """The camera of a band."""
        return Eye(band, self.poses.get(band.name, self.pose), size_px)

    def at_exposure_of(self, band: BandSpec) -> tuple[Patch, ...]:
        """The patches where a band finds them."""
        by = self.moved_m.get(band.name, {})
        return tuple(p.moved(by[p.group]) if p.group in by else p for p in self.patches)


@dataclass(frozen=True)
class BandTruth:
    """The mapping reference -> moving band, for every pixel (height, width) of the reference."""

    moving_px: Field
    """(height, width, 2) raw px of the moving image; nan where the band shows another scene."""
    hidden: Mask
    """Occluded: something nearer hides the point from the band, or a hand does."""
    inside: Mask
    """The point is inside the moving image."""
    moved: Mask
    """The point moved between the exposures; `moving_px` follows it."""

    @property
    def visible(self) -> Mask:
        """Where the band shows the reference's point."""
        return self.inside & ~self.hidden

    @property
    def scored(self) -> Mask:
        """Visible and not moved: where a mapping of the static scene can be measured."""
        return self.visible & ~self.moved


@dataclass(frozen=True)
class Truth:
    """The geometry of a capture on the reference's raw pixels."""

    range_m: Field
    """(height, width): depth along the reference's optical axis."""
    bands: Mapping[str, BandTruth]


def view(scene: Scene, band: BandSpec, size_px: tuple[int, int]) -> Field:
    """Reflectances (height, width) as a band sees them, without vignetting and noise."""
    seen = scene.others.get(band.name, scene)
    eye, patches = seen.eye(band, size_px), seen.at_exposure_of(band)
    x, y = eye.rays(_SAMPLES)
    depth, light = np.full(x.shape, np.inf, np.float32), np.zeros(x.shape, np.float32)
    tiles = reflectances(seen.textures, band)
    for index, hits, window, closer in nearer(patches, eye, x, y, boxes_of(patches, eye, _SAMPLES), depth):
        tile, rays = tiles[patches[index].material], (x[window], y[window])
        light[window][closer] = _shaded(patches[index], hits, seen.textures, tile, eye, rays)[closer]
    mean = cv2.resize(cv2.GaussianBlur(light, (0, 0), _BLUR_PX * _SAMPLES), size_px, interpolation=cv2.INTER_AREA)
    if hand := scene.hands.get(band.name):
        cover = hand.cover(size_px)
        mean = mean * (1 - cover) + hand.reflectance * max(band.soil, band.crop) * cover
    return np.asarray(mean, np.float32)


def _shaded(patch: Patch, hits: Hits, textures: Textures, tile: Field, eye: Eye, rays: tuple[Field, Field]) -> Field:
    """Reflectance times light at hits (height, width) of a tile; misses have any value."""
    length_u, length_v = (float(np.linalg.norm(axis)) for axis in (patch.u_m, patch.v_m))
    # Rays that miss a small patch would sample far away, or at infinity.
    u, v = (np.clip(np.nan_to_num(at), -1, 1) for at in (hits.u, hits.v))
    offset_u, offset_v = (t % (len(tile) * textures.texel_m) for t in patch.texture_m)
    at_m, mean = (u * length_u + offset_u, v * length_v + offset_v, textures.texel_m), tile.mean()
    result = (mean + (sample(tile, *at_m) - mean) * np.float32(patch.contrast)) * np.float32(patch.shade)
    if not patch.gloss:
        return result
    slopes = [sample(w, *at_m) * np.float32(_GLINT_SLOPE) for w in textures.waves]
    along, across = np.array(patch.u_m) / length_u, np.array(patch.v_m) / length_v
    up = np.cross(along, across) * -np.sign(np.cross(along, across)[2])
    normal = up - slopes[0][..., None] * along - slopes[1][..., None] * across
    to_lens = -np.stack([*rays, np.ones_like(rays[0])], axis=-1) @ eye.attitude.T
    half = to_lens / np.linalg.norm(to_lens, axis=-1, keepdims=True) + np.array(_SUN) / np.linalg.norm(_SUN)
    cosine = (normal * half).sum(axis=-1) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(half, axis=-1)
    glint = patch.gloss * np.clip(cosine, 0, 1) ** _GLINT_POWER
    return np.asarray(result + glint * max(eye.band.soil, eye.band.crop), np.float32)


def truth_of(scene: Scene, size_px: tuple[int, int], camera: CameraSpec = CLOSE_RANGE) -> Truth:
    """The exact geometry of a capture."""
    reference = camera.bands[camera.reference]
    patches, eye = scene.at_exposure_of(reference), scene.eye(reference, size_px)
    seen = nearest(patches, eye, *eye.rays(), boxes_of(patches, eye))
    bands = {b.name: _band_truth(scene, b, eye, *seen) for b in camera.bands if b is not reference}
    return Truth(np.asarray(seen[0], np.float32), bands)


def _band_truth(scene: Scene, band: BandSpec, reference: Eye, depth: Field, index: NDArray[np.int32]) -> BandTruth:
    """The truth of a moving band; `depth` in m and `index` of the patch are what each pixel of the reference sees."""
    if band.name in scene.others:
        nothing = np.zeros(depth.shape, bool)
        return BandTruth(np.full((*depth.shape, 2), np.nan, np.float32), ~nothing, nothing, nothing)
    x, y = reference.rays()
    points = reference.to_world(np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None])
    before, after = (np.array([p.centre_m for p in scene.at_exposure_of(b)]) for b in (reference.band, band))
    by = (after - before)[index]
    eye = scene.eye(band, reference.size_px)
    there = eye.to_camera(points + by)
    there_px = eye.project(there)
    inside = ((there_px >= 0) & (there_px <= np.subtract(eye.size_px, 1))).all(axis=-1)
    # The ray from the band's lens to a point meets something nearer.
    patches, z = scene.at_exposure_of(band), there[..., 2]
    boxes = boxes_of(patches, reference, farther_px=_reach_px(scene, reference, eye, depth))
    hidden = nearest(patches, eye, there[..., 0] / z, there[..., 1] / z, boxes)[0] < z * (1 - _SAME_SURFACE)
    if hand := scene.hands.get(band.name):
        cover = cv2.remap(hand.cover(eye.size_px), there_px.astype(np.float32), None, cv2.INTER_LINEAR)
        hidden |= cover > _SEEN_THROUGH
    return BandTruth(there_px.astype(np.float32), hidden, inside, (by != 0).any(axis=-1))


def _reach_px(scene: Scene, reference: Eye, eye: Eye, depth: Field) -> float:
    """Largest distance in the reference's image between a point and what hides it from another lens: the difference of
    their disparities, and what moved between the exposures.
    """
    moved = [np.linalg.norm(by) for groups in scene.moved_m.values() for by in groups.values()]
    baseline_m = np.linalg.norm(eye.place_m - reference.place_m) + 2 * max(moved, default=0.0)
    # A hiding patch may be nearer than anything that the reference sees.
    return float(eye.model.fx_px * baseline_m * (1 / (0.7 * depth.min()) - 1 / depth.max()))


def write_capture(
    folder: Path,
    scene: Scene,
    number: int = 1,
    size_px: tuple[int, int] = (640, 480),
    rng_seed: int = 0,
    camera: CameraSpec = CLOSE_RANGE,
) -> Truth:
    """Write a file per band below `folder`, as a RedEdge does, and return the truth."""
    rng = np.random.default_rng(rng_seed)
    images = folder / "0000SET" / "000"
    images.mkdir(parents=True, exist_ok=True)
    exposure = Exposure(scene.pose, number, size_px)
    for band in camera.bands:
        pixels = recorded(view(scene, band, size_px), band, rng)
        camera.write_band(images / camera.file_name(band, number), pixels, band, exposure)
    return truth_of(scene, size_px, camera)
