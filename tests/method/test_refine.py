import math

import numpy as np
import pytest
import torch

from agalign.config import JointSettings
from agalign.method.gauss_newton import Step
from agalign.method.patches import Keypoints
from agalign.method.refine import ReferencePatches, Solver, refine
from agalign.method.state import ImageGroup, JointState
from agalign.values.image import Raster
from agalign.values.issues import CORNERS_UNKNOWN, Issue

from ..conftest import textured_pair


class Halving(Solver):
    """Each step covers half of the remaining distance to a shift of 1 px."""

    def step(self, _band: object, homography: torch.Tensor, _anchors: ReferencePatches) -> Step:
        left = 1.0 - float(homography[0, 2])
        change = torch.eye(3, dtype=torch.float64)
        change[0, 2] = left / 2
        return Step(change, abs(left) / 2, ((0.0, 0.0),) * 4, "homography", torch.zeros(8, 8, dtype=torch.float64))


def test_steps_with_a_constant_ratio_are_extrapolated() -> None:
    points = Keypoints(torch.zeros(4, 2), torch.zeros(4), torch.ones(4))
    reference_patches = ReferencePatches(points, torch.zeros(4, 256), torch.zeros(4, 256, 2))
    result, last = Halving("homography").converge(None, torch.eye(3), reference_patches)
    assert last.length_px < 0.03
    assert abs(float(result[0, 2]) - 1.0) < 1e-3


class Unbounded(Solver):
    """Some regular steps, then one of infinite length, as `gauss_newton.solve` returns it."""

    regular_steps = 0

    def step(self, _band: object, homography: torch.Tensor, _anchors: ReferencePatches) -> Step:
        change = torch.eye(3, dtype=torch.float64)
        length_px = 0.4 if float(homography[0, 2]) < 0.4 * self.regular_steps - 1e-3 else math.inf
        if math.isfinite(length_px):
            change[0, 2] = length_px
        return Step(change, length_px, ((0.1, 0.1),) * 4, "homography", torch.zeros(8, 8, dtype=torch.float64))


@pytest.mark.parametrize("regular_steps", [0, 1, 2])
def test_a_step_of_infinite_length_ends_with_a_finite_homography(
    regular_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Unbounded, "regular_steps", regular_steps)
    points = Keypoints(torch.zeros(4, 2), torch.zeros(4), torch.ones(4))
    reference_patches = ReferencePatches(points, torch.zeros(4, 256), torch.zeros(4, 256, 2))
    result, last = Unbounded("homography").converge(None, torch.eye(3), reference_patches)
    assert torch.isfinite(result).all()
    assert last.length_px == math.inf


def test_an_infinite_last_step_means_unknown_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agalign.method.gauss_newton.transform", lambda _h, points: points * math.nan)
    fixed, moving = textured_pair(np.eye(3))
    valid = np.ones(fixed.shape, bool)
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    group = ImageGroup.of_one(Raster(fixed, valid), Raster(moving, valid), np.eye(3))
    assert refine(state, state.fast_descriptor([1, 1]), group) == [Issue(CORNERS_UNKNOWN)]
