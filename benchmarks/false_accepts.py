"""Aligns synthetic pairs, about half of them without a correct alignment, and prints the number of wrong decisions.

    python benchmarks/false_accepts.py [pairs, by default 200] [first] [--grids] [--figures]

The bad: two different fields, two captures of one field at different places, water (a moving texture of its own in
each image), 8 % of overlap, a band that is almost all saturated, and one with a third of it displaced by 15 px. The
good: a rig's usual offset, blurred, noisy, partly saturated, shifted by 5 % of the image. Between them planted grids
without a seed: aligned is wrong where it is a period away. Truth comes from the generator.

With --grids all pairs are planted grids, of 480 x 360 px, which also match at multiples of their period: plants on a
lattice of 8 to 80 px, not jittered at all or by up to a tenth of its period, in contrast that reverses between the two
images, each with noise of its own. Seeds: none; good, off by up to a quarter of a period and known to that; and bad,
off by one to three periods and not known to anything.
"""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import cv2
import numpy as np
from common import WRONG_PX, Number, cell, print_head, print_row, run, timed
from figures_csv import FiguresOption, TableRow, write_figures
from numpy.typing import NDArray

import agalign
from agalign.synthetic.cameras import BANDS, REFERENCE, Pose, true_homography
from agalign.synthetic.flight import recorded
from agalign.synthetic.flight import view as seen
from agalign.synthetic.ground import Ground, paint_ground, reflectance
from agalign.values import geometry

Pair = tuple[NDArray[Any], NDArray[Any], dict[str, Any], Callable[[NDArray[np.float64]], float]]
"""Two images, options of `agalign.align`, and the error of a homography in px; nan if they show different scenes."""
SIZE, GRID_SIZE = (640, 480), (480, 360)
MARGIN = 120
"""Of a grid, which is cut off."""


def scene(rng: np.random.Generator, east_m: float = 0.0) -> tuple[Ground, Pose, Pose]:
    """Return a field, a pose above it, and a second pose `east_m` to the east."""
    here = Pose(26.0, float(rng.uniform(-180, 180)), 0.0, 0.0, 0.0, 0.0)
    there = Pose(26.0, here.yaw_deg, 0.0, 0.0, east_m, 0.0)
    return paint_ground(rng, [here, there], SIZE), here, there


def view(ground: Ground, band: int, pose: Pose, rng: np.random.Generator) -> np.ndarray:
    return recorded(seen(reflectance(ground, BANDS[band]), ground, BANDS[band], pose, SIZE), BANDS[band], rng)


def water(rng: np.random.Generator) -> np.ndarray:
    """Return an image of ripples and glint: equal statistics, different realisations."""
    noise = rng.normal(size=SIZE[::-1]).astype(np.float32)
    ripples = cv2.GaussianBlur(noise, (0, 0), sigmaX=6, sigmaY=1.5)
    ripples += 0.3 * cv2.GaussianBlur(rng.normal(size=SIZE[::-1]).astype(np.float32), (0, 0), 1.0)
    return np.clip(20000 + 9000 * ripples / ripples.std(), 0, 65535).astype(np.uint16)


