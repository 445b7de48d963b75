"""What says the same as pyproject.toml in another place."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import yaml

from agalign import __version__

ROOT = Path(__file__).resolve().parents[1]
NAMES_ON_CONDA_FORGE = {"opencv-python-headless": "py-opencv", "torch": "pytorch"}


def requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [f"python {project['requires-python']}", *(re.sub(r"(?=>=)", " ", d) for d in project["dependencies"])]


def test_the_conda_recipe_wants_what_the_project_wants() -> None:
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    wanted = {" ".join([NAMES_ON_CONDA_FORGE.get(d.split()[0], d.split()[0]), *d.split()[1:]]) for d in requirements()}
    assert set(recipe["requirements"]["run"]) == wanted


def test_the_image_has_hashes_of_all_that_the_project_wants() -> None:
    locked = "".join((ROOT / "locks" / n).read_text(encoding="utf-8") for n in ("image.txt", "torch-cpu.txt"))
    names = {line.partition("==")[0] for line in locked.splitlines() if line[:1].isalpha()}
    assert {d.split()[0] for d in requirements()[1:]} <= names
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").strip()
    assert f"{pinned}+cpu " in locked


def test_the_page_of_licences_is_whole() -> None:
    script = ROOT / "tools" / "licences.py"
    done = subprocess.run([sys.executable, script, "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_changes_begin_with_this_version() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+?),? ", changes, re.MULTILINE)[0] == __version__
