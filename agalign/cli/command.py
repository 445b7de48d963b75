"""Commands: their options are parameters of their functions, and fields of the settings (`agalign.config`).

The docstrings of functions and fields are the help texts. That of a function may end with the sections `Options`, with
`name: help text` of its parameters and of fields whose help text differs for this command, and `Examples`, with
command lines, two spaces, and what they do.
"""

import copy
import inspect
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from agalign.cli.terminal import Terminal, exits
from agalign.errors import WorkerError
from agalign.host.files import path_problem
from agalign.host.processes import address_space_problem

if TYPE_CHECKING:
    from agalign.config import Option

Given = dict[str, dict[str, Any]]
"""Values of the options of a command that belong to fields, by name of the field: `settings` by stage and field, for
`Settings.model_validate`, `discover` of `DiscoverOptions`, `run` of `RunOptions`."""
_TERMINAL = inspect.signature(Terminal).parameters
"""Options of the terminal, by name."""


@cache
def field_options() -> dict[str, "Option"]:
    """Return the options of all fields by name, in the order of the fields."""
    from agalign.config import DiscoverOptions, RunOptions, Settings

    models = {"settings": Settings(), "discover": DiscoverOptions(), "run": RunOptions()}
    return {option.name: option for name, model in models.items() for option in _options_of(model, (name,))}


def _options_of(model: Any, path: tuple[str, ...]) -> Iterator["Option"]:
    from agalign.config import SettingsModel, option_of

    for name, of_field in type(model).__pydantic_fields__.items():
        default, option = getattr(model, name), option_of(name, of_field)
        if isinstance(default, SettingsModel):
            yield from _options_of(default, (*path, name))
            continue
        if option.type is not None or option.default is not None:
            default = option.default
        info = {"help": " ".join(of_field.description.split())}
        for limit in of_field.metadata:
            info |= {end: getattr(limit, of) for end, of in (("min", "ge"), ("max", "le")) if hasattr(limit, of)}
        kind = option.type or of_field.annotation
        yield replace(option, path=(*path, name), type=kind, default=default, info=info)


def _store(option: "Option", value: Any, given: dict[str, Any]) -> None:
    """Add the value of an option to the values of its model."""
    *folders, name = option.path
    for folder in folders:
        given = given.setdefault(folder, {})
    given[name] = option.parse(value)


def help_of(function: Any) -> tuple[str, dict[str, str], list[str]]:
    """Return the help text in the docstring of a function, the help texts of its options by name, and the examples."""
    text, *parts = re.split(r"\n\n(Options|Examples):\n", inspect.getdoc(function) or "")
    sections = dict(zip(parts[::2], parts[1::2], strict=True))
    options = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", sections.get("Options", ""), re.MULTILINE)
    examples = sections.get("Examples", "").splitlines()
    return text, {name: " ".join(words.split()) for name, words in options}, [line.strip() for line in examples]


def _on_command_line(parameter: inspect.Parameter, text: str | None, panel: str | None) -> inspect.Parameter:
    """Return a parameter, which may have an option of typer as annotation, as one of the command line in a panel of
    its help. The help text replaces that of the annotation. The help shows the kind of value as `value_name` names it.
    """
    kind, info = parameter.annotation, typer.Option(f"--{parameter.name.replace('_', '-')}")  # without --no-…
    if get_origin(kind) is Annotated:
        kind, info = get_args(kind)
    info = copy.copy(info)
    info.help, info.rich_help_panel = text or info.help, panel
    if value_name(kind) == "PATH":
        info.parser = _path
    if isinstance(info, OptionInfo):
        info.metavar = value_name(kind)
    else:
        info.metavar = f"{parameter.name.upper()}{'...' if get_origin(kind) is list else ''}"
    return parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, info])


def _path(text: Any) -> Path:
    """Return the path of a local file or folder; an empty name, as of a shell variable that is not set, would be the
    working folder.
    """
    path = Path(str(text))  # a configuration file may have a number
    if problem := path_problem(path) if text else "is empty; give a path":
        raise typer.BadParameter(problem)
    return path


def value_name(kind: Any) -> str:
    """Return how a help text names the value of an option of this type, "" for a flag; `None` is ignored.

    >>> value_name(Path | None), value_name(list[str] | None), value_name(Literal["odm", "pix4d"])
    ('PATH', 'TEXT', 'odm|pix4d')
    """
    if get_origin(kind) in (Union, UnionType):
        kind = next(one for one in get_args(kind) if one is not NoneType)
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    kind = get_args(kind)[0] if get_origin(kind) is list else kind
    return {bool: "", int: "INTEGER", float: "NUMBER", Path: "PATH"}.get(kind, "TEXT")


