"""Alignment of scenes with depth, against their exact geometry: terraces, plants and boxes from 1-2 m and from 20 m.

    python benchmarks/relief.py [--scenes N] [--kinds flat,boxes] [--ranges close,far] [--size 640x480] [--methods ...]
    python benchmarks/relief.py --fooled [N]

Each scene is one capture of a synthetic RedEdge in a folder of its own, aligned by the command line with its defaults.
The other methods start from `--relief never`: elastix's B-splines (`pip install 'agalign[bench]'`) and OpenCV's dense
flows. Residuals are the distance to the true position of each written pixel that a band shows. `--fooled` counts bands
that are called `aligned` though more than a tenth of what they show is more than 1 px off, or they show another scene.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile
from relief_peers import Peer, available, by_peer
from relief_score import (
    WRONG_PX,
    Map,
    Score,
    is_wrong,
    mapping_of,
    occlusion_scores,
    range_errors,
    read_sidecar,
    residuals,
)
from synthetic_flights.depth import Scene, Truth, write_capture
from synthetic_flights.relief import FOOLING, GEOMETRIES, SCENES, fooling, fooling_scene, make_scene

DEFAULT, START = "agalign", "agalign, homography alone"
_OPTIONS = {DEFAULT: ("--relief-map",), START: ("--relief", "never")}
"""The relief's map changes no alignment; it contains the range, which is scored."""
_FIRST_SEED = 1000
"""Apart from those of the fooling scenes."""


