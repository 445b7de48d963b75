"""Send a signal to a run at random moments, run the same command again, and compare with an undisturbed run.

    python benchmarks/reliability/kills.py [--kills 50] [--modes "one job,two jobs,Dask,indices"]
        [--signals SIGKILL,SIGTERM,SIGINT,SIGHUP,SIGSTOP] [--captures 12] [--figures]

The synthetic flight, `--layout both` with an error map and tie points, so that every kind of file is at stake; and
`agalign indices` on five times as many aligned captures. `--kills` is the number for each mode. Moments are drawn
evenly over the time that an undisturbed run takes. Signals go to the run, its fork server, a worker, or all of them.
SIGSTOP is followed by SIGCONT. Compared are all files that a run writes, byte by byte, but JSON without the
seconds.
"""

import json
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from contextlib import suppress
from itertools import cycle, islice, product
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import command, ended, run, table
from figures_csv import FiguresOption, end_check
from synthetic_flights.aligned import make_aligned

from agalign.host.files import RUN_FILE
from agalign.records.sidecar_file import find_sidecars, verify_outputs
from agalign.synthetic import flight as synthetic

SIZE_PX = 480, 360
OPTIONS = "--layout", "both", "--error-map", "--tie-points"
INDICES = "indices"
MODES = {"one job": ("-j", "1"), "two jobs": ("-j", "2"), "Dask": ("-j", "2", "--dask", "local"), INDICES: ("-j", "2")}
TARGETS = "run", "fork server", "worker", "run and workers"
STOPPED_S, HUNG_S = 5.0, 120.0
"""Seconds for which SIGSTOP stops a process, and after which a run hangs."""
CHANGING = {RUN_FILE, "summary.csv", "index.html"}
"""These hold seconds."""
DECLARED = r"(could not be|were not) written; run again$"
"""End of a problem of `agalign verify` that the sidecar declares itself."""


def contents(path: Path) -> object:
    """Return what must be equal: JSON without seconds, else the bytes; the error of an unreadable file."""
    try:
        if path.suffix != ".json":
            return path.read_bytes()
        return json.loads(path.read_text(), object_hook=lambda part: {k: v for k, v in part.items() if k != "seconds"})
    except (OSError, ValueError) as error:
        return error


def snapshot(out: Path) -> dict[str, object]:
    """Return the contents of the files of a run by name."""
    files = (p for p in out.rglob("*") if p.is_file() and p.name not in CHANGING)
    return {path.relative_to(out).as_posix(): contents(path) for path in files}


def differences(out: Path, expected: dict[str, object]) -> Counter[str]:
    """Return the numbers of missing, left-over, unreadable and different files."""
    here = snapshot(out)
    result = Counter({"missing": len(expected.keys() - here), "left over": len(here.keys() - expected)})
    for name in (n for n in expected.keys() & here if here[n] != expected[n]):
        kind = "corrupt" if isinstance(here[name], Exception) else "different"
        print(f"{kind}: {name}")
        result[kind] += 1
    return result


def torn(out: Path) -> int:
    """Return the number of captures with an unreadable sidecar, or with files that are not as it lists them. Files that
    it declares as not written are not torn.
    """
    every = [problems for _, problems in verify_outputs(out)] if find_sidecars(out) else []
    return sum(any(not re.search(DECLARED, problem) for problem in problems) for problems in every)


def processes_of(process: "subprocess.Popen[str]", target: str) -> list[psutil.Process]:
    """Return the running processes that a signal is sent to; the run itself where it has no workers."""
    here = psutil.Process(process.pid)
    children = here.children(recursive=True)
    below = [c for c in children if c.ppid() != here.pid]
    if target == "fork server":
        below = list({c.parent() for c in below} - {None})
    return {"run": [here], "run and workers": [here, *children]}.get(target, below) or [here]


