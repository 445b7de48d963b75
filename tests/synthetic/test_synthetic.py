import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agalign.cameras.discover import discover
from agalign.pixels.raster import read_for_alignment
from agalign.synthetic import camera_model, cameras
from agalign.synthetic import flight as synthetic
from agalign.synthetic.ground import paint_ground, reflectance
from agalign.values import lens


def rotation(*degrees: float) -> np.ndarray:
    return Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()


def test_the_truth_follows_from_rays_and_the_plane() -> None:
    # Independent of the generator's homographies: shoot a ray from the reference, hit the ground, look from the band.
    pose = camera_model.Pose(30.0, 40.0, 1.5, -2.0, 3.0, -4.0)
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


def test_the_images_show_the_truth(flight: Path) -> None:
    """Red and green look alike: along the true mapping they correlate, and less at a distance of 4 px."""
    truth = json.loads((flight / "truth.json").read_text())["IMG_0001"]
    bands = {b.path.name: b for b in discover(flight).captures[0].bands}
    ties = np.array(truth["bands"]["IMG_0001_3.tif"]["ties"])
    offsets = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), -1).reshape(-1, 1, 2)

    def correlation(extra_px: tuple[int, int] = (0, 0)) -> float:
        values = []
        for file, positions in ((truth["reference"], ties[:, :2]), ("IMG_0001_3.tif", ties[:, 2:] + extra_px)):
            pixels = read_for_alignment(bands[file], 4096).pixels
            at = (positions + offsets).astype(np.float32)
            values.append(cv2.remap(pixels, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).ravel())
        return float(np.corrcoef(*values)[0, 1])

    assert correlation() > 0.6
    assert all(correlation(e) < correlation() for e in ((4, 0), (-4, 0), (0, 4), (0, -4)))


def test_contrast_reverses_between_green_and_near_infra_red(flight: Path) -> None:
    ground = paint_ground(np.random.default_rng(0), [camera_model.Pose(30, 0, 0, 0, 0, 0)], (320, 240))
    by_name = {b.name: reflectance(ground, b).ravel() for b in cameras.BANDS}
    assert np.corrcoef(by_name["Red"], by_name["NIR"])[0, 1] < -0.25
    assert np.corrcoef(by_name["Green"], by_name["Red"])[0, 1] > 0.5


def test_the_same_seed_gives_the_same_flight(tmp_path: Path) -> None:
    for name in ("a", "b"):
        synthetic.make_flight(tmp_path / name, captures=1, size_px=(160, 120), rng_seed=1)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 6
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize("band", cameras.BANDS, ids=lambda b: b.name)
def test_bands_are_well_exposed(flight: Path, band: camera_model.BandSpec) -> None:
    (result,) = [b for b in discover(flight).captures[0].bands if b.name == band.name]
    raster = read_for_alignment(result, 4096)
    assert raster.valid.mean() > 0.95
    assert raster.pixels[raster.valid].std() > 1000
