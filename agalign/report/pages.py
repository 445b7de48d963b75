"""The views of the sidecars of a folder: index.html, summary.csv, indices.csv and flight.geojson."""

import base64
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup

from agalign._version import __version__
from agalign.config import Settings
from agalign.errors import SidecarError
from agalign.host.files import PANELS_FILE, REPORT_FILE, SKY_FILE, SUMMARY_FILE, write_text
from agalign.host.own_files import refuse_foreign_pages
from agalign.host.text import counted, escape_controls
from agalign.records.captures import RunCapture
from agalign.records.cautions import RunFacts
from agalign.records.panels_and_sky import PanelPart, SkyPart, exclusions, read_panels, read_sky
from agalign.records.run_record import RunPart, counted_sidecars, read_run_record, unfinished_run
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import find_sidecars, label_of, place_problem, read_sidecar
from agalign.report.charts import drifts_of, rig_views
from agalign.report.facts import FlightFacts
from agalign.report.page_data import data_files_exist, printable, remove_other_data_files
from agalign.report.pair_totals import PairTotals
from agalign.report.terms import DOC_PAGES, TERMS
from agalign.spectral_indices.indices_csv import current_rows, merged, reports_of, update_table
from agalign.spectral_indices.rasters import IndexReport

T = TypeVar("T")
_MAX_LISTED = 100
"""Entries of a list in the page; OUT/summary.csv and OUT/agalign-run.json have all."""
_MAX_EXCLUDED = 20
"""Captures of panels, and of the sky, with a table in the page; OUT/panels.json and OUT/sky.json have all."""

SCRIPTS = (
    "data.js",
    "elements.js",
    "texts.js",
    "colours.js",
    "table.js",
    "map.js",
    "capture.js",
    "viewer.js",
    "navigation.js",
    "sheet.js",
    "overlays.js",
    "painting.js",
    "start.js",
)
"""The files of the script of the page, in their order."""


def write_pages(out: Path, on_problem: Callable[[str], object]) -> FlightFacts:
    """Write OUT/index.html with OUT/report-data, OUT/summary.csv, OUT/indices.csv and OUT/flight.geojson from all
    sidecars below OUT, and return their data.

    Unreadable files are reported to `on_problem` and left out; the pages then count as outdated in `pages_exist`.
    Raises OutputError, and ConfigurationError for a file with the name of a page that no command has written.
    """
    refuse_foreign_pages(out, "rename it")
    unreadable: list[str] = []
    facts = _captures(out, unreadable.append)

    def readable(read: Callable[[Path], T]) -> T | None:
        try:
            return read(out)
        except SidecarError as error:
            unreadable.append(str(error))
            return None

    panels, sky, run = readable(read_panels) or [], readable(read_sky) or [], readable(read_run_record)
    excluded: list[PanelPart | SkyPart] = [*(one for one in panels if one.is_left_out), *sky]
    for one in excluded:
        facts.add_excluded(one)
    unfinished = unfinished_run(run, excluded, facts.seconds)
    facts.add_without_result([] if unfinished is None else unfinished.missing)
    facts.write()
    page = _page(
        flight=facts,
        facts=facts.in_page(),
        run=run,
        unfinished="" if unfinished is None else unfinished.sentence,
        notes=[] if run is None else run.notes_on_input(),
        settings=_changed_settings(run),
        rigs=rig_views(out, unreadable.append),
        drifts=drifts_of(facts.cameras),
        panels=panels,
        sky=sky,
        exclusions=exclusions(excluded),
    )
    write_text(out / REPORT_FILE, page)
    remove_other_data_files(out, facts.files)
    if unreadable:
        outdate_pages(out)
    for text in unreadable:
        on_problem(text)
    return facts


def _captures(
    out: Path, on_problem: Callable[[str], object], table: Sequence[IndexReport] | None = None
) -> FlightFacts:
    """Return the data of all captures with a sidecar below OUT, and write OUT/indices.csv.

    All captures have to be read before it is known that the table leaves out rasters that are not masked like most:
    if it does, they are read again, with the rows of the `table`.
    """
    facts, rows_of = FlightFacts(out), defaultdict[str, list[IndexReport]](list)
    for row in current_rows(out) if table is None else table:
        # An index that could not be calculated has no raster, whose removal would remove the row.
        if row.path is not None or (out / f"{row.capture}.json").is_file():
            rows_of[row.capture].append(row)
    for capture in _results(out, on_problem):
        label, listed = capture.label, capture.listed
        # The report needs no stacks: these may be deleted.
        problems = {file: problem for file in listed.parts if file.exists() and (problem := listed.problem(file))}
        for problem in problems.values():
            on_problem(problem)
        sidecar = _without(capture.result, capture.path.parent, problems)
        rows = [row for row in rows_of[label] if row.path not in problems]
        if table is None:
            rows = merged(rows, reports_of(sidecar, label, out, facts.pairs.run))
        rows_of[label] = rows
        facts.add(label, sidecar, rows)
    if table is None:
        all_rows = [row for rows in rows_of.values() for row in rows]
        table = update_table(out, all_rows, earlier=[])
        if table != all_rows:
            return _captures(out, lambda _: None, table)
    return facts