def pair(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Return (fixed, moving, seed, truth); truth is None if the images show different scenes."""
    if kind == GRID:
        fixed, moving, truth, _ = lattice(rng)
        return fixed, moving, None, truth
    band, seed, truth = int(rng.choice([0, 2, 3, 4])), None, None
    ground, here, there = scene(rng, AWAY_M.get(kind, 0.0))
    fixed = view(ground, REFERENCE, here, rng)
    if kind == "water":
        return water(rng), water(rng), None, None
    if kind == "another field":
        ground, there, _ = scene(rng)
    moving = view(ground, band, there, rng)
    if kind in CHANGES:
        moving = CHANGES[kind](moving, rng).clip(0, 65535).astype(np.uint16)
    if kind in GOOD:
        truth = true_homography(BANDS[REFERENCE], BANDS[band], here, SIZE)
    if kind == "5 % off":
        angle = rng.uniform(0, 2 * np.pi)
        seed = truth @ geometry.translation(0.05 * SIZE[0] * np.cos(angle), 0.05 * SIZE[0] * np.sin(angle))
    return fixed, moving, seed, truth


def saturated(image: np.ndarray, _rng: np.random.Generator, share: float) -> np.ndarray:
    """Return an image with saturated pixels above a quantile."""
    return np.where(image > np.quantile(image, share), 65535, image)


def displaced(image: np.ndarray, _rng: np.random.Generator) -> np.ndarray:
    """Return an image with a third of it 15 px lower."""
    is_left = np.arange(SIZE[0]) < SIZE[0] - SIZE[0] // 3
    return np.where(is_left, image, np.roll(image, 15, axis=0))


BAD = ("another field", "another place of the field", "water", "8 % overlap", "all but saturated", "a third displaced")
GRID = "planted grid"
GOOD = ("as it comes", "blurred", "noisy", "partly saturated", "5 % off")
AWAY_M = {"another place of the field": 60.0, "8 % overlap": 0.92 * SIZE[0] / 640 * 26.0 * 1280 / 1453.33}
CHANGES: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "all but saturated": partial(saturated, share=0.01),
    "a third displaced": displaced,
    "blurred": lambda image, _: cv2.GaussianBlur(image, (0, 0), 1.5),
    "noisy": lambda image, rng: image + rng.normal(0, 1500, image.shape),
    "partly saturated": partial(saturated, share=0.7),
}
"""Functions of the moving image and a generator."""


def pair_with_error(kind: str, rng: np.random.Generator) -> Pair:
    fixed, moving, seed, truth = pair(kind, rng)
    size = fixed.shape[::-1]
    points = geometry.lattice(*size, 20, 20)
    # In the centre lens distortion is small, which a homography only partly models.
    middle = points[(np.abs(points - np.divide(size, 2)) < np.multiply(size, 0.3)).all(axis=1)]

    def error_px(matrix: np.ndarray) -> float:
        there = np.full_like(middle, np.nan) if truth is None else geometry.apply(truth, middle)
        return float(np.linalg.norm(geometry.apply(matrix, middle) - there, axis=1).mean())

    return fixed, moving, {"seed": seed}, error_px


# ---- planted grids


def lattice(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return (fixed, moving, truth, period in px)."""
    period = float(np.exp(rng.uniform(np.log(8), np.log(80))))
    jitter = float(rng.choice([0.0, rng.uniform(0, 0.1)]))
    angle = rng.uniform(0, np.pi)
    size = np.array(GRID_SIZE) + 2 * MARGIN
    reach = int(np.hypot(*size) / period) + 2
    grid = np.stack(np.meshgrid(np.arange(-reach, reach), np.arange(-reach, reach)), -1).reshape(-1, 2) * period
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = grid @ turn.T + size / 2 + jitter * period * rng.normal(size=grid.shape)
    shift = rng.uniform(-40, 40, 2)
    images = []
    for offset, sign in (((0.0, 0.0), 1.0), (shift, -0.7)):
        at = places + offset
        canvas = np.zeros(size[::-1], np.float32)
        at = at[((at > 1) & (at < size - 2)).all(axis=1)]
        whole = np.floor(at).astype(int)
        for corner in product((0, 1), repeat=2):
            x, y = (whole + corner).T
            np.add.at(canvas, (y, x), np.abs(1 - np.array(corner) - (at - whole)).prod(axis=1))
        canvas = cv2.GaussianBlur(canvas, (0, 0), max(1.2, 0.18 * period))
        canvas = sign * canvas / canvas.std() + 0.1 * rng.normal(size=canvas.shape)
        images.append(canvas[MARGIN:-MARGIN, MARGIN:-MARGIN].astype(np.float32))
    return images[0], images[1], geometry.translation(*shift), period


def seeded_pair(kind: str, rng: np.random.Generator) -> Pair:
    fixed, moving, truth, period = lattice(rng)
    angle = rng.uniform(0, 2 * np.pi)
    off = {"none": 0.0, "good": 0.25 * rng.uniform() * period, "bad": period * rng.integers(1, 4)}[kind]
    start = geometry.compose(truth, geometry.translation(off * np.cos(angle), off * np.sin(angle)))
    options = {"seed": None if kind == "none" else start, "seed_std_px": period / 6 if kind == "good" else None}
    return fixed, moving, options, lambda matrix: geometry.corner_error_px(matrix, truth, *GRID_SIZE)


# ---- decisions


SYNTHETIC, PLANTED = "synthetic pairs", "planted grids"
GROUPS = {
    "unchanged, or blur 1.5 px, noise 2 %, 30 % saturated, shift of 5 %": GOOD,
    "another field or place, water, 8 % overlap, 99 % saturated, a third displaced": BAD,
}
GROUPS_OF_GRIDS = {
    "no initial alignment": ("none",),
    "initial alignment off by up to a quarter of a period": ("good",),
    "initial alignment wrong by whole periods": ("bad",),
}
"""Kinds of pairs by the rows of docs/figures/figures.csv."""


def table_row(table: str, name: str, pairs: list[tuple[str, float, float]]) -> TableRow:
    """Return a row of decisions, which are (status, error in px, seconds)."""
    errors_px = np.array([error_px for status, error_px, _ in pairs if status == "aligned"])
    cells: dict[str, object] = {"aligned": len(errors_px), "wrong": int((~(errors_px <= WRONG_PX)).sum())}
    if table == SYNTHETIC:
        cells["worst error, px"] = cell(errors_px, ".2f", np.max)
    return TableRow(table, name, f"{len(pairs)} pairs", cells)


def main(count: Number = 200, first: Number = 0, *, grids: bool = False, figures: FiguresOption = False) -> None:
    kinds, pair_of = (("none", "good", "bad"), seeded_pair) if grids else ((*BAD, *GOOD, GRID), pair_with_error)
    rows: dict[str, list[tuple[str, float, float]]] = {kind: [] for kind in kinds}
    for number in range(first, first + count):
        kind = kinds[number % len(kinds)]
        fixed, moving, options, error_px = pair_of(kind, np.random.default_rng(number))
        seconds, result = timed(agalign.align, fixed, moving, **options)
        rows[kind].append((result.status, error_px(result.fixed_to_moving), seconds))
        print("{:4d} {:28s} {:9s} {:7.2f} px {:5.1f} s".format(number, kind, *rows[kind][-1]), result.reason or "")
    statuses = "aligned", "seed_only", "failed"
    print_head("kind", "pairs", *statuses, "wrongly aligned", "worst error, px", "seconds")
    for kind, some in ((kind, some) for kind, some in rows.items() if some):
        errors = [error for status, error, _ in some if status == "aligned"]
        counts = [sum(status == one for status, *_ in some) for one in statuses]
        wrong, worst_px = sum(not error <= WRONG_PX for error in errors), max(errors, default=np.nan)
        print_row(kind, len(some), *counts, wrong, f"{worst_px:.2f}", cell([s for *_, s in some], ".1f"))
    if figures:
        table, groups = (PLANTED, GROUPS_OF_GRIDS) if grids else (SYNTHETIC, GROUPS)
        grouped = {name: [pair for kind in kinds for pair in rows[kind]] for name, kinds in groups.items()}
        write_figures([table_row(table, name, pairs) for name, pairs in grouped.items()])


if __name__ == "__main__":
    run(main)
