import numpy as np
import pytest
import torch

from agalign.method.gauss_newton import PatchEquations, Step, shift_gradient, shift_over_psi
from agalign.method.gauss_newton import solve as solve_equations
from agalign.method.patches import Keypoints, homography_from_psi, transform
from agalign.values import geometry

WIDTH, HEIGHT = 300, 200


def solve(
    p: Keypoints, residual: torch.Tensor, gradient: torch.Tensor, family: str | None, max_std: float, longest: float
) -> Step:
    equations = PatchEquations.of(p, residual, gradient, (WIDTH, HEIGHT))
    return solve_equations(equations, family, max_corner_std_px=max_std, max_step_px=longest)


def scattered(count: int, seed: int = 0) -> Keypoints:
    rng = np.random.default_rng(seed)
    xy = torch.tensor(rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2)))
    return Keypoints(xy, torch.zeros(count).double(), torch.ones(count).double())


def linear_problem(
    change: torch.Tensor, count: int = 200, noise: float = 0.0, seed: int = 0
) -> tuple[Keypoints, torch.Tensor, torch.Tensor]:
    """Descriptors that are linear in the position: the residual of a change is exactly G times its shifts."""
    rng = torch.Generator().manual_seed(seed)
    p = scattered(count, seed)
    gradient = torch.randn(count, 256, 2, generator=rng, dtype=torch.float64)
    shifts = transform(change, p.xy) - p.xy
    residual = torch.einsum("ndk,nk->nd", gradient, shifts)
    return p, residual + noise * torch.randn(count, 256, generator=rng, dtype=torch.float64), gradient


def test_shift_over_psi_equals_finite_differences() -> None:
    p = scattered(10).xy
    jacobian = shift_over_psi(p, WIDTH, HEIGHT)
    for k in range(8):
        step = torch.zeros(8, dtype=torch.float64)
        step[k] = 1e-5
        plus = transform(homography_from_psi(step, WIDTH, HEIGHT), p)
        minus = transform(homography_from_psi(-step, WIDTH, HEIGHT), p)
        torch.testing.assert_close(jacobian[:, :, k], (plus - minus) / 2e-5, atol=1e-5, rtol=1e-5)


def test_shift_over_psi_equals_over_corners_in_other_parameters() -> None:
    """The Jacobian is implemented in torch and in numpy; both must agree."""
    p = scattered(10).xy
    corners = torch.from_numpy(geometry.corners(WIDTH, HEIGHT))
    of_corners = shift_over_psi(corners, WIDTH, HEIGHT).reshape(8, 8).numpy()
    expected = geometry.over_corners(p.numpy(), WIDTH, HEIGHT) @ of_corners
    np.testing.assert_allclose(shift_over_psi(p, WIDTH, HEIGHT), expected, atol=1e-9)


def test_shift_gradient_of_a_linear_descriptor() -> None:
    p = scattered(20)
    slope = torch.randn(256, 2, dtype=torch.float64)
    torch.testing.assert_close(
        shift_gradient(lambda k: k.xy @ slope.T, p, 0.75), slope.expand(20, 256, 2), atol=1e-9, rtol=1e-9
    )


@pytest.mark.parametrize("family", ["homography", "affine", "translation"])
def test_a_small_change_is_recovered(family: str) -> None:
    moves = {"homography": range(8), "affine": range(6), "translation": (4, 5)}[family]
    psi = torch.zeros(8, dtype=torch.float64)
    psi[list(moves)] = torch.tensor([0.05, -0.03, 0.04, 0.02, 0.03, -0.06, 0.02, -0.03], dtype=torch.float64)[
        list(moves)
    ]
    change = homography_from_psi(psi, WIDTH, HEIGHT)
    p, residual, gradient = linear_problem(change)
    step = solve(p, residual, gradient, family, 1.0, 10.0)
    corner = torch.tensor([[0.0, 0], [WIDTH - 1, HEIGHT - 1]], dtype=torch.float64)
    # Not exact, because the mean residual is removed and the damping is 1e-4.
    torch.testing.assert_close(transform(step.change, corner), transform(change, corner), atol=0.02, rtol=0)


def test_a_third_of_wrong_patches_does_not_bias_the_step() -> None:
    change = torch.eye(3, dtype=torch.float64)
    change[0, 2] = 0.5
    p, residual, gradient = linear_problem(change, 300, noise=0.05)
    residual[:100] = 4 * torch.randn(100, 256, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    step = solve(p, residual, gradient, "translation", 1.0, 10.0)
    assert float(step.change[0, 2]) == pytest.approx(0.5, abs=0.03)


def test_long_steps_are_cut() -> None:
    change = torch.eye(3, dtype=torch.float64)
    change[0, 2] = 20
    p, residual, gradient = linear_problem(change)
    step = solve(p, residual, gradient, "translation", 1.0, 4.0)
    assert step.length_px == pytest.approx(20, abs=0.5)
    assert float(step.change[0, 2]) == pytest.approx(4, abs=0.1)


def test_the_family_has_as_many_parameters_as_the_patches_determine() -> None:
    still = torch.eye(3, dtype=torch.float64)
    p, residual, gradient = linear_problem(still, 300, noise=0.5)
    rich = solve(p, residual, gradient, None, 0.5, 4.0)
    assert rich.family == "homography"
    corner = p.xy.clone()
    corner[:] = corner * 0.1  # All patches are in one corner and do not determine the others.
    near = Keypoints(corner, p.angle, p.scale)
    poor = solve(near, residual, gradient, None, 0.05, 4.0)
    assert poor.family != "homography"


def test_the_standard_error_equals_the_scatter_of_repeated_trials() -> None:
    still = torch.eye(3, dtype=torch.float64)
    errors, claimed = [], []
    for seed in range(60):
        p, residual, gradient = linear_problem(still, 150, noise=1.0, seed=seed)
        step = solve(p, residual, gradient, "homography", 9.0, 10.0)
        corners = torch.tensor(
            [[0.0, 0], [WIDTH - 1, 0], [WIDTH - 1, HEIGHT - 1], [0, HEIGHT - 1]], dtype=torch.float64
        )
        errors.append((transform(step.change, corners) - corners).numpy())
        claimed.append(step.corner_std_px)
    spread = np.sqrt((np.array(errors) ** 2).sum(axis=-1).mean(axis=0)).max()
    assert np.median(claimed) == pytest.approx(spread, rel=0.35)
