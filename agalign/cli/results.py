"""The commands that use the output folder of a run: `report`, `verify`, `export` and `indices`."""

import heapq
import math
from collections.abc import Collection, Sequence
from contextlib import closing
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agalign.cli.command import Command, Given
from agalign.cli.terminal import MAX_LISTED, RAW_NUMBERS, ExitCode, Terminal, explain, progress
from agalign.host.files import INDICES_FILE, REPORT_FILE, SUMMARY_FILE
from agalign.host.text import counted
from agalign.values.choices import ExportProgram

if TYPE_CHECKING:
    from agalign.batch.index_run import IndexTask
    from agalign.spectral_indices.rasters import IndexReport

Out = Annotated[Path, typer.Argument(help="Output folder of a run.")]
Json = Annotated[bool, typer.Option("--json")]


def _report(terminal: Terminal, out: Annotated[Path, typer.Argument()], as_json: Json = False) -> int:
    """Rebuild the report and the summary from the sidecars.

    Options:
        out: Output folder of an earlier run.
        as_json: Print the content of the report as JSON; keys may change.
    """
    from agalign.host.output_folder import locked
    from agalign.records.sidecar_file import run_sidecars
    from agalign.report.pages import write_pages

    run_sidecars(out)
    unreadable: list[str] = []
    with locked(out):
        facts = write_pages(out, unreadable.append)
    for text in unreadable:
        terminal.problem(text)
    is_unfinished = _print_unfinished(out, facts.seconds, terminal)
    if as_json:
        for line in facts.json_lines():
            typer.echo(line)
    else:
        explain(facts.groups(), terminal)
        slowest = heapq.nlargest(5, facts.seconds.items(), key=itemgetter(1))
        terminal.table(("Slowest", "Seconds"), [(label, f"{seconds:.1f}") for label, seconds in slowest])
        for name in (REPORT_FILE, SUMMARY_FILE):
            terminal.result(str(out / name))
    return ExitCode.PARTIAL if unreadable or is_unfinished else ExitCode.OK


def _print_unfinished(out: Path, labels: Collection[str], terminal: Terminal) -> bool:
    """Print what the last run into a folder did not do, given the labels of the captures with a result, and which of
    them are not in its input; return True if it did not do all.
    """
    from agalign.errors import SidecarError
    from agalign.records.panels_and_sky import read_panels, read_sky
    from agalign.records.run_record import read_run_record, unfinished_run

    try:
        excluded, record = [*read_panels(out), *read_sky(out)], read_run_record(out)
        unfinished = unfinished_run(record, excluded, labels)
    except SidecarError as error:
        terminal.problem(str(error))
        return True
    for line in [] if record is None else record.notes_on_input():
        terminal.problem(f"{out}: {line}")
    if unfinished is None or not unfinished.sentence:
        return False
    facts = {"state": unfinished.state, "missing": unfinished.missing, "erroneous": unfinished.erroneous}
    terminal.problem(f"{out}: {unfinished.sentence}", **facts, kept=unfinished.kept)
    return True


def _verify(terminal: Terminal, out: Out) -> int:
    """Compare the files of a run with their checksums.

    Compares each sidecar and the files that it lists (rasters, pictures, tie points), and prints those that are missing
    or have changed; the exit code is then 3. Tables, report, models and input images are not compared.
    """
    from agalign.records.run_record import counted_sidecars
    from agalign.records.sidecar_file import label_of, run_sidecars, verify_outputs

    labels, damaged = [], 0
    for path, problems in verify_outputs(out, counted_sidecars(run_sidecars(out), out)):
        labels.append(label_of(path, out))
        damaged += bool(problems)
        for text in problems:
            terminal.problem(text)
    is_unfinished = _print_unfinished(out, set(labels), terminal)
    match = "matches its" if len(labels) == 1 else "match their"
    terminal.result(f"{len(labels) - damaged} of {counted(len(labels), 'capture')} {match} checksums")
    return ExitCode.PARTIAL if damaged or is_unfinished else ExitCode.OK


