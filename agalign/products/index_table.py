"""OUT/indices.csv: a row per capture and index, with the statistics of its values."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from agalign.products.csv_file import write_csv
from agalign.products.index_rasters import IndexReport
from agalign.products.index_statistics import IndexStatistics, read_statistics
from agalign.products.sidecar import CaptureResult
from agalign.values.text import without_formula

INDICES_FILE = "indices.csv"
COLUMNS = (
    "folder", "capture", "captured_at", "latitude", "longitude", "index", "median", "p5", "p95", "valid_share", "input",
    "low", "high", "file", "problem",
)  # fmt: skip
_STATISTICS = ("median", "p5", "p95", "valid_share", "low", "high")
"""Columns with a number of `IndexStatistics`."""

_Key = tuple[str, str, str]
"""(folder, capture, index)."""


@dataclass(frozen=True)
class IndexRow:
    """One index of one capture."""

    folder: str
    capture: str
    captured_at: str
    latitude: float | None
    longitude: float | None
    index: str
    file: str
    """The raster, relative to the folder of the table; empty if it was not written."""
    statistics: IndexStatistics
    problem: str = ""

    @property
    def key(self) -> _Key:
        """Identify the row."""
        return self.folder, self.capture, self.index

    @property
    def label(self) -> str:
        """The capture with its folder."""
        return Path(self.folder, self.capture).as_posix()


def row_of(report: IndexReport, sidecar: CaptureResult, folder: str, out: Path) -> IndexRow:
    """Return the row of a report; `folder` is the capture's, relative to the output folder of its run."""
    file = "" if report.path is None else report.path.relative_to(out).as_posix()
    place = sidecar.position
    latitude, longitude = (None, None) if place is None else (place.latitude, place.longitude)
    return IndexRow(
        folder, sidecar.capture, sidecar.captured_at, latitude, longitude, report.index, file, report.statistics,
        report.problem,
    )  # fmt: skip


def rows_of_run(sidecar: CaptureResult, folder: str, out: Path) -> list[IndexRow]:
    """Return the rows of the indices that the run itself wrote, from the tags of the rasters."""
    result = []
    for part in sidecar.products:
        path = out / folder / part.file
        if part.kind == "index" and path.suffix == ".tif":
            name = path.stem.removeprefix(f"{Path(sidecar.capture).name}_")
            statistics = read_statistics(path)
            if statistics is not None:
                report = IndexReport("", name, path, statistics)
                result.append(row_of(report, sidecar, folder, out))
    return result


def read_table(out: Path) -> list[IndexRow]:
    """Return the rows of OUT/indices.csv whose rasters still exist; empty if there is no table."""
    try:
        text = (out / INDICES_FILE).read_text(encoding="utf-8")
        rows = [_row(line) for line in csv.DictReader(io.StringIO(text))]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [row for row in rows if not row.file or (out / row.file).is_file()]


def write_table(out: Path, rows: Iterable[IndexRow]) -> None:
    """Write OUT/indices.csv. Raises OutputError."""
    in_order = sorted(rows, key=lambda row: row.key)
    cells = [vars(row) | row.statistics.as_json() | {"input": row.statistics.unit} for row in in_order]
    write_csv(out / INDICES_FILE, COLUMNS, ([without_formula(one[name]) for name in COLUMNS] for one in cells))


def update_table(out: Path, rows: Sequence[IndexRow]) -> list[IndexRow]:
    """Add rows to OUT/indices.csv, replacing those of the same capture and index, and return all rows.

    An empty table is not written. Raises OutputError.
    """
    old = read_table(out)
    result = list({row.key: row for row in [*old, *rows]}.values())
    if result and (result != old or not (out / INDICES_FILE).is_file()):
        write_table(out, result)
    return result


def _row(cells: Mapping[str, str]) -> IndexRow:
    cells = {k: _unquoted(v) for k, v in cells.items()}
    numbers = {k: float(cells[k] or "nan") for k in _STATISTICS}
    latitude, longitude = (float(cells[k]) if cells[k] else None for k in ("latitude", "longitude"))
    return IndexRow(
        cells["folder"], cells["capture"], cells["captured_at"], latitude, longitude, cells["index"], cells["file"],
        IndexStatistics(unit=cells["input"], **numbers), cells["problem"],
    )  # fmt: skip


def _unquoted(text: str) -> str:
    """The text that `without_formula` quoted."""
    return text[1:] if text.startswith("'") and without_formula(text[1:]) != text[1:] else text
