"""OUT/indices.csv: a row per capture and index, with the statistics of its values."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from agalign.products.index_rasters import IndexReport, IndexStatistics, read_statistics
from agalign.products.sidecar import CaptureResult
from agalign.values.files import write_text
from agalign.values.text import without_formula

INDICES_FILE = "indices.csv"
COLUMNS = (
    "folder", "capture", "captured_at", "latitude", "longitude", "index", "median", "p5", "p95", "valid_share", "input",
    "low", "high", "file", "problem",
)  # fmt: skip

_Key = tuple[str, str, str]
"""(folder, capture, index)."""


@dataclass(frozen=True)
class IndexRow:
    """One index of one capture, as the table has it."""

    folder: str
    capture: str
    captured_at: str
    latitude: float | None
    longitude: float | None
    index: str
    file: str
    """Relative to the table's folder; empty where nothing was written."""
    statistics: IndexStatistics
    problem: str = ""

    @property
    def key(self) -> _Key:
        """What no other row has."""
        return self.folder, self.capture, self.index


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
    """Return the rows of the indices that the run itself wrote of a capture, by the rasters' tags."""
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
    """Return the rows of OUT/indices.csv with rasters that still exist; empty without a table."""
    try:
        text = (out / INDICES_FILE).read_text(encoding="utf-8")
        rows = [_row(line) for line in csv.DictReader(io.StringIO(text))]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [row for row in rows if not row.file or (out / row.file).is_file()]


def write_table(out: Path, rows: Iterable[IndexRow]) -> None:
    """Write OUT/indices.csv. Raises OutputError."""
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in sorted(rows, key=lambda r: r.key):
        writer.writerow({k: without_formula(v) for k, v in _cells(row).items()})
    write_text(out / INDICES_FILE, table.getvalue())


def merged(old: Sequence[IndexRow], new: Sequence[IndexRow]) -> list[IndexRow]:
    """Return all rows, the new ones in place of old ones of the same capture and index."""
    return list(({row.key: row for row in old} | {row.key: row for row in new}).values())


def update_table(out: Path, rows: Sequence[IndexRow]) -> list[IndexRow]:
    """Add rows to OUT/indices.csv and return all; a table that would be empty is not written. Raises OutputError."""
    old = read_table(out)
    result = merged(old, rows)
    if result and (result != old or not (out / INDICES_FILE).is_file()):
        write_table(out, result)
    return result


def _cells(row: IndexRow) -> dict[str, object]:
    known = row.statistics
    numbers = {name: getattr(known, name) for name in ("median", "p5", "p95", "valid_share", "low", "high")}
    return {
        "folder": row.folder, "capture": row.capture, "captured_at": row.captured_at, "latitude": row.latitude,
        "longitude": row.longitude, "index": row.index, "input": known.unit, "file": row.file, "problem": row.problem,
        **{k: v if math.isfinite(v) else None for k, v in numbers.items()},
    }  # fmt: skip


def _row(cells: Mapping[str, str]) -> IndexRow:
    cells = {k: _unquoted(v) for k, v in cells.items()}
    numbers = {k: float(cells[k] or "nan") for k in ("median", "p5", "p95", "valid_share", "low", "high")}
    latitude, longitude = (float(cells[k]) if cells[k] else None for k in ("latitude", "longitude"))
    return IndexRow(
        cells["folder"], cells["capture"], cells["captured_at"], latitude, longitude, cells["index"], cells["file"],
        IndexStatistics(unit=cells["input"], **numbers), cells["problem"],
    )  # fmt: skip


def _unquoted(text: str) -> str:
    """What `without_formula` was given."""
    return text[1:] if text.startswith("'") and without_formula(text[1:]) != text[1:] else text
