from collections.abc import Sequence

import numpy as np
import torch

from agalign.method.levels import Level, Sampler, footprints_inside, make_level, make_level_image
from agalign.method.patches import Keypoints, patch_positions, transform
from agalign.values import lens
from agalign.values.displacement import DisplacementField
from agalign.values.image import Raster
from agalign.values.lens import Lens

from ..builders import texture, whole

HOLE = np.ones((240, 320), bool)
HOLE[90:150, 140:200] = False
FIXED = texture(320, 240)
MOVING = Raster(np.where(HOLE, texture(320, 240, 1).pixels, np.float32(1e6)), HOLE)


def level_of(
    fixed: Raster = FIXED, moving: Sequence[Raster] = (MOVING,), scale: float = 1.0, matrix: np.ndarray | None = None
) -> Level:
    matrices = [np.eye(3) if matrix is None else matrix] * len(moving)
    return make_level(fixed, moving, matrices, scale, torch.Generator().manual_seed(0), torch.device("cpu"))


def drawn(
    level: Level, pool: Keypoints, homographies: Sequence[torch.Tensor], count: int
) -> tuple[Keypoints, torch.Tensor]:
    return Sampler(torch.Generator().manual_seed(0)).draw(level, pool, homographies, count, 1.0)


def shift(x: float, y: float = 0.0) -> torch.Tensor:
    return torch.tensor([[1.0, 0, x], [0, 1.0, y], [0, 0, 1.0]])


def test_images_are_standardised_over_their_valid_pixels_only() -> None:
    image, valid = level_of().moving[0].image[0], torch.from_numpy(HOLE)
    assert abs(float(image[valid].mean())) < 1e-4
    assert abs(float(image[valid].std()) - 1) < 1e-3
    assert float(image[~valid].abs().max()) == 0


def test_keypoints_never_touch_invalid_pixels() -> None:
    level, h = level_of(), shift(7.0, -4.0)
    p, inside = drawn(level, level.anywhere, [h], 500)
    assert len(p) == 500
    assert bool(inside.all())
    touched = transform(h, patch_positions(p)).reshape(-1, 2)
    assert (touched >= 0).all()
    assert (touched <= torch.tensor([319.0, 239.0])).all()
    valid = torch.from_numpy(HOLE)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = touched.floor().long().unbind(dim=1)
        assert valid[(y + dy).clamp(max=239), (x + dx).clamp(max=319)].all()


def test_held_out_patches_share_no_pixel_with_training_patches() -> None:
    level = level_of()
    assert len(level.held_out) > 500
    seen = []
    for pool in (level.trainable, level.held_out):
        p, _ = drawn(level, pool, [torch.eye(3)], 400)
        assert len(p) > 100
        assert float(p.scale.max()) > 1.5
        pixels = patch_positions(p).reshape(-1, 2)
        # Bilinear interpolation uses four pixels.
        seen.append({(x + dx, y + dy) for x, y in pixels.floor().int().tolist() for dx in (0, 1) for dy in (0, 1)})
    train, held = seen
    assert not train & held


def test_keypoints_are_drawn_where_there_is_contrast() -> None:
    flat = FIXED.pixels.copy()
    flat[:, :160] = 0.3
    level = level_of(whole(flat))
    assert int((level.anywhere.xy[:, 0] < 158).sum()) == 0


def test_points_beyond_the_horizon_are_outside() -> None:
    p = Keypoints(torch.tensor([[160.0, 60.0]]), torch.zeros(1), torch.ones(1))
    singular = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1 / 160, 0, 1.0]])
    for away in (shift(1e9), singular):
        assert not bool(footprints_inside(level_of(), 0, p, away)[0])


def test_keypoints_in_most_images_come_first() -> None:
    level, near, far = level_of(moving=(MOVING, MOVING)), torch.eye(3), shift(200.0)
    p, inside = drawn(level, level.anywhere, [near, far], 100)
    assert inside.shape == (100, 2)
    in_both = inside.all(dim=1)
    assert int(in_both.sum()) > 0
    assert bool((in_both[:-1] >= in_both[1:]).all())
    for band, h in enumerate((near, far)):
        torch.testing.assert_close(inside[:, band], footprints_inside(level, band, p, h))


def test_patches_are_sampled_through_the_lens() -> None:
    # The values of the raw image are undistorted x coordinates, so a sample must equal its undistorted x.
    model = Lens(300.0, 300.0, 158.0, 121.0, (-0.1, 0.15, 0.0004, -0.0003, -0.03))
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    raw = lens.undistort(model, np.stack([x, y], axis=-1))[..., 0].astype(np.float32)
    view = make_level_image(whole(raw, model), 1.0, torch.device("cpu"))
    xy = torch.tensor([[60.0, 50.0], [200.0, 180.0]])
    positions = patch_positions(Keypoints(xy, torch.tensor([0.3, 2.0]), torch.ones(2)))
    result = view.patches(positions)[:, 0] * float(raw.std()) + float(raw.mean())
    torch.testing.assert_close(result, positions[..., 0], atol=0.02, rtol=0)


def test_positions_are_displaced_by_the_local_value_of_the_field() -> None:
    """The rig's field is in px of the full image; at half the resolution displacements are half as long."""
    nodes = np.stack(np.meshgrid(np.arange(12) * 32.0, np.arange(9) * 32.0), axis=-1)
    field = DisplacementField(32.0, np.stack([0.01 * nodes[..., 0], -0.02 * nodes[..., 1]], axis=-1))
    level = level_of(scale=0.5)
    assert level.displacement(0, torch.zeros(1, 2)) is None
    xy = torch.tensor([[40.0, 30.0], [100.0, 90.0]])
    result = level.with_fields([field]).displacement(0, xy)
    full = (xy + 0.5) * 2 - 0.5
    torch.testing.assert_close(result, full * torch.tensor([0.005, -0.01]), atol=0.01, rtol=0)
