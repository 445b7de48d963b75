"""Commands: their options are parameters of their functions, and fields of the settings (`agalign.config`).

An option of a field has its type, default, range and docstring (the help text).
"""

import inspect
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.core import TyperCommand

from agalign.cli.terminal import Terminal, exits
from agalign.values.files import read_regular
from agalign.values.processes import check_address_space, check_threads
from agalign.values.text import did_you_mean

if TYPE_CHECKING:
    from agalign.config import Option

Given = dict[str, dict[str, Any]]
"""Values of the options of a command that belong to fields, by name of the field: `settings` by stage and field, for
`Settings.model_validate`, `discover` of `DiscoverOptions`, `run` of `RunOptions`."""
_TERMINAL = inspect.signature(Terminal).parameters
"""Options of the terminal, by name."""


@dataclass(frozen=True)
class FieldOption:
    """The command-line option of a field."""

    owner: str
    """Key in `Given`."""
    path: tuple[str, ...]
    """Names of the stage, if any, and of the field."""
    option: "Option"
    kind: Any
    info: Mapping[str, Any]
    """Default, help text and range."""

    @property
    def name(self) -> str:
        """Return the name of the option as an identifier."""
        return self.option.name or self.path[-1]

    @property
    def flag(self) -> str:
        """Return the long name of the option, with its dashes."""
        return f"--{self.name.replace('_', '-')}"

    def parameter(self, changes: Mapping[str, Any]) -> inspect.Parameter:
        """Return it as a parameter of a function; `changes` replace its default or help text."""
        info = {**self.info, **changes}
        default, names = info.pop("default"), filter(None, (self.flag, self.option.short))
        kind: Any = self.kind
        annotation = Annotated[kind, typer.Option(*names, **info)]
        return inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)

    def store(self, value: Any, given: Given) -> None:
        """Add the value of the option to the values of its owner."""
        values = given[self.owner]
        for stage in self.path[:-1]:
            values = values.setdefault(stage, {})
        values[self.path[-1]] = self.option.parse(value)


@cache
def field_options() -> dict[str, FieldOption]:
    """Return the options of all fields by name, in the order of the fields."""
    from agalign.config import DiscoverOptions, RunOptions, Settings

    owners = {"settings": Settings(), "discover": DiscoverOptions(), "run": RunOptions()}
    return {option.name: option for owner, value in owners.items() for option in _options_of(owner, value, ())}


def _options_of(owner: str, value: Any, path: tuple[str, ...]) -> Iterator[FieldOption]:
    from agalign.config import Option, SettingsModel

    for name, of_field in type(value).__pydantic_fields__.items():
        default = getattr(value, name)
        if isinstance(default, SettingsModel):
            yield from _options_of(owner, default, (*path, name))
            continue
        option = next((m for m in of_field.metadata if isinstance(m, Option)), Option())
        if option.type is not None or option.default is not None:
            default = option.default
        text = " ".join(of_field.description.split())
        info = {"default": default, "help": text}
        for limit in of_field.metadata:
            info |= {end: getattr(limit, of) for end, of in (("min", "ge"), ("max", "le")) if hasattr(limit, of)}
        yield FieldOption(owner, (*path, name), option, option.type or of_field.annotation, info)


