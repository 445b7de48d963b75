from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from agalign.config import JointSettings
from agalign.method.fast import learn_scales
from agalign.method.joint import learn_and_refine
from agalign.method.paper import DEFAULT_TRAINING, Training
from agalign.method.state import ImageGroup, MovingImage
from agalign.values import geometry
from agalign.values.alignment import JointResult
from agalign.values.choices import Recipe
from agalign.values.image import Raster
from agalign.values.issues import NO_CONTRAST, Issue

from ..builders import in_full_run, texture, two_views, whole
from ..conftest import mean_error_px

pytestmark = pytest.mark.slow

TRUTH = np.array([[1.004, 0.006, 6.0], [-0.005, 0.998, -4.0], [4e-6, -6e-6, 1.0]])
NEAR = geometry.translation(7.5, -5.5)


def scratch(
    fixed: Raster,
    moving: Raster,
    seed: np.ndarray,
    *,
    trusted: bool = True,
    training: Training = DEFAULT_TRAINING,
    **settings: Any,
) -> JointResult | Issue:
    group = ImageGroup(fixed, [MovingImage(moving, seed, trusted=trusted)])
    (result,) = learn_and_refine(group, JointSettings(**settings), lambda *_: None, training=training).values()
    return result


def error_px(result: JointResult, truth: np.ndarray = TRUTH) -> float:
    return mean_error_px(result.fixed_to_moving, truth, 400, 320)


@pytest.mark.parametrize("recipe", [in_full_run("scratch"), "fast"])
def test_a_homography_is_recovered_through_reversed_contrast(recipe: Recipe) -> None:
    result = scratch(*two_views(TRUTH), NEAR, recipe=recipe)
    assert result.recipe == recipe
    assert error_px(result) < 0.08
    assert result.retrieval > 0.8
    assert result.chance < 0.01
    assert result.model_family == "homography"


def test_results_depend_on_the_rng_seed_and_leave_the_global_random_state_unchanged() -> None:
    before = torch.get_rng_state()
    one, same, other = (scratch(*two_views(TRUTH), NEAR, rng_seed=k) for k in (4, 4, 5))
    assert torch.equal(before, torch.get_rng_state())
    np.testing.assert_array_equal(one.fixed_to_moving, same.fixed_to_moving)
    assert one.retrieval == same.retrieval
    assert not np.array_equal(one.fixed_to_moving, other.fixed_to_moving)


def test_a_translation_stays_a_translation() -> None:
    truth = geometry.translation(6.0, -4.0)
    result = scratch(*two_views(truth), geometry.translation(4.0, -2.0), model_family="translation")
    np.testing.assert_allclose(result.fixed_to_moving[:, :2], truth[:, :2], atol=1e-6)
    np.testing.assert_allclose(result.fixed_to_moving, truth, atol=0.08)


def test_unrelated_images_are_not_distinguished() -> None:
    result = scratch(texture(seed=8), texture(seed=9), np.eye(3))
    assert result.code == "retrieval"
    assert result.value is not None
    assert result.value < 0.1


@pytest.mark.parametrize("side_px", [40, 46])
def test_patches_need_room_at_the_finest_level_only(side_px: int) -> None:
    """Between saturated areas, reduced images have none, or too few for a test of retrieval."""
    fixed, moving = two_views(np.eye(3), 640, 480)
    y, x = np.indices((480, 640)) % (side_px + 8)
    valid = (y < side_px) & (x < side_px)
    result = scratch(replace(fixed, valid=valid), replace(moving, valid=valid), np.eye(3), trusted=False)
    assert result.retrieval > 0.8


def test_images_without_contrast_or_overlap_have_an_issue() -> None:
    fixed, moving = two_views(TRUTH)
    assert scratch(whole(np.zeros_like(fixed.pixels)), moving, NEAR) == Issue(NO_CONTRAST)
    result = scratch(fixed, moving, geometry.translation(390, 0))
    assert result.code == "few_keypoints"


@pytest.mark.parametrize(
    ("sharing", "training", "left"),
    [
        ("pseudo-siamese", Training(1000, 4), 0.8),
        in_full_run("pseudo-siamese", Training(2000, 6), 0.35),
        in_full_run("siamese", Training(2000, 6), 0.35),
        in_full_run("unshared", Training(2000, 6), 0.9),
    ],
)
def test_paper_recipe_reduces_the_error(sharing: str, training: Training, left: float) -> None:
    # Unshared networks learn most slowly, as the paper expects; three epochs are few.
    fixed, moving = two_views(TRUTH)
    # The siamese network is for one modality, so the contrast is not reversed.
    moving = whole(-moving.pixels) if sharing == "siamese" else moving
    result = scratch(fixed, moving, NEAR, training=training, recipe="paper", sharing=sharing)
    assert result.recipe == "paper"
    assert result.levels == pytest.approx((0.2, 0.2**0.5, 1.0))
    assert error_px(result) < left * mean_error_px(NEAR, TRUTH, 400, 320)


def test_levels_halve_down_to_the_coarsest() -> None:
    assert learn_scales(1280) == [0.25, 0.5]


def test_a_distant_start_is_found_by_searching_the_loss() -> None:
    """An offset of an eighth of the image, too large for steps on psi alone."""
    truth = geometry.translation(6.0, -4.0)
    result = scratch(*two_views(truth), geometry.translation(46.0, 26.0), trusted=False)
    assert error_px(result, truth) < 0.2
