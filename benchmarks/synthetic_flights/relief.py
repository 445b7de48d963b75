"""Scenes with depth, and captures of them that are made to fool, each from a seed.

Lengths are shares of the range to the lowest surface, so that a scene close by and one 20 m away look alike; the relief
far away is lower.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agalign.synthetic.cameras import FOCAL_LENGTH_MM, PIXELS_PER_MM, Pose
from synthetic_flights.depth import CLOSE_RANGE, Hand, Scene
from synthetic_flights.patches import Patch, make_textures

CLOSE_M, FAR_M = (1.2, 2.0), (18.0, 22.0)
"""Range to the lowest surface."""
GEOMETRIES = ("flat", "terraces", "plants", "boxes")
FOOLING = ("pots", "wind", "hand", "glossy", "other scene", "other time")
_CLOSE_SHARE = 0.6
"""Of the fooling scenes; the others are 20 m away."""

_NEAREST_SHARE = 0.55
"""Range of the highest objects as a share of the range to the floor: sets the size of a texel."""
_VIEW = 1.9
"""Half the side of the floor, in ranges: the camera sees less at any tilt."""
_TILT_DEG = 2.0
_CONTRAST = 0.25, 1.0
"""Share of a material's full contrast that a surface has: some surfaces are nearly uniform."""
_WIND_PX, _WIND_SHARE = (2.0, 8.0), (0.25, 0.5)
"""Movement of a plant between two exposures in px of a 640 px image, and the share of the plants that move."""
_OTHER_TIME_SHARE = (0.03, 0.10)
"""Movement of the rig between two exposures, in ranges."""
_MOVING = tuple(b.name for i, b in enumerate(CLOSE_RANGE.bands) if i != CLOSE_RANGE.reference)

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Site:
    """Where a scene is built: random numbers, the range to the floor, and how much of it the relief may take."""

    rng: np.random.Generator
    range_m: float
    close: bool

    def relief(self) -> float:
        """A height of the highest surface that carries others, in ranges."""
        # Trees of 3-5 m are a quarter of 20 m.
        return self.rng.uniform(0.22, 0.38) if self.close else self.rng.uniform(0.12, 0.26)

    def patch(self, centre: ArrayLike, u: ArrayLike, v: ArrayLike, material: str, **more: Any) -> Patch:
        """A patch from lengths in ranges, with x east, y south and z up; textures differ from patch to patch."""
        axes_m = (tuple((np.array(axis) * (1, 1, -1) * self.range_m).tolist()) for axis in (centre, u, v))
        random = {"texture_m": tuple(self.rng.uniform(0, 10 * self.range_m, 2).tolist())}
        random["contrast"] = self.rng.uniform(*_CONTRAST)
        return Patch(*axes_m, material, **(random | more))

    def floor(self, height: float, material: str, **more: Any) -> Patch:
        """A horizontal surface that fills the image, at any angle to it."""
        u, v = (_VIEW * axis for axis in axes(self.rng.uniform(0, np.pi)))
        return self.patch((0, 0, height), (*u, 0), (*v, 0), material, **more)

    def places(self, count: int, apart: float, half_x: float = 0.55, half_y: float = 0.45) -> list[Vector]:
        """Up to `count` places, no two closer than `apart`."""
        result: list[Vector] = []
        for _ in range(20 * count):
            place = self.rng.uniform((-half_x, -half_y), (half_x, half_y))
            if len(result) < count and all(np.hypot(*(place - other)) > apart for other in result):
                result.append(place)
        return result


