"""Drawings of the rig of a flight, and charts of values of its bands over the captures, in SVG units: drift, light, and
the radiometric check, which compares the levels of successive captures in their overlap and finds sudden changes of
the light.

The check matches the previews of two captures, which places the blocks of the one in the other: the full images are not
read.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from agalign.errors import InputError
from agalign.flight.rig import Rig
from agalign.flight.rig_file import read_rig
from agalign.flight.rig_prediction import band_summaries
from agalign.pixels.landmarks import Landmarks, landmarks, matched_homography
from agalign.products.report.drawing import LEVEL_BLOCKS
from agalign.products.sidecar.schema import Sidecar
from agalign.values import geometry
from agalign.values.files import read_regular
from agalign.values.image import Raster
from agalign.values.pixel_units import PixelScale
from agalign.values.processes import usable_cores

PLAN_WIDTH, FIELD_WIDTH, CHART_WIDTH, CHART_HEIGHT = 200.0, 160.0, 640.0, 130.0
_JUMP = 0.15
"""Ground seen from opposite sides differs by 9 % in the same light; cloud shadows change all bands by more."""
_WINDOW = 5
"""The light is compared with this number of captures before and after."""
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """One band over a flight, as drawn in a chart."""

    name: str
    hue: float
    points: tuple[str, ...]
    """The `points` of an SVG polyline for each sequence of captures in which the band is known."""


@dataclass(frozen=True)
class FlightChart:
    """Values of the bands of a camera over its captures, in the order of time."""

    title: str
    full: float
    """Value at the upper end of the axis."""
    lines: tuple[Line, ...]
    ends: tuple[str, str]
    """Labels of the first and the last capture."""

    @classmethod
    def of(
        cls, title: str, labels: Sequence[str], names: Sequence[str], values: Values, min_full: float
    ) -> "FlightChart":
        """Return the chart of values (bands, captures); nan breaks a line. Values below `min_full` do not fill it."""
        full = float(np.abs(values[np.isfinite(values)]).max(initial=min_full))
        step = max(1, math.ceil(values.shape[1] / 400))  # more points than that are not distinguishable
        lines = (
            Line(name, _hue(number, len(names)), _polylines(of_band, full, step))
            for number, (name, of_band) in enumerate(zip(names, values, strict=True))
        )
        return cls(title, full, tuple(lines), (labels[0], labels[-1]))


def _by_band(captures: Sequence[Mapping[str, Any]], missing: Any = np.nan) -> tuple[list[str], Values]:
    """Return the names of the bands, and values (bands, captures, ...), given those of each capture by band."""
    names = list(dict.fromkeys(name for of_capture in captures for name in of_capture))
    return names, np.array([[of_capture.get(name, missing) for of_capture in captures] for name in names], np.float64)


def rig_views(out: Path, on_problem: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the rigs of the models below OUT/models; unreadable models are reported to `on_problem`.

    Each has `camera`, number of `captures`, `shared` factors in words, `field_height`, and `bands`: rows of
    `band_summaries` with `hue`, the position `x`, `y` of the lens in the plan of the rig, and `arrows` (x1, y1, x2, y2)
    of its displacement field.
    """
    views = []
    for path in sorted((out / "models").glob("*.safetensors")):
        try:
            _, rig = read_rig(path)
        except InputError as error:
            on_problem(str(error))
            continue
        if rig is not None:
            rows = band_summaries(rig)
            longest = max((math.hypot(*r["baseline"]) for r in rows), default=0.0) or 1.0
            to_plan = 0.36 * PLAN_WIDTH / longest  # leaves space for names
            for number, row in enumerate(rows):
                x, y = (PLAN_WIDTH / 2 + to_plan * v for v in row["baseline"])
                row |= {"hue": _hue(number, len(rows)), "x": x, "y": y, "arrows": _arrows(rig, row["band"])}
            size = {"field_height": FIELD_WIDTH * rig.size_px[1] / rig.size_px[0], "captures": len(rig.captures)}
            views.append({"camera": path.stem, "shared": ", ".join(rig.factors) or "nothing", "bands": rows, **size})
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


def _hue(number: int, count: int) -> float:
    """One of `count` equally spaced hues, degrees."""
    return round(205 + 360 * number / max(count, 1)) % 360


def drifts_of(captures: Sequence[dict[str, Any]]) -> list[FlightChart]:
    """Return a chart of the offsets, px, for each camera with three captures or more, given the report's data."""
    result = []
    for camera in dict.fromkeys(c["camera"] for c in captures):
        in_order = sorted((c for c in captures if c["camera"] == camera), key=lambda c: (c["captured_at"], c["label"]))
        usable = [[b for b in c["bands"] if b["status"] in ("aligned", "predicted")] for c in in_order]
        offsets = [{b["band"]: b["offset_px"] for b in bands if b["offset_px"]} for bands in usable]
        names, offsets_px = _by_band(offsets, (np.nan, np.nan))
        if len(in_order) < 3 or not names:
            continue
        differences = [_principal_component(of_band) for of_band in offsets_px]
        # The sign of a principal component is arbitrary: choose that of the first band.
        aligned = np.array([d if np.nansum(differences[0] * d) >= 0 else -d for d in differences])
        labels, min_full_px = [c["label"] for c in in_order], 0.2  # smaller drifts are noise
        result.append(FlightChart.of(f"{camera} from capture to capture", labels, names, aligned, min_full_px))
    return result