def _export(
    terminal: Terminal,
    out: Out,
    program: Annotated[ExportProgram, typer.Option("--for")],
    target: Annotated[Path | None, typer.Option("-o", "--out")] = None,
    copy: bool = False,
) -> int:
    """Export aligned captures for photogrammetry programs.

    Options:
        program: Program that reads the files; odm is OpenDroneMap.
        target: Output folder; by default OUT with the program's name added.
        copy: Copy the band files instead of creating hard links.

    Examples:
        agalign export aligned/ --for odm  band files in one folder, and the options for OpenDroneMap
    """
    from agalign.exports.programs import export as run_export
    from agalign.records.sidecar_file import label_of, run_sidecars

    run_folder = out.resolve()
    folder = target or run_folder.parent / f"{run_folder.name}-{program}"
    report = run_export(out, folder, program, copy=copy)
    _print_left_out(report.left_out, terminal)
    labels = {label_of(path, out) for path in run_sidecars(out)}
    is_unfinished = _print_unfinished(out, labels, terminal)
    for line in report.notes:
        terminal.result(line)
    terminal.event("export", captures=report.captures, files=len(report.files), folder=str(folder))
    terminal.result(f"{counted(report.captures, 'capture')}, {counted(len(report.files), 'file')} in {folder}")
    return ExitCode.PARTIAL if report.left_out or is_unfinished else ExitCode.OK


def _print_left_out(left_out: Sequence[tuple[str, str]], terminal: Terminal) -> None:
    """Print the captures that a result omits, from (capture, reason)."""
    for label, reason in left_out[:MAX_LISTED]:
        terminal.problem(f"{label}: left out: {reason}", capture=label)
    if len(left_out) > MAX_LISTED:
        terminal.problem(f"left out: {counted(len(left_out) - MAX_LISTED, 'more capture')}")


report = Command(_report)
verify = Command(_verify)
export = Command(_export, {"Output": "program target copy", "Running": "quiet log_json"})


def _indices(
    terminal: Terminal,
    given: Given,
    out: Out,
    index: Annotated[str | None, typer.Option("--index", "-i")] = None,
    formula: list[str] | None = None,
    target: Annotated[Path | None, typer.Option("-o", "--out")] = None,
    mask_qa: bool = False,
    as_json: Json = False,
) -> int:
    """Compute spectral indices of aligned captures: rasters, pictures and a table of statistics.

    Options:
        index: Names separated by commas: ndvi (by default, without --formula), ndre, savi …
        formula: A formula of the bands B, G, R, RE and N, such as 'name=(N-R)/(N+R)'; repeatable.
        target: Folder for the rasters; by default next to the stacks.
        mask_qa: Omit saturated, occluded and misaligned pixels, also of finished indices; the run needs --qa.
        as_json: Print JSON to standard output.
        overwrite: Compute finished indices again.
        verbose: Print a line per capture and index.

    Examples:
        agalign indices aligned/  NDVI of every capture, next to its stack
        agalign indices aligned/ --index ndvi,ndre,savi -o indices/  three indices, into another folder
    """
    from agalign.batch.index_run import index_tasks
    from agalign.config import names_in
    from agalign.spectral_indices.formulas import chosen_indices

    folder, run = target or out, given["run"]
    chosen = chosen_indices(names_in(index) if index else None, formula or [])
    tasks = index_tasks(out, chosen, folder, overwrite=run["overwrite"], mask_qa=mask_qa)
    terminal.event("found", captures=len(tasks), indices=len(chosen))
    reports, problems = _run_indices(tasks, folder, terminal, run["jobs"], run["executor"])
    is_unfinished = _print_unfinished(out, {task.label for task in tasks}, terminal)
    for problem in problems:
        terminal.problem(problem)
    written = [r for r in reports if r.path is not None]
    if as_json:
        terminal.facts({"folder": str(folder), "indices": [_facts(r) for r in reports]})
    elif written:
        _print_statistics([one.name for one in chosen], reports, terminal)
        if not problems:
            terminal.result(f"Statistics: {folder / INDICES_FILE}")
    is_complete = len(written) == len(reports) and not problems and not is_unfinished
    return ExitCode.NOTHING if not written else ExitCode.OK if is_complete else ExitCode.PARTIAL


