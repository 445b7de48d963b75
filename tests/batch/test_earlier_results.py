"""Results of earlier runs in an output folder: of another capture, of the same one with other options, removed ones."""

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agalign
from agalign.batch.crops import grids_of_captures
from agalign.batch.earlier_results import EarlierResults, Remaining, remaining
from agalign.batch.output_files import is_same
from agalign.batch.run import Listener, plan_run, run_flight
from agalign.batch.workers import RunTasks, open_workers
from agalign.cli.align_run import RunTotals, conclude
from agalign.cli.align_run import run as run_command
from agalign.cli.terminal import ExitCode, Terminal
from agalign.flight.groups import model_name
from agalign.rasters.product import CapturePaths
from agalign.records.sidecar_file import find_sidecars, read_checked, read_sidecar, write_sidecar
from agalign.values.image import OutputGrid

from ..builders import in_full_run
from ..conftest import Shared, read_json, save_known_model, seeded, textured_image, write_band, write_capture
from ..program import agalign_here

pytestmark = pytest.mark.slow

SEEDS = seeded("rig")
THREE = agalign.DiscoverOptions(bands=("Green", "NIR", "Red edge"))


@pytest.fixture
def out(flight: Path, shared: Shared, tmp_path: Path) -> Path:
    """The output of a run that only finds initial alignments, which a test may change."""
    done = shared("seeded_flight", lambda folder: agalign.align_folder(flight, folder / "out", settings=SEEDS))
    return shutil.copytree(done / "out", tmp_path / "out")


def contents(folder: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        (b"2026:06:21", b"2025:06:21", "2025-06-21T10:00:01"),
        (b"SY01-0000001-AG", b"SY01-0000002-AG", "SY01-0000002-AG"),
        (b"synthetic00000000001", b"synthetic00000000009", "synthetic00000000009"),
    ],
)
def test_another_capture_of_the_same_name_is_refused_before_anything_is_written(
    flight: Path, out: Path, tmp_path: Path, before: bytes, after: bytes, named: str
) -> None:
    other = tmp_path / "other"
    shutil.copytree(flight, other)
    for path in other.rglob("*.tif"):
        path.write_bytes(path.read_bytes().replace(before, after))
    unchanged = contents(out)
    for options in ((), ("--dry-run",), ("--overwrite",), ("--align-panels", "--crop", "none")):
        done = agalign_here(other, "-o", out, "--only-seed", *options)
        assert done.returncode == ExitCode.USAGE
        other_capture = "belongs to a different capture from 0000SET/000/IMG_0001"
        line = rf"(?m)^agalign: .*IMG_0001\.json: {other_capture}.*{named}.*with -o$"
        assert len(re.findall(line, done.stderr)) == done.stderr.count("agalign: ") == 1
    with pytest.raises(agalign.ConfigurationError, match="belongs to a different capture"):
        agalign.align_capture(agalign.discover(other).captures[0], out, settings=SEEDS)
    assert contents(out) == unchanged


