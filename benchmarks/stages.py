"""Time of the stages of a run, in seconds and relative to SIFT + RANSAC on the same images.

    python benchmarks/stages.py FLIGHT [--peers]

One process, one thread. The imports, a run over the first capture and its neighbours, the same with the model that it
learned, and the methods that others use are timed in turn, three times; the table has medians.
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


def run(command: list[str]) -> None:
    subprocess.run(command, check=False, env=os.environ | ONE_THREAD, stderr=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--peers", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    captures = discover(options.flight).captures
    band = captures[0].moving[0]
    pair = read(captures[0].reference.path), read(band.path)
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
        seconds.setdefault("imports of the libraries", []).append(
            seconds_of(lambda: run([sys.executable, "-c", IMPORTS]))
        )
        with tempfile.TemporaryDirectory() as folder:
            model: list[str] = []
            for name in ("run", "run with the model of an earlier flight"):
                out = Path(folder) / name.replace(" ", "_")
                command = [
                    sys.executable,
                    "-m",
                    "agalign",
                    str(options.flight),
                    "-o",
                    str(out),
                    "-q",
                    "-j",
                    "1",
                    *model,
                ]
                whole = seconds_of(lambda command=command: run(command))
                record = json.loads((out / "agalign-run.json").read_text())
                stages = record["stage_seconds"]
                learning = stages.pop("learning a flight", 0.0)
                steady = sum(stages.values()) / len(captures)
                seconds.setdefault(f"{name}: all of it", []).append(whole)
                seconds.setdefault(f"{name}: fixed part", []).append(whole - steady * len(captures))
                seconds.setdefault(f"{name}: of it learning", []).append(learning)
                seconds.setdefault(f"{name}: a capture", []).append(steady)
                for stage, value in sorted(stages.items(), key=lambda item: -item[1]):
                    seconds.setdefault(f"{name}: {stage} a capture", []).append(value / len(captures))
                model = ["--model", str(next((out / "models").glob("*")))]
    unit, imports = median(seconds["SIFT + RANSAC, a pair"]), median(seconds["imports of the libraries"])
    print(f"{options.flight.name}: {len(captures)} captures, {pairs} pairs")
    print("| | seconds | x SIFT | x imports |\n|---|---|---|---|")
    for name, values in seconds.items():
        value = median(values)
        print(f"| {name} | {value:.2f} | {value / unit:.2f} | {value / imports:.2f} |")


if __name__ == "__main__":
    main()
