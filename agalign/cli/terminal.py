"""How the commands speak: results, progress, complaints and exit codes."""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from agalign.errors import AgalignError, ConfigurationError

EXIT_OK, EXIT_NOTHING, EXIT_USAGE, EXIT_PARTIAL, EXIT_INTERRUPTED = 0, 1, 2, 3, 130
_PLAIN_WIDTH = 160
_OUT_OF_MEMORY = "out of memory; close other programs or try a smaller image"


def in_json(value: Any) -> Any:
    """A field's value; JSON has no nan and no infinity, which are told in words."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


class Voice:
    """How the program speaks: results to standard output, progress and complaints to standard error."""

    def __init__(self, *, quiet: bool, verbose: bool, log_json: bool) -> None:
        self.quiet, self.verbose, self.log_json = quiet, verbose, log_json
        # Lines in a file or a pipe are not wrapped to a terminal's width.
        self.out = Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
        self.err = Console(stderr=True, highlight=False, emoji=False, soft_wrap=not sys.stderr.isatty())

    def event(self, kind: str, text: str = "", /, **fields: Any) -> None:
        """One line of progress: JSON with --log-json, else the text unless --quiet."""
        if self.log_json:
            print(
                json.dumps({"event": kind, **{k: in_json(v) for k, v in fields.items()}}, default=str),
                file=sys.stderr,
                flush=True,
            )
        elif text and not self.quiet:
            self.err.print(escape(text))

    def problem(self, text: str, **fields: Any) -> None:
        """A complaint: shown even with --quiet."""
        if self.log_json:
            self.event("problem", message=text, **fields)
        else:
            self.err.print(f"[yellow]agalign: {escape(text)}[/]")

    def result(self, thing: Any) -> None:
        """A result on standard output, unless --quiet."""
        if not self.quiet and not self.log_json:
            self.out.print(thing)


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print problems only.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print a line per band pair.")]
LogJson = Annotated[bool, typer.Option("--log-json", help="Print one JSON object a line to standard error.")]


@contextmanager
def exits(voice: Voice, on_interrupt: str = "interrupted") -> Iterator[None]:
    """Turns what can go wrong into one line and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        voice.problem(on_interrupt)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except ConfigurationError as error:
        voice.problem(str(error))
        raise typer.Exit(EXIT_USAGE) from None
    except AgalignError as error:
        voice.problem(str(error))
        raise typer.Exit(EXIT_NOTHING) from None
    except MemoryError:
        voice.problem(_OUT_OF_MEMORY)
        raise typer.Exit(EXIT_NOTHING) from None
