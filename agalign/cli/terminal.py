"""How the commands speak: results, progress, complaints and exit codes."""

import io
import json
import math
import os
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agalign.errors import AgalignError, ConfigurationError, is_out_of_memory
from agalign.values.choices import MAX_RNG_SEED
from agalign.values.text import harmless

if TYPE_CHECKING:
    from rich.console import Console

EXIT_OK, EXIT_NOTHING, EXIT_USAGE, EXIT_PARTIAL = 0, 1, 2, 3
_SIGNALLED = 128
"""What shells add to the number of the signal that ended a program: 130 for the interrupt key, 143 for a request."""
_PLAIN_WIDTH = 160
GOES_ON = "interrupted; finished captures are kept, and the same command resumes the run"
RAW_NUMBERS = (
    "the bands are raw numbers, not reflectance: their indices are not comparable between captures or cameras, and are "
    "far from the indices of reflectance; align with --radiometry auto where the camera's tags allow it"
)
_OUT_OF_MEMORY = "out of memory; close other programs or try a smaller image"
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""As far as the system has them."""


class Stopped(KeyboardInterrupt):
    """Somebody wants the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def command_line() -> str:
    """What the user typed, as a shell would take it."""
    return shlex.join(["agalign", *sys.argv[1:]])


def shown(text: str) -> str:
    """A text from outside as rich prints it: no markup, nothing that a terminal acts on."""
    from rich.markup import escape

    return escape(harmless(text))


def in_json(value: Any) -> Any:
    """A field's value; JSON has no nan and no infinity, which become words."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _console(**options: Any) -> "Console":
    """A console that ignores a closed pipe (`| head -1`): the run continues without printing."""
    from rich.console import Console

    class Unbroken(Console):
        def on_broken_pipe(self) -> None:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.file.fileno())
            os.close(nowhere)

    return Unbroken(highlight=False, emoji=False, **options)


class Terminal:
    """How the program speaks: results to standard output, progress and complaints to standard error."""

    def __init__(self, *, quiet: bool, verbose: bool, log_json: bool) -> None:
        self.quiet, self.verbose, self.log_json = quiet, verbose, log_json
        self._stopped_by: int | None = None
        # Lines in a file or a pipe are not wrapped to a terminal's width.
        self.out = _console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
        self.err = _console(stderr=True, soft_wrap=not sys.stderr.isatty())

    def event(self, kind: str, text: str = "", /, **fields: Any) -> None:
        """One line of progress: JSON with --log-json, else the text unless --quiet."""
        if self.log_json:
            line = json.dumps({"event": kind, **{k: in_json(v) for k, v in fields.items()}}, default=str)
            try:
                print(line, file=sys.stderr, flush=True)
            except BrokenPipeError:
                self.err.on_broken_pipe()
        elif text and not self.quiet:
            self.err.print(shown(text))

    def problem(self, text: str, more: Sequence[str] = (), /, **fields: Any) -> None:
        """A complaint: shown even with --quiet, with further lines for who reads it."""
        if self.log_json:
            self.event("problem", message=text, **fields)
            return
        self.err.print(f"[yellow]agalign: {shown(text)}[/]")
        for line in more:
            self.err.print(f"    {shown(line)}")

    def result(self, thing: Any) -> None:
        """A result on standard output, unless --quiet."""
        if not self.quiet and not self.log_json:
            self.out.print(thing)

    def check(self) -> None:
        """Raises Stopped once somebody wanted the program to end: what a signal raises is lost where it falls into a
        callback from a C library.
        """
        if self._stopped_by is not None:
            raise Stopped(self._stopped_by)

    @contextmanager
    def stoppable(self) -> Iterator[None]:
        """Signals that end a program raise Stopped inside; the second one ends it at once."""

        def stop(number: int, _frame: object) -> None:
            if self._stopped_by is not None:
                os._exit(_SIGNALLED + number)
            self._stopped_by = number
            raise Stopped(number)

        before = {}
        if threading.current_thread() is threading.main_thread():
            for name in _ENDING:
                number = getattr(signal, name, None)
                # Who started the program may want it to outlive his terminal: nohup.
                if number is not None and (name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN):
                    before[number] = signal.signal(number, stop)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


of_input = partial(typer.Option, rich_help_panel="Input")
of_alignment = partial(typer.Option, rich_help_panel="Alignment")
of_output = partial(typer.Option, rich_help_panel="Output")
of_running = partial(typer.Option, rich_help_panel="Running")
of_expert = partial(typer.Option, rich_help_panel="Expert")
"""An option in the panel of the help that it belongs to."""


def examples(*lines: tuple[str, str]) -> str:
    """Commands and what they do, as the end of a help text."""
    quoted = [(command.replace("[", r"\["), what.replace("[", r"\[")) for command, what in lines]
    return "\n\n".join(["Examples:", *(f"[bold]{command}[/]  {what}" for command, what in quoted)])


RngSeed = Annotated[
    int, of_running(min=0, max=MAX_RNG_SEED, help="Seed of all random numbers; the same seed gives the same result.")
]
Quiet = Annotated[bool, of_running("--quiet", "-q", help="Print problems only.")]
Verbose = Annotated[bool, of_running("--verbose", "-v", help="Print a line per band pair.")]
LogJson = Annotated[bool, of_running("--log-json", help="Print one JSON object per line to standard error.")]


@contextmanager
def exits(terminal: Terminal, on_interrupt: str = "interrupted") -> Iterator[None]:
    """Turns what can go wrong into one line and an exit code."""
    try:
        with terminal.stoppable():
            yield
    except typer.Exit:
        raise
    except BaseException as error:
        code, text = _ending(error, on_interrupt)
        if code is None:
            raise
        with suppress(OSError):  # of a full disk, the terminal's too
            if terminal.verbose and code == EXIT_NOTHING and not isinstance(error, AgalignError):
                from rich.markup import escape

                terminal.err.print(escape(traceback.format_exc()))
            terminal.problem(text)
        raise typer.Exit(code) from None


def _ending(error: BaseException, on_interrupt: str) -> tuple[int | None, str]:
    """(exit code, the line that says why); no code for what is not ours to catch."""
    match error:
        case Stopped():
            return _SIGNALLED + error.number, on_interrupt
        case KeyboardInterrupt():
            return _SIGNALLED + signal.SIGINT, on_interrupt
        case ConfigurationError():
            return EXIT_USAGE, str(error)
        case AgalignError():
            return EXIT_NOTHING, str(error)
        case _ if is_out_of_memory(error):
            return EXIT_NOTHING, _OUT_OF_MEMORY
        case ImportError():
            return EXIT_NOTHING, f"a library cannot be loaded ({error}); is memory short, or the installation damaged?"
        case OSError():
            return EXIT_NOTHING, f"{error.filename or 'output'}: {error.strerror or error}"
        case Exception():
            return EXIT_NOTHING, f"agalign failed ({type(error).__name__}: {error}); please report this"
    return None, ""


@contextmanager
def printed() -> Iterator[None]:
    """What is printed inside is out before the program ends, whatever the terminal's letters. Raises SystemExit where
    it cannot be.
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
            raise SystemExit(EXIT_NOTHING) from None
