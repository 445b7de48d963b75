"""Time of the stages of a run, in seconds and relative to SIFT + RANSAC on the same images.

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
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import mean, median

import cv2
from bands.images import read
from common import command, print_head, print_row, run
from peers import sift

from agalign.cameras.discover import discover

ROUNDS = 3
IMPORTS = "import torch, cv2, rasterio, scipy"


def seconds_of(act: Callable[[], object]) -> float:
    began = time.perf_counter()
    act()
    return time.perf_counter() - began


def timed(argv: list[str]) -> tuple[float, str]:
    """Run a command on one core; return its time in seconds and its standard error."""
    began = time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(argv, check=False, env=environment, stderr=subprocess.PIPE, text=True)
    return time.perf_counter() - began, done.stderr


def captures_of(log: str) -> dict[str, dict[str, float]]:
    """Return {capture: {stage: seconds}} from a log in JSON."""
    result: dict[str, dict[str, float]] = {}
    for event in (json.loads(line) for line in log.splitlines() if line.startswith("{")):
        if event["event"] == "stage":
            stages = result.setdefault(event["capture"], {})
            stages[event["stage"]] = stages.get(event["stage"], 0.0) + event["seconds"]
    return result


def runs(flight: Path) -> list[tuple[float, str]]:
    """Return (seconds, log) of a run on one core, and of one with the model that the first has learned, if any."""
    with tempfile.TemporaryDirectory() as folder:
        out, again = Path(folder) / "out", Path(folder) / "again"
        first = timed(command(flight, out, "-j", "1", "--log-json"))
        with_model = [option for path in (out / "models").glob("*") for option in ("--model", str(path))]
        return [first, timed(command(flight, again, "-j", "1", "--log-json", *with_model[:2]))]


def main(flight: Path) -> None:
    cv2.setNumThreads(1)
    captures = discover(flight).captures
    middle = captures[len(captures) // 2]  # the first may show the sky or a panel
    pair = read(middle.reference.path), read(middle.moving[0].path)
    seconds: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        values = {"SIFT + RANSAC, a pair": seconds_of(partial(sift, *pair, features=8000))}
        values["imports of the libraries"] = timed([sys.executable, "-c", IMPORTS])[0]
        (whole_s, _), (again_s, log) = runs(flight)
        every = captures_of(log)
        refined = [stages for stages in every.values() if "refining" in stages] or list(every.values())
        stages = {name: mean(one.get(name, 0.0) for one in refined) for name in {n for one in refined for n in one}}
        capture_s = values["a capture"] = sum(stages.values())
        values |= {f"- {name}": stages[name] for name in sorted(stages, key=lambda name: -stages[name])}
        for name, run_s in (("a run", whole_s), ("a run with the model of an earlier flight", again_s)):
            values |= {name: run_s, f"{name}: fixed part": run_s - capture_s * len(captures)}
        for name, value in values.items():
            seconds.setdefault(name, []).append(value)
    unit, imports = median(seconds["SIFT + RANSAC, a pair"]), median(seconds["imports of the libraries"])
    print(f"{flight.name}: {len(captures)} captures, {sum(len(c.moving) for c in captures)} pairs")
    print_head("", "seconds", "x SIFT", "x imports")
    for name, some in seconds.items():
        value = median(some)
        print_row(name, *(f"{v:.2f}" for v in (value, value / unit, value / imports)))


if __name__ == "__main__":
    run(main)
