"""Aligns every capture below a folder with reference tie points, and prints accuracy and time.

    python benchmarks/accuracy.py DATA [align options, such as --seed identity --ignore-metadata]

A folder takes part where it holds `ties.json`:
{capture: {"reference": file, "bands": {file: {"ties": [[x_ref, y_ref, x_mov, y_mov], ...]}}}}, raw pixels of the files.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator

from agalign.products.sidecar_file import find_sidecars


def medians_and_seconds(out: Path, truth: dict[str, list[list[float]]]) -> list[tuple[str, float, float, float]]:
    """Return (status, median error px, p95 error px, seconds) of each pair with tie points."""
    rows = []
    for path in find_sidecars(out):
        for band in json.loads(path.read_text())["bands"]:
            if band["file"] not in truth or band["status"] == "reference":
                continue
            ties = np.array(truth[band["file"]])
            mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
            error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
            rows.append((band["status"], *np.nanpercentile(error, (50, 95)), band["seconds"]))
    return rows


def main() -> None:
    data, options = Path(sys.argv[1]), sys.argv[2:]
    print("| set | aligned | median, px | worst pair, px | 95 %, px | seconds a pair, median | worst |")
    print("|---|---|---|---|---|---|---|")
    for ties_path in sorted(data.rglob("ties.json")):
        captures = json.loads(ties_path.read_text())
        truth = {file: e["ties"] for c in captures.values() for file, e in c["bands"].items()}
        with tempfile.TemporaryDirectory() as out:
            command = [sys.executable, "-m", "agalign", str(ties_path.parent), "-o", out, "-q", *options]
            subprocess.run(command, check=False)
            rows = medians_and_seconds(Path(out), truth)
        good = [r for r in rows if r[0] == "aligned"]
        if not good:
            print(f"| {ties_path.parent.name} | 0 of {len(rows)} | | | | | |", flush=True)
            continue
        median, p95, seconds = (np.array([r[k] for r in good]) for k in (1, 2, 3))
        print(
            f"| {ties_path.parent.name} | {len(good)} of {len(rows)} | {np.median(median):.3f} | {median.max():.3f} "
            f"| {np.median(p95):.2f} | {np.median(seconds):.1f} | {seconds.max():.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
