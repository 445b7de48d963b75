"""Nothing in the documents rots: every command and every script in them is run, every link leads somewhere."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import agalign
from agalign.values import geometry

from ..conftest import REAL_DATA, textured_image
from ..test_api import TRUTH
from .blocks import PAGES, ROOT, Block, blocks_of, commands_of, program

RUN_BY = {
    "docker": "tools/container.sh",
    "dask": "tools/dask_cluster.sh",
    "pip": ".ci/run",
}
"""What cannot be run inside a test, and the script that runs it and what stands with it in a block."""
KINDS = {"sh", "python", "text", "{toctree}", "{include} ../CONTRIBUTING.md", "{include} ../CHANGELOG.md"}
RUNNABLE = [page for page in PAGES if any(b.kind in ("sh", "python") for b in blocks_of(page))]
PREAMBLE = """
import tifffile
green = tifffile.imread("flight/0000SET/000/IMG_0001_2.tif")
nir = tifffile.imread("flight/0000SET/000/IMG_0001_4.tif")
"""


def run(block: Block, command: list[str], folder: Path) -> None:
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    tools = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": paths, "PATH": tools},
    )  # fmt: skip
    assert done.returncode == 0, f"{block.where}: {shlex.join(command)}\n{done.stdout[-1500:]}{done.stderr[-3000:]}"


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNABLE, ids=[p.relative_to(ROOT).as_posix() for p in RUNNABLE])
def test_a_page_does_what_it_says(page: Path, desk: Path, tmp_path: Path) -> None:
    """Read from top to bottom, in a folder with a flight in it."""
    folder = tmp_path / "desk"
    shutil.copytree(desk, folder)
    for name in ("examples", "benchmarks"):
        (folder / name).symlink_to(ROOT / name)
    if REAL_DATA.is_dir():
        (folder / "DATA").symlink_to(REAL_DATA)
    for block in blocks_of(page):
        if named := re.match(r"# (\w+\.py)\n", block.text):
            (folder / named[1]).write_text(block.text, encoding="utf-8")
        if block.kind == "python":
            run(block, [sys.executable, "-c", PREAMBLE + block.text], folder)
        commands = commands_of(block) if block.kind == "sh" else []
        if " DATA " in block.text and not REAL_DATA.is_dir():
            pytest.skip(f"{block.where} is about real captures, which are not at {REAL_DATA}")
        if not any(program(command) in RUN_BY for command in commands):
            for command in commands:
                run(block, ["bash", "-c", command], folder)


def test_the_python_of_the_readme_aligns_pixels() -> None:
    """NIR has reversed contrast, a hole of NaN, and a displacement of 1.5 px that no homography represents."""
    displaced = SmoothPair()
    (block,) = (b for b in blocks_of(ROOT / "README.md") if b.kind == "python")
    names: dict[str, Any] = {"green": displaced.green, "nir": displaced.nir}
    exec(block.text.partition("reports =")[0], names)
    result, nir_on_green, valid = (names[name] for name in ("result", "nir_on_green", "valid"))
    errors_px = np.linalg.norm(result.map(displaced.pixels) - displaced.truth(displaced.pixels), axis=-1)
    assert np.median(errors_px) <= 0.1
    assert np.percentile(errors_px, 95) <= 0.3
    assert valid.mean() > 0.9
    assert np.isfinite(nir_on_green[valid]).all()
    assert np.isnan(nir_on_green[~valid]).all()
    difference = np.abs(nir_on_green - displaced.nir_on_green)[valid]
    assert np.median(difference) < 0.05 * displaced.nir_on_green.std()
    assert np.percentile(difference, 95) < 0.15 * displaced.nir_on_green.std()
    _, masked = result.warp(displaced.nir, valid=np.isfinite(displaced.nir) & (displaced.nir < 0))
    assert (displaced.nir_on_green[masked] < 0.2).all()


class SmoothPair:
    """Two views of one texture with known positions of every pixel."""

    size_px = 640, 480
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in size_px)), axis=-1).astype(float)

    def __init__(self) -> None:
        self.canvas = cv2.GaussianBlur(textured_image(2280, 1800), (0, 0), 1.5)
        moving = self.pixels
        for _ in range(30):  # to the pixel of green for each of NIR
            moving = moving - (self.truth(moving) - self.pixels)
        green = self._view(self.pixels)
        self.green, self.nir, self.nir_on_green = green, self._toned(self._view(moving)), self._toned(green)
        self.nir[200:230, 300:340] = np.nan

    @staticmethod
    def truth(points: np.ndarray) -> np.ndarray:
        waves = np.stack([np.sin(points[..., 1] / 127), np.cos(points[..., 0] / 127)], axis=-1)
        return geometry.apply(TRUTH, points + 1.5 * waves)

    def _view(self, points: np.ndarray) -> np.ndarray:
        at = (3 * points + 181).astype(np.float32)
        return cv2.remap(self.canvas, at[..., 0], at[..., 1], cv2.INTER_CUBIC)

    @staticmethod
    def _toned(image: np.ndarray) -> np.ndarray:
        return np.asarray(-image + 0.15 * image**2)


def test_every_block_says_what_it_is() -> None:
    """One without a kind would be run by nobody."""
    blocks = [block for page in PAGES for block in blocks_of(page)]
    assert blocks
    for block in blocks:
        assert block.kind in KINDS, block.where


def test_what_is_not_run_here_is_run_elsewhere() -> None:
    seen = set()
    for page in PAGES:
        for block in blocks_of(page):
            for command in commands_of(block) if block.kind == "sh" else ():
                if program(command) in RUN_BY:
                    seen.add(program(command))
    assert seen == set(RUN_BY)
    assert all((ROOT / script).is_file() for script in RUN_BY.values())


def test_extras_that_are_named_can_be_had() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = {name for names in re.findall(r"agalign\[([\w,]+)\]", text) for name in names.split(",")}
    assert named
    assert named <= set(extras)


@pytest.mark.parametrize("page", PAGES, ids=[p.relative_to(ROOT).as_posix() for p in PAGES])
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        result = (page.parent / path) if path else page
        if not result.suffix and not result.exists():
            result = result.with_suffix(".md")
        assert result.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.+)$", result.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in heads}, target


def test_options_in_the_documents_exist() -> None:
    known = set()
    for command in (["--help"], ["align", "--help"]):
        done = subprocess.run(
            [sys.executable, "-m", "agalign", *command], capture_output=True, text=True, check=True,
            env=os.environ | {"COLUMNS": "300"},
        )  # fmt: skip
        known |= set(re.findall(r"--[a-z][\w-]+", done.stdout))
    names = "README.md", "docs/options.md", "docs/quickstart.md", "docs/troubleshooting.md"
    for page in (ROOT / name for name in names):
        named = set(re.findall(r"[` ](--[a-z][\w-]+)", page.read_text(encoding="utf-8")))
        assert named, page
        assert named <= known, page


def test_generated_tables_are_current() -> None:
    done = subprocess.run(
        [sys.executable, "tools/pages.py", "--check"], cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_site_is_built(tmp_path: Path) -> None:
    """Every page, and what the docstrings say, without a warning."""
    pytest.importorskip("sphinx")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(ROOT / "docs"), str(tmp_path / "site")],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    described = set(re.findall(r'descname"><span class="pre">(\w+)<', page))
    assert set(agalign.__all__) - {"__version__"} <= described
