"""Error of every band next to the error that the run claims, for flights as they are and damaged, and time.

    python benchmarks/accuracy.py DATA [SET ...] [--damage NAME,...] [--bands]

A set is a folder with images below DATA. The error is measured at reference tie points (`ties.json` in the folder); in
damaged copies without them it is the distance from the mapping of the undamaged run, for bands that are aligned there.
The claim at a point is the value of the error map (`--error-map`). A usable band is aligned, or predicted within
--accept-predicted; it is wrong if more than a tenth of its points are off by more than 1 px and by two claims.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import rasterio
import typer
from bands.images import in_other_light
from common import align, flight_and_out, print_head, print_row, run, writable_copy
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from agalign import Alignment, read_alignment
from agalign.cameras.discover import discover
from agalign.config import CheckSettings
from agalign.pixels.raster import without_warnings
from agalign.products.sidecar.file import find_sidecars
from agalign.values import geometry

Points = NDArray[np.float64]
TIE_NOISE_PX = 0.05
"""Noise of reference tie points, added to the claims."""


def with_noise(share: float) -> Any:
    return lambda pixels, rng: pixels + share * pixels.mean() * rng.normal(size=pixels.shape)


def with_gloss(pixels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Saturate spots of some pixels over 3 % of the image, other ones in each band."""
    spots = cv2.GaussianBlur(rng.normal(size=pixels.shape).astype(np.float32), (0, 0), 5.0)
    return np.where(spots >= np.quantile(spots, 0.97), np.iinfo(pixels.dtype).max, pixels)


DAMAGES: dict[str, tuple[Any, str]] = {
    "noise 60 % in one": (with_noise(0.6), "one"),
    "noise 30 %": (lambda pixels, rng: in_other_light(pixels, "noise 30 %", rng), "moving"),
    "half saturated": (lambda pixels, rng: in_other_light(pixels, "half saturated", rng), "moving"),
    "gloss": (with_gloss, "all"),
}
"""Function of (pixels, generator), and the bands of each capture that it changes: one, the moving ones, or all."""


@dataclass(frozen=True)
class Row:
    """A band with its errors and claims at some points."""

    capture: str
    band: str
    status: str
    geometry: str
    is_usable: bool
    error_px: Points
    claim_px: Points
    seconds: float

    @property
    def is_wrong(self) -> bool:
        off = (self.error_px > 1) & ~(self.error_px <= 2 * self.claim_px)
        return self.is_usable and float(off.mean()) > 0.1


def damaged_copy(source: Path, copy: Path, name: str) -> None:
    """Copy a flight, with damage."""
    writable_copy(source, copy)
    change, which = DAMAGES[name]
    rng = np.random.default_rng(0)
    for capture in discover(copy).captures:
        moving = [band for band in capture.moving if band.path.suffix.lower() in (".tif", ".tiff")]
        bands = {"one": moving[-1:], "moving": moving, "all": [capture.reference, *moving]}[which]
        for band in bands:
            with without_warnings(), rasterio.open(band.path, "r+") as dataset:
                pixels = dataset.read(1)
                dataset.write(change(pixels, rng).clip(1, np.iinfo(pixels.dtype).max).astype(pixels.dtype), 1)


def claims_px(path: Path, sidecar: Any, band: str, points_px: Points) -> Points:
    """Return the error map (n,) of a band at raw points (n, 2) of the reference; nan outside."""
    error_map = path.with_suffix(".error.tif")
    if not error_map.exists():
        return np.full(len(points_px), np.nan)
    with rasterio.open(error_map) as dataset:
        if band not in dataset.descriptions:
            return np.full(len(points_px), np.nan)
        values = dataset.read(dataset.descriptions.index(band) + 1)
    x0, y0 = sidecar["output"]["crop"][:2]
    axes = (np.arange(n) + at for n, at in zip(values.shape, (y0, x0), strict=True))
    return np.asarray(RegularGridInterpolator(tuple(axes), values, bounds_error=False)(points_px[:, ::-1]))


