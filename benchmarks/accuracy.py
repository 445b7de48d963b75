"""Aligns every capture below a folder with reference tie points, and prints accuracy and time.

    python benchmarks/accuracy.py DATA [align options, such as --seed identity --ignore-metadata]

A folder takes part where it holds `ties.json`:
{capture: {"reference": file, "bands": {file: {"ties": [[x_ref, y_ref, x_mov, y_mov], ...]}}}}, raw pixels of the files.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from common import align, band_errors, flight_and_out, print_head, print_row, read_ties, run


def main(data: Path, options: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    print_head("set", "aligned", "median, px", "worst pair, px", "95 %, px", "seconds a pair, median", "worst")
    for path in sorted(data.rglob("ties.json")):
        with flight_and_out() as (_, out):
            align(path.parent, out, *(options or ()))
            bands = band_errors(out, read_ties(path))
        good = [b for b in bands if b.status == "aligned"]
        name, aligned = path.parent.name, f"{len(good)} of {len(bands)}"
        if not good:
            print_row(name, aligned, *[""] * 5)
            continue
        median, p95, seconds = np.array([(b.median_px, b.p95_px, b.seconds) for b in good]).T
        errors = f"{np.median(median):.3f}", f"{median.max():.3f}", f"{np.median(p95):.2f}"
        print_row(name, aligned, *errors, f"{np.median(seconds):.1f}", f"{seconds.max():.1f}")


if __name__ == "__main__":
    run(main)
