"""Results for bands without texture, and for captures over water, in an otherwise normal flight.

    python benchmarks/lost_bands.py FLIGHT... [--figures]

In one run each capture of the flight loses another band, to noise; in another one whole capture is water. The rows are
of the lost bands. The last row has those that indices use: predicted within --accept-predicted. Errors are
those at the reference tie points in ties.json. Without that file, they are the distances from the mappings of the
undamaged run, and the damaged runs use its model.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from accuracy import ties_of
from bands.images import without_scene
from common import BandError, Ties
from figures_csv import FiguresOption, TableRow, title_of, write_figures
from numpy.typing import NDArray

USABLE = "expected error up to 1 px"
"""Bands that indices use by default."""


def water(pixels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Return glitter with noise and the brightness of an image."""
    fine = rng.normal(size=pixels.shape)
    glitter = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), 3.0)
    return np.median(pixels) + 0.5 * pixels.std() * (0.3 * fine + glitter / glitter.std())


def losses(truth: Ties) -> Iterator[tuple[str, list[str], Any]]:
    """Yield (name, lost files, what replaces them) of each damaged run."""
    captures = defaultdict[str, list[str]](list)
    for file, entry in truth.items():
        captures[entry["reference"]].append(file)
    for turn in range(max(map(len, captures.values()))):
        lost = [files[(turn + k) % len(files)] for k, files in enumerate(captures.values())]
        yield "one band each", lost, without_scene
    for reference, files in captures.items():
        yield "a capture", [reference, *files], water


def table_row(name: str, bands: list[BandError], lost: int) -> TableRow:
    """Return the row of a number of lost bands, some of which may have no prediction: errors are medians over a band's
    tie points.
    """
    errors_px, std_px = np.array([(b.median_px, b.std_px) for b in bands if b.part.status == "predicted"]).T
    cells: dict[str, object] = {"predicted": len(errors_px)}
    heads = "median error, px", "p95, px", "worst band, px"
    cells |= {head: f"{px:.2f}" for head, px in zip(heads, np.percentile(errors_px, (50, 95, 100)), strict=True)}
    within = [f"{np.mean(errors_px <= times * std_px):.0%}".rstrip("%") for times in (1, 2)]
    cells |= dict(zip(("within 1 expected error, %", "within 2, %"), within, strict=True))
    return TableRow("predicted bands", name, f"{lost} bands", cells)


def main(flights: list[Path], *, figures: FiguresOption = False) -> None:
    rng, result, counts = np.random.default_rng(0), defaultdict[str, list[BandError]](list), Counter[str]()
    for flight in flights:
        truth, options = common.read_ties(flight / "ties.json"), list[str]()
        with common.flight_and_out() as (_, undamaged):
            if not truth:
                common.align(flight, undamaged)
                truth, options = ties_of(undamaged), ["--model", *map(str, undamaged.glob("models/*.safetensors"))]
            for name, lost, change in losses(truth):
                with common.flight_and_out() as (copy, out):
                    common.writable_copy(flight, copy)
                    for file in sorted(lost):
                        common.change_band(next(copy.rglob(file)), partial(change, rng=rng))
                    common.align(copy, out, *options)
                    known = {file: truth[file] for file in lost if file in truth}
                    group = f"{title_of(flight)}: {name}"
                    result[group] += common.band_errors(out, known)
                    counts[group] += len(known)
    of_all = [band for bands in result.values() for band in bands]
    result[USABLE] = [band for band in of_all if band.part.status == "predicted" and band.is_usable]
    counts[USABLE] = len(result[USABLE])
    common.print_errors(result)
    if figures:
        write_figures([table_row(name, bands, counts[name]) for name, bands in result.items()], "DATA/", flights)


if __name__ == "__main__":
    common.run(main)
