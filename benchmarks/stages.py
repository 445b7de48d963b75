"""Time of the stages of a run, and of SIFT + RANSAC on the same images, in seconds.

    python benchmarks/stages.py FLIGHT

One process, one thread. SIFT, the imports, a run, and the same with the model that it learned are timed in turn, three
times; the table has medians. "A capture" is one that no model was learned from or tested with,
as most of a long flight; the fixed part is the time of the run minus that of as many such captures.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import cv2
import numpy as np
from common import command, print_head, print_row, run, timed
from peers import sift

from agalign.cameras.discover import discover
from agalign.pixels.raster import open_raster, without_warnings
from agalign.values.capture import Band

ROUNDS = 3
IMPORTS = "import torch, cv2, rasterio, scipy"


def read(band: Band) -> np.ndarray:
    with without_warnings(), open_raster(band.path) as source:
        return np.asarray(source.read(band.band_index))


def sift_seconds(reference: Band, moving: Sequence[Band], features: int) -> float:
    """Return the seconds of SIFT + RANSAC on the reference with each other band at full size."""
    fixed = read(reference)
    return sum(timed(sift, fixed, read(band), features)[0] for band in moving)


def run_alone(argv: list[str]) -> tuple[float, str]:
    """Run a command on one core; return its time in seconds and its standard error."""
    options = {"env": os.environ | {"OMP_NUM_THREADS": "1"}, "stderr": subprocess.PIPE, "text": True}
    seconds, done = timed(subprocess.run, argv, check=False, **options)
    return seconds, done.stderr


def events(log: str, name: str) -> list[dict[str, Any]]:
    """Return the events of a kind in a log in JSON."""
    every = [json.loads(line) for line in log.splitlines() if line.startswith("{")]
    return [event for event in every if event["event"] == name]


def runs(flight: Path) -> list[tuple[float, str]]:
    """Return (seconds, log) of a run on one core, and of one with the model that the first has learned, if any."""
    with tempfile.TemporaryDirectory() as folder:
        out, again = Path(folder) / "out", Path(folder) / "again"
        first = run_alone(command(flight, out, "-j", "1", "--log-json"))
        with_model = [option for path in (out / "models").glob("*") for option in ("--model", str(path))]
        return [first, run_alone(command(flight, again, "-j", "1", "--log-json", *with_model[:2]))]


def main(flight: Path) -> None:
    cv2.setNumThreads(1)
    captures = discover(flight).captures
    middle = captures[len(captures) // 2]  # the first may show the sky or a panel
    seconds: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        values = {"SIFT + RANSAC, a pair": sift_seconds(middle.reference, middle.moving[:1], 8000)}
        values["imports of the libraries"] = run_alone([sys.executable, "-c", IMPORTS])[0]
        (whole_s, _), (again_s, log) = runs(flight)
        by_capture: dict[str, Counter[str]] = {}
        for event in events(log, "stage"):
            by_capture.setdefault(event["capture"], Counter())[event["stage"]] += event["seconds"]
        refined = [stages for stages in by_capture.values() if "refining" in stages] or list(by_capture.values())
        stages = {name: mean(one[name] for one in refined) for name in {n for one in refined for n in one}}
        capture_s = values["a capture"] = sum(stages.values())
        values |= {f"- {name}": stages[name] for name in sorted(stages, key=lambda name: -stages[name])}
        for name, run_s in (("a run", whole_s), ("a run with the model of an earlier flight", again_s)):
            values |= {name: run_s, f"{name}: fixed part": run_s - capture_s * len(captures)}
        for name, value in values.items():
            seconds.setdefault(name, []).append(value)
    print(f"{flight.name}: {len(captures)} captures, {sum(len(c.moving) for c in captures)} pairs")
    print_head("", "seconds")
    for name, some in seconds.items():
        print_row(name, f"{median(some):.2f}")


if __name__ == "__main__":
    run(main)
