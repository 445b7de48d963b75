"""Model files are read back as written; damaged ones are errors with the name of the file."""

import json
import math
import os
import struct
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from agalign.errors import InputError
from agalign.flight import model as model_module
from agalign.flight.model import FlightModel, _digest, load_model, save_model
from agalign.flight.rig_file import read_rig, rig_to_json
from agalign.report.charts import rig_views
from agalign.values import geometry
from agalign.values.mapping import DisplacementField

from ..conftest import save_known_model

FIELD = DisplacementField(40.0, np.arange(24.0).reshape(3, 4, 2) / 100)


def load(path: Path) -> FlightModel:
    return load_model(path, lambda: torch.device("cpu"))


@pytest.fixture
def model(tmp_path: Path) -> FlightModel:
    """A model with a rig and a displacement field."""
    save_known_model(tmp_path / "known.safetensors")
    known = load(tmp_path / "known.safetensors")
    one_band = {"extrapolation_px": 0.7, "parallax_px": 3.0, "fields": FIELD}
    rig = replace(known.rig, **{name: {"NIR": value} for name, value in one_band.items()})
    of_flight = {"folder": "0000SET", "captured_at": ("2026-06-21T10:00:00", "2026-06-21T10:20:00")}
    return replace(known, rig=rig, mappings={"NIR": geometry.translation(3, 4)}, fingerprint="0f", **of_flight)


@pytest.fixture
def path(model: FlightModel, tmp_path: Path) -> Path:
    """The file of the model."""
    save_model(model, tmp_path / "m.safetensors")
    return tmp_path / "m.safetensors"


def test_a_model_is_read_back_as_it_was_written(model: FlightModel, path: Path) -> None:
    again = load(path)
    assert (again.net.channels, again.side("NIR"), again.side("[Red]"), again.side("Blue")) == ((1, 1, 1), 1, 2, None)
    for name, value in model.net.state_dict().items():
        assert torch.equal(again.net.state_dict()[name], value)
    np.testing.assert_equal(asdict(replace(again, net=None)), asdict(replace(model, net=None)))
    camera, rig = read_rig(path)
    assert camera == model.camera
    np.testing.assert_equal(asdict(rig), asdict(model.rig))


def test_equal_models_have_equal_bytes_with_and_without_a_rig(model: FlightModel, path: Path, tmp_path: Path) -> None:
    other, plain = (tmp_path / f"{n}.safetensors" for n in ("other", "plain"))
    save_model(model, other)
    assert path.read_bytes() == other.read_bytes()
    assert struct.unpack_from("<Q", path.read_bytes())[0] % 8 == 0, "the tensors after the header are aligned"
    (tmp_path / "any").touch()
    assert path.stat().st_mode == (tmp_path / "any").stat().st_mode, "everybody who reads other files reads models"
    save_model(replace(model, rig=None), plain)
    assert (load(plain).rig, read_rig(plain)) == (None, (model.camera, None))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other/1"}, "is not a model of agalign"),
        ({"channels": "[1]"}, "invalid numbers of channels"),
        ({"channels": "[0, 1, 1]"}, "invalid numbers of channels"),
        ({"format": "agalign-model/1"}, "an earlier version wrote it"),
        ({"camera_bands": ""}, "cannot be read as a model"),
        ({"camera_bands": '[["Green", 640]]'}, "cannot be read as a model"),
        (None, "no checksum"),
    ],
)
def test_invalid_metadata_is_an_error(path: Path, change: dict[str, str] | None, said: str) -> None:
    with safe_open(path, framework="pt") as file:
        facts = {k: v for k, v in file.metadata().items() if k != "digest"} | (change or {})
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors, path, facts if change is None else facts | {"digest": _digest(tensors, facts)})
    with pytest.raises(InputError, match=said):
        load(path)


def test_values_that_are_not_finite_or_too_large_are_an_error(model: FlightModel, path: Path) -> None:
    save_model(replace(model, mappings={"NIR": np.full((3, 3), np.nan)}), path)
    with pytest.raises(InputError, match="cannot be read as a model"):
        load(path)
    with torch.no_grad():
        next(model.net.parameters()).mul_(1e30)
    save_model(model, path)
    with pytest.raises(InputError, match="values that are NaN or above"):
        load(path)


def test_files_that_are_no_models_are_an_error(tmp_path: Path) -> None:
    text, missing, pipe = (tmp_path / f"{name}.safetensors" for name in ("text", "missing", "pipe"))
    text.write_bytes(b"not a model")
    os.mkfifo(pipe)  # opening it like a file would block
    for path, reason in ((text, ""), (missing, ""), (pipe, r".*not a regular file")):
        for read in (load, read_rig):
            with pytest.raises(InputError, match=f"{path.name}{reason}"):
                read(path)
    with pytest.raises(
        InputError, match=r"text\.safetensors: its rig cannot be read \([^\[]*\); delete it and run again"
    ):
        read_rig(text)
    with pytest.raises(InputError, match=r"its rig cannot be read \(No such file or directory\); delete it and run"):
        read_rig(text.with_name("missing.safetensors"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size_px": [0, 480]}, "the size of its images is 0 x 480"),
        ({"size_px": [math.nan, 480]}, "it has the number NaN"),
        ({"size_px": [1e9, 480]}, r"the size of its images is 1e\+09 x 480"),
        ({"mean": {"NIR": [[0, 0, 0]] * 3}}, "the homography is singular"),
        ({"from_bands_px": {"NIR": 1e200}}, r"it has the number 1e\+200"),
    ],
)
def test_a_rig_with_values_that_no_camera_has_is_refused(
    model: FlightModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], said: str
) -> None:
    """The report reads it too, without torch, and omits it."""
    text = json.dumps(json.loads(rig_to_json(model.rig)) | change)
    monkeypatch.setattr(model_module, "rig_to_json", lambda _: text)
    path = tmp_path / "models" / "changed.safetensors"
    path.parent.mkdir()
    save_model(model, path)
    for read in (load, read_rig):
        with pytest.raises(InputError, match=rf"changed\.safetensors: .*{said}"):
            read(path)
    problems: list[str] = []
    assert rig_views(tmp_path, problems.append) == []
    assert len(problems) == 1
