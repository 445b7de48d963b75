"""Time of a run on one core, and of SIFT + MAGSAC on the same images.

    python benchmarks/speed.py FLIGHT... [--degraded] [--figures]
    python benchmarks/speed.py FLIGHT... --stages
    python benchmarks/speed.py FLIGHT... --floor

FLIGHT is a folder with captures. It is aligned without a model, which includes learning one, and again with the learned
model; SIFT gets all band pairs of each capture. --degraded adds a table of degraded versions of the first capture of
the first flight, each aligned without a model.

--stages has the stages in seconds. SIFT on a pair, the imports, a run, and the same with the model that it learned are
timed in turn, three times; the table has medians. "A capture" is one that no model was learned from or tested with, as
most of a long flight; the fixed part is the time of the run minus that of as many such captures.
"""

import json
import os
import shutil
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import rasterio
import torch
from bands.images import in_other_light
from common import command, ended, flight_and_out, print_head, print_row, read_band, run, timed, write_band
from figures_csv import FiguresOption, TableRow, title_of, write_figures
from peers import sift

from agalign import Settings, WriteSettings, read_alignment
from agalign.batch.capture_task import Task, process_capture
from agalign.cameras.discover import discover
from agalign.pixels.radiometry import with_radiometry
from agalign.rasters.geotiff import compressed, tiled_profile
from agalign.rasters.product import CapturePaths
from agalign.values.capture import Capture
from agalign.values.image import Tile

ROUNDS, MAX_S = 3, 3600
LOGGED = "-j", "1", "--log-json"
Events = dict[str, list[dict[str, Any]]]
"""Events of a log in JSON by kind."""
IMPORTS = "import torch, cv2, rasterio, scipy"
DEGRADED = ("unchanged", "blur 3 px", "half saturated", "noise 30 %", "stale")
"""`stale` is one band with the image of the next capture."""


def sift_seconds(capture: Capture, pairs: int) -> float:
    """Return the seconds of SIFT + MAGSAC on the reference of a capture with some of its other bands at full size."""
    bands = capture.reference, *capture.moving[:pairs]
    fixed, *others = (read_band(band.path, band.band_index) for band in bands)
    return sum(timed(sift, fixed, other)[0] for other in others)


def run_alone(*argv: str) -> tuple[float, Events]:
    """Run a command with one thread; return (seconds, the events of its log)."""
    ending = ended(argv, MAX_S, env=os.environ | {"OMP_NUM_THREADS": "1"})
    events = defaultdict[str, list[dict[str, Any]]](list)
    for event in (json.loads(line) for line in ending.errors.splitlines() if line.startswith("{")):
        events[event["event"]].append(event)
    return ending.seconds, events


def total_s(events: list[dict[str, Any]]) -> float:
    return sum(event["seconds"] for event in events)


def runs(flight: Path) -> list[tuple[float, Events]]:
    """Run with one thread, and again with the model that the first run has learned, if any."""
    with flight_and_out() as (again, out):
        first = run_alone(*command(flight, out, *LOGGED))
        with_model = [option for path in (out / "models").glob("*") for option in ("--model", str(path))]
        return [first, run_alone(*command(flight, again, *LOGGED, *with_model[:2]))]


def print_flight(folder: Path, captures: list[Capture]) -> TableRow:
    """Print medians over the captures of a flight, and return them for the figures."""
    (_, without), (_, with_model) = runs(folder)
    first_s, again_s = (median(e["seconds"] for e in events["capture"]) for events in (without, with_model))
    sift_s = median(sift_seconds(c, len(c.moving)) for c in captures)
    times_s = total_s(without["learned"]) / len(captures) + first_s, again_s, sift_s
    aligned = "{aligned} of {pairs}".format(**with_model["capture"][0])
    cells = [f"{s:.1f}" for s in times_s] + [f"{s / sift_s:.2f}" for s in times_s[:2]]
    print_row(folder.name, len(captures), aligned, *cells)
    heads = "without a model, s", "with a model, s", "SIFT + MAGSAC, s"
    n = f"{len(captures)} capture{'s' if len(captures) > 1 else ''}"
    return TableRow("captures with depth", title_of(folder), n, dict(zip(heads, cells[:3], strict=True)))


def print_degraded(captures: list[Capture]) -> None:
    """Print times of the first capture with the moving bands in each variant."""
    print_head("variant", "aligned", "s", "times the unchanged one")
    unchanged_s = 0.0
    for name in DEGRADED if len(captures) > 1 else DEGRADED[:-1]:
        rng = np.random.default_rng(0)
        with flight_and_out() as (flight, out):
            flight.mkdir()
            for band in captures[0].bands:
                shutil.copyfile(band.path, flight / band.path.name)
            changed = {"unchanged": (), "stale": captures[0].moving[:1]}.get(name, captures[0].moving)
            for band in changed:
                source = captures[1].moving[0] if name == "stale" else band
                pixels = read_band(source.path, source.band_index)
                pixels = pixels if name == "stale" else in_other_light(pixels, name, rng)
                write_band(flight / band.path.name, pixels, band.band_index)
            _, events = run_alone(*command(flight, out, *LOGGED))
        (capture,) = events["capture"]
        seconds = total_s(events["learned"]) + capture["seconds"]
        unchanged_s = unchanged_s or seconds
        print_row(name, "{aligned} of {pairs}".format(**capture), f"{seconds:.1f}", f"{seconds / unchanged_s:.2f}")


