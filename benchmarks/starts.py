"""Success of methods by initial shift, rotation and scale of the moving band, without tags.

    pip install -e '.[bench]' && python benchmarks/starts.py DATA... [--pairs 3] [--figures]

DATA holds flights with `ties.json` or `truth.json` (benchmarks/accuracy.py says how); of each, and of a synthetic
flight, so many pairs are taken. The moving band is shifted within its frame by a share of its width, then turned and
scaled about its centre on a canvas that holds all of it. A pair is found where the median error is at most 0.3 px of
the moving file.
"""

import tempfile
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from bands import images
from common import WRONG_PX, cell, print_head, print_row, read_ties, run, timed
from figures_csv import FiguresOption, TableRow, write_figures
from numpy.typing import NDArray
from peers import elastix, sift

import agalign
from agalign.cameras.base import rotation
from agalign.cameras.discover import discover
from agalign.pixels.raster import read_for_alignment
from agalign.synthetic import flight as synthetic
from agalign.values import geometry, lens
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

FOUND_PX = 0.3
SHIFTS, TURNS, SCALES = (0.0, 0.1, 0.2, 0.25), (0.0, 3.0, 10.0, 45.0, 90.0, 180.0), (0.5, 0.8, 1.25, 2.0)
STARTS = [(shift, turn, 1.0) for turn in TURNS for shift in SHIFTS] + [(0.0, turn, s) for s in SCALES for turn in TURNS]
Aligner = Callable[[Raster, Raster], tuple[Matrix | None, bool]]
"""Maps a pair to (fixed_to_moving, whether the method accepts its result)."""


def moved(raster: Raster, shift: float, degrees: float, scale: float) -> tuple[Raster, Matrix]:
    """Return (the image shifted, rotated and scaled in its frame, the homography from old to new pixels)."""
    width, height = raster.size_px
    within = geometry.translation(shift * width, -shift * height / 2)
    about = rotation(0, 0, degrees) @ np.diag([scale, scale, 1.0])
    size = tuple(np.ceil(np.abs(about[:2, :2]) @ (width, height)).astype(int).tolist())
    about[:2, 2] = (np.array(size) - 1) / 2 - about[:2, :2] @ ((np.array([width, height]) - 1) / 2)
    frame = cv2.warpAffine(raster.valid.astype(np.uint8) * 255, within[:2], (width, height))
    whole = cv2.warpAffine(frame, about[:2], size) == 255
    matrix = about @ within
    return Raster(images.moved(raster.pixels, matrix, size), whole), matrix


def ours(fixed: Raster, moving: Raster) -> tuple[Matrix | None, bool]:
    result = agalign.align(fixed.pixels, moving.pixels, fixed_valid=fixed.valid, moving_valid=moving.valid)
    return result.fixed_to_moving, result.status == "aligned"


def by_sift(fixed: Raster, moving: Raster) -> tuple[Matrix | None, bool]:
    result = sift(fixed.pixels, moving.pixels)
    return None if result is None else result.fixed_to_moving, True


def by_elastix(fixed: Raster, moving: Raster) -> tuple[Matrix | None, bool]:
    """Register the moving image, resampled to the size of the fixed one, by elastix."""
    overlay = geometry.overlay(fixed.size_px, moving.size_px)
    resized = cv2.warpPerspective(moving.pixels, overlay, fixed.size_px, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    result = elastix(fixed.pixels, resized)
    return None if result is None else geometry.compose(overlay, result), True


METHODS: dict[str, Aligner] = {"agalign": ours, "SIFT + MAGSAC": by_sift, "elastix affine": by_elastix}


def error_px(ties: NDArray[np.float64], to_moved: Matrix, result: Matrix | None) -> float:
    """Return the median error, px of the moving file, of tie points (n, 4) inside the transformed image."""
    if result is None:
        return float("inf")
    there = geometry.apply(to_moved, ties[:, 2:])
    off = np.linalg.norm(geometry.apply(result, ties[:, :2]) - there, axis=1)
    return float(np.median(off) / np.sqrt(abs(np.linalg.det(to_moved[:2, :2]))))


def chosen(folder: Path, count: int) -> Iterator[tuple[Raster, Raster, NDArray[np.float64]]]:
    """Yield this number of pairs of a flight, evenly spread: two images without lens distortion, and (n, 4) tie points
    in their pixels.
    """
    truth = read_ties(folder / "ties.json") or read_ties(folder / "truth.json")
    captures = discover(folder).captures
    pairs = [(c.reference, band) for c in captures for band in c.moving if band.path.name in truth]
    for index in np.unique(np.linspace(0, len(pairs) - 1, count).round().astype(int)):
        fixed, moving = (images.straightened(read_for_alignment(band, 4096)) for band in pairs[index])
        raw_px = np.hsplit(np.array(truth[pairs[index][1].path.name]["ties"]), 2)
        ties = [lens.undistort(band.lens, px) for band, px in zip(pairs[index], raw_px, strict=True)]
        yield fixed, moving, np.hstack(ties)


def main(data: list[Path], pairs: int = 3, methods: str = ";".join(METHODS), *, figures: FiguresOption = False) -> None:
    counts = {name: np.zeros(3, int) for name in methods.split(";")}
    kind = "method", "shift", "turn", "scale"
    print_head(*kind, "found", "median, px", "worst sure, px", "wrong though sure", "s")
    with tempfile.TemporaryDirectory() as folder:
        synthetic.make_flight(Path(folder), captures=2, rng_seed=11)
        tried = [pair for flight in (*data, Path(folder)) for pair in chosen(flight, pairs)]
    for start, name in product(STARTS, counts):
        rows = []
        for fixed, moving, ties in tried:
            image, to_moved = moved(moving, *start)
            seconds, (result, is_sure) = timed(METHODS[name], fixed, image)
            rows.append((error_px(ties, to_moved, result), is_sure, seconds))
        off, sure, seconds = map(np.array, zip(*rows, strict=True))
        hit = off <= FOUND_PX
        counts[name] += len(hit), hit.sum(), (sure & (off > WRONG_PX)).sum()
        errors = cell(off, ".3f"), cell(off[sure], ".2f", np.max), (sure & (off > WRONG_PX)).sum(), cell(seconds, ".1f")
        moved_by = f"{start[0]:.0%}", f"{start[1]:g}°", f"{start[2]:g}"
        print_row(name, *moved_by, f"{hit.sum()} of {len(hit)}", *errors)
    if figures:
        heads = f"median error up to {FOUND_PX:g} px", f"wrong by more than {WRONG_PX:g} px"
        rows = [
            TableRow("starts", name, f"{n} starts", dict(zip(heads, found_and_wrong, strict=True)))
            for name, (n, *found_and_wrong) in counts.items()
        ]
        write_figures(rows, "DATA/", data)


if __name__ == "__main__":
    run(main)
