"""A flight with the faults of a whole season, with its ground truth."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from agalign.synthetic.cameras import REDEDGE
from agalign.synthetic.flight import Shot, Spoil, write_shots
from agalign.synthetic.ground import Field, Ground, paint_ground
from agalign.synthetic.rig import CameraSpec, Pose
from synthetic_flights.cameras import MAVIC

_HEIGHT_M = 28.0
_SPEED_M_S = 8.0
_LINE = 8
"""Captures of a line, before the drone turns."""

Make = Callable[[np.random.Generator, Pose, tuple[int, int]], Shot]


def make_troubled_flight(
    folder: Path, captures: int = 60, size_px: tuple[int, int] = (1280, 960), rng_seed: int = 0
) -> Path:
    """Write a flight with faults in about half of its captures; its truth has the "trouble" of each, "" for none.
    Returns the path of truth.json, as `make_flight` does.
    """
    rng = np.random.default_rng(rng_seed)
    shots = [make(rng, _pose(rng, number), size_px) for number, make in enumerate(_plan(captures))]
    return write_shots(folder, shots, size_px, REDEDGE, rng)


def make_two_headings(
    folder: Path, captures: int = 24, size_px: tuple[int, int] = (1280, 960), rng_seed: int = 0,
    camera: CameraSpec = MAVIC, line: int = _LINE, *, lakes: bool = True,
) -> Path:  # fmt: skip
    """Write a flight of lines to and fro with the camera facing one way, by default one that exposes its bands one
    after another; with `lakes` the captures before and after each turn are over water.
    """
    rng = np.random.default_rng(rng_seed)
    shots = []
    for number in range(captures):
        speed = float(rng.normal(_SPEED_M_S, 0.5)) * (-1) ** (number // line)
        drift = float(rng.normal(0.0, 0.3))
        pose = replace(_pose(rng, number), yaw_deg=float(rng.normal(12.0, 1.5)), velocity_m_s=(drift, -speed))
        turns = lakes and number % line in (0, line - 1) and 0 < number < captures - 1
        ground = paint_ground(rng, [_above_the_origin(pose)], size_px, camera=camera)
        shots.append(_shot(pose, ground, *(("a lake",) if turns else ()), spoil=water if turns else None))
    return write_shots(folder, shots, size_px, camera, rng)


def _plan(captures: int) -> list[Make]:
    """What to make of each capture: troubles first and last where they belong, the others spread over the flight."""
    start: list[Make] = [_panel, _panel, *(_at(h, "take-off") for h in (4.0, 8.0, 13.0, 19.0))]
    end: list[Make] = [*(_at(h, "landing") for h in (15.0, 6.0)), _panel]
    between: list[Make] = [
        _spoilt("a lake", water), _spoilt("a lake", water), _spoilt("fog", fog), _spoilt("fog", fog),
        _spoilt("blur, 3 px", blur), _spoilt("blur, 3 px", blur), _spoilt("motion, 25 px", motion),
        _spoilt("noise, 30 %", noise), _spoilt("noise, 30 %", noise), _spoilt("half saturated", half_saturated),
        _planted, _planted, _planted, _terraces, _terraces, _without("NIR"), _spoilt("NIR lost", nothing, ("NIR",)),
        _spoilt("Blue lost", nothing, ("Blue",)),
    ]  # fmt: skip
    middle: list[Make] = [_plain] * max(0, captures - len(start) - len(end) - len(between))
    # Of each few captures one is troubled, the first few being good.
    mixed = list(_interleaved(middle, between))
    return [*start, *mixed, *end][:captures]


def _interleaved(many: list[Make], few: list[Make]) -> Iterator[Make]:
    spread = np.linspace(0, len(few), len(many) + 1)[1:].astype(int).tolist()
    given = 0
    for make, until in zip(many, spread, strict=True):
        yield make
        yield from few[given:until]
        given = until
    yield from few[given:]


def _pose(rng: np.random.Generator, number: int) -> Pose:
    return Pose(
        altitude_m=float(rng.normal(_HEIGHT_M, 0.7)), yaw_deg=float(rng.normal(0, 3)), roll_deg=float(rng.normal(0, 2)),
        pitch_deg=float(rng.normal(0, 2)), east_m=4.0 * (number % 10), north_m=4.0 * (number // 10),
    )  # fmt: skip


def _ground(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int], relief_m: float = 0.0) -> Ground:
    """Return the ground below one capture."""
    return paint_ground(rng, [_above_the_origin(pose)], size_px, relief_m)


def _above_the_origin(pose: Pose) -> Pose:
    """Return a separate ground for each capture, centred on it."""
    return replace(pose, east_m=0.0, north_m=0.0)


def _shot(pose: Pose, ground: Ground, trouble: str = "", **more: object) -> Shot:
    return replace(Shot(_above_the_origin(pose), ground, trouble=trouble), **more)  # type: ignore[arg-type]


def _plain(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
    return _shot(pose, _ground(rng, pose, size_px))


def _at(altitude_m: float, trouble: str) -> Make:
    def make(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
        low = replace(pose, altitude_m=altitude_m)
        return _shot(low, _ground(rng, low, size_px), trouble)

    return make


def _spoilt(trouble: str, spoil: Spoil, bands: tuple[str, ...] | None = None) -> Make:
    def make(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
        return _shot(pose, _ground(rng, pose, size_px), trouble, spoil=spoil, spoilt=bands)

    return make


def _without(band: str) -> Make:
    def make(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
        return _shot(pose, _ground(rng, pose, size_px), f"no {band}", without=(band,))

    return make


def _panel(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
    """The calibration panel on the ground, held under the camera a metre up."""
    low = replace(pose, altitude_m=1.0)
    ground = _ground(rng, low, size_px)
    axis = (np.arange(len(ground.crop)) - len(ground.crop) / 2) * ground.metres_per_px
    x, y = np.meshgrid(axis, axis)
    square = (np.abs(x) < 0.075) & (np.abs(y) < 0.075)
    frame = (np.abs(x) < 0.1) & (np.abs(y) < 0.1) & ~square
    brightness = np.where(square, 2.0, np.where(frame, 0.3, ground.brightness)).astype(np.float32)
    bare = square | frame
    crop, tree = (np.where(bare, np.float32(0), cover) for cover in (ground.crop, ground.tree))
    return _shot(low, replace(ground, brightness=brightness, crop=crop, tree=tree), "panel")


def _planted(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
    """An orchard: round trees on a lattice, 2.2 m apart, on mown grass."""
    ground = _ground(rng, pose, size_px)
    side, metre = len(ground.crop), 1 / ground.metres_per_px
    period, angle = 2.2 * metre, float(rng.uniform(0, np.pi))
    axis = np.arange(side, dtype=np.float32)
    along = (np.cos(angle) * axis[None, :] + np.sin(angle) * axis[:, None]) / period
    across = (np.cos(angle) * axis[:, None] - np.sin(angle) * axis[None, :]) / period
    row, column = np.floor(along).astype(int), np.floor(across).astype(int)
    # Each tree is a little off the lattice.
    jitter = 0.03 * rng.normal(size=(2, 512, 512)).astype(np.float32)
    off = np.hypot(along - row - 0.5 + jitter[0][row % 512, column % 512],
                   across - column - 0.5 + jitter[1][row % 512, column % 512])  # fmt: skip
    tree = expit(30 * (0.32 - off)).astype(np.float32)
    planted = replace(
        ground, tree=tree, crop=np.asarray(0.15 * (1 - tree), np.float32), brightness=0.9 + 0.1 * ground.brightness,
        vigour=0.2 * ground.vigour,
    )  # fmt: skip
    return _shot(pose, planted, "planted grid")


def _terraces(rng: np.random.Generator, pose: Pose, size_px: tuple[int, int]) -> Shot:
    return _shot(pose, _ground(rng, pose, size_px, relief_m=1.5), "terraces")


# ---- what becomes of the light


def water(light: Field, rng: np.random.Generator) -> Field:
    """Ripples that no two bands see alike: they move between the exposures, and mirror the sky."""
    ripples = cv2.GaussianBlur(rng.normal(size=light.shape).astype(np.float32), (0, 0), 3.0)
    return np.asarray(0.12 + 0.01 * ripples / ripples.std(), np.float32)


def nothing(light: Field, _rng: np.random.Generator) -> Field:
    """Return an image without light from the scene."""
    return np.full_like(light, 0.1)


def fog(light: Field, _rng: np.random.Generator) -> Field:
    """A veil that takes most of the contrast, and some of the sharpness."""
    return np.asarray(0.4 + 0.15 * cv2.GaussianBlur(light, (0, 0), 1.5), np.float32)


def blur(light: Field, _rng: np.random.Generator) -> Field:
    """Defocus by 3 px."""
    return np.asarray(cv2.GaussianBlur(light, (0, 0), 3.0))


def motion(light: Field, _rng: np.random.Generator) -> Field:
    """Motion blur of 25 px along x."""
    return np.asarray(cv2.filter2D(light, -1, np.full((1, 25), 1 / 25, np.float32)))


def noise(light: Field, rng: np.random.Generator) -> Field:
    """Noise of 30 % of the range of the light."""
    low, high = np.percentile(light, (1, 99))
    return np.asarray(light + 0.3 * (high - low) * rng.normal(size=light.shape), np.float32)


def half_saturated(light: Field, _rng: np.random.Generator) -> Field:
    """Exposed so that the brighter half is 1 or more."""
    return np.asarray(light / np.median(light))
