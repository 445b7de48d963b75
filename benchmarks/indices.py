"""Three indices of a thousand small captures with two processes: time, memory, and resumption after a kill.

python benchmarks/indices.py [CAPTURES] [WIDTH] [HEIGHT]
"""

import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
from synthetic_flights.aligned import make_aligned

NAMES = "ndvi,ndre,gndvi"


def main(captures: int, size_px: tuple[int, int]) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "aligned"
        make_aligned(out, captures, size_px)
        print("| run | rasters written | s | s a raster | memory at a quarter, MB | at the end, MB |")
        print("|---|---|---|---|---|---|")
        show("whole", out, Path(temporary) / "whole")
        killed = Path(temporary) / "killed"
        with subprocess.Popen(command(out, killed)) as process:
            while len(list(killed.rglob("*_ndvi.tif"))) < captures // 3:
                time.sleep(0.1)
            process.send_signal(signal.SIGKILL)
        show("after kill -9", out, killed)
        whole, again = ((Path(temporary) / name / "indices.csv").read_bytes() for name in ("whole", "killed"))
        print(f"\ntables are {'equal' if whole == again else 'DIFFERENT'}")


def command(out: Path, target: Path) -> list[str]:
    return [sys.executable, "-m", "agalign", "indices", str(out), "-o", str(target), "--index", NAMES, "--jobs", "2",
            "--json", "--quiet"]  # fmt: skip


def show(name: str, out: Path, target: Path) -> None:
    began, memory_mb = time.monotonic(), []
    with subprocess.Popen(command(out, target), stdout=subprocess.PIPE) as process:
        watch = threading.Thread(target=watch_memory, args=(process.pid, memory_mb))
        watch.start()
        text, _ = process.communicate()
        watch.join()
    seconds = time.monotonic() - began
    reports = json.loads(text)["indices"]
    written = sum(not r["kept"] for r in reports)
    quarter, end = memory_mb[len(memory_mb) // 4], max(memory_mb[-5:])
    each = seconds / max(written, 1)
    print(f"| {name} | {written} of {len(reports)} | {seconds:.0f} | {each:.3f} | {quarter:.0f} | {end:.0f} |")


def watch_memory(pid: int, memory_mb: list[float]) -> None:
    """Append the memory of a process and its descendants, MB, every half second."""
    try:
        process = psutil.Process(pid)
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            everyone = [process, *process.children(recursive=True)]
            memory_mb.append(sum(p.memory_full_info().uss for p in everyone) / 1e6)
            time.sleep(0.5)
    except psutil.Error:
        return


if __name__ == "__main__":
    given = [int(a) for a in sys.argv[1:]]
    main(given[0] if given else 1000, (given[1], given[2]) if len(given) > 2 else (320, 240))
