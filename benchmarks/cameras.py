"""Errors of synthetic flights on two headings, for cameras without public images with ground truth: a table.

python benchmarks/cameras.py [CAPTURES] [CAMERA ...]

Cameras are rendered with half of their pixels along each side, but the Altum, with its small thermal band, with all.
"""

from typing import Annotated

import numpy as np
import typer
from common import Number, band_errors, flight_and_out, print_head, print_row, read_ties, run, timed
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_two_headings

import agalign

CAMERAS = {
    "mavic": (MAVIC, (1280, 960)),
    "mavic-3m": (MAVIC_3M, (1296, 972)),
    "altum": (ALTUM, (2064, 1544)),
    "altum-pt": (ALTUM_PT, (1032, 772)),
    "6x": (SENTERA_6X, (1024, 768)),
}


def main(captures: Number = 8, names: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    print_head("camera", "band", "aligned", "predicted", "other", "median, px", "worst capture, px", "in its own px")
    for name in names or CAMERAS:
        camera, size_px = CAMERAS[name]
        with flight_and_out() as (flight, out):
            truth = make_two_headings(flight, captures, size_px, camera=camera, line=captures // 2, lakes=False)
            options = agalign.DiscoverOptions(with_rgb=True)
            seconds, _ = timed(agalign.align_folder, flight, out, options=options)
            bands = band_errors(out, read_ties(truth))
        view = camera.bands[camera.reference].view
        for spec in camera.bands:
            own = [b for b in bands if b.band == spec.name]
            if not own:
                continue
            counts = [sum(b.status == status for b in own) for status in ("aligned", "predicted")]
            # The grid of the sidecar contains positions in the moving file.
            there = np.array([b.median_px for b in own])
            here = there / (spec.size_ratio[0] / spec.view * view)
            errors = f"{np.median(here):.3f}", f"{here.max():.3f}", f"{np.median(there):.3f} / {there.max():.3f}"
            print_row(name, spec.name, *counts, len(own) - sum(counts), *errors)
        print_row(name, "all", *[""] * 5, f"{seconds / captures:.1f} s a capture")


if __name__ == "__main__":
    run(main)
