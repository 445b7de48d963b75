"""Three indices of a thousand small captures with two processes: time, memory, and resumption after a kill.

python benchmarks/indices.py [CAPTURES] [WIDTH] [HEIGHT]
"""

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import print_head, print_row, watched
from synthetic_flights.aligned import make_aligned


def command(out: Path, target: Path) -> list[str]:
    options = ["--index", "ndvi,ndre,gndvi", "--jobs", "2", "--json", "--quiet"]
    return [sys.executable, "-m", "agalign", "indices", str(out), "-o", str(target), *options]


def show(name: str, out: Path, target: Path) -> None:
    with tempfile.TemporaryFile() as file:
        run = watched(command(out, target), stdout=file)
        file.seek(0)
        reports = json.load(file)["indices"]
    written = sum(not r["kept"] for r in reports)
    memory_mb = run.samples[:, 2]
    quarter, end = memory_mb[len(memory_mb) // 4], memory_mb[-5:].max()
    time_s = f"{run.seconds:.0f}", f"{run.seconds / max(written, 1):.3f}"
    print_row(name, f"{written} of {len(reports)}", *time_s, f"{quarter:.0f}", f"{end:.0f}")


def main(captures: int = 1000, width_px: int = 320, height_px: int = 240) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        out, whole, killed = (Path(temporary) / name for name in ("aligned", "whole", "killed"))
        make_aligned(out, captures, (width_px, height_px))
        print_head("run", "rasters written", "s", "s a raster", "memory at a quarter, MB", "at the end, MB")
        show("whole", out, whole)
        with subprocess.Popen(command(out, killed), stdout=subprocess.DEVNULL) as process:
            while len(list(killed.rglob("*_ndvi.tif"))) < captures // 3:
                time.sleep(0.1)
            process.send_signal(signal.SIGKILL)
        show("after kill -9", out, killed)
        equal = (whole / "indices.csv").read_bytes() == (killed / "indices.csv").read_bytes()
        print(f"\ntables are {'equal' if equal else 'DIFFERENT'}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
