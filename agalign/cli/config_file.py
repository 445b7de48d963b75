"""Options from a TOML file (`--config agalign.toml`); its keys are the long options without the leading dashes."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import typer

_COMMAND_LINE_ONLY = {"help", "config", "dry-run"}


def load_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a file as defaults of the command's options; the command line takes precedence.

    Raises BadParameter for a file that is not TOML, and for an unknown key.
    """
    if path is None:
        return None
    import tomllib

    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise typer.BadParameter(f"{path} does not exist") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise typer.BadParameter(f"{path} cannot be read as TOML ({error})") from None
    options = _options(ctx.command)
    defaults: dict[str, Any] = {}
    for key, value in values.items():
        name = key.replace("_", "-")
        if name not in options:
            near = get_close_matches(name, options, 1)
            raise typer.BadParameter(f"{path}: no option '{key}'" + (f"; did you mean '{near[0]}'?" if near else ""))
        if isinstance(value, dict) or (isinstance(value, list) and not options[name].multiple):
            raise typer.BadParameter(f"{path}: '{key}' takes one value")
        single = options[name].multiple and not isinstance(value, list)
        defaults[options[name].name] = [value] if single else value
    ctx.default_map = {**(ctx.default_map or {}), **defaults}
    return path


def config_text(command: Any) -> str:
    """Return a configuration file with all options of a command and their defaults as comments."""
    lines = ["# Options of 'agalign align', for --config. Remove the # in front of what you set."]
    for name, option in _options(command).items():
        lines += ["", f"# {' '.join((option.help or '').split())}", f"# {name} = {_toml(option.default)}"]
    return "\n".join(lines)


def _options(command: Any) -> dict[str, Any]:
    """Return the options of a command by their long names without the leading dashes."""
    named = {max(p.opts, key=len).lstrip("-"): p for p in command.params if p.param_type_name == "option"}
    return {name: option for name, option in named.items() if name not in _COMMAND_LINE_ONLY}


def _toml(value: Any) -> str:
    if value is None or callable(value):
        return '""'
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, int | float) else f'"{value}"'
