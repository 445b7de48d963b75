"""What the synthetic cameras write is read as what they are."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_flights.cameras import ALTUM, ALTUM_PT, MAVIC, MAVIC_3M, SENTERA_6X

from agalign.cameras.discover import DiscoverOptions, discover
from agalign.cameras.tag_seeds import rig_seed
from agalign.synthetic.cameras import REDEDGE, CameraSpec, Pose, true_homography
from agalign.synthetic.flight import Shot, write_shots
from agalign.synthetic.ground import paint_ground
from agalign.values import geometry

pytestmark = pytest.mark.full

CAMERAS = REDEDGE, MAVIC, MAVIC_3M, ALTUM, ALTUM_PT, SENTERA_6X
SIZE = 400, 300
"""Unlike that of a thermal image (320 x 256 px), whose lens it would be taken for."""


@pytest.mark.parametrize("camera", CAMERAS, ids=["RedEdge", "M3M calibrated", "M3M", "Altum", "Altum-PT", "6X"])
def test_rig_tags_are_the_truth_from_far_above(tmp_path: Path, camera: CameraSpec) -> None:
    ground = paint_ground(np.random.default_rng(0), [Pose(28.0, 20.0, 0, 0, 0, 0)], SIZE, camera=camera)
    pose = Pose(40_000.0, 20.0, 0, 0, 0, 0)  # so high that the lenses stand in one place
    path = write_shots(tmp_path, [Shot(pose, ground)], SIZE, camera, np.random.default_rng(0))
    (capture,) = discover(tmp_path, DiscoverOptions(with_rgb=True)).captures
    specs = {b.name: b for b in camera.bands}
    assert {b.name: b.size_px for b in capture.bands} == {name: spec.size_px(SIZE) for name, spec in specs.items()}
    assert capture.reference.name == camera.bands[camera.reference].name
    for band in capture.moving:
        spec = specs[band.name]
        truth = true_homography(camera.bands[camera.reference], spec, pose, SIZE)
        seed = rig_seed(capture.reference, band)
        assert seed is not None
        # Tags of optical centres contain no angles, and those of the thermal lens are not its true ones.
        tolerance = 0.8 if not getattr(camera, "calibrated", True) else 3.0 if spec.sees == "heat" else 0.05
        assert geometry.corner_error_px(seed, truth, *SIZE) < tolerance
    assert set(json.loads(path.read_text())[capture.name]["bands"]) == {b.path.name for b in capture.moving}
