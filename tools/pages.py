"""Write the tables of docs/ that repeat the program (options, sidecar fields, reasons), or check that they are current.

    python tools/pages.py [--check]

Options come from the command line (`agalign align --help`), fields from `agalign/sidecar.schema.json`, reasons from
`agalign/values/issues.py` and the checks in `agalign/verify`. Each table is between two comments in its page.
"""

import json
import re
import sys
import typing
from collections.abc import Callable, Iterable
from enum import Enum
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import typer

import agalign
from agalign.cli.align import align
from agalign.cli.main import app
from agalign.config import Settings
from agalign.values.issues import Issue, sentence
from agalign.verify.checks import KINDS

DOCS = Path(__file__).resolve().parents[1] / "docs"
SCHEMA = Path(agalign.__file__).parent / "sidecar.schema.json"

OTHER_NAMES = {
    "seed.force": "--seed",
    "seed.only": "--only-seed",
    "flight.together": "--each-alone",
    "relief.use": "--relief",
    "write.indices": "--index",
    "executor": "--dask",
}
"""Options of settings with another name; all others have the name of the setting without its unit."""
UNIT = re.compile("_(px|m|s)$")
OWNERS = {
    "Settings": Settings(),
    "DiscoverOptions": agalign.DiscoverOptions(),
    "RunOptions": agalign.RunOptions(),
}
COMMAND_LINE_ONLY = ("--model", "--dry-run", "--config", "--quiet", "--verbose", "--log-json")


def names_of(owner: object) -> dict[str, str]:
    """{option: setting} of a settings object, in its order."""
    parts = owner if isinstance(owner, Settings) else [("", owner)]
    paths = [f"{part}.{name}".lstrip(".") for part, of_part in parts for name in type(of_part).__annotations__]
    options = {
        OTHER_NAMES.get(path, "--" + UNIT.sub("", path.split(".")[-1]).replace("_", "-")): path for path in paths
    }
    elsewhere = {"--jobs"} if isinstance(owner, agalign.DiscoverOptions) else set()  # it is also one of a run
    return {option: path for option, path in options.items() if option in command_line_options().keys() - elsewhere}


def options(owner: object) -> str:
    """One row per option: its name, the Python name, type, default in Python, and help text."""
    rows = [("option", "Python", "type", "default", "effect")]
    of_command = command_line_options()
    for option, name in names_of(owner).items():
        opposite = " (opposite)" if option == "--each-alone" else ""
        default = f"`{attrgetter(name)(owner)}`"
        rows.append((f"`{option}`", f"`{name}`{opposite}", of_command[option][0], default, of_command[option][1]))
    if isinstance(owner, agalign.RunOptions):
        listed = {option for one in OWNERS.values() for option in names_of(one)}
        if unlisted := of_command.keys() - {*listed, *COMMAND_LINE_ONLY, "--out"}:
            raise SystemExit(f"tools/pages.py: no setting has the name of {', '.join(sorted(unlisted))}")
        for option in COMMAND_LINE_ONLY:
            kind, text = of_command[option]
            rows.append((f"`{option}`", "argument `model`" if option == "--model" else "", kind, "", text))
    return table(rows)


@cache
def command_line_options() -> dict[str, tuple[str, str]]:
    """{option: (type, help text)} of `agalign align`."""
    hints = typing.get_type_hints(align)
    command: Any = typer.main.get_command(app)
    result = {}
    for parameter in command.commands["align"].params:
        name = next((option for option in parameter.opts if option.startswith("--")), None)
        if name is not None:
            text = re.sub(r"(?<![`<\w])(--[a-z-]+)", r"`\1`", parameter.help)
            result[name] = (type_name(hints[parameter.name]), text.replace("<", "\\<"))
    return result


def type_name(kind: Any) -> str:
    """Return the value as a user writes it."""
    kinds = [k for k in (typing.get_args(kind) or (kind,)) if k is not type(None)]
    if typing.get_origin(kind) is list:
        return "repeatable"
    if isinstance(kinds[0], type) and issubclass(kinds[0], Enum):
        return ", ".join(f"`{member.value}`" for member in kinds[0])
    if typing.get_origin(kinds[0]) is typing.Literal or isinstance(kinds[0], str):
        values = kinds if isinstance(kinds[0], str) else typing.get_args(kinds[0])
        return ", ".join(f"`{value}`" for value in values)
    return {bool: "flag", int: "integer", float: "number", str: "text", Path: "file"}.get(kinds[0], "text")


def fields() -> str:
    """A table for the sidecar and for each of its parts, with the descriptions of the schema."""
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    tables = []
    for name, part in [("Sidecar", schema), *schema["$defs"].items()]:
        rows = [("field", "type", "meaning")]
        for field, of_field in part["properties"].items():
            rows.append((f"`{field}`", json_type(of_field), " ".join(of_field["description"].split())))
        title = "The file" if name == "Sidecar" else name.removesuffix("Part")
        tables.append(f"### {title}\n\n{' '.join(part['description'].split())}\n\n{table(rows)}")
    return "\n".join(tables)


def json_type(field: dict[str, Any]) -> str:
    """Short: `number`, `Seed or null`, `list of Band`."""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2].removesuffix("Part")
        return f"[{name}](#{name.lower()})"
    if "anyOf" in field:
        return " or ".join(json_type(one) for one in field["anyOf"])
    if field.get("type") == "array":
        if "prefixItems" in field:
            count = len(field["prefixItems"])
            item, either, rest = json_type(field["prefixItems"][0]).partition(" or ")
            return f"{count} x {item}" if item[0].isdigit() else f"{count} {item}s{either}{rest}"
        return f"list of {json_type(field['items'])}"
    return str(field.get("type", "text")).replace("string", "text")


def reasons() -> str:
    """Return a table of the reasons, causes and remedies of band pairs; numbers and details are dots."""
    grouped: dict[Any, list[str]] = {}
    for kind in KINDS.values():
        detail = "FILE: cannot be read (\0)" if kind.code == "unreadable" else "\0"
        text = sentence(Issue(kind, 0.0, 0.0, detail))
        text = re.sub(r"\d+(\.\d+)?", "…", text.replace("\0", "…"))
        grouped.setdefault(kind.remedy, []).append(f"`{text}`")
    rows = [("reason", "usual cause", "remedy")]
    rows += [("; ".join(texts), remedy.cause, remedy.advice) for remedy, texts in grouped.items()]
    return table(rows)


def table(rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table; the first row is the header."""
    header, *body = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([header, "|---" * (header.count(" | ") + 1) + "|", *body]) + "\n"


TABLES: dict[str, dict[str, Callable[[], str]]] = {
    "options.md": {name: partial(options, owner) for name, owner in OWNERS.items()},
    "sidecar.md": {"fields": fields},
    "troubleshooting.md": {"reasons": reasons},
}


def main() -> None:
    """Write the pages, or check them with --check."""
    for name, tables in TABLES.items():
        page = DOCS / name
        old = new = page.read_text(encoding="utf-8")
        for mark, content in tables.items():
            begin, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->"
            head, found, rest = new.partition(begin)
            if not found or end not in rest:
                sys.exit(f"{page}: has no section {begin.strip()}")
            new = head + begin + content() + end + rest.partition(end)[2]
        if new == old:
            continue
        if "--check" in sys.argv[1:]:
            sys.exit(f"{name}: a table is out of date; run python tools/pages.py")
        page.write_text(new, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
