"""What the examples say without the arguments that they need."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("*.py"))


@pytest.mark.parametrize(
    "path", [path for path in EXAMPLES if "sys.argv" in path.read_text(encoding="utf-8")], ids=lambda path: path.stem
)
def test_an_example_without_arguments_prints_its_usage(path: Path) -> None:
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"usage: python examples/{path.name} ")
    assert done.stderr.removeprefix("usage: ").strip() in path.read_text(encoding="utf-8")
