import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial, partialmethod
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import agalign
from agalign.batch import CaptureReport, RunOptions, learning_tasks, run_flight
from agalign.batch import capture as batch_capture
from agalign.batch import learn as batch_learn
from agalign.batch.learn import learning_fingerprint
from agalign.cameras.discover import DiscoverOptions, discover
from agalign.config import FlightSettings, SeedSettings, Settings
from agalign.errors import ConfigurationError, GeometryError, InputError, OutputError
from agalign.flight.groups import camera_key, flights_of, model_names
from agalign.flight.model import FlightModel, load_model, save_model
from agalign.method import joint as method_joint
from agalign.method.fast import Schedule, learn
from agalign.method.state import JointState
from agalign.products import preview
from agalign.products.run_record import read_run_record
from agalign.products.sidecar_file import find_sidecars, read_sidecar
from agalign.synthetic.flight import score_against_truth
from agalign.values.capture import Capture

pytestmark = pytest.mark.slow

SETTINGS = Settings()
SEED_ONLY = Settings(seed=SeedSettings(only=True))
"""For tests of what happens to files: it aligns nothing."""
TWO_PAIRS = DiscoverOptions(bands=("Green", "NIR", "Red edge"))
"""For tests in which captures must be aligned, and how many bands they have does not matter."""
Finished = tuple[Path, list[CaptureReport]]


def cpu() -> torch.device:
    return torch.device("cpu")


