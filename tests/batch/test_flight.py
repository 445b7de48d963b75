import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import torch
from rasterio.errors import NotGeoreferencedWarning

import agalign
from agalign.batch import flight_learning as batch_learn
from agalign.batch import learning_tasks
from agalign.batch.capture_report import CaptureReport
from agalign.batch.crops import limits_of_cameras
from agalign.batch.model_files import ModelFiles
from agalign.batch.run import plan_run, run_flight
from agalign.batch.workers import Completed
from agalign.cameras.discover import FolderScan
from agalign.config import RunOptions
from agalign.flight.fingerprint import learning_fingerprint
from agalign.flight.groups import camera_key, flights_of
from agalign.flight.model import FlightModel, load_model, save_model
from agalign.flight.rig import MIN_CAPTURES
from agalign.flight.rig_file import read_rig
from agalign.flight.rig_prediction import extreme_mappings
from agalign.method import joint as method_joint
from agalign.method import state as method_state
from agalign.method.fast import Schedule, learn
from agalign.records.run_record import read_run_record
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.synthetic.flight import make_flight
from agalign.values.capture import Capture

from ..builders import in_full_run
from ..conftest import Shared, raising, save_known_model, seeded, write_signed

# The program itself reads files without a georeference quietly.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error:Dataset has no geotransform")]

SETTINGS = agalign.Settings()
TWO_PAIRS = agalign.DiscoverOptions(bands=("Green", "NIR", "Red edge"))
"""For tests that align captures, and for which the number of bands does not matter."""


def cpu() -> torch.device:
    return torch.device("cpu")


def run(folder: Path, out: Path, settings: agalign.Settings = SETTINGS, **options: Any) -> list[CaptureReport]:
    return list(run_flight(agalign.discover(folder), out, settings, **options))


def states(reports: list[CaptureReport]) -> list[str]:
    return [r.state for r in reports]


@pytest.fixture
def aligned_copy(aligned_flight: Path, tmp_path: Path) -> Path:
    """The output folder of a run with the default settings, which a test may change."""
    return shutil.copytree(aligned_flight, tmp_path / "aligned")


@pytest.fixture
def model(model_path: Path) -> FlightModel:
    return load_model(model_path, cpu)


@pytest.fixture
def learned_flight(shared: Shared) -> Path:
    """A flight with enough captures for a rig; those of one or two captures need no learning."""
    return shared("learned_flight", lambda f: make_flight(f, captures=MIN_CAPTURES, size_px=(480, 360), rng_seed=3))


def test_a_frozen_network_aligns_all_captures(aligned_flight: Path, model_path: Path) -> None:
    bands = [b for path in find_sidecars(aligned_flight) for b in read_sidecar(path).bands if b.joint]
    assert [(b.joint.recipe, b.joint.iterations) for b in bands if b.joint] == [("flight", 0)] * 8
    assert model_path.name == "RedEdge-M_SY01-0000001-AG.safetensors"


