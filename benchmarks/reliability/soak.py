"""A thousand small captures in one run: does memory, the number of open files or of processes grow, and how long does
it take to see that all of it is done?

    python benchmarks/reliability/soak.py [--captures 1000] [--jobs 2] [--markdown FILE]

Samples the run and all its children twice a second. Slopes are of the second half of the run, where everything is
loaded, by least squares; the noise is the scatter around that line.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from report import Section

from agalign.synthetic import flight as synthetic

SIZE_PX = 240, 180
QUANTITIES = ("memory of all processes, MB", "open files of all processes", "processes")


def watched(command: list[str]) -> tuple[int, float, np.ndarray, set[psutil.Process]]:
    """(exit code, seconds, (n, 4): seconds, memory in MB, open files, processes; every process that was seen)."""
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rows, seen = [], set[psutil.Process]()
    while process.poll() is None:
        here = psutil.Process(process.pid)
        memory = files = count = 0.0
        seen.update(here.children(recursive=True))
        for one in [here, *here.children(recursive=True)]:
            try:
                memory += one.memory_full_info().uss / 1e6
                files += one.num_fds()
                count += 1
            except (psutil.Error, FileNotFoundError, ProcessLookupError):
                continue
        rows.append((time.monotonic() - began, memory, files, count))
        time.sleep(0.5)
    return process.returncode, time.monotonic() - began, np.array(rows), seen


def slope(t_s: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """(mean, growth over the time seen, scatter)."""
    line = np.polyfit(t_s, y, 1)
    return float(y.mean()), float(line[0] * (t_s[-1] - t_s[0])), float((y - np.polyval(line, t_s)).std())


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--captures", type=int, default=1000)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--markdown", type=Path)
    asked = options.parse_args()
    section = Section("soak", asked.markdown)
    with tempfile.TemporaryDirectory() as folder:
        flight, out = Path(folder, "flight"), Path(folder, "out")
        synthetic.make_flight(flight, asked.captures, SIZE_PX, rng_seed=1)
        command = [sys.executable, "-m", "agalign", str(flight), "-o", str(out), "-q", "-j", str(asked.jobs)]
        code, seconds, rows, seen = watched(command)
        _, left = psutil.wait_procs(seen, timeout=10)
        section.say(
            f"{asked.captures} captures of {SIZE_PX[0]} x {SIZE_PX[1]} and five bands, {asked.jobs} worker processes: "
            f"exit code {code}, {seconds:.0f} s, {len(left)} processes left behind."
        )
        working = rows[rows[:, 3] == np.median(rows[:, 3])]  # neither while processes start nor while they end
        half = working[working[:, 0] > working[-1, 0] / 2]
        table = [("while all processes work, second half of the run", "mean", "growth", "scatter")]
        for name, y in zip(QUANTITIES, half[:, 1:].T, strict=True):
            mean, growth, scatter = slope(half[:, 0], y)
            table.append((name, f"{mean:.0f}", f"{growth:+.1f}", f"{scatter:.1f}"))
        section.table(table)
        code, seconds, rows, _ = watched(command)
        section.say(f"The same command again, all kept: exit code {code}, {seconds:.1f} s, {rows[:, 1].max():.0f} MB.")


if __name__ == "__main__":
    main()