def _principal_component(offsets_px: Values) -> Values:
    """(n,) differences of offsets (n, 2) from their median along the direction of largest variance; nan for nan."""
    differences = offsets_px - np.nanmedian(offsets_px, axis=0)
    _, _, directions = np.linalg.svd(differences[np.isfinite(differences).all(axis=1)])
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


@dataclass(frozen=True)
class CaptureLight:
    """The light of a capture by band, and its levels in the preview."""

    camera: str
    """With its serial number."""
    captured_at: str
    label: str
    irradiance: Mapping[str, float]
    """By the light sensor, in its unit."""
    by_panel: Mapping[str, float]
    """Radiance of a white panel at the time of the capture, as it was used; empty without a panel."""
    saturated: Mapping[str, float]
    levels: Mapping[str, Values]
    """Means of the written pixels in `LEVEL_BLOCKS` (rows, columns), nan without pixels; empty without a preview."""
    preview: Path
    tile_px: tuple[int, int, int, int]
    """x, y, width and height of the reference band in the preview."""

    @classmethod
    def of(cls, label: str, path: Path, sidecar: Sidecar) -> "CaptureLight":
        """Return the light of a capture from its sidecar, which is at `path`."""
        output, preview, bands = sidecar.output, sidecar.preview, sidecar.bands
        lit = [] if output is None else output.illumination
        has_panel = output is not None and output.panel_age_s is not None
        width, height = (0, 0) if preview is None else preview.tile_px
        column = 0 if preview is None else [b.band for b in bands].index(sidecar.reference.band)
        levels = {b.band: np.array(b.levels, np.float64) for b in bands if preview is not None}
        return cls(
            f"{sidecar.camera.name} {sidecar.camera.serial}".strip() or "unknown camera",
            sidecar.captured_at,
            label,
            {b.band: b.irradiance for b in lit if b.irradiance is not None},
            {b.band: 1 / b.reflectance_per_radiance for b in lit if has_panel},
            {b.band: b.saturated for b in bands if b.saturated is not None},
            {name: values for name, values in levels.items() if values.shape == LEVEL_BLOCKS},
            path if preview is None else path.parent / preview.file,
            (column * width, height, width, height),
        )

    @property
    def order(self) -> tuple[str, str, str]:
        """Sort by camera and time."""
        return self.camera, self.captured_at, self.label


def light_charts(captures: Sequence[CaptureLight]) -> list[FlightChart]:
    """Return the charts of each camera with known light in at least three captures."""
    captions = {
        "irradiance": "Irradiance on a horizontal plane by the light sensor",
        "by_panel": "Light by panels, at the time of each capture",
    }
    charts, min_captures = [], 3
    for camera in sorted({c.camera for c in captures}):
        of_camera = sorted((c for c in captures if c.camera == camera), key=lambda c: c.order)
        for source, caption in captions.items():
            known = {c.label: light for c in of_camera if (light := getattr(c, source))}
            if len(known) >= min_captures:
                names, light = _by_band([*known.values()])
                changes, min_full = light / np.nanmedian(light, axis=1, keepdims=True) - 1, 0.01  # less is noise
                charts.append(FlightChart.of(f"{caption}: {camera}", [*known], names, changes, min_full))
    return charts


@dataclass(frozen=True)
class RadiometricCheck:
    """The tables and the plot of the check."""

    bands: Sequence[Mapping[str, Any]]
    """For each band, its `name`, the largest `saturated` share and its `capture`, the number of `overlaps`, and the
    `median` and `p95` of their differences (relative).
    """
    jumps: Sequence[tuple[str, str]]
    """(label of a capture, its difference from the one before or from the light before and after)."""
    chart: FlightChart
    """Change of each capture from the one before."""


def radiometric_check(captures: Sequence[CaptureLight]) -> RadiometricCheck | None:
    """Compare the captures that have levels; None without any."""
    captures = sorted((c for c in captures if c.levels), key=lambda c: c.order)
    if not captures:
        return None
    names, labels = list(dict.fromkeys(name for c in captures for name in c.levels)), [c.label for c in captures]
    changes = _changes(captures, names)
    light = np.log(np.array([[c.irradiance.get(name, np.nan) for name in names] for c in captures]))
    cameras = np.array([c.camera for c in captures])
    windows = [slice(max(0, k - _WINDOW), k + _WINDOW + 1) for k in range(len(light))]
    sudden = light - [_median(light[w][cameras[w] == camera]) for w, camera in zip(windows, cameras, strict=True)]
    texts = [_jump(names, *rows) for rows in zip(changes, sudden, strict=True)]
    min_full = 0.05  # smaller differences do not fill the plot
    return RadiometricCheck(
        [_of_band(name, captures, changes[:, k]) for k, name in enumerate(names)],
        [(label, text) for label, text in zip(labels, texts, strict=True) if text],
        FlightChart.of("Radiometric check", labels, names, changes.T, min_full),
    )


