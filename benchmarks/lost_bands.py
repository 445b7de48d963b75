"""Results for bands without texture, and for captures over water, in an otherwise normal flight.

    python benchmarks/lost_bands.py FLIGHT...

In one run each capture of the flight loses another band, to noise; in another one whole capture is water. The rows are
of the lost bands. Errors are those at the reference tie points in ties.json. Without that file, they are the distances
from the mappings of the undamaged run, and the damaged runs use its model.
"""

from collections import defaultdict
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
from numpy.typing import NDArray


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
        yield "a band", [files[(turn + k) % len(files)] for k, files in enumerate(captures.values())], without_scene
    for reference, files in captures.items():
        yield "a capture", [reference, *files], water


def main(flights: list[Path]) -> None:
    rng, result = np.random.default_rng(0), defaultdict[str, list[BandError]](list)
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
                    result[f"{flight.name}, {name}"] += common.band_errors(out, known)
    common.print_errors(result)


if __name__ == "__main__":
    common.run(main)
