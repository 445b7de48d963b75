"""The command `agalign indices` (alias `ndvi`): spectral indices of aligned captures."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agalign.cli.align import Dask, Jobs
from agalign.cli.terminal import (
    EXIT_NOTHING,
    EXIT_OK,
    EXIT_PARTIAL,
    RAW_NUMBERS,
    LogJson,
    Quiet,
    Terminal,
    Verbose,
    examples,
    exits,
    of_output,
    of_running,
    shown,
)

if TYPE_CHECKING:
    from rich.table import Table

    from agalign.products.index_table import IndexReport
    from agalign.products.indices import Index

_EXAMPLES = examples(
    ("agalign indices aligned/", "NDVI of every capture, next to its stack"),
    ("agalign indices aligned/ --index ndvi,ndre,savi -o indices/", "three indices, into another folder"),
    ("agalign indices aligned/ --formula 'mine=(N-RE)/(N+RE)'", "a formula of the bands B, G, R, RE and N"),
)
_INTERRUPTED = "interrupted; written indices are kept, and the same command resumes the run"


def register(app: typer.Typer) -> None:
    """Add the command and its alias to the application."""
    app.command("indices", epilog=_EXAMPLES)(indices)
    app.command("ndvi", epilog=_EXAMPLES, hidden=True)(indices)


def indices(
    out: Annotated[Path, typer.Argument(help="Output folder of a run.", show_default=False)],
    index: Annotated[
        str | None,
        of_output(
            "--index", "-i", show_default=False,
            help="Names separated by commas: ndvi (the default), ndre, gndvi, ndwi, savi, evi …",
        ),
    ] = None,
    formula: Annotated[
        list[str] | None,
        of_output(
            show_default=False, help="A formula of the bands B, G, R, RE and N, as 'name=(N-R)/(N+R)'; repeatable."
        ),
    ] = None,
    target: Annotated[
        Path | None,
        of_output("-o", "--out", help="Folder for the rasters; by default next to the stacks.", show_default=False),
    ] = None,
    mask_qa: Annotated[
        bool,
        of_output("--mask-qa", help="Omit saturated, occluded and glint pixels; the run needs --qa."),
    ] = False,
    jobs: Jobs = 0,
    dask: Dask = None,
    overwrite: Annotated[
        bool, of_running("--overwrite", help="Compute again what an earlier command wrote.")
    ] = False,
    as_json: Annotated[bool, of_running("--json", help="Print JSON to standard output.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:  # fmt: skip
    """Compute spectral indices of aligned captures: rasters, pictures and a table of statistics."""
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal, _INTERRUPTED):
        from agalign.batch.index_run import IndexOptions, index_tasks, run_indices, unit_of_run
        from agalign.batch.output_folder import locked
        from agalign.products.index_bands import RAW
        from agalign.products.index_table import INDICES_FILE

        chosen = chosen_indices(index, formula or [])
        folder = target or out
        tasks = index_tasks(out, chosen, folder, overwrite=overwrite, mask_qa=mask_qa)
        terminal.event("found", captures=len(tasks), indices=len(chosen))
        announced = unit_of_run(tasks) == RAW
        if announced:
            terminal.problem(RAW_NUMBERS)
        with locked(folder), _cluster(dask, jobs) as executor, _progress(terminal, len(tasks)) as show:
            reports: list[IndexReport] = []
            for done in run_indices(tasks, IndexOptions(overwrite, jobs, executor)):
                terminal.check()
                reports += done.reports
                for report in done.reports:
                    _print(report, terminal)
                show(done.reports[0].capture)
            if target is None:
                _rebuild_report(out, terminal)
        written = [r for r in reports if r.path is not None]
        if any(r.raw_numbers for r in written) and not announced:
            terminal.problem(RAW_NUMBERS)
        if as_json:
            typer.echo(json.dumps({"folder": str(folder), "indices": [_facts(r) for r in reports]}, indent=1))
        elif written:
            terminal.result(_table([one.name for one in chosen], reports))
            terminal.result(shown(f"Statistics: {folder / INDICES_FILE}"))
        raise typer.Exit(EXIT_NOTHING if not written else EXIT_OK if len(written) == len(reports) else EXIT_PARTIAL)


def chosen_indices(names: str | None, formulas: Sequence[str]) -> "list[Index]":
    """Return the indices of a list of names and of formulas; ndvi if neither is given. Raises ConfigurationError."""
    from agalign.errors import ConfigurationError
    from agalign.products.indices import index_named, index_of_formula

    requested = (names or ("" if formulas else "ndvi")).split(",")
    chosen = [index_named(name) for name in requested if name.strip()] + [index_of_formula(f) for f in formulas]
    repeated = [one.name for i, one in enumerate(chosen) if one.name in [c.name for c in chosen[:i]]]
    if repeated or not chosen:
        problem = f"'{repeated[0]}' is given twice" if repeated else "--index is empty"
        raise ConfigurationError(f"{problem}; give names such as ndvi,ndre, or formulas as 'name=(N-R)/(N+R)'")
    return chosen


def _cluster(dask: str | None, jobs: int) -> Any:
    if dask is None:
        return nullcontext()
    from agalign.batch.workers import dask_executor

    return dask_executor(dask, jobs)


def _print(report: "IndexReport", terminal: Terminal) -> None:
    if report.problem:
        terminal.problem(f"{report.capture}: {report.problem}", capture=report.capture, index=report.index)
        return
    kept = ", kept" if report.kept else ""
    text = f"{report.capture} {report.index}: median {report.median:.3f}{kept}"
    terminal.event("index", text if terminal.verbose else "", **_facts(report))


def _facts(report: "IndexReport") -> dict[str, Any]:
    """Return a report as a JSON object; unknown values are null."""
    return {
        "capture": report.capture, "index": report.index, "path": None if report.path is None else str(report.path),
        **report.statistics.as_json(), "raw_numbers": report.raw_numbers, "kept": report.kept,
        "problem": report.problem or None,
    }  # fmt: skip


def _rebuild_report(out: Path, terminal: Terminal) -> None:
    """Rebuild the report of the run, which shows the indices, if there is one."""
    from agalign.products.report import REPORT_FILE, write_pages

    if (out / REPORT_FILE).is_file():
        write_pages(out, terminal.problem)


@contextmanager
def _progress(terminal: Terminal, captures: int) -> Iterator[Callable[[str], None]]:
    """Show a progress line on a terminal; yield the function that advances it by one capture."""
    if terminal.quiet or terminal.log_json or not terminal.err.is_terminal:
        yield lambda _: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        BarColumn(bar_width=20), MofNCompleteColumn(), TextColumn("captures"), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.description}"),
    )  # fmt: skip
    with Progress(*columns, console=terminal.err, transient=True) as progress:
        task = progress.add_task("", total=captures)
        yield lambda label: progress.update(task, advance=1, description=shown(label))


def _table(names: Sequence[str], reports: "Sequence[IndexReport]") -> "Table":
    """Return a table with a row per index: statistics of the medians of its captures."""
    from statistics import median

    from rich.table import Table

    written = [r for r in reports if r.path is not None]
    table = Table("Index", title=f"{len(written)} of {len(reports)} written; medians of captures")
    for name in ("Captures", "Median", "Lowest", "Highest"):
        table.add_column(name, justify="right")
    for name in names:
        values = [r.median for r in written if r.index == name and math.isfinite(r.median)]
        if values:
            table.add_row(name, str(len(values)), *(f"{v:.3f}" for v in (median(values), min(values), max(values))))
    return table
