"""Write the parts of docs/ that repeat the program (commands, settings, indices, sidecar fields, reasons), or check
that they are current.

    python tools/pages.py [--check]

Commands and their options come from `agalign/cli/` and `agalign/config.py`, indices from
`agalign/spectral_indices/formulas.py`, fields from `agalign/records/sidecar.py` and the records that it
contains, reasons from `agalign/values/issues.py`, measured figures from `docs/figures/figures.csv`. Each part is
between two comments in its page.
"""

import csv
import inspect
import json
import re
import sys
import typing
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from functools import cache, partial
from itertools import groupby
from operator import attrgetter, not_
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from bands.score import table
from common import with_section
from figures_csv import FIGURES, is_current

import agalign
from agalign.cli.command import Command, field_options, help_of, value_name
from agalign.cli.main import COMMANDS
from agalign.config import DiscoverOptions, RunOptions, Settings
from agalign.records.sidecar import Sidecar
from agalign.spectral_indices.formulas import INDICES
from agalign.values.issues import KINDS, Issue, sentence

DOCS = Path(__file__).resolve().parents[1] / "docs"
API = DOCS / "reference" / "api.rst"
NAMES, END_OF_NAMES = ".. Written by tools/pages.py: names\n", ".. end of names\n"
TABLES = {
    "accuracy": (
        *("accuracy", "standard errors", "simulated cameras", "scenes with depth", "runs"),
        "captures with depth",
    ),
    "failures": ("synthetic pairs", "planted grids", "starts", "difficult captures", "predicted bands"),
    "comparison": ("OpenDroneMap", "NDVI", "comparison, originals with tags", "comparison, degraded copies"),
    "verification": ("reliability",),
    "paper": ("experiments, recipe fast", "experiments, recipe paper"),
}
"""Tables of `figures.csv` by page of docs/explanation."""


def command_options() -> str:
    """Return a section per command: what it does, its usage, and a list of options for each panel of its help. Options
    that `align` has with the same text are described there only.
    """
    return "\n".join(section(c) for name, c in COMMANDS.items() if name == c.name and name not in EXPERIMENTS)


EXPERIMENTS = ("evaluate", "surface", "learn")
"""Commands without a section."""


def section(command: Command) -> str:
    """Return the section of a command."""
    text, *_ = help_of(command.function)
    built = command.built()
    usage = " ".join(built.collect_usage_pieces(built.make_context(command.name, [], resilient_parsing=True)))
    panels = {name: panel for panel, names in command.panels.items() for name in names.split()}
    by_panel: dict[str, list[str]] = {}
    same: list[str] = []
    known = [] if command.name == "align" else dict(option_lines(COMMANDS["align"])).values()
    for name, line in option_lines(command):
        if line in known:
            same.append("`" + re.findall(r"--[a-z-]+|[A-Z]+", line)[0] + "`")
        else:
            by_panel.setdefault(panels.get(name, ""), []).append(line)
    parts = [f"## {command.name}", f"`agalign {command.name} {usage.removeprefix('[OPTIONS] ')}`: " + effect(text)]
    for panel, lines in by_panel.items():
        parts += [f"**{panel}**"] * bool(panel) + ["\n".join(f"* {line}" for line in lines)]
    if same:
        parts.append(f"As in [`align`](#align): {', '.join(same)}.")
    return "\n\n".join(parts) + "\n"


def option_lines(command: Command) -> Iterator[tuple[str, str]]:
    """Yield the name of each parameter of a command and a line: names on the command line, values, default, help."""
    for parameter, param in zip(command.parameters(), command.built().params, strict=True):
        kind, info = typing.get_args(parameter.annotation)
        if param.param_type_name == "argument":
            names = str(param.metavar)
        else:
            names = f"{', '.join(sorted(param.opts, key=len))} {value_name(kind)}".strip()
        if param.required and param.param_type_name == "option":
            names += "` (required)`"
        has_default = not any(parameter.default is one for one in (inspect.Parameter.empty, None, False))
        default = f" ({parameter.default})" if has_default else ""
        yield parameter.name, f"`{names}`{default}: {effect(info.help)}".replace("``", "")


