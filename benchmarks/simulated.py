"""Errors of synthetic flights at their true ties: with and without faults, and of cameras without public ground truth.

    python benchmarks/simulated.py FLIGHT... [--captures N] [--rng-seed N]

FLIGHT is one of plain, troubled, "two headings" (a camera that exposes its bands one after another, and lakes), mavic,
mavic-3m, altum, altum-pt, 6x. Bands are grouped by the fault of their capture; without faults by name, with errors in
px of the reference. The cameras are rendered with half of their pixels along each side, but the Altum, with its small
thermal band, with all. "plain" also compares the uncertainty with the true homographies: at each corner of the
reference and along each axis, the error should be within one reported standard deviation in 68 % and within 1.96 of
them in 95 % of the cases.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from common import BandError, Ties, print_head, print_row
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.synthetic.cameras import REDEDGE, CameraSpec
from agalign.synthetic.flight import make_flight
from agalign.values import geometry

Flight = tuple[Callable[..., Path], CameraSpec, int]
"""Function that writes it, camera, and number of captures."""


def two_lines(camera: CameraSpec, size_px: tuple[int, int]) -> Flight:
    """A flight on two opposite headings."""

    def make(folder: Path, captures: int, rng_seed: int) -> Path:
        return make_two_headings(folder, captures, size_px, rng_seed, camera, line=captures // 2, lakes=False)

    return make, camera, 8


FLIGHTS: dict[str, Flight] = {
    "plain": (make_flight, REDEDGE, 60),
    "troubled": (make_troubled_flight, REDEDGE, 60),
    "two headings": (make_two_headings, MAVIC, 24),
    "mavic": two_lines(MAVIC, (1280, 960)),
    "mavic-3m": two_lines(MAVIC_3M, (1296, 972)),
    "altum": two_lines(ALTUM, (2064, 1544)),
    "altum-pt": two_lines(ALTUM_PT, (1032, 772)),
    "6x": two_lines(SENTERA_6X, (1024, 768)),
}


def by_fault(bands: list[BandError], truth: Ties) -> dict[str, list[BandError]]:
    groups = defaultdict[str, list[BandError]](list)
    for band in bands:
        groups[truth[band.part.file]["trouble"] or "none"].append(band)
    return groups


def by_band(bands: list[BandError], camera: CameraSpec) -> dict[str, list[BandError]]:
    """Group bands by name, with errors in px of the reference, and again in their own px if these differ."""
    groups: dict[str, list[BandError]] = {}
    for spec in camera.bands:
        own = [b for b in bands if b.part.band == spec.name]
        scale = spec.size_ratio[0] / spec.view * camera.bands[camera.reference].view
        if own:
            groups[spec.name] = [replace(b, error_px=b.error_px / scale, std_px=b.std_px / scale) for b in own]
        if own and scale != 1:
            groups[f"{spec.name}, in its own px"] = own
    return groups


def print_corners(out: Path, truth: Ties) -> None:
    """Print a table of the errors at the corners and their standard deviations."""
    bands = defaultdict[str, list[np.ndarray]](list)
    for sidecar in map(read_sidecar, find_sidecars(out)):
        corners = geometry.corners(sidecar.reference.width, sidecar.reference.height)
        for band in (b for b in sidecar.bands if b.status == "aligned"):
            true = geometry.invert(np.array(truth[band.file]["fixed_to_moving"]))
            back = geometry.compose(true, np.array(band.homography.fixed_to_moving))
            error = np.abs(geometry.apply(back, corners) - corners)
            bands[band.band].append(np.stack([error, band.joint.corner_std_xy_px]))
    print()
    shares = "within 1 std (68 %)", "within 1.96 std (95 %)"
    print_head("band", "corners x axes", *shares, "rms error, px", "rms std, px")
    bands["all"] = [one for values in bands.values() for one in values]
    for name, some in bands.items():
        error, std = np.concatenate(some, axis=1).reshape(2, -1)
        within = [f"{(error <= times * std).mean():.0%}" for times in (1, 1.96)]
        print_row(name, error.size, *within, *(f"{np.sqrt((values**2).mean()):.3f}" for values in (error, std)))


def main(flights: list[str], captures: int = 0, rng_seed: int = 0) -> None:
    for name in flights:
        make, camera, usual = FLIGHTS[name]
        count = captures or usual
        with common.flight_and_out() as (flight, out):
            truth = common.read_ties(make(flight, captures=count, rng_seed=rng_seed))
            seconds = common.align(flight, out, "--with-rgb")
            bands = common.band_errors(out, truth)
            print(f"\n{name}: {len(bands)} of {len(truth)} bands written, {seconds / count:.1f} s a capture\n")
            has_faults = any(entry["trouble"] for entry in truth.values())
            common.print_errors(by_fault(bands, truth) if has_faults else by_band(bands, camera))
            if name == "plain":
                print_corners(out, truth)


if __name__ == "__main__":
    common.run(main)
