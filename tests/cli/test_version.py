"""The output of `agalign --version`."""

import re
import sys
from importlib import metadata

import pytest

import agalign
from agalign.host import libraries

from ..program import agalign_here


def version_lines() -> list[str]:
    done = agalign_here("--version")
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_it_prints_versions_devices_and_limits_on_one_screen() -> None:
    lines = version_lines()
    assert lines[0] == f"agalign {agalign.__version__}"
    assert f"torch {metadata.version('torch')}" in lines
    text = "\n".join(lines)
    assert re.search(r"^cores [1-9]\d* usable of \d+$", text, re.MULTILINE)
    assert re.search(r"^gdal \d+\.\d+", text, re.MULTILINE)
    assert re.search(r"^device cpu: \w+, \d+ threads$", text, re.MULTILINE)
    assert len(lines) <= 24


def test_a_library_that_cannot_be_loaded_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "agalign.method.device", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    *others, last = version_lines()
    assert last.startswith("device unknown: ")
    assert "torch" in last
    assert f"numpy {metadata.version('numpy')}" in others


@pytest.mark.parametrize(
    ("limit_bytes", "memory"), [(1e15, "memory 8.0 GB"), (2e9, "memory 8.0 GB, limited to 2.0 GB")]
)
def test_the_memory_has_its_limit(monkeypatch: pytest.MonkeyPatch, limit_bytes: float, memory: str) -> None:
    sizes = {"SC_PAGE_SIZE": 4000, "SC_PHYS_PAGES": 2_000_000}
    monkeypatch.setattr("os.sysconf", sizes.get, raising=False)
    monkeypatch.setattr("agalign.cli.version.memory_limit_bytes", lambda: limit_bytes)
    assert memory in version_lines()


def test_its_libraries_are_those_of_the_package() -> None:
    requirements = metadata.requires("agalign") or []
    by_extra = {is_extra: {r for r in requirements if ("extra ==" in r) == is_extra} for is_extra in (True, False)}
    names = {k: {re.match(r"[\w.-]+", r)[0].lower() for r in found} for k, found in by_extra.items()}
    assert set(libraries.REQUIRED) <= names[False]
    assert set(libraries.OPTIONAL) <= names[True]
