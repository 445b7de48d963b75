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

SETTINGS = {
    "--recipe": "joint.recipe", "--sharing": "joint.sharing", "--model-family": "joint.model_family",
    "--device": "joint.device", "--rng-seed": "joint.rng_seed", "--seed": "seed.force", "--only-seed": "seed.only",
    "--each-alone": "flight.together", "--accept-predicted": "check.accept_predicted_px", "--relief": "relief.use",
    "--interpolation": "write.interpolation", "--crop": "write.crop", "--undistort": "write.undistort",
    "--resolution": "write.resolution", "--layout": "write.layout", "--radiometry": "write.radiometry",
    "--panel-albedo": "write.panel_albedo", "--index": "write.indices", "--pan-sharpen": "write.pan_sharpen",
    "--error-map": "write.error_map", "--relief-map": "write.relief_map", "--fill-occluded": "write.fill_occluded",
    "--tie-points": "write.tie_points", "--qa": "write.qa", "--georeference": "write.georeference",
    "--ground-elevation": "write.ground_elevation_m", "--stac": "write.stac", "--format": "write.format",
    "--compression": "write.compression", "--statistics": "write.statistics",
}  # fmt: skip
DISCOVER = {
    "--reference": "reference", "--bands": "bands", "--order": "order", "--with-rgb": "with_rgb",
    "--pattern": "pattern", "--ignore-metadata": "ignore_metadata", "--include": "include", "--exclude": "exclude",
    "--max-pixels": "max_pixels",
}  # fmt: skip
RUN = {
    "--jobs": "jobs", "--dask": "executor", "--timeout": "timeout_s", "--overwrite": "overwrite",
    "--retry-failed": "retry_failed", "--align-panels": "align_panels",
}  # fmt: skip
COMMAND_LINE_ONLY = ("--model", "--dry-run", "--config", "--quiet", "--verbose", "--log-json")


def options(names: dict[str, str], owner: object) -> str:
    """One row per option: its name, the Python name, type, default in Python, and help text."""
    rows = [("option", "Python", "type", "default", "effect")]
    of_command = command_line_options()
    for option, name in names.items():
        kind, text = of_command[option]
        opposite = " (opposite)" if option == "--each-alone" else ""
        rows.append((f"`{option}`", f"`{name}`{opposite}", kind, f"`{attrgetter(name)(owner)}`", text))
    if isinstance(owner, agalign.RunOptions):
        unlisted = of_command.keys() - {*SETTINGS, *DISCOVER, *RUN, *COMMAND_LINE_ONLY, "--out"}
        if unlisted:
            raise SystemExit(f"tools/pages.py: say which setting these options are of: {', '.join(sorted(unlisted))}")
        for option in COMMAND_LINE_ONLY:
            kind, text = of_command[option]
            rows.append((f"`{option}`", "argument `model`" if option == "--model" else "", kind, "", text))
    return table(rows)


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
    "options.md": {
        "Settings": lambda: options(SETTINGS, Settings()),
        "DiscoverOptions": lambda: options(DISCOVER, agalign.DiscoverOptions()),
        "RunOptions": lambda: options(RUN, agalign.RunOptions()),
    },
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
