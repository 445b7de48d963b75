"""Folders, options and tags from strangers: each fault is one line with the file, and nothing is lost silently."""

import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from common import WRONG_PX, band_errors, read_ties

from agalign.batch import capture_task as batch
from agalign.cameras.discover import discover
from agalign.cameras.metadata import Tags
from agalign.cameras.pix4d import NAMESPACE, focal_length_px
from agalign.cameras.read_files import _of_image
from agalign.errors import SidecarError
from agalign.flight.model import FlightModel, load_model, save_model
from agalign.host.files import INDICES_FILE, PANELS_FILE, RUN_FILE, SKY_FILE, write_csv
from agalign.host.text import without_controls
from agalign.records.panels_and_sky import read_panels, read_sky
from agalign.records.run_record import read_run_record
from agalign.records.sidecar_file import find_sidecars
from agalign.spectral_indices.indices_csv import current_rows
from agalign.synthetic import flight as synthetic
from agalign.values import geometry

from ..conftest import Shared, raising, read_json, seeded
from ..program import agalign_here


@pytest.fixture(params=["pipe", "folder"])
def irregular(request: pytest.FixtureRequest) -> Callable[[Path], None]:
    """Make a pipe, which blocks those that open it, or a folder, where a file is expected."""
    return os.mkfifo if request.param == "pipe" else Path.mkdir


@pytest.mark.parametrize(
    ("name", "read"), [(RUN_FILE, read_run_record), (PANELS_FILE, read_panels), (SKY_FILE, read_sky)]
)
def test_a_record_that_is_not_a_regular_file_is_an_error(
    tmp_path: Path, irregular: Callable[[Path], None], name: str, read: Callable[[Path], object]
) -> None:
    irregular(tmp_path / name)
    with pytest.raises(SidecarError, match=re.escape(f"{name}: cannot be read (it is not a regular file); delete it")):
        read(tmp_path)


def test_a_table_that_is_not_a_regular_file_is_empty(tmp_path: Path, irregular: Callable[[Path], None]) -> None:
    irregular(tmp_path / INDICES_FILE)
    assert current_rows(tmp_path) == []


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        ("report {tmp}", 3, "a.json: cannot be read (it is not a regular file)"),  # else its capture is lost silently
        ("align x --config {tmp}/a.json", 2, "a.json cannot be read as TOML (it is not a regular file)"),
    ],
)
def test_an_input_that_is_a_pipe_is_reported(tmp_path: Path, command: str, code: int, said: str) -> None:
    os.mkfifo(tmp_path / "a.json")
    done = agalign_here(*(part.format(tmp=tmp_path) for part in command.split()))
    assert done.returncode == code
    assert said in done.stderr


def test_no_table_has_a_formula(tmp_path: Path) -> None:
    write_csv(
        tmp_path / "a.csv", ("x",), [["=1+1"], ["-1+1"], ["@x"], ["\t=1"], ["-1.5"], [-2.5], [None], ["a\x1b\u202e"]]
    )
    expected = ["x", "'=1+1", "'-1+1", "'@x", "\\t=1", "-1.5", "-2.5", '""', "a\\x1b\\u202e"]
    assert (tmp_path / "a.csv").read_text().splitlines() == expected


def test_tags_have_no_character_that_changes_other_text() -> None:
    assert without_controls("Ca\x1b[2Jm\u202e\u2066e\u2028ra\x00 é\u3000") == "Ca[2Jmera é\u3000"


@pytest.mark.parametrize(
    "change", [{"fx_px": 1e308}, {"fy_px": 0.0}, {"cx_px": 1e16}, {"cy_px": math.nan}, {"distortion": (0.0, -1e14)}, {}]
)
def test_a_lens_of_damaged_tags_is_not_used(flight: Path, change: dict[str, Any]) -> None:
    """Mappings by it are not finite, and cannot be written."""
    band = discover(flight).captures[0].bands[2]
    result, _, why = _of_image(replace(band, lens=replace(band.lens, **change)), Tags(), 1)
    assert (result.lens is None, result.to_rig is None, bool(why)) == (bool(change),) * 3