@pytest.mark.full
@pytest.mark.parametrize(("folder", "recipe"), [("flight", "scratch"), ("learned_flight", "flight")])
def test_networks_are_learned_from_random_weights(
    request: pytest.FixtureRequest, folder: str, recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each capture of a flight that has too few to learn it, or of the flight."""
    monkeypatch.setattr(method_state, "start_from_starter", raising(AssertionError("the starter network is used")))
    settings = agalign.Settings(joint=agalign.JointSettings(recipe="scratch"))
    list(run_flight(agalign.discover(request.getfixturevalue(folder), TWO_PAIRS), tmp_path, settings))
    bands = [b for path in find_sidecars(tmp_path) for b in read_sidecar(path).bands if b.joint]
    assert {(b.status, b.joint.recipe) for b in bands} == {("aligned", recipe)}
    assert recipe == "flight" or all(b.joint.iterations > 0 for b in bands)


@pytest.mark.full
def test_a_model_is_used_again(
    flight: Path, model_path: Path, aligned_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (batch_learn, method_joint):
        monkeypatch.setattr(module, "learn", partial(learn, schedule=Schedule(max_steps=1)))
    assert states(run(flight, aligned_copy)) == ["kept", "kept"]
    reports = run(flight, aligned_copy, model=model_path)
    assert [(r.state, r.is_complete) for r in reports] == [("done", True)] * 2
    assert states(run(flight, aligned_copy, model=model_path)) == ["kept", "kept"]


def test_a_model_of_another_camera_or_of_no_use_is_refused(flight: Path, model: FlightModel, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    assert model.camera is not None
    camera, (reference, first, *others) = model.camera.name, model.camera.described_bands
    strange = replace(model.camera, name="Another [1, 2]")
    for other, difference in {
        strange: f"for Another [1, 2]; the images here are of {camera}",
        replace(model.camera, bands=model.camera.bands[1::-1]): (
            f"with the reference {first}; the reference here is {reference}"
        ),
        replace(model.camera, bands=model.camera.bands[:2]): f"without {', '.join(others)}",
    }.items():
        save_model(replace(model, camera=other), path)
        with pytest.raises(agalign.ConfigurationError) as refused:
            run(flight, tmp_path / "out", model=path)
        assert str(refused.value) == f"{path}: was learned {difference}; leave --model out"
    alone = agalign.Settings(flight=agalign.FlightSettings(together=False))
    with pytest.raises(
        agalign.ConfigurationError, match="is not used, as --each-alone learns a network for each capture"
    ):
        run(flight, tmp_path / "out", alone, model=path)


@pytest.mark.full
def test_two_captures_at_a_time_give_the_same_numbers(flight: Path, aligned_flight: Path, tmp_path: Path) -> None:
    agalign.align_folder(flight, tmp_path, settings=SETTINGS, run=RunOptions(jobs=2))
    serial, parallel = (
        [b.model_dump_json(exclude={"seconds"}) for path in find_sidecars(out) for b in read_sidecar(path).bands]
        for out in (aligned_flight, tmp_path)
    )
    assert len(serial) == 10
    assert serial == parallel


def test_a_second_run_reuses_the_model_and_retries_failed_captures(flight: Path, aligned_copy: Path) -> None:
    (path,) = (aligned_copy / "models").iterdir()
    before = path.stat().st_mtime_ns
    first, second = find_sidecars(aligned_copy)
    first.unlink()
    write_signed(second, second.read_text().replace('"status": "ok"', '"status": "degraded"', 1))
    assert sorted(states(run(flight, aligned_copy))) == ["done", "kept"]
    again = run(flight, aligned_copy, options=RunOptions(retry_failed=True))
    assert sorted((r.state, r.is_complete) for r in again) == [("done", True), ("kept", True)]
    assert path.stat().st_mtime_ns == before


@pytest.mark.parametrize("is_damaged", [True, False], ids=["damaged", "deleted"])
def test_a_lost_model_is_learned_again_for_captures_that_are_rendered(
    is_damaged: bool, flight: Path, aligned_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its rig determines the crop that the captures of a flight share."""
    monkeypatch.setattr(batch_learn, "learn", partial(learn, schedule=Schedule(max_steps=1)))
    (path,) = (aligned_copy / "models").iterdir()
    path.write_bytes(path.read_bytes()[:1000]) if is_damaged else path.unlink()
    undistorted = agalign.Settings(write=agalign.WriteSettings(undistort=True))
    assert states(run(flight, aligned_copy, undistorted)) == ["done", "done"]
    assert load_model(path, cpu).camera is not None


def test_captures_of_one_camera_and_flight_are_a_group_with_a_model_name_of_its_own(
    flight: Path, tmp_path: Path
) -> None:
    one, two = agalign.discover(flight).captures

    def of(capture: Capture, flight_id: str = "", **camera: str) -> Capture:
        return replace(capture, camera=replace(capture.camera, **camera), flight_id=flight_id)

    other, later = of(two, two.flight_id, serial="X9"), of(two, "another")
    assert camera_key(one) == camera_key(later) != camera_key(other)
    groups = flights_of([one, two, other, later])
    assert groups == [[one, two], [other], [later]]
    cameras = [[of(one, model=model, serial="")] for model in ("X", "X", "X-2", "x")]
    stem = "RedEdge-M_SY01-0000001-AG"
    names = stem, "RedEdge-M_X9", f"{stem}-2", f"{stem}-3", "X", "X-2", "X-2-2", "x-3"
    models = ModelFiles(tmp_path)
    for group, name in zip([*groups, [later], *cameras], names, strict=True):
        path = models.new(group)
        models.add(path, "")
        assert path.name == f"{name}.safetensors"
    smaller = tuple(replace(b, width_px=100) if b.name == "NIR" else b for b in two.bands)
    assert len(flights_of([one, replace(two, bands=smaller)])) == 2
    without = tuple(b for b in two.bands if b.name != "NIR")
    assert len(flights_of([replace(two, bands=without), one])) == 1


def test_flights_of_one_camera_share_the_limits_of_their_crop(flight: Path, tmp_path: Path) -> None:
    """The rig of a finished flight takes part; a damaged model and a flight without a model do not."""
    one, other = agalign.discover(flight).captures
    good, bad = tmp_path / "good.safetensors", tmp_path / "bad.safetensors"
    save_known_model(good)
    bad.write_text("damaged")
    captures, models = (one, other, one, other), (good, None, bad, good)
    flights = [([replace(c, flight_id=str(k))], m) for k, (c, m) in enumerate(zip(captures, models, strict=True))]
    flights.append(([replace(one, camera=replace(one.camera, serial="X9"))], None))
    of_first, of_other = limits_of_cameras(flights).values()
    assert {band.name for _, band in of_first} == {"NIR"}
    assert len(of_first) == 2 * len(extreme_mappings(read_rig(good)[1], "NIR"))
    assert not of_other


def test_radiometry_that_no_capture_has_tags_for_is_refused(flight: Path, tmp_path: Path) -> None:
    one, other = agalign.discover(flight).captures
    without = replace(other, bands=tuple(replace(b, radiometry=None) for b in other.bands))
    settings = agalign.Settings(write=agalign.WriteSettings(radiometry="camera"))
    plan = plan_run(FolderScan(flight, (one, without), ()), tmp_path, settings)
    assert list(plan.values()) == ["to be aligned"] * 2
    match = "--radiometry camera: no tags for radiance in Blue, Green"
    with pytest.raises(agalign.ConfigurationError, match=match):
        plan_run(FolderScan(flight, (without,), ()), tmp_path, settings)


def test_a_model_is_learned_again_if_its_input_changed(flight: Path, tmp_path: Path) -> None:
    captures = agalign.discover(flight).captures
    read = {capture.label for capture in captures}
    before = learning_fingerprint(captures, SETTINGS, read)
    assert learning_fingerprint(agalign.discover(flight).captures, SETTINGS, read) == before
    elsewhere = agalign.Settings(flight=agalign.FlightSettings(start_model="another network"))
    others = [(captures[:1], SETTINGS), (captures, elsewhere)]
    copy = shutil.copytree(flight, tmp_path / "flight")
    with (copy / captures[0].bands[1].path.relative_to(flight)).open("r+b") as file:
        file.seek(20_000)
        file.write(b"pixels")  # the size, the start, the middle and the end of the file are as before
    others.append((agalign.discover(copy).captures, SETTINGS))
    assert before not in [learning_fingerprint(*other, read) for other in others]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 50, 500])
