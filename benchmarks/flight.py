"""How the time of a run grows with the flight: synthetic flights of several lengths, one and two captures at a time.

    python benchmarks/flight.py [lengths, by default 10,30,100] [jobs, by default 1,2]

Prints a table, the line total = learning + captures x steady through its rows, and the largest memory of any process.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def main() -> None:
    lengths = [int(n) for n in (sys.argv[1] if len(sys.argv) > 1 else "10,30,100").split(",")]
    jobs = [int(n) for n in (sys.argv[2] if len(sys.argv) > 2 else "1,2").split(",")]
    seconds: dict[tuple[int, int], float] = {}
    print("| captures | jobs | seconds | largest process, GB |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "flight"
        # In a process of its own: a child's memory is counted from its parent's at its start.
        make = f"from agalign.synthetic import make_flight; make_flight(Path({str(source)!r}), {max(lengths)})"
        subprocess.run([sys.executable, "-c", f"from pathlib import Path; {make}"], check=True)
        images = sorted((source / "0000SET" / "000").glob("*.tif"))
        for length in sorted(lengths):
            part = Path(folder) / f"flight{length}"
            part.mkdir()
            for path in images:
                if int(path.stem.split("_")[1]) <= length:
                    (part / path.name).symlink_to(path)
            for count in jobs:
                out = Path(folder) / f"out{length}-{count}"
                command = [sys.executable, "-m", "agalign", str(part), "-o", str(out), "-q", "--jobs", str(count)]
                began = time.perf_counter()
                _, _, usage = os.wait4(subprocess.Popen(command).pid, 0)
                seconds[length, count] = time.perf_counter() - began
                gigabytes = usage.ru_maxrss / 1e6
                print(f"| {length} | {count} | {seconds[length, count]:.1f} | {gigabytes:.2f} |", flush=True)
    for count in jobs:
        slope, offset = np.polyfit(lengths, [seconds[n, count] for n in lengths], 1)
        print(f"jobs {count}: {offset:.1f} s + {slope:.2f} s a capture")
    if len(jobs) == 2:
        first, second = (np.polyfit(lengths, [seconds[n, count] for n in lengths], 1)[0] for count in jobs)
        print(f"steady throughput, jobs {jobs[1]} over jobs {jobs[0]}: {first / second:.2f}")


if __name__ == "__main__":
    main()
