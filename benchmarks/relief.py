"""Alignment of scenes with depth, against their exact geometry: terraces, plants and boxes from 1-2 m and from 20 m.

    python benchmarks/relief.py [--scenes N] [--kinds flat,boxes] [--ranges close,far] [--size 640x480]
    python benchmarks/relief.py --fooled N

Each scene is one capture of a synthetic RedEdge in a folder of its own, aligned by the command line with its defaults.
The other method, OpenCV's dense flow, starts from `--relief never`. Residuals are the distance to the true position of
each written pixel that a band shows. `--fooled` counts bands that are called `aligned` though more than a tenth of what
they show is more than 1 px off, or they show another scene.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import rasterio
import tifffile
import typer
from common import WRONG_PX, align, flight_and_out, layer, print_head, print_row, run, timed
from numpy.typing import NDArray
from peers import dis_flow
from scipy.interpolate import RectBivariateSpline
from synthetic_flights.depth import BandTruth, Scene, Truth, write_capture
from synthetic_flights.relief import FOOLING, GEOMETRIES, fooling, make_scene

from agalign.pixels.raster import without_warnings
from agalign.products.sidecar.file import find_sidecars

DEFAULT, START, FLOW = "agalign", "agalign, homography alone", "DIS flow on structure"
_OPTIONS = {DEFAULT: ("--relief-map",), START: ("--relief", "never")}
"""The relief's map changes no alignment; it contains the range, which is scored."""
_FIRST_SEED = 1000
"""Apart from those of the fooling scenes."""
_COLUMNS = {
    "median_px": ("median, px", ".3f"),
    "p90_px": ("p90, px", ".2f"),
    "beyond_1_px": ("beyond 1 px", ".1%"),
    "range_error": ("range error", ".2%"),
    "density": ("density", ".0%"),
    "precision": ("occlusion precision", ".0%"),
    "recall": ("recall", ".0%"),
    "seconds": ("s a capture", ".1f"),
}
"""Medians over bands in the table: field of a score, title, format."""
Map = NDArray[np.float64]
"""(height, width, 2): raw px of the moving image for each raw px of the reference."""
Window = tuple[slice, slice]
"""Rows and columns of the reference."""
WHOLE: Window = (slice(None), slice(None))

_TOLERANCE_PX = 1
"""An occluded pixel counts as found, and a masked one as right, where the other is this near: truth is decided at
pixel centres."""


@dataclass(frozen=True)
class Score:
    """One band of one capture by one method. Values are nan where nothing can be measured."""

    method: str
    kind: str
    close: bool
    scene: int
    band: str = ""
    status: str = "-"
    """`-` for a method that does not verify."""
    median_px: float = np.nan
    p90_px: float = np.nan
    beyond_1_px: float = np.nan
    """Share of the pixels."""
    range_error: float = np.nan
    """Median relative error of the relief's range."""
    density: float = np.nan
    """Share of the written pixels that have a range."""
    precision: float = np.nan
    recall: float = np.nan
    """Of the pixels without data in the stack, against the occluded ones."""
    seconds: float = np.nan
    """Processing time of the whole capture."""

    @property
    def wrong(self) -> bool:
        """True for a wrong acceptance: the band is misaligned, or does not show the scene."""
        return self.status == "aligned" and not self.p90_px <= WRONG_PX

    @property
    def place(self) -> str:
        """Kind and distance of the scene."""
        return f"{self.kind}, {'close' if self.close else 'far'}, scene {self.scene}"


@dataclass(frozen=True)
class Sidecar:
    """Outputs of a run for a capture."""

    path: Path
    content: dict[str, Any]

    @property
    def moving(self) -> list[dict[str, Any]]:
        """The bands but for the reference."""
        return [band for band in self.content["bands"] if band["status"] != "reference"]

    @property
    def window(self) -> Window:
        """Rows and columns of the reference in the output."""
        x0, y0, width, height = self.content["output"]["crop"]
        return slice(y0, y0 + height), slice(x0, x0 + width)


def read_sidecar(out: Path) -> Sidecar:
    """Return the one sidecar below the output of a run."""
    (path,) = find_sidecars(out)
    return Sidecar(path, json.loads(path.read_text(encoding="utf-8")))