def _results(out: Path, on_problem: Callable[[str], object]) -> Iterator[RunCapture]:
    """Yield the captures that the pages show, with their complete sidecars. Sidecars that cannot be read, or are at the
    place of another capture, are reported to `on_problem`.

    Edited ones count: their checksums take three times as long as reading them, and `agalign verify` finds them.
    """
    for path, states in counted_sidecars(find_sidecars(out), out).items():
        try:
            sidecar = read_sidecar(path)
        except SidecarError as error:
            on_problem(str(error))
            continue
        if problem := place_problem(path, sidecar):
            on_problem(f"{path}: {problem}")
        else:
            yield RunCapture(label_of(path, out), path, sidecar, states)


def pair_totals(out: Path) -> PairTotals:
    """Return the band pairs in the pages of an output folder, without writing these."""
    pairs = PairTotals(RunFacts.of(out))
    for capture in _results(out, lambda _: None):
        pairs.add(escape_controls(capture.label), capture.result)
    return pairs


def _without(sidecar: Sidecar, folder: Path, changed: Collection[Path]) -> Sidecar:
    """Return a sidecar without files that are not as they were written, given its folder."""
    products = [part for part in sidecar.products if folder / part.file not in changed]
    preview = sidecar.preview
    is_changed = preview is not None and folder / preview.file in changed
    return sidecar.model_copy(update={"products": products, "preview": None if is_changed else preview})


def outdate_pages(out: Path) -> None:
    """Make `pages_exist` return False for the pages of an earlier run."""
    with suppress(OSError):
        os.utime(out / REPORT_FILE, (0, 0))


def pages_exist(out: Path) -> bool:
    """Return True if report and summary of an earlier run exist and are newer than all files that they describe. Tables
    and maps that not every run has are not looked for.
    """
    try:
        written = min((out / name).stat().st_mtime_ns for name in (REPORT_FILE, SUMMARY_FILE))
        entries = [*find_sidecars(out), *(out / f for f in (PANELS_FILE, SKY_FILE) if (out / f).exists())]
        is_newer = all(path.stat().st_mtime_ns < written for path in entries)
        return is_newer and data_files_exist(out / REPORT_FILE)
    except (OSError, UnicodeDecodeError):
        return False


def _page(**values: Any) -> str:
    """The page of the template, which gets these values and those of every page."""
    files = resources.files(__package__) / "page"
    style = (files / "page.css").read_text("utf-8")
    script = "".join((files / name).read_text("utf-8") for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    of_every_page = {
        "version": __version__,
        "median": median,
        "counted": counted,
        "terms": TERMS,
        "pages": DOC_PAGES,
        "max_listed": _MAX_LISTED,
        "max_excluded": _MAX_EXCLUDED,
    }
    return _template().render(style=style, script=script, script_hash=digest, **of_every_page, **values)


def _template() -> Template:
    """The template of the page."""
    environment = Environment(
        loader=PackageLoader(__package__, "page"),
        autoescape=select_autoescape(["j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        # What is not markup comes from files.
        finalize=lambda value: value if isinstance(value, Markup) else printable(value),
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "ensure_ascii": False, "allow_nan": False}
    return environment.get_template("page.html.j2")


def _changed_settings(run: RunPart | None) -> list[tuple[str, str]]:
    """(Python name, value) of the settings of a run that differ from the defaults."""
    if run is None:
        return []
    defaults = Settings().model_dump(mode="json")
    return [
        (f"{stage}.{name}", json.dumps(value, ensure_ascii=False))
        for stage, values in run.settings.items()
        if isinstance(values, dict)
        for name, value in values.items()
        if value != defaults.get(stage, {}).get(name) and (stage, name) != ("flight", "start_model")
    ]
