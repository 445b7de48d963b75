"""Alignment of scenes with depth, against their exact geometry: terraces, plants and boxes from 1-2 m and from 20 m.

    python benchmarks/relief.py [--scenes N] [--kinds flat,boxes] [--ranges close,far] [--size 640x480] [--figures]
    python benchmarks/relief.py --fooled N

Each scene is one capture of a synthetic RedEdge in a folder of its own, aligned by the command line with its defaults.
The other method, OpenCV's dense flow, starts from `--relief never`. Residuals are the distance to the true position of
each written pixel that a band shows. `--fooled` counts bands that are called `aligned` though more than a tenth of what
they show is more than 1 px off, or they show another scene.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated

import common
import cv2
import numpy as np
import tifffile
import typer
from common import WRONG_PX, cell, layer, print_head, print_row
from figures_csv import FiguresOption, TableRow, write_figures
from numpy.typing import NDArray
from peers import dis_flow
from synthetic_flights.depth import BandTruth, Scene, Truth, write_capture
from synthetic_flights.relief import FOOLING, GEOMETRIES, fooling, make_scene

from agalign import Alignment, SidecarError, read_alignment
from agalign.values.image import Tile

DEFAULT, START, FLOW = "agalign", "agalign, homography alone", "DIS flow on structure"
_OPTIONS = {DEFAULT: ("--relief-map",), START: ("--relief", "never")}
"""The relief's map changes no alignment; it contains the range, which is scored."""
_FIRST_SEED = 1000
"""Apart from those of the fooling scenes."""
Map = NDArray[np.float64]
"""(height, width, 2): raw px of the moving image for each raw px of the reference."""
_TOLERANCE_PX = 1
"""An occluded pixel counts as found, and a masked one as right, where the other is this near: truth is decided at
pixel centres."""


def _column(title: str, style: str) -> float:
    """A field of a score, nan by default; its median over bands is in the table with this title and format."""
    return field(default=np.nan, metadata={"title": title, "style": style})


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
    median_px: float = _column("median, px", ".3f")
    p90_px: float = _column("p90, px", ".2f")
    beyond_1_px: float = _column("beyond 1 px", ".1%")
    """Share of the pixels."""
    within_1: float = _column("within the expected error", ".0%")
    """Share of the pixels whose error is at most the expected error of the pixel: 63 % for normal errors."""
    within_2: float = _column("within twice", ".0%")
    """Within twice as much: 98 %."""
    range_error: float = _column("range error", ".2%")
    """Median relative error of the relief's range."""
    density: float = _column("density", ".0%")
    """Share of the written pixels that have a range."""
    precision: float = _column("occlusion precision", ".0%")
    recall: float = _column("recall", ".0%")
    """Of the pixels without data in the stack, against the occluded ones."""
    seconds: float = _column("s a capture", ".1f")
    """Processing time of the whole capture."""

    @property
    def wrong(self) -> bool:
        """True for a wrong acceptance: the band is misaligned, or does not show the scene."""
        return self.status == "aligned" and not self.p90_px <= WRONG_PX

    @property
    def place(self) -> str:
        """Kind and distance of the scene."""
        return f"{self.kind}, {'close' if self.close else 'far'}, scene {self.scene}"


def alignment_of(sidecar: Path, band: str) -> Alignment | None:
    """Return the alignment of a band; None where its sidecar has none."""
    try:
        return read_alignment(sidecar, band)
    except SidecarError:
        return None


def mapping_of(alignment: Alignment | None) -> Map | None:
    """Return the mapping of a band at every pixel of the reference."""
    return None if alignment is None else alignment.mapping.positions(Tile(0, 0, *alignment.size_px))


