"""Models of several flights of one camera in one output folder: each flight has its own."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import agalign
from agalign.batch import run as batch_run
from agalign.batch.model_files import ModelFiles
from agalign.batch.run import run_flight
from agalign.flight.rig_file import model_fingerprint
from agalign.records.sidecar_file import find_sidecars, read_sidecar
from agalign.synthetic.flight import make_flight
from agalign.values.capture import CameraIdentity, Capture

from ..conftest import Shared, raising, save_known_model
from ..run_outputs import table_in

CAMERA = "RedEdge-M_SY01-0000001-AG"
ONE_PAIR = agalign.DiscoverOptions(bands=("Green", "NIR"))
FIRST, SECOND = "later", "earlier"
"""Folders of the flights: the second is found before the first."""


@pytest.fixture
def images(shared: Shared, tmp_path: Path) -> Path:
    """Two flights of a camera, each with two captures and an identifier of its own."""
    original = shared("two_flights", lambda folder: make_flight(folder, captures=4, size_px=(480, 360), rng_seed=3))
    for path in original.rglob("IMG_*_[24].tif"):
        flight = FIRST if path.name < "IMG_0003" else SECOND
        copy = tmp_path / flight / path.name
        copy.parent.mkdir(exist_ok=True)
        flight_id = f"synthetic{flight}".ljust(20, "0").encode()
        copy.write_bytes(path.read_bytes().replace(b"syntheticflight00001", flight_id))
    return tmp_path


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def align(folder: Path, out: Path, **options: Any) -> list[str]:
    """Return the states of the captures."""
    scan = agalign.discover(folder, replace(ONE_PAIR, skip=(out,)))
    return [r.state for r in run_flight(scan, out, agalign.Settings(), **options)]


def models(out: Path) -> dict[str, str]:
    """Return the fingerprint of each model by its name."""
    return {path.stem: model_fingerprint(path) for path in (out / "models").iterdir()}


def used(out: Path) -> list[str]:
    """Return the fingerprint of the model of each capture, and check that no capture has a caution."""
    assert {row["check"] for row in table_in(out / "summary.csv")} == {""}
    return [read_sidecar(path).model for path in sorted(find_sidecars(out), key=lambda path: path.name)]


@pytest.mark.slow
def test_a_flight_of_another_input_keeps_its_model(images: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    align(images / FIRST, out)
    (first,) = models(out).values()
    align(images / SECOND, out)
    second = models(out)[f"{CAMERA}-2"]
    assert models(out) == {CAMERA: first, f"{CAMERA}-2": second}
    assert used(out) == [first] * 2 + [second] * 2
    # Each flight finds its own again, if only to render its captures, and also without its results.
    with monkeypatch.context() as patch:
        patch.setattr(batch_run, "learn_flight", raising(AssertionError("a model is learned again")))
        assert align(images / FIRST, out) == ["kept"] * 2
        assert align(images / FIRST, out, options=agalign.RunOptions(overwrite=True)) == ["done"] * 2
        for path in find_sidecars(out):
            path.unlink()
        assert [align(images / flight, out) for flight in (SECOND, FIRST)] == [["done"] * 2] * 2
    assert used(out) == [first] * 2 + [second] * 2
    # It replaces its own with other options.
    assert align(images / SECOND, out, model=out / "models" / f"{CAMERA}.safetensors") == ["done"] * 2
    assert models(out)[CAMERA] == first
    assert models(out).keys() == {CAMERA, f"{CAMERA}-2"}
    assert used(out)[2:] == [models(out)[f"{CAMERA}-2"]] * 2 != [second] * 2


@pytest.mark.slow
def test_a_flight_that_is_found_before_another_does_not_take_its_model(images: Path, out: Path) -> None:
    later = (images / SECOND).rename(images / "skipped")
    folder = images / "in"
    folder.mkdir()
    (images / FIRST).rename(folder / FIRST)
    align(folder, out)
    (first,) = models(out).values()
    later.rename(folder / SECOND)
    assert sorted(align(folder, out)) == ["done", "done", "kept", "kept"]
    second = models(out)[f"{CAMERA}-2"]
    assert models(out) == {CAMERA: first, f"{CAMERA}-2": second}
    assert used(out) == [first] * 2 + [second] * 2


def test_a_damaged_model_is_replaced_and_other_files_are_not(tmp_path: Path) -> None:
    folder = tmp_path / "models"
    (capture,) = captures = [Capture("x", Path(), (), 0, CameraIdentity("", "Y", ""))]
    assert ModelFiles(tmp_path).new(captures) == folder / "Y.safetensors"
    save_known_model(folder / "Y.safetensors")
    files = ModelFiles(tmp_path)
    assert files.find(captures, {""}) == folder / "Y.safetensors"
    assert files.find(captures, {"another"}) is None
    files.add(files.new(captures), "mine")
    assert files.find(captures, {"mine"}) == folder / "Y-2.safetensors"
    small = replace(capture, camera=CameraIdentity("", "y", ""))
    assert files.new([small]) == folder / "y-3.safetensors"
    (folder / "Y-2.safetensors").write_bytes((folder / "Y.safetensors").read_bytes()[:1000])
    assert ModelFiles(tmp_path).new(captures) == folder / "Y-2.safetensors"
    (folder / "Y-2.safetensors").write_text("weights of mine")
    assert ModelFiles(tmp_path).new(captures) == folder / "Y-3.safetensors"
