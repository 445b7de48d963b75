"""The table of measured figures from which pages quote; a benchmark with --figures replaces the rows of its command."""

import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures" / "figures.csv"
HEAD = "fact", "value", "unit", "n", "command"
UNITS = "px", "%", "s", "GB"
FiguresOption = Annotated[
    bool, typer.Option("--figures", help="write the rows of this command in docs/figures/figures.csv")
]

TITLES = {
    "rededge_m_rowcrop": "RedEdge-M, row crop",
    "rededge_altitudes": "RedEdge-M, two altitudes",
    "rededge_mx_dual": "RedEdge-MX dual",
    "rededge_orchard_no_rig": "RedEdge, orchard, no rig tags",
    "p4m_forest": "Phantom 4 Multispectral, forest",
    "p4m_forest_next": "Phantom 4 Multispectral, forest, second exposure",
    "p4m_bananas": "Phantom 4 Multispectral, bananas from 19 m",
    "blurred_flat": "RedEdge, blurred by 3 px, no tags",
    "boom_two_depths": "RedEdge-M, plants from 1-2 m",
    "sentera_d4k": "Sentera Double 4K, 12 megapixels",
}
"""Names of folders with real captures in the tables."""


def title_of(folder: Path) -> str:
    """Return the name of a folder in the tables."""
    return TITLES.get(folder.name, folder.name)


@dataclass(frozen=True)
class TableRow:
    """A row of a table of figures."""

    table: str
    name: str
    n: str
    """Number of cases and what they are: `16 pairs`."""
    cells: Mapping[str, object]
    """Values by column, with its unit after a comma; "-" and "" are unknown."""


def write_figures(
    rows: Iterable[TableRow],
    placeholder: str = "",
    folders: Sequence[Path] = (),
    command: str = "",
    path: Path = FIGURES,
) -> None:
    """Replace the rows of a command, and those with the same facts; all others stay as they are.

    The command is by default the running one without --figures, with `placeholder` instead of its arguments that are
    `folders`. New rows keep the order of the old ones with the same facts, and are written where the first replaced row
    is.
    """
    command = command or command_line(placeholder, folders)
    facts = [line for row in rows for line in _lines(row, command)]
    with path.open(encoding="utf-8", newline="") as file:
        old = list(csv.DictReader(file))
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
    for head, value in row.cells.items():
        column, _, unit = head.rpartition(", ")
        column, unit = (column, unit) if unit in UNITS else (head, "")
        values = {"value": "" if value == "-" else str(value), "unit": unit, "n": row.n}
        yield {"fact": f"{row.table} / {row.name} / {column}", **values, "command": command}


def command_line(placeholder: str = "", folders: Sequence[Path] = ()) -> str:
    """Return the running command without --figures, with a placeholder for its folders."""
    script = Path(sys.argv[0]).resolve().relative_to(ROOT).as_posix()
    words = ["python", script]
    for argument in sys.argv[1:]:
        word = placeholder if Path(argument) in folders else f'"{argument}"' if " " in argument else argument
        if argument != "--figures" and not (word == placeholder == words[-1]):
            words.append(word)
    return " ".join(words)
