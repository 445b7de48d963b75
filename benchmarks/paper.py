"""The paper's experiments on a folder of aerial RGB/NIR pairs (VIS_1.png, NIR_TF_1.png, GT_1.txt ...): files for
`agalign evaluate` and `agalign learn`, and long evaluations in pieces.

    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial
    python benchmarks/paper.py pairs.csv --pieces FOLDER --jobs 2 -m paper:pseudo-siamese --shift 5

The first writes to the current folder: pairs.csv with the pairs, learn.csv with 20 of them and homographies 5 %
off, and test.csv with the others. The second runs `agalign evaluate` with the options given for each pair alone, in
--jobs processes, and prints its table for all pairs; results are files in FOLDER, and those which are there are not
computed again.

The tables of docs/explanation/paper.md:

    git clone https://github.com/JasonLi-UCAS/NIR-VIS-RS
    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial                  # pairs.csv; its parts learn.csv, test.csv
    agalign evaluate pairs.csv -m fast:siamese:grey -m sift -m daisy      # RGB and near infra-red: each row
    agalign evaluate pairs.csv -m scratch:pseudo-siamese --shift 2.5,5,10
    S="--shift 0,2.5,5,7.5,10,15,20"
    agalign evaluate pairs.csv -m fast:pseudo-siamese $S -o alone.csv     # convergence; also with --seeding
    agalign evaluate pairs.csv -m elastix $S -o elastix.csv
    python benchmarks/paper.py pairs.csv --pieces paper-5 --jobs 2 -m paper:pseudo-siamese --shift 5   # 42 minutes
    agalign learn learn.csv -o net.safetensors                            # without labels; also --sharing siamese
    agalign evaluate test.csv -m net.safetensors -m sift
"""

import csv
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path

import numpy as np
from bands.score import table
from common import run

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
    rows = [
        row for file in sorted(pieces.glob("*.csv")) for row in csv.DictReader(file.read_text("utf-8").splitlines())
    ]
    results = [Result(**{f.name: f.type(row[f.name]) for f in fields(Result)}) for row in rows]
    print(table(error_table(results)))


def main(paths: list[str], pieces: Path | None = None, jobs: int = 1) -> None:
    if pieces:
        evaluate(Path(paths[0]), pieces, jobs, paths[1:])
    else:
        write_pairs(Path(paths[0]))


if __name__ == "__main__":
    run(main)
