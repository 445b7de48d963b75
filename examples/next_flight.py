"""Reuse the network and rig of one flight for the next flight of the same camera.

python examples/next_flight.py FIRST SECOND OUT
"""

import sys
from pathlib import Path

import agalign


def main() -> None:
    if len(sys.argv) != 4:
        sys.exit("usage: python examples/next_flight.py FIRST SECOND OUT")
    first, second, out = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    agalign.align_folder(first, out / "first", run=agalign.RunOptions(jobs=0))
    # A model for each camera: give the one to reuse. Without one, each flight learns its own.
    model = next(iter(sorted((out / "first" / "models").glob("*.safetensors"))), None)
    for report in agalign.align_folder(second, out / "second", model=model, run=agalign.RunOptions(jobs=0)):
        if report.result is None:
            print(f"{report.label}: {report.error}")
            continue
        statuses = [band.status for band in report.result.bands]
        print(f"{report.label}: {statuses.count('aligned')} of {len(statuses) - 1} aligned, {report.seconds:.1f} s")


if __name__ == "__main__":
    main()
