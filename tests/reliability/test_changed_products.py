"""Files of a run that were exchanged, reversed, truncated or overwritten: no command uses them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio

import agalign
from agalign.records import listed_files
from agalign.records.run_record import file_states
from agalign.records.sidecar_file import read_checked

from ..builders import in_full_run
from ..conftest import Shared
from ..program import agalign_here

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
OPTIONS = "--layout", "both", "--qa", "--error-map", "--georeference", "--ground-elevation", "0"
PRODUCTS = {"stack": "{}.tif", "band": "{}_4.tif", "index": "{}_ndvi.tif", "picture": "{}.png", "qa": "{}.qa.tif"}
Change = Callable[[Path, Path], None]


def exchanged(path: Path, other: Path) -> None:
    kept = path.with_name("kept")
    path.rename(kept)
    other.rename(path)
    kept.rename(other)


def reversed_rows(path: Path, _: Path) -> None:
    """The time of the last modification is set back."""
    before = path.stat()
    if path.suffix == ".tif":
        with rasterio.open(path, "r+") as dataset:
            dataset.write(np.flip(dataset.read() + 1, 1))
    else:
        path.write_bytes(path.read_bytes()[::-1])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def truncated(path: Path, _: Path) -> None:
    os.truncate(path, path.stat().st_size * 2 // 3)


def zeros(path: Path, _: Path) -> None:
    before = path.stat()
    path.write_bytes(bytes(before.st_size))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.fixture
def run(flight: Path, aligned_flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """A copy of the aligned flight with every kind of file, which the run record knows, and its copy `before`."""

    def fill(folder: Path) -> None:
        shutil.copytree(aligned_flight, folder, dirs_exist_ok=True)
        assert agalign_here(flight, "-o", folder, *OPTIONS).returncode == 0
        assert agalign_here("indices", folder).returncode == 0

    made = shared("every product", fill)
    shutil.copytree(made, tmp_path / "before")
    out = Path(shutil.copytree(made, tmp_path / "out"))
    assert agalign_here(flight, "-o", out, *OPTIONS).returncode == 0
    return out


def contents(out: Path) -> dict[str, bytes]:
    """The pixels of all captures."""
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.suffix in (".tif", ".png")}


IN_EVERY_RUN = ("stack", exchanged), ("band", zeros), ("index", reversed_rows), ("picture", truncated)
CASES = [(product, change) for product in PRODUCTS for change in (exchanged, reversed_rows, truncated, zeros)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("product", "change"), [case if case in IN_EVERY_RUN else in_full_run(*case) for case in CASES]
)
def test_no_command_uses_a_file_that_was_changed(
    flight: Path, run: Path, tmp_path: Path, product: str, change: Change
) -> None:
    folder = run / "0000SET" / "000"
    path, other = (folder / PRODUCTS[product].format(name) for name in ("IMG_0001", "IMG_0002"))
    change(path, other)
    again = "run 'agalign indices' again" if product == "index" else "run again"
    said = f"{path}: is not what was written; delete it and {again}"
    done = agalign_here("verify", run)
    assert (done.returncode, said in done.stderr) == (3, True)
    done = agalign_here("report", run)
    assert (done.returncode, said in done.stderr) == (3, True)
    if product in ("stack", "qa"):
        done = agalign_here("indices", run, "-i", "ndre", "--mask-qa", "-o", tmp_path / "indices")
        assert (done.returncode, said in done.stderr) == (1 if change is exchanged else 3, True)
    if product in ("stack", "band"):
        done = agalign_here("export", run, "--for", "pix4d", "-o", tmp_path / "export")
        assert said in done.stderr
        assert done.returncode == (1 if change is exchanged else 3)
        files = {p.name for p in (tmp_path / "export").rglob("*.tif")}
        assert not any(name.startswith("0000SET_000_IMG_0001") for name in files)
    if product == "stack":
        with pytest.raises(agalign.UnreadableFileError, match="is not what was written"):
            agalign.open_capture(path)
        done = agalign_here("onto", other, path, "-o", tmp_path / "onto")
        assert done.returncode == 1
        assert "IMG_0001.tif: " in done.stderr or "IMG_0002.tif: is not what was written" in done.stderr
        assert not (tmp_path / "onto").exists()
    if product == "index":
        (row,) = [r for r in agalign.indices(run) if r.capture.endswith("IMG_0001")]
        assert not row.kept
        # Zeros have no mark, and an incomplete raster is written again; one that may have been edited is not.
        problems = {zeros: "was not written by agalign", truncated: "", exchanged: said, reversed_rows: said}
        assert problems[change] in row.problem
        assert bool(row.problem) is (change is not truncated)
    done = agalign_here(flight, "-o", run, *OPTIONS)
    if (product, change) != ("index", zeros):  # no command knows its formula
        assert contents(run) == contents(tmp_path / "before")
        assert agalign_here("verify", run).returncode == 0


@pytest.mark.slow
def test_a_stack_of_zeros_is_rendered_again_by_a_run_with_other_options(flight: Path, run: Path) -> None:
    path = run / "0000SET" / "000" / "IMG_0001.tif"
    good = path.read_bytes()
    zeros(path, path)
    done = agalign_here(flight, "-o", run, *OPTIONS, "--dry-run")
    assert "to be rendered again; changed since: files that are not as they were written" in " ".join(
        done.stdout.split()
    )
    agalign_here(flight, "-o", run, *OPTIONS, "--tie-points")
    assert path.read_bytes() == good


@pytest.mark.slow
def test_a_run_reads_only_files_that_changed_since_the_last_one(
    flight: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, checksum = list[object](), listed_files._checksum
    monkeypatch.setattr(listed_files, "_checksum", lambda file: (read.append(file), checksum(file))[1])
    assert agalign_here(flight, "-o", run, *OPTIONS).returncode == 0
    assert read == []
    states = file_states(run)
    sidecars = {label: read_checked(run / f"{label}.json") for label in states}
    assert {label: len(one.split()) for label, one in states.items()} == {k: len(s.files) for k, s in sidecars.items()}
    stack = run / "0000SET" / "000" / "IMG_0001.tif"
    shutil.copy2(stack, stack.with_name("copy"))
    stack.with_name("copy").replace(stack)
    assert agalign_here(flight, "-o", run, *OPTIONS).returncode == 0
    assert len(read) == 1


@pytest.mark.slow
def test_a_deleted_result_is_forgotten_so_that_a_later_file_in_its_place_is_the_user_s(flight: Path, run: Path) -> None:
    first, second = sorted(file_states(run))
    for path in (run / second).parent.glob("IMG_0002*"):
        path.unlink()
    assert agalign_here(flight, "-o", run, *OPTIONS, "--exclude", "IMG_0002_*").returncode == 0
    assert [*file_states(run)] == [first]
    mine = run / f"{second}.json"
    mine.write_text('{"schema": "mine"}')
    done = agalign_here(flight, "-o", run, *OPTIONS)
    assert (done.returncode, mine.read_text()) == (2, '{"schema": "mine"}')


@pytest.mark.slow
@pytest.mark.parametrize("copied", [False, True], ids=["exchanged", "copied"])
def test_no_command_uses_the_sidecar_of_another_capture(
    flight: Path, run: Path, tmp_path: Path, *, copied: bool
) -> None:
    folder = run / "0000SET" / "000"
    first, second = folder / "IMG_0001.json", folder / "IMG_0002.json"
    if copied:
        shutil.copy(second, first)
    else:
        exchanged(first, second)
    for command in (
        ["verify", run],
        ["report", run],
        ["indices", run, "-o", tmp_path / "indices"],
        ["export", run, "--for", "pix4d", "-o", tmp_path / "export"],
    ):
        done = agalign_here(*command)
        assert f"{first}: belongs to IMG_0002; delete it and run again" in done.stderr, command
        assert done.returncode == (3 if copied or command[0] in ("verify", "report") else 1), command
    assert agalign_here(flight, "-o", run, *OPTIONS).returncode == 2
