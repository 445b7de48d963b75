import math
from collections.abc import Iterable

import numpy as np
import pytest
import torch

from agalign.config import JointSettings
from agalign.method.gauss_newton import PatchEquations, Step, shift_gradient, shift_over_psi
from agalign.method.gauss_newton import solve as solve_equations
from agalign.method.patches import Keypoints, homography_from_psi, transform
from agalign.method.refine import ReferencePatches, Solver, refine
from agalign.method.state import ImageGroup, JointState
from agalign.values import geometry
from agalign.values.issues import CORNERS_UNKNOWN, Issue

from ..builders import two_views

WIDTH, HEIGHT = 300, 200
CORNERS = torch.from_numpy(geometry.corners(WIDTH, HEIGHT))
Problem = tuple[Keypoints, torch.Tensor, torch.Tensor]
"""Keypoints, residuals and gradients of the descriptors."""


def solve(problem: Problem, family: str | None, max_std: float = 1.0, longest: float = 10.0) -> Step:
    equations = PatchEquations.of(*problem, (WIDTH, HEIGHT))
    return solve_equations(equations, family, max_corner_std_px=max_std, max_step_px=longest)


def shift_of(x: float) -> torch.Tensor:
    change = torch.eye(3, dtype=torch.float64)
    change[0, 2] = x
    return change


def scattered(count: int, seed: int = 0) -> Keypoints:
    rng = np.random.default_rng(seed)
    xy = torch.tensor(rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2)))
    return Keypoints(xy, torch.zeros(count).double(), torch.ones(count).double())


def linear_problem(change: torch.Tensor, count: int = 200, noise: float = 0.0, seed: int = 0) -> Problem:
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


def test_shift_gradient_of_a_linear_descriptor() -> None:
    p = scattered(20)
    slope = torch.randn(256, 2, dtype=torch.float64)
    result = shift_gradient(lambda k: k.xy @ slope.T, p, 0.75)
    torch.testing.assert_close(result, slope.expand(20, 256, 2), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize(("family", "moves"), [("homography", range(8)), ("affine", range(6)), ("translation", (4, 5))])
def test_a_small_change_is_recovered(family: str, moves: Iterable[int]) -> None:
    psi = torch.tensor([0.05, -0.03, 0.04, 0.02, 0.03, -0.06, 0.02, -0.03], dtype=torch.float64)
    psi = torch.where(torch.isin(torch.arange(8), torch.tensor(list(moves))), psi, 0.0)
    change = homography_from_psi(psi, WIDTH, HEIGHT)
    step = solve(linear_problem(change), family)
    # Not exact, because the mean residual is removed and the damping is 1e-4.
    torch.testing.assert_close(transform(step.change, CORNERS), transform(change, CORNERS), atol=0.02, rtol=0)


def test_a_third_of_wrong_patches_does_not_bias_the_step() -> None:
    p, residual, gradient = linear_problem(shift_of(0.5), 300, noise=0.05)
    residual[:100] = 4 * torch.randn(100, 256, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    step = solve((p, residual, gradient), "translation")
    assert float(step.change[0, 2]) == pytest.approx(0.5, abs=0.03)


def test_long_steps_are_cut() -> None:
    step = solve(linear_problem(shift_of(20)), "translation", longest=4.0)
    assert step.length_px == pytest.approx(20, abs=0.5)
    assert float(step.change[0, 2]) == pytest.approx(4, abs=0.1)


def test_the_family_has_as_many_parameters_as_the_patches_determine() -> None:
    p, residual, gradient = linear_problem(shift_of(0), 300, noise=0.5)
    assert solve((p, residual, gradient), None, 0.5).family == "homography"
    near = Keypoints(0.1 * p.xy, p.angle, p.scale)  # All patches are in one corner and do not determine the others.
    assert solve((near, residual, gradient), None, 0.05).family != "homography"


def test_the_standard_error_equals_the_scatter_of_repeated_trials() -> None:
    steps = [solve(linear_problem(shift_of(0), 150, noise=1.0, seed=seed), "homography", 9.0) for seed in range(60)]
    errors = np.array([(transform(step.change, CORNERS) - CORNERS).numpy() for step in steps])
    spread = np.sqrt((errors**2).sum(axis=-1).mean(axis=0)).max()
    assert np.median([step.corner_std_px for step in steps]) == pytest.approx(spread, rel=0.35)


# ---- steps until convergence

START = (
    torch.eye(3),
    ReferencePatches(
        Keypoints(torch.zeros(4, 2), torch.zeros(4), torch.ones(4)), torch.zeros(4, 256), torch.zeros(4, 256, 2)
    ),
)


def step_of(x: float, length_px: float) -> Step:
    covariance = torch.zeros(8, 8, dtype=torch.float64)
    return Step(shift_of(x), length_px, ((0.1, 0.1),) * 4, "homography", covariance)


class Halving(Solver):
    """Each step covers half of the remaining distance to a shift of 1 px."""

    def step(self, _band: object, homography: torch.Tensor, _patches: ReferencePatches) -> Step:
        half_px = (1.0 - float(homography[0, 2])) / 2
        return step_of(half_px, abs(half_px))


def test_steps_with_a_constant_ratio_are_extrapolated() -> None:
    result, last = Halving("homography").converge(None, *START)
    assert last.length_px < 0.03
    assert abs(float(result[0, 2]) - 1.0) < 1e-3


class Unbounded(Solver):
    """Some regular steps, then one of infinite length, as `gauss_newton.solve` returns it."""

    regular_steps = 0

    def step(self, _band: object, homography: torch.Tensor, _patches: ReferencePatches) -> Step:
        is_regular = float(homography[0, 2]) < 0.4 * self.regular_steps - 1e-3
        return step_of(0.4, 0.4) if is_regular else step_of(0.0, math.inf)


@pytest.mark.parametrize("regular_steps", [0, 1, 2])
def test_a_step_of_infinite_length_ends_with_a_finite_homography(
    regular_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Unbounded, "regular_steps", regular_steps)
    result, last = Unbounded("homography").converge(None, *START)
    assert torch.isfinite(result).all()
    assert last.length_px == math.inf


def test_an_infinite_last_step_means_unknown_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agalign.method.gauss_newton.transform", lambda _h, points: points * math.nan)
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    group = ImageGroup.of_one(*two_views(np.eye(3)), np.eye(3))
    assert refine(state, state.fast_descriptor([1, 1]), group) == [Issue(CORNERS_UNKNOWN)]
