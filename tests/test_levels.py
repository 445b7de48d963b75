import numpy as np
import torch

from agalign.levels import Sampler, footprints_inside, make_level
from agalign.patches import Keypoints, patch_grid, transform
from agalign.records import Raster

from .conftest import textured_image

CPU = torch.device("cpu")


def rasters() -> tuple[Raster, Raster]:
    fixed, moving = textured_image(320, 240), textured_image(320, 240, 1)
    valid = np.ones((240, 320), bool)
    hole = valid.copy()
    hole[90:150, 140:200] = False
    return Raster(fixed, valid), Raster(np.where(hole, moving, 1e6).astype(np.float32), hole)


def test_images_are_standardised_over_their_valid_pixels_only() -> None:
    level = make_level(*rasters(), 1.0, 1.0, 0.05, CPU)
    valid = torch.from_numpy(rasters()[1].valid)
    inside = level.moving.image[0][valid]
    assert abs(float(inside.mean())) < 1e-4
    assert abs(float(inside.std()) - 1) < 1e-3
    assert float(level.moving.image[0][~valid].abs().max()) == 0


def test_keypoints_never_touch_invalid_pixels() -> None:
    level = make_level(*rasters(), 1.0, 1.0, 0.05, CPU)
    h = torch.tensor([[1.0, 0, 7.0], [0, 1.0, -4.0], [0, 0, 1.0]])
    p = Sampler(torch.Generator().manual_seed(0)).draw(level, level.anywhere, h, 500, 1.0)
    assert len(p) == 500
    touched = transform(h, patch_grid(p)).reshape(-1, 2)
    assert (touched >= 0).all()
    assert (touched <= torch.tensor([319.0, 239.0])).all()
    valid = torch.from_numpy(rasters()[1].valid)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = touched.floor().long().unbind(dim=1)
        assert valid[(y + dy).clamp(max=239), (x + dx).clamp(max=319)].all()


def test_held_out_cells_are_apart_from_training() -> None:
    level = make_level(*rasters(), 1.0, 1.0, 0.05, CPU)
    train = {tuple(p) for p in level.trainable.tolist()}
    held = {tuple(p) for p in level.held_out.tolist()}
    assert len(held) > 500
    assert not train & held
    distance = torch.cdist(level.held_out[::97].float(), level.trainable.float()).amin(dim=1)
    assert float(distance.min()) > 4


def test_keypoints_lie_where_there_is_contrast() -> None:
    fixed, moving = rasters()
    flat = fixed.pixels.copy()
    flat[:, :160] = 0.3
    level = make_level(Raster(flat, fixed.valid), moving, 1.0, 1.0, 0.05, CPU)
    assert int((level.anywhere[:, 0] < 158).sum()) == 0


def test_points_beyond_the_horizon_are_outside() -> None:
    level = make_level(*rasters(), 1.0, 1.0, 0.05, CPU)
    p = Keypoints(torch.tensor([[160.0, 60.0]]), torch.zeros(1), torch.ones(1))
    away = torch.tensor([[1.0, 0, 1e9], [0, 1.0, 0], [0, 0, 1.0]])
    assert not bool(footprints_inside(level, p, away)[0])
    singular = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1 / 160, 0, 1.0]])
    assert not bool(footprints_inside(level, p, singular)[0])
