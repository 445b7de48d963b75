"""Every method on every pair from every start, and the tables that come of it."""

import csv
import io
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from agalign.errors import InputError
from agalign.evaluation.image_pairs import PairFiles, read_image
from agalign.evaluation.methods import Method, PairTask
from agalign.evaluation.protocol import average_precision, homography_error_px
from agalign.method.detect import sift_keypoints, visible_in_both
from agalign.method.device import one_memory_error, one_thread
from agalign.values import geometry
from agalign.values.geometry import Matrix


@dataclass(frozen=True)
class Starts:
    """Where alignment starts: the truth moved by a share of the image's longer side."""

    shifts: tuple[float, ...] = (0.05,)
    directions: int = 1
    """Of each shift, evenly around the circle; a single one is drawn for each pair."""
    seeding: bool = False
    """Let the structures correct the start first, as a run does."""

    def of(self, truth: Matrix, longer_side_px: int, rng: np.random.Generator) -> Iterator[tuple[float, Matrix]]:
        """(shift, fixed_to_moving) of every start."""
        first = rng.uniform(0, 2 * math.pi)
        for shift in self.shifts:
            for k in range(1 if shift == 0 else self.directions):
                angle = first + 2 * math.pi * k / self.directions
                length = shift * longer_side_px
                yield (
                    shift,
                    geometry.compose(truth, geometry.translation(length * math.cos(angle), length * math.sin(angle))),
                )


@dataclass(frozen=True)
class Result:
    """One method on one pair from one start."""

    pair: str
    group: str
    method: str
    shift: float
    """Share of the longer side by which the start was off."""
    keypoints: int
    average_precision: float
    """nan for a method that gives no descriptors."""
    error_px: float
    """Mean over the true matches; nan for a method that gives no homography."""
    error_share: float
    """The same over the longer side of the second image."""
    seconds: float


def evaluate(
    pairs: Sequence[PairFiles], methods: Mapping[str, Method], starts: Starts, device: str = "auto", rng_seed: int = 0
) -> Iterator[Result]:
    """Results pair by pair. A descriptor that is not learnt on the pair depends on no start and is measured once.

    Raises InputError for a pair without a true homography or an image that cannot be read.
    """
    for number, pair in enumerate(pairs):
        truth = pair.fixed_to_moving
        if truth is None:
            raise InputError(f"{pair.fixed}: has no homography to compare with")
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        keypoints = visible_in_both(sift_keypoints(fixed), truth, fixed, moving)
        points = keypoints.xy.numpy().astype(np.float64)
        for name, method in methods.items():
            rng = np.random.default_rng((rng_seed, number))
            for shift, start in starts.of(truth, max(fixed.size_px), rng):
                began = time.perf_counter()
                with one_thread(), one_memory_error():
                    outcome = method(PairTask(fixed, moving, start, device, rng_seed, starts.seeding))
                seconds = time.perf_counter() - began
                precision = error = math.nan
                if outcome.describe is not None and len(keypoints):
                    precision = average_precision(*outcome.describe(keypoints, truth))
                if outcome.fixed_to_moving is not None and len(points):
                    error = homography_error_px(outcome.fixed_to_moving, truth, points)
                share = error / max(moving.size_px)
                yield Result(pair.name, pair.group, name, shift, len(points), precision, error, share, seconds)
                if outcome.fixed_to_moving is None:
                    break


def as_csv(results: Sequence[Result]) -> str:
    """A row per result."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(Result)], lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in asdict(r).items()} for r in results)
    return text.getvalue()


def precision_table(results: Sequence[Result]) -> list[list[str]]:
    """Mean average precision, a row a method and a column a group, after a row of titles."""
    groups = list(dict.fromkeys(r.group for r in results))
    rows = [["method", *groups, *(["all"] if len(groups) > 1 else []), "pairs"]]
    for method in dict.fromkeys(r.method for r in results):
        own = [r for r in results if r.method == method and not math.isnan(r.average_precision)]
        if own:
            wanted: list[str | None] = [*groups, *([None] if len(groups) > 1 else [])]
            means = [_mean([r.average_precision for r in own if g in (None, r.group)]) for g in wanted]
            rows.append([method, *(f"{m:.3f}" for m in means), str(len({r.pair for r in own}))])
    return rows


def error_table(results: Sequence[Result]) -> list[list[str]]:
    """How far off the homographies are, a row a method and a shift, after a row of titles."""
    rows = [
        ["method", "start off by", "median error, px", "worst, px", "mean, % of the side", "under 1 px", "mAP", "s"]
    ]
    for method in dict.fromkeys(r.method for r in results):
        for shift in dict.fromkeys(r.shift for r in results):
            own = [r for r in results if (r.method, r.shift) == (method, shift) and not math.isnan(r.error_px)]
            if own:
                e = np.array([r.error_px for r in own])
                share = _mean([r.error_share for r in own])
                rows.append(
                    [method, f"{shift:.1%}", f"{np.median(e):.3f}", f"{e.max():.2f}", f"{share:.3%}",
                     f"{(e < 1).sum()} of {len(e)}", f"{_mean([r.average_precision for r in own]):.3f}",
                     f"{np.median([r.seconds for r in own]):.1f}"]
                )  # fmt: skip
    return rows


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