@pytest.fixture(scope="module")
def finished(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The output folder of a run with the default settings, which tests must not change, and its reports."""
    out = tmp_path_factory.mktemp("finished")
    return out, list(run_flight(discover(flight), out, SETTINGS))


@pytest.fixture
def finished_copy(finished: Finished, tmp_path: Path) -> Path:
    """The output folder of a run, which a test may change."""
    return shutil.copytree(finished[0], tmp_path / "finished")


@pytest.fixture
def out_with_model(finished: Finished, tmp_path: Path) -> Path:
    """An output folder in which the flight's model is already learned, and no capture is aligned."""
    shutil.copytree(finished[0] / "models", tmp_path / "out" / "models")
    return tmp_path / "out"


@pytest.fixture(scope="module")
def model(finished: Finished) -> FlightModel:
    (path,) = (finished[0] / "models").iterdir()
    return load_model(path, cpu)


def test_a_frozen_network_aligns_a_capture_that_it_has_never_seen(flight: Path, finished: Finished) -> None:
    out, reports = finished
    bands = [b for r in reports for b in r.sidecar.bands if b.joint]
    assert {b.joint.recipe for b in bands} == {"flight"}
    assert {b.joint.iterations for b in bands} == {0}
    scores = score_against_truth(reports, flight / "truth.json")
    assert len(scores) == 8
    assert max(s.median_px for s in scores) < 0.2
    assert [p.name for p in (out / "models").iterdir()] == ["RedEdge-M_SY01-0000001-AG.safetensors"]


def test_saved_and_loaded_it_is_the_same(model: FlightModel, tmp_path: Path) -> None:
    path = tmp_path / "models" / "m.safetensors"
    save_model(model, path)
    again = load_model(path, cpu)
    assert (again.camera, again.bands, again.fingerprint) == (model.camera, model.bands, model.fingerprint)
    assert len(model.mappings) == 4
    for name, matrix in model.mappings.items():
        np.testing.assert_array_equal(again.mappings[name], matrix)
    patches = torch.randn(5, 1, 16, 16)
    for side in range(5):
        torch.testing.assert_close(again.net(patches, side), model.net(patches, side))


def test_what_is_no_model_is_named(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    with pytest.raises(InputError, match=r"m\.safetensors"):
        load_model(path, cpu)
    path.write_bytes(b"nonsense" * 100)
    with pytest.raises(InputError, match=r"m\.safetensors"):
        load_model(path, cpu)
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(InputError, match="not a model of agalign"):
        load_model(path, cpu)


def test_a_model_is_used_again_and_refused_for_another_camera(
    flight: Path, model: FlightModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.safetensors"
    save_model(model, path)
    # From random weights, nothing could be learnt in one step.
    monkeypatch.setattr(JointState, "fast_descriptor", partialmethod(JointState.fast_descriptor, start="random"))
    for module in (batch_learn, method_joint):
        monkeypatch.setattr(module, "learn", partial(learn, schedule=Schedule(max_steps=1)))
    reports = list(run_flight(discover(flight), tmp_path / "out", SETTINGS, model=path))
    assert [r.good for r in reports] == [True, True]
    save_model(replace(model, camera="Another 1 [Green 10x10]"), path)
    with pytest.raises(ConfigurationError, match=r"m\.safetensors: was learned for Another 1"):
        list(run_flight(discover(flight), tmp_path / "out2", SETTINGS, model=path))


def test_two_captures_at_a_time_give_the_same_numbers(flight: Path, finished: Finished, tmp_path: Path) -> None:
    agalign.align_folder(flight, tmp_path, settings=SETTINGS, run=RunOptions(jobs=2))
    result = []
    for out in (finished[0], tmp_path):
        sidecars = [read_sidecar(p) for p in find_sidecars(out)]
        result.append([(b.grid, b.metrics, b.joint) for s in sidecars for b in s.bands])
    assert len(result[0]) == 10
    assert result[0] == result[1]


def test_a_second_run_learns_nothing_anew(flight: Path, finished_copy: Path) -> None:
    path = next((finished_copy / "models").iterdir())
    before = path.stat().st_mtime_ns
    next(iter(find_sidecars(finished_copy))).unlink()
    states = [r.state for r in run_flight(discover(flight), finished_copy, SETTINGS)]
    assert sorted(states) == ["done", "kept"]
    assert path.stat().st_mtime_ns == before


def test_cameras_and_flights_are_kept_apart(flight: Path) -> None:
    captures = discover(flight).captures
    other = replace(captures[1], camera=replace(captures[1].camera, serial="X9"))
    later = replace(captures[1], flight_id="another")
    assert len(flights_of(captures)) == 1
    groups = flights_of([*captures, other, later])
    assert [len(g) for g in groups] == [2, 1, 1]
    assert camera_key(captures[0]) == camera_key(later) != camera_key(other)
    stem = "RedEdge-M_SY01-0000001-AG"
    assert model_names([*groups, [later]]) == [
        f"{stem}.safetensors", "RedEdge-M_X9.safetensors", f"{stem}-2.safetensors", f"{stem}-3.safetensors",
    ]  # fmt: skip


def test_a_model_is_learnt_anew_where_what_it_depends_on_has_changed(flight: Path) -> None:
    captures = discover(flight).captures
    before = learning_fingerprint(captures, SETTINGS)
    assert learning_fingerprint(discover(flight).captures, SETTINGS) == before
    no_lens = [replace(c, bands=tuple(replace(b, lens=None) for b in c.bands)) for c in captures]
    other_reference = [replace(c, reference_index=0) for c in captures]
    elsewhere = Settings(flight=FlightSettings(start="another network"))
    assert len({learning_fingerprint(c, SETTINGS) for c in (captures, no_lens, other_reference)}) == 3
    assert learning_fingerprint(captures, elsewhere) != before


def test_a_capture_is_done_again_with_another_model(
    flight: Path, model: FlightModel, finished_copy: Path, tmp_path: Path
) -> None:
    path = tmp_path / "m.safetensors"
    save_model(model, path)
    assert [r.state for r in run_flight(discover(flight), finished_copy, SETTINGS)] == ["kept", "kept"]
    assert [r.state for r in run_flight(discover(flight), finished_copy, SETTINGS, model=path)] == ["done", "done"]
    assert [r.state for r in run_flight(discover(flight), finished_copy, SETTINGS, model=path)] == ["kept", "kept"]


def test_a_model_of_no_use_is_refused(flight: Path, model: FlightModel, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    save_model(model, path)
    alone = Settings(flight=FlightSettings(together=False))
    with pytest.raises(ConfigurationError, match="needs one network per flight"):
        list(run_flight(discover(flight), tmp_path / "out", alone, model=path))


def test_any_executor_will_do(flight: Path, out_with_model: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        reports = agalign.align_folder(flight, out_with_model, settings=SETTINGS, run=RunOptions(executor=executor))
    assert sorted(r.label for r in reports) == ["0000SET/000/IMG_0001", "0000SET/000/IMG_0002"]
    assert [r.good for r in reports] == [True, True]


def test_one_broken_reference_stops_neither_learning_nor_the_others(flight: Path, tmp_path: Path) -> None:
    copy = tmp_path / "in"
    shutil.copytree(flight, copy)
    for pattern in ("IMG_0001_2.tif", "IMG_0002_4.tif"):
        path = next(copy.rglob(pattern))
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    reports = {r.label[-8:]: r for r in run_flight(discover(copy), tmp_path / "out", Settings())}
    statuses = {b.band: b.status for b in reports["IMG_0002"].sidecar.bands}
    assert statuses["Blue"] == statuses["Red"] == "aligned"


def test_a_fault_in_one_capture_costs_no_other(
    flight: Path, out_with_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = batch_capture.process_capture

    def faulty(capture: Capture, *arguments: object) -> object:
        if capture.name == "IMG_0001":
            raise ZeroDivisionError("of nothing")
        return real(capture, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(batch_capture, "process_capture", faulty)
    reports = {r.label: r for r in agalign.align_folder(flight, out_with_model)}
    assert reports["0000SET/000/IMG_0002"].good
    problem = reports["0000SET/000/IMG_0001"].error
    assert problem is not None
    assert "please report this" in problem


def test_a_want_of_memory_is_said_so(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def greedy(*_: object) -> object:
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory")

    monkeypatch.setattr(batch_capture, "process_capture", greedy)
    reports = agalign.align_folder(flight, tmp_path, settings=Settings(flight=FlightSettings(together=False)))
    assert [r.state for r in reports] == ["error", "error"]
    assert all("out of memory" in (r.error or "") for r in reports)


@pytest.mark.parametrize("fault", [cv2.error("of OpenCV"), GeometryError("no homography")])
def test_a_fault_while_learning_costs_the_flights_network_and_nothing_else(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    def faulty(*_: object) -> object:
        raise fault

    monkeypatch.setattr(learning_tasks, "refine_with", faulty)
    reports = list(run_flight(discover(flight, TWO_PAIRS), tmp_path, SETTINGS))
    assert [r.good for r in reports] == [True, True]
    assert {b.joint.recipe for r in reports for b in r.sidecar.bands if b.joint} == {"fast"}


def test_a_name_that_another_cameras_number_takes_is_not_taken_twice(flight: Path) -> None:
    def named(model: str, flight_id: str) -> Capture:
        capture = discover(flight).captures[0]
        return replace(capture, camera=replace(capture.camera, model=model, serial=""), flight_id=flight_id)

    names = model_names([[named("X", "1")], [named("X", "2")], [named("X-2", "1")], [named("x", "1")]])
    assert names == ["X.safetensors", "X-2.safetensors", "X-2-2.safetensors", "x-3.safetensors"]
    assert len({n.lower() for n in names}) == 4


def test_an_old_sidecar_deletes_nothing_beyond_its_folder(flight: Path, finished_copy: Path) -> None:
    precious = finished_copy.parent / "precious.tif"
    precious.write_text("not ours")
    sidecar = finished_copy / "0000SET" / "000" / "IMG_0001.json"
    data = json.loads(sidecar.read_text())
    data["output"]["band_files"] = [{"file": "../../../precious.tif", "bytes": 1}, {"file": str(precious), "bytes": 1}]
    sidecar.write_text(json.dumps(data))
    assert [r.state for r in run_flight(discover(flight), finished_copy, SEED_ONLY)] == ["done", "done"]
    assert precious.read_text() == "not ours"


def test_an_output_that_cannot_be_replaced_costs_its_capture_only(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "0000SET" / "000" / "IMG_0001.tif" / "below").mkdir(parents=True)
    reports = {r.label: r for r in run_flight(discover(flight), tmp_path, SEED_ONLY)}
    assert reports["0000SET/000/IMG_0002"].state == "done"
    lost = reports["0000SET/000/IMG_0001"]
    assert lost.state == "error"
    assert "IMG_0001.tif: cannot be written" in (lost.error or "")


def test_the_same_model_is_the_same_bytes_and_is_for_everybody(model: FlightModel, tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.safetensors" for k in range(2)]
    for path in paths:
        save_model(model, path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    assert paths[0].stat().st_mode == plain.stat().st_mode


def test_a_run_tells_what_it_was(flight: Path, tmp_path: Path) -> None:
    copy = tmp_path / "in"
    shutil.copytree(flight, copy)
    next(copy.rglob("IMG_0001_5.tif")).write_bytes(b"no image")
    reports = run_flight(discover(copy, TWO_PAIRS), tmp_path / "out", SETTINGS)
    record = read_run_record(tmp_path / "out")
    assert record is None
    first = next(reports)
    record = read_run_record(tmp_path / "out")
    assert record is not None
    assert record.state == "running"
    rest = list(reports)
    record = read_run_record(tmp_path / "out")
    assert record is not None
    assert (record.state, record.captures) == ("finished", {"found": 2, "done": 2})
    assert record.pairs["aligned"] == 3
    assert set(record.capture_seconds) == {first.label, rest[0].label}
    assert {"reading", "refining", "checking", "writing", "learning a flight"} <= set(record.stage_seconds)
    assert [p.problem for p in record.problems if "IMG_0001_5.tif" in p.of]
    assert record.versions["torch"]
    assert record.settings["joint"]["recipe"] == "fast"


def test_what_fell_short_is_done_again_where_asked(flight: Path, finished_copy: Path) -> None:
    captures = discover(flight)
    path = finished_copy / "0000SET" / "000" / "IMG_0001.json"
    path.write_text(path.read_text().replace('"status": "ok"', '"status": "degraded"', 1))
    assert {r.state for r in run_flight(captures, finished_copy, SETTINGS)} == {"kept"}
    again = {r.label: r for r in run_flight(captures, finished_copy, SETTINGS, RunOptions(retry_failed=True))}
    assert {label[-8:]: r.state for label, r in again.items()} == {"IMG_0001": "done", "IMG_0002": "kept"}
    assert [r.good for r in again.values()] == [True, True]


def test_one_run_at_a_time(flight: Path, out_with_model: Path) -> None:
    captures = discover(flight)
    first = run_flight(captures, out_with_model, SETTINGS)
    next(first)
    with pytest.raises(OutputError, match=rf"another run writes there \(process {os.getpid()} on "):
        next(run_flight(captures, out_with_model, SETTINGS))
    first.close()
    record = read_run_record(out_with_model)
    assert record is not None
    assert record.state == "interrupted"
    assert [r.state for r in run_flight(captures, out_with_model, SETTINGS)].count("kept") >= 1
    assert not list(out_with_model.rglob(".agalign*"))


def test_a_picture_that_fails_is_told_and_costs_no_more(
    flight: Path, out_with_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OutputError("a.png: cannot be written")

    monkeypatch.setattr(preview, "write_picture", fails)
    reports = list(run_flight(discover(flight), out_with_model, SETTINGS))
    assert [r.shortcomings for r in reports] == [("a.png: cannot be written",)] * 2
    assert not any(r.good for r in reports)
    assert all(r.result is not None and r.result.status == "ok" for r in reports)
    assert [r.result.not_written for r in reports if r.result is not None] == [["picture"]] * 2
    monkeypatch.undo()
    again = list(run_flight(discover(flight), out_with_model, SETTINGS))
    assert [(r.state, r.shortcomings) for r in again] == [("done", ())] * 2
    assert len(list(out_with_model.rglob("*.png"))) == 2


def test_a_forced_seed_is_for_the_captures_that_the_flight_is_learned_from(flight: Path, tmp_path: Path) -> None:
    """The others start from the flight's own mapping: the identity is farther away than a frozen network reaches."""
    settings = Settings(seed=SeedSettings(force="identity"))
    reports = list(run_flight(discover(flight, TWO_PAIRS), tmp_path, settings))
    bands = [b for r in reports for b in r.sidecar.bands if b.status != "reference"]
    assert [b.status for b in bands] == ["aligned"] * 4
    assert {b.seed.kind for b in bands if b.seed} <= {"model", "structure", "match"}
    assert {b.joint.recipe for b in bands if b.joint} == {"flight"}


def without_band(flight: Path, folder: Path, *files: str) -> Path:
    """A copy of a flight that lacks some files."""
    shutil.copytree(flight, folder)
    for name in files:
        next(folder.rglob(name)).unlink()
    return folder


def test_a_first_capture_that_lacks_a_band_belongs_to_its_flight(flight: Path, tmp_path: Path) -> None:
    folder = without_band(flight, tmp_path / "in", "IMG_0001_4.tif")
    captures = discover(folder).captures
    assert [len(c.bands) for c in captures] == [4, 5]
    (group,) = flights_of(captures)
    assert group == list(captures)
    reports = list(run_flight(discover(folder), tmp_path / "out", Settings()))
    (path,) = (tmp_path / "out" / "models").iterdir()
    model = load_model(path, cpu)
    assert set(model.bands) == {b.name for b in captures[1].moving}
    bands = [b for r in reports for b in r.sidecar.bands if b.status != "reference"]
    assert [b.status for b in bands] == ["aligned"] * 7
    assert {b.joint.recipe for b in bands if b.joint} == {"flight"}
    assert {r.label: r.sidecar.missing_bands for r in reports} == {captures[0].label: ["NIR"], captures[1].label: []}
    # Such a capture alone is of the model's camera too.
    alone = without_band(folder, tmp_path / "alone", *(b.path.name for b in captures[1].bands))
    (report,) = run_flight(discover(alone), tmp_path / "again", Settings(), model=path)
    assert report.useful


def test_captures_whose_bands_have_other_sizes_are_of_another_flight(flight: Path) -> None:
    whole, other = discover(flight).captures
    smaller = [replace(b, width_px=100) if b.name == "NIR" else b for b in other.bands]
    assert len(flights_of([whole, replace(other, bands=tuple(smaller))])) == 2
    without = [b for b in other.bands if b.name != "NIR"]
    assert len(flights_of([replace(other, bands=tuple(without)), whole])) == 1
