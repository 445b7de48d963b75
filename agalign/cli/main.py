"""The application: its commands and its entry point."""

import json
import logging
import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, get_args

import typer

from agalign._version import __version__
from agalign.cli import align as cli_align
from agalign.cli import doctor as cli_doctor
from agalign.cli import evaluate as cli_evaluate
from agalign.cli import export as cli_export
from agalign.cli import indices as cli_indices
from agalign.cli import info as cli_info
from agalign.cli.align import Jobs
from agalign.cli.onto import onto
from agalign.cli.root import RootGroup
from agalign.cli.terminal import (
    EXIT_OK,
    EXIT_PARTIAL,
    EXIT_USAGE,
    INTERRUPTED,
    LogJson,
    Quiet,
    RngSeed,
    Terminal,
    Verbose,
    examples,
    exits,
    of_running,
    printed,
    shown,
)
from agalign.values.choices import RadiometryChoice, ReliefUse
from agalign.values.memory_limit import check_address_space

_EXAMPLES = examples(
    ("agalign demo", "align a synthetic flight and compare it with its ground truth"),
    ("agalign info flight/", "list captures, bands and missing files"),
    ("agalign flight/ -o aligned/", "align a flight; 'agalign align --help' lists the options"),
    ("agalign indices aligned/", "compute spectral indices of the aligned captures"),
    ("agalign doctor", "check this machine"),
)
app = typer.Typer(
    cls=RootGroup,
    name="agalign",
    help="Co-register the bands of multispectral drone cameras. 'agalign FOLDER' aligns everything below FOLDER.",
    epilog=_EXAMPLES,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
cli_align.register(app)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(f"agalign {__version__}")
        raise typer.Exit


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(help="Folder to make.")] = Path("agalign-demo"),
    captures: Annotated[int, typer.Option(min=1, max=1000, help="Captures to make.")] = 3,
    jobs: Jobs = 0,
    device: Annotated[str, of_running(help="auto, cpu, cuda, cuda:1 …")] = "auto",
    rng_seed: RngSeed = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Make a synthetic flight, align it, and compare the result with the ground truth."""
    from rich.table import Table

    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal, INTERRUPTED):
        check_address_space()
        from agalign.batch import CaptureReport, RunOptions, prepare_output
        from agalign.cameras.discover import DiscoverOptions
        from agalign.cli.run import conclude, find_captures, run
        from agalign.config import JointSettings, Settings
        from agalign.synthetic.score import make_flight, score_against_truth

        source, target = out / "flight", out / "aligned"
        prepare_output(source)
        terminal.event("make", f"Rendering a synthetic flight: {captures} captures of 5 bands …", captures=captures)
        truth = make_flight(source, captures, rng_seed=rng_seed)
        flight = find_captures(source, DiscoverOptions(), terminal)
        settings = Settings(joint=JointSettings(device=device, rng_seed=rng_seed))
        reports: list[CaptureReport] = []
        options = RunOptions(overwrite=True, jobs=jobs)
        totals = run(flight, target, settings, terminal, options, each=reports.append)
        reports.sort(key=lambda r: r.label)
        table = Table("Capture", "Band", "Status", title="Error relative to the ground truth, px")
        for name in ("before", "median", "p95"):
            table.add_column(name, justify="right")
        for s in score_against_truth(reports, truth):
            table.add_row(s.capture, s.band, s.status, f"{s.before_px:.1f}", f"{s.median_px:.3f}", f"{s.p95_px:.3f}")
        terminal.result(table)
        raise typer.Exit(conclude(totals, target, terminal))


cli_info.register(app)


@app.command()
def report(
    out: Annotated[Path, typer.Argument(help="Output folder of an earlier run.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Print the content of the report as JSON.")] = False,
) -> None:
    """Rebuild the report and the summary from the sidecars."""
    from rich.table import Table

    terminal = Terminal(quiet=False, verbose=False, log_json=False)
    with exits(terminal):
        from agalign.batch.output_folder import locked
        from agalign.cli.failures import explain
        from agalign.errors import InputError
        from agalign.products.report import write_pages
        from agalign.products.sidecar_file import find_sidecars

        if not out.is_dir() or not find_sidecars(out):
            raise InputError(f"{out}: no sidecars there; give the output folder of a run")
        unreadable: list[str] = []
        with locked(out):
            pages = write_pages(out, unreadable.append)
        for text in unreadable:
            terminal.problem(text)
        if as_json:
            typer.echo(json.dumps(pages.facts, indent=1))
            raise typer.Exit(EXIT_PARTIAL if unreadable else EXIT_OK)
        explain(pages.failures, terminal)
        table = Table("Slowest", "Seconds")
        for label, seconds in pages.slowest:
            table.add_row(shown(label), f"{seconds:.1f}")
        terminal.result(table)
        for path in (pages.report, pages.summary):
            terminal.result(shown(str(path)))
        raise typer.Exit(EXIT_PARTIAL if unreadable else EXIT_OK)


@app.command()
def verify(
    out: Annotated[Path, typer.Argument(help="Output folder of a run.", show_default=False)],
) -> None:
    """Compare the files of a run with their checksums."""
    terminal = Terminal(quiet=False, verbose=False, log_json=False)
    with exits(terminal):
        from agalign.products.sidecar_file import verify_outputs

        captures = damaged = 0
        for _, problems in verify_outputs(out):
            captures, damaged = captures + 1, damaged + bool(problems)
            for text in problems:
                terminal.problem(text)
        terminal.result(f"{captures - damaged} of {captures} captures match their checksums")
        raise typer.Exit(EXIT_PARTIAL if damaged else EXIT_OK)


cli_indices.register(app)
cli_export.register(app)
app.command()(onto)
cli_doctor.register(app)
cli_evaluate.register(app)
_COMMANDS = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}


def main() -> None:
    """Run the application; if the first argument is not a command, it is the folder to align."""
    arguments = sys.argv[1:]
    if arguments and not arguments[0]:
        Terminal(quiet=False, verbose=False, log_json=False).problem("the name of the folder is empty")
        raise SystemExit(EXIT_USAGE)
    if arguments and arguments[0] not in _COMMANDS and not _is_root_option(arguments[0]):
        _refuse_files(arguments)
        _refuse_misspelt(arguments[0])
        arguments = ["align", *arguments]
    _rename(arguments, "--local", "--relief")
    _insert_value(arguments, "--relief", get_args(ReliefUse), "always")
    _insert_value(arguments, "--radiometry", get_args(RadiometryChoice), "auto")
    # Threads that spin while they wait slow down other programs on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # The matrices here are small: a second BLAS thread only spins.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.getLogger("rasterio").setLevel(logging.CRITICAL)
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    with printed():
        app(args=arguments, prog_name="agalign")


def _refuse_misspelt(first: str) -> None:
    """Raise SystemExit for a misspelt command, instead of reporting a missing folder."""
    similar = get_close_matches(first, _COMMANDS, 1, cutoff=0.7)
    if similar and not Path(first).exists():
        terminal = Terminal(quiet=False, verbose=False, log_json=False)
        terminal.problem(f"'{first}' is neither a command nor a folder; did you mean '{similar[0]}'?")
        raise SystemExit(EXIT_USAGE)


def _refuse_files(arguments: Sequence[str]) -> None:
    """Raise SystemExit for several files instead of a folder: the shell expands a glob such as flight/*.tif."""
    files = [Path(a) for a in arguments if not a.startswith("-") and Path(a).is_file()]
    if len(files) > 1 and Path(arguments[0]) == files[0]:
        terminal = Terminal(quiet=False, verbose=False, log_json=False)
        terminal.problem(f"{files[0]}, …: give the folder of the images, not the files: agalign {files[0].parent}")
        raise SystemExit(EXIT_USAGE)


def _rename(arguments: list[str], old: str, new: str) -> None:
    """Replace a deprecated option by its successor, with a warning."""
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == old:
            arguments[index] = f"{new}{equals}{value}"
            terminal = Terminal(quiet=False, verbose=False, log_json="--log-json" in arguments)
            terminal.problem(f"{old} is deprecated; use {new}")


def _insert_value(arguments: list[str], option: str, values: Sequence[str], default: str) -> None:
    """Insert the default value of an option that may be given as a flag, without a value."""
    if option in arguments:
        after = arguments.index(option) + 1
        if arguments[after : after + 1] not in [[value] for value in values]:
            arguments.insert(after, default)


def _is_root_option(argument: str) -> bool:
    return argument in ("--help", "-h", "--version", "--install-completion", "--show-completion")


if __name__ == "__main__":
    main()
