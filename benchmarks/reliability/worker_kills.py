"""Kill one worker process after another, at random moments, and look at what became of every task.

    python benchmarks/reliability/worker_kills.py [--kills 1000] [--minutes 10] [--markdown FILE]

First the pool alone: eight workers on however many cores, tasks of some milliseconds with arguments and results of up
to 400 kB, so that kills also come while a task or a result is on its way. Then, for so many minutes, runs of
`agalign -j 2` over a small flight. After each run the same command runs undisturbed, and every file is compared with
those of a run without kills.
"""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from agalign.errors import WorkerError
from agalign.values.process_pool import ProcessPool, WorkerDiedError
from agalign.values.processes import follow_parent

WORKERS, TASKS = 8, 400
MAX_BYTES = 400_000
CAPTURES, SIZE_PX = 16, (240, 180)
HUNG_S = 300.0
"""An undisturbed batch takes seconds, a run half a minute, and more where other programs take the cores."""
KINDS = ("lost", "hung", "wrong", "left over")
Tiny = tuple[int, float, bytes, int]
"""Number, seconds, argument, size of the result."""


def do_tiny(task: Tiny) -> tuple[int, int, bytes]:
    """What can be checked: the number, a checksum of the argument, a result of the size that was asked for."""
    number, seconds, data, size = task
    time.sleep(seconds)
    return number, zlib.crc32(data), bytes(size)


def make_tiny(rng: random.Random) -> list[Tiny]:
    sizes = 10, 1000, MAX_BYTES
    return [(n, rng.uniform(0, 0.02), rng.randbytes(rng.choice(sizes)), rng.choice(sizes)) for n in range(TASKS)]


def workers_below(process: psutil.Process) -> list[psutil.Process]:
    """The processes that the fork server has started."""
    try:
        children = process.children(recursive=True)
        return [c for c in children if c.ppid() != process.pid and c.status() != psutil.STATUS_ZOMBIE]
    except psutil.NoSuchProcess:
        return []


class Killer(threading.Thread):
    """Kills a worker of a process, again and again, until it is to stop or has killed enough."""

    def __init__(self, target: psutil.Process, rng: random.Random, rest_s: tuple[float, float], maximum: int) -> None:
        super().__init__(daemon=True)
        self.killed = 0
        self._stopped = threading.Event()
        self._target, self._rng, self._rest_s, self._maximum = target, rng, rest_s, maximum

    def run(self) -> None:
        while self.killed < self._maximum and not self._stopped.wait(self._rng.uniform(*self._rest_s)):
            alive = workers_below(self._target)
            with suppress(psutil.NoSuchProcess):
                if alive:
                    self._rng.choice(alive).kill()
                    self.killed += 1

    def stop(self) -> int:
        """How many it has killed."""
        self._stopped.set()
        self.join()
        return self.killed


def run_tiny(kills: int, rng: random.Random) -> Counter[str]:
    """Batches of tiny tasks until there were so many kills."""
    result: Counter[str] = Counter()
    here = psutil.Process()
    while result["kills"] < kills:
        given, began = make_tiny(rng), time.monotonic()
        killer = Killer(here, rng, (0.0, 0.2), kills - result["kills"])
        seen: Counter[int] = Counter()
        with ProcessPool(do_tiny, WORKERS, get_context("forkserver"), follow_parent) as pool:
            killer.start()
            try:
                for outcome in pool.run(given, timeout_s=20):
                    seen[outcome.number] += 1
                    number, _, data, size = given[outcome.number]
                    if isinstance(outcome.error, WorkerDiedError):
                        result["reported as killed"] += 1
                        result["wrong"] += str(outcome.error) != "signal 9"
                    else:
                        result["wrong"] += outcome.result != (number, zlib.crc32(data), bytes(size))
            except WorkerError:
                result["runs ended with a reason"] += 1
            else:
                result["lost"] += sum(seen[n] != 1 for n in range(TASKS))
            result["kills"] += killer.stop()
        result["runs"] += 1
        result["tasks"] += seen.total()
        result["hung"] += time.monotonic() - began > HUNG_S
        result["left over"] += len(workers_below(here))
    return result


def run_flight(argv: list[str], result: Counter[str], killer_rng: random.Random | None = None) -> tuple[int, str]:
    """Return (exit code, standard error) of a run, with kills if there is a generator; one that hangs prints what its
    threads do.
    """
    environment = {**os.environ, "PYTHONFAULTHANDLER": "1"}
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)
    maximum = 0 if killer_rng is None else sys.maxsize
    killer = Killer(psutil.Process(process.pid), killer_rng or random.Random(), (0.2, 4.0), maximum)
    killer.start()
    try:
        _, errors = process.communicate(timeout=HUNG_S)
    except subprocess.TimeoutExpired:
        result["hung"] += 1
        process.send_signal(signal.SIGABRT)
        _, errors = process.communicate()
        print(errors)
    result["kills"] += killer.stop()
    return process.returncode, errors


def flights(minutes: float, rng: random.Random, folder: Path) -> Iterator[Counter[str]]:
    """Yield the result of each run with kills over the same flight, followed by the same command without."""
    # Each worker of the tiny tasks imports this module: what loads slowly is imported here.
    from common import align, command
    from kills import differences, snapshot

    from agalign.synthetic import flight as synthetic

    flight, whole, out = folder / "flight", folder / "whole", folder / "out"
    synthetic.make_flight(flight, CAPTURES, SIZE_PX, rng_seed=6)
    align(flight, whole, "-j", "2")
    expected = snapshot(whole)
    end_s = time.monotonic() + 60 * minutes
    while time.monotonic() < end_s:
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(whole / "models", out / "models")  # a run learns for longer than it aligns
        result = Counter(runs=1, tasks=CAPTURES)
        _, errors = run_flight(command(flight, out, "-j", "2"), result, rng)
        killed = set(re.findall(r"agalign: (\S+): its worker process was killed \(signal 9", errors))
        finished = {p.relative_to(out).with_suffix("").as_posix() for p in out.rglob("IMG_*.json")}
        result["reported as killed"] = len(killed)
        if "worker processes one after another ended" in errors:
            result["runs ended with a reason"] += 1
        else:
            result["lost"] = max(CAPTURES - len(killed | finished), 0)
        code, _ = run_flight(command(flight, out, "-j", "2"), result)
        after = differences(out, expected)
        result["wrong"] = after["missing"] + after["corrupt"] + after["different"] + (code != 0)
        result["left over"] = after["left over"]
        yield result


def main(kills: int = 1000, minutes: float = 10.0, rng_seed: int = 0, markdown: Path | None = None) -> None:
    from common import Section

    rng = random.Random(rng_seed)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    warnings.simplefilter("ignore")  # of rasters without georeference
    tiny = run_tiny(kills, rng)
    print(dict(tiny), flush=True)
    real: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for one in flights(minutes, rng, Path(folder)):
            real += one
            print({k: v for k, v in one.items() if v}, flush=True)
    counted = ("runs", "tasks", "kills", "reported as killed", "runs ended with a reason", *KINDS)
    results = {"tiny tasks, 8 workers": tiny, f"flights of {CAPTURES} captures, 2 workers": real}
    rows = [("", *(name.replace("runs ended", "ended") for name in counted))]
    rows += [(name, *(str(result[kind]) for kind in counted)) for name, result in results.items()]
    Section("worker kills", markdown).table(rows)
    if any(counts[kind] for counts in results.values() for kind in KINDS):
        raise SystemExit("something was lost, hung, wrong or left over")


if __name__ == "__main__":
    from common import run

    run(main)
