"""Time of captures of scenes with depth on one core, relative to SIFT + RANSAC on all band pairs of the same capture.

    python benchmarks/depth_speed.py DATA [SET ...] [--good SET]

Each SET is a folder below DATA; missing ones are left out. A set is aligned without a model, which includes learning
one, and again with the learned model. A second table has degraded versions of the first capture of the set --good, each
aligned without a model, and their time relative to that of the unchanged capture.
"""

import shutil
from pathlib import Path
from statistics import median
from typing import Annotated

import cv2
import numpy as np
import rasterio
import typer
from bands.images import in_other_light
from common import command, flight_and_out, print_head, print_row, run
from stages import events, read, run_alone, runs, sift_seconds

from agalign.cameras.discover import discover
from agalign.pixels.raster import without_warnings
from agalign.values.capture import Capture

SETS = ("boom_two_depths", "p4m_forest", "p4m_bananas", "rededge_mx_dual", "sentera_d4k")
DEGRADED = ("unchanged", "blur 3 px", "half saturated", "noise 30 %", "stale")


def print_set(folder: Path, captures: list[Capture]) -> None:
    """Print medians over the captures of a set."""
    without, with_model = (log for _, log in runs(folder))
    learning_s = sum(event["seconds"] for event in events(without, "learnt")) / len(captures)
    first_s, again_s = (median(e["seconds"] for e in events(log, "capture")) for log in (without, with_model))
    sift_s = median(sift_seconds(c.reference, c.moving, 5000) for c in captures)
    times_s = learning_s + first_s, again_s, sift_s
    aligned = "{aligned} of {pairs}".format(**events(with_model, "capture")[0])
    cells = [f"{s:.1f}" for s in times_s] + [f"{s / sift_s:.2f}" for s in times_s[:2]]
    print_row(folder.name, len(captures), aligned, *cells)


def degraded_run(captures: list[Capture], name: str) -> tuple[float, str]:
    """Return (seconds, bands aligned) of the first capture with the moving bands in a variant; `stale` is one band with
    the image of the next capture.
    """
    first, rng = captures[0], np.random.default_rng(0)
    with flight_and_out() as (flight, out):
        flight.mkdir()
        for band in first.bands:
            shutil.copyfile(band.path, flight / band.path.name)
        for k, band in enumerate(first.moving if name != "unchanged" else ()):
            if name == "stale" and k:
                continue
            pixels = read(captures[1].moving[0]) if name == "stale" else in_other_light(read(band), name, rng)
            with without_warnings(), rasterio.open(flight / band.path.name, "r+") as dataset:
                dataset.write(pixels, band.band_index)
        _, log = run_alone(command(flight, out, "-j", "1", "--log-json"))
    learning_s = sum(event["seconds"] for event in events(log, "learnt"))
    (capture,) = events(log, "capture")
    return learning_s + capture["seconds"], "{aligned} of {pairs}".format(**capture)


def main(data: Path, sets: Annotated[list[str] | None, typer.Argument()] = None, *, good: str = SETS[0]) -> None:
    cv2.setNumThreads(1)
    names = [name for name in sets or SETS if (data / name).is_dir()]
    captures = {name: discover(data / name).captures for name in {*names, good}}
    times = "without a model, s a capture", "with a model", "SIFT + RANSAC", "without / SIFT", "with / SIFT"
    print_head("set", "captures", "aligned in the first", *times)
    for name in names:
        print_set(data / name, captures[name])
    print(f"\nThe first capture of {good}:\n", flush=True)
    print_head("variant", "aligned", "s", "times the unchanged one")
    unchanged_s = 0.0
    for name in DEGRADED if len(captures[good]) > 1 else DEGRADED[:-1]:
        seconds, aligned = degraded_run(captures[good], name)
        unchanged_s = unchanged_s or seconds
        print_row(name, aligned, f"{seconds:.1f}", f"{seconds / unchanged_s:.2f}")


if __name__ == "__main__":
    run(main)