def print_stages(flight: Path, captures: list[Capture]) -> None:
    middle = captures[len(captures) // 2]  # the first may show the sky or a panel
    seconds = defaultdict[str, list[float]](list)
    for _ in range(ROUNDS):
        seconds["SIFT + MAGSAC, a pair"].append(sift_seconds(middle, 1))
        seconds["imports of the libraries"].append(run_alone(sys.executable, "-c", IMPORTS)[0])
        (whole_s, _), (again_s, events) = runs(flight)
        by_capture = defaultdict[str, Counter[str]](Counter)
        for event in events["stage"]:
            by_capture[event["capture"]][event["stage"]] += event["seconds"]
        refined = [stages for stages in by_capture.values() if "refining" in stages] or list(by_capture.values())
        total = sum(refined, Counter[str]())
        capture_s = total.total() / len(refined)
        seconds["a capture"].append(capture_s)
        for name, stage_s in total.most_common():
            seconds[f"- {name}"].append(stage_s / len(refined))
        for name, run_s in (("a run", whole_s), ("a run with the model of an earlier flight", again_s)):
            seconds[name].append(run_s)
            seconds[f"{name}: fixed part"].append(run_s - capture_s * len(captures))
    print(f"{flight.name}: {len(captures)} captures, {sum(len(c.moving) for c in captures)} pairs")
    print_head("", "seconds")
    for name, some in seconds.items():
        print_row(name, f"{median(some):.2f}")


def floor_s(capture: Capture, folder: Path) -> float:
    """Return the CPU seconds of reading the bands of an aligned capture, resampling them and writing the stack."""
    path = CapturePaths.of(capture, folder).sidecar
    width, height = capture.reference.size_px
    known = {b.name: read_alignment(path, b.name).mapping for b in capture.moving}
    positions = {name: mapping.positions(Tile(0, 0, width, height), np.float32) for name, mapping in known.items()}
    profile = tiled_profile(width, height, len(capture.bands), capture.reference.dtype, interleave="band")
    profile |= compressed("uint16", "zstd")
    began_s = time.process_time()
    planes = [read_band(band.path, band.band_index) for band in capture.bands]
    for k, band in enumerate(capture.bands):
        if band.name in positions:
            plane = cv2.remap(planes[k].astype(np.float32), positions[band.name], None, cv2.INTER_LANCZOS4)
            planes[k] = np.clip(np.rint(plane), 0, 65535).astype(planes[k].dtype)
    with rasterio.open(folder / "floor.tif", "w", **profile) as file:
        file.write(np.stack(planes))
    return time.process_time() - began_s


def print_floor(flight: Path, captures: list[Capture]) -> None:
    """Print the CPU seconds of a capture relative to the least that any program does."""
    seconds = defaultdict[str, list[float]](list)
    as_reflectance = Settings(write=WriteSettings(radiometry="sun"))
    with flight_and_out() as (_, out):
        run_alone(*command(flight, out, *LOGGED))
        (model,) = (out / "models").iterdir()
        in_light = [with_radiometry(capture, "sun", {}) for capture in captures]
        tasks = {
            "a capture with a model": [Task(c, out, Settings(), model) for c in captures],
            "rendered again as reflectance": [Task(c, out, as_reflectance, is_estimated=True) for c in in_light],
        }
        process_capture(tasks["a capture with a model"][0])  # loads the model and the libraries
        for _ in range(ROUNDS):
            for name, of_kind in tasks.items():
                for task in of_kind:
                    began_s = time.process_time()
                    process_capture(task)
                    seconds[name].append(time.process_time() - began_s)
            seconds["floor"] += [floor_s(capture, out) for capture in captures]
    floor = median(seconds["floor"])
    for name, some in seconds.items():
        print_row(flight.name, name, f"{median(some):.2f}", f"{median(some) / floor:.1f}")


def main(
    flights: list[Path],
    *,
    stages: bool = False,
    degraded: bool = False,
    floor: bool = False,
    figures: FiguresOption = False,
) -> None:
    if figures and (stages or floor):
        sys.exit("--figures writes no figures of --stages and --floor; omit them")
    cv2.setNumThreads(1)
    captures = {flight: discover(flight).captures for flight in flights}
    if floor:
        torch.set_num_threads(1)
        print_head("flight", "", "CPU s", "times the floor")
        for flight in flights:
            print_floor(flight, captures[flight])
        return
    if stages:
        for flight in flights:
            print_stages(flight, captures[flight])
        return
    times = "without a model, s a capture", "with a model", "SIFT + MAGSAC", "without / SIFT", "with / SIFT"
    print_head("flight", "captures", "aligned in the first", *times)
    rows = [print_flight(flight, captures[flight]) for flight in flights]
    if figures:
        write_figures(rows, "DATA/", flights)
    if degraded:
        print(f"\nThe first capture of {flights[0].name}:\n", flush=True)
        print_degraded(captures[flights[0]])


if __name__ == "__main__":
    run(main)
