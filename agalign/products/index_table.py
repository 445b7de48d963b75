"""Results of indices: the statistics in the tags of a raster, and OUT/indices.csv, a row per capture and index."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from agalign.errors import AgalignError
from agalign.pixels.raster import open_raster
from agalign.products.index_bands import RAW
from agalign.products.sidecar import CaptureResult
from agalign.products.text_files import write_csv
from agalign.values.files import read_regular
from agalign.values.text import without_formula

STATISTICS_TAG = "INDEX_STATISTICS"
INDICES_FILE = "indices.csv"


@dataclass(frozen=True)
class IndexStatistics:
    """The values of an index raster; nan if no pixel is valid."""

    median: float = math.nan
    p5: float = math.nan
    p95: float = math.nan
    valid_share: float = 0.0
    unit: str = ""
    """Unit of the bands: reflectance, radiance, or raw numbers."""
    low: float = math.nan
    """Value at the lower end of the colour scale of the picture."""
    high: float = math.nan
    """Value at the upper end of the colour scale."""
    masked_share: float = 0.0
    """Share of the pixels that only the quality flags mask."""

    def as_json(self) -> dict[str, float | str | None]:
        """Return the fields by name, with null for nan, which JSON does not have."""
        return {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in vars(self).items()}


@dataclass(frozen=True)
class IndexReport:
    """One index of one capture."""

    capture: str
    """Label of the capture: its folder, relative to the output folder of the run, and its name."""
    index: str
    path: Path | None = None
    """The raster; None if it could not be written."""
    statistics: IndexStatistics = IndexStatistics()
    problem: str = ""
    kept: bool = field(default=False, compare=False)
    """True if an earlier command wrote the raster from the same bands with the same formula."""
    captured_at: str = ""
    latitude: float | None = None
    longitude: float | None = None

    @property
    def median(self) -> float:
        """Median of the valid pixels."""
        return self.statistics.median

    @property
    def raw_numbers(self) -> bool:
        """True if the bands are neither reflectance nor radiance."""
        return self.statistics.unit == RAW

    @property
    def key(self) -> tuple[str, str, str]:
        """Identify the row in the table: (folder, capture, index)."""
        label = PurePosixPath(self.capture)
        return label.parent.as_posix(), label.name, self.index

    def of(self, sidecar: CaptureResult) -> "IndexReport":
        """Return the report with the time and the position of its capture."""
        place = sidecar.position
        latitude, longitude = (None, None) if place is None else (place.latitude, place.longitude)
        return replace(self, captured_at=sidecar.captured_at, latitude=latitude, longitude=longitude)


def statistics_in(tags: Mapping[str, str]) -> IndexStatistics | None:
    """Return the statistics in the tags of a raster; None if there are none."""
    try:
        fields: dict[str, Any] = json.loads(tags[STATISTICS_TAG])
        unit = str(fields.pop("unit"))
        return IndexStatistics(unit=unit, **{k: math.nan if v is None else float(v) for k, v in fields.items()})
    except (KeyError, ValueError, TypeError):
        return None


def read_statistics(path: Path) -> IndexStatistics | None:
    """Return the statistics of an index raster; None for another file, or one that cannot be read."""
    try:
        with open_raster(path) as source:
            return statistics_in(source.tags())
    except AgalignError:
        return None


def reports_of_run(sidecar: CaptureResult, folder: str, out: Path) -> list[IndexReport]:
    """Return the indices that the run itself wrote, from the tags of the rasters."""
    result = []
    for part in sidecar.products:
        path = out / folder / part.file
        if part.kind == "index" and path.suffix == ".tif":
            name = path.stem.removeprefix(f"{Path(sidecar.capture).name}_")
            statistics = read_statistics(path)
            if statistics is not None:
                label = Path(folder, sidecar.capture).as_posix()
                result.append(IndexReport(label, name, path, statistics).of(sidecar))
    return result


def read_table(out: Path) -> list[IndexReport]:
    """Return the rows of OUT/indices.csv whose rasters still exist; empty if there is no table."""
    try:
        text = read_regular(out / INDICES_FILE).decode()
        # Lines may have too few or too many cells.
        rows = [_row(line, out) for line in csv.DictReader(io.StringIO(text))]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error):
        return []
    return [row for row in rows if row.path is None or row.path.is_file()]


def update_table(out: Path, rows: Sequence[IndexReport]) -> list[IndexReport]:
    """Add rows to OUT/indices.csv, replacing those of the same capture and index, and return all rows.

    An empty table is not written. Raises OutputError.
    """
    old = read_table(out)
    result = list({row.key: row for row in [*old, *rows]}.values())
    if result and (result != old or not (out / INDICES_FILE).is_file()):
        of_capture = "folder", "capture", "captured_at", "latitude", "longitude"
        of_index = "index", "median", "p5", "p95", "valid_share", "masked_share", "input", "low", "high", "file"
        columns = *of_capture, *of_index, "problem"
        cells = (_cells(row, out) for row in sorted(result, key=lambda row: row.key))
        write_csv(out / INDICES_FILE, columns, ([one[name] for name in columns] for one in cells))
    return result


def _cells(row: IndexReport, out: Path) -> dict[str, Any]:
    folder, capture, _ = row.key
    place = {"folder": folder, "capture": capture, "input": row.statistics.unit}
    file = "" if row.path is None else row.path.relative_to(out).as_posix()
    return vars(row) | row.statistics.as_json() | place | {"file": file}


def _row(cells: Mapping[str, str], out: Path) -> IndexReport:
    cells = {k: _unquoted(v) for k, v in cells.items()}
    numbers = {k: float(cells[k] or "nan") for k in ("median", "p5", "p95", "valid_share", "low", "high")}
    numbers["masked_share"] = float(cells.get("masked_share") or 0)  # older tables do not have it
    path = out / cells["file"]
    path.relative_to(out)  # raises ValueError for an absolute path, which no table has
    latitude, longitude = (float(cells[k]) if cells[k] else None for k in ("latitude", "longitude"))
    return IndexReport(
        Path(cells["folder"], cells["capture"]).as_posix(),
        path=path if cells["file"] else None,
        statistics=IndexStatistics(unit=cells["input"], **numbers),
        index=cells["index"],
        problem=cells["problem"],
        captured_at=cells["captured_at"],
        latitude=latitude,
        longitude=longitude,
    )


def _unquoted(text: str) -> str:
    """The text that `without_formula` quoted."""
    return text[1:] if text.startswith("'") and without_formula(text[1:]) != text[1:] else text