def python_names(owner: str) -> str:
    """Return a list of the fields of a model in `Given` with their defaults and the options of `agalign align`."""
    lines = []
    defaults = {"settings": Settings(), "discover": DiscoverOptions(), "run": RunOptions()}[owner]
    for option in field_options().values():
        name = ".".join(option.path[1:])
        if option.path[0] != owner or option.path[-1] in NOT_OPTIONS[owner]:
            continue
        opposite = " (opposite)" if option.parse is not_ else ""
        lines.append(f"* `{name}={attrgetter(name)(defaults)!r}`: `{option.flag}`{opposite}")
    return "\n".join(lines) + "\n"


NOT_OPTIONS = {"settings": ("start_model",), "discover": ("skip", "jobs", "timeout_s"), "run": ("command",)}
"""Fields without an option of their own."""


def effect(text: str) -> str:
    """Return a help text as Markdown: quoted commands, options and `<capture>.tif` as code."""
    code = r"'agalign [^']+'|(?<![`<\w])--[a-z-]+|<capture>[\w.]*\w|OUT/[\w/….]*\w"
    return re.sub(code, lambda found: "`" + found[0].strip("'") + "`", text)


def fields() -> str:
    """Return a list of fields for the sidecar and for each of its parts, with the descriptions of the schema.

    A part without other parts that only one field has is listed below that field.
    """
    schema = Sidecar.json_schema()
    types = schema["$defs"]
    owners = [("The file", schema), *types.items()]
    references = Counter(
        name for _, owner in owners for field in owner["properties"].values() for name in types_in(field)
    )
    inner = {name: part for name, part in types.items() if references[name] == 1 and not types_in(part["properties"])}
    of_types = {part["description"] for part in types.values()}
    sections = []
    for name, part in owners:
        if name not in inner and name not in NOT_LISTED:
            lines = field_lines(part, inner, of_types)
            sections += [f"## {name.removesuffix('Part')}", " ".join(part["description"].split()), "\n".join(lines)]
    return "\n\n".join(sections) + "\n"


NOT_LISTED = {
    *("PreviewPart", "Similarity"),
    *("preview", "estimated_with", "rendered_with", "input_samples", "model"),
    *("loss", "chance", "iterations", "levels", "last_step_px", "cells"),
    *("corner_covariance_px2", "covariance_px2", "lens_std_px", "relief_std_px"),
    *("score", "peak_sigma", "trusted", "runner_up_sigma", "windows", "held_out_p95_px"),
    *("joint", "rig_std_px", "field_std_px", "input_digests", "input_states"),
    *("vignetting_corrected", "exposed_after_s", "not_written", "seconds", "cell_means", "lens_calibration"),
}
"""Parts that another page describes, and fields that only agalign needs: for the report, resumed runs and errors."""


def types_in(schema: Any) -> set[str]:
    """Return the names of the types to which a schema refers."""
    return set(re.findall(r"#/\$defs/(\w+)", json.dumps(schema)))


def field_lines(part: Mapping[str, Any], inner: Mapping[str, Any], of_types: Container[str]) -> Iterator[str]:
    """Yield the fields of a part as items of a list, each followed by the fields of its type if that is in `inner`.

    Adjacent fields with the same type and description have one item. The type is omitted if it is a number or
    text, and the description if it is that of a type with a section of its own. Of the descriptions of a field and of
    its type in `inner`, the longer one is used.
    """
    for (text, kind), fields in groupby(listed(part), lambda item: described(item[1], inner, of_types)):
        items = dict(fields)
        names = ", ".join(f"`{name}`" for name in items)
        inside = sorted({one for field in items.values() for one in types_in(field)} & set(inner))
        kind = re.sub(rf"^(number|integer|text{'|object' if inside else ''})(?=\??$)", "", kind)
        of_kind = f" ({kind})" if kind.strip("?") else kind
        yield f"* {names}{of_kind}" + (f": {text}" if text else "")
        for type_name in inside:
            yield from (f"  {line}" for line in field_lines(inner[type_name], inner, of_types))


