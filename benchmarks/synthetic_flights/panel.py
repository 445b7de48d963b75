"""A synthetic flight between two captures of a calibration panel, while the sun goes down."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from agalign.synthetic.cameras import REDEDGE, Pose
from agalign.synthetic.flight import Shot, write_shots
from agalign.synthetic.ground import Field, Ground, paint_ground

PANEL_CODE, PANEL_ALBEDO = "RP04-0000001-SY_04005101000510", 0.51
"""51.0 % at 400 nm and at 1000 nm."""
_CASE, _LABEL, _INK = 0.03, 0.85, 0.04
_SQUARE_M, _CODE_M, _APART_M = 0.15, 0.135, 0.21
_HELD_M = 1.0
_SHUTTER = 0.12
"""A panel is brighter than crops."""
_HEIGHT_M = 28.0


def make_flight_between_panels(
    folder: Path, captures: int = 3, size_px: tuple[int, int] = (1280, 960), sun: tuple[float, float] = (1.0, 0.7)
) -> Path:
    """Write the panel, a flight, and the panel again; the sun goes from the one brightness to the other, linearly, and
    the light sensor does not see it. Returns the path of truth.json, as `make_flight` does.
    """
    rng = np.random.default_rng(0)
    poses = [
        Pose(_HEIGHT_M + float(rng.normal(0, 0.7)), float(rng.normal(0, 3)), 0.0, 0.0, 4.0 * k, 0.0)
        for k in range(captures)
    ]
    field = paint_ground(rng, poses, size_px, camera=REDEDGE)
    held = Pose(_HELD_M, 0.0, 0.0, 0.0, 0.0, 0.0)
    table = with_panel(paint_ground(rng, [held], size_px, camera=REDEDGE))
    panel = Shot(held, table, trouble="panel", shutter=_SHUTTER)
    shots = [panel, *(Shot(pose, field) for pose in poses), panel]
    brightness = np.linspace(*sun, len(shots))
    return write_shots(
        folder, [replace(s, sun=float(b)) for s, b in zip(shots, brightness, strict=True)], size_px, REDEDGE, rng
    )


def with_panel(ground: Ground) -> Ground:
    """The ground with an opened panel on it: a grey square and, right of it, its code on a label, in a black case."""
    side = len(ground.crop)
    axis = (np.arange(side) - (side - 1) / 2) * ground.metres_per_px
    x, y = axis[None, :] + _APART_M / 2, axis[:, None]
    overlay = np.full((side, side), np.nan, np.float32)
    overlay[(np.abs(x - _APART_M / 2) < 0.24) & (np.abs(y) < 0.15)] = _CASE
    overlay[_within(x, y, _SQUARE_M)] = PANEL_ALBEDO
    overlay[_within(x - _APART_M, y, 1.3 * _CODE_M)] = _LABEL
    here = _within(x - _APART_M, y, _CODE_M)
    rows, columns = np.flatnonzero(here.any(axis=1)), np.flatnonzero(here.any(axis=0))
    overlay[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = _code(len(columns), len(rows))
    return replace(ground, overlay=overlay)


def _within(x: Field, y: Field, side_m: float) -> Field:
    return np.asarray((np.abs(x) < side_m / 2) & (np.abs(y) < side_m / 2))


def _code(width: int, height: int) -> Field:
    """(height, width) reflectance of the QR code."""
    drawn = cv2.QRCodeEncoder.create().encode(PANEL_CODE)
    enlarged = cv2.resize(drawn, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(enlarged > 127, np.float32(_LABEL), np.float32(_INK))
