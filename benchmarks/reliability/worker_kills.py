"""Kill one worker process after another, at random moments, and look at what became of every task.

    python benchmarks/reliability/worker_kills.py [--kills 1000] [--figures]

The pool alone: eight workers on any number of cores, tasks of some milliseconds with arguments and results of up to
400 kB, so that kills also come while a task or a result is on its way. kills.py kills the workers of runs.
"""

import os
import random
import sys
import threading
import time
import zlib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from figures_csv import FiguresOption, end_check

from agalign.errors import WorkerError
from agalign.host.process_pool import ProcessPool, WorkerDiedError

WORKERS, TASKS = 8, 400
MAX_BYTES = 400_000
HUNG_S = 300.0
"""An undisturbed batch takes seconds, and more where other programs take the cores."""
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


def workers() -> list[psutil.Process]:
    """The processes that the fork server has started."""
    here = psutil.Process()
    children = here.children(recursive=True)
    return [c for c in children if c.ppid() != here.pid and c.status() != psutil.STATUS_ZOMBIE]


def kill_workers(stopped: threading.Event, rng: random.Random, maximum: int) -> int:
    """Kill a worker again and again, until an event or the maximum, and return how many."""
    killed = 0
    while killed < maximum and not stopped.wait(rng.uniform(0.0, 0.2)):
        with suppress(psutil.NoSuchProcess):
            if alive := workers():
                rng.choice(alive).kill()
                killed += 1
    return killed


def run_tiny(kills: int, rng: random.Random) -> Counter[str]:
    """Batches of tiny tasks until there were so many kills."""
    result: Counter[str] = Counter()
    while result["kills"] < kills:
        given, began = make_tiny(rng), time.monotonic()
        done, stopped = 0, threading.Event()
        with ProcessPool(WORKERS, get_context("forkserver")) as pool, ThreadPoolExecutor(1) as threads:
            killer = threads.submit(kill_workers, stopped, rng, kills - result["kills"])
            futures = {pool.submit(do_tiny, task, timeout_s=20): task for task in given}
            try:
                for future in as_completed(futures, HUNG_S):
                    done += 1
                    number, _, data, size = futures[future]
                    error = future.exception()
                    if isinstance(error, WorkerError):
                        raise error
                    if isinstance(error, WorkerDiedError):
                        result["reported as killed"] += 1
                        result["wrong"] += str(error) != "signal 9"
                    else:
                        expected = number, zlib.crc32(data), bytes(size)
                        result["wrong"] += error is not None or future.result() != expected
            except TimeoutError:
                result["lost"] += TASKS - done
            except WorkerError:
                result["runs ended with a reason"] += 1
            stopped.set()
            result["kills"] += killer.result()
        result["runs"] += 1
        result["tasks"] += done
        result["hung"] += time.monotonic() - began > HUNG_S
        result["left over"] += len(workers())
    return result


def main(kills: int = 1000, rng_seed: int = 0, *, figures: FiguresOption = False) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    result = run_tiny(kills, random.Random(rng_seed))
    counted = ("runs", "tasks", "kills", "reported as killed", "runs ended with a reason", *KINDS)
    heads = (name.replace("runs ended", "ended") for name in counted)
    print(table([[*heads], [result[name] for name in counted]]))
    failures = sum(result[kind] for kind in KINDS)
    end_check("SIGKILL to workers of a pool of eight", f"{result['kills']} kills", failures, figures=figures)


if __name__ == "__main__":
    # Each worker imports this module: what loads slowly is imported here.
    from common import run, table

    run(main)