@dataclass(frozen=True)
class Command:
    """A command of the program."""

    function: Callable[..., int | None]
    """Takes the `terminal`, the values `given` for fields if there are any, and its own parameters; returns the exit
    code. Its docstring is the help text."""
    panels: Mapping[str, str] = field(default_factory=dict)
    """Names of options by panel of the help: own parameters, fields, and options of the terminal."""
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Help texts and defaults of fields that differ for this command."""
    on_interrupt: str = "interrupted"
    epilog: str | None = None
    panel: str | None = None
    """Panel in the list of commands."""
    hidden: bool = False

    @property
    def summary(self) -> str:
        """The first paragraph of the help text, a sentence."""
        return " ".join((inspect.getdoc(self.function) or "").split("\n\n")[0].split())

    def parameters(self) -> list[inspect.Parameter]:
        """Return the parameters of the command line: own ones outside of panels, then those of each panel."""
        own = dict(inspect.signature(self.function).parameters)
        result = []
        for panel, names in self.panels.items():
            for name in names.split():
                shared = own.pop(name, None) or _TERMINAL.get(name)
                result.append(shared or field_options()[name].parameter(self.changes.get(name, {})))
                get_args(result[-1].annotation)[1].rich_help_panel = panel
        result = [*(own[name] for name in own if name not in ("terminal", "given")), *result]
        return [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in result]

    def built(self, name: str) -> Any:
        """Return the command of typer."""
        parameters, own = self.parameters(), inspect.signature(self.function).parameters
        fields = [p.name for p in parameters if p.name not in {*own, *_TERMINAL}]

        def call(**values: Any) -> None:
            terminal = Terminal(**{name: values.pop(name, False) for name in _TERMINAL})
            with exits(terminal, self.on_interrupt, values.get("config")):
                check_address_space()
                check_threads()
                given: Given = defaultdict(dict)
                for name in fields:
                    field_options()[name].store(values.pop(name), given)
                if fields:
                    values["given"] = given
                raise typer.Exit(self.function(terminal, **values) or 0)

        call.__doc__ = self.function.__doc__
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)
        cls = _LenientCommand if fields else TyperCommand
        app.command(name, cls=cls, epilog=self.epilog, hidden=self.hidden, rich_help_panel=self.panel)(call)
        return typer.main.get_command(app)


class _LenientCommand(TyperCommand):
    """A command that takes options under their former names, and some options without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, after options are renamed and get their missing values."""
        own = {param.name for param in self.params}
        for one in field_options().values():
            if one.option.alone and one.name in own:
                args = _completed(args, one)
        return super().parse_args(ctx, args)


def _completed(args: list[str], one: FieldOption) -> list[str]:
    result = []
    for argument, following in pairwise([*args, ""]):
        name, equals, value = argument.partition("=")
        if name and name == one.option.former:
            Terminal(log_json="--log-json" in args).problem(f"{name} is deprecated; use {one.flag}")
            name = one.flag
        result.append(f"{name}{equals}{value}")
        if name == one.flag and not equals and not _is_value(following, one):
            result.append(one.option.alone)
    return result


def _is_value(text: str, one: FieldOption) -> bool:
    """Return True for a choice of an option, and for a word that is neither an option nor a path: a misspelt choice."""
    return text in get_args(one.kind) or (text.isalnum() and not Path(text).exists())


def load_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a TOML file (`--config agalign.toml`) as defaults of the command's options.

    Its keys are the long options without the leading dashes. The command line takes precedence. Raises BadParameter for
    a file that is not TOML, and for an unknown key.
    """
    if path is None:
        return None
    options = _file_options(ctx.command)
    defaults: dict[str, Any] = {}
    for key, value in _read_toml(path).items():
        name = key.replace("_", "-")
        if name not in options:
            raise typer.BadParameter(f"{path}: no option '{key}'{did_you_mean(name, options)}")
        option = options[name]
        values = value if isinstance(value, list) and option.multiple else [value]
        if isinstance(value, (dict, list)) and values is not value:
            raise typer.BadParameter(f"{path}: '{key}' takes one value")
        if not all(type(one) in ((bool,) if option.is_flag else (str, int, float)) for one in values):
            kind = "true or false" if option.is_flag else "a text or number"
            raise typer.BadParameter(f"{path}: '{key}' takes {kind}")
        defaults[option.name] = values if option.multiple else value
    ctx.default_map = {**(ctx.default_map or {}), **defaults}
    return path


def _read_toml(path: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(read_regular(path).decode("utf-8-sig"))
    except FileNotFoundError:
        raise typer.BadParameter(f"{path} does not exist") from None
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise typer.BadParameter(f"{path} cannot be read as TOML ({reason})") from None


def config_text(command: Any) -> str:
    """Return a configuration file with all options of a command and their defaults as comments."""
    lines = ["# Options of 'agalign align', for --config. Remove the # in front of what you set."]
    for name, option in _file_options(command).items():
        default = "" if option.default is None or callable(option.default) else option.default
        help_text = " ".join((option.help or "").split())
        lines += ["", f"# {help_text}", f"# {name} = {json.dumps(default, ensure_ascii=False)}"]
    return "\n".join(lines)


def _file_options(command: Any) -> dict[str, Any]:
    """Return the options of a command by their long names without the leading dashes."""
    named = {max(p.opts, key=len).lstrip("-"): p for p in command.params if p.param_type_name == "option"}
    command_line_only = {"help", "config", "dry-run"}
    return {name: option for name, option in named.items() if name not in command_line_only}
