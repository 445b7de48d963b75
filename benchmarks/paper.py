"""Files for the paper's experiments on a folder of aerial RGB/NIR pairs (VIS_1.png, NIR_TF_1.png, GT_1.txt ...), which
`agalign evaluate` and `agalign learn` run, and a plot of their results.

    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial
    python benchmarks/paper.py RESULTS.csv... --plot robustness.png

The first writes to the current folder: pairs.csv with the pairs, learn.csv with 20 of them and homographies 5 %
off, and test.csv with the others. The second draws files of `agalign evaluate --out`: a line for each method of each.
"""

import csv
import random
from pathlib import Path

import numpy as np
from common import pyplot, run

from agalign.evaluation.evaluate import Starts
from agalign.evaluation.image_pairs import read_image

SPLIT_SEED, LEARNED = 2018, 20
SETS = (
    (range(1, 50, 2), ("VIS_{}.png", "NIR_TF_{}.png", "GT_{}.txt")),
    (range(1, 6), ("VI_{}_a.png", "VI_{}_b.png", "VI_{}_fixed_to_moving.txt")),
)
"""Numbers and names of the aerial pairs, and of visible-thermal ones."""


def write_pairs(folder: Path) -> None:
    files = [(n, *(folder.resolve() / name.format(n) for name in names)) for numbers, names in SETS for n in numbers]
    pairs = [row for row in files if row[-1].is_file()]
    mixed = random.Random(SPLIT_SEED).sample(pairs, len(pairs))
    rng, rough = np.random.default_rng(SPLIT_SEED), []
    for number, fixed, moving, truth in mixed[:LEARNED]:
        longer_side_px = max(read_image(fixed).size_px)
        ((_, start),) = Starts((0.05,)).of(np.loadtxt(truth), longer_side_px, rng)
        rough.append((number, fixed, moving, " ".join(map(str, start.ravel()))))
    for name, rows in (("pairs", pairs), ("learn", rough), ("test", mixed[LEARNED:])):
        with Path(f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("name", "fixed", "moving", "homography"), *rows])


def draw(results: list[Path], path: Path) -> None:
    """Draw mean homography error and mAP over the start's error."""
    figure, axes = pyplot().subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    lines: dict[str, list[dict[str, str]]] = {}
    for result in results:
        for row in csv.DictReader(result.read_text(encoding="utf-8").splitlines()):
            lines.setdefault(f"{row['method']}, {result.stem}", []).append(row)
    for name, rows in lines.items():
        shifts = sorted({float(row["shift"]) for row in rows})
        for axis, field, scale in zip(axes, ("error_share", "average_precision"), (100, 1), strict=True):
            values = [[float(row[field]) for row in rows if float(row["shift"]) == s] for s in shifts]
            means = [scale * np.mean(some) for some in values]
            axis.plot(100 * np.array(shifts), means, marker="o", label=name)
    axes[0].set(xlabel="start off by, % of the side", ylabel="mean homography error, % of the side")
    axes[1].set(xlabel="start off by, % of the side", ylabel="mAP", ylim=(0, 1))
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def main(paths: list[Path], plot: Path | None = None) -> None:
    if plot:
        draw(paths, plot)
    else:
        write_pairs(paths[0])


if __name__ == "__main__":
    run(main)
