"""The results of the benchmark by pair, in results.csv, and the tables of the comparison that are counted from it."""

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import cell
from figures_csv import TITLES, Provenance, TableRow

from agalign.config import CheckSettings
from bands import score
from bands.images import LENS_CORRECTED
from bands.score import AS_IT_IS, Scored

WHOLE = {"agalign, capture": (), "agalign, capture, no tags": ("--ignore-metadata",)}
"""Runs of the command line on a whole flight, with its files and tags: options by name."""
VOTED = "OpenDroneMap, flight"
"""One matrix per band for all captures of a flight, as OpenDroneMap uses it."""
REPEATED = "OpenDroneMap, capture", VOTED
"""Methods whose results differ between runs."""
RUNS = 3
"""Of each method that is repeated: a median, and a range that hardly grows with more."""
OF_RAW_FILES = (*WHOLE, *REPEATED)
"""Methods that are not given corrected images."""
USABLE_PX = CheckSettings().accept_predicted_px
"""Largest standard error of a predicted band that agalign uses by default."""


@dataclass(frozen=True)
class Result(Scored):
    """The result of a pair, with the version of the estimator."""

    commit: str
    digest: str


def read_results(path: Path) -> list[Result]:
    """Return the results of earlier runs, an empty list without a file."""
    if not path.is_file():
        return []
    kinds = {f.name: {"1": True, "0": False}.__getitem__ if f.type is bool else f.type for f in fields(Result)}
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [Result(**{k: kinds[k](v or ("nan" if kinds[k] is float else "")) for k, v in row.items()}) for row in rows]


def add_results(path: Path, scored: Sequence[Scored], order: Sequence[tuple[str, str]]) -> list[Result]:
    """Replace the results of methods, sets and variants in a file, and return all of it, in this order of methods and
    variants.

    What another version of the estimator made of one of these methods is removed.
    """
    now = Provenance.of("comparison")
    new = [Result(**vars(s), **now._asdict()) for s in scored]
    done = {(r.method, r.set, r.variant) for r in new}
    stale = {r.method for r in new}
    kept = [
        r
        for r in read_results(path)
        if (r.method, r.set, r.variant) not in done and (r.method not in stale or r.digest == now.digest)
    ]
    places = {place: index for index, place in enumerate(order)}
    result = sorted([*kept, *new], key=lambda r: (places.get((without_run(r.method), r.variant), len(places)), r.set))
    score.write_csv(result, path)
    return result


def without_run(method: str) -> str:
    """Return the name of a method without the number of its run."""
    return re.sub(r", run \d+$", "", method)


ORIGINALS, WITH_LENSES, COPIES = "originals", "originals with tags", "degraded copies"


def table_of(result: Result) -> str:
    """Return the table of the comparison that a result belongs to."""
    return {AS_IT_IS: ORIGINALS, LENS_CORRECTED: WITH_LENSES}.get(result.variant, COPIES)


def comparison(results: Sequence[Result], sets: Mapping[str, Any]) -> Iterable[TableRow]:
    """Yield the rows of methods in each table: of all sets, of drone cameras, with a limit for the ratings of methods,
    and by set for OpenDroneMap.

    The program corrects the lenses of a capture by itself, and OpenDroneMap aligns raw files: what they make of the
    original files is compared with what other methods make of corrected images.
    """
    corrected = {r.key for r in results if r.variant == LENS_CORRECTED}
    pairwise = [r for r in results if r.method not in WHOLE or r.variant != AS_IT_IS]
    raw = [r for r in results if without_run(r.method) in OF_RAW_FILES and r.variant == AS_IT_IS]
    used = [*pairwise, *(replace(r, variant=LENS_CORRECTED) for r in raw if r.key in corrected)]
    limited = [r for r in score.limited(used, sets) if table_of(r) != WITH_LENSES]
    drone_cameras = {name for name, description in sets.items() if "ties" in _first_pair(description)}
    of_drones = [r for r in results if r.variant == AS_IT_IS and r.set in drone_cameras]
    pairs_of_drones = [r for r in of_drones if r.method not in WHOLE]
    rated = [*used, *with_predicted(used), *limited]
    copies_of_drones = [r for r in rated if table_of(r) == COPIES and r.set in drone_cameras]
    prefixes = {
        "comparison": [*used, *with_predicted(used)],
        "drone cameras": [*pairs_of_drones, *copies_of_drones],
        "limits": limited,
    }
    for prefix, some in prefixes.items():
        groups: dict[tuple[str, str], list[Result]] = {}
        for r in some:
            groups.setdefault((table_of(r), without_run(r.method)), []).append(r)
        for kind in (ORIGINALS, WITH_LENSES, COPIES):
            own = {method: group for (name, method), group in groups.items() if name == kind}
            yield from (table_row(f"{prefix}, {kind}", *group, counts) for group in own.items())
    for name in sorted({r.set for r in of_drones if without_run(r.method) == VOTED}):
        yield errors_of_set(name, [r for r in of_drones if r.set == name])