def residuals(
    mapping: Map | None, truth: BandTruth, window: tuple[slice, slice], expected_px: NDArray[np.floating] | None = None
) -> dict[str, float]:
    """Return median, 90th percentile and share beyond 1 px of the distance to the truth, as fields of a score, over
    pixels of a window of the reference that the band shows and that did not move; with the expected errors (height,
    width) of the mapping, also the shares within them.
    """
    some = truth.scored[window]
    if mapping is None or not some.any():
        return {}
    error_px = np.linalg.norm(mapping[window][some] - truth.moving_px[window][some], axis=-1)
    # A pixel without a mapping is infinitely far off, which no interpolating quantile can express.
    error_px = np.where(np.isfinite(error_px), error_px, np.inf)
    median, p90 = np.percentile(error_px, (50, 90), method="lower").tolist()
    result = {"median_px": median, "p90_px": p90, "beyond_1_px": float((error_px > 1).mean())}
    if expected_px is not None:
        ratio = error_px / expected_px[window][some]
        result |= {"within_1": float((ratio <= 1).mean()), "within_2": float((ratio <= 2).mean())}
    return result


def range_errors(range_m: NDArray[np.float64] | None, expected_m: NDArray[np.floating]) -> dict[str, float]:
    """Return median relative error and density of a range (height, width), as fields of a score; none without it."""
    if range_m is None:
        return {}
    some = np.isfinite(range_m) & (range_m > 0)
    error = float(np.median(np.abs(range_m[some] / expected_m[some] - 1))) if some.any() else np.nan
    return {"range_error": error, "density": float(some.mean())}


def occlusion_scores(
    pixels: NDArray[np.float64] | None, truth: BandTruth, window: tuple[slice, slice]
) -> dict[str, float]:
    """Return precision and recall, as fields of a score, of the nan pixels of a band of the stack, where the truth is
    inside the moving image; nothing for a band without pixels.
    """
    if pixels is None:
        return {}
    inside = truth.inside[window]
    masked, hidden = np.isnan(pixels) & inside, truth.hidden[window] & inside
    near = np.ones((2 * _TOLERANCE_PX + 1,) * 2, np.uint8)
    near_masked, near_hidden = (cv2.dilate(mask.astype(np.uint8), near) for mask in (masked, hidden))
    precision, recall = (of.mean() if len(of) else np.nan for of in (near_hidden[masked], near_masked[hidden]))
    return {"precision": float(precision), "recall": float(recall)}


# ---- runs


def program_scores(out: Path, truth: Truth, blank: Score) -> Iterator[Score]:
    """Yield the scores of a run on one capture."""
    path, sidecar = common.only_sidecar(out)
    window = common.window_of(sidecar)
    # With --relief-map the raster contains the range.
    of_range = range_errors(layer(path.with_suffix(".relief.tif"), "range"), truth.range_m[window])
    for band in (b for b in sidecar.bands if b.status != "reference"):
        known = truth.bands[band.band]
        alignment = alignment_of(path, band.band)
        expected_px = None if alignment is None else alignment.error_map_px
        values = residuals(mapping_of(alignment), known, window, expected_px)
        written = None if band.place is None else layer(path.with_suffix(".tif"), band.band)
        values |= occlusion_scores(written, known, window)
        yield replace(blank, band=band.band, status=band.status, **values, **of_range)


def flow_scores(flight: Path, out: Path, truth: Truth, blank: Score) -> list[Score]:
    """Return the scores of the dense flow from the mappings of a run; a band without a mapping has none."""
    images = {p.name: tifffile.imread(p).astype(np.float32) for p in flight.rglob("*.tif")}
    (path, sidecar), scores, total_s = common.only_sidecar(out), [], 0.0
    reference = images[Path(sidecar.reference.file).name]
    for band in (b for b in sidecar.bands if b.status != "reference"):
        start = mapping_of(alignment_of(path, band.band))
        moving = images[Path(band.file).name]
        seconds, mapping = (0.0, None) if start is None else common.timed(dis_flow, reference, moving, start)
        total_s += seconds
        values = residuals(mapping, truth.bands[band.band], common.window_of(sidecar))
        scores.append(replace(blank, band=band.band, **values))
    return [replace(score, seconds=total_s) for score in scores]


