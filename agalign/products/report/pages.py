"""The views of the sidecars of a folder: index.html, summary.csv, indices.csv and flight.geojson."""

import base64
import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from importlib import resources
from pathlib import Path
from statistics import median
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from agalign._version import __version__
from agalign.config import Settings
from agalign.errors import SidecarError
from agalign.products.indices.rasters import IndexReport, reports_of, update_table
from agalign.products.report.charts import drifts_of, rig_views
from agalign.products.report.facts import BAND_COLUMNS, FlightFacts
from agalign.products.run.excluded import PANELS_FILE, SKY_FILE, PanelPart, SkyPart, read_excluded
from agalign.products.run.flight_map import FlightMap
from agalign.products.run.record import RunPart, read_run_record
from agalign.products.sidecar.file import find_sidecars, read_sidecar
from agalign.values.files import write_csv, write_text

SUMMARY_COLUMNS = ("folder", "capture", *BAND_COLUMNS, "reference")
REPORT_FILE, SUMMARY_FILE = "index.html", "summary.csv"


def write_pages(out: Path, on_problem: Callable[[str], None]) -> FlightFacts:
    """Write OUT/index.html, OUT/summary.csv, OUT/indices.csv and OUT/flight.geojson from all sidecars below OUT, and
    return their data.

    Unreadable files are reported to `on_problem` and left out; the pages then count as outdated in `pages_exist`.
    Raises OutputError.
    """
    indices: list[IndexReport] = []
    unreadable: list[str] = []
    facts, flight_map = FlightFacts(), FlightMap()
    for path in find_sidecars(out):
        folder = path.parent.relative_to(out).as_posix()
        try:
            sidecar = read_sidecar(path)
        except SidecarError as error:
            unreadable.append(str(error))
            continue
        indices += reports_of(sidecar, folder, out)
        facts.add(folder, sidecar)
        flight_map.add(folder, sidecar)
    panels: list[PanelPart] = []
    sky: list[SkyPart] = []
    run: RunPart | None = None
    try:
        (panels, sky), run = read_excluded(out), read_run_record(out)
    except SidecarError as error:
        unreadable.append(str(error))
    not_aligned = [("panel", part) for part in panels if not part.in_scene] + [("sky", part) for part in sky]
    for status, part in not_aligned:
        of_capture = {"folder": part.folder, "capture": part.capture, "status": status, "reason": part.sentence}
        facts.rows += [of_capture | {"band": band.band} for band in part.bands]
    write_csv(out / SUMMARY_FILE, SUMMARY_COLUMNS, ([row.get(name) for name in SUMMARY_COLUMNS] for row in facts.rows))
    rows = update_table(out, indices)
    facts.add_indices(rows, out)
    for excluded in [] if run is None else run.excluded:
        flight_map.add_excluded(excluded)
    flight_map.add_indices(rows, out)
    flight_map.write(out)
    page = _page(
        version=__version__,
        median=median,
        flight=facts,
        facts=facts.as_json(),
        run=run,
        settings=_changed_settings(run),
        rigs=rig_views(out, unreadable.append),
        drifts=drifts_of(facts.captures),
        panels=panels,
        sky=sky,
    )
    write_text(out / REPORT_FILE, page)
    if unreadable:
        with suppress(OSError):
            os.utime(out / REPORT_FILE, (0, 0))
    for text in unreadable:
        on_problem(text)
    return facts


def pages_exist(out: Path) -> bool:
    """Return True if the pages of an earlier run are complete and newer than all files that they describe."""
    try:
        written = min((out / name).stat().st_mtime_ns for name in (REPORT_FILE, SUMMARY_FILE))
        entries = [*find_sidecars(out), *(out / f for f in (PANELS_FILE, SKY_FILE) if (out / f).exists())]
        return all(path.stat().st_mtime_ns < written for path in entries)
    except OSError:
        return False


def _page(**values: Any) -> str:
    """The page of the template, which gets these values."""
    environment = Environment(
        loader=PackageLoader(__package__, "."),
        autoescape=select_autoescape(["j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "ensure_ascii": False, "allow_nan": False}
    style, script = (resources.files(__package__).joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    template = environment.get_template("page.html.j2")
    return template.render(style=style, script=script, script_hash=digest, **values)


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
