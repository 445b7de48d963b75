"""What the examples say without the arguments that they need."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize(
    "path", [path for path in EXAMPLES if "sys.argv" in path.read_text(encoding="utf-8")], ids=lambda path: path.stem
)
def test_an_example_without_arguments_prints_its_usage(path: Path) -> None:
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"usage: python examples/{path.name} ")
    assert done.stderr.removeprefix("usage: ").strip() in path.read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_a_season_continues_after_a_flight_that_fails(tmp_path: Path) -> None:
    program = tmp_path / "bin" / "agalign"
    program.parent.mkdir()
    codes = '*a/*) exit 1;; *b/*) exit 3;; "indices aligned/d") exit 143;;'
    program.write_text(f'#!/bin/sh\ncase "$1 $2" in {codes} esac\n')
    program.chmod(0o755)
    for name in "abcd":
        (tmp_path / "season" / name).mkdir(parents=True)
    command = ["make", "-f", ROOT / "examples" / "flights.mk", "FLIGHTS=season", "OUT=aligned"]
    environment = os.environ | {"PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, "a.done" in done.stderr, "d.done" in done.stderr) == (2, True, True)
    assert sorted(p.name for p in (tmp_path / "aligned").iterdir()) == ["b.done", "c.done", "incomplete.txt"]


def test_a_job_writes_to_its_volume_as_the_user_of_the_image() -> None:
    user = re.search(r"^USER (\d+)", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert user is not None
    assert f"fsGroup: {user[1]}" in (ROOT / "examples" / "kubernetes-job.yaml").read_text(encoding="utf-8")
