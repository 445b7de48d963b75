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
    troubles = [t["trouble"] for t in truth.values()]
    assert {"panel", "take-off", "a lake", "fog", "planted grid", "terraces", "no NIR", ""} < set(troubles)
    assert troubles[0] == troubles[-1] == "panel"
    result = {c.name: c for c in discover(tmp_path).captures}
    assert len(result) == 32
    for name, known in truth.items():
        assert {b.path.name for b in result[name].moving} == set(known["bands"])
        assert len(result[name].moving) == (3 if known["trouble"] == "no NIR" else 4)


@pytest.mark.slow
def test_half_of_the_pixels_are_saturated(tmp_path: Path) -> None:
    truth = json.loads(make_troubled_flight(tmp_path, 32, SIZE).read_text())
    (name,) = (n for n, t in truth.items() if t["trouble"] == "half saturated")
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
    for capture, motion in zip(captures, passing, strict=True):
        ties = np.array(truth[capture.name]["bands"][f"{capture.name}_MS_NIR.TIF"]["ties"])
        later = np.median(ties[:, 2:] - ties[:, :2], axis=0) @ [0, 1]
        assert abs(later) < 20
        expected = MAVIC.bands[3].delay_s * focal_px * motion[1]
        assert later - expected == pytest.approx(_without_motion(captures[0], truth), abs=1.5)


def _without_motion(first: object, truth: dict) -> float:
    """Rows between green and near infra-red where the drone stands still."""
    name = first.name  # type: ignore[attr-defined]
    ties = np.array(truth[name]["bands"][f"{name}_MS_NIR.TIF"]["ties"])
    focal_px = MAVIC.bands[3].lens(*SIZE).fx_px
    moved = MAVIC.bands[3].delay_s * focal_px * first.motion[1]  # type: ignore[attr-defined]
    return float(np.median(ties[:, 2:] - ties[:, :2], axis=0)[1] - moved)
