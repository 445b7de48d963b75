"""A thousand small captures in one run: does memory, the number of open files or of processes grow, and how long does
it take to see that all of it is done?

    python benchmarks/reliability/soak.py [--captures 1000] [--jobs 2] [--markdown FILE]

Samples the run and all its children twice a second. Slopes are of the second half of the run, where everything is
loaded, by least squares; the noise is the scatter around that line.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Section, command, flight_and_out, run, watched

from agalign.synthetic import flight as synthetic

SIZE_PX = 240, 180
QUANTITIES = {"memory of all processes, MB": 2, "open files of all processes": 3, "processes": 4}
"""Columns of the samples."""


def main(captures: int = 1000, jobs: int = 2, markdown: Path | None = None) -> None:
    section = Section("soak", markdown)
    with flight_and_out() as (flight, out):
        synthetic.make_flight(flight, captures, SIZE_PX, rng_seed=1)
        process = watched(command(flight, out, "-j", str(jobs)))
        section.say(
            f"{captures} captures of {SIZE_PX[0]} x {SIZE_PX[1]} and five bands, {jobs} worker processes: "
            f"exit code {process.code}, {process.seconds:.0f} s, {len(process.left)} processes left behind."
        )
        count = process.samples[:, 4]
        working = process.samples[count == np.median(count)]  # neither while processes start nor while they end
        half = working[working[:, 0] > working[-1, 0] / 2]
        parts = []
        for name, column in QUANTITIES.items():
            t_s, y = half[:, 0], half[:, column]
            line = np.polyfit(t_s, y, 1)
            growth, scatter = line[0] * (t_s[-1] - t_s[0]), (y - np.polyval(line, t_s)).std()
            parts.append(f"{name} {y.mean():.0f} (growth {growth:+.1f}, scatter {scatter:.1f})")
        section.say(f"Second half of the run, while all processes work: {', '.join(parts)}.")
        process = watched(command(flight, out, "-j", str(jobs)))
        mb = process.samples[:, 2].max()
        section.say(
            f"The same command again, all kept: exit code {process.code}, {process.seconds:.1f} s, {mb:.0f} MB."
        )


if __name__ == "__main__":
    run(main)
