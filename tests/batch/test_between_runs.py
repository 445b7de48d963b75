"""What happens to input and output files between two runs: good results stay, and what is used is compared before."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import agalign
from agalign.batch import capture_task
from agalign.batch.output_files import is_own
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, byte_string, read_directories
from agalign.records import sidecar_file
from agalign.records.run_record import read_run_record
from agalign.records.sidecar_file import find_sidecars, read_sidecar, verify_outputs
from agalign.values.alignment import Alignment

from ..builders import in_full_run
from ..conftest import Shared, read_json, seeded, write_capture
from ..program import agalign_here
from ..rasters.test_relief_map import Run
from ..run_outputs import facts_of, table_in

pytestmark = pytest.mark.slow

SEEDS = seeded("rig")
COMMAND = "--seed", "rig", "--only-seed"
FOLDER = Path("0000SET", "000")
GREEN, NIR = FOLDER / "IMG_0001_2.tif", FOLDER / "IMG_0001_4.tif"
"""Files of the reference and of a moving band."""


@pytest.fixture
def copy(flight: Path, tmp_path: Path) -> Path:
    """The images of a flight, which a test may change."""
    return shutil.copytree(flight, tmp_path / "flight")


@pytest.fixture
def out(flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """The output of a run that only finds initial alignments, which a test may change."""
    done = shared("seeded_flight", lambda folder: agalign.align_folder(flight, folder / "out", settings=SEEDS))
    return shutil.copytree(done / "out", tmp_path / "out")


def captures_in(out: Path, name: str = "IMG_*") -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (out / FOLDER).glob(name)}


def problems(out: Path) -> list[str]:
    return [text for _, texts in verify_outputs(out) for text in texts]


# ---- files of the input


def test_a_copy_of_the_input_is_the_same_input(copy: Path, out: Path) -> None:
    for path in copy.rglob("*.tif"):
        os.utime(path, (1, 1))
    before = captures_in(out)
    assert [r.state for r in agalign.align_folder(copy, out, settings=SEEDS)] == ["kept", "kept"]
    assert captures_in(out) == before


@pytest.mark.parametrize("where", ["samples", "elsewhere"])
def test_other_contents_of_equal_size_are_another_input(copy: Path, out: Path, where: str) -> None:
    """With the times of the first file where the samples differ; with new times anywhere."""
    agalign.align_folder(copy, out, settings=SEEDS)
    path = copy / NIR
    data, times = bytearray(path.read_bytes()), path.stat()
    middle = len(data) // 2 if where == "samples" else len(data) // 4
    data[middle : middle + 100] = bytes(b ^ 1 for b in data[middle : middle + 100])
    path.write_bytes(data)
    if where == "samples":
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    done = agalign_here(copy, "-o", out, *COMMAND)
    assert "1 finished capture to be estimated again; changed since: input files\n" in done.stderr


@pytest.mark.parametrize(
    ("harmed", "harm"),
    [
        (GREEN, "empty"),
        *(in_full_run(*pair) for pair in ((NIR, "removed"), (NIR, "cut short"), (GREEN, "removed"), (NIR, "empty"))),
    ],
)
def test_a_result_with_more_bands_is_kept(copy: Path, out: Path, harmed: Path, harm: str) -> None:
    before, path = captures_in(out), copy / harmed
    if harm == "removed":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: 0 if harm == "empty" else 3000 + path.stat().st_size // 2])
    for options in (("--retry-failed",), ("--crop", "none", "--relief", "never")):
        done = agalign_here(copy, "-o", out, *COMMAND, *options)
        assert done.returncode == 3
        lines = [line for line in done.stderr.splitlines() if "IMG_0001: kept as aligned before, and now" in line]
        assert len(lines) == 1
        assert harmed.name in lines[0]
        assert "--overwrite" in lines[0]
        assert {k: v for k, v in captures_in(out, "IMG_0001*").items() if before.get(k) != v} == {}
        assert read_json(out / "agalign-run.json")["captures"]["kept"] >= 1
    done = agalign_here("report", out)
    assert done.returncode == 3
    assert "1 of 2 captures was not processed, as input files are missing or damaged: " in done.stderr
    assert "resumes" not in done.stderr
    agalign_here(copy, "-o", out, *COMMAND, "--overwrite")
    assert captures_in(out)["IMG_0001.json"] != before["IMG_0001.json"]


def test_a_problem_of_a_file_says_whether_the_file_is_used(copy: Path, out: Path) -> None:
    tags = read_directories(copy / NIR)
    add_directories(copy / NIR, {XMP: byte_string(tags[0][XMP].data[:-200])}, tags[EXIF], tags[GPS])
    (copy / FOLDER / "IMG_0009_1.tif").write_bytes(b"")
    agalign.align_folder(copy, out, settings=SEEDS)
    kinds = {Path(part.of).name: part.kind for part in read_run_record(out).problems}
    assert kinds == {NIR.name: "used", "IMG_0009_1.tif": "skipped"}


def test_a_file_that_comes_back_needs_no_option(copy: Path, out: Path) -> None:
    data = (copy / NIR).read_bytes()
    (copy / NIR).unlink()
    assert agalign.align_folder(copy, out, settings=SEEDS)[0].problems
    (copy / NIR).write_bytes(data)
    reports = agalign.align_folder(copy, out, settings=SEEDS)
    assert [(r.state, r.problems) for r in reports] == [("kept", ())] * 2


def test_a_choice_of_bands_is_no_loss_and_is_named(flight: Path, out: Path) -> None:
    done = agalign_here(flight, "-o", out, *COMMAND, "--bands", "green,red,nir")
    assert "2 finished captures to be estimated again; changed since: --bands" in done.stderr
    done = agalign_here(flight, "-o", out, *COMMAND, "--bands", "green,red,nir", "--reference", "red")
    assert "2 finished captures to be estimated again; changed since: --reference\n" in done.stderr


def test_files_of_bands_that_are_not_chosen_may_be_in_another_folder(copy: Path, tmp_path: Path) -> None:
    """The halves of a dual camera write to a card each."""
    other, out = copy / "other card", tmp_path / "out"
    other.mkdir()
    _, second = (p.rename(other / p.name) for p in sorted(copy.glob("*/*/IMG_*_4.tif")))
    assert [len(r.result.bands) for r in agalign.align_folder(copy, out, settings=SEEDS)] == [5, 5]
    # A file of the same name in the folder of other bands is another file.
    shutil.copy(second, copy / FOLDER / second.name)
    second.unlink()
    chosen = agalign.DiscoverOptions(bands=("Green", "Red"))
    reports = {r.label: r for r in agalign.align_folder(copy, out, settings=SEEDS, options=chosen)}
    (done, kept) = (reports[(FOLDER / name).as_posix()] for name in ("IMG_0001", "IMG_0002"))
    assert (done.state, done.problems) == ("done", ())
    assert kept.state == "kept"
    assert "other card/IMG_0002_4.tif is missing" in kept.problems[0]


def test_a_band_that_other_captures_have_is_missing_when_a_capture_is_rendered_again(tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    write_capture(folder, "green", "red")
    settings = seeded("identity")
    (first,) = agalign.align_folder(folder, out, settings=settings)
    assert first.result.missing_bands == []
    for name in ("g", "h", "i"):
        write_capture(folder, "green", "red", "nir", name=name)
    reports = {r.label: r for r in agalign.align_folder(folder, out, settings=settings)}
    result = reports["f"].result
    assert len(result.output.bands) == 3
    assert (result.missing_bands, result.status) == (["nir"], "degraded")
    rows = [(row["band"], row["status"]) for row in table_in(out / "summary.csv") if row["capture"] == "f"]
    assert ("nir", "missing") in rows


# ---- files of the user in the output


@pytest.mark.parametrize(
    ("name", "option"),
    [("IMG_0001.qa.tif", "--qa"), ("IMG_0001.ties.csv", "--tie-points"), ("IMG_0001.error.tif", "--error-map")],
)
def test_files_of_the_user_are_kept_or_refused(flight: Path, out: Path, name: str, option: str) -> None:
    mine = out / FOLDER / name
    shutil.copy(flight / NIR, mine)
    data = mine.read_bytes()
    done = agalign_here(flight, "-o", out, *COMMAND, "--crop", "none")
    assert "2 finished captures to be rendered again" in done.stderr
    assert mine.read_bytes() == data
    done = agalign_here(flight, "-o", out, *COMMAND, option)
    assert done.returncode == 2
    assert f"{name}: was not written by agalign; choose another output folder with -o" in done.stderr
    assert mine.read_bytes() == data


@pytest.mark.full
def test_a_file_with_the_name_of_a_stack_is_kept(flight: Path, tmp_path: Path) -> None:
    agalign.align_folder(flight, tmp_path, settings=seeded("rig", layout="bands"))
    mine = tmp_path / FOLDER / "IMG_0001.tif"
    shutil.copy(flight / NIR, mine)
    data = mine.read_bytes()
    reports = agalign.align_folder(flight, tmp_path, settings=seeded("rig", layout="bands", crop="none"))
    assert [r.state for r in reports] == ["done"] * 2
    assert mine.read_bytes() == data


@pytest.mark.full
def test_every_output_has_the_mark_of_the_program(flight: Path, tmp_path: Path) -> None:
    """A run that is killed leaves files that no sidecar lists; the same command replaces them."""
    others = {"error_map": True, "tie_points": True, "indices": ("ndre",), "radiometry": "sun"}
    for name, options in (("gtiff", others), ("cog", {"format": "cog"})):
        settings = seeded("rig", layout="both", qa=True, **options)
        agalign.align_folder(flight, tmp_path / name, settings=settings)
        files = [path for path in (tmp_path / name / FOLDER).iterdir() if path.suffix != ".json"]
        assert [path.name for path in files if not is_own(path)] == []
    assert not any(is_own(path) for path in (flight / FOLDER).iterdir())


# ---- sidecars and parallax files


def moved(text: str) -> str:
    """A sidecar with 15 px added to the first homography."""
    at = text.index('"fixed_to_moving": [[') + len('"fixed_to_moving": [[')
    cells = text[at : text.index("]", at)].split(",")
    cells[2] = f"{float(cells[2]) + 15}"
    return text[:at] + ",".join(cells) + text[text.index("]", at) :]


REFUSED = "(was changed after it was written|has no checksum)"
EDITS: dict[str, Callable[[str], str]] = {
    "homography": moved,
    "status": lambda text: text.replace('"status": "seed_only"', '"status": "aligned"', 1),
    "no checksum": lambda text: re.sub(r'"checksum": "\w+"', '"checksum": null', moved(text)),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_sidecar_is_estimated_again_and_nothing_confirms_it(flight: Path, out: Path, edit: str) -> None:
    path = out / FOLDER / "IMG_0001.json"
    before = read_json(path)["checksum"]
    path.write_text(EDITS[edit](path.read_text()))
    assert any(re.search(REFUSED, text) for text in problems(out))
    indices = agalign_here("indices", out, "--formula", "sum=G+R")
    assert indices.returncode in (1, 3)
    assert re.search(rf"IMG_0001\.json: {REFUSED}.*; run again", indices.stderr)
    assert any(re.search(REFUSED, text) for text in problems(out))
    done = agalign_here(flight, "-o", out, *COMMAND)
    assert "1 finished capture to be estimated again; changed since: the sidecar (edited or damaged)" in done.stderr
    assert read_json(path)["checksum"] == before
    assert problems(out) == []


def test_an_edited_sidecar_is_not_exported(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    agalign.align_folder(flight, out, settings=seeded("rig", layout="bands"))
    path = out / FOLDER / "IMG_0001.json"
    path.write_text(moved(path.read_text()))
    done = agalign_here("export", out, "--for", "odm", "-o", tmp_path / "export")
    assert "IMG_0001: left out: " in done.stderr or "IMG_0001: " in done.stderr
    assert "was changed after it was written" in done.stderr
    assert not (tmp_path / "export" / "images").exists()


def test_a_sidecar_of_another_capture_is_found(out: Path) -> None:
    shutil.copy(out / FOLDER / "IMG_0002.json", out / FOLDER / "IMG_0001.json")
    assert problems(out) == [f"{out / FOLDER / 'IMG_0001.json'}: belongs to IMG_0002; delete it and run again"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("relief"))


@pytest.mark.parametrize("harm", ["another of equal size", in_full_run("cut short"), in_full_run("empty")])
def test_a_parallax_that_is_not_the_listed_one_is_estimated_again(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harm: str
) -> None:
    folder, calls = run.capture.reference.path.parents[2], []

    def align(*_: object) -> dict[str, Alignment]:
        calls.append(1)
        return run.on_hill()

    monkeypatch.setattr(capture_task, "align_capture_bands", align)
    (report,) = agalign.align_folder(folder, tmp_path, settings=seeded())
    parallax = report.path.with_suffix(".parallax.tif")
    data = parallax.read_bytes()
    harmed = {"another of equal size": data[:-200] + bytes(200), "cut short": data[: len(data) // 2], "empty": b""}
    parallax.write_bytes(harmed[harm])
    with pytest.raises(agalign.SidecarError, match=r"parallax\.tif: is not what was written; delete it and run again"):
        agalign.read_alignment(report.path, "NIR")
    (report,) = agalign.align_folder(folder, tmp_path, settings=seeded(crop="none"))
    assert (report.state, report.problems, len(calls)) == ("done", (), 2)
    assert parallax.read_bytes() == data
    assert problems(tmp_path) == []


def test_a_resumed_run_compares_each_sidecar_with_its_checksum_once(
    flight: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That takes five times as long as parsing it."""
    agalign_here(flight, "-o", out, *COMMAND)  # it writes the pages of a copied folder
    compared, checksum = [], sidecar_file.content_checksum

    def counted(text: bytes) -> str:
        compared.append(json.loads(text)["capture"])
        return checksum(text)

    monkeypatch.setattr(sidecar_file, "content_checksum", counted)
    done = agalign_here(flight, "-o", out, *COMMAND)
    assert done.stderr.count("kept from an earlier run") == 2
    assert sorted(compared) == [path.stem for path in find_sidecars(out)]


