"""Alignment of real images from the starter network and from random weights.

    python benchmarks/starter.py FOLDER...

A FOLDER holds captures with `ties.json` (benchmarks/accuracy.py says how), or pairs NAME_1.png / OTHER_1.png with
their homography in a text file, which start 5 % of the image away from the truth.
"""

import sys
import time
from collections.abc import Iterator
from functools import partialmethod
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from cases import cases

from agalign.batch.capture import quiet
from agalign.capture.align import align_pairs
from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.config import Settings
from agalign.method.state import JointState
from agalign.values import geometry
from agalign.values.image import Raster

Matrix = np.ndarray
Group = tuple[str, list[tuple[str, Raster, Raster, dict[str, Matrix]]], dict[str, Matrix]]
"""(set, images as align_images takes them, ties (n, 4) by name)."""

PAIRS = (("VIS_{}.png", "NIR_TF_{}.png", "GT_{}.txt"), ("VI_{}_a.png", "VI_{}_b.png", "VI_{}_fixed_to_moving.txt"))


def groups(folder: Path) -> Iterator[Group]:
    captures: dict[str, list] = {}
    for case in cases([folder]):
        captures.setdefault(case.reference.path.name, []).append(case)
    for some in captures.values():
        images = [(c.band.name, c.fixed, c.moving, {"rig": c.rig, "identity": np.eye(3)}) for c in some]
        yield folder.name, images, {c.band.name: c.ties for c in some}
    for number in range(1, 100):
        for fixed, moving, truth in ([folder / name.format(number) for name in names] for names in PAIRS):
            if fixed.is_file():
                yield _pair(folder.name, number, _read(fixed), _read(moving), np.loadtxt(truth))


def _pair(set_name: str, number: int, fixed: Raster, moving: Raster, truth: Matrix) -> Group:
    points = geometry.lattice(*fixed.size_px, 20, 20)
    there = geometry.apply(truth, points)
    common = ((there >= 0) & (there <= np.subtract(moving.size_px, 1))).all(axis=1)
    angle = 2.4 * number  # a direction of its own for each pair
    shift = 0.05 * max(fixed.size_px) * np.array([np.cos(angle), np.sin(angle)])
    start = geometry.compose(truth, geometry.translation(*shift))
    return set_name, [("moving", fixed, moving, {"user": start})], {"moving": np.hstack([points, there])[common]}


def _read(path: Path) -> Raster:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32)
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))
    return Raster(image, np.ones(image.shape[-2:], bool))


def main() -> None:
    print("| set | theta starts from | pairs | aligned | median error, px | worst | wrong by 1 px | s a pair |")
    print("|---|---|---|---|---|---|---|---|")
    for folder in map(Path, sys.argv[1:]):
        for start in ("random", "starter"):
            settings = Settings()
            errors, seconds, pairs = [], [], 0
            for _, images, ties in groups(folder):
                began = time.perf_counter()
                reference = Reference(images[0][1])
                pairs_here = [BandPair(name, reference, moving, starts) for name, _, moving, starts in images]
                descriptor = partialmethod(JointState.fast_descriptor, start=start)
                with patch.object(JointState, "fast_descriptor", descriptor):
                    result = align_pairs(pairs_here, settings, quiet)
                seconds += [(time.perf_counter() - began) / len(images)] * len(images)
                pairs += len(images)
                for name, alignment in result.items():
                    if alignment.status == "aligned":
                        moved = geometry.apply(alignment.fixed_to_moving, ties[name][:, :2])
                        errors.append(np.median(np.linalg.norm(moved - ties[name][:, 2:], axis=1)))
            e = np.array(errors or [np.nan])
            print(
                f"| {folder.name} | {start} | {pairs} | {len(errors)} | {np.median(e):.3f} | {e.max():.3f} "
                f"| {(e > 1).sum()} | {np.median(seconds):.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
