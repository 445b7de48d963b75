"""Images without structure in one half: the result is a prediction with the error of that half."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import agalign
from agalign.capture.band_pair import BandPair
from agalign.capture.from_windows import without_extrapolated
from agalign.capture.verification import verified
from agalign.config import Settings
from agalign.flight.rig import Rig
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Seed
from agalign.verify.expected_error import expected_error_px
from agalign.verify.lens_shapes import lens_shapes
from tests.conftest import textured_pair

SIZE = 640, 480
MATRIX = geometry.translation(6.0, -4.0)
LENS_PX = np.array([0.8, 0.0, 0.4, 0.0])
LEFT, RIGHT = (slice(None), slice(None, 320)), (slice(None), slice(320, None))


def distorted_images() -> tuple[np.ndarray, np.ndarray]:
    """A pair of lenses with a difference of up to 1.2 px."""
    fixed, moving = textured_pair(MATRIX, *SIZE)
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1).reshape(-1, 2).astype(np.float64)
    away = (pixels + lens_shapes(pixels, SIZE) @ LENS_PX).reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    return cv2.remap(fixed, away[..., 0], away[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), moving


def valid_in(part: tuple[slice, slice]) -> np.ndarray:
    valid = np.zeros(SIZE[::-1], bool)
    valid[part] = True
    return valid


def pair_in(part: tuple[slice, slice]) -> BandPair:
    fixed, moving = distorted_images()
    images = (raster_of(image, valid_in(part), "image") for image in (fixed, moving))
    return BandPair.of_images("moving", *images, {"identity": np.eye(3)})


def aligned(pair: BandPair) -> Alignment:
    """An alignment with a homography fitted to the common part."""
    points = geometry.lattice(*SIZE, 40, 30)
    seen = points[pair.fixed.valid[points[:, 1].astype(int), points[:, 0].astype(int)]]
    truth = geometry.apply(MATRIX, seen + lens_shapes(seen, SIZE) @ LENS_PX)
    matrix = geometry.fit_homography(seen, truth)
    joint = JointResult(
        matrix, 0.1, 0.9, 0.004, 75, (1.0,), "fast", "homography", 0.01, ((0.05, 0.05),) * 4, 0.0025 * np.eye(8)
    )
    result = verified(pair, Seed("structure", matrix, 20.0), joint, Settings())
    assert result.status == "aligned"
    return result


def errors_px(alignment: Alignment, points: np.ndarray) -> np.ndarray:
    truth = geometry.apply(MATRIX, points + lens_shapes(points, SIZE) @ LENS_PX)
    return np.linalg.norm(alignment.map(points) - truth, axis=1)


def test_half_of_the_image_is_extrapolated_with_the_lens_and_its_error() -> None:
    pair = pair_in(LEFT)
    before = aligned(pair)
    after = without_extrapolated([pair], {"moving": before})["moving"]
    assert after.status == "predicted"
    assert [issue.code for issue in after.issues] == ["extrapolated"]
    assert "top right and bottom right" in str(after.reason)
    assert "windows in the image" in str(after.reason)
    points = geometry.lattice(*SIZE, 17, 13)
    right = points[:, 0] > 330
    error_px = np.sqrt((errors_px(after, points) ** 2).mean())
    assert error_px < 0.5 < np.sqrt((errors_px(before, points[right]) ** 2).mean())
    prediction = after.prediction
    assert prediction.source == "windows"
    assert 0.5 * error_px < prediction.std_px < 1.0
    expected = expected_error_px(after, SIZE, points)
    assert np.median(expected[right]) > 2 * np.median(expected[points[:, 0] < 300])
    assert (errors_px(after, points) < 3 * expected).mean() > 0.95


def test_a_fully_covered_image_is_unchanged() -> None:
    pair = pair_in((slice(None), slice(None)))
    before = aligned(pair)
    assert without_extrapolated([pair], {"moving": before})["moving"] is before


@pytest.mark.parametrize(("extrapolation_px", "status"), [({}, "aligned"), ({"moving": 0.7}, "predicted")])
def test_a_rig_of_the_whole_image_prevents_extrapolation(extrapolation_px: dict[str, float], status: str) -> None:
    pair = replace(pair_in(LEFT), candidate_std_px={"model": 1.0})
    rig = Rig(
        SIZE, {"moving": MATRIX}, {"moving": (1.0, 0.0)}, {"moving": 0.0}, {"moving": 0.1}, (), (), {"moving": 0.1},
        extrapolation_px=extrapolation_px,
    )  # fmt: skip
    before = aligned(pair)
    assert without_extrapolated([pair], {"moving": before}, rig)["moving"].status == status


def test_georeferenced_files_and_failed_pairs_are_unchanged() -> None:
    pair = pair_in(LEFT)
    before = aligned(pair)
    mosaic = replace(pair, candidates={"geo": np.eye(3)})
    assert without_extrapolated([mosaic], {"moving": before})["moving"] is before
    failed = replace(before, status="failed")
    assert without_extrapolated([pair], {"moving": failed})["moving"] is failed


@pytest.mark.slow
def test_half_masked_arrays_are_predicted() -> None:
    fixed, moving = distorted_images()
    result = agalign.align(fixed, moving, fixed_valid=valid_in(RIGHT), moving_valid=valid_in(RIGHT))
    assert result.status == "predicted"
    assert (errors_px(result, geometry.lattice(*SIZE, 17, 13)) ** 2).mean() < (2 * result.prediction.std_px) ** 2
    assert agalign.align(fixed, moving).status == "aligned"
