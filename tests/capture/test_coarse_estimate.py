"""Bands with few pixels and little common structure: predicted with a correct standard error, or failed."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from agalign.capture.band_pair import BandPair
from agalign.capture.from_windows import from_windows
from agalign.capture.seeding import find_seed
from agalign.config import SeedSettings
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.image import Raster
from agalign.values.issues import RETRIEVAL, Issue

from ..conftest import textured_image

FIXED_PX, MOVING_PX = (320, 240), (160, 120)
TRUTH = geometry.compose(
    geometry.translation(83.0, 57.0), np.diag([0.43, 0.43, 1.0]), geometry.translation(-159.5, -119.5)
)
"""A field of view a sixth wider than in an overlay of the images."""


def raster(pixels: np.ndarray) -> Raster:
    return Raster((1000 + 100 * pixels).astype(np.float32), np.ones(pixels.shape, bool))


def thermal(scene: np.ndarray, other_share: float) -> np.ndarray:
    """The scene in a thermal camera: inverted, with unrelated content in a share of the image."""
    large = cv2.GaussianBlur(scene, (0, 0), 1.2)
    to_moving = geometry.compose(TRUTH, geometry.translation(-100.0, -100.0))
    seen = cv2.warpPerspective(large, to_moving, MOVING_PX, flags=cv2.INTER_LINEAR)
    mask = cv2.GaussianBlur(np.random.default_rng(5).normal(size=MOVING_PX[::-1]), (0, 0), 12)
    other = cv2.GaussianBlur(textured_image(*MOVING_PX, seed=9), (0, 0), 1.0)
    return np.asarray(np.where(mask > np.quantile(mask, other_share), -seen / seen.std(), other / other.std()))


def tried(fixed: np.ndarray, moving: np.ndarray) -> tuple[BandPair, Alignment]:
    candidates = {"identity": geometry.overlay(FIXED_PX, MOVING_PX)}
    pair = replace(BandPair.of_images("LWIR", raster(fixed), raster(moving), candidates), is_coarse=True)
    seed = find_seed(pair, SeedSettings())
    issue = Issue(RETRIEVAL, 0.0, 0.2)
    failed = Alignment(pair.mapping(seed.fixed_to_moving), pair.fixed.size_px, "failed", (issue,), seed)
    return pair, from_windows(pair, failed)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """100 px wider than the reference on every side."""
    return textured_image(520, 440, seed=3)


@pytest.mark.parametrize("other_share", [0.2, 0.5])
def test_a_band_with_another_field_of_view_is_predicted_with_its_error(scene: np.ndarray, other_share: float) -> None:
    _, result = tried(scene[100:340, 100:420], thermal(scene, other_share))
    assert result.status == "predicted"
    points = geometry.lattice(*FIXED_PX, 9, 7)
    error_px = np.linalg.norm(result.map(points) - geometry.apply(TRUTH, points), axis=1)
    assert np.sqrt((error_px**2).mean()) < result.prediction.std_px < 0.6
    assert result.reason is not None
    assert "predicted from windows in the image" in result.reason


def test_an_unrelated_image_is_not_predicted(scene: np.ndarray) -> None:
    _, result = tried(textured_image(*FIXED_PX, seed=11), thermal(scene, 0.2))
    assert (result.status, result.prediction) == ("failed", None)


def test_a_repetitive_scene_is_not_predicted() -> None:
    tile = np.tile(textured_image(40, 40, seed=4), (11, 13))
    _, result = tried(tile[100:340, 100:420], thermal(tile, 0.2))
    assert (result.status, result.prediction) == ("failed", None)


def test_a_band_of_full_resolution_is_unchanged(scene: np.ndarray) -> None:
    pair, result = tried(scene[100:340, 100:420], thermal(scene, 0.2))
    failed = replace(result, status="failed", prediction=None)
    assert from_windows(replace(pair, is_coarse=False), failed) is failed
    untrusted = replace(failed, seed=replace(failed.seed, trusted=False))
    assert from_windows(pair, untrusted) is untrusted
