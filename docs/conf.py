"""The site of these pages: pip install '.[docs]' && sphinx-build -W docs site."""

import inspect
import json
import re
from functools import reduce
from operator import or_
from pathlib import Path
from pkgutil import resolve_name
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy.typing
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, NumpyDocstring

from agalign import __version__
from agalign.records.sidecar import Sidecar

# The site has this name instead of a union of ten types. No module of agalign has imported it so far.
numpy.typing.ArrayLike = type("ArrayLike", (), {"__module__": "numpy.typing"})

project = "agalign"
copyright = "the agalign authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 3
autodoc_default_options = {"exclude-members": "model_config"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
smartquotes = False  # -- begins an option
exclude_patterns = ["_build"]
autodoc_member_order = "bysource"
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"agalign {__version__}"

ROOT_PAGES = {"../CONTRIBUTING.md": "project/contributing.md", "../CHANGELOG.md": "project/changelog.md"}
"""Pages that are outside of docs/, and the pages that include them on the site and link to them on GitHub."""
OUTSIDE_PAGE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(benchmarks/[\w/]+\.md)(?:#[\w-]+)?\)")
"""Link to a page of the repository that is not on the site, which then names its file."""


def add_navigation(_app: Sphinx, page: str, source: list[str]) -> None:
    """Add the lists of index.md to the navigation of the site, and include the pages that are outside of docs/.

    GitHub would show a toctree or include as a raw block.
    """
    source[0] = OUTSIDE_PAGE.sub(r"\1 (`\2`)", source[0])
    for path, included_by in ROOT_PAGES.items():
        if included_by == f"{page}.md":
            source[0] = f"```{{include}} ../{path}\n:relative-docs: docs/\n:relative-images:\n```\n"
    if page != "index":
        return
    for path, included_by in ROOT_PAGES.items():
        source[0] = source[0].replace(f"]({path})", f"]({included_by})")
    for part in source[0].split("\n## ")[1:]:
        group, *links = part.splitlines()
        pages = re.findall(r"^\* \[.*?\]\((\S+)\.\w+\)", "\n".join(links), re.MULTILINE)
        source[0] += "\n".join(["\n```{toctree}", ":hidden:", f":caption: {group}", *pages, "```\n"])


def setup(app: Sphinx) -> None:
    """Add the navigation; convert docstrings, hide arguments of results, and simplify types in the API reference."""
    app.connect("autodoc-process-docstring", convert_sections)
    app.connect("autodoc-process-signature", hide_arguments_of_results)
    app.connect("source-read", add_navigation)
    app.connect("build-finished", write_schema)
    page = Path(__file__).with_name("reference") / "api.rst"
    for module, name in re.findall(r"^\.\. auto\w+:: ([\w.]+)\.(\w+)$", page.read_text(encoding="utf-8"), re.M):
        listed = resolve_name(f"{module}:{name}")
        members = vars(listed).values() if inspect.isclass(listed) else ()
        for value in (listed, *members, *(getattr(m, "fget", getattr(m, "func", None)) for m in members)):
            hints = getattr(value, "__annotations__", {})
            hints.update({name: without_constraints(hint) for name, hint in hints.items()})


def write_schema(app: Sphinx, _error: Exception | None) -> None:
    """Write the JSON Schema of sidecars beside the pages."""
    text = json.dumps(Sidecar.json_schema(), indent=1)
    (Path(app.outdir) / "sidecar.schema.json").write_text(text, encoding="utf-8")


def without_constraints(hint: Any) -> Any:
    """Return a type without the constraints of pydantic, and without the shapes and types of arrays."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return without_constraints(parts[0])
    if origin is numpy.ndarray:
        return numpy.ndarray
    if origin in (Union, UnionType):
        return reduce(or_, map(without_constraints, parts))
    return tuple[tuple(map(without_constraints, parts))] if origin is tuple else hint


def convert_sections(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Convert the sections of a docstring; the extension napoleon would also split the text of fields at colons."""
    if what not in ("attribute", "property"):
        lines[:] = NumpyDocstring(list(lines), Config(), app, what, name, obj, options).lines()


def hide_arguments_of_results(_app: Sphinx, what: str, _name: str, obj: Any, *_: Any) -> tuple[str, str] | None:
    """Hide the arguments of classes that users do not construct."""
    return ("", "") if what == "class" and obj.__module__ != "agalign.config" else None
