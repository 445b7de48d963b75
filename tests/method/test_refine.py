import torch

from agalign.config import FastRecipe
from agalign.method.gauss_newton import Step
from agalign.method.patches import Keypoints
from agalign.method.refine import ReferencePatches, Solver


class Halving(Solver):
    """Every step goes half of the way that is left to a shift of 1 px."""

    def step(self, _band: object, homography: torch.Tensor, _anchors: ReferencePatches) -> Step:  # type: ignore[override]
        left = 1.0 - float(homography[0, 2])
        change = torch.eye(3, dtype=torch.float64)
        change[0, 2] = left / 2
        return Step(change, abs(left) / 2, ((0.0, 0.0),) * 4, "homography", torch.zeros(8, 8, dtype=torch.float64))


def test_steps_that_fall_by_a_constant_ratio_are_summed_to_their_end() -> None:
    points = Keypoints(torch.zeros(4, 2), torch.zeros(4), torch.ones(4))
    reference_patches = ReferencePatches(points, torch.zeros(4, 256), torch.zeros(4, 256, 2))
    result, last = Halving("homography", FastRecipe()).converge(None, torch.eye(3), reference_patches)  # type: ignore[arg-type]
    assert last.length_px < FastRecipe().final_rest_px
    assert abs(float(result[0, 2]) - 1.0) < 1e-3
