"""Alignment of scenes with depth, against their exact geometry: terraces, plants and boxes from 1-2 m and from 20 m.

    python benchmarks/relief.py [--scenes N] [--kinds flat,boxes] [--ranges close,far] [--size 640x480]
    python benchmarks/relief.py --fooled N

Each scene is one capture of a synthetic RedEdge in a folder of its own, aligned by the command line with its defaults.
The other method, OpenCV's dense flow, starts from `--relief never`. Residuals are the distance to the true position of
each written pixel that a band shows. `--fooled` counts bands that are called `aligned` though more than a tenth of what
they show is more than 1 px off, or they show another scene.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import tifffile
import typer
from common import WRONG_PX, align, flight_and_out, print_head, print_row, run, timed
from peers import dis_flow
from relief_score import Score, mapping_of, occlusion_scores, range_errors, read_sidecar, residuals
from synthetic_flights.depth import Scene, Truth, write_capture
from synthetic_flights.relief import FOOLING, GEOMETRIES, fooling, make_scene

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
