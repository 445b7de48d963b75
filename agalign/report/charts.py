"""Drawings of the rig of a flight, and charts of the offsets of its bands over the captures, in SVG units."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.errors import GeometryError, InputError
from agalign.flight.rig import Rig
from agalign.flight.rig_file import read_rig
from agalign.flight.rig_prediction import band_summaries
from agalign.host.files import MODELS_FOLDER
from agalign.report.facts import CameraOffsets
from agalign.values import geometry
from agalign.values.spectrum import Role, role_of

PLAN_WIDTH, FIELD_WIDTH, CHART_WIDTH, CHART_HEIGHT = 200.0, 160.0, 640.0, 130.0
Values = NDArray[np.float64]
_HUES: Mapping[Role, float] = {"blue": 215, "green": 130, "red": 0, "red edge": 325, "nir": 280}
"""Degrees: the colours of the bands, and two that no visible band has for those that the eye does not see."""
_FREE_HUES = 45, 180, 85, 250, 20, 300, 155, 235
"""For other bands, in their order."""


def rig_views(out: Path, on_problem: Callable[[str], object]) -> list[dict[str, Any]]:
    """Return the rigs of the models below OUT/models; unreadable models are reported to `on_problem`.

    Each has `camera`, number of `captures`, `shared` factors in words, `field_height`, the `reference` band with
    `reference_hue` and `reference_y` of its label, and `bands`: rows of `band_summaries` with `hue`, the position `x`,
    `y` of the lens in the plan of the rig, and `arrows` (x1, y1, x2, y2) of its displacement field.
    """
    views = []
    for path in sorted((out / MODELS_FOLDER).glob("*.safetensors")):
        try:
            camera, rig = read_rig(path)
            rows = [] if rig is None else band_summaries(rig)
        except (InputError, GeometryError) as error:
            on_problem(f"{error}" if isinstance(error, InputError) else f"{path}: its rig cannot be used ({error})")
            continue
        if rig is not None:
            longest = max((math.hypot(*r["baseline"]) for r in rows), default=0.0) or 1.0
            to_plan = 0.36 * PLAN_WIDTH / longest  # leaves space for names
            reference = camera.bands[0][0] if camera is not None and camera.bands else ""
            hues = hues_of([reference, *(row["band"] for row in rows)])
            for row in rows:
                x, y = (PLAN_WIDTH / 2 + to_plan * v for v in row["baseline"])
                row |= {"hue": hues[row["band"]], "x": x, "y": y, "arrows": _arrows(rig, row["band"])}
            is_above = sum(row["y"] - PLAN_WIDTH / 2 for row in rows) > 0  # most lenses are below
            view = {"reference": reference, "reference_hue": hues[reference]}
            view |= {"reference_y": PLAN_WIDTH / 2 + (-11 if is_above else 21)}
            size = {"field_height": FIELD_WIDTH * rig.size_px[1] / rig.size_px[0], "captures": len(rig.captures)}
            shared = ", ".join(rig.factors) or "nothing"
            views.append({"camera": path.stem, "shared": shared, "bands": rows, **view, **size})
    return views


def _arrows(rig: Rig, band: str) -> tuple[tuple[float, float, float, float], ...]:
    if band not in rig.fields:
        return ()
    columns, rows = 13, 10
    points = geometry.lattice(*rig.size_px, columns, rows)
    starts, field = points * (FIELD_WIDTH / rig.size_px[0]), rig.fields[band](points)
    max_length = 11.0  # nearly the distance of the arrows
    arrows = field * max_length / max(float(np.linalg.norm(field, axis=1).max()), 1e-6)
    return tuple((x, y, x + dx, y + dy) for (x, y), (dx, dy) in zip(starts.tolist(), arrows.tolist(), strict=True))


def hues_of(bands: Sequence[str]) -> dict[str, float]:
    """Return the hue of each band, degrees: that of its colour by its name; each of the others, and each further band
    of the same colour, gets an unused colour.
    """
    hues: dict[str, float] = {}
    free = cycle(_FREE_HUES)
    for band in bands:
        role = role_of(band, None)
        hue = None if role is None else _HUES[role]
        hues[band] = next(free) if hue is None or hue in hues.values() else hue
    return hues


def drifts_of(cameras: Mapping[str, CameraOffsets]) -> list[dict[str, Any]]:
    """Return a chart of the offsets, px, over the captures in the order of time, for each camera with three captures or
    more, given by name.

    Each has `title`, `full_px` at the upper end of the axis, `ends`, which are the labels of the first and the last
    capture, and `lines`: `name` and `hue` of a band, and `points` of an SVG polyline for each sequence of captures in
    which it is known.
    """
    result = []
    for camera, known in cameras.items():
        captures = sorted(known.captures, key=lambda one: one[:2])
        offsets = [offsets_px for _, _, offsets_px in captures]
        names = list(dict.fromkeys(name for of_capture in offsets for name in of_capture))
        if len(captures) < 3 or not names:
            continue
        missing = (np.nan, np.nan)
        differences = [
            _principal_component(np.array([of_capture.get(name, missing) for of_capture in offsets], np.float64))
            for name in names
        ]
        # The sign of a principal component is arbitrary: choose that of the first band.
        aligned = np.array([d if np.nansum(differences[0] * d) >= 0 else -d for d in differences])
        min_full_px = 0.2  # smaller drifts are noise
        full_px = float(np.nanmax(np.abs(aligned), initial=min_full_px))
        step = max(1, math.ceil(len(captures) / 400))  # more points than that are not distinguishable
        hues = hues_of([known.reference, *names])  # as in the plan of the rig
        lines = [
            {"name": name, "hue": hues[name], "points": _polylines(of_band, full_px, step)}
            for name, of_band in zip(names, aligned, strict=True)
        ]
        ends = captures[0][1], captures[-1][1]
        result.append({"title": f"{camera} from capture to capture", "full_px": full_px, "lines": lines, "ends": ends})
    return result


def _principal_component(offsets_px: Values) -> Values:
    """(n,) differences of offsets (n, 2) from their median along the direction of largest variance; nan for nan."""
    differences = offsets_px - np.nanmedian(offsets_px, axis=0)
    _, _, directions = np.linalg.svd(differences[np.isfinite(differences).all(axis=1)], full_matrices=False)
    return np.asarray(differences @ directions[0])


def _polylines(values: Values, full: float, step: int) -> tuple[str, ...]:
    """SVG points of each sequence of known values; `step` neighbouring values are averaged."""
    groups = [values[i : i + step] for i in range(0, len(values), step)]
    lines: list[list[str]] = [[]]
    for i, group in enumerate(groups):
        if np.isnan(group).all():
            lines.append([])
            continue
        x, y = CHART_WIDTH * (i + 0.5) / len(groups), 1 - 0.92 * float(np.nanmean(group)) / full
        lines[-1].append(f"{x:.1f},{CHART_HEIGHT / 2 * y:.1f}")
    return tuple(" ".join(line if line[1:] else line * 2) for line in lines if line)  # a single point is a dot
