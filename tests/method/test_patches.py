"""Patches at keypoints, and the levels of the pyramid that they are drawn from."""

from collections.abc import Sequence

import kornia
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from agalign.method.levels import Level, Sampler, footprints_inside, make_level, make_level_image
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
from agalign.values import lens
from agalign.values.image import Raster
from agalign.values.lens import Lens
from agalign.values.mapping import DisplacementField

from ..builders import texture, whole

psis = st.lists(st.floats(-6, 6), min_size=8, max_size=8).map(lambda v: torch.tensor(v, dtype=torch.float64))


def keypoints(count: int = 50, seed: int = 0) -> Keypoints:
    g = torch.Generator().manual_seed(seed)
    return Keypoints(
        torch.rand(count, 2, generator=g, dtype=torch.float64) * 60 + 20,
        torch.rand(count, generator=g, dtype=torch.float64) * 6.28,
        1 + torch.rand(count, generator=g, dtype=torch.float64),
    )


@settings(deadline=None)
@given(psis)
def test_psi_round_trip(psi: torch.Tensor) -> None:
    h = homography_from_psi(psi, 320, 240)
    torch.testing.assert_close(psi_from_homography(3 * h, 320, 240), psi, atol=1e-9, rtol=1e-9)


def test_psi_is_the_vector_in_the_paper() -> None:
    h = torch.tensor([[1.1, 0.2, 32.0], [0.3, 0.9, -24.0], [1e-3, -2e-3, 1.0]], dtype=torch.float64)
    expected = ALPHA * torch.tensor([0.1, 0.2, 0.3, -0.1, 0.1, -0.1, 0.32, -0.48], dtype=torch.float64)
    torch.testing.assert_close(psi_from_homography(h, 320, 240), expected)
    torch.testing.assert_close(homography_from_psi(torch.zeros(8), 320, 240), torch.eye(3))


def test_keypoint_warp_equals_finite_differences_of_an_affine_mapping() -> None:
    # For an affine mapping the paper's v' equals the difference of two warped points.
    h = torch.tensor([[1.1, 0.1, 5.0], [-0.2, 0.9, -3.0], [0, 0, 1.0]], dtype=torch.float64)
    p = keypoints()
    v = p.scale[:, None] * torch.stack([p.angle.cos(), p.angle.sin()], dim=1)
    v_prime = transform(h, p.xy + v) - transform(h, p.xy)
    warped = warp_keypoints(p, h)
    torch.testing.assert_close(warped.xy, transform(h, p.xy))
    torch.testing.assert_close(warped.scale, v_prime.norm(dim=1))
    torch.testing.assert_close(warped.angle, torch.atan2(v_prime[:, 1], v_prime[:, 0]))


def test_keypoint_warp_divides_by_the_denominator() -> None:
    h = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [2e-3, 0, 1.0]], dtype=torch.float64)
    p = Keypoints(*(torch.tensor(v).double() for v in ([[50.0, 0.0]], [0.0], [2.0])))
    assert float(warp_keypoints(p, h).scale) == pytest.approx(2 / 1.1)


def test_bilinear_is_linear_interpolation_at_pixel_centres() -> None:
    image = np.random.default_rng(0).normal(size=(2, 90, 110))
    grid = patch_positions(keypoints())
    where = [grid[..., 1].numpy(), grid[..., 0].numpy()]
    expected = [map_coordinates(channel, where, order=1, mode="nearest") for channel in image]
    np.testing.assert_allclose(bilinear(torch.from_numpy(image), grid), np.stack(expected, 1), atol=1e-10)


def test_patch_agrees_with_kornias_rotated_crop() -> None:
    image = torch.randn(1, 1, 100, 100, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    p = Keypoints(*(torch.tensor(v).double() for v in ([[50.0, 47.0]], [0.6], [1.3])))
    actual = bilinear(image[0], patch_positions(p))[0, 0]
    cos, sin = 1.3 * np.cos(0.6), 1.3 * np.sin(0.6)
    # Patch pixel (u, v) -> image pixel, as a 3x3; kornia warps with the map from source to destination.
    to_image = np.array([[cos, -sin, 50 - 7.5 * (cos - sin)], [sin, cos, 47 - 7.5 * (sin + cos)], [0, 0, 1.0]])
    to_patch = torch.from_numpy(np.linalg.inv(to_image))[None]
    theirs = kornia.geometry.warp_perspective(image, to_patch, (16, 16), align_corners=True)[0, 0]
    torch.testing.assert_close(actual, theirs, atol=1e-5, rtol=1e-5)  # kornia normalises with an epsilon


# ---- levels


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