def _run_indices(
    tasks: "Sequence[IndexTask]", folder: Path, terminal: Terminal, jobs: int, dask: str | None
) -> "tuple[list[IndexReport], list[str]]":
    """Write indices to a folder, and print them; return their reports, and why captures are missing, or what the table
    or the report lacks.
    """
    from agalign.batch.index_run import run_indices
    from agalign.cli.align_run import cluster
    from agalign.errors import OutputError, WorkerError
    from agalign.host.output_folder import locked

    reports: list[IndexReport] = []
    problems: list[str] = []
    are_raw = False
    with locked(folder), cluster(dask, jobs) as executor, progress(terminal, len(tasks)) as show:
        try:
            with closing(run_indices(tasks, jobs, executor, problems.append)) as results:
                for number, done in enumerate(results, start=1):
                    terminal.check()
                    if not are_raw and (are_raw := any(r.raw_numbers for r in done)):
                        terminal.problem(RAW_NUMBERS)
                    _print_capture(done, terminal)
                    reports += done
                    show(number, done[0].capture, 0)
        except (OutputError, WorkerError) as error:  # the rasters that were reported, and their statistics, exist
            problems.append(str(error))
    return reports, problems


def _print_statistics(names: Sequence[str], reports: "Sequence[IndexReport]", terminal: Terminal) -> None:
    """Print a row per index, statistics of the medians of its captures, and what to check in them."""
    from statistics import median

    from agalign.records.captures import differing_from_most

    written, rows = [r for r in reports if r.path is not None], []
    for name in names:
        of_index = [r for r in written if r.index == name and math.isfinite(r.median)]
        differing = dict(differing_from_most({r.capture: (r.statistics.unit,) for r in of_index}))
        for label, reason in differing.items():
            terminal.problem(f"{label} {name}: not in the medians of captures: {reason}", capture=label)
        values = [r.median for r in of_index if r.capture not in differing]
        if values:
            numbers = (median(values), min(values), max(values))
            masked_share = median(r.statistics.masked_share for r in written if r.index == name)
            rows.append((name, str(len(values)), *(f"{number:.3f}" for number in numbers), f"{masked_share:.1%}"))
    title = f"{len(written)} of {len(reports)} written; medians of captures"
    terminal.table(("Index", "Captures", "Median", "Lowest", "Highest", "Masked"), rows, title, texts=1)
    if masked := sorted({r.capture for r in written if r.statistics.masked_share > 1 / 3}):
        more = f" and {counted(len(masked) - 1, 'more capture')}" if masked[1:] else ""
        terminal.problem(f"--mask-qa leaves out more than a third of {masked[0]}{more}: look at the .qa.tif")
    if doubtful := [r for r in written if r.problem]:
        first = f"{doubtful[0].capture} {doubtful[0].index}: {doubtful[0].problem}"
        rasters = counted(len(doubtful), "raster")
        terminal.problem(f"{rasters} with bands to check (column problem of {INDICES_FILE}), such as {first}")


indices = Command(
    _indices,
    {"Output": "index formula target mask_qa", "Running": "jobs dask overwrite as_json quiet verbose log_json"},
    on_interrupt="interrupted; written indices are kept, and the same command resumes the run",
)


def _print_capture(reports: "Sequence[IndexReport]", terminal: Terminal) -> None:
    """Print the indices of a capture."""
    for report in reports:
        if report.path is None:
            terminal.problem(
                f"{report.capture} {report.index}: {report.problem}", capture=report.capture, index=report.index
            )
            continue
        kept = ", kept" if report.kept else ""
        text = f"{report.capture} {report.index}: median {report.median:.3f}{kept}"
        terminal.event("index", text if terminal.verbose else "", **_facts(report))


def _facts(report: "IndexReport") -> dict[str, Any]:
    """Return a report as a JSON object; unknown values are null."""
    return {
        "capture": report.capture,
        "index": report.index,
        "path": None if report.path is None else str(report.path),
        **report.statistics.as_json(),
        "raw_numbers": report.raw_numbers,
        "kept": report.kept,
        "problem": report.problem or None,
    }
