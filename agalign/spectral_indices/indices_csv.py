"""The table of the indices of a run, OUT/indices.csv."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from agalign.errors import InputError
from agalign.host.files import INDICES_FILE, PAGE_STARTS, read_regular, write_csv
from agalign.host.own_files import refuse_foreign
from agalign.host.text import without_formula
from agalign.rasters.band_reader import UNSTATED
from agalign.records.cautions import RunFacts
from agalign.records.run_record import renamed_captures
from agalign.records.sidecar import Sidecar
from agalign.spectral_indices.formulas import Index, bands_for
from agalign.spectral_indices.rasters import IndexRaster, IndexReport, IndexStatistics

_COLUMNS = (
    *("folder", "capture", "captured_at", "latitude", "longitude"),
    *("index", "median", "p5", "p95", "valid_share", "masked_share", "input", "low", "high", "file", "problem"),
)


def to_check(index: Index | None, unit: str, sidecar: Sidecar, run: RunFacts, label: str) -> str:
    """Return what to check in the bands of an index of a capture, given their unit, its run and label; empty if there
    is nothing, or if the formula is unknown.
    """
    if index is None:
        return ""
    result = []
    if not index.any_unit and unit != "reflectance":
        what = "which no tag states" if unit == UNSTATED else f"which are {unit}, not reflectance"
        result.append(f"its value depends on the unit of the bands, {what}")
    elif unit.endswith("radiance"):
        result.append(f"the light in each band is a part of its value, as the bands are {unit}, not reflectance")
    with suppress(InputError):  # other bands than those of the sidecar
        used = bands_for(index, {b.band: b.wavelength_nm for b in sidecar.bands})
        result += [f"{c.band}: {c.reason}" for c in run.cautions(sidecar, label) if c.band in used]
    return "; ".join(result)


def reports_of(sidecar: Sidecar, label: str, out: Path, run: RunFacts) -> list[IndexReport]:
    """Return the indices of a capture that its sidecar lists, given its label, from the tags of the rasters, which are
    as they were written.
    """
    result = []
    for part in sidecar.products:
        path = (out / label).parent / part.file
        if part.kind == "index" and path.suffix == ".tif" and (raster := IndexRaster.read(path)) is not None:
            problem = to_check(raster.index, raster.statistics.unit, sidecar, run, label)
            report = IndexReport(label, raster.name, path, raster.statistics, problem, is_masked=raster.is_masked)
            result.append(report.of(sidecar))
    return result


def refuse_foreign_table(folder: Path) -> None:
    """Raise ConfigurationError if a folder has a file with the name of the table that no command has written."""
    refuse_foreign(folder / INDICES_FILE, (PAGE_STARTS[INDICES_FILE],), "choose another folder with -o")


def current_rows(out: Path) -> list[IndexReport]:
    """Return the rows of OUT/indices.csv that can be read and are of a raster that exists, whose tags have the
    statistics, or of an index that could not be calculated; those of renamed captures are left out.
    """
    rows, renamed = list[IndexReport](), renamed_captures(out)
    with suppress(OSError, csv.Error):
        for line in csv.DictReader(io.StringIO(read_regular(out / INDICES_FILE).decode(errors="replace"))):
            with suppress(ValueError, KeyError, TypeError, AttributeError):  # too few or too many cells
                rows.append(_report_of_row(line, out))
    return [row for row in rows if row.capture not in renamed]


def merged(rows: Iterable[IndexReport], newer: Iterable[IndexReport]) -> list[IndexReport]:
    """Return all rows; a newer one replaces that of the same capture and index."""
    return list({row.key: row for row in [*rows, *newer]}.values())


def update_table(
    out: Path, rows: Sequence[IndexReport], earlier: Sequence[IndexReport] | None = None
) -> list[IndexReport]:
    """Write OUT/indices.csv: `rows`, and the `current_rows` of other captures and indices, which may be given.

    Return all rows. Without any, only an earlier table is written again, empty. Raises OutputError.
    """
    result = _masked_alike(merged(current_rows(out) if earlier is None else earlier, rows))
    if result or (out / INDICES_FILE).is_file():
        cells = (_cells(row, out) for row in sorted(result, key=lambda row: row.key))
        write_csv(out / INDICES_FILE, _COLUMNS, cells)
    return result


def _masked_alike(rows: Sequence[IndexReport]) -> list[IndexReport]:
    """Return the rows without the values of rasters that are not masked like most, of an equal number like the masked:
    statistics with and without quality flags are not comparable.
    """
    counts: Counter[tuple[str, bool]] = Counter((row.index, row.is_masked) for row in rows if row.path is not None)
    result = []
    for row in rows:
        are_masked = counts[row.index, True] >= counts[row.index, False]
        if row.path is not None and row.is_masked != are_masked:
            state = "masked" if row.is_masked else "not masked"
            problem = f"its raster is {state} by quality flags, unlike those of most captures; compute the index again"
            row = replace(row, path=None, statistics=IndexStatistics(), problem=problem)
        result.append(row)
    return result


def _cells(row: IndexReport, out: Path) -> dict[str, Any]:
    """Return the cells of a row by column."""
    folder, capture, _ = row.key
    file = "" if row.path is None else row.path.relative_to(out).as_posix()
    others = {"folder": folder, "capture": capture, "input": row.statistics.unit, "file": file}
    known = vars(row) | row.statistics.as_json() | others
    return {column: known[column] for column in _COLUMNS}


def _report_of_row(cells: Mapping[str, str], out: Path) -> IndexReport:
    """Return the report of which `_cells` wrote a row. Raises ValueError or KeyError, also if its raster is missing."""
    cells = {k: _unquoted(v) for k, v in cells.items()}
    latitude, longitude = (float(cells[k]) if cells[k] else None for k in ("latitude", "longitude"))
    report = IndexReport(
        Path(cells["folder"], cells["capture"]).as_posix(),
        cells["index"],
        problem=cells["problem"],
        captured_at=cells["captured_at"],
        latitude=latitude,
        longitude=longitude,
    )
    path = out / cells["file"]
    path.relative_to(out)  # raises ValueError for an absolute path, which no table has
    raster = IndexRaster.read(path) if cells["file"] else None
    if raster is not None:
        return replace(report, path=path, statistics=raster.statistics, is_masked=raster.is_masked)
    if cells["file"] or not report.problem:
        raise ValueError("its raster is missing")
    return report


def _unquoted(text: str) -> str:
    """The text that `without_formula` quoted."""
    return text[1:] if text.startswith("'") and without_formula(text[1:]) != text[1:] else text
