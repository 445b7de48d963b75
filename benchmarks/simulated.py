"""Errors of synthetic flights at their true ties: with and without faults, and of cameras without public ground truth.

    python benchmarks/simulated.py FLIGHT... [--captures N] [--rng-seed N] [--figures]

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
from figures_csv import FiguresOption, TableRow, write_figures
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.records.sidecar_file import find_sidecars, read_sidecar
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


TROUBLED = {
    "none": "not degraded",
    "panel": "calibration panel in the image",
    **dict.fromkeys(("take-off", "landing"), "take-off, landing"),
    "a lake": "lake",
    "blur, 3 px": "blur 3 px",
    "motion, 25 px": "motion 25 px",
    "noise, 30 %": "noise 30 %",
    **dict.fromkeys(("no NIR", "NIR lost", "Blue lost"), "a band missing or lost"),
}
TWO_HEADINGS = {"none": "bands exposed 25 ms apart, field", "a lake": "bands exposed 25 ms apart, water"}
"""Rows of docs/figures/figures.csv by faults; that of another fault is named after it."""
MODELS = {"mavic": "Mavic 3M", "mavic-3m": "Mavic 3M", "altum": "Altum", "altum-pt": "Altum-PT", "6x": "6X"}


def by_fault(bands: list[BandError], truth: Ties) -> dict[str, list[BandError]]:
    groups = defaultdict[str, list[BandError]](list)
    for band in bands:
        groups[truth[Path(band.part.file).name]["trouble"] or "none"].append(band)
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


def rows_of_faults(groups: dict[str, list[BandError]], names: dict[str, str]) -> list[TableRow]:
    """Return the rows of faults in docs/figures/figures.csv."""
    pooled = defaultdict[str, list[BandError]](list)
    for fault, bands in groups.items():
        pooled[names.get(fault, fault)] += bands
    rows = []
    for name, bands in pooled.items():
        cells = {one: sum(b.part.status == one for b in bands) for one in ("aligned", "predicted")}
        errors_px = [b.median_px for b in bands]
        cells |= {"median error, px": f"{np.median(errors_px):.3f}", "worst band, px": f"{max(errors_px):.3f}"}
        rows.append(TableRow("difficult captures", name, f"{len(bands)} bands", cells))
    return rows


def rows_of_cameras(by_camera: dict[str, list[BandError]]) -> list[TableRow]:
    """Return the rows of cameras in docs/figures/figures.csv: all narrow bands, and each other kind of a camera."""
    narrow, others = list[list[float]](), defaultdict[str, list[tuple[float, float, str]]](list)
    for flight, bands in by_camera.items():
        camera = FLIGHTS[flight][1]
        for spec in camera.bands:
            scale = spec.size_ratio[0] / spec.view * camera.bands[camera.reference].view
            own = [b for b in bands if b.part.band == spec.name]
            kind = {"colour": "colour photograph", "heat": "thermal band"}.get(spec.sees)
            kind = kind or ("panchromatic band" if spec.size_ratio[0] > 1 else None)
            if kind and own:
                others[f"{kind}, {MODELS[flight]}"] += [
                    (b.median_px / scale, b.median_px, b.sidecar.capture) for b in own
                ]
            elif own:
                narrow.append([b.median_px / scale for b in own])
    medians, worst_px = [np.median(errors_px) for errors_px in narrow], max(map(max, narrow))
    heads = [f"{what}, {px}, px" for px in ("reference", "band") for what in ("median error", "worst capture")]
    values = f"{min(medians):.3f} to {max(medians):.3f}", f"{worst_px:.3f}", "-", "-"
    *first, last = dict.fromkeys(MODELS[flight] for flight in by_camera)
    name = "narrow bands of " + (f"{', '.join(first)} and {last}" if first else last)
    rows = [
        TableRow("simulated cameras", name, f"{sum(map(len, narrow))} bands", dict(zip(heads, values, strict=True)))
    ]
    for name, errors in others.items():
        captures = len({capture for *_, capture in errors})
        values = [f"{statistic([e[k] for e in errors]):.3f}" for k in (0, 1) for statistic in (np.median, np.max)]
        rows.append(TableRow("simulated cameras", name, f"{captures} captures", dict(zip(heads, values, strict=True))))
    return rows


def print_corners(out: Path, truth: Ties) -> TableRow:
    """Print a table of the errors at the corners and their standard deviations; return its last row for the figures."""
    bands = defaultdict[str, list[np.ndarray]](list)
    for sidecar in map(read_sidecar, find_sidecars(out)):
        corners = geometry.corners(sidecar.reference.width, sidecar.reference.height)
        for band in (b for b in sidecar.bands if b.status == "aligned"):
            true = geometry.invert(np.array(truth[Path(band.file).name]["fixed_to_moving"]))
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
        rms_px = [f"{np.sqrt((values**2).mean()):.3f}" for values in (error, std)]
        print_row(name, error.size, *within, *rms_px)
    heads = "within 1 standard error, %", "within 1.96, %", "RMS error, px", "RMS standard error, px"
    cells = dict(zip(heads, (*(share.rstrip("%") for share in within), *rms_px), strict=True))
    return TableRow("standard errors", "errors at corners, along each axis", f"{error.size} errors", cells)


def main(flights: list[str], captures: int = 0, rng_seed: int = 0, *, figures: FiguresOption = False) -> None:
    rows, by_camera = list[TableRow](), dict[str, list[BandError]]()
    for name in flights:
        make, camera, usual = FLIGHTS[name]
        count = captures or usual
        with common.flight_and_out() as (flight, out):
            truth = common.read_ties(make(flight, captures=count, rng_seed=rng_seed))
            seconds = common.align(flight, out, "--with-rgb")
            bands = common.band_errors(out, truth)
            mapped = len({band.part.file for band in bands})
            print(f"\n{name}: {mapped} of {len(truth)} files have a mapping, {seconds / count:.1f} s a capture\n")
            has_faults = any(entry["trouble"] for entry in truth.values())
            common.print_errors(by_fault(bands, truth) if has_faults else by_band(bands, camera))
            if name == "plain":
                rows.append(print_corners(out, truth))
            elif has_faults:
                rows += rows_of_faults(by_fault(bands, truth), TROUBLED if name == "troubled" else TWO_HEADINGS)
            else:
                by_camera[name] = bands
    if figures:
        write_figures([*rows, *(rows_of_cameras(by_camera) if by_camera else ())])


if __name__ == "__main__":
    common.run(main)
