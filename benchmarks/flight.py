"""Time of a run by the length of the flight: synthetic flights, processed with one and two processes.

    python benchmarks/flight.py [lengths, by default 10,30,100] [jobs, by default 1,2]

Prints the largest memory of any process, and what all processes of a run hold in its second and its last quarter,
memory and open files.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from common import command, print_head, print_row, run, watched

Numbers = Annotated[str, typer.Argument()]
"""Separated by commas."""


def main(of_captures: Numbers = "10,30,100", of_jobs: Numbers = "1,2") -> None:
    lengths, jobs = (sorted(map(int, numbers.split(","))) for numbers in (of_captures, of_jobs))
    print_head("captures", "jobs", "seconds", "largest process, GB", "all, 2nd and last quarter, GB", "open files")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "flight"
        # In a separate process, because the peak memory of a child starts at that of its parent.
        make = f"from agalign.synthetic.flight import make_flight; make_flight(Path({str(source)!r}), {max(lengths)})"
        subprocess.run([sys.executable, "-c", f"from pathlib import Path; {make}"], check=True)
        for length in lengths:
            part = Path(folder) / f"flight{length}"
            part.mkdir()
            for path in source.rglob("*.tif"):
                if int(path.stem.split("_")[1]) <= length:
                    (part / path.name).symlink_to(path)
            for count in jobs:
                process = watched(command(part, Path(folder) / f"out{length}-{count}", "--jobs", str(count)))
                quarters = [np.median(np.array_split(process.samples, 4)[k], axis=0) for k in (1, 3)]
                memory_gb = " / ".join(f"{q[1] / 1000:.2f}" for q in quarters)
                files = " / ".join(f"{q[3]:.0f}" for q in quarters)
                print_row(length, count, f"{process.seconds:.1f}", f"{process.largest_gb:.2f}", memory_gb, files)


if __name__ == "__main__":
    run(main)
