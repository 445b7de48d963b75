"""NDVI before and after alignment, against the truth. Prints a table.

    pip install -e '.[bench]' && python benchmarks/ndvi.py [DATA] [--captures 3] [--figures]

Without DATA: the synthetic flight, whose truth is the reflectance that it was painted with. With DATA, methods are
compared on the four captures of the row crop below it (benchmarks/bands/README.md). There the truth is the NDVI of the
same files when red and near infrared are resampled by a mapping that is fitted to the tie points, a cubic polynomial.
Edges are the 10 % of the pixels where this NDVI changes most; only pixels between tie points count. Rows named "NIR
shifted" have that mapping with near infrared shifted. OpenDroneMap is repeated: the median of its runs, and their
range.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from bands.images import locate
from bands.results import REPEATED, RUNS, with_range
from bands.run import bands_of, mapped
from bands.score import AS_IT_IS, Pair, mapped_px, pairs_of, read_sets
from common import flight_and_out, print_head, print_row, read_band, run, window_of
from figures_csv import FiguresOption, TableRow, write_figures
from numpy.typing import NDArray
from scipy.spatial import Delaunay

import agalign
from agalign.batch.index_run import index_tasks, run_indices
from agalign.cameras.discover import discover
from agalign.config import Settings, WriteSettings
from agalign.method.device import limit_threads
from agalign.pixels.radiometry import calibrated
from agalign.records.sidecar_file import read_sidecar
from agalign.spectral_indices.formulas import INDICES, compute
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import reflectance
from agalign.values import geometry
from agalign.values.geometry import Points

SIZE_PX = (1280, 960)
NDVI, BANDS = INDICES["ndvi"], ("NIR", "Red")
REAL = "rededge_m_rowcrop"
METHODS = "agalign, capture", *REPEATED
SHIFTS_PX = {"along x": (1.0, 0.0), "along y": (0.0, 1.0), "diagonally": (0.5**0.5, 0.5**0.5)}
"""Shifts of near infrared, px of its file."""
OFF = 0.1
"""A pixel whose NDVI is off by more is counted."""
EDGES = 0.1
"""Share of the pixels that are edges."""
_GRID_PX = 16
Errors = NDArray[np.float64]


def main(
    data: Annotated[Path | None, typer.Argument()] = None, captures: int = 3, *, figures: FiguresOption = False
) -> None:
    if data is None:
        print_synthetic(captures)
        return
    rows = [*real_rows(data)]
    print_head("NDVI", *rows[0].cells)
    for row in rows:
        print_row(row.name, *row.cells.values())
    if figures:
        write_figures(rows, "DATA", [data])


# ---- the synthetic flight


def print_synthetic(captures: int) -> None:
    """Print errors of the painted NDVI before and after alignment."""
    errors: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    specs, reference = {b.name: b for b in cameras.BANDS}, cameras.BANDS[cameras.REFERENCE]
    with flight_and_out() as (flight, out):
        synthetic.make_flight(flight, captures, SIZE_PX)
        poses, ground = synthetic.plan_flight(np.random.default_rng(0), captures, SIZE_PX)
        agalign.align_folder(flight, out, settings=Settings(write=WriteSettings(radiometry="auto")))
        reports = [r for done in run_indices(index_tasks(out, [NDVI], out)) for r in done]
        painted = [reflectance(ground, specs[name]) for name in BANDS]
        for pose, capture, report in zip(poses, discover(flight).captures, reports, strict=True):
            truth = compute(NDVI, [synthetic.view(p, ground, reference, pose, SIZE_PX) for p in painted])
            own = {b.name: calibrated(read_band(b.path), b.radiometry, 0, 0) for b in capture.bands}
            before, after = compute(NDVI, [own[name] for name in BANDS]), read_band(report.path)
            window = window_of(read_sidecar(report.path.with_name(f"{capture.name}.json")))
            errors["before"].append(np.abs(before[window] - truth[window]))
            errors["after"].append(np.abs(after - truth[window]))
    print_head("NDVI", "median error", "mean", "95 %", "pixels off by more than 0.1")
    for name, result in errors.items():
        every = np.concatenate([e[np.isfinite(e)] for e in result])
        figures = [f"{value:.3f}" for value in (np.median(every), every.mean(), np.percentile(every, 95))]
        print_row(name, *figures, f"{(every > OFF).mean():.1%}")


# ---- real captures


def real_rows(data: Path) -> Iterator[TableRow]:
    """Yield the errors of NDVI by each method, and without alignment."""
    limit_threads(1)
    description = read_sets()[REAL]
    located, _ = locate(data, {REAL: description})
    if REAL not in located:
        raise SystemExit(f"{data}: does not contain all images of {REAL}")
    paths, pairs = located[REAL], pairs_of(description)
    bands = bands_of(paths)
    pixels = {name: calibrated(read_band(path), bands[name].radiometry, 0, 0) for name, path in paths.items()}
    true = [{"grid": grid_of_ties(pair)} for pair in pairs]
    files = {(pair.capture, bands[pair.file].name): pair.file for pair in pairs}
    captures = list(dict.fromkeys(pair.capture for pair in pairs))

    def ndvi(rows: Mapping[str, Mapping[str, Any]]) -> list[Errors]:
        """Return the NDVI of each capture under mappings by file."""
        named = [[files[capture, name] for name in BANDS] for capture in captures]
        return [compute(NDVI, [resampled(pixels[file], rows[file]) for file in two]) for two in named]

    def by_file(rows: Any) -> dict[str, Any]:
        return {pair.file: row for pair, row in zip(pairs, rows, strict=True)}

    truth = ndvi(by_file(true))
    inside = [
        np.all([between_ties(p) for p in pairs if p.capture == c and bands[p.file].name in BANDS], 0) for c in captures
    ]

    def cells(rows: Any) -> dict[str, str]:
        errors = [
            np.where(i, np.abs(n - t), np.nan) for n, t, i in zip(ndvi(by_file(rows)), truth, inside, strict=True)
        ]
        at_edges = [e[edges(t)] for e, t in zip(errors, truth, strict=True)]
        every, at_edge = (np.concatenate([np.ravel(e) for e in some]) for some in (errors, at_edges))
        every, at_edge = every[np.isfinite(every)], at_edge[np.isfinite(at_edge)]
        return {
            "median error at edges": f"{np.median(at_edge):.3f}",
            "off by more than 0.1 at edges, %": f"{100 * (at_edge > OFF).mean():.1f}",
            "off by more than 0.1, %": f"{100 * (every > OFF).mean():.1f}",
        }

    count = f"{len(captures)} captures"
    yield TableRow("NDVI", "not aligned", count, cells([{"homography": np.eye(3).tolist()}] * len(pairs)))
    nir = {files[capture, BANDS[0]] for capture in captures}
    for name, shift_px in SHIFTS_PX.items():
        rows = [shifted(row, shift_px) if pair.file in nir else row for pair, row in zip(pairs, true, strict=True)]
        yield TableRow("NDVI", f"NIR shifted by 1 px {name}", count, cells(rows))
    for method in METHODS:
        runs = RUNS if method in REPEATED else 1
        of_runs = [cells(mapped(method, description, pairs, AS_IT_IS, paths, bands)) for _ in range(runs)]
        yield TableRow("NDVI", method, count, {head: with_range([c[head] for c in of_runs]) for head in of_runs[0]})


def grid_of_ties(pair: Pair) -> dict[str, Any]:
    """Return the mapping of a pair by a cubic polynomial that is fitted to its tie points, on a lattice."""
    coefficients, *_ = np.linalg.lstsq(cubic(pair.reference_px), pair.moving_px)
    here = geometry.lattice(*SIZE_PX, SIZE_PX[0] // _GRID_PX, SIZE_PX[1] // _GRID_PX)
    return {"reference_px": here, "moving_px": cubic(here) @ coefficients}


def shifted(row: Mapping[str, Any], shift_px: tuple[float, float]) -> dict[str, Any]:
    """Return the lattice of a mapping with (x, y) added in the band."""
    return {"grid": {**row["grid"], "moving_px": row["grid"]["moving_px"] + np.array(shift_px)}}


def cubic(points_px: Points) -> NDArray[np.float64]:
    """Return the ten monomials of points (n, 2) up to the third degree, with coordinates of about 1."""
    x, y = ((points_px - np.divide(SIZE_PX, 2)) / max(SIZE_PX)).T
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def between_ties(pair: Pair) -> NDArray[np.bool_]:
    """Return which pixels of the reference (height, width) are within the convex hull of the tie points of a pair."""
    return (Delaunay(pair.reference_px).find_simplex(all_pixels()) >= 0).reshape(SIZE_PX[::-1])


def all_pixels() -> Points:
    """Return the pixels of an image (n, 2), row by row."""
    return geometry.lattice(*SIZE_PX, *SIZE_PX)


def resampled(pixels: NDArray[Any], row: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return a band on the grid of the reference; nan outside, or without a mapping."""
    there = mapped_px(row, all_pixels())
    if there is None:
        return np.full(SIZE_PX[::-1], np.nan, np.float32)
    at = there.reshape(*SIZE_PX[::-1], 2).astype(np.float32)
    return np.asarray(cv2.remap(pixels, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan))


def edges(ndvi: Errors) -> NDArray[np.bool_]:
    """Return the pixels where NDVI changes most."""
    change = np.hypot(*np.gradient(ndvi))
    return np.asarray(change > np.nanquantile(change, 1 - EDGES))


if __name__ == "__main__":
    run(main)
