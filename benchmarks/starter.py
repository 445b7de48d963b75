"""Alignment of real images from the starter network and from random weights.

    python benchmarks/starter.py FOLDER...

A FOLDER holds captures with `ties.json` (benchmarks/accuracy.py says how), or pairs NAME_1.png / OTHER_1.png with
their homography in a text file, which start 5 % of the image away from the truth.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
from cases import cases, image_pairs
from common import WRONG_PX, print_head, print_row

from agalign.batch.capture import quiet
from agalign.capture.align import align_pairs
from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.config import Settings
from agalign.evaluation.image_pairs import read_image
from agalign.method.state import JointState
from agalign.values import geometry
from agalign.values.geometry import Matrix

Group = tuple[list[BandPair], dict[str, Matrix]]
"""(pairs of one reference, ties (n, 4) by name)."""


def groups(folder: Path) -> Iterator[Group]:
    captures: dict[str, list] = {}
    for case in cases(folder):
        captures.setdefault(case.reference.path.name, []).append(case)
    for some in captures.values():
        reference = Reference(some[0].fixed)
        starts = [{"rig": c.rig, "identity": np.eye(3)} for c in some]
        pairs = [BandPair(c.band.name, reference, c.moving, s) for c, s in zip(some, starts, strict=True)]
        yield pairs, {c.band.name: c.ties for c in some}
    for pair in image_pairs(folder):
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        points = geometry.lattice(*fixed.size_px, 20, 20)
        there = geometry.apply(pair.fixed_to_moving, points)
        common = ((there >= 0) & (there <= np.subtract(moving.size_px, 1))).all(axis=1)
        angle = 2.4 * int(pair.name)  # a direction of its own for each pair
        shift = 0.05 * max(fixed.size_px) * np.array([np.cos(angle), np.sin(angle)])
        start = geometry.compose(pair.fixed_to_moving, geometry.translation(*shift))
        pairs = [BandPair.of_images("moving", fixed, moving, {"user": start})]
        yield pairs, {"moving": np.hstack([points, there])[common]}


def main() -> None:
    head = "set", "theta starts from", "pairs", "aligned", "median error, px", "worst", "wrong by 1 px", "s a pair"
    print_head(*head)
    descriptor = JointState.fast_descriptor
    for folder in map(Path, sys.argv[1:]):
        for start in ("random", "starter"):
            errors, seconds = [], []
            for pairs, ties in groups(folder):
                began = time.perf_counter()
                with patch.object(JointState, "fast_descriptor", lambda *args, s=start: descriptor(*args[:2], s)):
                    result = align_pairs(pairs, Settings(), quiet)
                seconds += [(time.perf_counter() - began) / len(pairs)] * len(pairs)
                for name, alignment in result.items():
                    if alignment.status == "aligned":
                        moved = geometry.apply(alignment.fixed_to_moving, ties[name][:, :2])
                        errors.append(np.median(np.linalg.norm(moved - ties[name][:, 2:], axis=1)))
            e = np.array(errors or [np.nan])
            figures = f"{np.median(e):.3f}", f"{e.max():.3f}", (e > WRONG_PX).sum(), f"{np.median(seconds):.2f}"
            print_row(folder.name, start, len(seconds), len(errors), *figures)


if __name__ == "__main__":
    main()