def rows_of(out: Path, folder: Path, clean: dict[tuple[str, str], Alignment[Any]] | None) -> list[Row]:
    """Return a row for each moving band of a run; `clean` are the mappings of the undamaged run."""
    result, ties, truth = [], folder / "ties.json", {}
    for capture in json.loads(ties.read_text(encoding="utf-8")).values() if ties.exists() else ():
        truth |= {file: entry | {"reference": capture["reference"]} for file, entry in capture["bands"].items()}
    for path in find_sidecars(out):
        sidecar = json.loads(path.read_text(encoding="utf-8"))
        for band in sidecar["bands"]:
            if band["status"] == "reference" or band["homography"] is None:
                continue
            alignment = read_alignment(path, band["band"])
            points, target, noise_px = np.empty((0, 2)), np.empty((0, 2)), TIE_NOISE_PX
            undamaged = (clean or {}).get((sidecar["capture"], band["band"]))
            if band["file"] in truth:
                points, target = np.hsplit(np.array(truth[band["file"]]["ties"]), 2)
                other = next(b for b in sidecar["bands"] if b["file"] == truth[band["file"]]["reference"])
                if other["status"] != "reference":  # the run has another reference than the ties
                    points = read_alignment(path, other["band"]).inverse(points)
                    noise_px *= 2
            elif undamaged is not None and undamaged.status == "aligned":
                points = geometry.lattice(*alignment.size_px, 64, 48)
                target = undamaged.map(points)
            error = np.linalg.norm(alignment.map(points) - target, axis=1)
            claim = np.hypot(claims_px(path, sidecar, band["band"], points), noise_px)
            kept = np.isfinite(error) & (band["file"] in truth or np.isfinite(claim))
            predicted = band["prediction"] or {}
            usable = band["status"] == "aligned" or (
                band["status"] == "predicted" and predicted["std_px"] <= CheckSettings().accept_predicted_px
            )
            facts = sidecar["capture"], band["band"], band["status"], alignment.geometry, usable
            result.append(Row(*facts, error[kept], claim[kept], band["seconds"]))
    return result


def mappings(out: Path) -> dict[tuple[str, str], Alignment[Any]]:
    """Return the alignments of a run by capture and band."""
    result = {}
    for path in find_sidecars(out):
        sidecar = json.loads(path.read_text(encoding="utf-8"))
        for band in sidecar["bands"]:
            if band["status"] != "reference" and band["homography"] is not None:
                result[sidecar["capture"], band["band"]] = read_alignment(path, band["band"])
    return result


def percentile(values: Points, share: float) -> str:
    return f"{np.nanpercentile(values, share):.3f}" if np.isfinite(values).any() else ""


def print_rows(name: str, rows: list[Row]) -> None:
    for row in rows:
        wrong = "WRONG" if row.is_wrong else "usable" if row.is_usable else ""
        errors = [percentile(row.error_px, q) for q in (50, 68, 90)]
        beyond = f"{(row.error_px > 1).mean():.0%}" if len(row.error_px) else ""
        claim = percentile(row.claim_px, 50)
        what = (f"{row.capture} {row.band}", row.status, row.geometry, wrong)
        print_row(name, *what, *errors, beyond, claim, f"{row.seconds:.1f}")


def summary(name: str, rows: list[Row]) -> tuple[str, ...]:
    aligned = [r for r in rows if r.status == "aligned"]
    medians, p95s = (np.array([np.percentile(r.error_px, q) for r in aligned if len(r.error_px)]) for q in (50, 95))
    usable = [r for r in rows if r.is_usable and len(r.error_px) and np.isfinite(r.claim_px).any()]
    error = np.concatenate([r.error_px for r in usable]) if usable else np.empty(0)
    claim = np.concatenate([r.claim_px for r in usable]) if usable else np.empty(0)
    known = np.isfinite(claim)
    error, claim = error[known], claim[known]
    within = f"{(error <= 2 * claim).mean():.0%}" if len(error) else ""
    false = f"{((claim < 0.3) & (error > 1)).mean():.1%}" if len(error) else ""
    return (
        name,
        f"{len(aligned)} of {len(rows)}",
        str(sum(r.is_usable for r in rows) - len(aligned)),
        str(sum(r.is_wrong for r in rows)),
        f"{np.median(medians):.3f}" if len(medians) else "",
        f"{medians.max():.3f}" if len(medians) else "",
        f"{np.median(p95s):.2f}" if len(p95s) else "",
        within,
        false,
        f"{np.median([r.seconds for r in aligned]):.1f}" if aligned else "",
    )


def main(
    data: Path,
    sets: Annotated[list[str] | None, typer.Argument()] = None,
    *,
    damage: Annotated[str, typer.Option()] = "",
    bands: Annotated[bool, typer.Option()] = False,
) -> None:
    folders = sorted({p.parent for p in data.rglob("*") if p.suffix.lower() in (".tif", ".jpg", ".jpeg")})
    folders = [f for f in folders if (f.name in sets if sets else (f / "ties.json").exists())]
    lines = []
    if bands:
        print_head("set", "band", "status", "geometry", "", "p50, px", "p68", "p90", "> 1 px", "claim", "seconds")
    for folder in folders:
        clean: dict[tuple[str, str], Alignment[Any]] | None = None
        for name in ("", *(d for d in damage.split(",") if d)):
            title = f"{folder.name}, {name}" if name else folder.name
            with flight_and_out() as (flight, out):
                if name:
                    damaged_copy(folder, flight, name)
                align(flight if name else folder, out, "--error-map")
                rows = rows_of(out, folder, clean if name else None)
                if not name and damage:
                    clean = mappings(out)
            if bands:
                print_rows(title, rows)
            lines.append(summary(title, rows))
    print()
    shares = "error <= 2 claims", "claim < 0.3, error > 1"
    print_head("set", "aligned", "usable predictions", "wrong", "median, px", "worst", "95 %", *shares, "s per pair")
    for line in lines:
        print_row(*line)


if __name__ == "__main__":
    run(main)
