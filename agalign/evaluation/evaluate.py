"""Evaluation of methods on pairs from several initial homographies, and tables of the results."""

import math
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import product
from pathlib import Path

import numpy as np

from agalign.errors import InputError
from agalign.evaluation.image_pairs import PairFiles, read_image
from agalign.evaluation.methods import Method, PairTask, average_precision, homography_error_px
from agalign.method.device import one_memory_error, one_thread
from agalign.method.match import sift_keypoints, visible_in_both
from agalign.products.text_files import write_csv
from agalign.values import geometry
from agalign.values.geometry import Matrix


@dataclass(frozen=True)
class Starts:
    """Initial homographies: the ground truth, shifted by a share of the image's longer side."""

    shifts: tuple[float, ...] = (0.05,)
    directions: int = 1
    """Number of directions for each shift, evenly spaced from a random one for each pair."""
    seeding: bool = False
    """Correct the initial homography by the initial alignment first, as a run does."""

    def of(self, truth: Matrix, longer_side_px: int, rng: np.random.Generator) -> Iterator[tuple[float, Matrix]]:
        """Yield (shift, fixed_to_moving) of every initial homography."""
        first = rng.uniform(0, 2 * math.pi)
        for shift in self.shifts:
            for k in range(1 if shift == 0 else self.directions):
                angle = first + 2 * math.pi * k / self.directions
                dx, dy = shift * longer_side_px * np.array([math.cos(angle), math.sin(angle)])
                yield shift, geometry.compose(truth, geometry.translation(dx, dy))


@dataclass(frozen=True)
class Result:
    """One method on one pair from one start."""

    pair: str
    group: str
    method: str
    shift: float
    """Shift of the initial homography as a share of the longer side."""
    keypoints: int
    average_precision: float
    """nan for a method without descriptors."""
    error_px: float
    """Mean over the keypoints; nan for a method without a homography."""
    error_share: float
    """`error_px` divided by the longer side of the second image."""
    seconds: float


def evaluate(
    pairs: Sequence[PairFiles], methods: Mapping[str, Method], starts: Starts, device: str = "auto", rng_seed: int = 0
) -> Iterator[Result]:
    """Yield the results pair by pair; methods without a homography do not depend on the start and are run once.

    Raises InputError for a pair without a homography or an image that cannot be read.
    """
    for pair in pairs:
        truth = pair.fixed_to_moving
        if truth is None:
            raise InputError(f"{pair.fixed}: has no homography to compare with")
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        keypoints = visible_in_both(sift_keypoints(fixed), truth, fixed, moving)
        for name, method in methods.items():
            rng = np.random.default_rng((rng_seed, zlib.crc32(pair.name.encode())))
            for shift, start in starts.of(truth, max(fixed.size_px), rng):
                began = time.perf_counter()
                with one_thread(), one_memory_error():
                    outcome = method(PairTask(fixed, moving, start, device, rng_seed, starts.seeding))
                seconds = time.perf_counter() - began
                precision = error_px = math.nan
                if outcome.describe is not None and len(keypoints):
                    precision = average_precision(*outcome.describe(keypoints, truth))
                if outcome.fixed_to_moving is not None and len(keypoints):
                    points_px = keypoints.xy.numpy().astype(np.float64)
                    error_px = homography_error_px(outcome.fixed_to_moving, truth, points_px)
                share = error_px / max(moving.size_px)
                yield Result(pair.name, pair.group, name, shift, len(keypoints), precision, error_px, share, seconds)
                if outcome.fixed_to_moving is None:
                    break


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write the results as CSV, one row per result. Raises OutputError."""
    rows = ([f"{v:.5g}" if isinstance(v, float) else v for v in astuple(r)] for r in results)
    write_csv(path, [f.name for f in fields(Result)], rows)


def precision_table(results: Sequence[Result]) -> list[list[str]]:
    """Mean average precision: a row of titles, then a row for each method with a column for each group."""
    described = [r for r in results if not math.isnan(r.average_precision)]
    groups = list(dict.fromkeys(r.group for r in results))
    totals = ["all"] if len(groups) > 1 else []
    rows = [["method", *groups, *totals, "pairs"]]
    for method in dict.fromkeys(r.method for r in described):
        own = [r for r in described if r.method == method]
        means = [_mean_precision([r for r in own if r.group == group]) for group in groups]
        means += [_mean_precision(own) for _ in totals]
        rows.append([method, *(f"{m:.3f}" for m in means), str(len({r.pair for r in own}))])
    return rows


def error_table(results: Sequence[Result]) -> list[list[str]]:
    """Errors of the homographies: a row of titles, then a row for each method and shift."""
    rows = [
        ["method", "start off by", "median error, px", "worst, px", "mean, % of the side", "under 1 px", "mAP", "s"]
    ]
    measured = [r for r in results if not math.isnan(r.error_px)]
    for method, shift in product(*(dict.fromkeys(getattr(r, name) for r in results) for name in ("method", "shift"))):
        own = [r for r in measured if (r.method, r.shift) == (method, shift)]
        if own:
            e, shares, seconds = np.array([(r.error_px, r.error_share, r.seconds) for r in own]).T
            errors = f"{np.median(e):.3f}", f"{e.max():.2f}", f"{shares.mean():.3%}", f"{(e < 1).sum()} of {len(e)}"
            rows.append([method, f"{shift:.1%}", *errors, f"{_mean_precision(own):.3f}", f"{np.median(seconds):.1f}"])
    return rows


def _mean_precision(results: Sequence[Result]) -> float:
    """Return the mean of the average precisions; nan without results."""
    return float(np.mean([r.average_precision for r in results])) if results else math.nan
