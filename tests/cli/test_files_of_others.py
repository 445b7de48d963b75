"""No command replaces a file that it did not write."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from ..program import agalign_here

pytestmark = pytest.mark.slow
ONLY_SEEDS = "--seed", "rig", "--only-seed"


def raw(out: Path, flight: Path) -> Path:
    """An image of the flight at the place of a stack."""
    place = out / "0000SET" / "000" / "IMG_0001.tif"
    place.parent.mkdir(parents=True)
    return Path(shutil.copy(next(flight.rglob("IMG_0001_1.tif")), place))


def page(out: Path, _: Path) -> Path:
    """A page of a web site."""
    out.mkdir()
    (out / "index.html").write_text("a site")
    return out / "index.html"


def record(out: Path, _: Path) -> Path:
    """A file of another program with the name of the run record."""
    out.mkdir()
    (out / "agalign-run.json").write_text("{}")
    return out / "agalign-run.json"


def settings(out: Path, _: Path) -> Path:
    """JSON of another program at the place of a sidecar."""
    place = out / "0000SET" / "000" / "IMG_0001.json"
    place.parent.mkdir(parents=True)
    place.write_text("{}")
    return place


@pytest.mark.parametrize("make", [raw, page, record, settings])
def test_a_run_refuses_a_folder_with_files_of_its_names(
    flight: Path, tmp_path: Path, make: Callable[[Path, Path], Path]
) -> None:
    path = make(tmp_path / "out", flight)
    before = path.read_bytes()
    done = agalign_here(flight, "-o", tmp_path / "out", *ONLY_SEEDS)
    assert done.returncode == 2
    assert f"{path}: was not written by agalign; choose another output folder with -o" in done.stderr
    assert path.read_bytes() == before
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == [path]


@pytest.mark.parametrize("command", ["learn", "surface", "evaluate"])
def test_experiments_replace_no_image(flight: Path, tmp_path: Path, command: str) -> None:
    image = Path(shutil.copy(next(flight.rglob("IMG_0001_1.tif")), tmp_path / "image.tif"))
    pairs = tmp_path / "pairs.csv"
    pairs.write_text(f"fixed,moving,homography\n{image},{image},1 0 0 0 1 0 0 0 1\n")
    before = image.read_bytes()
    done = agalign_here(command, pairs, "-o", image)
    assert done.returncode == 2
    assert "image.tif: exists already; choose another name with -o, or delete it" in done.stderr
    assert image.read_bytes() == before
