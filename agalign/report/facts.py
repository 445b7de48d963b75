"""The data that the report shows about each capture."""

import json
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

import numpy as np

from agalign.errors import ConfigurationError
from agalign.host.files import SUMMARY_FILE, CsvTable
from agalign.host.text import escape_controls
from agalign.rasters.preview import ERROR_FULL_PX
from agalign.records.cautions import MIN_SHARE_OVER_1_PX, RunFacts
from agalign.records.panels_and_sky import PanelPart, SkyPart
from agalign.records.sidecar import BandResult, ErrorPart, GridPart, OutputPart, Sidecar
from agalign.report.flight_map import FlightMap
from agalign.report.page_data import DataParts
from agalign.report.pair_totals import CautionGroup, PairTotals
from agalign.report.summary_csv import SHOWN_COLUMNS, SIMILARITY, SUMMARY_COLUMNS, rounded, row_of, value_at
from agalign.spectral_indices.formulas import index_named
from agalign.spectral_indices.picture import INDEX_COLOURS, INDEX_GREYS, PICTURE_PX
from agalign.spectral_indices.rasters import IndexReport, reason_not_written
from agalign.values.alignment import Prediction
from agalign.values.remedies import NO_RESULT

_NO_RASTER = "its raster does not exist; 'agalign indices' writes it"
_SHIFT_STEP_PX = 0.01
"""Shifts of windows are written as integer multiples of this."""


_DETAILS_PER_PART = 50
"""Captures whose details are loaded together: 300 kB."""
_ROWS_PER_PART = 1000
"""Captures whose rows of the table are loaded together: 400 kB."""


@dataclass
class CameraOffsets:
    """Offsets of the bands of a camera, for the chart over its captures."""

    captures: list[tuple[str, str, dict[str, tuple[float, float]]]] = field(default_factory=list)
    """(time, label, offsets (x, y), px, by aligned or predicted band) of each capture."""
    reference: str = ""
    """The reference band of the last capture."""


