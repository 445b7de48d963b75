"""Kill a run at random moments, run the same command again, and compare with an undisturbed run.

    python benchmarks/reliability/kills.py [--kills 50] [--markdown FILE]

The synthetic flight, `--layout both` with an error map and STAC items, so that every kind of file is at stake. Moments
are drawn evenly over the time that an undisturbed run takes; SIGKILL goes to the run and, every other time, to its
workers with it. Compared are all files that a run writes, rasters pixel by pixel, sidecars without the seconds.
"""

import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import rasterio

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Section, align, command, run

from agalign.products.sidecar_file import find_sidecars
from agalign.synthetic import flight as synthetic
from agalign.values.files import RUN_FILE

CAPTURES, SIZE_PX = 12, (480, 360)
OPTIONS = ("--layout", "both", "--error-map", "--stac", "-j", "2")
CHANGING = {RUN_FILE, "summary.csv", "index.html"}
"""These hold seconds."""


def without(value: object, names: Collection[str]) -> object:
    """Return a JSON value without the entries of these names."""
    if isinstance(value, dict):
        return {k: without(v, names) for k, v in value.items() if k not in names}
    return [without(v, names) for v in value] if isinstance(value, list) else value


def contents(path: Path) -> object:
    """Return what must be equal: pixels and names of bands, JSON without times, else the bytes."""
    if path.suffix == ".tif":
        with rasterio.open(path) as source:
            return source.profile["dtype"], source.descriptions, source.read().tobytes()
    return without(json.loads(path.read_text()), {"seconds"}) if path.suffix == ".json" else path.read_bytes()


def snapshot(out: Path, content: Callable[[Path], object] = contents) -> dict[str, object]:
    """Return the contents of the files of a run by name; the error of an unreadable one."""
    result: dict[str, object] = {}
    for path in (p for p in out.rglob("*") if p.is_file() and p.name not in CHANGING):
        try:
            result[path.relative_to(out).as_posix()] = content(path)
        except Exception as error:
            result[path.relative_to(out).as_posix()] = error
    return result


def differences(out: Path, expected: dict[str, object], content: Callable[[Path], object] = contents) -> Counter[str]:
    """Return the numbers of missing, left-over, unreadable and different files."""
    here = snapshot(out, content)
    result = Counter({"missing": len(expected.keys() - here), "left over": len(here.keys() - expected)})
    for name in expected.keys() & here:
        corrupt = isinstance(here[name], Exception)
        if corrupt or here[name] != expected[name]:
            print("corrupt:" if corrupt else "different:", name)
            result["corrupt" if corrupt else "different"] += 1
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
    process.kill()
    for child in children if workers_too else ():
        with suppress(psutil.NoSuchProcess):
            child.kill()
    process.wait()
    psutil.wait_procs(children, timeout=10)
    left = [c for c in children if c.is_running() and c.status() != psutil.STATUS_ZOMBIE]
    if left:
        raise SystemExit(f"processes outlived the run: {left}")
    return running


def main(kills: int = 50, rng_seed: int = 0, markdown: Path | None = None) -> None:
    section, rng = Section("kills", markdown), random.Random(rng_seed)
    np.seterr(all="ignore")
    with tempfile.TemporaryDirectory() as folder:
        flight, whole, out = Path(folder, "flight"), Path(folder, "whole"), Path(folder, "out")
        synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=4)
        seconds = align(flight, whole, *OPTIONS)
        expected = snapshot(whole)
        result: Counter[str] = Counter()
        hit, kept = 0, []
        for number in range(kills):
            shutil.rmtree(out, ignore_errors=True)
            at = rng.uniform(0.02, 1.0) * seconds
            hit += kill_after(at, command(flight, out, *OPTIONS), workers_too=bool(number % 2))
            torn = whole_sidecars(out)
            again = command(flight, out, *OPTIONS, "--log-json")
            done = subprocess.run(again, capture_output=True, text=True, check=False)
            kept.append(done.stderr.count('"state": "kept"'))
            here = +(differences(out, expected) + torn + Counter({"bad exit codes": int(done.returncode != 0)}))
            print(
                f"{number + 1}: killed after {at:.1f} s, {kept[-1]} captures kept, {dict(here) or 'equal'}", flush=True
            )
            result += here
        section.say(
            f"{kills} kills of a run of {seconds:.0f} s over {CAPTURES} captures ({hit} while it was running; "
            f"between {min(kept)} and {max(kept)} captures were finished by then), each followed by the same command: "
            f"{kills - result['bad exit codes']} exit codes 0. Files after the kill: {result['torn sidecars']} torn "
            f"sidecars, {result['torn captures']} torn captures; after resuming: {result['missing']} missing, "
            f"{result['left over']} left over, {result['corrupt']} corrupt, {result['different']} different."
        )


if __name__ == "__main__":
    run(main)