@dataclass(frozen=True)
class Command:
    """A command of the program."""

    function: Callable[..., int | None]
    """Takes the `terminal`, the values `given` for fields if there are any, and its own parameters; returns the exit
    code. Its docstring is the help text."""
    panels: Mapping[str, str] = field(default_factory=dict)
    """Names of options by panel of the help: own parameters, fields, and options of the terminal."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Defaults of fields that differ for this command."""
    on_interrupt: str = "interrupted"
    panel: str | None = None
    """Panel in the list of commands."""

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return self.function.__name__.removeprefix("_")

    @property
    def summary(self) -> str:
        """The first paragraph of the help text, a sentence."""
        return " ".join(help_of(self.function)[0].split("\n\n")[0].split())

    def parameters(self) -> list[inspect.Parameter]:
        """Return the parameters of the command line: own ones outside of panels, then those of each panel."""
        own = dict(inspect.signature(self.function).parameters)
        panels = {name: panel for panel, names in self.panels.items() for name in names.split()}
        names = [*(name for name in own if name not in ("terminal", "given", *panels)), *panels]
        helps = help_of(Terminal)[1] | help_of(self.function)[1]
        parameters = (own.get(name) or _TERMINAL.get(name) or self._of_field(field_options()[name]) for name in names)
        return [_on_command_line(p, helps.get(p.name), panels.get(p.name)) for p in parameters]

    def _of_field(self, option: "Option") -> inspect.Parameter:
        kind: Any = option.type
        annotation = Annotated[kind, typer.Option(*filter(None, (option.flag, option.short)), **option.info)]
        default = self.defaults.get(option.name, option.default)
        return inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)

    def built(self) -> Any:
        """Return the command of typer."""
        parameters, own = self.parameters(), inspect.signature(self.function).parameters
        fields = [p.name for p in parameters if p.name not in {*own, *_TERMINAL}]

        def call(**values: Any) -> None:
            terminal = Terminal(**{name: values.pop(name, False) for name in _TERMINAL})
            with exits(terminal, self.on_interrupt, values.get("config")):
                if "device" in fields and (problem := address_space_problem()):
                    raise WorkerError(problem)
                given: Given = {}
                for name in fields:
                    _store(field_options()[name], values.pop(name), given)
                if fields:
                    values["given"] = given
                raise typer.Exit(self.function(terminal, **values) or 0)

        text, _, examples = help_of(self.function)
        call.__doc__ = re.sub(r"(?<!\n)\n(?!\n)", " ", text)  # the lines of a paragraph are wrapped to the terminal
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)
        cls = _LenientCommand if fields else _Command
        epilog = "\n\n".join(["Examples:", *map(_highlighted, examples)]) if examples else None
        app.command(self.name, cls=cls, epilog=epilog)(call)
        return typer.main.get_command(app)


def _highlighted(example: str) -> str:
    """Return an example in the markup of rich, with its command line in bold."""
    command, what = example.replace("[", r"\[").split("  ")
    return f"[bold]{command}[/]  {what}"


class _Command(TyperCommand):
    """A command with a help that shows no types of flags and arguments."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters with that of --help."""
        params = super().get_params(ctx)
        for param in params:
            if param.param_type_name == "argument":
                vars(param)["display_type_rich"] = lambda ctx: None  # noqa: ARG005
            elif param.name == "help":
                param.metavar = ""
        return params

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the line "Usage:", with arguments as they are named in the text."""
        arguments = (param for param in self.get_params(ctx) if param.param_type_name == "argument")
        return ["[OPTIONS]", *(a.metavar if a.required else f"[{a.metavar}]" for a in arguments)]


class _LenientCommand(_Command):
    """A command that takes some options without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, after options get their missing values."""
        for option in field_options().values():
            if option.alone:
                args = _completed(args, option)
        return super().parse_args(ctx, args)


def _completed(args: list[str], option: "Option") -> list[str]:
    result = []
    for argument, following in pairwise([*args, ""]):
        result.append(argument)
        # A word that is neither an option nor a path is a misspelt choice.
        is_value = following in get_args(option.type) or (following.isalnum() and not os.path.exists(following))  # noqa: PTH110 - Path raises OSError for a long name
        if argument == option.flag and not is_value:
            result.append(option.alone[0])
    return result
