"""Error of every band next to the error that the run claims, for flights as they are and damaged, and time.

    python benchmarks/accuracy.py DATA [SET ...] [--damage NAME,...] [--bands] [--figures]

A set is a folder with images below DATA. The error is measured at reference tie points (`ties.json` in the folder); in
damaged copies without them it is the distance from the mapping of the undamaged run, for bands that are aligned there.
The claim at a point is the value of the error map (`--error-map`). A usable band is aligned, or predicted within
--accept-predicted; it is overconfident if more than a tenth of its points are off by more than 1 px and by two claims.
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import common
import cv2
import numpy as np
import typer
from bands.images import in_other_light
from common import BandError, Ties, cell, print_head, print_row
from figures_csv import FiguresOption, TableRow, title_of, write_figures
from numpy.typing import NDArray

from agalign import read_alignment
from agalign.cameras.discover import discover
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.values import geometry

TIE_NOISE_PX = 0.05
"""Noise of reference tie points, added to the claims."""


def with_noise(pixels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Add noise with a standard deviation of 60 % of the mean."""
    return pixels + 0.6 * pixels.mean() * rng.normal(size=pixels.shape)


def with_gloss(pixels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Saturate spots of some pixels over 3 % of the image, other ones in each band."""
    spots = cv2.GaussianBlur(rng.normal(size=pixels.shape).astype(np.float32), (0, 0), 5.0)
    return np.where(spots >= np.quantile(spots, 0.97), np.iinfo(pixels.dtype).max, pixels)


DAMAGES: dict[str, tuple[Any, str]] = {
    "noise 60 % in one": (with_noise, "one"),
    "noise 30 %": (partial(in_other_light, variant="noise 30 %"), "moving"),
    "half saturated": (partial(in_other_light, variant="half saturated"), "moving"),
    "gloss": (with_gloss, "all"),
}
"""Function of pixels and `rng`, and the bands of each capture that it changes: one, the moving ones, or all."""


def damaged_copy(source: Path, copy: Path, name: str) -> None:
    """Copy a flight, with damage."""
    common.writable_copy(source, copy)
    damage, which = DAMAGES[name]
    change = partial(damage, rng=np.random.default_rng(0))
    for capture in discover(copy).captures:
        moving = [band for band in capture.moving if band.path.suffix.lower() in (".tif", ".tiff")]
        for band in {"one": moving[-1:], "moving": moving, "all": [capture.reference, *moving]}[which]:
            common.change_band(band.path, change)


def ties_of(out: Path) -> Ties:
    """Return the mappings of the aligned bands of a run as ties of their files."""
    result = {}
    for path in find_sidecars(out):
        sidecar = read_sidecar(path)
        for band in (b for b in sidecar.bands if b.status == "aligned"):
            points = geometry.lattice(*sidecar.reference.size_px, 64, 48)
            ties = np.hstack([points, read_alignment(path, band.band).map(points)])
            result[Path(band.file).name] = {"ties": ties, "reference": Path(sidecar.reference.file).name}
    return result


def known_errors(out: Path, ties: Ties, of_a_run: Ties) -> list[BandError]:
    """Return the errors at ties, for files without them at those of a run where the band is written, and the claims
    there with the noise of the ties. A file without any has no errors.
    """
    result = []
    for band in common.band_errors(out, of_a_run | ties):
        file = Path(band.part.file).name
        is_reference = (of_a_run | ties)[file]["reference"] == Path(band.sidecar.reference.file).name
        claim_px = np.hypot(band.claim_px, TIE_NOISE_PX * (1 if is_reference else 2))
        known = np.isfinite(band.error_px) & (file in ties or np.isfinite(claim_px))
        result.append(replace(band, error_px=band.error_px[known], claim_px=claim_px[known]))
    return result


def is_overconfident(band: BandError) -> bool:
    off = (band.error_px > 1) & ~(band.error_px <= 2 * band.claim_px)
    return band.is_usable and bool(off.sum() > 0.1 * len(off))


def print_bands(name: str, bands: list[BandError]) -> None:
    for row in bands:
        verdict = "OVERCONFIDENT" if is_overconfident(row) else "usable" if row.is_usable else ""
        errors = [cell(row.error_px, ".3f", partial(np.percentile, q=q)) for q in (50, 68, 90)]
        beyond, claim = cell(row.error_px > 1, ".0%", np.mean), cell(row.claim_px, ".3f")
        what = row.name, row.part.status, row.part.geometry.kind, verdict
        print_row(name, *what, *errors, beyond, claim, f"{row.part.seconds:.1f}")


def summary(name: str, rows: list[BandError]) -> tuple[Any, ...]:
    aligned, usable = [r for r in rows if r.part.status == "aligned"], [r for r in rows if r.is_usable]
    medians, p95s = ([np.percentile(r.error_px, q) for r in aligned if len(r.error_px)] for q in (50, 95))
    pairs = [np.stack([r.error_px, r.claim_px]) for r in usable]
    error, claim = np.concatenate([np.empty((2, 0)), *pairs], axis=1)
    error, claim = error[np.isfinite(claim)], claim[np.isfinite(claim)]
    counts = f"{len(aligned)} of {len(rows)}", len(usable) - len(aligned), sum(map(is_overconfident, rows))
    errors = cell(medians, ".3f"), cell(medians, ".3f", np.max), cell(p95s, ".2f")
    shares = cell(error <= 2 * claim, ".0%", np.mean), cell((claim < 0.3) & (error > 1), ".1%", np.mean)
    return name, *counts, *errors, *shares, cell([r.part.seconds for r in aligned], ".1f")


def table_row(folder: Path, rows: list[BandError]) -> TableRow:
    """Return the row of an undamaged flight in docs/figures/figures.csv."""
    _, aligned, usable, overconfident, median, worst, p95, within, *_ = summary("", rows)
    heads = "aligned", "predicted, usable", "overconfident", "median error, px", "worst pair, px", "95th percentile, px"
    values = aligned.partition(" ")[0], usable, overconfident, median, worst, p95
    cells = {**dict(zip(heads, values, strict=True)), "within 2 expected errors, %": within.rstrip("%")}
    return TableRow("accuracy", title_of(folder), f"{len(rows)} pairs", cells)


def main(
    data: Path,
    sets: Annotated[list[str] | None, typer.Argument()] = None,
    damage: str = "",
    *,
    bands: bool = False,
    figures: FiguresOption = False,
) -> None:
    suffixes = ".tif", ".jpg", ".jpeg"
    folders = sorted(  # a set may be a link, which Path.rglob does not follow
        Path(root)
        for root, _, names in os.walk(data, followlinks=True)
        if any(name.lower().endswith(suffixes) for name in names)
    )
    folders = [f for f in folders if (f.name in sets if sets else (f / "ties.json").exists())]
    if not folders:
        raise SystemExit(f"{data}: no folder with images {'of these names' if sets else 'and ties.json'}")
    lines, undamaged = [], []
    if bands:
        print_head("set", "band", "status", "geometry", "", "p50, px", "p68", "p90", "> 1 px", "claim", "seconds")
    for folder in folders:
        ties = common.read_ties(folder / "ties.json")
        nothing = {"ties": np.empty((0, 4)), "reference": ""}
        of_a_run = {band.path.name: nothing for capture in discover(folder).captures for band in capture.bands}
        for name in ("", *(d for d in damage.split(",") if d)):
            title = f"{folder.name}, {name}" if name else folder.name
            with common.flight_and_out() as (flight, out):
                if name:
                    damaged_copy(folder, flight, name)
                common.align(flight if name else folder, out, "--error-map")
                rows = known_errors(out, ties, of_a_run)
                if not name and damage:
                    of_a_run |= ties_of(out)
            if bands:
                print_bands(title, rows)
            lines.append(summary(title, rows))
            undamaged += [] if name else [table_row(folder, rows)]
    print()
    shares = "error <= 2 claims", "claim < 0.3, error > 1"
    print_head(
        "set", "aligned", "usable predictions", "overconfident", "median, px", "worst", "95 %", *shares, "s per pair"
    )
    for line in lines:
        print_row(*line)
    if figures:
        write_figures(undamaged, "DATA", [data])


if __name__ == "__main__":
    common.run(main)
