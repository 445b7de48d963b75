import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

from agalign.config import JointSettings
from agalign.errors import NotEnoughTextureError
from agalign.method.gauss_newton import Step
from agalign.method.gauss_newton import solve as solve_equations
from agalign.method.levels import Level, LevelBand, make_level
from agalign.method.patches import homography_from_psi, transform
from agalign.method.refine import ReferencePatches, converge, refine
from agalign.method.state import ImageGroup, JointState, MovingImage
from agalign.values import geometry
from agalign.values.issues import CORNERS_UNKNOWN, Issue

from ..builders import whole
from ..conftest import textured_image

SIZE = WIDTH, HEIGHT = 300, 200
CORNERS = torch.from_numpy(geometry.corners(WIDTH, HEIGHT))
Problem = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Positions, residuals and gradients of the descriptors."""


def solve(problem: Problem, family: str | None) -> Step:
    return solve_equations(*problem, SIZE, family)


def shift_of(x: float) -> torch.Tensor:
    return torch.from_numpy(geometry.translation(x, 0.0))


def linear_problem(change: torch.Tensor, count: int = 200, noise: float = 0.0, seed: int = 0) -> Problem:
    """Descriptors that are linear in the position: the residual of a change is exactly G times its shifts."""
    rng = torch.Generator().manual_seed(seed)
    xy = torch.tensor(np.random.default_rng(seed).uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2)))
    gradient = torch.randn(count, 256, 2, generator=rng, dtype=torch.float64)
    residual = torch.einsum("ndk,nk->nd", gradient, transform(change, xy) - xy)
    return xy, residual + noise * torch.randn(count, 256, generator=rng, dtype=torch.float64), gradient


@pytest.mark.parametrize(("family", "moves"), [("homography", range(8)), ("affine", range(6)), ("translation", (4, 5))])
def test_a_small_change_is_recovered(family: str, moves: range | tuple[int, int]) -> None:
    psi = torch.zeros(8, dtype=torch.float64)
    psi[list(moves)] = torch.tensor([0.05, -0.03, 0.04, 0.02, 0.03, -0.06, 0.02, -0.03]).double()[list(moves)]
    change = homography_from_psi(psi, WIDTH, HEIGHT)
    step = solve(linear_problem(change), family)
    # Not exact, because the mean residual is removed and the damping is 1e-4.
    torch.testing.assert_close(transform(step.change, CORNERS), transform(change, CORNERS), atol=0.02, rtol=0)


def test_a_third_of_wrong_patches_does_not_bias_the_step() -> None:
    xy, residual, gradient = linear_problem(shift_of(0.5), 300, noise=0.05)
    residual[:100] = 4 * torch.randn(100, 256, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    assert float(solve((xy, residual, gradient), "translation").change[0, 2]) == pytest.approx(0.5, abs=0.03)


def test_long_steps_are_cut() -> None:
    step = solve(linear_problem(shift_of(20)), "translation")
    assert step.length_px == pytest.approx(20, abs=0.5)
    assert float(step.change[0, 2]) == pytest.approx(4, abs=0.1)


def test_the_family_has_as_many_parameters_as_the_patches_determine() -> None:
    xy, residual, gradient = linear_problem(shift_of(0), 300, noise=0.5)
    assert solve((xy, residual, gradient), None).family == "homography"
    in_a_corner = 0.02 * xy
    assert solve((in_a_corner, residual, gradient), None).family != "homography"


@pytest.mark.parametrize("count", [16, 150])
def test_the_standard_error_equals_the_scatter_of_repeated_trials(count: int) -> None:
    steps = [solve(linear_problem(shift_of(0), count, noise=1.0, seed=seed), "homography") for seed in range(120)]
    errors = np.array([(transform(step.change, CORNERS) - CORNERS).numpy() for step in steps])
    claims = np.array([step.corner_std_xy_px for step in steps])
    assert np.sqrt((claims**2).mean()) == pytest.approx(np.sqrt((errors**2).mean()), rel=0.15)


# ---- steps on images


STATE = JointState(JointSettings(device="cpu"), lambda *_: None)


@pytest.fixture
def group() -> ImageGroup:
    """Two equal smooth images."""
    smooth = whole(cv2.GaussianBlur(textured_image(400, 320), (0, 0), 3.0))
    return ImageGroup(smooth, [MovingImage(smooth, np.eye(3))])


@pytest.fixture
def level(group: ImageGroup) -> Level:
    return make_level(STATE, group.fixed, group.moving, 1.0)


@torch.no_grad()
def test_the_gradient_predicts_the_descriptors_of_shifted_patches(level: Level) -> None:
    net, (p, _) = STATE.fast_descriptor([1, 1]), level.draw(level.anywhere, 200, 0.3)
    patches = ReferencePatches.of(net, level, p)
    for shift in ((0.7, 0.0), (0.0, 0.7)):
        change = level.fixed.describe(net, p.moved(*shift)) - patches.f
        predicted = patches.gradient @ torch.tensor(shift)
        assert float((predicted * change).sum() / change.square().sum()) == pytest.approx(0.9, abs=0.1)


def step_of(x: float, length_px: float) -> Step:
    covariance = torch.zeros(8, 8, dtype=torch.float64)
    return Step(shift_of(x), length_px, ((0.1, 0.1),) * 4, "homography", covariance)


def halving(x: float) -> Step:
    """Half of the remaining distance to a shift of 1 px."""
    return step_of((1.0 - x) / 2, abs(1.0 - x) / 2)


def unbounded_from(end: float) -> Callable[[float], Step]:
    """Regular steps up to a shift, then one of infinite length, as `solve` returns it."""
    return lambda x: step_of(0.4, 0.4) if x < end - 1e-3 else step_of(0.0, math.inf)


@pytest.mark.parametrize(
    ("step_at", "end", "last_px"),
    [(halving, 1.0, 0.0), (unbounded_from(0.0), 0.0, math.inf), (unbounded_from(0.8), 0.8, math.inf)],
)
def test_steps_with_a_constant_ratio_are_extrapolated_and_infinite_ones_left_out(
    level: Level, monkeypatch: pytest.MonkeyPatch, step_at: Callable[[float], Step], end: float, last_px: float
) -> None:
    monkeypatch.setattr("agalign.method.refine.step_from", lambda _net, band, *_: step_at(float(band.h[0, 2])))
    (band,) = level.bands
    patches = ReferencePatches(*(torch.zeros(4, 2),) * 3)
    assert converge(None, band, patches, "homography").length_px == pytest.approx(last_px, abs=0.03)
    assert float(band.h[0, 2]) == pytest.approx(end, abs=1e-3)


def test_all_patches_are_used_if_half_of_them_are_too_few(level: Level, monkeypatch: pytest.MonkeyPatch) -> None:
    def step_from(_net: object, band: LevelBand, patches: ReferencePatches, *_: object) -> Step:
        if len(patches.f) < 20:
            raise NotEnoughTextureError(len(patches.f), 20)
        return halving(float(band.h[0, 2]))

    monkeypatch.setattr("agalign.method.refine.step_from", step_from)
    (band,) = level.bands
    assert converge(None, band, ReferencePatches(*(torch.zeros(24, 2),) * 3), "homography").length_px < 0.06
    with pytest.raises(NotEnoughTextureError):
        converge(None, band, ReferencePatches(*(torch.zeros(16, 2),) * 3), "homography")


def test_an_infinite_last_step_means_unknown_corners(group: ImageGroup, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agalign.method.gauss_newton.transform", lambda _h, points: points * math.nan)
    assert refine(STATE, STATE.fast_descriptor([1, 1]), group) == [Issue(CORNERS_UNKNOWN)]
