"""Scores the mappings of band pairs by a method against their truth. Needs numpy and scipy, and not agalign.

    python benchmarks/bands/score.py RESULTS [-o TABLE.csv] [--sets FOLDER]

RESULTS is CSV with a header, or JSON with a list of objects. A row is a band pair: `set`, `capture`, `file` (the moving
one), and `homography` (nine numbers, row by row) or `grid` (JSON {"reference_px": [[x, y], ...], "moving_px": ...}:
where the mapping sends some pixels of the reference). Both map a raw pixel of the reference file to a raw pixel of the
moving file: x right, y down, (0, 0) the centre of the top-left pixel. A row with neither is a refusal. Optional are
`method`, `variant`, `seconds`, `rating` (what the method says about the pair, high is good), `claimed`: "no" for an
estimate that the method itself does not accept, and `std_px`, its standard error of such an estimate.
"""

import argparse
import csv
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

Matrix = NDArray[np.float64]
Points = NDArray[np.float64]

SETS = Path(__file__).parent / "sets"
AS_IT_IS = "as it is"
LOST = "lost"
VARIANT_NAMES = {
    "as it is": "unchanged",
    "lens-corrected": "lens-corrected",
    "blur 3 px": "blur 3 px",
    "motion 25 px": "motion 25 px",
    "noise 30 %": "noise 30 %",
    "half saturated": "half saturated",
    "turn 3": "rotated 3°",
    "turn 10": "rotated 10°",
    "turn 20": "rotated 20°",
    "scale 0.8": "scaled 0.8",
    "lost": "noise only",
}
"""Names of the variants of the benchmark in tables and figures."""
WRONG_PX = 1.0
"""A claimed pair with a larger median error is a wrong claim."""
GOOD_PX = 0.5
_LATTICE = 20
_PAIRS_OF_A_VARIANT = 3
_LARGEST_CELL = 1 << 24
"""Characters: a grid as fine as anyone may want."""


@dataclass(frozen=True)
class Pair:
    """A band pair, and the true positions of pixels of its reference in the moving file."""

    set: str
    capture: str
    reference: str
    file: str
    reference_px: Points
    """(n, 2) raw px."""
    moving_px: Points
    """(n, 2) raw px."""
    size_px: tuple[int, int]
    """(width, height) of the moving file."""

    @property
    def key(self) -> tuple[str, str, str]:
        """What a row names it by."""
        return self.set, self.capture, self.file


@dataclass(frozen=True)
class Scored:
    """Result of one pair."""

    method: str
    set: str
    variant: str
    capture: str
    file: str
    claimed: bool
    given: bool
    """An estimate is there, claimed or not."""
    median_px: float
    p95_px: float
    rating: float
    """What the method says about the pair: number of inliers, or ECC's coefficient; nan without one."""
    std_px: float
    """The method's standard error of an estimate that is not claimed; nan without one."""
    seconds: float

    @property
    def is_wrong(self) -> bool:
        """Claimed, and more than 1 px off in the median."""
        return self.claimed and self.median_px > WRONG_PX

    @property
    def key(self) -> tuple[str, str, str]:
        """The pair of bands, in whatever variant."""
        return self.set, self.capture, self.file


@dataclass(frozen=True)
class Score:
    """A method on the pairs of a set and a variant. Medians are over its claims, shares over all pairs."""

    set: str
    variant: str
    method: str
    pairs: int
    claimed: int
    wrong_claims: int
    """Claimed, and more than 1 px off in the median."""
    refused: int
    unclaimed: int
    """Estimates that the method does not accept; neither claims nor refusals."""
    under_half_px: float
    under_1_px: float
    median_px: float
    """Median of the pairs' median errors."""
    p95_px: float
    """Median of the pairs' p95 errors."""
    worst_px: float
    """Maximum of the pairs' median errors."""
    unclaimed_median_px: float
    seconds: float
    """Median over pairs."""


# ---- the truth


def read_sets(folder: Path = SETS) -> dict[str, dict[str, Any]]:
    """The descriptions of all sets, by name."""
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}


def pairs_of(description: Mapping[str, Any], variant: str = AS_IT_IS) -> list[Pair]:
    """The pairs of a set that a variant is made of, with their truth there: all of a set as it is, at most three
    otherwise, which are of one capture where that has several; where bands are lost, another one of each capture.
    """
    by_capture = []
    for capture, truth in description["captures"].items():
        of_all = description, capture, truth["reference"]
        by_capture.append([_pair(*of_all, file, entry, variant) for file, entry in truth["pairs"].items()])
    pairs = [pair for group in by_capture for pair in group]
    if variant in (AS_IT_IS, "lens-corrected"):
        return pairs
    if len(by_capture[0]) == 1:
        some = pairs
    elif variant == LOST:
        some = [group[number % len(group)] for number, group in enumerate(by_capture)]
    else:
        some = by_capture[0]
    spread = np.linspace(0, len(some) - 1, min(len(some), _PAIRS_OF_A_VARIANT)).round().astype(int)
    return [some[i] for i in spread]