def test_only_captures_to_learn_from_are_learned_from(flight: Path, count: int) -> None:
    """Whatever is unusable of them: the model depends on no other images."""
    (one, *_) = agalign.discover(flight).captures
    captures = [replace(one, name=f"{number}") for number in range(count)]
    read: set[str] = set()

    def failed(_: Any, tasks: Sequence[Any], /, **__: object) -> Completed[Any]:
        for number, task in enumerate(tasks):
            read.update(capture.label for capture in (task if isinstance(task, tuple) else (task,)))
            yield number, lambda: None

    model = FlightModel(batch_learn.initial_network(("NIR",), SETTINGS, None), None, ("NIR",), {}, "")
    learner = batch_learn._FlightLearner(captures, SETTINGS, lambda *_: None, None, failed, 1, None)
    learner._network()
    learner._observed(model)
    learner._observations(model, [])
    assert read == {capture.label for capture in batch_learn.captures_to_learn_from(captures)}


@pytest.mark.full
@pytest.mark.parametrize("fault", [cv2.error("of OpenCV"), in_full_run(agalign.GeometryError("no homography"))])
def test_a_fault_while_learning_only_loses_the_network_of_the_flight(
    learned_flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    monkeypatch.setattr(learning_tasks, "refine_with", raising(fault))
    reports = list(run_flight(agalign.discover(learned_flight, TWO_PAIRS), tmp_path, SETTINGS))
    assert [r.is_complete for r in reports] == [True] * MIN_CAPTURES
    assert {b.joint.recipe for r in reports for b in r.sidecar.bands if b.joint} == {"fast"}


def test_captures_that_exceed_the_time_limit_are_not_learned_from(
    learned_flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    limits_s = set()

    def late(_: Any, tasks: Sequence[Any], /, *, timeout_s: float | None = None) -> Completed[Any]:
        limits_s.add(timeout_s)
        for number in range(len(tasks)):
            yield number, raising(TimeoutError())

    captures = agalign.discover(learned_flight, TWO_PAIRS).captures
    for several, limit_s in (captures, 7.0), (captures * 3, 21.0):  # of up to three captures, the best is learned from
        assert batch_learn.learn_flight(several, SETTINGS, lambda *_: None, run_tasks=late, timeout_s=7.0) is None
        assert limits_s == {limit_s}
        limits_s.clear()
    assert f"{captures[0].label}: not learned from, as it exceeds --timeout" in caplog.text


@pytest.mark.full
def test_a_band_of_noise_in_one_capture_does_not_change_the_network(learned_flight: Path, tmp_path: Path) -> None:
    """It is trained on the capture, but aligns no more bands of it then."""
    folder = shutil.copytree(learned_flight, tmp_path / "in")
    (path,) = folder.rglob("IMG_0001_4.tif")
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "r+") as file:
        file.write(np.random.default_rng(0).integers(1000, 40000, file.shape, np.uint16), 1)
    captures = agalign.discover(folder, TWO_PAIRS).captures
    learned = batch_learn.learn_flight(captures, SETTINGS, lambda *_: None)
    expected = learning_tasks.initial_network(learned.bands, SETTINGS, None).state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in learned.net.state_dict().items())