def test_another_limit_of_predicted_bands_renders_and_changes_the_status(
    flight: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("estimated again")

    monkeypatch.setattr(capture_task, "align_capture_bands", fail)
    done = agalign_here(flight, "-o", out, *COMMAND, "--accept-predicted", "0.8")
    assert "2 finished captures to be rendered again; changed since: --accept-predicted\n" in done.stderr
    sidecars = [read_sidecar(path) for path in find_sidecars(out)]
    assert [s.accept_predicted_px for s in sidecars] == [0.8] * 2
    assert [s.options["check"] for s in sidecars] == [{"accept_predicted_px": 0.8}] * 2
    again = agalign_here(flight, "-o", out, *COMMAND, "--accept-predicted", "0.8")
    assert again.stderr.count("kept from an earlier run") == 2


def test_records_of_other_versions(out: Path) -> None:
    path = out / "agalign-run.json"
    record = read_json(path)
    path.write_text(json.dumps({**record, "agalign": "0.0.9", "another field": 1}))
    assert agalign_here("verify", out).stderr == ""
    del record["versions"], record["machine"]
    path.write_text(json.dumps(record))
    assert agalign_here("verify", out).stderr == ""
    path.write_text(json.dumps({**record, "schema": "agalign-run/0", "agalign": "0.0.1"}))
    done = agalign_here("verify", out)
    assert done.returncode == 3
    assert "agalign-run.json: was written by agalign 0.0.1 and cannot be read by agalign" in done.stderr
    assert "run again into a new folder" in done.stderr


# ---- deleted products


@pytest.mark.full
def test_a_deleted_quality_raster_is_restored_by_the_last_command(flight: Path, out: Path) -> None:
    agalign.align_folder(flight, out, settings=seeded("rig", qa=True))
    raster = out / FOLDER / "IMG_0001.qa.tif"
    data = raster.read_bytes()
    raster.unlink()
    assert len(problems(out)) == 1
    for settings in (SEEDS, seeded("rig", crop="none")):
        agalign.align_folder(flight, out, settings=settings)
        assert raster.exists()
        assert problems(out) == []
    agalign.align_folder(flight, out, settings=seeded("rig", qa=True))
    assert raster.read_bytes() == data


@pytest.mark.full
def test_a_deleted_index_is_reported_until_its_command_restores_it(
    flight: Path, aligned_flight: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(aligned_flight, tmp_path / "out")
    command = "indices", out, "--formula", "sum=G+R"
    agalign_here(*command)
    raster = out / FOLDER / "IMG_0001_sum.tif"
    raster.unlink()
    for options in ((), ("--interpolation", "bilinear")):
        agalign_here(flight, "-o", out, *options)
        assert problems(out) == [f"{raster}: cannot be read (No such file or directory); run 'agalign indices' again"]
    agalign_here(*command)
    assert raster.exists()
    assert problems(out) == []


@pytest.mark.full
def test_the_table_of_indices_has_no_unmasked_row_among_masked_ones(
    flight: Path, aligned_flight: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(aligned_flight, tmp_path / "out")
    command = "indices", out, "--formula", "sum=G+R"
    agalign_here(flight, "-o", out, "--qa")
    agalign_here(*command)
    raster = out / FOLDER / "IMG_0002.qa.tif"
    raster.unlink()
    assert agalign_here(*command, "--mask-qa").returncode == 3
    first, second = table_in(out / "indices.csv")
    assert first["median"]
    assert (second["median"], second["file"]) == ("", "")
    assert "not masked by quality flags, unlike those of most captures" in second["problem"]
    shown = [record["indices"] for record in facts_of(out)["details"]["records"]]
    assert [len(of_capture) for of_capture in shown] == [1, 0]
    agalign_here(flight, "-o", out)
    assert agalign_here(*command, "--mask-qa").returncode == 0
    assert all(row["median"] and row["file"] for row in table_in(out / "indices.csv"))
    assert problems(out) == []
