"""What a run prints about the files that it found."""

from pathlib import Path

import pytest

from agalign.cameras.discover import FolderScan, Problem
from agalign.cli.run import print_problems
from agalign.cli.terminal import Terminal
from agalign.errors import UnreadableFileError


def problem(name: str, text: str) -> Problem:
    path = Path("flight", name)
    return Problem(path, UnreadableFileError(f"{path}: {text}"))


SCAN = FolderScan(
    Path("flight"), (),
    (*(problem(f"f{n:04d}.tif", f"is empty, {n} bytes") for n in range(4000)), problem("x.tif", "cannot be read")),
)  # fmt: skip


def test_many_files_with_one_problem_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    print_problems(SCAN, Terminal(quiet=False, verbose=False, log_json=False))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "agalign: flight/f0000.tif: is empty, 0 bytes"
    assert lines[10:] == [
        "agalign: flight/x.tif: cannot be read",
        "agalign: flight: 3990 more files with the same problem as f0009.tif; 'agalign info --json' lists all",
    ]


def test_the_json_log_has_every_file(capsys: pytest.CaptureFixture[str]) -> None:
    print_problems(SCAN, Terminal(quiet=False, verbose=False, log_json=True))
    assert len(capsys.readouterr().err.splitlines()) == 4001
