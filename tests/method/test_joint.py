from typing import Any

import numpy as np
import pytest
import torch

from agalign.config import JointSettings
from agalign.method.fast import Schedule, learn, learn_scales
from agalign.method.joint import align_from_scratch
from agalign.method.paper import Training
from agalign.method.refine import refine
from agalign.method.state import ImageGroup, JointState, ThetaStart
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.image import Raster
from agalign.values.issues import NO_CONTRAST, Issue

from ..conftest import mean_error_px, textured_image, textured_pair

pytestmark = pytest.mark.slow

TRUTH = np.array([[1.004, 0.006, 6.0], [-0.005, 0.998, -4.0], [4e-6, -6e-6, 1.0]])
NEAR = geometry.translation(7.5, -5.5)


def rasters(matrix: np.ndarray, seed: int = 0) -> tuple[Raster, Raster]:
    fixed, moving = textured_pair(matrix, seed=seed)
    valid = np.ones(fixed.shape, bool)
    return Raster(fixed, valid), Raster(moving, valid)


def scratch(
    fixed: Raster, moving: Raster, seed: np.ndarray, settings: JointSettings, **how: Any
) -> JointResult | Issue:
    group = ImageGroup.of_one(fixed, moving, seed, trusted=True)
    return align_from_scratch(group, settings, lambda *_: None, **how)[0]


def run(settings: JointSettings, **how: Any) -> JointResult:
    result = scratch(*rasters(TRUTH), NEAR, settings, **how)
    assert isinstance(result, JointResult)
    return result


@pytest.mark.parametrize("start", ["random", "starter"])
def test_fast_recovers_a_homography_through_reversed_contrast(start: ThetaStart) -> None:
    result = run(JointSettings(), start=start)
    assert mean_error_px(result.fixed_to_moving, TRUTH, 400, 320) < 0.08
    assert result.retrieval > 0.8
    assert result.chance < 0.01
    assert result.model_family == "homography"


def test_the_same_rng_seed_gives_the_same_result_and_another_gives_another() -> None:
    short: dict[str, Any] = {"start": "random", "schedule": Schedule(max_steps=50)}
    one, same = (run(JointSettings(rng_seed=4), **short) for _ in range(2))
    other = run(JointSettings(rng_seed=5), **short)
    np.testing.assert_array_equal(one.fixed_to_moving, same.fixed_to_moving)
    assert one.retrieval == same.retrieval
    assert not np.array_equal(one.fixed_to_moving, other.fixed_to_moving)


def test_the_global_random_state_is_unchanged() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    run(JointSettings(), start="random", schedule=Schedule(max_steps=50))
    assert torch.equal(before, torch.get_rng_state())


def test_a_translation_stays_a_translation() -> None:
    start = geometry.translation(4.0, -2.0)
    fixed, moving = rasters(geometry.translation(6.0, -4.0))
    settings = JointSettings(model_family="translation")
    result = scratch(fixed, moving, start, settings)
    np.testing.assert_allclose(result.fixed_to_moving[:2, :2], np.eye(2), atol=1e-6)
    np.testing.assert_allclose(result.fixed_to_moving[2], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(result.fixed_to_moving[:2, 2], [6, -4], atol=0.08)


def test_unrelated_images_are_not_distinguished() -> None:
    valid = np.ones((320, 400), bool)
    pair = [Raster(textured_image(400, 320, s), valid) for s in (8, 9)]
    result = scratch(*pair, np.eye(3), JointSettings())
    assert result.code == "retrieval"
    assert result.value is not None
    assert result.value < 0.1


def test_rgb_against_a_single_band() -> None:
    fixed, moving = rasters(TRUTH)
    rgb = np.stack([fixed.pixels, 0.5 * fixed.pixels + 1, textured_image(400, 320, 3)])
    result = scratch(Raster(rgb, fixed.valid), moving, NEAR, JointSettings())
    assert mean_error_px(result.fixed_to_moving, TRUTH, 400, 320) < 0.15


def test_images_without_contrast_or_overlap_have_an_issue() -> None:
    fixed, moving = rasters(TRUTH)
    flat = Raster(np.zeros_like(fixed.pixels), fixed.valid)
    assert scratch(flat, moving, NEAR, JointSettings()) == Issue(NO_CONTRAST)
    without_overlap = geometry.translation(390, 0)
    result = scratch(fixed, moving, without_overlap, JointSettings())
    assert result.code == "few_keypoints"


def test_one_network_for_two_bands_and_an_unrelated_one() -> None:
    fixed, moving = rasters(TRUTH)
    unrelated_image = Raster(textured_image(400, 320, 9), fixed.valid)
    other = Raster(np.tanh(fixed.pixels), fixed.valid)
    group = ImageGroup(fixed, [moving, unrelated_image, other], [NEAR, NEAR, np.eye(3)], [1, 2, 3], [True] * 3)
    result = align_from_scratch(group, JointSettings(), lambda *_: None)
    assert [type(r) for r in result] == [JointResult, Issue, JointResult]
    assert mean_error_px(result[0].fixed_to_moving, TRUTH, 400, 320) < 0.1
    assert result[1].code == "retrieval"
    assert mean_error_px(result[2].fixed_to_moving, np.eye(3), 400, 320) < 0.1


@pytest.mark.parametrize(("sharing", "left"), [("siamese", 0.35), ("pseudo-siamese", 0.35), ("unshared", 0.9)])
def test_paper_recipe_reduces_the_error(sharing: str, left: float) -> None:
    # Unshared networks learn most slowly, as the paper expects; three epochs are few.
    settings = JointSettings(recipe="paper", sharing=sharing)
    fixed, moving = textured_pair(TRUTH)
    # The siamese network is for one modality, so the contrast is not reversed.
    valid = np.ones(fixed.shape, bool)
    moving = -moving if sharing == "siamese" else moving
    result = scratch(Raster(fixed, valid), Raster(moving, valid), NEAR, settings, training=Training(2000, 3))
    assert result.recipe == "paper"
    assert result.levels == (0.25, 0.5, 1.0)
    start = mean_error_px(NEAR, TRUTH, 400, 320)
    assert mean_error_px(result.fixed_to_moving, TRUTH, 400, 320) < left * start


def test_levels_halve_down_to_the_coarsest() -> None:
    assert learn_scales(1280) == [0.25, 0.5]


def test_a_distant_start_is_found_by_searching_the_loss() -> None:
    """An offset of an eighth of the image, too large for steps on psi alone."""
    truth = geometry.translation(6.0, -4.0)
    fixed, moving = rasters(truth)
    state = JointState(JointSettings(device="cpu"), lambda *_: None)
    net = state.fast_descriptor([1, 1])
    group = ImageGroup.of_one(fixed, moving, geometry.translation(46.0, 26.0))
    learn(state, [group], net)
    result = refine(state, net, group)[0]
    assert np.abs(geometry.apply(result.fixed_to_moving, [[200.0, 160.0]]) - [206.0, 156.0]).max() < 0.2
