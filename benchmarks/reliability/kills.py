"""Kill a run at random moments, run the same command again, and compare with an undisturbed run.

    python benchmarks/reliability/kills.py [--kills 50] [--markdown FILE]

The synthetic flight, `--layout both` with an error map and STAC items, so that every kind of file is at stake. Moments
are drawn evenly over the time that an undisturbed run takes; SIGKILL goes to the run and, every other time, to its
workers with it. Compared are all files that a run writes, rasters pixel by pixel, sidecars without the seconds.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
import rasterio
from report import Section

from agalign.products.sidecar_file import find_sidecars
from agalign.synthetic import flight as synthetic
from agalign.values.files import RUN_FILE

CAPTURES, SIZE_PX = 12, (480, 360)
OPTIONS = ("--layout", "both", "--error-map", "--stac", "-j", "2", "-q")
CHANGING = {RUN_FILE, "summary.csv", "index.html"}
"""These hold seconds."""


def command(flight: Path, out: Path) -> list[str]:
    return [sys.executable, "-m", "agalign", str(flight), "-o", str(out), *OPTIONS]


def without_seconds(value: object) -> object:
    if isinstance(value, dict):
        return {k: without_seconds(v) for k, v in value.items() if k != "seconds"}
    return [without_seconds(v) for v in value] if isinstance(value, list) else value


def contents(path: Path) -> object:
    """What must be equal: pixels and what is said of them, JSON without times, else the bytes."""
    if path.suffix in (".tif", ".tiff"):
        with rasterio.open(path) as source:
            return source.profile["dtype"], source.descriptions, source.read().tobytes()
    if path.suffix == ".json":
        return without_seconds(json.loads(path.read_text()))
    return path.read_bytes()


def files(out: Path) -> dict[str, Path]:
    return {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file() and p.name not in CHANGING}


def differences(out: Path, expected: dict[str, object]) -> Counter[str]:
    """Return the numbers of missing, left-over, unreadable and different files."""
    result: Counter[str] = Counter()
    here = files(out)
    result["missing"] = len(expected.keys() - here.keys())
    result["left over"] = len(here.keys() - expected.keys())
    for name in expected.keys() & here.keys():
        try:
            if contents(here[name]) != expected[name]:
                result["different"] += 1
                print("different:", name)
        except Exception as error:
            print(name, error)
            result["corrupt"] += 1
    return result


def whole_sidecars(out: Path) -> Counter[str]:
    """Right after a kill: a sidecar that is there must be readable, and its files must be as it says."""
    result: Counter[str] = Counter()
    for path in find_sidecars(out) if out.is_dir() else []:
        try:
            output = json.loads(path.read_text())["output"]
        except ValueError:
            result["torn sidecars"] += 1
            continue
        named = [*output["band_files"], {"file": output["file"], "bytes": output["bytes"]}]
        result["torn captures"] += any(
            not (path.parent / f["file"]).is_file() or (path.parent / f["file"]).stat().st_size != f["bytes"]
            for f in named
        )
    return result


def kill_after(seconds: float, argv: list[str], *, workers_too: bool) -> bool:
    """Return True if the run was still running."""
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(seconds)
    running = process.poll() is None
    children = psutil.Process(process.pid).children(recursive=True) if running else []
    for one in [process.pid, *(c.pid for c in children if workers_too)]:
        try:
            os.kill(one, signal.SIGKILL)
        except ProcessLookupError:
            continue
    process.wait()
    psutil.wait_procs(children, timeout=10)
    left = [c for c in children if c.is_running() and c.status() != psutil.STATUS_ZOMBIE]
    if left:
        raise SystemExit(f"processes outlived the run: {left}")
    return running


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--kills", type=int, default=50)
    options.add_argument("--rng-seed", type=int, default=0)
    options.add_argument("--markdown", type=Path)
    asked = options.parse_args()
    section, rng = Section("kills", asked.markdown), random.Random(asked.rng_seed)
    np.seterr(all="ignore")
    with tempfile.TemporaryDirectory() as folder:
        flight, whole, out = Path(folder, "flight"), Path(folder, "whole"), Path(folder, "out")
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        began = time.monotonic()
        subprocess.run(command(flight, whole), check=True)
        seconds = time.monotonic() - began
        expected = {name: contents(path) for name, path in files(whole).items()}
        result: Counter[str] = Counter()
        hit, kept = 0, []
        for number in range(asked.kills):
            shutil.rmtree(out, ignore_errors=True)
            at = rng.uniform(0.02, 1.0) * seconds
            hit += kill_after(at, command(flight, out), workers_too=bool(number % 2))
            torn = whole_sidecars(out)
            done = subprocess.run([*command(flight, out)[:-1], "--log-json"], capture_output=True, text=True)
            kept.append(done.stderr.count('"state": "kept"'))
            here = differences(out, expected) + torn
            here["bad exit codes"] = int(done.returncode != 0)
            here = Counter({k: v for k, v in here.items() if v})
            print(
                f"{number + 1}: killed after {at:.1f} s, {kept[-1]} captures kept, {dict(here) or 'equal'}", flush=True
            )
            result += here
        section.say(
            f"{asked.kills} kills of a run of {seconds:.0f} s over {CAPTURES} captures ({hit} while it was running; "
            f"between {min(kept)} and {max(kept)} captures were finished by then), each followed by the same command: "
            f"{asked.kills - result['bad exit codes']} exit codes 0."
        )
        kinds = ("torn sidecars", "torn captures", "missing", "left over", "corrupt", "different")
        section.table([("after the kill, and after resuming", "files"), *((k, str(result[k])) for k in kinds)])


if __name__ == "__main__":
    main()
