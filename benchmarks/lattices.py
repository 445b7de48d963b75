"""Planted grids, which also match at multiples of their period: wrong acceptances, and alignments from a good seed.

    python benchmarks/lattices.py [pairs, by default 60] [first seed]

Pairs of 480 x 360 px: plants on a lattice of 8 to 80 px, not jittered at all or by up to a tenth of its period, in
contrast that reverses between the two images, each with noise of its own. Seeds: none; good, off by up to a quarter of
a period and known to that; and bad, off by one to three periods and not known to anything.
"""

import cv2
import numpy as np
from common import Number, Pair, print_decisions, run

from agalign.values import geometry

SIZE = 480, 360
MARGIN = 120


def pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return (fixed, moving, truth, period in px)."""
    period = float(np.exp(rng.uniform(np.log(8), np.log(80))))
    jitter = float(rng.choice([0.0, rng.uniform(0, 0.1)]))
    angle = rng.uniform(0, np.pi)
    size = SIZE[0] + 2 * MARGIN, SIZE[1] + 2 * MARGIN
    reach = int(np.hypot(*size) / period) + 2
    grid = np.stack(np.meshgrid(np.arange(-reach, reach), np.arange(-reach, reach)), -1).reshape(-1, 2) * period
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = grid @ turn.T + np.array(size) / 2 + jitter * period * rng.normal(size=grid.shape)
    shift = rng.uniform(-40, 40, 2)
    images = []
    for offset, sign in (((0.0, 0.0), 1.0), (shift, -0.7)):
        at = places + offset
        canvas = np.zeros((size[1], size[0]), np.float32)
        inside = ((at > 1) & (at < np.array(size) - 2)).all(axis=1)
        whole = np.floor(at[inside]).astype(int)
        part = at[inside] - whole
        for dx in (0, 1):
            for dy in (0, 1):
                weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
                np.add.at(canvas, (whole[:, 1] + dy, whole[:, 0] + dx), weight)
        canvas = cv2.GaussianBlur(canvas, (0, 0), max(1.2, 0.18 * period))
        canvas = sign * canvas / canvas.std() + 0.1 * rng.normal(size=canvas.shape)
        images.append(canvas[MARGIN:-MARGIN, MARGIN:-MARGIN].astype(np.float32))
    return images[0], images[1], geometry.translation(*shift), period


def seeded_pair(kind: str, rng: np.random.Generator) -> Pair:
    fixed, moving, truth, period = pair(rng)
    angle = rng.uniform(0, 2 * np.pi)
    off = {"none": 0.0, "good": 0.25 * rng.uniform() * period, "bad": period * rng.integers(1, 4)}[kind]
    start = geometry.compose(truth, geometry.translation(off * np.cos(angle), off * np.sin(angle)))
    options = {"seed": None if kind == "none" else start, "seed_std_px": period / 6 if kind == "good" else None}
    return fixed, moving, options, lambda matrix: geometry.corner_error_px(matrix, truth, *SIZE)


def main(count: Number = 60, first: Number = 0) -> None:
    print_decisions(("none", "good", "bad"), seeded_pair, range(first, first + count))


if __name__ == "__main__":
    run(main)
