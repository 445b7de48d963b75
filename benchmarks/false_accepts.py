"""Aligns synthetic pairs, about half of them without a correct alignment, and prints the number of wrong decisions.

    python benchmarks/false_accepts.py [pairs, by default 200] [first]

The bad: two different fields, two captures of one field at different places, water (a moving texture of its own in
each image), 8 % of overlap, a band that is almost all saturated, and one with a third of it displaced by 15 px. The
good: a rig's usual offset, blurred, noisy, partly saturated, shifted by 5 % of the image. Between them planted grids
without a seed, as in lattices.py: aligned is wrong where it is a period away. Truth comes from the generator.
"""

import cv2
import numpy as np
from common import Number, Pair, print_decisions, run
from lattices import pair as lattice

from agalign.synthetic.cameras import BANDS, REFERENCE, Pose, true_homography
from agalign.synthetic.flight import recorded
from agalign.synthetic.flight import view as seen
from agalign.synthetic.ground import Ground, paint_ground, reflectance
from agalign.values import geometry

SIZE = (640, 480)


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
    band = int(rng.choice([0, 2, 3, 4]))
    reference, moving = BANDS[REFERENCE], BANDS[band]
    away = {"another place of the field": 60.0, "8 % overlap": 0.92 * SIZE[0] / 640 * 26.0 * 1280 / 1453.33}
    ground, here, there = scene(rng, away.get(kind, 0.0))
    fixed = view(ground, REFERENCE, here, rng)
    if kind == "water":
        return water(rng), water(rng), None, None
    if kind == "another field":
        other, pose, _ = scene(rng)
        return fixed, view(other, band, pose, rng), None, None
    other_view = view(ground, band, there, rng)
    if kind in away:
        return fixed, other_view, None, None
    truth = true_homography(reference, moving, here, SIZE)
    seed = None
    if kind == "all but saturated":
        return fixed, saturated(other_view, 0.01), None, None
    if kind == "a third displaced":
        third = SIZE[0] // 3
        other_view = other_view.copy()
        other_view[:, -third:] = np.roll(other_view, 15, axis=0)[:, -third:]
        return fixed, other_view, None, None
    if kind == "blurred":
        other_view = cv2.GaussianBlur(other_view, (0, 0), 1.5)
    elif kind == "noisy":
        noisy = other_view + rng.normal(0, 1500, other_view.shape)
        other_view = np.clip(noisy, 0, 65535).astype(np.uint16)
    elif kind == "partly saturated":
        other_view = saturated(other_view, 0.7)
    elif kind == "5 % off":
        angle = rng.uniform(0, 2 * np.pi)
        shift = 0.05 * SIZE[0] * np.array([np.cos(angle), np.sin(angle)])
        seed = truth @ geometry.translation(*shift)
    return fixed, other_view, seed, truth


def saturated(image: np.ndarray, share: float) -> np.ndarray:
    """Return an image with saturated pixels above a quantile."""
    return np.where(image > np.quantile(image, share), 65535, image).astype(np.uint16)


BAD = ("another field", "another place of the field", "water", "8 % overlap", "all but saturated", "a third displaced")
GRID = "planted grid"
GOOD = ("as it comes", "blurred", "noisy", "partly saturated", "5 % off")


def pair_with_error(kind: str, rng: np.random.Generator) -> Pair:
    fixed, moving, seed, truth = pair(kind, rng)
    size = fixed.shape[::-1]
    points = geometry.lattice(*size, 20, 20)
    # In the centre lens distortion is small, which a homography only partly models.
    middle = points[(np.abs(points - np.divide(size, 2)) < np.multiply(size, 0.3)).all(axis=1)]

    def error_px(matrix: np.ndarray) -> float:
        if truth is None:
            return np.nan
        return float(np.linalg.norm(geometry.apply(matrix, middle) - geometry.apply(truth, middle), axis=1).mean())

    return fixed, moving, {"seed": seed}, error_px


def main(count: Number = 200, first: Number = 0) -> None:
    print_decisions((*BAD, *GOOD, GRID), pair_with_error, range(first, first + count))


if __name__ == "__main__":
    run(main)