def test_an_output_that_cannot_be_made_is_named(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(agalign.OutputError, match=r"out: cannot be made \(.+\); choose another folder with -o$"):
        run(flight, tmp_path / "file" / "out")


def test_a_run_writes_its_record(flight: Path, tmp_path: Path) -> None:
    copy, out = shutil.copytree(flight, tmp_path / "in"), tmp_path / "out"
    next(copy.rglob("IMG_0001_5.tif")).write_bytes(b"no image")
    reports = run_flight(agalign.discover(copy, TWO_PAIRS), out, SETTINGS)
    assert read_run_record(out) is None
    first = next(reports)
    assert read_run_record(out).state == "running"
    (second,) = reports
    record = read_run_record(out)
    assert (record.state, record.captures) == ("finished", {"found": 2, "done": 2})
    assert record.pairs["aligned"] == 3
    assert set(record.capture_seconds) == {first.label, second.label}
    assert {"reading", "refining", "checking", "writing", "learning a flight"} <= set(record.stage_seconds)
    assert [p.problem for p in record.problems if "IMG_0001_5.tif" in p.of]
    assert record.versions["torch"]
    assert record.settings["joint"]["recipe"] == "fast"


def test_an_interruption_is_not_hidden_by_a_page_that_cannot_be_written(flight: Path, tmp_path: Path) -> None:
    first = run_flight(agalign.discover(flight), tmp_path, seeded())
    next(first)
    (tmp_path / "index.html").write_text("of the user")
    with pytest.raises(KeyboardInterrupt):
        first.throw(KeyboardInterrupt)
    assert (tmp_path / "index.html").read_text() == "of the user"


def test_one_run_at_a_time(flight: Path, tmp_path: Path) -> None:
    first = run_flight(agalign.discover(flight), tmp_path, seeded())
    next(first)
    with pytest.raises(agalign.OutputError, match="another run writes there"):
        run(flight, tmp_path, seeded())
    with pytest.raises(agalign.OutputError, match="another run writes there"):
        agalign.align_capture(agalign.discover(flight).captures[1], tmp_path, settings=seeded())
    first.close()
    assert read_run_record(tmp_path).state == "interrupted"
    assert "kept" in states(run(flight, tmp_path, seeded()))
    assert not list(tmp_path.rglob(".agalign*"))


@pytest.mark.full
def test_a_forced_seed_is_for_the_captures_that_the_flight_is_learned_from(
    learned_flight: Path, tmp_path: Path
) -> None:
    """All three are; others would start from the flight's mapping: a frozen network does not reach the identity."""
    settings = agalign.Settings(seed=agalign.SeedSettings(force="identity"))
    reports = list(run_flight(agalign.discover(learned_flight, TWO_PAIRS), tmp_path, settings))
    bands = [b for r in reports for b in r.sidecar.bands if b.status != "reference"]
    assert [b.status for b in bands] == ["aligned"] * 2 * MIN_CAPTURES
    assert {b.seed.kind for b in bands if b.seed} <= {"identity", "model", "structure", "match"}
    assert {b.joint.recipe for b in bands if b.joint} == {"flight"}


@pytest.mark.full
def test_a_first_capture_that_lacks_a_band_belongs_to_its_flight(flight: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(flight, tmp_path / "in")
    next(folder.rglob("IMG_0001_4.tif")).unlink()
    captures = agalign.discover(folder).captures
    assert [len(c.bands) for c in captures] == [4, 5]
    assert flights_of(captures) == [list(captures)]
    reports = run(folder, tmp_path / "out")
    (path,) = (tmp_path / "out" / "models").iterdir()
    assert set(load_model(path, cpu).bands) == {b.name for b in captures[1].moving}
    bands = [b for r in reports for b in r.sidecar.bands if b.status != "reference"]
    assert [b.status for b in bands] == ["aligned"] * 7
    assert {b.joint.recipe for b in bands if b.joint} == {"flight"}
    assert [r.sidecar.missing_bands for r in reports] == [["NIR"], []]
    # Such a capture alone is of the model's camera too.
    for band in captures[1].bands:
        band.path.unlink()
    (report,) = run(folder, tmp_path / "again", model=path)
    assert {b.status for b in report.sidecar.bands} <= {"reference", "aligned", "predicted"}
