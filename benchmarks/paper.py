"""The paper's experiments on a folder of aerial RGB/NIR pairs (VIS_1.png, NIR_TF_1.png, GT_1.txt ...): files for
`agalign evaluate` and `agalign learn`, long evaluations in pieces, and a plot of their results.

    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial
    python benchmarks/paper.py pairs.csv --pieces FOLDER --jobs 2 -m paper:pseudo-siamese --shift 5
    python benchmarks/paper.py RESULTS.csv... --plot robustness.png

The first writes to the current folder: pairs.csv with the pairs, learn.csv with 20 of them and homographies 5 %
off, and test.csv with the others. The second runs `agalign evaluate` with the options given for each pair alone, in
--jobs processes, and prints its table for all pairs; results are files in FOLDER, and those which are there are not
computed again. The third draws results: a line for each method of each file or folder.

The tables of docs/explanation/paper.md:

    git clone https://github.com/JasonLi-UCAS/NIR-VIS-RS
    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial                  # pairs.csv; its parts learn.csv, test.csv
    agalign evaluate pairs.csv -m fast:siamese:grey -m sift -m daisy      # RGB and near infra-red: each row
    agalign evaluate pairs.csv -m scratch:pseudo-siamese --shift 2.5,5,10
    S="--shift 0,2.5,5,7.5,10,15,20"
    agalign evaluate pairs.csv -m fast:pseudo-siamese $S -o alone.csv     # convergence; also with --seeding
    agalign evaluate pairs.csv -m elastix $S -o elastix.csv
    python benchmarks/paper.py pairs.csv --pieces paper-5 --jobs 2 -m paper:pseudo-siamese --shift 5   # 42 minutes
    python benchmarks/paper.py alone.csv elastix.csv paper-5 --plot robustness.png
    agalign learn learn.csv -o net.safetensors                            # without labels; also --sharing siamese
    agalign evaluate test.csv -m net.safetensors -m sift
"""

import csv
import random
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path

import numpy as np
from bands.score import table
from common import pyplot, run

from agalign.evaluation.evaluate import Result, Starts, error_table
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
        ((_, _, start),) = Starts((0.05,)).of(np.loadtxt(truth), longer_side_px, rng)
        rough.append((number, fixed, moving, " ".join(map(str, start.ravel()))))
    for name, rows in (("pairs", pairs), ("learn", rough), ("test", mixed[LEARNED:])):
        with Path(f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("name", "fixed", "moving", "homography"), *rows])


def evaluate(pairs: Path, pieces: Path, jobs: int, options: list[str]) -> None:
    """Run `agalign evaluate` for each pair alone, at most `jobs` at a time, and print the table of all."""
    pieces.mkdir(exist_ok=True)

    def one(row: dict[str, str]) -> None:
        out = pieces / f"{row['name']}.csv"
        if out.exists():
            return
        alone, new = pieces / f"{row['name']}.pair", pieces / f"{row['name']}.new"
        with alone.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([row.keys(), row.values()])
        subprocess.run([sys.executable, "-m", "agalign", "evaluate", alone, "-q", "-o", new, *options], check=True)
        new.rename(out)
        alone.unlink()

    with ThreadPoolExecutor(jobs) as executor:
        list(executor.map(one, csv.DictReader(pairs.read_text(encoding="utf-8").splitlines())))
    results = [Result(**{f.name: f.type(row[f.name]) for f in fields(Result)}) for row in rows_of(pieces)]
    print(table(error_table(results)))


def rows_of(results: Path) -> list[dict[str, str]]:
    """Read the results of a file or folder."""
    files = sorted(results.glob("*.csv")) if results.is_dir() else [results]
    return [row for file in files for row in csv.DictReader(file.read_text(encoding="utf-8").splitlines())]


def draw(results: list[Path], path: Path) -> None:
    """Draw mean homography error and mAP over the start's error."""
    figure, axes = pyplot().subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    lines = defaultdict[str, list[dict[str, str]]](list)
    for result in results:
        for row in rows_of(result):
            lines[f"{row['method']}, {result.stem}"].append(row)
    for name, rows in lines.items():
        names = "shift", "error_share", "average_precision"
        shift, error, precision = np.array([[float(row[field]) for field in names] for row in rows]).T
        shifts = np.unique(shift)
        for axis, values in zip(axes, (100 * error, precision), strict=True):
            axis.plot(100 * shifts, [values[shift == s].mean() for s in shifts], marker="o", label=name)
    axes[0].set(xlabel="start off by, % of the side", ylabel="mean homography error, % of the side")
    axes[1].set(xlabel="start off by, % of the side", ylabel="mAP", ylim=(0, 1))
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def main(paths: list[str], plot: Path | None = None, pieces: Path | None = None, jobs: int = 1) -> None:
    if plot:
        draw([Path(path) for path in paths], plot)
    elif pieces:
        evaluate(Path(paths[0]), pieces, jobs, paths[1:])
    else:
        write_pairs(Path(paths[0]))


if __name__ == "__main__":
    run(main)
