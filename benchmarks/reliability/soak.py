"""Runs over many captures: time, memory, and whether memory, open files or processes grow.

    python benchmarks/reliability/soak.py [--captures 1000] [--jobs 2] [--size 240x180] [--figures]

A synthetic flight is aligned with each number of --jobs, separated by commas. Samples the run and all its children
twice a second. Slopes are of the second half of the run, where everything is loaded, by least squares; the noise is the
scatter around that line. The same command again finds that all of it is done. With --figures, a run over many captures
writes what grows, a shorter one time and memory.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Watched, command, flight_and_out, run, watched
from figures_csv import FiguresOption, TableRow, write_figures

MANY = 500
"""Captures of a run in which growth differs from scatter."""
MAX_GROWTH = 0.1
"""Growth in the second half of a long run relative to the mean. Scatter is less; a leak of 1 MB per capture, or of a
file in every tenth, is more."""
QUANTITIES = "memory of all processes, MB", "open files of all processes", "processes"
"""Columns of the samples, after the seconds."""


def growth(samples: np.ndarray) -> dict[str, tuple[float, float, float]]:
    """Return mean, growth and scatter of each quantity in the second half of a run."""
    count = samples[:, 3]
    working = samples[count == np.median(count)]  # neither while processes start nor while they end
    t_s, *values = working[working[:, 0] > working[-1, 0] / 2].T
    result = {}
    for name, y in zip(QUANTITIES, values, strict=True):
        line = np.polyfit(t_s, y, 1)
        result[name] = y.mean(), line[0] * (t_s[-1] - t_s[0]), (y - np.polyval(line, t_s)).std()
    return result


def table_row(captures: int, jobs: int, seen: Watched) -> TableRow:
    """Return the row of a run in docs/figures/figures.csv."""
    n = f"{captures} captures"
    if captures < MANY:
        cells = {"run, s": f"{seen.seconds:.1f}", "memory, GB": f"{seen.samples[:, 1].max() / 1000:.2g}"}
        return TableRow("runs", f"{jobs} job{'s' if jobs > 1 else ''}", n, cells)
    failures = sum(grown > MAX_GROWTH * mean for mean, grown, _ in growth(seen.samples).values())
    failures += (seen.code != 0) + len(seen.left)
    return TableRow("reliability", "long run: growth of memory, files, processes", n, {"failures": failures})


def main(captures: int = 1000, jobs: str = "2", size: str = "240x180", *, figures: FiguresOption = False) -> None:
    rows = []
    with flight_and_out() as (flight, out):
        # In a separate process, because the peak memory of a child starts at that of its parent.
        make = f"make_flight(Path({str(flight)!r}), {captures}, ({size.replace('x', ', ')}), rng_seed=1)"
        code = f"from pathlib import Path; from agalign.synthetic.flight import make_flight; {make}"
        subprocess.run([sys.executable, "-c", code], check=True)
        for count in jobs.split(","):
            argv = command(flight, out.with_name(f"out{count}"), "-j", count)
            first, again = watched(argv), watched(argv)
            grown = (
                f"{name} {mean:.0f} (growth {by:+.1f}, scatter {scatter:.1f})"
                for name, (mean, by, scatter) in growth(first.samples).items()
            )
            print(
                f"{captures} captures of {size.replace('x', ' x ')} and five bands, {count} worker processes: exit "
                f"code {first.code}, {first.seconds:.0f} s, largest process {first.largest_gb:.2f} GB, "
                f"{len(first.left)} processes left behind.\n"
                f"Second half of the run, while all processes work: {', '.join(grown)}.\n"
                f"The same command again, all kept: exit code {again.code}, {again.seconds:.1f} s, "
                f"{again.samples[:, 1].max():.0f} MB.\n"
            )
            rows.append(table_row(captures, int(count), first))
    if figures:
        write_figures(rows)


if __name__ == "__main__":
    run(main)
