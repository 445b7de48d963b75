"""The root command group: help as plain text, because typer's panels double the start-up time, and usage errors in one
line.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from typer.core import TyperGroup

from agalign.cli.terminal import EXIT_USAGE

_UsageError: Any = typer.BadParameter.__mro__[1]
"""The class of click, or of the copy of click in typer."""
_REWORDED = (
    (r"Value error, ", ""),
    (r"Input should be a valid integer.*", "give a whole number"),
    (r"Input should be a valid number.*", "give a number"),
    (r"Input should be greater than or equal to (\S+)", r"give \1 or more"),
    (r"Input should be less than or equal to (\S+)", r"give \1 or less"),
    (r"Input should be ", "give "),
    (r"'(\w[\w-]*)'(?=[,.])", r"\1"),
    (r" is not one of ", " is unknown; choose from "),
    (r"\.$", ""),
)
"""Patterns in messages of pydantic and click about wrong values, and their replacements."""
_PANEL = "rich_help_panel"


class RootGroup(TyperGroup):
    """Root group with a list of commands by panel as plain text; the help of each command is typer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options before the command."""
        with _in_one_line(ctx):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Parse the arguments of the command, and run it."""
        with _in_one_line(ctx):
            return super().invoke(ctx)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the usage, the options, a section of commands for each panel, and the examples."""
        self.format_usage(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text(self.help or "")
        options = [param.get_help_record(ctx) for param in self.get_params(ctx)]
        with formatter.section("Options"):
            formatter.write_dl([record for record in options if record is not None])
        for title, rows in self._commands(ctx).items():
            with formatter.section(title):
                formatter.write_dl(rows)
        formatter.write_paragraph()
        for line in (self.epilog or "").split("\n\n"):
            formatter.write(f"{line.replace('[bold]', '  ').replace('[/]', '')}\n")

    def _commands(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        """Return (name, short help) of the commands by panel, in the order of the first command of each."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                panel = getattr(command, _PANEL, None)
                title = panel if isinstance(panel, str) else "Commands"
                panels.setdefault(title, []).append((name, command.get_short_help_str(limit=100)))
        return panels


@contextmanager
def _in_one_line(ctx: Any) -> Iterator[None]:
    """Print usage errors in one line, and exit with code 2."""
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            raise
        where = (error.ctx or ctx).command_path
        typer.echo(f"agalign: {_reworded(error)}; '{where} --help' lists the options", err=True)
        raise typer.Exit(EXIT_USAGE) from None


def _reworded(error: Any) -> str:
    param = getattr(error, "param", None)
    if type(error).__name__ == "MissingParameter" and param is not None:
        return f"{param.name} is missing"
    text = str(error.message)
    for pattern, words in _REWORDED:
        text = re.sub(pattern, words, text)
    name = "" if param is None else f"{max(param.opts, key=len)}: " if param.opts else f"{param.name}: "
    return f"{name}{text[:1].lower()}{text[1:]}"