def _pair(
    description: Mapping[str, Any], capture: str, reference: str, file: str, entry: Mapping[str, Any], variant: str
) -> Pair:
    width, height = description["files"][file]["size_px"]
    if "ties" in entry:
        here, there = np.hsplit(np.array(entry["ties"], float), 2)
    else:
        w, h = description["files"][reference]["size_px"]
        x, y = np.meshgrid(np.linspace(0, w - 1, _LATTICE), np.linspace(0, h - 1, _LATTICE))
        here = np.stack([x.ravel(), y.ravel()], axis=1)
        there = apply(np.array(entry["homography"], float), here)
    moved = apply(movement(variant, (width, height)), there)
    inside = np.logical_and(*(((at >= 0) & (at <= (width - 1, height - 1))).all(axis=1) for at in (there, moved)))
    return Pair(description["set"], capture, reference, file, here[inside], moved[inside], (width, height))


def movement(variant: str, size_px: tuple[int, int]) -> Matrix:
    """Where a variant puts the pixels of a moving file (width, height): `turn DEGREES` (clockwise as seen) and `scale
    FACTOR` about its centre and within its frame; all others leave them in their places.
    """
    result, matrix = re.fullmatch(r"(turn|scale) ([\d.]+)", variant), np.eye(3)
    if result:
        angle, scale = (np.radians(float(result[2])), 1.0) if result[1] == "turn" else (0.0, float(result[2]))
        cos, sin = scale * np.cos(angle), scale * np.sin(angle)
        matrix[:2, :2] = [[cos, -sin], [sin, cos]]
        centre = (np.array(size_px) - 1) / 2
        matrix[:2, 2] = centre - matrix[:2, :2] @ centre
    return matrix


def apply(matrix: Matrix, points_px: Points) -> Points:
    """Points (n, 2) through a homography; inf or nan on its horizon."""
    mapped = points_px @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[:, :2] / mapped[:, 2:])


# ---- results of a method


