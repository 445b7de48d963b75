"""The configuration file of a command, `--config`: a TOML file with its long options."""

import json
from pathlib import Path
from typing import Any

import typer

from agalign.cli.command import field_options
from agalign.host.files import path_problem, read_regular
from agalign.host.text import did_you_mean


def load_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a TOML file (`--config agalign.toml`) as defaults of the command's options.

    Its keys are the long options without the leading dashes; true is an option without a value. The command line takes
    precedence. Raises BadParameter for a file that is not TOML, and for an unknown key.
    """
    if path is None:
        return None
    if problem := path_problem(path):
        raise typer.BadParameter(problem)
    options = _file_options(ctx.command)
    defaults: dict[str, Any] = {}
    for key, value in _read_toml(path).items():
        name = key.replace("_", "-")
        if name not in options:
            raise typer.BadParameter(f"{path}: no option '{key}'{did_you_mean(name, options)}")
        option, of_field = options[name], field_options().get(name.replace("-", "_"))
        value = of_field.value_of(value) if of_field else value
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

    not_utf_8 = typer.BadParameter(f"{path} is not in UTF-8; save it as UTF-8")
    try:
        contents = read_regular(path)
        if b"\0" in contents:  # UTF-16 of plain text is valid UTF-8
            raise not_utf_8
        return tomllib.loads(contents.decode("utf-8-sig"))
    except FileNotFoundError:
        raise typer.BadParameter(f"{path} does not exist") from None
    except UnicodeDecodeError:
        raise not_utf_8 from None
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
