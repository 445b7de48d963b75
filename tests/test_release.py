"""What says the same as pyproject.toml in another place."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from agalign import __version__
from agalign.batch.capture_task import Task
from agalign.batch.run import Listener, capture_reports
from agalign.batch.workers import open_workers
from agalign.cameras.discover import discover
from agalign.host import processes
from agalign.method.device import limit_threads

from .conftest import seeded

ROOT = Path(__file__).resolve().parents[1]
NAMES_ON_CONDA_FORGE = {"opencv-python-headless": "py-opencv", "torch": "pytorch"}


def requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [f"python {project['requires-python']}", *(re.sub(r"(?=>=)", " ", d) for d in project["dependencies"])]


def test_the_conda_recipe_has_the_dependencies_of_the_project() -> None:
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    wanted = {" ".join([NAMES_ON_CONDA_FORGE.get(d.split()[0], d.split()[0]), *d.split()[1:]]) for d in requirements()}
    assert set(recipe["requirements"]["run"]) == wanted


def test_the_image_has_hashes_of_all_that_the_project_wants() -> None:
    locked = "".join((ROOT / "locks" / n).read_text(encoding="utf-8") for n in ("image.txt", "torch-cpu.txt"))
    names = {line.partition("==")[0] for line in locked.splitlines() if line[:1].isalpha()}
    assert {d.split()[0] for d in requirements()[1:]} <= names
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").strip()
    assert f"{pinned}+cpu " in locked


def test_the_changes_begin_with_this_version() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+?),? ", changes, re.MULTILINE)[0] == __version__


ENCODINGS_SAID = """
import sys, warnings
warnings.filterwarnings("ignore", category=EncodingWarning)  # of libraries
warnings.filterwarnings("error", category=EncodingWarning, module="agalign")
from agalign.__main__ import main
sys.argv[0] = "agalign"
main()
"""


@pytest.mark.full
def test_every_text_is_read_and_written_in_an_encoding_that_is_said(flight: Path, tmp_path: Path) -> None:
    """Where none is said it is the system's, which on Windows is not UTF-8."""
    options = ["--only-seed", "--layout", "both", "--error-map", "--tie-points"]
    for arguments in (["align", str(flight), "-o", str(tmp_path), *options], ["report", str(tmp_path)]):
        command = [sys.executable, "-X", "warn_default_encoding", "-c", ENCODINGS_SAID, *arguments]
        done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
        assert "EncodingWarning" not in done.stderr
        assert done.returncode in (0, 3), done.stderr


@pytest.mark.full
def test_processes_that_start_from_nothing(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows and macOS: they do not share the memory of this process."""
    monkeypatch.setattr(processes, "get_all_start_methods", lambda: ["spawn"])
    tasks = [Task(c, tmp_path, seeded()) for c in discover(flight).captures]
    with open_workers(None, 2, limit_threads) as run:
        assert [r.state for r in capture_reports(run, tasks, Listener(), None)] == ["done"] * len(tasks)
