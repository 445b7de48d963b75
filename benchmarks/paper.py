"""The paper's experiments on a folder of aerial RGB/NIR pairs (VIS_1.png, NIR_TF_1.png, GT_1.txt ...). Prints tables.

    python benchmarks/paper.py FOLDER precision|robustness|automatic [method...]

precision: descriptors and homographies from starts 5 % off, no seeding. robustness: starts 0 to 20 % off in four
directions (recipe paper, which takes a minute a pair: in one, on 5 pairs), without seeding and for `method+seeds` with
it; a table, robustness.csv and the plot robustness.png. automatic: 20 pairs teach a descriptor without labels, 5 test
it. `agalign evaluate` and `agalign learn` do the same on any pairs.
"""

import random
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from cases import image_pairs
from common import print_head, print_row, pyplot, run

from agalign.capture.band_pair import BandPair
from agalign.config import JointSettings, Settings
from agalign.evaluation.image_pairs import PairFiles, read_image
from agalign.evaluation.learn import learn_descriptor
from agalign.evaluation.methods import method_named
from agalign.evaluation.run import Result, Starts, as_csv, error_table, evaluate, precision_table
from agalign.flight.model import save_model

SHIFTS = (0.0, 0.025, 0.05, 0.075, 0.1, 0.15, 0.2)
SPLIT_SEED = 2018


def split(pairs: list[PairFiles]) -> tuple[list[PairFiles], list[PairFiles]]:
    """20 to learn from, 5 to test."""
    mixed = random.Random(SPLIT_SEED).sample(pairs, len(pairs))
    return mixed[:20], mixed[20:]


def precision(pairs: list[PairFiles], names: list[str]) -> None:
    names = names or ["fast:pseudo-siamese", "fast:siamese", "fast:unshared", "sift", "daisy", "paper:pseudo-siamese"]
    results = list(evaluate(pairs, {name: method_named(name) for name in names}, Starts((0.05,))))
    print_table(precision_table(results))
    print_table(error_table(results))


def robustness(pairs: list[PairFiles], names: list[str]) -> None:
    results: list[Result] = []
    for name in names or ["fast:pseudo-siamese", "fast:pseudo-siamese+seeds", "elastix", "paper:pseudo-siamese"]:
        method, _, seeds = name.partition("+")
        slow = method.startswith("paper")
        starts = Starts(SHIFTS, directions=1 if slow else 4, seeding=bool(seeds))
        results += evaluate(split(pairs)[1] if slow else pairs, {name: method_named(method)}, starts)
        Path("robustness.csv").write_text(as_csv(results))
    print_table(error_table(results))
    plot(results, Path("robustness.png"))


def plot(results: list[Result], path: Path) -> None:
    """Mean homography error and mAP over the start's error, a line a method."""
    figure, axes = pyplot().subplots(1, 2, figsize=(9, 3.6))
    for name in dict.fromkeys(r.method for r in results):
        own = [r for r in results if r.method == name]
        shifts = sorted({r.shift for r in own})
        for axis, field, scale in zip(axes, ("error_share", "average_precision"), (100, 1), strict=True):
            means = [scale * np.mean([getattr(r, field) for r in own if r.shift == s]) for s in shifts]
            if np.isfinite(means).all():
                axis.plot([100 * s for s in shifts], means, marker="o", label=name)
    axes[0].set(xlabel="start off by, % of the side", ylabel="mean homography error, % of the side")
    axes[1].set(xlabel="start off by, % of the side", ylabel="mAP", ylim=(0, 1))
    for axis in axes:
        axis.grid(alpha=0.25)
    axes[0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def automatic(pairs: list[PairFiles], _names: list[str]) -> None:
    train, test = split(pairs)
    rng = np.random.default_rng(SPLIT_SEED)
    coarse = []
    for pair in train:
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        ((_, start),) = Starts((0.05,)).of(pair.fixed_to_moving, max(fixed.size_px), rng)
        coarse.append((pair.name, fixed, moving, {"user": start}))
    methods = {name: method_named(name) for name in ("sift", "daisy")}
    with tempfile.TemporaryDirectory() as temporary:
        for sharing in ("siamese", "pseudo-siamese"):
            path = Path(temporary) / f"automatic, {sharing}.safetensors"
            settings = Settings(joint=JointSettings.model_validate({"sharing": sharing}))
            aligned = []
            pairs = [BandPair.of_images(*c) for c in coarse]
            model = learn_descriptor(pairs, settings, on_pair=lambda lesson, a=aligned: a.append(lesson.status))
            print(f"{sharing}: {aligned.count('aligned')} of {len(aligned)} pairs aligned", flush=True)
            save_model(model, path)
            methods[path.stem] = method_named(str(path))
        results = list(evaluate(test, methods, Starts((0.05,))))
    print_table(precision_table(results))


def main(
    folder: Path,
    experiment: Literal["precision", "robustness", "automatic"],
    methods: Annotated[list[str] | None, typer.Argument()] = None,
) -> None:
    steps = {"precision": precision, "robustness": robustness, "automatic": automatic}
    steps[experiment](image_pairs(folder), methods or [])


def print_table(rows: list[list[str]]) -> None:
    print_head(*rows[0])
    for row in rows[1:]:
        print_row(*row)
    print(flush=True)


if __name__ == "__main__":
    run(main)
