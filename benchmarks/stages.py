"""Time of the stages of a run, in seconds and relative to SIFT + RANSAC on the same images.

    python benchmarks/stages.py FLIGHT [--peers]

One process, one thread. The imports, a run, the same with the model that it learned, and the methods that others use
are timed in turn, three times; the table has medians. "A capture" is one that no model was learned from or tested with,
as most of a long flight; the fixed part is the time of the run minus that of as many such captures.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from bands.images import read
from bands.methods import Align, UnavailableError, by_ransac, grey_8_bit, method_named
from bands.score import Matrix

from agalign.cameras.discover import discover

ROUNDS = 3
PEERS = ("ECC on gradients", "elastix affine", "XFeat")
_FEATURES = 8000
ONE_THREAD = {"OMP_NUM_THREADS": "1"}
IMPORTS = "import torch, cv2, rasterio, scipy"


def sift(fixed: np.ndarray, moving: np.ndarray) -> Matrix | None:
    """SIFT with 8000 features, ratio test, RANSAC."""
    detector = cv2.SIFT.create(_FEATURES)
    (k1, d1), (k2, d2) = (detector.detectAndCompute(grey_8_bit(image), None) for image in (fixed, moving))
    good = [a for a, b in cv2.BFMatcher().knnMatch(d1, d2, k=2) if a.distance < 0.8 * b.distance]
    here, there = (np.array([k[getattr(g, i)].pt for g in good]) for k, i in ((k1, "queryIdx"), (k2, "trainIdx")))
    return by_ransac(here.astype(np.float32), there.astype(np.float32), cv2.RANSAC, 3.0)


def seconds_of(act: Callable[[], object]) -> float:
    began = time.perf_counter()
    act()
    return time.perf_counter() - began


def timed(command: list[str]) -> tuple[float, str]:
    """Run a command; return its time in seconds and its standard error."""
    began = time.perf_counter()
    done = subprocess.run(command, check=False, env=os.environ | ONE_THREAD, stderr=subprocess.PIPE, text=True)
    return time.perf_counter() - began, done.stderr


def stages_of_refined(log: str) -> dict[str, float]:
    """Return the mean seconds of each stage, from a log in JSON, of the captures that were refined in this run."""
    by_capture: dict[str, dict[str, float]] = {}
    for event in (json.loads(line) for line in log.splitlines() if line.startswith("{")):
        if event["event"] == "stage":
            stages = by_capture.setdefault(event["capture"], {})
            stages[event["stage"]] = stages.get(event["stage"], 0.0) + event["seconds"]
    refined = [s for s in by_capture.values() if "refining" in s] or list(by_capture.values())
    names = {name for stages in refined for name in stages}
    return {name: sum(stages.get(name, 0.0) for stages in refined) / len(refined) for name in names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--peers", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    captures = discover(options.flight).captures
    middle = captures[len(captures) // 2]  # the first may show the sky or a panel
    pair = read(middle.reference.path), read(middle.moving[0].path)
    methods: dict[str, Align] = {"SIFT + RANSAC": sift}
    for name in PEERS if options.peers else ():
        try:
            methods[name] = method_named(name)
        except UnavailableError as error:
            print(f"{name}: {error}", file=sys.stderr)
    seconds: dict[str, list[float]] = {}
    pairs = sum(len(c.moving) for c in captures)
    for _ in range(ROUNDS):
        for name, align in methods.items():
            seconds.setdefault(f"{name}, a pair", []).append(seconds_of(lambda align=align: align(*pair)))
        seconds.setdefault("imports of the libraries", []).append(timed([sys.executable, "-c", IMPORTS])[0])
        with tempfile.TemporaryDirectory() as folder:
            out, again = Path(folder) / "out", Path(folder) / "again"
            command = [sys.executable, "-m", "agalign", str(options.flight), "-j", "1", "--log-json", "-o"]
            whole, _ = timed([*command, str(out)])
            model = next((out / "models").iterdir())
            with_model, log = timed([*command, str(again), "--model", str(model)])
        stages = stages_of_refined(log)
        capture = sum(stages.values())
        values = {"a capture": capture, **{f"- {name}": s for name, s in sorted(stages.items(), key=lambda i: -i[1])}}
        for name, run_s in (("a run", whole), ("a run with the model of an earlier flight", with_model)):
            values |= {name: run_s, f"{name}: fixed part": run_s - capture * len(captures)}
        for name, value in values.items():
            seconds.setdefault(name, []).append(value)
    unit, imports = median(seconds["SIFT + RANSAC, a pair"]), median(seconds["imports of the libraries"])
    print(f"{options.flight.name}: {len(captures)} captures, {pairs} pairs")
    print("| | seconds | x SIFT | x imports |\n|---|---|---|---|")
    for name, values in seconds.items():
        value = median(values)
        print(f"| {name} | {value:.2f} | {value / unit:.2f} | {value / imports:.2f} |")


if __name__ == "__main__":
    main()
