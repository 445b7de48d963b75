"""A Dask cluster of two worker processes on this machine, one of them killed half-way: is everything done, and is it
equal to a run without a cluster?

    python benchmarks/reliability/cluster.py [--captures 40] [--markdown FILE]
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from kills import contents, differences, files
from report import Section

from agalign.products.sidecar_file import find_sidecars
from agalign.synthetic import flight as synthetic

SIZE_PX = 480, 360


def dask(*arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def worker_process(nanny: subprocess.Popen[bytes]) -> psutil.Process:
    """Return the worker process below its nanny."""
    children = psutil.Process(nanny.pid).children(recursive=True)
    return max(children, key=lambda p: p.memory_info().rss)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--captures", type=int, default=40)
    options.add_argument("--markdown", type=Path)
    asked = options.parse_args()
    section = Section("cluster", asked.markdown)
    with tempfile.TemporaryDirectory() as folder:
        flight, alone, out = Path(folder, "flight"), Path(folder, "alone"), Path(folder, "out")
        address_file = Path(folder, "scheduler.json")
        synthetic.make_flight(flight, asked.captures, SIZE_PX, rng_seed=5)
        program = [sys.executable, "-m", "agalign", str(flight), "-q"]
        began = time.monotonic()
        subprocess.run([*program, "-o", str(alone), "-j", "2"], check=True)
        alone_s = time.monotonic() - began
        scheduler = dask("dask_scheduler", "--scheduler-file", str(address_file), "--no-dashboard", "--port", "0")
        there = [
            "--scheduler-file",
            str(address_file),
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            folder,
        ]
        nannies = [dask("dask_worker", *there) for _ in range(2)]
        try:
            while not address_file.is_file():
                time.sleep(0.2)
            address = json.loads(address_file.read_text())["address"]
            began = time.monotonic()
            run = subprocess.Popen(
                [*program[:-1], "-o", str(out), "--dask", address], stderr=subprocess.PIPE, text=True
            )
            killed_at = 0
            while run.poll() is None:
                done = len(find_sidecars(out)) if out.is_dir() else 0
                if not killed_at and done >= asked.captures // 2:
                    os.kill(worker_process(nannies[0]).pid, signal.SIGKILL)
                    os.kill(nannies[0].pid, signal.SIGKILL)
                    killed_at = done
                time.sleep(0.1)
            seconds = time.monotonic() - began
        finally:
            for process in (*nannies, scheduler):
                process.terminate()
        result = differences(out, {name: contents(path) for name, path in files(alone).items()})
        section.say(
            f"{asked.captures} captures of {SIZE_PX[0]} x {SIZE_PX[1]} on a scheduler and two worker processes; one, "
            f"with its nanny, killed by SIGKILL when {killed_at} captures were done: exit code {run.returncode}, "
            f"{len(find_sidecars(out))} captures done in {seconds:.0f} s (a run on this machine's two cores without "
            f"a cluster: {alone_s:.0f} s)."
        )
        kinds = ("missing", "left over", "corrupt", "different")
        section.table([("compared with a run without a cluster", "files"), *((k, str(result[k])) for k in kinds)])


if __name__ == "__main__":
    main()
