"""The table of measured figures from which pages quote; a benchmark with --figures replaces the rows of its command.

Each row has the version of the packages that it depends on: `tools/pages.py` marks tables that were measured by another
version.
"""

import csv
import hashlib
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures" / "figures.csv"
HEAD = "fact", "value", "unit", "n", "command", "commit", "digest"
UNITS = "px", "%", "s", "MB", "GB"
FiguresOption = Annotated[
    bool, typer.Option("--figures", help="write the rows of this command in docs/figures/figures.csv")
]

TITLES = {
    "rededge_m_rowcrop": "RedEdge-M, row crop",
    "rededge_altitudes": "RedEdge-M, two altitudes",
    "rededge_mx_dual": "RedEdge-MX dual",
    "rededge_orchard_no_rig": "RedEdge, orchard, no rig tags",
    "p4m_forest": "Phantom 4 Multispectral, forest",
    "p4m_forest_next": "Phantom 4 Multispectral, forest, next capture",
    "p4m_bananas": "Phantom 4 Multispectral, bananas from 19 m",
    "blurred_flat": "RedEdge, blurred by 3 px, no tags",
    "boom_two_depths": "RedEdge-M, plants from 1-2 m",
    "sentera_d4k": "Sentera Double 4K, 12 megapixels",
}
"""Names of folders with real captures in the tables."""


def title_of(folder: Path) -> str:
    """Return the name of a folder in the tables."""
    return TITLES.get(folder.name, folder.name)


ESTIMATOR = "config.py", "values", "pixels", "cameras", "fit", "method", "flight", "verify", "capture"
"""Modules and packages of agalign on which every figure depends."""
RENDERING = "rasters", "spectral_indices"
"""What figures of runs depend on as well."""
DEPENDS_ON = {
    **dict.fromkeys(("runs", "captures with depth"), RENDERING),
    "reliability": ("host", "batch", *RENDERING),
    **dict.fromkeys(("experiments, recipe fast", "experiments, recipe paper"), ("evaluation",)),
}
"""Other packages on which the figures of a table depend."""


class Provenance(NamedTuple):
    """The version of the code by which a figure was measured."""

    commit: str
    """The last commit that changed the packages."""
    digest: str
    """Of the files of the packages."""

    @classmethod
    def of(cls, table: str) -> "Provenance":
        """Return the version of this checkout that the figures of a table depend on. Raises OSError without git."""
        packages = (*ESTIMATOR, *DEPENDS_ON.get(table, ()))
        paths = [f"agalign/{name}" for name in packages]
        log = ["git", "log", "-1", "--format=%h", "--abbrev=8", "--", *paths]
        done = subprocess.run(log, cwd=ROOT, capture_output=True, text=True, check=False)
        return cls(done.stdout.strip(), digest_of(packages))


def is_current(table: str, digest: str) -> bool:
    """Return whether the packages that the figures of a table depend on are those that were measured."""
    return digest == digest_of((*ESTIMATOR, *DEPENDS_ON.get(table, ())))


@cache
def digest_of(packages: Sequence[str]) -> str:
    """Return a digest of the files of some packages."""
    found = hashlib.sha256()
    for top in packages:
        path = ROOT / "agalign" / top
        assert path.exists(), f"{path}: a table depends on it"
        for file in sorted(path.rglob("*"), key=Path.as_posix) if path.is_dir() else [path]:
            if file.is_file() and file.suffix != ".pyc":
                found.update(file.relative_to(ROOT).as_posix().encode() + b"\0")
                found.update(file.read_bytes().replace(b"\r\n", b"\n"))
    return found.hexdigest()[:8]


@dataclass(frozen=True)
class TableRow:
    """A row of a table of figures."""

    table: str
    name: str
    n: str
    """Number of cases and what they are: `16 pairs`."""
    cells: Mapping[str, object]
    """Values by column, with its unit after a comma; "-" and "" are unknown."""
    measured: Provenance | None = None
    """By this version; by default, by that of this checkout."""


def end_check(name: str, cases: str, failures: int, *, figures: bool) -> None:
    """End a check of the reliability: write its row if asked to, and exit with code 1 if something failed."""
    if figures:
        write_figures([TableRow("reliability", name, cases, {"failures": failures})])
    if failures:
        raise SystemExit(f"{failures} failures: {name}")


def write_figures(
    rows: Iterable[TableRow],
    placeholder: str = "",
    folders: Sequence[Path] = (),
    command: str = "",
    path: Path = FIGURES,
) -> None:
    """Replace the rows of a command, and those with the same facts; all others stay as they are.

    The command is by default the running one without --figures, with `placeholder` instead of its arguments that are
    `folders`, or before their names if it ends with a slash. New rows keep the order of the old ones with the same
    facts, and are written where the first replaced row is.
    """
    command = command or command_line(placeholder, folders)
    facts = [line for row in rows for line in _lines(row, command)]
    old = read_figures(path)
    order = {line["fact"]: index for index, line in enumerate(old)}
    facts.sort(key=lambda line: order.get(line["fact"], len(old)))
    new = {line["fact"] for line in facts}
    is_kept = [line["command"] != command and line["fact"] not in new for line in old]
    at = [*is_kept, False].index(False)
    kept_after = [line for line, kept in zip(old[at:], is_kept[at:], strict=True) if kept]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, HEAD, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*old[:at], *facts, *kept_after])


def _lines(row: TableRow, command: str) -> Iterable[dict[str, str]]:
    """Yield the lines of a row in the file, one for each cell."""
    measured = row.measured or Provenance.of(row.table)
    for head, value in row.cells.items():
        column, _, unit = head.rpartition(", ")
        column, unit = (column, unit) if unit in UNITS else (head, "")
        values = {"value": "" if value == "-" else str(value), "unit": unit, "n": row.n, "command": command}
        yield {"fact": f"{row.table} / {row.name} / {column}", **values, **measured._asdict()}


def command_line(placeholder: str = "", folders: Sequence[Path] = ()) -> str:
    """Return the running command without --figures and without the paths of this machine."""
    words = ["python", Path(sys.argv[0]).resolve().relative_to(ROOT).as_posix()]
    for argument in sys.argv[1:]:
        name = Path(argument).name if placeholder.endswith("/") else ""
        word = placeholder + name if Path(argument) in folders else f'"{argument}"' if " " in argument else argument
        if argument != "--figures":
            words.append(word)
    return " ".join(words)


def read_figures(path: Path = FIGURES) -> list[dict[str, str]]:
    """Return the lines of the file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