def test_a_focal_length_of_damaged_tags_is_not_used() -> None:
    values = {(NAMESPACE, "PerspectiveFocalLength"): ("1e9",)}
    assert focal_length_px(Tags(xmp=values, exif={"FocalLength": 5.4})) is None


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("bands.0.grid.moving_px", [[0, 0]], "bands.0.grid: its lists of points are empty or of different lengths"),
        (
            "bands.0.grid",
            {"reference_px": [], "moving_px": []},
            "its lists of points are empty or of different lengths",
        ),
        ("bands.0.seconds", 1e308, "bands.0.seconds: Input should be less than or equal to 1"),
        ("bands.0.metrics.windows.shifts_px.0.0", -1e200, "shifts_px.0.0: Input should be greater than or equal to -1"),
        ("bands", [], "bands: List should have at least 1 item"),
        ("output.crop", [0, 0, 0, 9], "output.crop.2: Input should be greater than 0"),
        ("output.scale", [0, 1], "output.scale.0: Input should be greater than 0"),
    ],
)
def test_values_of_a_sidecar_that_no_run_writes_are_an_error(
    aligned_flight: Path, tmp_path: Path, field: str, value: object, said: str
) -> None:
    """Commands that calculate with them would fail."""
    content = read_json(find_sidecars(aligned_flight)[0])
    *parents, last = (int(part) if part.isdigit() else part for part in field.split("."))
    reduce(getitem, parents, content)[last] = value
    (tmp_path / "a.json").write_text(json.dumps(content))
    done = agalign_here("report", tmp_path)
    assert done.returncode == 3
    assert said in done.stderr


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("libx.so"), "agalign failed on it (ImportError: libx.so); please report this"),
        (StopIteration(), "agalign failed on it (StopIteration: StopIteration); please report this"),
        (RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory"), "out of memory; "),
    ],
)
def test_any_error_fails_one_capture_only(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    monkeypatch.setattr(batch, "process_capture", raising(error))
    report = batch.do_capture(batch.Task(discover(flight).captures[0], tmp_path, seeded()))
    assert report.state == "error"
    assert report.error.startswith(said)


@pytest.fixture(scope="module")
def learned(shared: Shared) -> Path:
    """A flight of four captures and its aligned output: the model has a rig."""

    def align(folder: Path) -> None:
        synthetic.make_flight(folder / "in", captures=4, size_px=(480, 360), rng_seed=3)
        agalign_here(folder / "in", "-o", folder / "out", "--relief", "never")

    return shared("learned", align)


def shifted(matrix: np.ndarray) -> np.ndarray:
    """A mapping that is wrong by 5 px."""
    return geometry.compose(geometry.translation(4.0, -3.0), matrix)


def with_shifted_rig(model: FlightModel) -> FlightModel:
    """Rig and mappings are wrong and have tiny errors."""
    tiny = {name: dict.fromkeys(getattr(model.rig, name), 1e-6) for name in ("baseline_std", "from_bands_px")}
    mean, mappings = ({band: shifted(h) for band, h in hs.items()} for hs in (model.rig.mean, model.mappings))
    return replace(model, rig=replace(model.rig, mean=mean, **tiny), mappings=mappings)


@pytest.mark.full
def test_a_model_changed_by_hand_makes_no_wrong_alignment(learned: Path, tmp_path: Path) -> None:
    """It has the right checksum; a band is aligned only where the images confirm that."""
    (path,) = (learned / "out" / "models").iterdir()
    model = load_model(path, lambda: torch.device("cpu"))
    changed = tmp_path / "models" / path.name
    save_model(with_shifted_rig(model), changed)
    contents = changed.read_bytes()
    done = agalign_here(learned / "in", "-o", tmp_path, "--relief", "never")
    assert done.returncode in (0, 1, 3)
    assert changed.read_bytes() == contents, "the model was used"
    errors = band_errors(tmp_path, read_ties(learned / "in" / "truth.json"))
    assert len(errors) == 16
    assert [e for e in errors if e.part.status == "aligned" and not e.p95_px <= WRONG_PX] == []
