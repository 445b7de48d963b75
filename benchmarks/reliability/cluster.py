"""A Dask cluster on this machine that loses one of its two worker processes half-way: is every capture done, and are
the files equal to those of a run without a cluster?

    python benchmarks/reliability/cluster.py [--captures 40] [--figures]
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import align, command, ended, flight_and_out, run
from figures_csv import FiguresOption, end_check
from kills import differences, snapshot

from agalign.records.sidecar_file import find_sidecars
from agalign.synthetic import flight as synthetic

SIZE_PX, MAX_S = (480, 360), 1800


def dask(program: str, address_file: Path, *arguments: str) -> psutil.Popen:
    module = [sys.executable, "-m", f"distributed.cli.{program}", "--scheduler-file", str(address_file)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return psutil.Popen([*module, "--no-dashboard", *arguments], **quiet)


def main(captures: int = 40, *, figures: FiguresOption = False) -> None:
    with flight_and_out() as (flight, out):
        alone, address_file = (out.with_name(name) for name in ("alone", "scheduler.json"))
        synthetic.make_flight(flight, captures, SIZE_PX, rng_seed=5)
        alone_s = align(flight, alone, "-j", "2")
        worker = "--nthreads", "1", "--local-directory", str(out.parent)
        processes = [dask("dask_worker", address_file, *worker) for _ in range(2)]
        processes.append(dask("dask_scheduler", address_file, "--port", "0"))
        try:
            while not address_file.is_file():
                time.sleep(0.2)
            address = json.loads(address_file.read_text())["address"]
            done = 0

            def lose_a_worker(process: "subprocess.Popen[str]") -> None:
                """Kill a nanny and its worker, which is the largest of its children, half-way."""
                nonlocal done
                while process.poll() is None and done < captures // 2:
                    time.sleep(0.1)
                    done = len(find_sidecars(out))
                nanny = processes[0]
                max(nanny.children(recursive=True), key=lambda p: p.memory_info().rss).kill()
                nanny.kill()

            ending = ended(command(flight, out, "--dask", address), MAX_S, lose_a_worker)
        finally:
            for one in processes:
                one.terminate()
        result = differences(out, snapshot(alone))
        finished = len(find_sidecars(out))
        print(
            f"{captures} captures of {SIZE_PX[0]} x {SIZE_PX[1]} on a scheduler and two worker processes; one, "
            f"with its nanny, killed by SIGKILL when {done} captures were done: exit code {ending.code}, "
            f"{finished} captures done in {ending.seconds:.0f} s (a run on this machine's two cores "
            f"without a cluster: {alone_s:.0f} s). Files compared with that run: {result['missing']} missing, "
            f"{result['left over']} left over, {result['corrupt']} corrupt, {result['different']} different."
        )
    # A capture that is not done has missing files.
    failures = result.total() + (ending.code != 0)
    name = "Dask cluster that loses one of two workers"
    end_check(name, f"{captures} captures", failures, figures=figures)


if __name__ == "__main__":
    run(main)