def _changes(captures: Sequence[CaptureLight], names: Sequence[str]) -> Values:
    """Logarithms (captures, bands) of the ratio of each capture to the one before, nan without overlap."""
    pairs = [(k, k - 1) for k, (one, other) in enumerate(pairwise(captures), 1) if one.camera == other.camera]
    # Matching takes 0.1 s a capture; of longer flights, captures at equal distances are compared with their
    # predecessors.
    max_captures = 200
    pairs = pairs[:: -(-len(pairs) // max_captures)] if pairs else []
    result = np.full((len(captures), len(names)), np.nan)
    with ThreadPoolExecutor(usable_cores()) as threads:
        used = sorted({k for pair in pairs for k in pair})
        found = dict(zip(used, threads.map(lambda k: _landmarks_of(captures[k]), used), strict=True))
        ratios = threads.map(lambda p: _ratio(captures[p[0]], captures[p[1]], found[p[0]], found[p[1]], names), pairs)
        for (k, _), ratio in zip(pairs, ratios, strict=True):
            result[k] = ratio
    return result


def _landmarks_of(capture: CaptureLight) -> Landmarks | None:
    try:
        sheet = cv2.imdecode(np.frombuffer(read_regular(capture.preview), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        return None
    x, y, width, height = capture.tile_px
    if sheet is None or sheet.shape[0] < y + height or sheet.shape[1] < x + width:
        return None
    tile = np.asarray(sheet[y : y + height, x : x + width], np.float32)
    keypoints = 800
    return landmarks(Raster(tile, np.ones(tile.shape, bool)), "image", keypoints)


def _ratio(
    one: CaptureLight, before: CaptureLight, in_one: Landmarks | None, in_before: Landmarks | None, names: Sequence[str]
) -> Values:
    """Logarithm (bands,) of the ratio of a capture to the one before, the median over the blocks of the overlap."""
    unknown, (rows, columns) = np.full(LEVEL_BLOCKS, np.nan), LEVEL_BLOCKS
    size_px = one.tile_px[2:]
    mapping = None if in_one is None or in_before is None else matched_homography(in_one, in_before, size_px)
    if mapping is None:
        return np.full(len(names), np.nan)
    scales = [PixelScale(columns / c.tile_px[2], rows / c.tile_px[3]) for c in (one, before)]
    centres = geometry.lattice(columns, rows, columns, rows)
    at = geometry.apply(geometry.rescale(mapping, *scales), centres)[:, ::-1].T
    there = np.array([map_coordinates(before.levels.get(name, unknown), at, order=1, cval=np.nan) for name in names])
    here = np.array([one.levels.get(name, unknown).ravel() for name in names])
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.log(here / there)
    min_blocks = 6  # minimum number of blocks in an overlap
    ratios[np.isfinite(ratios).sum(axis=1) < min_blocks] = np.nan
    return _median(ratios.T)


def _of_band(name: str, captures: Sequence[CaptureLight], changes: Values) -> dict[str, Any]:
    saturated, capture = max(
        ((c.saturated[name], c.label) for c in captures if name in c.saturated), default=(None, "")
    )
    known = np.expm1(np.abs(changes[np.isfinite(changes)]))
    median, p95 = np.percentile(known, (50, 95)).tolist() if len(known) else (None, None)
    facts = {"name": name, "saturated": saturated, "capture": capture}
    return facts | {"overlaps": len(known), "median": median, "p95": p95}


def _jump(names: Sequence[str], changes: Values, light: Values) -> str:
    """Describe large changes (bands,) of a capture from the one before, and of its light; empty for none."""
    parts = zip(names, np.expm1(changes), strict=True)
    texts = [f"{name} {change:+.0%}" for name, change in parts if abs(change) > _JUMP]
    cues = {"darker than the capture before": changes, "light sensor": light}
    known = {cue: values[np.isfinite(values)] for cue, values in cues.items()}
    dark = [cue for cue, values in known.items() if len(values) and values.max() < np.log(1 - _JUMP)]
    return ", ".join(texts + [f"cloud shadow suspected ({', '.join(dark)})"] * bool(dark))


def _median(values: Values) -> Values:
    """The median over the rows (n, m), without nan; nan if there is none."""
    is_known, result = np.isfinite(values).any(axis=0), np.full(values.shape[1], np.nan)
    result[is_known] = np.nanmedian(values[:, is_known], axis=0)
    return result
