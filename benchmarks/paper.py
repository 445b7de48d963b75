"""The paper's experiments on aerial RGB/NIR pairs (VIS_1.png, NIR_TF_1.png, GT_1.txt ...) of NIR-VIS-RS.

    git clone https://github.com/JasonLi-UCAS/NIR-VIS-RS
    python benchmarks/paper.py NIR-VIS-RS/Dataset/Aerial [--recipe fast] [--out paper] [--jobs 2] [--figures]

Each experiment is `agalign evaluate` on each pair alone, in --jobs processes; `agalign learn` learns one descriptor on
20 pairs for the 5 others. Results are files in --out, and those which are there are not measured again. `--recipe fast`
takes half an hour on two cores, `--recipe paper` one to two hours.
"""

import csv
import random
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from common import run, table
from figures_csv import FiguresOption, TableRow, write_figures

from agalign.evaluation.evaluate import Result, Starts
from agalign.evaluation.image_pairs import read_image

SPLIT_SEED, LEARNED = 2018, 20
NUMBERS, NAMES = range(1, 50, 2), ("VIS_{}.png", "NIR_TF_{}.png", "GT_{}.txt")
"""Of the aerial pairs."""
PAPERS_START = 0.05
"""Of the longer side: the paper's distance of the start from the truth."""


class Experiment(NamedTuple):
    """Rows of the table, which are measured together."""

    pairs: Literal["pairs", "test"]
    options: str
    """Of `agalign evaluate`."""
    rows: dict[str, tuple[str, float, float]]
    """(method, smallest and largest distance of the start) by name."""


def at_papers_start(*methods: str) -> dict[str, tuple[str, float, float]]:
    return {title(m): (m, PAPERS_START, PAPERS_START) for m in methods}


def title(method: str) -> str:
    """Return `fast, siamese` for `fast:siamese`, and SIFT."""
    recipe, _, sharing = method.partition(":")
    return f"{recipe}, {sharing}" if sharing else method.upper()


FAST = "fast:siamese", "fast:pseudo-siamese", "fast:unshared"
DISTANCES = "-m fast:pseudo-siamese --shift 0,2.5,5,7.5,10,15,20"
NETWORK = "net.safetensors"
EXPERIMENTS: dict[str, dict[str, Experiment]] = {
    "fast": {
        "sharing": Experiment("pairs", "-m " + " -m ".join((*FAST, "sift")), at_papers_start(*FAST, "sift")),
        "distances": Experiment(
            "pairs",
            DISTANCES,
            {
                f"{title(FAST[1])}, 0 to 10 %": (FAST[1], 0.0, 0.1),
                f"{title(FAST[1])}, 15 and 20 %": (FAST[1], 0.15, 0.2),
            },
        ),
        "initial": Experiment(
            "pairs",
            f"{DISTANCES} --seeding",
            {f"{title(FAST[1])}, with initial alignment, 0 to 20 %": (f"{FAST[1]}, initial alignment", 0.0, 0.2)},
        ),
        "learned": Experiment(
            "test",
            f"-m {NETWORK} -m sift",
            {
                "one descriptor learned on 20 other pairs": ("net", PAPERS_START, PAPERS_START),
                "SIFT on these five pairs": ("sift", PAPERS_START, PAPERS_START),
            },
        ),
    },
    "paper": {"paper": Experiment("pairs", "-m paper:pseudo-siamese", at_papers_start("paper:pseudo-siamese"))},
}
"""Experiments by recipe and name."""


def write_pairs(folder: Path, out: Path) -> None:
    """Write pairs.csv, its part learn.csv with homographies 5 % off, and its part test.csv with the others."""
    rows = [(n, *(folder.resolve() / name.format(n) for name in NAMES)) for n in NUMBERS]
    mixed = random.Random(SPLIT_SEED).sample(rows, len(rows))
    rng, rough = np.random.default_rng(SPLIT_SEED), []
    for number, fixed, moving, truth in mixed[:LEARNED]:
        longer_side_px = max(read_image(fixed).size_px)
        ((_, _, start),) = Starts((PAPERS_START,)).of(np.loadtxt(truth), longer_side_px, rng)
        rough.append((number, fixed, moving, " ".join(map(str, start.ravel()))))
    for name, some in (("pairs", rows), ("learn", rough), ("test", mixed[LEARNED:])):
        with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("name", "fixed", "moving", "homography"), *some])


def agalign(command: str, out: Path, *arguments: Path) -> None:
    subprocess.run([sys.executable, "-m", "agalign", *command.split(), *arguments, "-q"], cwd=out, check=True)


def evaluate(pairs: Path, options: str, folder: Path, jobs: int) -> list[Result]:
    """Run `agalign evaluate` on each pair alone, at most `jobs` at a time, and return the results of all."""
    folder.mkdir(exist_ok=True)

    def one(row: dict[str, str]) -> Path:
        result = folder / f"{row['name']}.csv"
        if not result.exists():
            pair, new = result.with_suffix(".pair"), result.with_suffix(".new")
            with pair.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows([row.keys(), row.values()])
            agalign(f"evaluate {options} -o", folder.parent, new, pair)
            new.rename(result)
            pair.unlink()
        return result

    with ThreadPoolExecutor(jobs) as executor:
        files = list(executor.map(one, csv.DictReader(pairs.read_text(encoding="utf-8").splitlines())))
    rows = [row for file in files for row in csv.DictReader(file.read_text("utf-8").splitlines())]
    return [Result(**{f.name: f.type(row[f.name]) for f in fields(Result)}) for row in rows]


def rows_of(table_name: str, experiment: Experiment, results: Sequence[Result]) -> list[TableRow]:
    rows = []
    for name, (method, nearest, farthest) in experiment.rows.items():
        own = [r for r in results if Path(r.method).stem == method and nearest <= r.shift <= farthest]
        errors_px = np.array([r.error_px for r in own])
        is_mapping = not np.isnan(errors_px).any()  # a network alone has none
        cells = {
            "mAP": f"{np.mean([r.average_precision for r in own]):.3f}",
            "error under 1 px": int((errors_px < 1).sum()) if is_mapping else "-",
        }
        rows.append(TableRow(table_name, name, f"{len(own)} starts", cells))
    return rows


def main(
    data: Path,
    recipe: Literal["fast", "paper"] = "fast",
    out: Path = Path("paper"),
    jobs: int = 1,
    *,
    figures: FiguresOption = False,
) -> None:
    out = out.resolve()
    out.mkdir(exist_ok=True)
    write_pairs(data, out)
    if recipe == "fast" and not (out / NETWORK).exists():
        agalign(f"learn -o {NETWORK}", out, out / "learn.csv")
    rows = []
    for name, experiment in EXPERIMENTS[recipe].items():
        results = evaluate(out / f"{experiment.pairs}.csv", experiment.options, out / name, jobs)
        rows += rows_of(f"experiments, recipe {recipe}", experiment, results)
    print(table([("", "", *rows[0].cells), *((row.name, row.n, *row.cells.values()) for row in rows)]))
    if figures:
        command = f"python benchmarks/paper.py DATA/aerial_rgb_nir --recipe {recipe}"
        write_figures(rows, command=command)


if __name__ == "__main__":
    run(main)