class FlightFacts:
    """The data of the captures below an output folder, which are added one by one. What the page shows of a single
    capture is written to files meanwhile: that of a season does not fit into memory.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.pairs = PairTotals(RunFacts.of(out))
        self.unwritten: dict[str, list[tuple[str, str]]] = defaultdict(list)
        """(label, reason) of the captures by requested index that was not written."""
        self.statuses: Counter[str] = Counter()
        """Number of captures by status as the page shows it: `ok_by_prediction` is not `ok`."""
        self._units: dict[tuple[str, str], CameraOffsets] = {}
        """By name of the model, and unit."""
        self.seconds: dict[str, float] = {}
        """Processing time of each capture, by label."""
        self.placed = 0
        """Number of captures with a position."""
        self.without_result: Sequence[str] = ()
        """Labels of the captures of the run that have no sidecar."""
        self.masked: dict[str, list[float]] = defaultdict(list)
        """Shares of pixels that only the quality flags mask, of the captures with any, by index."""
        self._summary, self._map = CsvTable(SUMMARY_COLUMNS), FlightMap()
        self._rows = DataParts(out, "rows", _ROWS_PER_PART)
        self._details = DataParts(out, "details", _DETAILS_PER_PART, self._take_lattices)
        self._lattices: dict[bytes, int] = {}
        """Centres of windows, which many pairs share, and their index, of the current part of the details."""
        self._first_lattice = 0

    @property
    def cameras(self) -> dict[str, CameraOffsets]:
        """Offsets by camera: the name of its model, with the unit where the run has several of the model."""
        units = Counter(model for model, _ in self._units)
        return {
            model if units[model] == 1 else f"{model} {unit}".strip(): offsets
            for (model, unit), offsets in self._units.items()
        }

    def add(self, label: str, sidecar: Sidecar, indices: Sequence[IndexReport] = ()) -> None:
        """Add a capture, given its label, and its indices. Raises OutputError."""
        folder = Path(label).parent
        checks: dict[str, list[str]] = defaultdict(list)
        # The page has links by the label that it shows.
        for caution in self.pairs.add(escape_controls(label), sidecar):
            checks[caution.band].append(caution.reason)
        keys = {"folder": folder.as_posix(), "capture": sidecar.capture, "reference": sidecar.reference.band}
        unwritten = list(unwritten_indices(sidecar, self.out / folder, indices))
        for name, why in unwritten:
            self.unwritten[name].append((escape_controls(label), why))
        facts = _of_capture(folder, label, sidecar) | {
            "bands": [self._pair(b, sidecar, keys, checks[b.band]) for b in sidecar.bands],
            "indices": [self._index(row) for row in indices if row.path is not None],
            "unwritten": unwritten,
        }
        for name, status, reason in sidecar.pairs:
            if status == "missing":
                self._summary.add(keys | {"band": name, "status": status, "reason": reason, "check": reason})
        self._count(facts, sidecar.camera.unit)
        rasters = [row.path.relative_to(self.out).as_posix() for row in indices if row.path]
        medians = {f"{index['name']}_median": index["median"] for index in facts["indices"]}
        self._map.add(label, sidecar, rasters, expected_error_px=facts["error_px"], **medians)
        self._rows.add(_map_row(facts))
        self._details.add(facts)

    def _count(self, facts: dict[str, Any], unit: str) -> None:
        label, camera = facts["label"], self._units.setdefault((facts["camera"], unit), CameraOffsets())
        self.statuses[facts["shown"]] += 1
        self.seconds[label] = facts["seconds"]
        self.placed += facts["position"] is not None
        usable = [b for b in facts["bands"] if b["status"] in ("aligned", "predicted") and b["offset_px"]]
        camera.captures.append((facts["captured_at"], label, {b["band"]: b["offset_px"] for b in usable}))
        camera.reference = facts["reference"]

    def _index(self, row: IndexReport) -> dict[str, Any]:
        assert row.path is not None
        known = row.statistics.as_json()
        if row.statistics.masked_share > 0:
            self.masked[row.index].append(rounded(row.statistics.masked_share))
        file = row.path.relative_to(self.out)
        return {name: rounded(known[name]) for name in ("median", "p5", "p95")} | {
            "name": row.index,
            "valid": known["valid_share"],
            "unit": known["unit"],
            "masked": known["masked_share"],
            "span": (known["low"], known["high"]),
            "raw": row.raw_numbers,
            "file": quote(file.as_posix()),
            "picture": quote(file.with_suffix(".png").as_posix()),
        }

    def _take_lattices(self) -> dict[str, Any]:
        """Return the lattices of the current part of the details, and begin with those of the next."""
        first, lattices = self._first_lattice, [np.frombuffer(centres).tolist() for centres in self._lattices]
        self._first_lattice += len(lattices)
        self._lattices = {}
        return {"first_lattice": first, "lattices": lattices}

    def add_excluded(self, part: PanelPart | SkyPart) -> None:
        """Add the bands of a capture that is not aligned, as it shows a panel or the sky."""
        row = {"folder": part.folder, "capture": part.capture, "status": part.kind, "reason": part.sentence}
        for band in part.bands:
            self._summary.add(row | {"band": band.band})
        self._map.add_excluded(part)

    def add_without_result(self, labels: Sequence[str]) -> None:
        """Add the captures of the run that have no sidecar."""
        self.without_result = labels
        facts = {"status": "no_result", "reason": NO_RESULT.cause, "check": NO_RESULT.cause}
        for path in map(Path, labels):
            self._summary.add({"folder": path.parent.as_posix(), "capture": path.name, **facts})

    def groups(self) -> list[CautionGroup]:
        """Return what to check, by cause, the largest effect first."""
        return self.pairs.groups(self.without_result)

    def write(self) -> None:
        """Write OUT/summary.csv, OUT/flight.geojson and the last parts of the data of the page. Raises OutputError."""
        self._rows.flush()
        self._details.flush()
        self._summary.write(self.out / SUMMARY_FILE)
        self._map.write(self.out)

    @property
    def files(self) -> list[str]:
        """Names of the data files that the page needs, relative to the output folder."""
        return [*self._rows.files, *self._details.files]

    def in_page(self) -> dict[str, Any]:
        """Return the data in the page, after `write`. The script of the page declares their types."""
        return {
            "captures": self.statuses.total(),
            "shift_step_px": _SHIFT_STEP_PX,
            "min_share_over_1_px": MIN_SHARE_OVER_1_PX,
            "error_full_px": ERROR_FULL_PX,
            "index_picture_px": PICTURE_PX,
            "index_colours": INDEX_COLOURS,
            "index_greys": INDEX_GREYS,
            "rows": self._rows.first,
            "details": self._details.first,
            "details_per_part": _DETAILS_PER_PART,
            "row_files": self._rows.files,
            "detail_files": self._details.files,
        }

    def json_lines(self) -> Iterator[str]:
        """Yield the lines of a JSON object of the schema `agalign-report/1` with the details of all captures."""
        yield f'{{"schema": "agalign-report/1", "shift_step_px": {_SHIFT_STEP_PX}, "captures": ['
        for key, end in (("records", '], "lattices": ['), ("lattices", "]}")):
            before = ""
            for part in self._details.parts():
                for record in part[key]:
                    yield before + json.dumps(record, allow_nan=False)
                    before = ","
            yield end

    def _pair(self, band: BandResult, sidecar: Sidecar, keys: dict[str, Any], checks: Sequence[str]) -> dict[str, Any]:
        """The data of a band. Its row, with `keys`, and its offset are added: for the reference only a row, if there is
        something to check.
        """
        row = row_of(band)
        if band.status != "reference" or checks:
            std_percent = None if sidecar.output is None else rounded(sidecar.output.std_percent(band.band))
            self._summary.add(keys | row | {"radiometry_std_percent": std_percent, "check": "; ".join(checks)})
        metrics, windows = band.metrics, None if band.metrics is None else band.metrics.windows
        similarity = {name: (row[f"{name}_before"], row[f"{name}_after"]) for name in SIMILARITY}
        centres_px = np.empty((0, 2)) if windows is None else windows.centres_px
        shifts_px = np.empty((0, 2)) if windows is None else windows.shifts_px
        lattice = np.round(centres_px, 2).tobytes()
        offset_px, offset_length_px = _band_offset(band.grid, sidecar)
        if offset_length_px is not None and band.status != "reference":
            self.pairs.bands[band.band].offsets_px.append(offset_length_px)
        steps = (shifts_px / _SHIFT_STEP_PX).ravel().tolist()
        return {name: row[name] for name in SHOWN_COLUMNS} | {
            "seconds": round(band.seconds, 2),
            "written": band.place is not None,
            "offset_px": offset_px,
            "offset_length_px": offset_length_px,
            **_errors(band.error),
            "usable": band.is_usable(sidecar.accept_predicted_px),
            "over_1_px": band.share_over_1_px,
            "coverage": row["residual_coverage"],
            "similarity": None if metrics is None else similarity,
            "prediction": _prediction(band.prediction),
            "geometry": None if band.geometry is None else band.geometry.model_dump(mode="json"),
            "occluded": value_at(band, "relief.occluded"),
            "check": [text for text in checks if text != band.reason],
            "lattice": self._first_lattice + self._lattices.setdefault(lattice, len(self._lattices)),
            "shifts": [round(step) if math.isfinite(step) else None for step in steps],
        }


def _of_capture(folder: Path, label: str, sidecar: Sidecar) -> dict[str, Any]:
    """The data of a capture without those of its bands and indices."""
    output, position = sidecar.output, sidecar.position
    grid = output or OutputPart(file=None, crop=(0, 0, *sidecar.reference.size_px), nodata=None)
    files = {part.kind: part.file for part in sidecar.products}
    relief = next((b.relief.file for b in sidecar.bands if b.relief is not None), None)
    return {
        "label": label,
        "captured_at": sidecar.captured_at,
        "camera": sidecar.camera.name or "unknown camera",
        "status": sidecar.status,
        "shown": "ok_by_prediction" if is_by_prediction(sidecar) else sidecar.status,
        "position": None if position is None else (position.latitude, position.longitude),
        "altitude_m": None if position is None else position.altitude_m,
        "missing": [(name, reason) for name, status, reason in sidecar.pairs if status == "missing"],
        "reference": sidecar.reference.band,
        "seconds": sidecar.seconds,
        "crop": grid.crop,
        "scale": grid.scale,
        "radiometry": _radiometry(grid),
        "stack": _link(folder, files.get("stack")),
        "relief": _link(folder, relief),
        "sidecar": _link(folder, f"{sidecar.capture}.json"),
        "picture": _link(folder, files.get("picture")),
        "preview": _preview(sidecar, folder),
        "residual_px": rounded(sidecar.largest_residual("residual_px")),
        **_errors(largest_error(sidecar)),
    }


def _errors(error: ErrorPart | None) -> dict[str, Any]:
    """An expected error in px of the reference, and in px of the band if these differ."""
    std_px, other_px = (None, None) if error is None else (error.std_px, error.other_px)
    return {"error_px": rounded(std_px), "error_band_px": rounded(other_px)}


def _radiometry(output: OutputPart) -> str | None:
    """The conversion of the raw numbers, with the largest expected error of a band."""
    errors = [part.std_percent for part in output.band_radiometry if math.isfinite(part.std_percent)]
    return f"{output.radiometry}, expected error up to {max(errors):.0f} %" if errors else output.radiometry


def _map_row(facts: dict[str, Any]) -> dict[str, Any]:
    """The row of a capture in the table of the page, and its dot on the map."""
    moving = [b for b in facts["bands"] if b["status"] != "reference"]
    same = "label", "captured_at", "camera", "status", "shown", "position", "altitude_m", "missing", "seconds", "stack"
    return {name: facts[name] for name in (*same, "error_px", "error_band_px")} | {
        "bands": [(b["band"], b["status"]) for b in moving],
        "residual_px": facts["residual_px"],
        "indices": {i["name"]: i["median"] for i in facts["indices"]},
        "raw": any(i["raw"] for i in facts["indices"]),
        "check": bool(facts["missing"] or facts["unwritten"]) or any(b["check"] or b["reason"] for b in facts["bands"]),
    }


def _preview(sidecar: Sidecar, folder: Path) -> dict[str, Any] | None:
    if sidecar.preview is None:
        return None
    detail, rows = [round(v, 5) for v in sidecar.preview.detail], sidecar.preview.rows
    return sidecar.preview.model_dump() | {"file": _link(folder, sidecar.preview.file), "detail": detail, "rows": rows}


def _link(folder: Path, name: str | None) -> str | None:
    return None if name is None else quote((folder / name).as_posix())


def _prediction(prediction: Prediction | None) -> dict[str, Any] | None:
    if prediction is None:
        return None
    std_px, off_px = rounded(prediction.std_px), rounded(prediction.off_px)
    return {"from": prediction.source, "std_px": std_px, "off_px": off_px}


def _band_offset(grid: GridPart | None, sidecar: Sidecar) -> tuple[tuple[float, float] | None, float | None]:
    """(offset (x, y) of a band's raw file in the centre of the reference, median length of the offset), px.

    None if the scales of the two files differ by 10 % or more.
    """
    if grid is None or not len(grid.reference_px):
        return None, None
    reference_px, moving_px = grid.reference_px, grid.moving_px
    offsets, span_px = moving_px - reference_px, reference_px.max(axis=0) - reference_px.min(axis=0)
    if not (np.abs(moving_px.max(axis=0) - moving_px.min(axis=0) - span_px) < 0.1 * span_px).all():
        return None, None
    centre = (np.array(sidecar.reference.size_px) - 1) / 2
    dx, dy = offsets[np.linalg.norm(reference_px - centre, axis=1).argmin()].tolist()
    return (round(dx, 3), round(dy, 3)), round(median(np.linalg.norm(offsets, axis=1).tolist()), 3)


def largest_error(sidecar: Sidecar) -> ErrorPart | None:
    """Return the largest expected error of the moving bands of a capture that indices can use, by px of the reference;
    None if none is known.
    """
    errors = (b.error for b in sidecar.usable if b.error is not None)
    return max(errors, key=attrgetter("std_px"), default=None)


def is_by_prediction(sidecar: Sidecar) -> bool:
    """Return True for a capture that is `ok`, but with a predicted band, which its own image did not confirm."""
    return sidecar.status == "ok" and any(b.status == "predicted" for b in sidecar.bands)


def unwritten_indices(sidecar: Sidecar, folder: Path, reports: Sequence[IndexReport]) -> Iterator[tuple[str, str]]:
    """Yield (name, reason) of the indices without a raster: those that the last rendering of the capture requested, and
    those that `agalign indices` could not write, given the folder of the sidecar and the reports of the capture.
    """
    problems = {report.index: report.problem for report in reports if report.path is None}
    written = {report.index for report in reports} - problems.keys()
    requested = sidecar.write_options.get("indices", [])
    for name in dict.fromkeys([*map(str, requested), *problems]):
        if name not in written:
            before = f"when it was last calculated: {problems[name]}" if name in problems else _NO_RASTER
            yield name, _reason(name, sidecar, folder) or before


def _reason(name: str, sidecar: Sidecar, folder: Path) -> str:
    """Why an index cannot be calculated now; empty if it can, or if its formula is not known."""
    try:
        # The page may be opened elsewhere: files are relative to their capture.
        return reason_not_written(index_named(name), sidecar, folder).replace(f"{folder}{os.sep}", "")
    except ConfigurationError:  # a formula, or an index of another version
        return ""