def read_results(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV or JSON file; those without a method are named after the file."""
    csv.field_size_limit(_LARGEST_CELL)
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = json.load(file) if path.suffix == ".json" else list(csv.DictReader(file))
    return [{"method": path.stem, **{k: v for k, v in row.items() if v not in (None, "")}} for row in rows]


def _decoded(value: Any) -> Any:
    """Return the JSON value in a cell of a CSV file."""
    if not isinstance(value, str):
        return value
    return json.loads(value) if value.lstrip().startswith(("[", "{")) else [float(v) for v in value.split()]


def mapped_px(row: Mapping[str, Any], reference_px: Points) -> Points | None:
    """Points (n, 2) of the reference in the moving file; None where the row has no mapping.

    Raises ValueError for a file that does not contain a mapping.
    """
    if row.get("homography") is not None:
        return apply(np.array(_decoded(row["homography"]), float).reshape(3, 3), reference_px)
    if row.get("grid") is None:
        return None
    grid = _decoded(row["grid"])
    return np.asarray(CloughTocher2DInterpolator(grid["reference_px"], grid["moving_px"])(reference_px))


def errors_px(row: Mapping[str, Any], pair: Pair) -> Points | None:
    """(n,) distances from the truth, inf where a mapping says nothing; None where the row has no mapping.

    Raises ValueError for a file that does not contain a mapping.
    """
    there = mapped_px(row, pair.reference_px)
    if there is None:
        return None
    return np.asarray(np.nan_to_num(np.linalg.norm(there - pair.moving_px, axis=1), nan=np.inf))


def score_pairs(rows: Iterable[Mapping[str, Any]], sets: Mapping[str, Mapping[str, Any]]) -> list[Scored]:
    """A row for each pair of each set and variant that a method says anything of; what it leaves out it refuses.

    Raises ValueError for rows of unknown pairs, for two rows of one pair, and for mappings that are none.
    """
    groups = defaultdict[tuple[str, str, str], dict[tuple[str, str, str], Mapping[str, Any]]](dict)
    for row in rows:
        group = groups[row["set"], row.get("variant", AS_IT_IS), row["method"]]
        key = row["set"], str(row["capture"]), row["file"]
        if key in group:
            raise ValueError(f"{row['method']}: two rows for {key}")
        group[key] = row
    scored = []
    for (name, variant, method), group in groups.items():
        if name not in sets:
            raise ValueError(f"{method}: there is no set {name}")
        pairs = pairs_of(sets[name], variant)
        if unknown := set(group) - {p.key for p in pairs}:
            raise ValueError(f"{method}, {variant}: no such pair: {sorted(unknown)[0]}")
        scored += [_scored(group.get(p.key, {}), p, variant, method) for p in pairs]
    return scored


def _scored(row: Mapping[str, Any], pair: Pair, variant: str, method: str) -> Scored:
    try:
        error = errors_px(row, pair)
    except (ValueError, KeyError, TypeError) as problem:
        raise ValueError(f"{method}: {pair.key}: no mapping ({problem})") from None
    given = error is not None
    rating, std_px, seconds = (float(row.get(name, "nan")) for name in ("rating", "std_px", "seconds"))
    # Of the order statistics the upper one, for between a number and inf nothing can be interpolated.
    quantiles_px = np.percentile(error, (50, 95), method="higher").tolist() if given else (np.nan, np.nan)
    claimed = given and str(row.get("claimed", "yes")).lower() not in ("no", "false", "0")
    return Scored(method, pair.set, variant, *pair.key[1:], claimed, given, *quantiles_px, rating, std_px, seconds)


def limited(scored: Sequence[Scored], sets: Mapping[str, Mapping[str, Any]]) -> list[Scored]:
    """Return the results of the methods that rate pairs, claimed only above a limit.

    Every other pair of all sets, with its copies, is one half. The limit for a half is the highest rating of a wrong
    claim in the other one, so that all claims there would be right.
    """
    pairs = (pair for description in sets.values() for pair in pairs_of(description))
    half = {pair.key: index % 2 for index, pair in enumerate(pairs)}
    result = []
    for method in dict.fromkeys(s.method for s in scored if not np.isnan(s.rating)):
        own = [s for s in scored if s.method == method]
        limits = [max((s.rating for s in own if half[s.key] != h and s.is_wrong), default=-np.inf) for h in (0, 1)]
        name = f"{method}, with a limit"
        result += [replace(s, method=name, claimed=s.claimed and s.rating > limits[half[s.key]]) for s in own]
    return result


def summary(scored: Sequence[Scored], name: str | None = None) -> list[Score]:
    """A score for each set, variant and method, in the order in which they come; `name` pools the sets under it."""
    groups = defaultdict[tuple[str, str, str], list[Scored]](list)
    for s in scored:
        groups[name or s.set, s.variant, s.method].append(s)
    return [_score(*key, group) for key, group in groups.items()]


def _score(set_name: str, variant: str, method: str, group: Sequence[Scored]) -> Score:
    medians, p95 = (np.array([getattr(s, name) for s in group if s.claimed]) for name in ("median_px", "p95_px"))
    unclaimed = [s.median_px for s in group if s.given and not s.claimed]
    refused = sum(not s.given for s in group)
    counts = len(group), len(medians), int((medians > WRONG_PX).sum()), refused, len(unclaimed)
    under = [float((medians <= limit_px).sum() / len(group)) for limit_px in (GOOD_PX, WRONG_PX)]
    errors = _median(medians), _median(p95), max(medians.tolist(), default=np.nan), _median(unclaimed)
    return Score(set_name, variant, method, *counts, *under, *errors, _median([s.seconds for s in group]))


def _median(values: Iterable[float]) -> float:
    """Return the median of the values that are not nan, nan without any."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.median(known)) if known else np.nan


# ---- tables


def write_csv(scores: Sequence[Score] | Sequence[Scored], path: Path) -> None:
    """Write scores as CSV, in few bytes: unknown values are empty, and True is 1."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([f.name for f in fields(scores[0])] if scores else [])
        writer.writerows([_stored(f.name, v) for f, v in zip(fields(s), astuple(s), strict=True)] for s in scores)


def _stored(name: str, value: object) -> object:
    """A value in a cell of a file: a number with at most four decimals and digits, seconds with two and three."""
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        decimals, digits = (2, 3) if name == "seconds" else (4, 4)
        return "" if np.isnan(value) else f"{round(value, decimals):.{digits}g}"
    return value


def table(rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table; the first row is the head."""
    cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    head, *body = [f"| {' | '.join(row)} |" for row in cells]
    return "\n".join([head, "|---" * len(rows[0]) + "|", *body])


def markdown(scores: Sequence[Score]) -> str:
    """Return a table of the scores of one set and variant."""
    counts = "method", "pairs", "claimed", "**wrong claims**", "refused", "unclaimed", "under 0.5 px", "under 1 px"
    rows = [(*counts, "median, px", "95 %, px", "worst pair, px", "s a pair")]
    for s in scores:
        unclaimed = f"{s.unclaimed} ({s.unclaimed_median_px:.2f} px)" if s.unclaimed else "0"
        shares = f"{s.under_half_px:.0%}", f"{s.under_1_px:.0%}"
        errors = [_cell(v, n) for v, n in ((s.median_px, 3), (s.p95_px, 2), (s.worst_px, 2), (s.seconds, 2))]
        rows.append((s.method, s.pairs, s.claimed, f"**{s.wrong_claims}**", s.refused, unclaimed, *shares, *errors))
    return table(rows)


def _cell(value: object, digits: int) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if np.isnan(value) else f"{value:.{digits}f}" if abs(value) < 1e4 else f"{value:.0e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--sets", type=Path, default=SETS)
    options = parser.parse_args()
    try:
        rows = [row for path in options.results for row in read_results(path)]
        scores = summary(score_pairs(rows, read_sets(options.sets)))
    except (ValueError, KeyError, OSError) as error:
        sys.exit(str(error))
    for set_name, variant in dict.fromkeys((s.set, s.variant) for s in scores):
        print(f"\n### {set_name}, {variant}\n")
        print(markdown([s for s in scores if (s.set, s.variant) == (set_name, variant)]))
    if options.output:
        write_csv(scores, options.output)


if __name__ == "__main__":
    main()
