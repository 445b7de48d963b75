"""A flight of captures with depth: its rig is learned from captures that are aligned by relief."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from synthetic_flights.depth import write_capture
from synthetic_flights.relief import make_scene

import agalign
from agalign.batch.run import run_flight
from agalign.cameras.discover import discover
from agalign.config import Settings
from agalign.flight.model import load_model

from ..rasters.test_relief_map import assert_same_as_stack

pytestmark = pytest.mark.full

SIZE = 480, 360
CAPTURES = 4


def test_captures_with_relief_determine_the_rig_and_have_one_size(tmp_path: Path) -> None:
    scene, folder, out = make_scene("boxes", 8, width_px=SIZE[0]), tmp_path / "in", tmp_path / "out"
    for number in range(1, CAPTURES + 1):
        yaw_deg, altitude_m = scene.pose.yaw_deg + 3 * number, scene.pose.altitude_m * (1 + 0.04 * number)
        pose = replace(scene.pose, east_m=0.05 * number, yaw_deg=yaw_deg, altitude_m=altitude_m)
        write_capture(folder, replace(scene, pose=pose), number, SIZE, number)
    reports = list(run_flight(discover(folder), out, Settings()))
    bands = [b for r in reports for b in r.sidecar.bands if b.status != "reference"]
    assert {b.status for b in bands} == {"aligned"}
    assert all(b.relief is not None for b in bands)
    (path,) = (out / "models").iterdir()
    model = load_model(path, lambda: torch.device("cpu"))
    assert set(model.rig.mean) == {"Blue", "Red", "NIR", "Red edge"}
    assert all(b.prediction is not None and b.prediction.std_px < 0.3 for b in bands)
    assert len({r.sidecar.output.crop for r in reports if r.sidecar.output is not None}) == 1
    for report in reports:
        inputs = folder / report.path.parent.relative_to(out)
        assert assert_same_as_stack(report.path, inputs) == 4
    flight = agalign.open_flight(out)
    assert flight.sizes["capture"] == CAPTURES
    assert (flight.sizes["x"], flight.sizes["y"]) != SIZE