def scores_of(scene: Scene, blank: Score, size_px: tuple[int, int], methods: Sequence[str]) -> Iterator[Score]:
    """Yield the scores of methods on one scene."""
    with common.flight_and_out() as (flight, out):
        truth = write_capture(flight, scene, size_px=size_px, rng_seed=blank.scene)
        for method in methods:
            blank = replace(blank, method=method)
            if method == FLOW:
                yield from flow_scores(flight, out / START, truth, blank)
            else:
                seconds = common.align(flight, out / method, *_OPTIONS[method])
                yield from program_scores(out / method, truth, replace(blank, seconds=seconds))


def print_table(scores: Sequence[Score]) -> None:
    """Print a row for each kind, range and method, and one for all scenes of a method; then the wrong bands."""
    columns = [f for f in fields(Score) if f.metadata]
    titles = (column.metadata["title"] for column in columns)
    print_head("kind", "range", "method", "bands", "aligned", "wrongly", *titles)
    groups: dict[tuple[str, ...], list[Score]] = {}
    for s in sorted(scores, key=lambda s: (GEOMETRIES + FOOLING).index(s.kind)):
        groups.setdefault((s.kind, "1-2 m" if s.close else "20 m", s.method), []).append(s)
    for s in scores:
        groups.setdefault(("all", "", s.method), []).append(s)
    for title, some in groups.items():
        is_verified = some[0].status != "-"
        counts = (sum(s.status == "aligned" for s in some), sum(s.wrong for s in some)) if is_verified else ("-", "-")
        cells = [cell([getattr(s, column.name) for s in some], column.metadata["style"]) for column in columns]
        print_row(*title, len(some), *counts, *cells)
    wrong, aligned = [s for s in scores if s.wrong], sum(s.status == "aligned" for s in scores)
    print(f"\n{len(wrong)} of {aligned} bands called aligned are more than {WRONG_PX:g} px off at p90,", end=" ")
    print("or show another scene")
    for s in wrong:
        off = "another scene" if np.isnan(s.p90_px) else f"median {s.median_px:.2f} px, p90 {s.p90_px:.2f} px"
        print(f"  {s.place}, {s.band}, {s.method}: {off}")


def table_rows(scores: Sequence[Score]) -> Iterator[TableRow]:
    """Yield the rows of docs/figures/figures.csv: each kind of scene, and all of them by each other method."""
    groups = {kind: [s for s in scores if (s.kind, s.method) == (kind, DEFAULT)] for kind in GEOMETRIES}
    others = {START: "all, one homography per band", FLOW: "all, DIS optical flow"}
    groups |= {name: [s for s in scores if s.method == method] for method, name in others.items()}
    heads = {
        "median error, px": ("median_px", ".3f"),
        "p90, px": ("p90_px", ".2f"),
        "beyond 1 px, %": ("beyond_1_px", ".1%"),
        "within the expected error, %": ("within_1", ".0%"),
        "within twice, %": ("within_2", ".0%"),
        "error of the range, %": ("range_error", ".2%"),
    }
    for name, some in ((name, some) for name, some in groups.items() if some):
        aligned = sum(s.status == "aligned" for s in some) if some[0].method == DEFAULT else "-"
        values = {
            head: cell([getattr(s, field) for s in some], style).rstrip("%") for head, (field, style) in heads.items()
        }
        yield TableRow("scenes with depth", name, f"{len(some)} bands", {"aligned": aligned, **values})


def main(
    scenes: int = 2,
    kinds: str = ",".join(GEOMETRIES),
    ranges: str = "close,far",
    size: str = "640x480",
    fooled: Annotated[int, typer.Option(help="count wrong bands on this number of fooling scenes")] = 0,
    first: Annotated[int, typer.Option(help="number of the first scene")] = 0,
    *,
    figures: FiguresOption = False,
) -> None:
    if figures and fooled:
        sys.exit("--figures writes no figures of --fooled; omit one of them")
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
    if figures:
        write_figures(table_rows(scores))


if __name__ == "__main__":
    common.run(main)
