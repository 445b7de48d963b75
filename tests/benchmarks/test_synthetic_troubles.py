"""The troubled flights are what they say they are."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from synthetic_flights.cameras import MAVIC
from synthetic_flights.troubles import make_troubled_flight, make_two_headings

from agalign.cameras.discover import discover
from agalign.synthetic import cameras

pytestmark = pytest.mark.full

SIZE = 160, 120


@pytest.mark.slow
def test_every_trouble_is_in_the_flight_and_in_its_truth(tmp_path: Path) -> None:
    truth = json.loads(make_troubled_flight(tmp_path, 32, SIZE).read_text())
    troubles = {name: t["trouble"] for name, t in truth.items()}
    assert {"panel", "take-off", "a lake", "fog", "planted grid", "terraces", "no NIR", ""} < set(troubles.values())
    moving = {c.name: {b.path.name for b in c.moving} for c in discover(tmp_path).captures}
    assert moving == {name: set(t["bands"]) for name, t in truth.items()}
    assert {troubles[name]: len(files) for name, files in moving.items()}["no NIR"] == 3
    (name,) = (n for n, trouble in troubles.items() if trouble == "half saturated")
    pixels = tifffile.imread(next(tmp_path.rglob(f"{name}_2.tif")))
    assert 0.2 < (pixels > 0.95 * cameras.WHITE_LEVEL).mean() < 0.6


def test_bands_that_come_late_see_another_place(tmp_path: Path) -> None:
    truth = json.loads(make_two_headings(tmp_path, 16, SIZE).read_text())
    captures = discover(tmp_path).captures
    assert [c.camera.model for c in captures] == ["M3M"] * 16
    passing = np.array([c.motion for c in captures])
    assert (np.sign(passing[:8, 1]) == -np.sign(passing[8:, 1])).all()
    # Tags tell the speed to 0.1 m/s, and the ground moves as they say: by the delay, times the focal length.
    focal_px = MAVIC.bands[3].lens(*SIZE).fx_px
    ties = [np.array(truth[c.name]["bands"][f"{c.name}_MS_NIR.TIF"]["ties"]) for c in captures]
    later_px = np.array([np.median(t[:, 3] - t[:, 1]) for t in ties])
    assert np.abs(later_px).max() < 20
    without_motion_px = later_px - MAVIC.bands[3].delay_s * focal_px * passing[:, 1]
    np.testing.assert_allclose(without_motion_px, without_motion_px[0], atol=1.5)