def run_program(flight: Path, out: Path, method: str) -> float:
    """Seconds of `agalign FOLDER`. Exit code 3 is that of bands that are not aligned."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "agalign", str(flight), "-o", str(out), "-q", *_OPTIONS[method]]
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - began


def program_scores(out: Path, truth: Truth, blank: Score) -> tuple[list[Score], dict[str, tuple[str, Map | None]]]:
    """(scores, {file: (name of the band, its mapping)}) of a run on one capture."""
    sidecar = read_sidecar(out)
    range_error, density = range_errors(sidecar, truth)
    scores, maps = [], {}
    for band in sidecar.content["bands"]:
        if band["status"] == "reference":
            continue
        known, mapping = truth.bands[band["band"]], mapping_of(sidecar, band)
        maps[band["file"]] = band["band"], mapping
        median, p90, beyond = residuals(mapping, known, sidecar.window)
        precision, recall = occlusion_scores(sidecar, band, known)
        scores.append(replace(
            blank, band=band["band"], status=band["status"], median_px=median, p90_px=p90, beyond_1_px=beyond,
            wrong=is_wrong(band["status"], p90), range_error=range_error, density=density, precision=precision,
            recall=recall,
        ))  # fmt: skip
    return scores, maps


def peer_scores(
    peer: Peer, flight: Path, out: Path, truth: Truth, maps: dict[str, tuple[str, Map | None]], blank: Score
) -> list[Score]:
    """Scores of a peer on one capture; a band without a start has none."""
    images = {p.name: tifffile.imread(p).astype(np.float32) for p in flight.rglob("*.tif")}
    sidecar = read_sidecar(out)
    reference = images[sidecar.content["reference"]["file"]]
    began, rows = time.perf_counter(), []
    for file, (band, start) in maps.items():
        mapping = None if start is None else by_peer(peer, reference, images[file], start)
        rows.append((band, *residuals(mapping, truth.bands[band], sidecar.window)))
    seconds = time.perf_counter() - began
    return [
        replace(blank, band=band, median_px=median, p90_px=p90, beyond_1_px=beyond, seconds=seconds)
        for band, median, p90, beyond in rows
    ]


def of_scene(scene: Scene, number: int, close: bool, size_px: tuple[int, int], methods: Sequence[str]) -> list[Score]:
    """Scores of all methods on one scene."""
    blank = Score("", scene.kind, close, number, "", "-", np.nan, np.nan, np.nan, False)
    peers = {name: peer for name, peer in available().items() if name in methods}
    result: list[Score] = []
    with tempfile.TemporaryDirectory() as temporary:
        flight = Path(temporary) / "flight"
        truth = write_capture(flight, scene, size_px=size_px, rng_seed=number)
        for method in (m for m in _OPTIONS if m in methods or (m == START and peers)):
            out = Path(temporary) / method
            seconds = run_program(flight, out, method)
            scores, maps = program_scores(out, truth, replace(blank, method=method, seconds=seconds))
            result += scores
        for name, peer in peers.items():
            result += peer_scores(peer, flight, Path(temporary) / START, truth, maps, replace(blank, method=name))
    return result


_HEADER = (
    "| kind | range | method | bands | aligned | wrongly | median, px | p90, px | beyond 1 px | range error | density "
    "| occlusion precision | recall | s a capture |"
)


def row(title: Sequence[str], scores: Sequence[Score]) -> str:
    """A line of the table: medians over bands."""
    aligned = "-" if scores[0].status == "-" else str(sum(s.status == "aligned" for s in scores))
    wrong = "-" if scores[0].status == "-" else str(sum(s.wrong for s in scores))
    cells = [str(len(scores)), aligned, wrong]
    for name, style in (
        ("median_px", ".3f"), ("p90_px", ".2f"), ("beyond_1_px", ".1%"), ("range_error", ".2%"), ("density", ".0%"),
        ("precision", ".0%"), ("recall", ".0%"), ("seconds", ".1f"),
    ):  # fmt: skip
        values = np.array([getattr(s, name) for s in scores])
        values = values[~np.isnan(values)]
        cells.append(format(np.median(values), style) if len(values) else "-")
    return "| " + " | ".join([*title, *cells]) + " |"


def table(scores: Sequence[Score]) -> str:
    """A row for each kind, range and method, and one for all scenes of a method."""
    keys = dict.fromkeys((s.kind, s.close, s.method) for s in scores)
    lines = [_HEADER, "|---" * (_HEADER.count("|") - 1) + "|"]
    for kind, close, method in sorted(keys, key=lambda k: (GEOMETRIES + FOOLING).index(k[0])):
        some = [s for s in scores if (s.kind, s.close, s.method) == (kind, close, method)]
        lines.append(row((kind, "1-2 m" if close else "20 m", method), some))
    methods = dict.fromkeys(s.method for s in scores)
    lines += [row(("all", "", method), [s for s in scores if s.method == method]) for method in methods]
    return "\n".join(lines)


def report_wrong(scores: Iterable[Score]) -> None:
    """List the bands that are wrongly called aligned."""
    for s in scores:
        if s.wrong:
            off = "another scene" if np.isnan(s.p90_px) else f"median {s.median_px:.2f} px, p90 {s.p90_px:.2f} px"
            print(f"  {s.kind}, {'close' if s.close else 'far'}, scene {s.scene}, {s.band}, {s.method}: {off}")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    methods = (*_OPTIONS, *available())
    parser.add_argument("--scenes", type=int, default=2, help="of each kind and range")
    parser.add_argument("--kinds", default=",".join(GEOMETRIES))
    parser.add_argument("--ranges", default="close,far")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--methods", help=f"separated by ;: {'; '.join(methods)}; all, and the first for --fooled")
    parser.add_argument("--fooled", type=int, nargs="?", const=SCENES, help="count wrong bands on N fooling scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    options = parser.parse_args()
    options.size = tuple(int(n) for n in options.size.split("x"))
    usual = methods if options.fooled is None else (DEFAULT,)
    options.methods = usual if options.methods is None else tuple(m.strip() for m in options.methods.split(";"))
    return options


def main() -> None:
    options, scores = parsed(), list[Score]()
    if options.fooled is None:
        plan = [
            (kind, place == "close", _FIRST_SEED + options.first + number)
            for kind in options.kinds.split(",")
            for place in options.ranges.split(",")
            for number in range(options.scenes)
        ]
    else:
        plan = [(*fooling(n), n) for n in range(options.first, options.first + options.fooled)]
    for kind, close, number in plan:
        if options.fooled is None:
            scene = make_scene(kind, number, close=close, width_px=options.size[0])
        else:
            scene = fooling_scene(number, options.size[0])
        result = of_scene(scene, number, close, options.size, options.methods)
        scores += result
        statuses = ", ".join(f"{s.band} {s.status} {s.p90_px:.2f}" for s in result if s.method == options.methods[0])
        print(f"{kind}, {'close' if close else 'far'}, scene {number}: {statuses}", file=sys.stderr, flush=True)
    print(table(scores))
    wrong = sum(s.wrong for s in scores)
    aligned = sum(s.status == "aligned" for s in scores)
    print(
        f"\n{wrong} of {aligned} bands called aligned are more than {WRONG_PX:g} px off at p90, or show another scene"
    )
    report_wrong(scores)


if __name__ == "__main__":
    main()