def test_a_sidecar_that_became_other_json_is_written_again(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    before = {r.label: r.sidecar.checksum for r in agalign.align_folder(flight, out, settings=SEEDS)}
    for text in ("null", "[]", "{}", "3"):
        (out / "0000SET" / "000" / "IMG_0001.json").write_text(text)
        reports = agalign.align_folder(flight, out, settings=SEEDS)
        states = {r.label: r.state for r in reports}
        assert states == {"0000SET/000/IMG_0001": "done", "0000SET/000/IMG_0002": "kept"}, text
        assert {r.label: r.sidecar.checksum for r in reports} == before, text


@pytest.mark.parametrize("first", ["0000SET", in_full_run(".")])
def test_a_run_on_a_folder_of_another_depth_is_refused(flight: Path, tmp_path: Path, first: str) -> None:
    out, second = tmp_path / "out", "." if first == "0000SET" else "0000SET"
    agalign.align_folder(flight / first, out, settings=SEEDS)
    unchanged = contents(out)
    done = agalign_here(flight / second, "-o", out, "--only-seed")
    assert done.returncode == ExitCode.USAGE
    assert "is of the same capture as" in done.stderr
    assert contents(out) == unchanged


def test_files_without_tags_are_compared_by_their_contents(tmp_path: Path) -> None:
    """Images of equal names and sizes in a folder and in a folder in it; a copied flight."""
    write_capture(tmp_path / "a", "green", "nir")
    for band in ("green", "nir"):
        path = tmp_path / "a" / "b" / f"f_{band}.tif"
        write_band(path, (4000 * textured_image(300, 240, 9) + 20000).clip(1).astype(np.uint16))
    out = tmp_path / "out"
    agalign.align_folder(tmp_path / "a", out, settings=SEEDS)
    unchanged = contents(out)
    with pytest.raises(agalign.ConfigurationError, match="here without tags"):
        agalign.align_folder(tmp_path / "a" / "b", out, settings=SEEDS)
    assert contents(out) == unchanged
    copy = shutil.copytree(tmp_path / "a", tmp_path / "copy", copy_function=shutil.copyfile)
    assert [r.state for r in agalign.align_folder(copy, out, settings=SEEDS)] == ["kept", "kept"]


def test_what_identifies_a_capture(flight: Path, out: Path) -> None:
    capture = agalign.discover(flight).captures[0]
    earlier = read_checked(find_sidecars(out)[0])

    def same(result: dict[str, Any], **tags: Any) -> bool | None:
        return is_same(earlier.model_copy(update=result), replace(capture, **tags))

    assert same({})
    other_camera = replace(capture.camera, serial="another")
    two_serials = replace(capture.camera, serial=f"A+{capture.camera.serial}")
    assert same({}, camera=other_camera) is False
    assert same({}, camera=replace(capture.camera, model="Altum")) is False
    assert same({}, camera=two_serials)  # of a dual camera, --bands left one half
    assert same({}, camera=replace(capture.camera, serial=""))
    # The time of the reference, which another option may choose, differs by parts of a second.
    assert same({}, captured_at="2026-06-21T10:00:01.400000")
    assert same({}, captured_at="2026-06-21T10:01:01") is False
    assert same({}, captured_at="", capture_id="")
    assert same({"input_samples": {"Green": "0"}}, captured_at="", capture_id="") is False
    assert same({"input_samples": {}}, captured_at="", capture_id="") is None
    # Several mosaics are aligned onto one reference: their own contents, or their place, tell them apart.
    green, others = earlier.reference.band, {"input_samples": {**earlier.input_samples, "NIR": "0"}}
    of_mosaic = {"reference": earlier.reference.model_copy(update={"georeferenced": True})}
    only_reference = {"input_samples": {green: earlier.input_samples[green], "NIR": "0"}}
    elsewhere = [band.model_copy(update={"file": f"x/{band.file}"}) for band in earlier.bands]
    without_tags = {"captured_at": "", "capture_id": ""}
    assert same(of_mosaic | others, **without_tags)
    assert same(of_mosaic | only_reference, **without_tags)
    assert same(of_mosaic | only_reference | {"bands": elsewhere}, **without_tags) is False
    assert same(only_reference | {"bands": elsewhere}, **without_tags)


def test_captures_with_other_options_are_done_again_and_this_is_printed_before(flight: Path, out: Path) -> None:
    first, second = find_sidecars(out)
    options = "--seed", "rig", "--only-seed", "--crop", "none", "--qa"
    planned = agalign_here(flight, "-o", out, *options, "--dry-run")
    assert "2 captures to be rendered again; changed since: --crop, --qa; nothing was written" in " ".join(
        planned.stdout.split()
    )
    done = agalign_here(flight, "-o", out, *options)
    lines = done.stderr.splitlines()
    said = lines.index("2 finished captures to be rendered again; changed since: --crop, --qa")
    assert said < next(k for k, line in enumerate(lines) if line.startswith("[1/2]"))
    assert read_checked(first).without_tables().output.crop == (0, 0, 480, 360)
    again = agalign_here(flight, "-o", out, *options)
    assert "again; changed since" not in again.stderr
    assert again.stderr.count("kept from an earlier run") == 2
    write_sidecar(second, read_sidecar(second).model_copy(update={"agalign": "0.0.9", "estimated_with": "0"}))
    done = agalign_here(flight, "-o", out, *options)
    assert "1 finished capture to be estimated again; changed since: version (agalign 0.0.9 before)" in done.stderr


def test_a_result_of_another_schema_is_refused_before_anything_is_written(flight: Path, out: Path) -> None:
    """Whether it is of the same capture is not known."""
    first, _ = find_sidecars(out)
    first.write_text(json.dumps({**read_json(first), "schema": "agalign/2"}))
    unchanged = contents(out)
    for options in ((), ("--overwrite",)):
        done = agalign_here(flight, "-o", out, "--only-seed", *options)
        assert done.returncode == ExitCode.USAGE
        line = f"agalign: {first}: schema is 'agalign/2' of agalign "
        assert done.stderr.count(line) == done.stderr.count("agalign: ") == 1
        assert "run again into a new folder" in done.stderr
    assert contents(out) == unchanged


def remaining_of(flight: Path, sidecar: Path, out: Path) -> Remaining:
    (capture,) = (c for c in agalign.discover(flight).captures if c.name == sidecar.stem)
    return remaining(capture, out, SEEDS, agalign.RunOptions(), EarlierResults())


def test_a_flight_that_grows_needs_no_option(flight: Path, tmp_path: Path) -> None:
    part = shutil.copytree(flight, tmp_path / "part", ignore=shutil.ignore_patterns("IMG_0002_*.tif"))
    agalign.align_folder(part, tmp_path / "out", settings=SEEDS)
    scan = agalign.discover(flight)
    assert [*plan_run(scan, tmp_path / "out", SEEDS).values()] == ["kept from an earlier run", "to be aligned"]
    assert [r.state for r in agalign.align_folder(flight, tmp_path / "out", settings=SEEDS)] == ["kept", "done"]


def test_most_finished_captures_decide_on_the_crop_of_a_camera(flight: Path, tmp_path: Path) -> None:
    one, other = agalign.discover(flight).captures
    captures = [replace(c, name=f"{c.name}{k}") for k in range(3) for c in (one, other)]
    save_known_model(tmp_path / "m.safetensors")

    def grid(model: Path | None, *kept: OutputGrid, crop: str = "flight") -> OutputGrid | None:
        grids = dict(zip((c.label for c in captures), kept, strict=False))
        settings = agalign.WriteSettings(crop=crop)
        ((result, fine),) = {*grids_of_captures([(captures, model)], grids, settings, tmp_path).values()}
        assert (fine is None) == (result is None or model is None)
        return result

    model, first, second = tmp_path / "m.safetensors", OutputGrid(4, 4, 400, 300), OutputGrid(5, 4, 400, 301)
    of_rig = grid(model)
    assert of_rig not in (None, first, second)
    assert grid(model, first, first, first, second) == first
    assert grid(model, first, first, second) == of_rig  # too few for a rig: each has its own
    assert grid(None, first, first, first) == first
    assert grid(None, first, first, first, second) is None
    assert grid(model, first, first, first, crop="common") is None
    # Its pan-sharpened files keep their scale.
    write_band(CapturePaths.of(captures[1], tmp_path).file(".pan.tif"), np.zeros((525, 700), np.uint16))
    kept = {c.label: first for c in captures[:3]}
    ((_, fine),) = {*grids_of_captures([(captures, model)], kept, SEEDS.write, tmp_path).values()}
    assert fine is not None
    assert (fine.x0, fine.y0, fine.width, fine.height) == (7, 7, 700, 525)


def test_finished_captures_get_the_crop_of_a_new_rig(flight: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are known once the rig is, and are rendered by as many workers as others."""
    scan, said, opened = agalign.discover(flight), [], []
    save_known_model(out / "models" / model_name(scan.captures[0]), fingerprint="of the flight")
    for path in find_sidecars(out):
        write_sidecar(path, read_sidecar(path).model_copy(update={"model": "of the flight"}))

    def open_counted(*arguments: Any, **options: Any) -> AbstractContextManager[RunTasks]:
        opened.append(arguments)
        return open_workers(*arguments, **options)

    monkeypatch.setattr("agalign.batch.run.open_workers", open_counted)
    reports = list(run_flight(scan, out, SEEDS, agalign.RunOptions(jobs=2), Listener(on_again=said.append)))
    processes_and_threads = [(processes, threads) for _, processes, _, threads in opened]
    assert processes_and_threads == [(0, 0), (1, 2)]
    assert said == ["2 finished captures to be rendered again; changed since: crop of the flight"]
    assert [(r.state, r.result.output.crop) for r in reports] == [("done", reports[0].result.output.crop)] * 2


# ---- an edited sidecar


def test_a_sidecar_removes_no_file_but_those_of_its_capture(flight: Path, tmp_path: Path) -> None:
    project = tmp_path / "proj"
    shutil.copytree(flight / "0000SET" / "000", project / "flight")
    agalign.align_folder(project / "flight", project, settings=seeded("rig", layout="both"))
    thesis, raw = project / "thesis.txt", project / "IMG_0001_9.tif"
    thesis.write_text("years of work")
    shutil.copy(project / "flight" / "IMG_0002_1.tif", raw)
    sidecar = project / "IMG_0001.json"
    listed = ["flight/IMG_0001_1.tif", "flight/IMG_0002_3.tif", "thesis.txt", "IMG_0001_9.tif", "IMG_0002.tif"]
    part = {"kind": "band", "bytes": 1, "sha256": ""}
    products = [part | {"file": name} for name in [*listed, "IMG_0001_4.tif"]]
    sidecar.write_text(json.dumps(read_json(sidecar) | {"products": products}))
    stack = (project / "IMG_0002.tif").stat().st_mtime_ns
    before = contents(project / "flight")
    # With the stack alone and two bands, the other files of bands are outdated.
    chosen = agalign.DiscoverOptions(bands=("Green", "Red"), skip=(project / "none",))
    capture = agalign.discover(project / "flight", chosen).captures[0]
    agalign.align_capture(capture, project, settings=seeded("rig", qa=True))
    assert contents(project / "flight") == before
    assert thesis.read_text() == "years of work"
    assert raw.is_file()
    assert (project / "IMG_0002.tif").stat().st_mtime_ns == stack
    assert not (project / "IMG_0001_4.tif").exists()


# ---- outputs that are removed during the run


def when_the_second_is_reported(monkeypatch: pytest.MonkeyPatch, remove: Callable[[], object]) -> None:
    """Remove outputs when the command line has counted the second capture."""
    add = RunTotals.add

    def added(totals: RunTotals, report: agalign.CaptureReport) -> None:
        add(totals, report)
        if report.label.endswith("2"):
            remove()

    monkeypatch.setattr(RunTotals, "add", added)


@pytest.mark.full
def test_outputs_removed_during_the_run_are_reported_and_not_counted(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal, scan = Terminal(), agalign.discover(flight, THREE)
    when_the_second_is_reported(monkeypatch, lambda: [path.unlink() for path in tmp_path.rglob("IMG_0001*")])
    totals = run_command(scan, tmp_path, agalign.Settings(), terminal, agalign.RunOptions())
    assert conclude(totals, tmp_path, terminal) == ExitCode.PARTIAL
    printed = capsys.readouterr()
    removed = f"{tmp_path}: outputs of 1 capture were removed during the run, such as of 0000SET/000/IMG_0001; the same"
    assert removed in printed.err
    assert "2 of 4 band pairs aligned; 1 capture not written" in printed.out
    assert totals.states == {"done": 1, "error": 1}
    record = read_json(tmp_path / "agalign-run.json")
    assert record["captures"] == {"found": 2, "done": 1, "error": 1}
    assert record["pairs"] == {"aligned": 2}
    assert [*record["capture_seconds"]] == ["0000SET/000/IMG_0002"]
    assert [part["of"] for part in record["problems"]] == ["0000SET/000/IMG_0001"]
    assert [r.state for r in agalign.align_folder(flight, tmp_path, options=THREE)] == ["kept", "done"]


def test_a_run_fails_if_its_output_folder_is_removed(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, terminal = tmp_path / "out", Terminal(quiet=True)
    when_the_second_is_reported(monkeypatch, lambda: shutil.rmtree(out))
    totals = run_command(agalign.discover(flight), out, SEEDS, terminal, agalign.RunOptions())
    assert conclude(totals, out, terminal) == ExitCode.NOTHING
    assert totals.states == {"error": 2}
    record = read_json(out / "agalign-run.json")
    assert (record["captures"], record["pairs"], record["refused"]) == ({"found": 2, "error": 2}, {}, [])


def test_a_plan_knows_that_a_given_model_estimates_everything_again(
    flight: Path, aligned_flight: Path, model_path: Path
) -> None:
    scan = agalign.discover(flight)
    assert {*plan_run(scan, aligned_flight, agalign.Settings()).values()} == {"kept from an earlier run"}
    plan = plan_run(scan, aligned_flight, agalign.Settings(), model=model_path)
    assert {*plan.values()} == {"to be estimated again; changed since: --model"}
