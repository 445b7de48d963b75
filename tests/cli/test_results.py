"""The commands on the output folder of a run that was killed, or that lacks captures."""

import json
import shutil
from pathlib import Path

import pytest

import agalign
from agalign.products.run.excluded import read_excluded
from agalign.products.run.record import read_run_record, unfinished_run
from agalign.products.sidecar.file import find_sidecars, read_sidecar, write_sidecar

from ..conftest import Shared, seeded
from ..products.conftest import change
from ..program import agalign_here

pytestmark = pytest.mark.slow

FIRST, SECOND = "0000SET/000/IMG_0001", "0000SET/000/IMG_0002"
ALIGNED = {"status": "aligned", "reason": None, "issues": ()}


@pytest.fixture
def out(flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """The output of a run, by the tags alone to save time: its captures count as `ok`."""

    def fill(folder: Path) -> None:
        agalign.align_folder(flight, folder, settings=seeded("rig", layout="both"))
        for path in find_sidecars(folder):
            sidecar = read_sidecar(path)
            bands = [b if b.status == "reference" else b.model_copy(update=ALIGNED) for b in sidecar.bands]
            write_sidecar(path, sidecar.model_copy(update={"status": "ok", "bands": bands}))

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
    panels, sky = read_excluded(out)
    unfinished = unfinished_run(read_run_record(out), (*panels, *sky), {FIRST})
    assert (unfinished.found, unfinished.missing, unfinished.sentence) == (1, [], "")


def test_a_sidecar_without_a_checksum_is_no_match(out: Path) -> None:
    change(out / f"{FIRST}.json", checksum=None)
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
