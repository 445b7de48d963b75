"""Results for bands without texture, and for captures over water, in an otherwise normal flight.

    python benchmarks/lost_bands.py FLIGHT...

In one run each capture of the flight loses another band, to noise; in another one whole capture is water. The rows are
of the lost bands. Errors are those at the reference tie points in ties.json. Without that file, they are the distances
from the mappings of the undamaged run, and the damaged runs use its model.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from accuracy import ties_of
from common import (
    BandError,
    Ties,
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


def run_without(
    flight: Path, truth: Ties, lost: Sequence[str], how: str, rng: np.random.Generator, *options: str
) -> list[BandError]:
    """Align a copy of a flight without these files, and return their errors."""
    with flight_and_out() as (copy, out):
        writable_copy(flight, copy)
        for name in sorted(lost):
            degrade(next(copy.rglob(name)), how, rng)
        align(copy, out, *options)
        return band_errors(out, {name: entry for name, entry in truth.items() if name in lost})


def main(flights: list[Path]) -> None:
    rng, result = np.random.default_rng(0), dict[str, list[BandError]]()
    for flight in flights:
        with flight_and_out() as (_, out):
            if (flight / "ties.json").exists():
                truth, options = read_ties(flight / "ties.json"), []
            else:
                align(flight, out)
                truth, options = ties_of(out), ["--model", *map(str, out.glob("models/*.safetensors"))]
            captures = defaultdict[str, list[str]](list)
            for file, entry in truth.items():
                captures[entry["reference"]].append(file)
            count = max(map(len, captures.values()))
            for turn in range(count):
                lost = [files[(turn + k) % len(files)] for k, files in enumerate(captures.values())]
                result.setdefault(f"{flight.name}, a band", []).extend(
                    run_without(flight, truth, lost, "noise", rng, *options)
                )
            for reference, files in captures.items():
                lost = [reference, *files]
                result.setdefault(f"{flight.name}, a capture", []).extend(
                    run_without(flight, truth, lost, "water", rng, *options)
                )
    print_errors(result)


if __name__ == "__main__":
    run(main)
