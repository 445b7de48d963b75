import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.spatial.transform import Rotation

from agalign.errors import ConfigurationError
from agalign.synthetic import cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import paint_ground, reflectance
from agalign.values import lens


def rotation(*degrees: float) -> np.ndarray:
    return Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()


def test_the_truth_follows_from_rays_and_the_plane() -> None:
    # Independent of the generator's homographies: shoot a ray from the reference, hit the ground, look from the band.
    pose = cameras.Pose(30.0, 40.0, 1.5, -2.0, 3.0, -4.0)
    size = (1280, 960)
    reference, band = cameras.BANDS[cameras.REFERENCE], cameras.BANDS[3]
    attitude = rotation(pose.roll_deg, pose.pitch_deg, pose.yaw_deg)
    rig_m = [pose.east_m, pose.north_m, -pose.altitude_m]
    place, other = (attitude @ [*one.baseline_m, 0] + rig_m for one in (reference, band))
    fixed, moving = reference.lens(*size), band.lens(*size)
    ground = paint_ground(np.random.default_rng(0), [pose], (320, 240))
    ties = np.array(synthetic.true_ties(ground, reference, band, pose, size))
    for x_ref, y_ref, x_mov, y_mov in ties[::37]:
        direction = np.linalg.inv(fixed.matrix) @ [*lens.undistort(fixed, (x_ref, y_ref)), 1]
        ray = attitude @ rotation(*reference.rig_degrees) @ direction
        below = place - ray * place[2] / ray[2]
        seen = moving.matrix @ (attitude @ rotation(*band.rig_degrees)).T @ (below - other)
        np.testing.assert_allclose(lens.distort(moving, seen[:2] / seen[2]), (x_mov, y_mov), atol=2e-3)


def test_contrast_reverses_between_green_and_near_infra_red() -> None:
    ground = paint_ground(np.random.default_rng(0), [cameras.Pose(30, 0, 0, 0, 0, 0)], (320, 240))
    by_name = {b.name: reflectance(ground, b).ravel() for b in cameras.BANDS}
    assert np.corrcoef(by_name["Red"], by_name["NIR"])[0, 1] < -0.25
    assert np.corrcoef(by_name["Green"], by_name["Red"])[0, 1] > 0.5


def test_the_same_seed_gives_the_same_flight(tmp_path: Path) -> None:
    for name in ("a", "b"):
        synthetic.make_flight(tmp_path / name, captures=1, size_px=(160, 120), rng_seed=1)
    one, other = ([p.read_bytes() for p in sorted((tmp_path / name).rglob("*.*"))] for name in ("a", "b"))
    assert len(one) == 6
    assert one == other


def test_captures_of_an_earlier_demo_are_not_scored(flight: Path, aligned_flight: Path, tmp_path: Path) -> None:
    """They stay in the folder if the new flight has fewer captures."""
    name, of_first = next(iter(json.loads((flight / "truth.json").read_text()).items()))
    (tmp_path / "truth.json").write_text(json.dumps({name: of_first}))
    scores = synthetic.score_against_truth(aligned_flight, tmp_path / "truth.json")
    assert {Path(score.capture).name for score in scores} == {name}


def test_the_demo_does_not_replace_images_of_the_user(tmp_path: Path) -> None:
    synthetic.make_flight(tmp_path, 1, (64, 48))
    synthetic.refuse_other_images(tmp_path)
    mine = tmp_path / "0000SET" / "000" / "IMG_0002_1.tif"
    tifffile.imwrite(mine, np.zeros((48, 64), np.uint16), software="another")
    with pytest.raises(ConfigurationError, match=r"IMG_0002_1\.tif: was not written by agalign demo"):
        synthetic.refuse_other_images(tmp_path)
    for path in mine.parent.iterdir():
        path.unlink()
    with pytest.raises(ConfigurationError, match=r"truth\.json: was not written by agalign demo"):
        synthetic.refuse_other_images(tmp_path)
