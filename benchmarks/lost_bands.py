"""Results for bands without texture, and for captures over water, in an otherwise normal flight.

    python benchmarks/lost_bands.py FLIGHT...

FLIGHT holds a flight with reference tie points of its captures in ties.json. In one run each capture loses another
band, to noise; in another one whole capture is water. The rows are of the lost bands.
"""

import json
from pathlib import Path

import cv2
import numpy as np
from common import (
    BandError,
    align,
    band_errors,
    flight_and_out,
    print_errors,
    read_band,
    read_ties,
    run,
    writable_copy,
    write_band,
)


def degrade(path: Path, how: str, rng: np.random.Generator) -> None:
    """Replace a file's pixels, and leave its tags."""
    pixels = read_band(path)
    noise = rng.normal(size=pixels.shape)
    if how == "water":
        glitter = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 3.0)
        noise = 0.3 * noise + glitter / glitter.std()
    write_band(path, (np.median(pixels) + 0.5 * pixels.std() * noise).clip(1, 65000).astype(pixels.dtype))


def run_without(flight: Path, lost: set[str], how: str, rng: np.random.Generator) -> list[BandError]:
    """Align a copy of a flight without these files, and return their errors."""
    with flight_and_out() as (copy, out):
        writable_copy(flight, copy)
        for name in sorted(lost):
            degrade(next(copy.rglob(name)), how, rng)
        align(copy, out)
        truth = read_ties(flight / "ties.json")
        return band_errors(out, {name: entry for name, entry in truth.items() if name in lost})


def main(flights: list[Path]) -> None:
    rng, result = np.random.default_rng(0), dict[str, list[BandError]]()
    for flight in flights:
        captures = list(json.loads((flight / "ties.json").read_text()).values())
        count = len(captures[0]["bands"])
        for turn in range(count):
            lost = {list(c["bands"])[(turn + i) % count] for i, c in enumerate(captures)}
            result.setdefault(f"{flight.name}, a band", []).extend(run_without(flight, lost, "noise", rng))
        for capture in captures:
            lost = {capture["reference"], *capture["bands"]}
            result.setdefault(f"{flight.name}, a capture", []).extend(run_without(flight, lost, "water", rng))
    print_errors(result)


if __name__ == "__main__":
    run(main)
