"""Flights with the faults of a season, on two headings, and between calibration panels, with their ground truth."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.special import expit

from agalign.synthetic.cameras import REDEDGE, CameraSpec, Pose
from agalign.synthetic.flight import Shot, plan_flight, write_shots
from agalign.synthetic.ground import Field, Ground, paint_ground
from synthetic_flights.cameras import MAVIC

PANEL_CODE, PANEL_ALBEDO = "RP04-0000001-SY_04005101000510", 0.51
"""51.0 % at 400 nm and at 1000 nm."""
_CASE, _LABEL, _INK = 0.03, 0.85, 0.04
_SQUARE_M, _CODE_M, _APART_M = 0.15, 0.135, 0.21
_HELD_M = 1.0
_SHUTTER = 0.12
"""A panel is brighter than crops."""
_HEIGHT_M = 28.0
_SPEED_M_S = 8.0
_LINE = 8
"""Captures of a line, before the drone turns."""


def make_troubled_flight(
    folder: Path, captures: int = 60, size_px: tuple[int, int] = (1280, 960), rng_seed: int = 0
) -> Path:
    """Write a flight with faults in about half of its captures; its truth has the "trouble" of each, "" for none.
    Returns the path of truth.json, as `make_flight` does.
    """
    rng = np.random.default_rng(rng_seed)
    shots = [_shot(rng, _pose(rng, number), size_px, **what) for number, what in enumerate(_plan(captures))]
    return write_shots(folder, shots, size_px, REDEDGE, rng)


def make_two_headings(
    folder: Path,
    captures: int = 24,
    size_px: tuple[int, int] = (1280, 960),
    rng_seed: int = 0,
    camera: CameraSpec = MAVIC,
    line: int = _LINE,
    *,
    lakes: bool = True,
) -> Path:
    """Write a flight of lines to and fro with the camera facing one way, by default one that exposes its bands one
    after another; with `lakes` the captures before and after each turn are over water.
    """
    rng = np.random.default_rng(rng_seed)
    lake, shots = {"trouble": "a lake", "degrade": water}, []
    for number in range(captures):
        speed, drift = rng.normal(_SPEED_M_S, 0.5) * (-1) ** (number // line), rng.normal(0.0, 0.3)
        pose = replace(_pose(rng, number), yaw_deg=rng.normal(12.0, 1.5), velocity_m_s=(drift, -speed))
        turns = lakes and number % line in (0, line - 1) and 0 < number < captures - 1
        shots.append(_shot(rng, pose, size_px, camera, **(lake if turns else {})))
    return write_shots(folder, shots, size_px, camera, rng)


def make_terraces(folder: Path, size_px: tuple[int, int], rng_seed: int, relief_m: float) -> Path:
    """Write a capture of terraces. The homographies of its truth are those of the plane below them, and the tie points
    include the relief. Returns the path of truth.json, as `make_flight` does.
    """
    rng = np.random.default_rng(rng_seed)
    (pose,), ground = plan_flight(rng, 1, size_px)
    return write_shots(folder, [Shot(pose, _terraces(rng, ground, relief_m))], size_px, REDEDGE, rng)


def make_flight_between_panels(folder: Path, captures: int, size_px: tuple[int, int], sun: tuple[float, float]) -> Path:
    """Write the panel, a flight, and the panel again; the sun goes from the one brightness to the other, linearly, and
    the light sensor does not see it. Returns the path of truth.json, as `make_flight` does.
    """
    rng = np.random.default_rng(0)
    heights_and_yaws = [(_HEIGHT_M + rng.normal(0, 0.7), rng.normal(0, 3)) for _ in range(captures)]
    poses = [Pose(height_m, yaw_deg, 0.0, 0.0, 4.0 * k, 0.0) for k, (height_m, yaw_deg) in enumerate(heights_and_yaws)]
    field = paint_ground(rng, poses, size_px, camera=REDEDGE)
    held = Pose(_HELD_M, 0.0, 0.0, 0.0, 0.0, 0.0)
    panel = Shot(
        held, with_panel(paint_ground(rng, [held], size_px, camera=REDEDGE)), trouble="panel", shutter=_SHUTTER
    )
    shots = [panel, *(Shot(pose, field) for pose in poses), panel]
    lit = [replace(s, sun=b) for s, b in zip(shots, np.linspace(*sun, len(shots)).tolist(), strict=True)]
    return write_shots(folder, lit, size_px, REDEDGE, rng)


def _plan(captures: int) -> list[dict[str, Any]]:
    """What is special in each capture, as options of `_shot`: troubles first and last where they belong, the others
    spread over the flight.
    """
    panel = {"trouble": "panel", "altitude_m": 1.0, "change": _with_plain_panel}
    start = [panel, panel, *({"trouble": "take-off", "altitude_m": height_m} for height_m in (4.0, 8.0, 13.0, 19.0))]
    end = [*({"trouble": "landing", "altitude_m": height_m} for height_m in (15.0, 6.0)), panel]
    degraded = {"a lake": water, "fog": fog, "blur, 3 px": blur, "motion, 25 px": motion, "noise, 30 %": noise}
    degraded |= {"half saturated": half_saturated}
    between: list[dict[str, Any]] = []
    for name, by in degraded.items():
        between += [{"trouble": name, "degrade": by}] * (1 if by in (motion, half_saturated) else 2)
    between += [{"trouble": "planted grid", "change": _orchard}] * 3
    between += [{"trouble": "terraces", "change": partial(_terraces, relief_m=1.5)}] * 2
    between += [{"trouble": "no NIR", "without": ("NIR",)}]
    for band in ("NIR", "Blue"):
        between += [{"trouble": f"{band} lost", "degrade": nothing, "degraded_bands": (band,)}]
    plain = max(0, captures - len(start) - len(end) - len(between))
    # One of every few captures is degraded, the first few being good.
    until = np.linspace(0, len(between), plain + 1).astype(int).tolist()
    mixed = [what for k in range(plain) for what in ({}, *between[until[k] : until[k + 1]])]
    return [*start, *mixed, *between[until[-1] :], *end][:captures]


def _pose(rng: np.random.Generator, number: int) -> Pose:
    altitude_m, *angles_deg = rng.normal((_HEIGHT_M, 0, 0, 0), (0.7, 3, 2, 2)).tolist()
    return Pose(altitude_m, *angles_deg, 4.0 * (number % 10), 4.0 * (number // 10))


def _shot(
    rng: np.random.Generator,
    pose: Pose,
    size_px: tuple[int, int],
    camera: CameraSpec = REDEDGE,
    altitude_m: float | None = None,
    change: Callable[[np.random.Generator, Ground], Ground] | None = None,
    **more: Any,
) -> Shot:
    """A capture over its own ground, which is centred on it. `more` are fields of Shot."""
    pose = replace(pose, altitude_m=altitude_m or pose.altitude_m, east_m=0.0, north_m=0.0)
    ground = paint_ground(rng, [pose], size_px, camera)
    return Shot(pose, change(rng, ground) if change else ground, **more)


def _with_plain_panel(_rng: np.random.Generator, ground: Ground) -> Ground:
    """A calibration panel without a code on the ground."""
    axis = (np.arange(len(ground.crop)) - len(ground.crop) / 2) * ground.metres_per_px
    distance = np.maximum(*np.abs(np.meshgrid(axis, axis)))
    bare, square = distance < 0.1, distance < 0.075
    brightness = np.where(square, 2.0, np.where(bare, 0.3, ground.brightness)).astype(np.float32)
    crop, tree = (np.where(bare, np.float32(0), cover) for cover in (ground.crop, ground.tree))
    return replace(ground, brightness=brightness, crop=crop, tree=tree)


def _terraces(rng: np.random.Generator, ground: Ground, relief_m: float) -> Ground:
    """Three levels connected by slopes, `relief_m` apart, with round trees half as high.

    Slopes are gentle enough to cause no occlusions, which cannot be aligned.
    """
    terrace_m, metre = 8.0, 1 / ground.metres_per_px
    along, _ = _turned_grid(len(ground.tree), rng.uniform(0, np.pi), terrace_m * metre)
    slope = np.clip((along % 1 - 0.4) / 0.6, 0, 1)
    level = np.floor(along) + slope * slope * (3 - 2 * slope)
    crowns = cv2.GaussianBlur(ground.tree, (0, 0), 0.4 * metre)
    return replace(ground, height_m=np.asarray(relief_m * (np.abs(level % 4 - 2) + 0.5 * crowns), np.float32))


def _orchard(rng: np.random.Generator, ground: Ground) -> Ground:
    """Round trees on a lattice, 2.2 m apart, on mown grass."""
    along, across = _turned_grid(len(ground.crop), rng.uniform(0, np.pi), 2.2 / ground.metres_per_px)
    row, column = np.floor(along).astype(int), np.floor(across).astype(int)
    # Each tree is a little off the lattice.
    jitter = 0.03 * rng.normal(size=(2, 512, 512)).astype(np.float32)[:, row % 512, column % 512]
    off = np.hypot(along - row - 0.5 + jitter[0], across - column - 0.5 + jitter[1])
    tree = expit(30 * (0.32 - off)).astype(np.float32)
    covers = {"tree": tree, "crop": np.asarray(0.15 * (1 - tree), np.float32)}
    return replace(ground, **covers, brightness=0.9 + 0.1 * ground.brightness, vigour=0.2 * ground.vigour)


def _turned_grid(side: int, angle: float, period_px: float) -> tuple[Field, Field]:
    """Coordinates (side, side) of the pixels of a ground along an angle and across, in periods."""
    x, y = np.arange(side) / period_px, np.arange(side)[:, None] / period_px
    return np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x


# ---- the panel


def with_panel(ground: Ground) -> Ground:
    """The ground with an opened panel on it: a grey square and, right of it, its code on a label, in a black case."""
    overlay = np.full(ground.crop.shape, np.nan, np.float32)
    axis_m = (np.arange(len(overlay)) - (len(overlay) - 1) / 2) * ground.metres_per_px

    def rectangle(x_m: float, width_m: float, height_m: float) -> tuple[slice, slice]:
        """Rows and columns of a rectangle with its centre so far to the right of the middle."""
        rows, columns = (
            np.flatnonzero(np.abs(axis_m - at_m) < length_m / 2) for at_m, length_m in ((0, height_m), (x_m, width_m))
        )
        return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    overlay[rectangle(0, 0.48, 0.3)] = _CASE
    overlay[rectangle(-_APART_M / 2, _SQUARE_M, _SQUARE_M)] = PANEL_ALBEDO
    overlay[rectangle(_APART_M / 2, 1.3 * _CODE_M, 1.3 * _CODE_M)] = _LABEL
    code = overlay[rectangle(_APART_M / 2, _CODE_M, _CODE_M)]
    drawn = cv2.resize(cv2.QRCodeEncoder.create().encode(PANEL_CODE), code.shape[::-1], interpolation=cv2.INTER_NEAREST)
    code[:] = np.where(drawn > 127, _LABEL, _INK)
    return replace(ground, overlay=overlay)


# ---- changes of the light


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
