"""Docstrings of the public names: they are complete, and their examples run."""

import ast
import contextlib
import doctest
import inspect
import re
import shutil
import textwrap
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import agalign
from agalign.values import geometry

from .builders import in_full_run
from .conftest import textured_pair, write_band
from .test_public_names import ERRORS, FUNCTIONS, ROOT

API_PAGE = (ROOT / "docs" / "reference" / "api.rst").read_text(encoding="utf-8")
LISTED = re.findall(r"^\.\. auto(?:class|exception):: agalign\.([\w.]+)\n((?: +:.*\n)*)", API_PAGE, re.M)
HIDDEN = {name: re.findall(r"\w+", options.partition(":exclude-members:")[2]) for name, options in LISTED}
"""Members of each class that the page does not show."""
CLASSES = [*HIDDEN]
ERROR_NAMES = set(ERRORS.split())
NEEDS = {"dask_executor": ("distributed",), "open_capture": ("rioxarray",), "open_flight": ("rioxarray",)}


def public(name: str) -> Any:
    value: Any = agalign
    for part in name.split("."):
        value = getattr(value, part)
    return value


def shown_members(name: str) -> dict[str, Any]:
    """The public methods and properties of a class that the API page shows."""
    kinds = (property, cached_property, classmethod, FunctionType)
    members = {key: value for key, value in vars(public(name)).items() if isinstance(value, kinds)}
    return {key: value for key, value in members.items() if key[0] != "_" and key not in HIDDEN[name]}


METHODS = [f"{n}.{key}" for n in CLASSES for key, value in shown_members(n).items() if isinstance(value, FunctionType)]
CALLABLES = [*FUNCTIONS.split(), *METHODS]


@pytest.mark.parametrize("name", CALLABLES)
def test_arguments_and_results_are_described(name: str) -> None:
    text, function = inspect.getdoc(public(name)) or "", public(name)
    sections = dict(re.findall(r"^(\w+)\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", text, re.M | re.S))
    described = re.findall(r"^(\w+)$", sections["Parameters"], re.M)
    assert described == [parameter for parameter in inspect.signature(function).parameters if parameter != "self"]
    assert sections["Returns"].strip()
    named = re.findall(r"^([\w, ]+)$", sections.get("Raises", ""), re.M)
    assert {error for line in named for error in line.split(", ")} <= ERROR_NAMES
    assert not_documented(function, sections.get("Raises", "")) == set()
    assert ">>> " in sections["Examples"]