def strike(argv: list[str], after_s: float, number: signal.Signals, target: str, rng: random.Random) -> Counter[str]:
    """Send a signal to processes of a run, and return what is wrong with its end; `hit` if it was still running."""
    result: Counter[str] = Counter()
    children: list[psutil.Process] = []

    def send(process: "subprocess.Popen[str]") -> None:
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        with suppress(psutil.NoSuchProcess):
            children.extend(psutil.Process(process.pid).children(recursive=True))
            targets = processes_of(process, target)
            result["hit"] += process.poll() is None
            for one in targets if target == "run and workers" else [rng.choice(targets)]:
                one.send_signal(number)
                if number == signal.SIGSTOP:
                    time.sleep(STOPPED_S)
                    one.send_signal(signal.SIGCONT)

    ending = ended(argv, HUNG_S, send)
    _, left = psutil.wait_procs(children, timeout=10)
    result["hung"] = ending.code is None
    result["outlived the run"] = sum(c.is_running() and c.status() != psutil.STATUS_ZOMBIE for c in left)
    result["traceback"] = ending.has_traceback
    # A second signal, or one before the program catches it, ends the process at once.
    result["bad exit"] = ending.code not in (None, 0, 1, 3, 128 + number, -number)
    if result.total() > result["hit"]:
        print(ending.code, ending.errors, [c.pid for c in left], flush=True)
    return result


def main(
    kills: int = 50,
    modes: str = ",".join(MODES),
    signals: str = "SIGKILL",
    captures: int = 12,
    rng_seed: int = 0,
    *,
    figures: FiguresOption = False,
) -> None:
    rng = random.Random(rng_seed)
    rows = [("run", "signals to", "signals", "while it ran", "seconds of a run", "faults")]
    with tempfile.TemporaryDirectory() as folder:
        flight, aligned, out = Path(folder, "flight"), Path(folder, "aligned"), Path(folder, "out")
        synthetic.make_flight(flight, captures, SIZE_PX, rng_seed=4)
        make_aligned(aligned, 5 * captures, SIZE_PX)
        for mode in modes.split(","):
            of_indices = mode == INDICES
            make = [sys.executable, "-m", "agalign", "indices", str(out), "-q", "--index", "ndvi,ndre,savi"]
            argv = [*(make if of_indices else command(flight, out, *OPTIONS)), *MODES[mode]]

            def start(of_indices: bool = of_indices) -> None:
                shutil.rmtree(out, ignore_errors=True)
                if of_indices:
                    shutil.copytree(aligned, out)

            start()
            whole = ended(argv, HUNG_S)
            if whole.code != 0:
                raise SystemExit(f"{mode}: the run without signals failed")
            expected, counts = snapshot(out), defaultdict[str, Counter[str]](Counter)
            turns = product(TARGETS if mode != "one job" else ("run",), signals.split(","))
            for index, (target, name) in enumerate(islice(cycle(turns), kills), start=1):
                start()
                at_s = rng.uniform(0.02, 1.0) * whole.seconds
                here = strike(argv, at_s, signal.Signals[name], target, rng)
                here["torn"] = 0 if of_indices else torn(out)
                again = ended(argv, HUNG_S)
                here += differences(out, expected)
                here["bad exit"] += again.code != 0
                wrong = {k: n for k, n in here.items() if n and k != "hit"}
                print(f"{index}: {mode}: {name} to {target} after {at_s:.1f} s: {wrong or 'equal'}", flush=True)
                if wrong:
                    print(again.errors, flush=True)
                counts[target] += here + Counter(strikes=1, faults=sum(wrong.values()))
            for target, n in counts.items():
                rows.append((mode, target, n["strikes"], n["hit"], f"{whole.seconds:.0f}", n["faults"]))
    print(table(rows))
    sent, failures = (sum(row[column] for row in rows[1:]) for column in (2, -1))
    name = "signals at random moments of a run, then the same command again"
    end_check(name, f"{sent} signals", failures, figures=figures)


if __name__ == "__main__":
    run(main)