def mapping_of(sidecar: Sidecar, band: dict[str, Any]) -> Map | None:
    """The mapping of a band at every pixel of the reference, as its sidecar has it: from `relief` and the raster that
    it names, nan outside the written area, else from `grid`. None where it has neither.
    """
    relief, grid = band.get("relief"), band.get("grid")
    if relief and relief["file"]:
        plane_px, slope = (_interpolated(sidecar, relief["reference_px"], relief[k]) for k in ("plane_px", "slope"))
        parallax_px = np.full(plane_px.shape[:2], np.nan)
        parallax_px[sidecar.window] = layer(sidecar.path.parent / relief["file"], "parallax")
        return np.asarray(plane_px + parallax_px[..., None] * slope)
    return _interpolated(sidecar, grid["reference_px"], grid["moving_px"]) if grid else None


def _interpolated(sidecar: Sidecar, nodes_px: list[list[float]], values: list[list[float]]) -> Map:
    """A cubic spline at every pixel of the reference, through values on a lattice of nodes, row by row."""
    here, there = np.array(nodes_px, np.float64), np.array(values, np.float64)
    x, y = np.unique(here[:, 0]), np.unique(here[:, 1])
    columns, rows = (np.arange(sidecar.content["reference"][name]) for name in ("width", "height"))
    lattice = there.reshape(len(y), len(x), 2)
    return np.stack([RectBivariateSpline(y, x, lattice[..., k])(rows, columns) for k in (0, 1)], axis=-1)


def residuals(mapping: Map | None, truth: BandTruth, window: Window = WHOLE) -> dict[str, float]:
    """Return median, 90th percentile and share beyond 1 px of the distance to the truth, as fields of a score, over
    pixels of a window that the band shows and that did not move.
    """
    some = truth.scored[window]
    if mapping is None or not some.any():
        return {}
    error_px = np.linalg.norm(mapping[window][some] - truth.moving_px[window][some], axis=-1)
    # A pixel without a mapping is infinitely far off, which no interpolating quantile can express.
    error_px = np.sort(np.where(np.isfinite(error_px), error_px, np.inf))
    median, p90 = (float(error_px[int(share * (len(error_px) - 1))]) for share in (0.5, 0.9))
    return {"median_px": median, "p90_px": p90, "beyond_1_px": float((error_px > 1).mean())}


def range_errors(sidecar: Sidecar, truth: Truth) -> tuple[float, float]:
    """(median relative error, density) of the range in <capture>.relief.tif, which has it with --relief-map."""
    range_m = layer(sidecar.path.with_suffix(".relief.tif"), "range")
    if range_m is None:
        return np.nan, np.nan
    expected = truth.range_m[sidecar.window]
    some = np.isfinite(range_m) & (range_m > 0)
    if not some.any():
        return np.nan, 0.0
    return float(np.median(np.abs(range_m[some] / expected[some] - 1))), float(some.mean())


