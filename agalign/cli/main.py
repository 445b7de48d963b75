"""The application: its commands, its help, its usage errors and its entry point."""

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from agalign.cli.align_commands import align, demo, onto
from agalign.cli.command import help_of
from agalign.cli.evaluate import evaluate, learn, surface
from agalign.cli.info import info
from agalign.cli.results import export, indices, report, verify
from agalign.cli.terminal import ExitCode, Terminal, options_from, printed
from agalign.host.processes import leave_out_network_clients, limit_default_threads, silence_libraries
from agalign.host.text import did_you_mean, name_problem

_LISTED = align, demo, info, report, verify, indices, export, onto, evaluate, surface, learn
COMMANDS = {command.name: command for command in _LISTED} | {"ndvi": indices}  # a second name of a command
_UsageError: Any = typer.BadParameter.__mro__[1]
"""The class of click, or of the copy of click in typer."""


class RootGroup(TyperGroup):
    """Root group. Its help is plain text, because typer's panels double the start-up time. A command is built when it
    is used, because the settings with its options take as long again to load.
    """

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """Return the names of all commands."""
        return [*COMMANDS]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """Return a command; None if there is none of this name."""
        return COMMANDS[cmd_name].built() if cmd_name in COMMANDS else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Write a section of commands for each panel."""
        for panel in dict.fromkeys(command.panel for command in _LISTED):
            with formatter.section(panel or "Commands"):
                formatter.write_dl([(c.name, c.summary) for c in _LISTED if c.panel == panel])

    def format_epilog(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Write the examples."""
        formatter.write("\nExamples:\n")
        for example in help_of(_root)[2]:
            formatter.write(f"  {example}\n")


def _usage_problem(text: str) -> None:
    """Print a problem of the command line, of which --log-json may not be parsed yet."""
    Terminal(log_json="--log-json" in sys.argv).problem(text)


def _reworded(error: Any) -> str:
    """Return the message of pydantic or click about a wrong value in plain words, after the name of the parameter."""
    param = getattr(error, "param", None)
    if type(error).__name__ == "MissingParameter" and param is not None:
        return f"{param.name} is missing" if param.opts[0] != "out" else "give the output folder of a run"
    text = str(error.message)
    if type(error).__name__ == "NoSuchOption":
        text += did_you_mean(error.option_name, error.possibilities or ())
    for pattern, words in (
        (r"Value error, ", ""),
        (r"Input should be a valid integer.*", "give a whole number"),
        (r"Input should be a valid number.*", "give a number"),
        (r"Input should be greater than or equal to (\S+)", r"give \1 or more"),
        (r"Input should be less than or equal to (\S+)", r"give \1 or less"),
        (r"Input should be ", "give "),
        (r"'(\w[\w-]*)'(?=[,.])", r"\1"),
        (r" is not one of ", " is unknown; choose from "),
        (r"\.$", ""),
    ):
        text = re.sub(pattern, words, text)
    name = "" if param is None else f"{max(param.opts, key=len)}: " if param.opts else f"{param.name}: "
    return f"{name}{text[:1].lower()}{text[1:]}"


def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print versions, devices and limits, and exit.", is_eager=True)
    ] = False,
) -> None:
    """Co-register the bands of multispectral drone cameras. 'agalign FOLDER' aligns everything below FOLDER.

    Examples:
        agalign demo  align a synthetic flight and compare it with its ground truth
        agalign info flight/  list captures, bands and missing files
        agalign flight/ -o aligned/  align a flight; 'agalign align --help' lists the options
        agalign indices aligned/  compute spectral indices of the aligned captures
        agalign --version  print versions, devices and limits
    """
    if version:
        from agalign.cli.version import version_lines

        for line in version_lines():
            typer.echo(line)
        raise typer.Exit


app = typer.Typer(
    cls=RootGroup, name="agalign", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)
app.callback(invoke_without_command=True, help=help_of(_root)[0])(_root)


def main() -> None:
    """Run the application; if the first argument is not a command, it is the folder to align."""
    arguments = sys.argv[1:]
    root_options = ("--help", "--version", "--install-completion", "--show-completion")
    problem = next(filter(None, map(name_problem, arguments)), "")
    if arguments and arguments[0] not in {*COMMANDS, *root_options}:
        problem = problem or _problem_of_folder(arguments)
        arguments = ["align", *arguments]
    if problem:
        _usage_problem(problem)
        raise SystemExit(ExitCode.USAGE)
    # Threads that spin while they wait slow down other programs on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # The matrices here are small: a second BLAS thread only spins.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    limit_default_threads()
    leave_out_network_clients()
    silence_libraries()
    with printed():
        try:
            code = app(args=arguments, prog_name="agalign", standalone_mode=False)
        except _UsageError as error:
            if arguments:
                context = error.ctx  # None for an option without its value
                path = f"agalign {arguments[0]}" if context is None else context.command_path
                config = None if context is None else context.params.get("config")
                _usage_problem(f"{_reworded(error)}{options_from(config)}; '{path} --help' lists the options")
            else:
                typer.echo(error.message, err=True)  # the help
            code = ExitCode.USAGE
        raise SystemExit(code)


def _problem_of_folder(arguments: Sequence[str]) -> str:
    """Return why the first argument cannot be a folder, if so: it is empty, a misspelt command, or the first of several
    files, to which the shell has expanded a glob such as flight/*.tif.
    """
    first = arguments[0]
    if not first:
        return "the name of the folder is empty"
    files = [Path(a) for a in arguments if not a.startswith("-") and os.path.isfile(a)]  # noqa: PTH113 - as below
    if len(files) > 1 and Path(first) == files[0]:
        return f"{files[0]}, …: give the folder of the images, not the files: agalign {files[0].parent}"
    similar = did_you_mean(first, COMMANDS)
    if similar and not os.path.exists(first):  # noqa: PTH110 - Path raises OSError for a long name
        return f"'{first}' is neither a command nor a folder{similar}"
    return ""


if __name__ == "__main__":
    main()
