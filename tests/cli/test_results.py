"""The commands on the output folder of a run that was killed, or that lacks captures."""

import json
import shutil
from pathlib import Path

import pytest
import rasterio

import agalign
from agalign.batch import capture_task
from agalign.cli import align_run
from agalign.cli.align_run import conclude
from agalign.cli.terminal import Terminal
from agalign.records.captures import captures_of_run
from agalign.records.panels_and_sky import read_sky
from agalign.records.run_record import read_run_record, unfinished_run
from agalign.records.sidecar_file import find_sidecars, read_sidecar, write_sidecar

from ..builders import in_full_run
from ..conftest import Shared, raising, read_json, seeded, write_band, write_capture
from ..program import agalign_here
from ..run_outputs import change, table_in

pytestmark = pytest.mark.slow

FIRST, SECOND = "0000SET/000/IMG_0001", "0000SET/000/IMG_0002"
ALIGNED = {"status": "aligned", "reason": None, "issues": ()}


def accept_seeds(out: Path) -> None:
    """Make the captures of a run that estimates nothing count as `ok`."""
    for path in find_sidecars(out):
        sidecar = read_sidecar(path)
        bands = [b if b.status == "reference" else b.model_copy(update=ALIGNED) for b in sidecar.bands]
        write_sidecar(path, sidecar.model_copy(update={"status": "ok", "bands": bands}))