def errors_of_set(name: str, results: Sequence[Result]) -> TableRow:
    """Return the errors of agalign and OpenDroneMap in a set; fewer of what OpenDroneMap does not use."""
    shown = {"agalign, capture": ("agalign", 3), VOTED: ("flight", 4), REPEATED[0]: ("capture", 2)}
    rows = {
        label: (table_row("OpenDroneMap", TITLES.get(name, name), own, errors), count)
        for method, (label, count) in shown.items()
        if (own := [r for r in results if without_run(r.method) == method])
    }
    cells = {
        f"{label}: {head}": cell for label, (row, count) in rows.items() for head, cell in [*row.cells.items()][:count]
    }
    return replace(rows["flight"][0], cells=cells)


def _first_pair(description: Mapping[str, Any]) -> Mapping[str, Any]:
    first: Mapping[str, Any] = next(iter(next(iter(description["captures"].values()))["pairs"].values()))
    return first


def with_predicted(results: Iterable[Result]) -> list[Result]:
    """Return the results of degraded copies by methods that predict, which claim predictions with a small standard
    error as well.
    """
    copies = [r for r in results if table_of(r) == COPIES]
    predict = {r.method for r in copies if not np.isnan(r.std_px)}
    return [
        replace(r, method=f"{r.method}, with predicted", claimed=r.claimed or r.std_px <= USABLE_PX)
        for r in copies
        if r.method in predict
    ]


def table_row(
    name: str, method: str, results: Sequence[Result], cells_of: Callable[[Sequence[Result]], dict[str, object]]
) -> TableRow:
    """Return the cells of a method; for one that was repeated, the medians of its runs with their range."""
    runs: dict[str, list[Result]] = {}
    for r in results:
        runs.setdefault(r.method, []).append(r)
    of_runs = [cells_of(run) for run in runs.values()]
    cells = {head: with_range([str(of_run[head]) for of_run in of_runs]) for head in of_runs[0]}
    measured = Provenance(results[0].commit, results[0].digest)
    return TableRow(name, method, f"{len(next(iter(runs.values())))} pairs", cells, measured)


def with_range(values: Sequence[str]) -> str:
    """Return the median of numbers, with their range if they differ."""
    ordered = sorted((v for v in values if v != "-"), key=float)
    if not ordered:
        return "-"
    median, low, high = ordered[len(ordered) // 2], ordered[0], ordered[-1]
    return median if low == high else f"{median} ({low}-{high})"


def counts(results: Sequence[Result]) -> dict[str, object]:
    """Return the counts and medians of a method."""
    accepted_px = np.array([r.median_px for r in results if r.claimed])
    return {
        "accepted": len(accepted_px),
        "wrong": sum(r.is_wrong for r in results),
        "accepted within 0.5 px": int((accepted_px <= score.GOOD_PX).sum()),
        "median error, px": cell(accepted_px, ".3f"),
        "CPU time, s": cell(np.array([r.seconds for r in results]), ".1f"),
    }


def errors(results: Sequence[Result]) -> dict[str, object]:
    """Return the errors of a method."""
    median_px, p95_px = (np.array([getattr(r, name) for r in results if r.claimed]) for name in ("median_px", "p95_px"))
    return {
        "median, px": cell(median_px, ".3f"),
        "worst pair, px": cell(median_px, ".2f", np.max),
        "worst 95 %, px": cell(p95_px, ".2f", np.max),
        "beyond 1 px": int((median_px > score.WRONG_PX).sum()),
    }
