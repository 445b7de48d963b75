"""Patches at keypoints, and the levels of the pyramid that they are drawn from."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates

from agalign.config import JointSettings
from agalign.method.levels import Level, make_level
from agalign.method.patches import (
    ALPHA,
    Keypoints,
    bilinear,
    homography_from_psi,
    patch_positions,
    psi_from_homography,
    transform,
    warp_keypoints,
)
from agalign.method.state import JointState, MovingImage
from agalign.values import geometry, lens
from agalign.values.image import Raster
from agalign.values.lens import Lens
from agalign.values.mapping import DisplacementField

from ..builders import texture, whole


def keypoints(count: int = 50) -> Keypoints:
    g = torch.Generator().manual_seed(0)
    xy, angle, scale = (torch.rand(count, *shape, generator=g, dtype=torch.float64) for shape in ((2,), (), ()))
    return Keypoints(60 * xy + 20, 6.28 * angle, 1 + scale)


def test_psi_is_the_vector_in_the_paper() -> None:
    h = torch.tensor([[1.1, 0.2, 32.0], [0.3, 0.9, -24.0], [1e-3, -2e-3, 1.0]], dtype=torch.float64)
    psi = ALPHA * torch.tensor([0.1, 0.2, 0.3, -0.1, 0.1, -0.1, 0.32, -0.48], dtype=torch.float64)
    torch.testing.assert_close(psi_from_homography(3 * h, 320, 240), psi)
    torch.testing.assert_close(homography_from_psi(psi, 320, 240), h)


def test_keypoint_warp_is_that_of_the_affine_part_divided_by_the_denominator() -> None:
    affine = torch.tensor([[1.1, 0.1, 5.0], [-0.2, 0.9, -3.0], [0, 0, 1.0]], dtype=torch.float64)
    h, p = affine + torch.tensor([[0.0, 0, 0], [0, 0, 0], [2e-3, -1e-3, 0]]).double(), keypoints()
    v = p.scale[:, None] * torch.stack([p.angle.cos(), p.angle.sin()], dim=1)
    v_prime = (transform(affine, p.xy + v) - transform(affine, p.xy)) / (p.xy @ h[2, :2] + 1)[:, None]
    warped = warp_keypoints(p, h)
    torch.testing.assert_close(warped.xy, transform(h, p.xy))
    torch.testing.assert_close(warped.scale, v_prime.norm(dim=1))
    torch.testing.assert_close(warped.angle, torch.atan2(v_prime[:, 1], v_prime[:, 0]))


def test_a_patch_is_interpolated_at_a_rotated_and_scaled_grid() -> None:
    image, p = np.random.default_rng(0).normal(size=(2, 90, 110)), keypoints()
    steps = np.arange(16) - 7.5
    along = p.scale.numpy() * np.exp(1j * p.angle.numpy())
    grid = (p.xy[:, 0] + 1j * p.xy[:, 1]).numpy()[:, None, None] + along[:, None, None] * (steps + 1j * steps[:, None])
    expected = [map_coordinates(channel, [grid.imag, grid.real], order=1, mode="nearest") for channel in image]
    result = bilinear(torch.from_numpy(image), patch_positions(p))
    np.testing.assert_allclose(result, np.stack(expected, 1), atol=1e-10)


# ---- levels


HOLE = np.ones((240, 320), bool)
HOLE[90:150, 140:200] = False
FIXED = texture(320, 240)
MOVING = Raster(np.where(HOLE, texture(320, 240, 1).pixels, np.float32(1e6)), HOLE)


def level_of(*shifts: tuple[float, float]) -> Level:
    """The level of full resolution of moving images with these mappings."""
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    return make_level(state, FIXED, [MovingImage(MOVING, geometry.translation(*shift)) for shift in shifts], 1.0)


def test_images_are_standardised_over_their_valid_pixels_only() -> None:
    (band,) = level_of((0, 0)).bands
    image, valid = band.view.image[0], torch.from_numpy(HOLE)
    assert abs(float(image[valid].mean())) < 1e-4
    assert abs(float(image[valid].std()) - 1) < 1e-3
    assert float(image[~valid].abs().max()) == 0


def test_keypoints_never_touch_invalid_pixels() -> None:
    level = level_of((7.0, -4.0))
    p, inside = level.draw(level.anywhere, 500, 1.0)
    assert len(p) == 500
    assert bool(inside.all())
    touched = transform(level.bands[0].h, patch_positions(p)).reshape(-1, 2)
    assert (touched >= 0).all()
    assert (touched <= torch.tensor([319.0, 239.0])).all()
    valid = torch.from_numpy(HOLE)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = touched.floor().long().unbind(dim=1)
        assert valid[(y + dy).clamp(max=239), (x + dx).clamp(max=319)].all()


def test_held_out_patches_share_no_pixel_with_training_patches() -> None:
    level = level_of((0, 0))
    assert len(level.held_out) > 500
    seen = []
    for pool in (level.trainable, level.held_out):
        p, _ = level.draw(pool, 400, 1.0)
        assert len(p) > 100
        assert float(p.scale.max()) > 1.5
        pixels = patch_positions(p).reshape(-1, 2)
        # Bilinear interpolation uses four pixels.
        seen.append({(x + dx, y + dy) for x, y in pixels.floor().int().tolist() for dx in (0, 1) for dy in (0, 1)})
    train, held = seen
    assert not train & held


def test_points_beyond_the_horizon_are_outside() -> None:
    p, (band,) = Keypoints(torch.tensor([[160.0, 60.0]]), torch.zeros(1), torch.ones(1)), level_of((0, 0)).bands
    for away in ([[1.0, 0, 1e9], [0, 1.0, 0], [0, 0, 1.0]], [[1.0, 0, 0], [0, 1.0, 0], [-1 / 160, 0, 1.0]]):
        band.h = torch.tensor(away)
        assert not bool(band.overlaps(p)[0])


def test_keypoints_in_most_images_come_first() -> None:
    level = level_of((0, 0), (200.0, 0))
    p, inside = level.draw(level.anywhere, 100, 1.0)
    assert inside.shape == (100, 2)
    in_both = inside.all(dim=1)
    assert int(in_both.sum()) > 0
    assert bool((in_both[:-1] >= in_both[1:]).all())
    for k, band in enumerate(level.bands):
        torch.testing.assert_close(inside[:, k], band.overlaps(p))


def test_an_image_of_another_part_has_keypoints_of_its_own() -> None:
    left, right = (Raster(MOVING.pixels, HOLE & part) for part in (np.arange(320) < 180, np.arange(320) > 180))
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    level = make_level(state, FIXED, [MovingImage(one, np.eye(3)) for one in (left, left, right)], 1.0)
    p, inside = level.draw(level.anywhere, 100, 0.3)
    assert inside.sum(dim=0).tolist() == [100, 100, 25]
    assert len(p) == 125
    for k, band in enumerate(level.bands):
        torch.testing.assert_close(inside[:, k], band.overlaps(p))


def test_patches_are_displaced_by_the_local_value_of_the_field_and_sampled_through_the_lens() -> None:
    """The rig's field is in px of the full image; at half the resolution displacements are half as long."""
    model = Lens(300.0, 300.0, 158.0, 121.0, (-0.1, 0.15, 0.0004, -0.0003, -0.03))
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    # The values of the raw image are undistorted coordinates, so a sample equals its undistorted position.
    raw = np.moveaxis(lens.undistort(model, np.stack([x, y], axis=-1)), -1, 0).astype(np.float32)
    nodes = np.stack(np.meshgrid(np.arange(12) * 32.0, np.arange(9) * 32.0), axis=-1)
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    moving = [MovingImage(whole(raw, model), np.eye(3), field=DisplacementField(32.0, nodes * [0.01, -0.02]))]
    (band,) = make_level(state, FIXED, moving, 0.5).bands
    p = Keypoints(torch.tensor([[40.0, 30.0], [100.0, 90.0]]), torch.tensor([0.3, 2.0]), torch.full((2,), 0.5))
    samples = band.patches(p).numpy() * raw.std((1, 2))[:, None, None] + raw.mean((1, 2))[:, None, None]
    full_px, centres_px = (2 * (at.numpy() + 0.5) - 0.5 for at in (patch_positions(p), p.xy))
    expected = full_px + (centres_px * [0.01, -0.02])[:, None, None]
    np.testing.assert_allclose(np.moveaxis(samples, 1, -1), expected, atol=0.05)
