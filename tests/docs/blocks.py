"""The commands and the Python of the documents, in the order in which a reader meets them.

A block of ```sh``` is commands, one a line; one of ```python``` is a script; ```text``` is neither.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from ..program import agalign_here

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def each_page(pages: Iterable[Path] = PAGES) -> pytest.MarkDecorator:
    """Run a test for each of these pages."""
    return pytest.mark.parametrize("page", [pytest.param(p, id=p.relative_to(ROOT).as_posix()) for p in pages])


def text_of(page: Path) -> str:
    """The text of a page without blocks."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    page: Path
    line: int
    kind: str
    text: str

    @property
    def where(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks_of(page: Path) -> Iterator[Block]:
    """All fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    for found in re.finditer(r"^```(.*?)\n(.*?)\n?^```", text, re.MULTILINE | re.DOTALL):
        yield Block(page, text.count("\n", 0, found.start()) + 1, found[1].strip(), found[2])


def commands_of(block: Block) -> list[str]:
    """The commands of a block, with lines that go on put together, without comments."""
    whole = re.sub(r"\s*\\\n\s*", " ", block.text)
    return [bare for line in whole.splitlines() if (bare := re.sub(r"(^|\s)#.*$", "", line).strip())]


def program(command: str) -> str:
    """The name of the program that a command starts, whatever is set before it."""
    return next(word for word in command.split() if not re.fullmatch(r"\w+=\S*", word))


def run_command(command: str, where: str, codes: Sequence[int] = (0,)) -> None:
    """Run agalign in this process, which has loaded everything, and other programs in a shell; it must succeed, or
    return one of these exit codes.
    """
    first, *arguments = shlex.split(command)
    if first == "agalign":
        is_glob = ["*" in a and f"'{a}'" not in command for a in arguments]  # a shell does not expand quoted ones
        found = [sorted(map(str, Path().glob(a))) if g else [a] for a, g in zip(arguments, is_glob, strict=True)]
        done = agalign_here(*(argument for part in found for argument in part))
    else:
        tools = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        variables = os.environ | {"PYTHONPATH": str(ROOT), "PATH": tools}
        done = subprocess.run(["bash", "-c", command], env=variables, capture_output=True, text=True, check=False)
    assert done.returncode in codes, f"{where}: {command}\n{done.stdout[-1500:]}{done.stderr[-3000:]}"
