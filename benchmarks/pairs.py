"""Aligns RGB/NIR pairs of known homography from a start that is off by a share of the image, in four directions.

    python benchmarks/pairs.py FOLDER [share, by default 0.05] [most pairs]

FOLDER holds VIS_i.png, NIR_TF_i.png and GT_i.txt with p_nir = GT p_vis in pixels.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

import agalign
from agalign import geometry


def mean_error_px(found: np.ndarray, truth: np.ndarray, size_px: tuple[int, int]) -> float:
    """Over the area that both images show."""
    points = geometry.lattice(*size_px, 40, 40)
    there = geometry.apply(truth, points)
    common = ((there >= 0) & (there <= np.subtract(size_px, 1))).all(axis=1)
    return float(np.linalg.norm(geometry.apply(found, points) - there, axis=1)[common].mean())


def main() -> None:
    folder = Path(sys.argv[1])
    share = float(sys.argv[2]) if len(sys.argv) > 2 else 0.05
    numbers = sorted(int(p.stem.split("_")[1]) for p in folder.glob("GT_*.txt"))
    numbers = numbers[: int(sys.argv[3])] if len(sys.argv) > 3 else numbers
    errors, seconds, wrong = [], [], 0
    for number in numbers:
        visible = cv2.cvtColor(cv2.imread(str(folder / f"VIS_{number}.png")), cv2.COLOR_BGR2RGB)
        infrared = cv2.imread(str(folder / f"NIR_TF_{number}.png"), cv2.IMREAD_GRAYSCALE)
        truth = np.loadtxt(folder / f"GT_{number}.txt")
        height, width = visible.shape[:2]
        for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            start = truth @ geometry.translation(share * width * dx, share * height * dy)
            began = time.perf_counter()
            found = agalign.align(visible, infrared, seed=start)
            seconds.append(time.perf_counter() - began)
            error = mean_error_px(found.fixed_to_moving, truth, (width, height))
            errors.append(error)
            wrong += found.status == "aligned" and error > 1
            print(f"{number:3d} {found.status:9s} {error:8.3f} px  {seconds[-1]:5.1f} s", flush=True)
    print(
        f"{len(errors)} starts: median {np.median(errors):.3f} px, worst {max(errors):.3f} px, "
        f"{sum(e < 1 for e in errors)} under 1 px, {wrong} wrongly aligned; {np.median(seconds):.1f} s a pair"
    )


if __name__ == "__main__":
    main()