def raised_errors(function: Any) -> set[str]:
    """Names of the public errors that a function raises. Of the functions that it calls, the docstrings say what they
    raise; those without a "Raises" are searched too. Calls whose errors it handles, and methods, are not.
    """
    names, function = set[str](), inspect.unwrap(function)
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    tried = [line for node in ast.walk(tree) if isinstance(node, ast.Try) for line in node.body]
    handled = {node for line in tried for node in ast.walk(line)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise):
            names |= {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
        elif isinstance(node, ast.Call) and node not in handled:
            module, _, name = ast.unparse(node.func).rpartition(".")
            owner = function.__globals__.get(module) if module else SimpleNamespace(**function.__globals__)
            called = getattr(owner, name, None)
            if inspect.isfunction(called) and called.__module__.startswith("agalign.") and called is not function:
                documented = re.findall(r"[Rr]aises\s[^.]*", inspect.getdoc(called) or "")
                names |= set(re.findall(r"\w+Error", " ".join(documented))) if documented else raised_errors(called)
    return names & ERROR_NAMES


def not_documented(function: Any, text: str) -> set[str]:
    """Names of the errors that a function raises and a text does not name, neither themselves nor a base of theirs."""
    named = tuple(getattr(agalign, name) for name in re.findall(r"\w+Error", text) if name in ERROR_NAMES)
    return {name for name in raised_errors(function) if not issubclass(getattr(agalign, name), named)}


@pytest.mark.parametrize("name", CLASSES)
def test_examples_of_a_class_use_its_members(name: str) -> None:
    examples = doctest.DocTestParser().get_examples(inspect.getdoc(public(name)) or "")
    assert examples
    code = " ".join(example.source for example in examples)
    assert [key for key in shown_members(name) if f"{name}.{key}" not in METHODS and f".{key}" not in code] == []


@pytest.mark.parametrize("name", CLASSES)
def test_errors_of_properties_are_documented(name: str) -> None:
    for key, member in shown_members(name).items():
        if function := getattr(member, "fget", getattr(member, "func", None)):
            assert (key, not_documented(function, function.__doc__ or "")) == (key, set())


def test_arguments_of_an_error_are_described() -> None:
    arguments = list(inspect.signature(agalign.NotEnoughTextureError).parameters)
    assert re.findall(r"^(\w+)$", inspect.getdoc(agalign.NotEnoughTextureError) or "", re.M)[1:-1] == arguments
    assert [n for n in ERROR_NAMES if "__init__" in vars(public(n))] == ["NotEnoughTextureError"]  # others have a text


def undescribed(cls: type) -> Iterator[str]:
    """Yield the fields of a class without a docstring below them, and its public methods without one."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(body, ast.ClassDef)
    for one, following in zip(body.body, [*body.body[1:], ast.Pass()], strict=True):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name) and not one.target.id.startswith("_"):
            is_described = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            if not is_described and cls is not agalign.Settings:  # each stage is a class with a docstring
                yield one.target.id
        elif isinstance(one, ast.FunctionDef) and not one.name.startswith("_") and not ast.get_docstring(one):
            yield one.name


@pytest.mark.parametrize("name", CLASSES)
def test_fields_and_methods_are_described(name: str) -> None:
    assert list(undescribed(public(name))) == []
    assert public(name).__doc__


def test_the_api_page_has_every_public_name() -> None:
    listed = re.findall(r"^\.\. auto(?:function|class|exception):: agalign\.(\w+)$", API_PAGE, re.M)
    assert sorted([*listed, "__version__"]) == agalign.__all__


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_use_public_names_alone(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"agalign\.\w+ import|from agalign import|import agalign\.", text)
    assert set(re.findall(r"\bagalign\.(\w+)", text)) <= set(agalign.__all__)


def run_examples(name: str, names: dict[str, Any]) -> None:
    """Run the example in a docstring, whose variables are added to `names`."""
    (test,) = doctest.DocTestFinder(recurse=False).find(public(name), name, module=False, globs={})
    test.globs, output = names, list[str]()
    result = doctest.DocTestRunner().run(test, out=output.append, clear_globs=False)
    assert (result.failed, "".join(output)) == (0, "")
    assert 1 <= result.attempted <= 6


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    """The variables after the example of `align`; `run_folder` adds those of `align_folder`."""
    names = {"agalign": agalign, "np": np}
    run_examples("align", names)
    return names


@pytest.fixture(scope="module")
def run_folder(
    flight: Path, aligned_flight: Path, tmp_path_factory: pytest.TempPathFactory, names: dict[str, Any]
) -> Path:
    """The files of the examples: a flight, its results by the example of `align_folder`, and two mosaics."""
    folder = tmp_path_factory.mktemp("examples")
    shutil.copytree(flight, folder / "flight")
    shutil.copytree(aligned_flight, folder / "aligned")
    with contextlib.chdir(folder):
        run_examples("align_folder", names)
    june, july = textured_pair(geometry.translation(6, -4), 320, 260)
    for name, image in (("june", june), ("july", july)):
        place = {"crs": "EPSG:32633", "transform": (0.1, 0, 500_000, 0, -0.1, 4_000_000)}
        write_band(folder / f"{name}.tif", np.float32(1000 + 100 * image), **place)
    return folder


@pytest.fixture
def in_run_folder(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a copy of the folder the current one, so that no example depends on another."""
    monkeypatch.chdir(shutil.copytree(run_folder, tmp_path / "examples"))


SHARED_EXAMPLES = ("align", "align_folder")
"""Their variables are used by other examples."""


@pytest.mark.slow
@pytest.mark.usefixtures("in_run_folder")
@pytest.mark.parametrize("name", [in_full_run(n) if n == "dask_executor" else n for n in (*CALLABLES, *CLASSES)])
def test_the_example_of_a_docstring(name: str, names: dict[str, Any]) -> None:
    for module in NEEDS.get(name, ()):
        pytest.importorskip(module)
    if name not in SHARED_EXAMPLES:  # which have run
        shared = ("agalign", "np", "green", "nir", "result", "settings", "reports")
        run_examples(name, {key: names[key] for key in shared})
