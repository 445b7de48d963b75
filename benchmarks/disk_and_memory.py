"""Disk and files of the outputs of a capture, and the memory of a job.

    python benchmarks/disk_and_memory.py FLIGHT... [--figures]

FLIGHT is a folder with captures. Each is aligned by one job with the options of each row, and NDVI is calculated of all
captures that have its bands. Disk is without pages and the model of the flight, memory is the largest that a job had.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from common import command, print_head, print_row, run, watched
from figures_csv import FiguresOption, TableRow, title_of, write_figures

from agalign.host.text import counted
from agalign.records.sidecar_file import find_sidecars

OPTIONS = (), ("--radiometry", "auto", "--qa"), ("--radiometry", "auto", "--qa", "--relief", "always")
TABLE = "disk and memory"


def measured(flight: Path, options: tuple[str, ...], out: Path) -> TableRow:
    """Return the row of a flight and some options."""
    largest_gb = watched(command(flight, out, "-j", "1", *options)).largest_gb
    masked = ("--mask-qa",) if "--qa" in options else ()
    ndvi = [sys.executable, "-m", "agalign", "indices", str(out), "--index", "ndvi", "-q", *masked]
    subprocess.run(ndvi, check=False, stderr=subprocess.DEVNULL)  # some cameras lack a band of it
    sidecars = find_sidecars(out)
    files = {file for sidecar in sidecars for file in sidecar.parent.glob(f"{sidecar.stem}*")}
    per_capture = [total / len(sidecars) for total in (sum(file.stat().st_size for file in files) / 1e6, len(files))]
    cells = {"disk, MB": f"{per_capture[0]:.1f}", "files": f"{per_capture[1]:.1f}", "memory, GB": f"{largest_gb:.2f}"}
    name = f"{title_of(flight)}: {' '.join(options) or 'raw numbers'}"
    return TableRow(TABLE, name, counted(len(sidecars), "capture"), cells)


def main(flights: list[Path], *, figures: FiguresOption = False) -> None:
    rows = []
    print_head("", "captures", "disk, MB", "files", "memory, GB")
    for flight in flights:
        for options in OPTIONS:
            with tempfile.TemporaryDirectory() as folder:
                row = measured(flight, options, Path(folder))
            print_row(row.name, row.n, *row.cells.values())
            rows.append(row)
    if figures:
        write_figures(rows, "DATA/", flights)


if __name__ == "__main__":
    run(main)