def axes(angle: float) -> tuple[Vector, Vector]:
    """Unit vectors along an angle, and perpendicular to it."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c, s]), np.array([-s, c])


# ---- what scenes consist of


def box(
    site: Site, centre: Sequence[float], half: Sequence[float], angle: float, material: str, **more: Any
) -> list[Patch]:
    """The top and the four walls of a box with its base at `centre`; `half` is half its length, half its width, and its
    height.
    """
    x, y, base = centre
    a, b = (length * axis for length, axis in zip(half, axes(angle), strict=False))
    patches = [site.patch((x, y, base + half[2]), (*a, 0), (*b, 0), material, **more)]
    for out, along in ((a, b), (b, a), (-a, b), (-b, a)):
        shade = 0.62 + 0.2 * float(out @ (0.8, -0.6)) / float(np.hypot(*out))
        middle = (x + out[0], y + out[1], base + half[2] / 2)
        patches.append(site.patch(middle, (*along, 0), (0, 0, half[2] / 2), material, **{"shade": shade, **more}))
    return patches


def plant(
    site: Site, centre: Sequence[float], size: float, height: float, leaves: tuple[int, int] = (9, 16), **more: Any
) -> list[Patch]:
    """Leaves around a stem, at several heights and tilts, the higher ones shorter; their number is in a range."""
    result, uniform = [], site.rng.uniform
    count = site.rng.integers(*leaves)
    turn = uniform(0, 2 * np.pi)
    for number in range(count):
        at = (number + 0.5) / count
        out, side = axes(turn + 2.4 * number)  # the golden angle: leaves do not cover each other
        length = size * (1 - 0.5 * at) * uniform(0.8, 1.2) / 2
        tilt = uniform(-0.5, 0.3)
        u = length * np.array([*(np.cos(tilt) * out), np.sin(tilt)])
        roll = uniform(-0.4, 0.4)
        lift = np.array([*(-np.sin(tilt) * out), np.cos(tilt)])
        v = 0.38 * length * (np.cos(roll) * np.array([*side, 0.0]) + np.sin(roll) * lift)
        middle = np.array(centre) + (0, 0, height * at) + u * 0.95
        shade = 0.7 + 0.3 * at + uniform(-0.1, 0.1)
        result.append(site.patch(middle, u, v, "leaf", shape="leaf", shade=shade, **more))
    return result


# ---- the kinds


def _flat(site: Site) -> list[Patch]:
    return [site.floor(0, "field")]


def _terraces(site: Site) -> list[Patch]:
    """Long level steps up and down again, with banks of any slope between them."""
    (down, along), width = axes(site.rng.uniform(0, np.pi)), site.rng.uniform(0.16, 0.24)
    step, bank = site.relief() / 3, site.rng.uniform(0.0, 0.06)
    levels = [0, 1, 2, 3, 2, 1] if site.rng.random() < 0.5 else [0, 1, 2, 3]
    offset = site.rng.integers(len(levels))
    half = (*(_VIEW * along), 0)
    result = []
    for number in range(-6, 7):
        here, there = (step * levels[(number + k + offset) % len(levels)] for k in (0, 1))
        tread = (width - bank) / 2 * down
        material = str(site.rng.choice(["field", "soil"]))
        result.append(site.patch((*(number * width * down), here), (*tread, 0), half, material))
        middle = (*((number + 0.5) * width * down), (here + there) / 2)
        slope = (*(bank / 2 * down), (there - here) / 2)
        result.append(site.patch(middle, slope, half, "soil", shade=0.8))
    return result


def _plants(site: Site, gloss: float = 0.0) -> list[Patch]:
    """Tall plants of different heights over soil."""
    result = [site.floor(0, "soil")]
    height, size = site.relief(), site.rng.uniform(0.14, 0.2)
    for group, place in enumerate(site.places(site.rng.integers(14, 30), 0.55 * size), start=1):
        result += plant(site, (*place, 0), size, height * site.rng.uniform(0.5, 1.1), group=group, gloss=gloss)
    return result


def _boxes(site: Site, gloss: float = 0.0) -> list[Patch]:
    """Boxes on a bench above a floor, and on the floor."""
    uniform = site.rng.uniform
    bench, angle = site.relief(), uniform(0, np.pi)
    along, across = axes(angle)
    end = uniform(-0.15, 0.15) * along + uniform(0.1, 0.3) * across
    result = [site.floor(0, "concrete")]
    half_width = uniform(0.2, 0.28)
    result += box(site, (*end, 0.9 * bench), (1.2, half_width, 0.1 * bench), angle, "bench")
    for place in site.places(16, 0.13, 0.5, 0.4):
        away = abs((place - end) @ across)
        size = uniform(0.03, 0.07), uniform(0.03, 0.07), bench * 0.5 * uniform(0.3, 1.0)
        if abs(away - half_width) > 0.1:
            base = bench if away < half_width else 0.0
            material = str(site.rng.choice(["box", "plastic", "concrete"], p=[0.6, 0.2, 0.2]))
            result += box(site, (*place, base), size, uniform(0, np.pi), material, gloss=gloss)
    return result


def _pots(site: Site) -> list[Patch]:
    """A bench with a regular grid of identical pots and seedlings."""
    pitch, angle = site.rng.uniform(0.06, 0.1), site.rng.uniform(0, np.pi)
    same_seed = site.rng.integers(2**31)
    result = [site.floor(0, "plastic", shade=0.6)]
    along, across = axes(angle)
    many = int(0.6 / pitch)
    for row, column in product(range(-many, many + 1), repeat=2):
        same = replace(site, rng=np.random.default_rng(same_seed))
        x, y = column * pitch * along + row * pitch * across
        if abs(x) < 0.58 and abs(y) < 0.48:
            height = 0.6 * pitch
            result += box(same, (x, y, 0), (0.36 * pitch, 0.36 * pitch, height), angle, "box")
            result += plant(same, (x, y, height), 0.7 * pitch, 0.7 * pitch, leaves=(5, 7))
    return result


_KINDS = {"flat": _flat, "terraces": _terraces, "plants": _plants, "boxes": _boxes, "pots": _pots}


def make_scene(kind: str, rng_seed: int, *, close: bool = True, width_px: int = 640) -> Scene:
    """A scene of `GEOMETRIES` or `FOOLING`. `width_px` of the images decides how fine the textures are."""
    if kind not in (*GEOMETRIES, *FOOLING):
        raise ValueError(f"unknown kind '{kind}'; choose from {', '.join((*GEOMETRIES, *FOOLING))}")
    rng = np.random.default_rng(rng_seed)
    site = Site(rng, rng.uniform(*(CLOSE_M if close else FAR_M)), close)
    focal_px = FOCAL_LENGTH_MM * PIXELS_PER_MM * width_px / 1280
    textures = make_textures(rng, site.range_m * _NEAREST_SHARE / focal_px / 2, width_px)
    roll, pitch = rng.normal(0, _TILT_DEG, 2).tolist()
    pose = Pose(site.range_m, rng.uniform(-180, 180), roll, pitch, 0.0, 0.0)
    if kind == "glossy":
        make = _plants if rng.random() < 0.5 else _boxes
        return Scene(tuple(make(site, rng.uniform(1.0, 3.0))), textures, pose)
    geometry = kind if kind in _KINDS else "plants" if kind == "wind" else rng.choice(["plants", "boxes", "terraces"])
    scene = Scene(tuple(_KINDS[geometry](site)), textures, pose)
    if kind in _KINDS:
        return scene
    if kind == "wind":
        return _in_wind(scene, site)
    band = str(rng.choice(_MOVING))
    if kind == "hand":
        centre = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9)
        return replace(scene, hands={band: Hand(centre, rng.uniform(0.2, 0.4), rng.uniform(0.3, 1.2))})
    if kind == "other scene":
        other = make_scene(rng.choice(GEOMETRIES), rng.integers(2**31), close=close, width_px=width_px)
        return replace(scene, others={band: other})
    east, north = (float(rng.uniform(*_OTHER_TIME_SHARE) * site.range_m * rng.choice([-1, 1])) for _ in range(2))
    later = replace(pose, east_m=east, north_m=north, yaw_deg=pose.yaw_deg + rng.uniform(-3, 3))
    return replace(scene, poses={band: later})


def _in_wind(scene: Scene, site: Site) -> Scene:
    """A share of the plants has another place at each band's exposure."""
    groups = sorted({p.group for p in scene.patches} - {0})
    share = site.rng.uniform(*_WIND_SHARE)
    moving = [g for g in groups if site.rng.random() < share]
    pixel_m = site.range_m / (FOCAL_LENGTH_MM * PIXELS_PER_MM / 2)
    moved: dict[str, dict[int, tuple[float, float, float]]] = {band: {} for band in _MOVING}
    for by, group in product(moved.values(), moving):
        length, (direction, _) = site.rng.uniform(*_WIND_PX) * pixel_m, axes(site.rng.uniform(0, 2 * np.pi))
        by[group] = (*(length * direction).tolist(), 0.0)
    return replace(scene, moved_m=moved)


def fooling(number: int) -> tuple[str, bool]:
    """(kind, whether it is close) of the scene of a number, which is also its seed: the kinds in turn, three of five
    close by.
    """
    return FOOLING[number % len(FOOLING)], (number // len(FOOLING)) % 5 < 5 * _CLOSE_SHARE
