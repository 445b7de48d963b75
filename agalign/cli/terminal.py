"""Output of the commands: results, progress, problems, what to check in the results of a run; exit codes; signals."""

import io
import json
import math
import os
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import IntEnum
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agalign.errors import AgalignError, ConfigurationError, is_out_of_memory
from agalign.host.text import escape_controls, some_of

if TYPE_CHECKING:
    from rich.console import Console

    from agalign.report.pair_totals import CautionGroup

MAX_LISTED = 10
"""Maximum number of listed problems of one kind."""
RAW_NUMBERS = (
    "the bands are raw numbers, not reflectance: their indices are not comparable between captures or cameras, and are "
    "far from the indices of reflectance; align with --radiometry auto where the camera's tags allow it"
)


class ExitCode(IntEnum):
    """What a command returns to the shell."""

    OK = 0
    NOTHING = 1
    USAGE = 2
    PARTIAL = 3
    SIGNAL = 128
    """Added to the number of the signal that ended the program, as shells do: 130 for SIGINT, 143 for SIGTERM."""


def command_line() -> str:
    """Return the command line, quoted for a shell."""
    return shlex.join(["agalign", *sys.argv[1:]])


def in_json(value: Any) -> Any:
    """Return a value for JSON; nan and infinity, which JSON lacks, become strings."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _console(**options: Any) -> "Console":
    """A console that ignores a closed pipe (`| head -1`): the run continues without printing."""
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            null_device = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null_device, self.file.fileno())
            os.close(null_device)

    return PipeConsole(markup=False, highlight=False, emoji=False, **options)


class Terminal:
    """Prints results to standard output, progress and problems to standard error; its parameters are options of all
    commands that list them.

    Options:
        quiet: Print problems only.
        verbose: Print a line per band pair.
        log_json: Print one JSON object per line to standard error.
    """

    def __init__(
        self,
        *,
        quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False,
        verbose: Annotated[bool, typer.Option("--verbose", "-v")] = False,
        log_json: bool = False,
    ) -> None:
        self.quiet, self.verbose, self.log_json = quiet, verbose, log_json
        self._stopped_by: int | None = None
        # Lines in a file or a pipe are not wrapped to a terminal's width.
        self.out = _console(width=None if sys.stdout.isatty() else 160)
        self.err = _console(stderr=True, soft_wrap=not sys.stderr.isatty())

    def event(self, kind: str, text: str = "", /, **fields: Any) -> None:
        """Print a line of progress: JSON with the time (UTC) with --log-json, else the text unless --quiet."""
        if self.log_json:
            facts = {"event": kind, "time": datetime.now(UTC).isoformat(timespec="milliseconds")}
            line = json.dumps(facts | {k: in_json(v) for k, v in fields.items()}, default=str)
            self.err.out(line, highlight=False)
        elif text and not self.quiet:
            self.err.print(escape_controls(text))

    def problem(self, text: str, more: Sequence[str] = (), /, **fields: Any) -> None:
        """Print a problem, also with --quiet, followed by indented lines of details."""
        if self.log_json:
            self.event("problem", message=text, **fields)
            return
        self.err.print(f"agalign: {escape_controls(text)}", style="yellow")
        for line in more:
            self.err.print(f"    {escape_controls(line)}")

    def result(self, text: str) -> None:
        """Print a result to standard output, unless --quiet or --log-json."""
        if not self.quiet and not self.log_json:
            self.out.print(escape_controls(text))

    def facts(self, facts: Mapping[str, Any]) -> None:
        """Print the result of a command with --json to standard output."""
        typer.echo(json.dumps(facts, indent=1))

    def table(
        self, headers: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, texts: int = 99
    ) -> None:
        """Print a table like a result; the columns after the first `texts` are aligned to the right."""
        from rich.table import Table

        table = Table(title=title)
        for place, name in enumerate(headers):
            table.add_column(name, justify="left" if place < texts else "right", overflow="fold")  # nothing is cut
        for row in rows:
            table.add_row(*map(escape_controls, row))
        if not self.quiet and not self.log_json:
            self.out.print(table)

    def check(self) -> None:
        """Raise KeyboardInterrupt, with the number of the signal, if one has requested the end: an exception from a
        signal handler is lost in callbacks of C libraries.
        """
        if self._stopped_by is not None:
            raise KeyboardInterrupt(self._stopped_by)

    @contextmanager
    def stoppable(self) -> Iterator[None]:
        """Raise KeyboardInterrupt in the block at the first signal; the second one ends the process at once.

        While a module is imported, `check` or the end of the block raises it: Python ignores exceptions in callbacks of
        its import locks, and one of these locks may then be held for ever.
        """

        def stop(number: int, frame: FrameType | None) -> None:
            if self._stopped_by is not None:
                os._exit(ExitCode.SIGNAL + number)
            self._stopped_by = number
            if frame is None or "<frozen importlib" not in frame.f_code.co_filename:
                self.check()

        before = {}
        if threading.current_thread() is threading.main_thread():
            for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):  # not every system has all of them
                number = getattr(signal, name, None)
                # With nohup, SIGHUP stays ignored.
                if number is not None and (name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN):
                    before[number] = signal.signal(number, stop)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            self.check()


def explain(groups: "Sequence[CautionGroup]", terminal: Terminal) -> None:
    """Print what to check, the largest effect first: number of bands, cause, size, captures, and remedy."""
    max_named = 3
    if groups:
        terminal.event("check", "Check these, the largest effect first:", causes=len(groups))
    for group in groups:
        status, first = group.status.replace("_", " "), group.bands[0]
        if group.pairs == 1:
            name = f"{first.capture} {first.band}".rstrip()
            text, named = f"{name}: {status}: {first.reason}", []
        else:
            size = f" ({group.size})" if group.size else ""
            text = f"{status}: {group.count}: {group.remedy.cause}{size}"
            names = some_of((f"{b.capture} {b.band}".rstrip() for b in group.bands), max_named)
            named = [f"{names}: {first.reason}"]
        facts = {"bands": group.pairs, "captures": group.captures, "advice": group.advice}
        facts |= {"cause": group.remedy.cause, "size": group.size, "effect": round(group.effect, 4)}
        terminal.problem(text, (*named, f"try: {group.advice}"), status=group.status, **facts)


@contextmanager
def exits(terminal: Terminal, on_interrupt: str = "interrupted", config: Any = None) -> Iterator[None]:
    """Convert exceptions in the block to one line and an exit code; usage errors name the file of options."""
    code, details = ExitCode.NOTHING + 0, ""
    try:
        with terminal.stoppable():
            yield
        return
    except typer.Exit:
        raise
    except KeyboardInterrupt as error:
        number = error.args[0] if error.args else signal.SIGINT
        code, text = ExitCode.SIGNAL + number, on_interrupt
    except ConfigurationError as error:
        code, text = ExitCode.USAGE, f"{error}{options_from(config)}"
    except AgalignError as error:
        text = str(error)
    except Exception as error:
        text, details = _unexpected(error), traceback.format_exc()
    with suppress(OSError):  # standard error may be a file on a full disk
        if terminal.verbose and details:
            terminal.err.print(details)
        terminal.problem(text)
    raise typer.Exit(code)


def options_from(config: Any) -> str:
    """Return the end of a message about an option, which may be that of a --config file."""
    return f" (options also from {config})" if config else ""


def _unexpected(error: Exception) -> str:
    """Return the message for an exception of a library or of the system."""
    if is_out_of_memory(error):
        return "out of memory; close other programs or try a smaller image"
    if isinstance(error, ImportError):
        return f"a library cannot be loaded ({error}); is memory short, or the installation damaged?"
    if isinstance(error, OSError):
        return f"{error.filename or 'output'}: {error.strerror or error}"
    return f"agalign failed ({type(error).__name__}: {error}); please report this"


@contextmanager
def printed() -> Iterator[None]:
    """Flush standard output after the block, and escape characters that its encoding lacks. Raises SystemExit if it
    cannot be written.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        try:
            sys.stdout.flush()
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            print(f"agalign: standard output: {error.strerror}", file=sys.stderr)
            raise SystemExit(ExitCode.NOTHING) from None


@contextmanager
def progress(terminal: Terminal, captures: int) -> Iterator[Callable[[float, str, int], None]]:
    """Show a progress line on a terminal; yield the function that updates it.

    Its arguments are the number of finished captures, with the finished share of the current one, a description, and
    the number of captures that needed no time, which count neither for the rate nor for the time that is left.
    """
    if terminal.quiet or terminal.log_json or not terminal.err.is_terminal:
        yield lambda *_: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Column

    columns = (
        BarColumn(bar_width=20),
        TextColumn("{task.fields[done]} of {task.fields[captures]} captures"),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis")),
    )
    with Progress(*columns, console=terminal.err, transient=True, speed_estimate_period=600) as line:
        task = line.add_task("starting", total=captures, done=0, captures=captures, rate="")

        def show(done: float, text: str, skipped: int) -> None:
            speed = line.tasks[0].speed
            rate = "" if speed is None else f"{60 * speed:.0f} a minute"
            description, total = escape_controls(text), captures - skipped
            line.update(task, description=description, total=total, completed=done - skipped, done=int(done), rate=rate)

        yield show
