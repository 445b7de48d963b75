"""Errors of synthetic flights at their true ties: with and without faults, and of cameras without public ground truth.

    python benchmarks/simulated.py FLIGHT... [--captures N] [--rng-seed N]

FLIGHT is one of plain, troubled, "two headings" (a camera that exposes its bands one after another, and lakes), mavic,
mavic-3m, altum, altum-pt, 6x. Bands are grouped by the fault of their capture; without faults by name, with errors in
px of the reference. The cameras are rendered with half of their pixels along each side, but the Altum, with its small
thermal band, with all. "plain" also compares the uncertainty with the true homographies: at each corner of the
reference and along each axis, the error should be within one reported standard deviation in 68 % and within 1.96 of
them in 95 % of the cases.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from common import (
    BandError,
    Ties,
    align,
    band_errors,
    flight_and_out,
    print_errors,
    print_head,
    print_row,
    read_ties,
    run,
)
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.synthetic.cameras import REDEDGE, CameraSpec
from agalign.synthetic.flight import make_flight
from agalign.values import geometry


def two_lines(folder: Path, captures: int, rng_seed: int, *, camera: CameraSpec, size_px: tuple[int, int]) -> Path:
    """Write a flight on two opposite headings."""
    return make_two_headings(folder, captures, size_px, rng_seed, camera, line=captures // 2, lakes=False)


FLIGHTS: dict[str, tuple[Callable[..., Path], CameraSpec, int]] = {
    "plain": (make_flight, REDEDGE, 60),
    "troubled": (make_troubled_flight, REDEDGE, 60),
    "two headings": (make_two_headings, MAVIC, 24),
}
"""Function that writes it, camera, and number of captures."""
for name, camera, size_px in (
    ("mavic", MAVIC, (1280, 960)),
    ("mavic-3m", MAVIC_3M, (1296, 972)),
    ("altum", ALTUM, (2064, 1544)),
    ("altum-pt", ALTUM_PT, (1032, 772)),
    ("6x", SENTERA_6X, (1024, 768)),
):
    FLIGHTS[name] = partial(two_lines, camera=camera, size_px=size_px), camera, 8


def by_fault(bands: list[BandError], truth: Ties) -> dict[str, list[BandError]]:
    groups: dict[str, list[BandError]] = {}
    for band in bands:
        groups.setdefault(truth[band.file]["trouble"] or "none", []).append(band)
    return groups


def by_band(bands: list[BandError], camera: CameraSpec) -> dict[str, list[BandError]]:
    """Group bands by name, with errors in px of the reference, and again in their own px if these differ."""
    groups: dict[str, list[BandError]] = {}
    for spec in camera.bands:
        own = [b for b in bands if b.band == spec.name]
        scale = spec.size_ratio[0] / spec.view * camera.bands[camera.reference].view
        if own:
            groups[spec.name] = [replace(b, error_px=b.error_px / scale, std_px=b.std_px / scale) for b in own]
        if own and scale != 1:
            groups[f"{spec.name}, in its own px"] = own
    return groups


def print_corners(out: Path, truth: Ties) -> None:
    """Print a table of the errors at the corners and their standard deviations."""
    bands: dict[str, list[np.ndarray]] = {}
    for sidecar in map(read_sidecar, find_sidecars(out)):
        corners = geometry.corners(sidecar.reference.width, sidecar.reference.height)
        for band in (b for b in sidecar.bands if b.status == "aligned"):
            true = geometry.invert(np.array(truth[band.file]["fixed_to_moving"]))
            back = geometry.compose(true, np.array(band.homography.fixed_to_moving))
            error = np.abs(geometry.apply(back, corners) - corners)
            bands.setdefault(band.band, []).append(np.stack([error, np.array(band.joint.corner_std_xy_px)]))
    print()
    shares = "within 1 std (68 %)", "within 1.96 std (95 %)"
    print_head("band", "corners x axes", *shares, "rms error, px", "rms std, px")
    for name in (*bands, "all"):
        some = [one for band, values in bands.items() if name in (band, "all") for one in values]
        error, std = np.concatenate(some, axis=1).reshape(2, -1)
        within = [f"{(error <= times * std).mean():.0%}" for times in (1, 1.96)]
        print_row(name, error.size, *within, *(f"{np.sqrt((values**2).mean()):.3f}" for values in (error, std)))


def main(flights: list[str], captures: int = 0, rng_seed: int = 0) -> None:
    for name in flights:
        make, camera, usual = FLIGHTS[name]
        count = captures or usual
        with flight_and_out() as (flight, out):
            truth = read_ties(make(flight, captures=count, rng_seed=rng_seed))
            seconds = align(flight, out, "--with-rgb")
            bands = band_errors(out, truth)
            print(f"\n{name}: {len(bands)} of {len(truth)} bands written, {seconds / count:.1f} s a capture\n")
            has_faults = any(entry["trouble"] for entry in truth.values())
            print_errors(by_fault(bands, truth) if has_faults else by_band(bands, camera))
            if name == "plain":
                print_corners(out, truth)


if __name__ == "__main__":
    run(main)