def occlusion_scores(sidecar: Sidecar, band: dict[str, Any], truth: BandTruth) -> dict[str, float]:
    """Return precision and recall, as fields of a score, of the pixels without data in the stack, where the truth is
    inside the moving image.
    """
    place = band.get("place")
    if place is None:
        return {}
    with without_warnings(), rasterio.open(sidecar.path.parent / place["file"]) as dataset:
        masked = dataset.read_masks(place["band_index"]) == 0
    inside = truth.inside[sidecar.window]
    masked, hidden = masked & inside, truth.hidden[sidecar.window] & inside
    return {"precision": _share(masked, _grown(hidden)), "recall": _share(hidden, _grown(masked))}


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    side = 2 * _TOLERANCE_PX + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _share(some: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(of[some].mean()) if some.any() else np.nan


# ---- runs


def program_scores(out: Path, truth: Truth, blank: Score) -> Iterator[Score]:
    """Yield the scores of a run on one capture."""
    sidecar = read_sidecar(out)
    range_error, density = range_errors(sidecar, truth)
    for band in sidecar.moving:
        known = truth.bands[band["band"]]
        values = residuals(mapping_of(sidecar, band), known, sidecar.window) | occlusion_scores(sidecar, band, known)
        values |= {"range_error": range_error, "density": density}
        yield replace(blank, band=band["band"], status=band["status"], **values)


def flow_scores(flight: Path, out: Path, truth: Truth, blank: Score) -> list[Score]:
    """Return the scores of the dense flow from the mappings of a run; a band without a mapping has none."""
    images = {p.name: tifffile.imread(p).astype(np.float32) for p in flight.rglob("*.tif")}
    sidecar, scores, total_s = read_sidecar(out), [], 0.0
    reference = images[sidecar.content["reference"]["file"]]
    for band in sidecar.moving:
        start = mapping_of(sidecar, band)
        seconds, mapping = (0.0, None) if start is None else timed(dis_flow, reference, images[band["file"]], start)
        total_s += seconds
        values = residuals(mapping, truth.bands[band["band"]], sidecar.window)
        scores.append(replace(blank, band=band["band"], **values))
    return [replace(score, seconds=total_s) for score in scores]


def scores_of(scene: Scene, blank: Score, size_px: tuple[int, int], methods: Sequence[str]) -> Iterator[Score]:
    """Yield the scores of methods on one scene."""
    with flight_and_out() as (flight, out):
        truth = write_capture(flight, scene, size_px=size_px, rng_seed=blank.scene)
        for method in methods:
            blank = replace(blank, method=method)
            if method == FLOW:
                yield from flow_scores(flight, out / START, truth, blank)
            else:
                seconds = align(flight, out / method, *_OPTIONS[method])
                yield from program_scores(out / method, truth, replace(blank, seconds=seconds))


def print_scores(title: Sequence[str], scores: Sequence[Score]) -> None:
    """Print a line of the table."""
    verified = scores[0].status != "-"
    counts = (sum(s.status == "aligned" for s in scores), sum(s.wrong for s in scores)) if verified else ("-", "-")
    cells = []
    for name, (_, style) in _COLUMNS.items():
        values = np.array([getattr(s, name) for s in scores])
        cells.append("-" if np.isnan(values).all() else format(np.nanmedian(values), style))
    print_row(*title, len(scores), *counts, *cells)


def print_table(scores: Sequence[Score]) -> None:
    """Print a row for each kind, range and method, and one for all scenes of a method; then the wrong bands."""
    print_head("kind", "range", "method", "bands", "aligned", "wrongly", *(title for title, _ in _COLUMNS.values()))
    groups: dict[tuple[str, ...], list[Score]] = {}
    for s in sorted(scores, key=lambda s: (GEOMETRIES + FOOLING).index(s.kind)):
        groups.setdefault((s.kind, "1-2 m" if s.close else "20 m", s.method), []).append(s)
    for s in scores:
        groups.setdefault(("all", "", s.method), []).append(s)
    for title, some in groups.items():
        print_scores(title, some)
    wrong, aligned = [s for s in scores if s.wrong], sum(s.status == "aligned" for s in scores)
    print(f"\n{len(wrong)} of {aligned} bands called aligned are more than {WRONG_PX:g} px off at p90,", end=" ")
    print("or show another scene")
    for s in wrong:
        off = "another scene" if np.isnan(s.p90_px) else f"median {s.median_px:.2f} px, p90 {s.p90_px:.2f} px"
        print(f"  {s.place}, {s.band}, {s.method}: {off}")


def main(
    scenes: int = 2,
    kinds: str = ",".join(GEOMETRIES),
    ranges: str = "close,far",
    size: str = "640x480",
    fooled: Annotated[int, typer.Option(help="count wrong bands on this number of fooling scenes")] = 0,
    first: Annotated[int, typer.Option(help="number of the first scene")] = 0,
) -> None:
    width_px, height_px = map(int, size.split("x"))
    methods = [DEFAULT] if fooled else [DEFAULT, START, FLOW]
    if fooled:
        chosen_scenes = [(*fooling(number), number) for number in range(first, first + fooled)]
    else:
        numbers = range(_FIRST_SEED + first, _FIRST_SEED + first + scenes)
        chosen_scenes = list(product(kinds.split(","), [place == "close" for place in ranges.split(",")], numbers))
    scores: list[Score] = []
    for kind, close, number in chosen_scenes:
        scene, blank = make_scene(kind, number, close=close, width_px=width_px), Score("", kind, close, number)
        result = list(scores_of(scene, blank, (width_px, height_px), methods))
        statuses = ", ".join(f"{s.band} {s.status} {s.p90_px:.2f}" for s in result if s.method == DEFAULT)
        print(f"{blank.place}: {statuses}", file=sys.stderr, flush=True)
        scores += result
    print_table(scores)


if __name__ == "__main__":
    run(main)
