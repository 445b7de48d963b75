import kornia
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

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

psis = st.lists(st.floats(-6, 6), min_size=8, max_size=8).map(lambda v: torch.tensor(v, dtype=torch.float64))


def keypoints(count: int = 50, seed: int = 0) -> Keypoints:
    g = torch.Generator().manual_seed(seed)
    return Keypoints(
        torch.rand(count, 2, generator=g, dtype=torch.float64) * 60 + 20,
        torch.rand(count, generator=g, dtype=torch.float64) * 6.28,
        1 + torch.rand(count, generator=g, dtype=torch.float64),
    )


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


def test_gradient_over_psi_equals_finite_differences() -> None:
    # The image is smooth, so that the kinks of bilinear interpolation do not matter.
    y, x = torch.meshgrid(torch.arange(120.0).double(), torch.arange(140.0).double(), indexing="ij")
    image = (torch.sin(x / 9) * torch.cos(y / 11))[None]
    p = keypoints(20)

    def value(psi: torch.Tensor) -> torch.Tensor:
        return bilinear(image, transform(homography_from_psi(psi, 140, 120), patch_positions(p))).square().sum()

    psi = torch.full((8,), 0.5, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(psi), psi)
    for k in range(8):
        step = torch.zeros(8, dtype=torch.float64)
        step[k] = 0.02
        numeric = (value(psi.detach() + step) - value(psi.detach() - step)) / 0.04
        assert float(gradient[k]) == pytest.approx(float(numeric), rel=0.03, abs=0.02 * float(gradient.abs().max()))