def listed(part: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the fields of a part that the page lists; a camera's `model` is one."""
    internal = NOT_LISTED - ({"model"} if "make" in part["properties"] else set())
    return [(name, field) for name, field in part["properties"].items() if name not in internal]


def described(field: Mapping[str, Any], inner: Mapping[str, Any], of_types: Container[str]) -> tuple[str, str]:
    """Return the description and the type of a field."""
    text = field.get("description", "")
    if parts := [inner[one] for one in types_in(field) if one in inner]:
        text = max(text, *(part["description"] for part in parts), key=len)
    elif text in of_types:
        text = ""
    return " ".join(text.split()), json_type(field, inner)


def json_type(field: Mapping[str, Any], inner: Container[str]) -> str:
    """Return a type in short: `number`, `Lens?` if it may be null, `3 x 3 numbers`, `text[]` for a list.

    A type in `inner` is an `object`.
    """
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        title = name.removesuffix("Part")
        target = "outputs.md#summarycsv" if name in NOT_LISTED else f"#{title.lower()}"
        return "object" if name in inner else f"[{title}]({target})"
    if "anyOf" in field:
        kinds = [json_type(one, inner) for one in field["anyOf"] if one.get("type") != "null"]
        kind, may_be_null = " or ".join(kinds), len(kinds) < len(field["anyOf"])
        return kind + ("?" if may_be_null and not kind.endswith("?") else "")
    if field.get("type") == "array":
        item, null, _ = json_type((field.get("prefixItems") or [field["items"]])[0], inner).partition("?")
        if (count := field.get("minItems", 0)) > 1 and count == field.get("maxItems"):
            return f"{count} x {item}{null}" if item[0].isdigit() else f"{count} {item}s{null}"
        return f"({item}{null})[]" if " " in item and not item.endswith("[]") else f"{item}{null}[]"
    return str(field.get("type", "text")).replace("string", "text")


def reasons() -> str:
    """Return a table of the reasons, causes and remedies of band pairs; numbers and details are dots."""
    grouped: dict[Any, list[str]] = {}
    for kind in KINDS.values():
        detail = "FILE: cannot be read (\0)" if kind.code == "unreadable" else "\0"
        text = sentence(Issue(kind, 0.0, 0.0, detail))
        text = re.sub(r"\d+(\.\d+)?", "…", text.replace("\0", "…"))
        grouped.setdefault(kind.remedy, []).append(f"`{text}`")
    options = r"--model OUT/models/…|--seed match|--relief never|--[a-z-]+|gdal_translate -projwin"
    advice = {remedy: re.sub(options, r"`\g<0>`", remedy.advice) for remedy in grouped}
    rows = (("; ".join(texts), remedy.cause, advice[remedy]) for remedy, texts in grouped.items())
    return table([("reason", "cause", "remedy"), *rows]) + "\n"


def indices() -> str:
    """Return a table of the built-in spectral indices."""
    rows = [("index", "formula", "bands", "source")]
    for index in INDICES.values():
        unit = "any unit" if index.any_unit else "reflectance"
        rows.append((index.name, f"`{index.formula.replace(' ', '')}`", unit, index.source))
    return table(rows) + "\n"


@cache
def figures() -> dict[str, dict[str, str]]:
    """Return the rows of docs/figures/figures.csv by fact: table / row / column."""
    with FIGURES.open(encoding="utf-8", newline="") as file:
        return {row["fact"]: row for row in csv.DictReader(file)}


def figures_of(name: str) -> str:
    """Return a table of docs/figures/figures.csv.

    The command that makes it, and the commit at which it was measured if the code has changed since, are below, or in
    columns if the rows have different ones.
    """
    parts = [(*fact.split(" / ")[1:], row) for fact, row in figures().items() if fact.startswith(f"{name} / ")]
    if not parts:
        return "\nNot measured.\n"
    columns = list(dict.fromkeys((column, row["unit"]) for _, column, row in parts))
    by_row: dict[str, dict[str, dict[str, str]]] = {}
    for line, column, row in parts:
        by_row.setdefault(line, {})[column] = row
    first = {line: next(iter(cells.values())) for line, cells in by_row.items()}
    notes = {line: (f"`{row['command']}`", measured_at(name, row)) for line, row in first.items()}
    commands, measured = (list(dict.fromkeys(some)) for some in zip(*notes.values(), strict=True))
    further = [("command", commands), ("measured at", measured)]
    heads = [f"{column}, {unit}" if unit else column for column, unit in columns]
    units = {row["n"].partition(" ")[2].removesuffix("s") for row in first.values()}
    of_one_unit = f"{units.pop()}s" if len(units) == 1 else ""
    rows = [("", of_one_unit or "n", *heads, *(head for head, some in further if some[1:]))]
    for line, cells in by_row.items():
        values = [cells[column]["value"] or "-" if column in cells else "-" for column, _ in columns]
        count = first[line]["n"].partition(" ")[0] if of_one_unit else first[line]["n"]
        rows.append((line, count, *values, *(n for n, (_, some) in zip(notes[line], further, strict=True) if some[1:])))
    below = [] if commands[1:] else [commands[0]]
    below += [f"measured at {measured[0]}"] if measured[0] and not measured[1:] else []
    return table(rows) + ("\n\n" + ", ".join(below) if below else "") + "\n"


def measured_at(table_name: str, row: Mapping[str, str]) -> str:
    """Return the commit of a figure in code if the packages that it depends on have changed since, else nothing."""
    return "" if is_current(table_name, row["digest"]) else f"`{row['commit']}`"


def public_names() -> str:
    """Return lists of the public functions, classes and errors in reStructuredText."""
    public = {name: getattr(agalign, name) for name in sorted(agalign.__all__) if name != "__version__"}
    errors = [name for name, value in public.items() if isinstance(value, type) and issubclass(value, Exception)]
    classes = [name for name, value in public.items() if isinstance(value, type) and name not in errors]
    functions = [name for name in public if name not in (*errors, *classes)]
    groups = {"functions": functions, "classes": classes, "errors": errors}
    lines = (f"* {kind}: {', '.join(f'``{name}``' for name in names)}\n" for kind, names in groups.items())
    return "\n" + "".join(lines) + "\n"


PARTS: tuple[tuple[str, str, Callable[[], str]], ...] = (
    ("reference/commands.md", "commands", command_options),
    ("reference/settings.md", "Settings", partial(python_names, "settings")),
    ("reference/settings.md", "DiscoverOptions", partial(python_names, "discover")),
    ("reference/settings.md", "RunOptions", partial(python_names, "run")),
    ("how-to/reflectance.md", "indices", indices),
    ("reference/sidecar.md", "fields", fields),
    ("how-to/troubleshooting.md", "reasons", reasons),
    *((f"explanation/{page}.md", name, partial(figures_of, name)) for page, names in TABLES.items() for name in names),
)
"""Page, mark of the part in it, and the function that makes its content."""


def main() -> None:
    """Write the parts of pages, or check them with --check."""
    for name, mark, content in PARTS:
        write_or_check(DOCS / name, with_section(DOCS / name, mark, content()))
    before, _, rest = API.read_text(encoding="utf-8").partition(NAMES)
    write_or_check(API, before + NAMES + public_names() + END_OF_NAMES + rest.partition(END_OF_NAMES)[2])


def write_or_check(path: Path, text: str) -> None:
    """Write a file that has changed; with --check, end with exit code 1 instead."""
    if text == path.read_text(encoding="utf-8"):
        return
    if "--check" in sys.argv[1:]:
        sys.exit(f"{path.name}: is out of date; run python tools/pages.py")
    path.write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