@pytest.fixture
def out(flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """The output of a run, by the tags alone to save time: its captures count as `ok`."""

    def fill(folder: Path) -> None:
        agalign.align_folder(flight, folder, settings=seeded("rig", layout="both"))
        accept_seeds(folder)

    return shutil.copytree(shared("finished_run", fill), tmp_path / "out")


COMMANDS = {"report": (), "verify": (), "indices": ("--formula", "a=N-R"), "export": ("--for", "odm", "-o", "exported")}


def arguments(command: str, out: Path) -> list[object]:
    return [command, out, *(out.parent / "exported" if a == "exported" else a for a in COMMANDS[command])]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_on_a_run_name_its_state_and_the_captures_without_a_result(command: str, out: Path) -> None:
    assert read_run_record(out).labels == [FIRST, SECOND]
    done = agalign_here(*arguments(command, out))
    assert (done.returncode, "no result" in done.stderr) == (0, False)
    shutil.rmtree(out.parent / "exported", ignore_errors=True)
    (out / f"{SECOND}.json").unlink()
    resume = "the same command resumes it"
    without = f"1 of 2 captures has no result: {SECOND}"
    for state, line in (
        ("finished", f"{without}; {resume}"),
        ("interrupted", f"the run was stopped before its end; {without}; {resume}"),
        ("running", f"the run did not end: it was killed, or is still running; {without}; {resume}"),
    ):
        change(out / "agalign-run.json", state=state)
        done = agalign_here(*arguments(command, out))
        assert done.returncode == 3
        assert f"agalign: {out}: {line}\n" in done.stderr
        shutil.rmtree(out.parent / "exported", ignore_errors=True)


def test_one_capture_is_counted_in_the_singular(out: Path) -> None:
    change(out / "agalign-run.json", labels=[FIRST])
    for path in out.glob(f"{SECOND}*"):
        path.unlink()
    assert "1 of 1 capture matches its checksums" in agalign_here("verify", out).stdout
    assert "1 capture, 5 files in " in agalign_here(*arguments("export", out)).stdout


def images_of_first(folder: Path) -> list[Path]:
    return sorted(folder.rglob("IMG_0001_*.tif"))


def without_tags(source: str, target: str) -> None:
    with rasterio.open(source) as file:
        write_band(Path(target), file.read())


def captures_in(table: Path) -> set[str]:
    return {row["capture"] for row in table_in(table)}


@pytest.mark.full
@pytest.mark.parametrize("has_id", [True, in_full_run(False)])
def test_a_renamed_exposure_counts_once(flight: Path, tmp_path: Path, has_id: bool) -> None:
    out = tmp_path / "out"
    folder = shutil.copytree(flight, tmp_path / "in", copy_function=shutil.copyfile)
    for path in [] if has_id else folder.rglob("*.tif"):
        without_tags(str(path), str(path))
    settings = seeded("rig" if has_id else None, layout="both")
    agalign.align_folder(folder, out, settings=settings)
    if has_id:
        accept_seeds(out)
        assert agalign_here(*arguments("indices", out)).returncode == 0
    for path in images_of_first(folder):
        path.rename(path.with_name(path.name.replace("IMG_0001", "IMG_0009")))
    before = {path: path.read_bytes() for path in out.rglob("IMG_0001*")}
    agalign.align_folder(folder, out, settings=settings)
    assert {path: path.read_bytes() for path in out.rglob("IMG_0001*")} == before
    renamed = f"{FIRST[:-1]}9"
    assert [(part.capture, part.same_as) for part in read_run_record(out).not_in_input] == [(FIRST, renamed)]
    line = f"{FIRST} (now {renamed})"
    done = agalign_here("verify", out)
    assert (done.returncode, line in done.stderr) == (0, True)
    assert "2 of 2 captures match their checksums" in done.stdout
    assert captures_in(out / "summary.csv") == {"IMG_0002", "IMG_0009"}
    assert line in (out / "index.html").read_text()
    assert {c.label for c in captures_of_run(out)[0]} == {SECOND, renamed}
    if has_id:
        accept_seeds(out)
        for command, captures in (("report", {"IMG_0002"}), ("indices", {"IMG_0002", "IMG_0009"})):
            done = agalign_here(*arguments(command, out))
            assert (done.returncode, line in done.stderr) == (0, True)
            assert captures_in(out / "indices.csv") == captures
    # Without a result under its new name, the exposure has its earlier one.
    (out / f"{renamed}.json").unlink()
    assert {c.label for c in captures_of_run(out)[0]} == {FIRST, SECOND}


def test_an_exposure_counts_once_after_its_bands_are_spelled_otherwise(tmp_path: Path) -> None:
    images, out = tmp_path / "in", tmp_path / "out"
    for number, width in ((1, 300), (2, 320)):
        write_capture(images, "green", "nir", "red", name=f"cap{number}", size_px=(width, 240))
    agalign.align_folder(images, out, settings=seeded())
    for path in [*images.iterdir()]:
        path.rename(images / "renamed").rename(images / path.name.upper())
    agalign.align_folder(images, out, settings=seeded())
    if not (out / "cap1.json").samefile(out / "CAP1.json"):
        moved = [("cap1", "CAP1"), ("cap2", "CAP2")]
        assert [(part.capture, part.same_as) for part in read_run_record(out).not_in_input] == moved
        assert {c.label for c in captures_of_run(out)[0]} == {"CAP1", "CAP2"}
        accept_seeds(out)
        assert {r.capture for r in agalign.indices(out)} == {"CAP1", "CAP2"}
        assert captures_in(out / "indices.csv") == {"CAP1", "CAP2"}
        assert "2 of 2 captures match their checksums" in agalign_here("verify", out).stdout


@pytest.mark.full
def test_a_moved_folder_counts_once(flight: Path, tmp_path: Path) -> None:
    folder, out = shutil.copytree(flight, tmp_path / "in"), tmp_path / "out"
    agalign.align_folder(folder, out, settings=seeded("rig"))
    (folder / "0000SET").rename(folder / "flight A")
    agalign.align_folder(folder, out, settings=seeded("rig"))
    moved = [(label, label.replace("0000SET", "flight A")) for label in (FIRST, SECOND)]
    assert [(part.capture, part.same_as) for part in read_run_record(out).not_in_input] == moved
    assert "2 of 2 captures match" in agalign_here("verify", out).stdout
    # On the folder below, all captures would be there twice.
    with pytest.raises(agalign.ConfigurationError, match="by a run on a folder above or below"):
        agalign.align_folder(folder / "flight A", out, settings=seeded("rig"))


def test_a_capture_that_the_input_no_longer_has_is_named_and_kept(out: Path, flight: Path) -> None:
    folder, settings = shutil.copytree(flight, out.parent / "in"), seeded("rig", layout="both")
    agalign.align_folder(folder, out, settings=settings)
    # Images that an option leaves out are in the input.
    options = agalign.DiscoverOptions(exclude=("IMG_0001*",))
    agalign.align_folder(folder, out, settings=settings, options=options)
    assert read_run_record(out).not_in_input == []
    for path in images_of_first(folder):
        path.unlink()
    line = f"1 capture of earlier runs is not in the input of the last run, and still counted: {FIRST}; delete the"
    done = agalign_here(folder, "-o", out, "--seed", "rig", "--only-seed", "--layout", "both")
    assert line in " ".join(done.stderr.split())
    assert line in (out / "index.html").read_text()
    first = [row for row in table_in(out / "summary.csv") if row["capture"] == "IMG_0001"]
    assert len(first) == 4
    assert all("the input of the last run does not have this capture" in row["check"] for row in first)
    for command in COMMANDS:
        assert line in agalign_here(*arguments(command, out)).stderr


def test_a_season_may_be_aligned_folder_by_folder(flight: Path, tmp_path: Path) -> None:
    out, days = tmp_path / "out", [tmp_path / name for name in ("day 1", "day 2")]
    for number, day in enumerate(days, start=1):
        for path in flight.rglob(f"IMG_000{number}_*.tif"):
            day.mkdir(exist_ok=True)
            shutil.copyfile(path, day / path.name)
        agalign.align_folder(day, out, settings=seeded("rig"))
    record = read_run_record(out)
    assert (record.labels, record.other_inputs) == (["IMG_0002"], {str(days[0].resolve()): ["IMG_0001"]})
    assert record.notes_on_input() == []
    assert captures_in(out / "summary.csv") == {"IMG_0001", "IMG_0002"}


def test_table_and_report_count_the_same_results_once(
    flight: Path, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The results of other runs are among them. Each sidecar is read once for both."""
    (first,) = out.rglob("IMG_0001.json")
    failed = {"status": "failed", "reason": "blank"}
    bands = [band | (failed if band["status"] == "aligned" else {}) for band in read_json(first)["bands"]]
    change(first, bands=bands)
    second, table = agalign.DiscoverOptions(include=("IMG_0002*",)), "4 of 8 band pairs"

    def run() -> int:
        scan, settings = agalign.discover(flight, second), seeded("rig", layout="both")
        return conclude(align_run.run(scan, out, settings, Terminal(), agalign.RunOptions()), out, Terminal())

    with monkeypatch.context() as patch:
        patch.setattr(align_run, "pair_totals", raising(AssertionError("the sidecars are read again")))
        assert run() == 0
    assert f"{table} aligned" in capsys.readouterr().out
    assert f"{table} are aligned" in (out / "index.html").read_text()
    assert run() == 0, "the report is kept"
    assert f"{table} aligned" in capsys.readouterr().out


def test_after_a_failed_rendering_the_results_are_not_called_good(
    flight: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(capture_task, "render", raising(agalign.OutputError("the disk is full")))
        agalign.align_folder(flight, out, settings=seeded("rig", layout="both", radiometry="sun"))
    record = read_run_record(out)
    assert (record.state, record.settings["write"]["radiometry"]) == ("finished", "off")
    line = f"errors in 2 of 2 captures, whose files may be of an earlier run: {FIRST}, {SECOND}; the same command"
    assert line in (out / "index.html").read_text().replace("Errors", "errors")
    for command in COMMANDS:
        done = agalign_here(*arguments(command, out))
        assert done.returncode == 3
        assert f"agalign: {out}: {line}" in done.stderr
    # A run without errors changes the page, though it keeps all captures.
    agalign_here(flight, "-o", out, "--seed", "rig", "--only-seed", "--layout", "both")
    assert agalign_here("verify", out).returncode == 0
    assert "whose files may be" not in (out / "index.html").read_text()


def test_a_run_without_results_is_no_other_folder(out: Path) -> None:
    for path in find_sidecars(out):
        path.unlink()
    done = agalign_here("verify", out)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{out}: the run there has no results: it was stopped, or all captures failed; run it again" in done.stderr


def test_captures_of_panels_and_of_the_sky_need_no_result(out: Path) -> None:
    identity = {"folder": "0000SET/000", "captured_at": "", "cues": ["a"]}
    sky = [{**identity, "capture": "IMG_0002", "bands": []}]
    (out / "sky.json").write_text(json.dumps({"schema": "agalign-sky/1", "captures": sky}))
    unfinished = unfinished_run(read_run_record(out), read_sky(out), {FIRST})
    assert (unfinished.found, unfinished.missing, unfinished.sentence) == (1, [], "")


def test_a_sidecar_without_a_checksum_is_no_match(out: Path) -> None:
    path = out / f"{FIRST}.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"checksum": None}))  # not signed
    done = agalign_here("verify", out)
    assert done.returncode == 3
    assert "IMG_0001.json: has no checksum, so that changes cannot be found" in done.stderr
    assert "1 of 2 captures match their checksums" in done.stdout


LONG = "x" * 5000


TEXTS = ["band", "reason", "radiometry", "captured_at", "capture_id", "flight_id", "make", "model", "serial", "agalign"]


def with_long_texts(part: object, key: str = "") -> object:
    """A part of a sidecar with 5000 characters more in its names and sentences."""
    if isinstance(part, dict):
        return {k: with_long_texts(value, k) for k, value in part.items()}
    if isinstance(part, list):
        return [item + LONG if isinstance(item, str) else with_long_texts(item) for item in part]
    return part + LONG if key in TEXTS and isinstance(part, str) else part


@pytest.mark.parametrize("command", [*COMMANDS, "align"])
@pytest.mark.parametrize("edited", ["texts", "unknown key", "schema"])
def test_long_texts_of_an_edited_sidecar_make_no_long_lines(command: str, edited: str, out: Path, flight: Path) -> None:
    path = out / f"{FIRST}.json"
    facts = json.loads(path.read_text())
    if edited == "texts":
        facts = with_long_texts(facts | {"missing_bands": ["Pan"], "status": "degraded"})
        facts["bands"][1] |= {"status": "failed", "reason": LONG, "issues": [{"kind": "unreadable", "detail": LONG}]}
    elif edited == "schema":
        facts["schema"] = "agalign/2" + LONG
    else:
        facts["bands"][1][LONG] = 1
    path.write_text(json.dumps(facts))
    run = (
        ["align", flight, "-o", out, "--only-seed", "--dry-run", "-v"]
        if command == "align"
        else arguments(command, out)
    )
    done = agalign_here(*run)
    lines = (done.stdout + done.stderr).splitlines()
    assert "please report" not in done.stderr
    assert max(map(len, lines)) < 2500, "a sentence with some names"
