"""Drawings of the rig of a flight, in the units of their SVGs."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np

from agalign.errors import InputError
from agalign.flight.rig import Rig
from agalign.flight.rig_file import read_rig
from agalign.flight.rig_prediction import band_summaries
from agalign.products.report.facts import CaptureEntry
from agalign.values import geometry

PLAN_WIDTH, FIELD_WIDTH, CHART_WIDTH, CHART_HEIGHT = 200.0, 160.0, 640.0, 130.0
_FIELD_REACH = 11.0
"""Of the longest arrow of a lens field."""
_FIELD_COLUMNS, _FIELD_ROWS = 13, 10
_MIN_SPREAD_PX = 0.2
_MAX_POINTS = 400


@dataclass(frozen=True)
class BandView:
    """A band of a rig: position of its lens relative to the reference's, and residuals of the lens model."""

    name: str
    hue: float
    x: float
    y: float
    offset_px: tuple[float, float]
    from_bands_px: float
    from_flight_px: float
    field_px: float | None
    arrows: tuple[tuple[float, float, float, float], ...]
    """x1, y1, x2, y2."""


@dataclass(frozen=True)
class RigView:
    """The rig of a camera in a flight."""

    camera: str
    captures: int
    shared: str
    field_height: float
    bands: tuple[BandView, ...]


@dataclass(frozen=True)
class Line:
    """One band over a flight: how far it is from its median, along the direction in which it moves most."""

    name: str
    hue: float
    points: tuple[str, ...]
    """Runs of points of captures in which the band is known, as an SVG takes them."""


@dataclass(frozen=True)
class Drift:
    """The bands of a camera from capture to capture."""

    camera: str
    full_px: float
    """The largest distance; 0.92 of the way from the middle to the edges of the chart."""
    captures: int
    lines: tuple[Line, ...]
    first: str
    """Label of the first capture,"""
    last: str
    """and of the last."""


def rig_views(out: Path, on_problem: Callable[[str], None]) -> list[RigView]:
    """Of the models below OUT/models; what cannot be read is reported to `on_problem`."""
    views = []
    for path in sorted((out / "models").glob("*.safetensors")):
        try:
            _, rig = read_rig(path)
        except InputError as error:
            on_problem(str(error))
            continue
        if rig is not None:
            views.append(_rig_view(path.stem, rig))
    return views


def _rig_view(camera: str, rig: Rig) -> RigView:
    rows = band_summaries(rig)
    reach = max((math.hypot(*r["baseline"]) for r in rows), default=0.0) or 1.0
    to_plan = 0.36 * PLAN_WIDTH / reach
    width, height = rig.size_px
    bands = []
    for number, row in enumerate(rows):
        x, y = (PLAN_WIDTH / 2 + to_plan * v for v in row["baseline"])
        bands.append(
            BandView(
                row["band"], hue_of(number, len(rows)), x, y, tuple(row["offset_px"]), row["from_bands_px"],
                row["from_flight_px"], row["field_px"], _arrows(rig, row["band"]),
            )
        )  # fmt: skip
    shared = ", ".join(rig.factors) or "nothing"
    return RigView(camera, len(rig.captures), shared, FIELD_WIDTH * height / width, tuple(bands))


def _arrows(rig: Rig, band: str) -> tuple[tuple[float, float, float, float], ...]:
    if band not in rig.fields:
        return ()
    points = geometry.lattice(*rig.size_px, _FIELD_COLUMNS, _FIELD_ROWS)
    scale = FIELD_WIDTH / rig.size_px[0]
    field = rig.fields[band](points)
    begins, reach = points * scale, field * _FIELD_REACH / max(float(np.linalg.norm(field, axis=1).max()), 1e-6)
    return tuple((x, y, x + dx, y + dy) for (x, y), (dx, dy) in zip(begins.tolist(), reach.tolist(), strict=True))


def hue_of(number: int, count: int) -> float:
    """Colours that lie apart."""
    return round(205 + 360 * number / max(count, 1)) % 360


def drifts_of(captures: Sequence[CaptureEntry]) -> list[Drift]:
    """A chart for each camera that took three captures or more, in the order in which they were taken."""
    result = []
    for camera in dict.fromkeys(c.camera for c in captures):
        mine = sorted((c for c in captures if c.camera == camera), key=lambda c: (c.captured_at, c.label))
        names = list(dict.fromkeys(name for c in mine for name in c.offsets_px))
        if len(mine) >= 3 and names:
            result.append(_drift(camera, mine, names))
    return result


def _drift(camera: str, captures: Sequence[CaptureEntry], names: Sequence[str]) -> Drift:
    along = {name: _along([c.offsets_px.get(name) for c in captures]) for name in names}
    # The sign of a direction is arbitrary: the same for all as for the first band.
    first = along[names[0]]
    along = {name: values if _together(first, values) else [None if v is None else -v for v in values]
             for name, values in along.items()}  # fmt: skip
    full = max([_MIN_SPREAD_PX, *(abs(v) for values in along.values() for v in values if v is not None)])
    step = max(1, math.ceil(len(captures) / _MAX_POINTS))
    lines = tuple(
        Line(name, hue_of(number, len(names)), _runs(along[name], full, step)) for number, name in enumerate(names)
    )
    return Drift(camera, full, len(captures), lines, captures[0].label, captures[-1].label)


def _along(offsets: Sequence[tuple[float, float] | None]) -> list[float | None]:
    """Distances from the median along the direction of most change, with its sign."""
    known = [o for o in offsets if o is not None]
    middle = np.array([median(o[0] for o in known), median(o[1] for o in known)])
    _, _, directions = np.linalg.svd(np.array(known) - middle)
    return [None if o is None else float((np.array(o) - middle) @ directions[0]) for o in offsets]


def _together(one: Sequence[float | None], other: Sequence[float | None]) -> bool:
    return sum(a * b for a, b in zip(one, other, strict=True) if a is not None and b is not None) >= 0


def _runs(values: Sequence[float | None], full: float, step: int) -> tuple[str, ...]:
    """Pieces of a line; of many captures the mean of so many that follow each other."""
    parts = [[v for v in values[i : i + step] if v is not None] for i in range(0, len(values), step)]
    places = [
        None if not part else (
            CHART_WIDTH * (i + 0.5) / len(parts), CHART_HEIGHT / 2 * (1 - 0.92 * sum(part) / len(part) / full),
        )
        for i, part in enumerate(parts)
    ]  # fmt: skip
    runs: list[list[str]] = [[]]
    for before, here in pairwise([None, *places]):
        if here is None:
            continue
        if before is None and runs[-1]:
            runs.append([])
        runs[-1].append(f"{here[0]:.1f},{here[1]:.1f}")
    return tuple(" ".join(run) for run in runs if run)
