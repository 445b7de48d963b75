"""The results of the benchmark by pair, in results.csv, and the tables of the comparison that are counted from it."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import cell
from figures_csv import Provenance, TableRow

from bands import score
from bands.images import LENS_CORRECTED
from bands.score import AS_IT_IS, Scored

WHOLE = {"agalign, capture": (), "agalign, capture, no tags": ("--ignore-metadata",)}
"""Runs of the command line on a whole flight, with its files and tags: options by name."""


@dataclass(frozen=True)
class Result(Scored):
    """The result of a pair, with the version of the estimator."""

    commit: str
    digest: str


def read_results(path: Path) -> list[Result]:
    """Return the results of earlier runs, an empty list without a file."""
    if not path.is_file():
        return []
    kinds = {f.name: {"True": True, "False": False}.__getitem__ if f.type is bool else f.type for f in fields(Result)}
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
    result = sorted([*kept, *new], key=lambda r: (places.get((r.method, r.variant), len(places)), r.set))
    score.write_csv(result, path)
    return result


ORIGINALS, WITH_LENSES, COPIES = "originals", "originals with tags", "degraded copies"


def table_of(result: Result) -> str:
    """Return the table of the comparison that a result belongs to."""
    return {AS_IT_IS: ORIGINALS, LENS_CORRECTED: WITH_LENSES}.get(result.variant, COPIES)


def comparison(results: Sequence[Result], sets: Mapping[str, Any]) -> Iterable[TableRow]:
    """Yield the rows of methods in each table, with all sets and with the published ones.

    The program corrects the lenses of a capture by itself: what it makes of the original files is compared with what
    other methods make of corrected images.
    """
    corrected = {r.key for r in results if r.variant == LENS_CORRECTED}
    pairwise = [r for r in results if r.method not in WHOLE or r.variant != AS_IT_IS]
    whole = [r for r in results if r.method in WHOLE and r.variant == AS_IT_IS and r.key in corrected]
    used = [*pairwise, *(replace(r, variant=LENS_CORRECTED) for r in whole)]
    rated = [*used, *(r for r in score.limited(used, sets) if table_of(r) != WITH_LENSES)]
    public = [r for r in used if "repository" in sets[r.set]["published"]]
    for prefix, some in (("comparison", rated), ("public sets", public)):
        groups: dict[tuple[str, str], list[Result]] = {}
        for r in some:
            groups.setdefault((table_of(r), r.method), []).append(r)
        for kind in (ORIGINALS, WITH_LENSES, COPIES):
            own = {method: group for (name, method), group in groups.items() if name == kind}
            yield from (table_row(f"{prefix}, {kind}", *group) for group in own.items())


def table_row(name: str, method: str, results: Sequence[Result]) -> TableRow:
    """Return the counts and medians of a method."""
    accepted_px = np.array([r.median_px for r in results if r.claimed])
    seconds = np.array([r.seconds for r in results])
    cells = {
        "accepted": len(accepted_px),
        "wrong": sum(r.is_wrong for r in results),
        "accepted within 0.5 px": int((accepted_px <= score.GOOD_PX).sum()),
        "median error, px": cell(accepted_px, ".3f"),
        "CPU time, s": cell(seconds, ".1f"),
    }
    measured = Provenance(results[0].commit, results[0].digest)
    return TableRow(name, method, f"{len(results)} pairs", cells, measured)
