"""Time of a run by the length of the flight: synthetic flights, processed with one and two processes.

    python benchmarks/flight.py [lengths, by default 10,30,100] [jobs, by default 1,2]

Prints a table, the line total = learning + captures x steady through its rows, and the largest memory of any process;
also what all processes of a run hold in its second and its last quarter, memory and open files (where there is /proc).
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np


def watched(command: list[str]) -> tuple[resource.struct_rusage, list[tuple[float, int]]]:
    """Return (resources of a run, [(GB, open files) of its process tree every half second])."""
    process, held = subprocess.Popen(command), []
    while True:
        pid, _, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            return usage, held or [(0.0, 0)]
        result = [holds(p) for p in descendants(process.pid)]
        held.append((sum(memory for memory, _ in result), sum(files for _, files in result)))
        time.sleep(0.5)


def descendants(pid: int) -> list[int]:
    """Return a process and its running descendants."""
    children: list[str] = []
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            children += thread.read_text().split()
    return [pid, *(d for child in children for d in descendants(int(child)))]


def holds(pid: int) -> tuple[float, int]:
    """Return (GB, open files) of a process."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 1e9, len(os.listdir(f"/proc/{pid}/fd"))
    except (OSError, IndexError):
        return 0.0, 0


def main() -> None:
    lengths = [int(n) for n in (sys.argv[1] if len(sys.argv) > 1 else "10,30,100").split(",")]
    jobs = [int(n) for n in (sys.argv[2] if len(sys.argv) > 2 else "1,2").split(",")]
    seconds: dict[tuple[int, int], float] = {}
    print("| captures | jobs | seconds | largest process, GB | all, 2nd and last quarter, GB | open files, likewise |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "flight"
        # In a separate process, because the peak memory of a child starts at that of its parent.
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
                usage, held = watched(command)
                seconds[length, count] = time.perf_counter() - began
                gigabytes = usage.ru_maxrss / 1e6
                quarters = [np.median(held[len(held) * k // 4 : len(held) * (k + 1) // 4], axis=0) for k in (1, 3)]
                memory, files = (" / ".join(f"{q[k]:.{2 - 2 * k}f}" for q in quarters) for k in (0, 1))
                print(
                    f"| {length} | {count} | {seconds[length, count]:.1f} | {gigabytes:.2f} | {memory} | {files} |",
                    flush=True,
                )
    for count in jobs:
        slope, offset = np.polyfit(lengths, [seconds[n, count] for n in lengths], 1)
        print(f"jobs {count}: {offset:.1f} s + {slope:.2f} s a capture")
    if len(jobs) == 2:
        first, second = (np.polyfit(lengths, [seconds[n, count] for n in lengths], 1)[0] for count in jobs)
        print(f"steady throughput, jobs {jobs[1]} over jobs {jobs[0]}: {first / second:.2f}")


if __name__ == "__main__":
    main()
