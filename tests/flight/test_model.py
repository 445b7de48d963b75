"""Model files are read back as written; damaged ones are errors with the name of the file."""

import json
import math
import os
import struct
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from agalign.errors import InputError
from agalign.flight.model import FlightModel, _digest, load_model, save_model
from agalign.flight.rig import CaptureFactors, Rig
from agalign.flight.rig_file import read_rig
from agalign.method.descriptor import Descriptor
from agalign.values import geometry
from agalign.values.alignment import JointResult, RefinedPair, Seed
from agalign.values.mapping import DisplacementField
from agalign.values.pixel_units import FixedImagePx, MovingFilePx

FIELD = DisplacementField(40.0, np.arange(24.0).reshape(3, 4, 2) / 100)

SEED = Seed("structure", geometry.translation(1 / 3, 0.1), 20.0, 18.0, 2.5, trusted=True)
RESULT = JointResult[FixedImagePx](
    geometry.translation(1 / 7, -0.3),
    math.nan,
    0.9,
    0.004,
    0,
    (1.0,),
    "flight",
    "homography",
    0.01,
    ((0.1, 0.2), (0.1, 0.2), (0.3, 0.2), (0.1, 1 / 3)),
    np.eye(8) / 3,
)
PAIR = RefinedPair(SEED, RESULT, ((640, 480), (320, 240)))
REFINED = {"key": {"Red": PAIR}, "other": {"NIR": replace(PAIR, result=replace(RESULT, corner_covariance_px2=None))}}


def load(path: Path) -> FlightModel:
    return load_model(path, lambda: torch.device("cpu"))


@pytest.fixture
def model() -> FlightModel:
    torch.manual_seed(0)
    net = Descriptor("pseudo-siamese", [1, 1, 1], half_rectified=True, unit_length=True)
    captures = tuple(CaptureFactors(float(k), None, (0.1, 0.2), (float(k), 0.0, 0.0, 0.0, 0.0)) for k in range(3))
    mappings = {"Red": geometry.translation(3, 4), "NIR": geometry.translation(-1, 2)}
    by_band = {"Red": mappings["Red"]}, {"Red": (1.0, 0.0)}, {"Red": 0.5}, {"Red": 0.01}
    rig = Rig((640, 480), *by_band, ("distance",), captures, {"Red": MovingFilePx(0.1)}, fields={"Red": FIELD})
    rig = replace(rig, extrapolation_px={"Red": MovingFilePx(0.7)}, parallax_px={"Red": MovingFilePx(3.0)})
    return FlightModel(net, "Maker Model 1 [Green 640x480]", ("Red", "NIR"), mappings, "abc", rig, REFINED)


@pytest.fixture
def path(model: FlightModel, tmp_path: Path) -> Path:
    """The file of the model."""
    save_model(model, tmp_path / "m.safetensors")
    return tmp_path / "m.safetensors"


def test_a_model_is_read_back_as_it_was_written(model: FlightModel, path: Path) -> None:
    again = load(path)
    assert again.net.channels == (1, 1, 1)
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
    assert load(plain).rig is None
    assert read_rig(plain) == (model.camera, None)


def test_sides_are_counted_from_1(model: FlightModel) -> None:
    assert (model.side("Red"), model.side("NIR"), model.side("Blue")) == (1, 2, None)


@pytest.mark.parametrize("part", ["weight", "fact"])
def test_a_changed_model_is_reported_as_damaged(path: Path, part: str) -> None:
    contents = bytearray(path.read_bytes())
    contents[-3 if part == "weight" else contents.index(b"Maker")] ^= 1
    path.write_bytes(contents)
    with pytest.raises(InputError, match=r"m\.safetensors: cannot be read as a model \(it is damaged\)"):
        load(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other/1"}, "is not a model of agalign"),
        ({"channels": "[1]"}, "invalid numbers of channels"),
        ({"channels": "[0, 1, 1]"}, "invalid numbers of channels"),
        (None, "no checksum"),
    ],
)
def test_invalid_metadata_is_an_error(path: Path, change: dict[str, str] | None, said: str) -> None:
    contents = path.read_bytes()
    (length,) = struct.unpack_from("<Q", contents)
    header = json.loads(contents[8 : 8 + length])
    facts = {k: v for k, v in (header["__metadata__"] | (change or {})).items() if k != "digest"}
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header["__metadata__"] = facts | ({} if change is None else {"digest": _digest(tensors, facts)})
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + contents[8 + length :])
    with pytest.raises(InputError, match=said):
        load(path)


def test_a_pipe_is_an_error(tmp_path: Path) -> None:
    """Opening it like a file would block."""
    os.mkfifo(tmp_path / "m.safetensors")
    for read in (load, read_rig):
        with pytest.raises(InputError, match="not a regular file"):
            read(tmp_path / "m.safetensors")


def test_values_that_are_not_finite_or_too_large_are_an_error(model: FlightModel, path: Path) -> None:
    save_model(replace(model, mappings={"Red": np.full((3, 3), np.nan)}), path)
    with pytest.raises(InputError, match="cannot be read as a model"):
        load(path)
    with torch.no_grad():
        next(model.net.parameters()).mul_(1e30)
    save_model(model, path)
    with pytest.raises(InputError, match="values that are NaN or above"):
        load(path)
    path.write_bytes(b"not a model")
    for unreadable in (path, path.with_name("missing.safetensors")):
        with pytest.raises(InputError, match=unreadable.name):
            load(unreadable)
    with pytest.raises(InputError, match=r"m\.safetensors: its rig cannot be read"):
        read_rig(path)
