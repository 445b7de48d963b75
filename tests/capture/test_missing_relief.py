"""No structure in one half of the image: a prediction with the error of that half."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import agalign
from agalign.capture import missing_relief as module
from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import BandCandidates, Candidate, RefinedBand
from agalign.capture.missing_relief import is_extrapolated
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.lens_shapes import lens_shapes

from ..builders import decided, fitted_to_windows, joint_result, pair_of, rms, two_views

SIZE = 640, 480
MATRIX = geometry.translation(6.0, -4.0)
LENS_PX = np.array([0.8, 0.0, 0.4, 0.0])
WHOLE, LEFT, RIGHT = slice(None), slice(None, 320), slice(320, None)


def distorted_images() -> tuple[np.ndarray, np.ndarray]:
    """A pair of lenses with a difference of up to 1.2 px."""
    fixed, moving = two_views(MATRIX, *SIZE)
    pixels = geometry.lattice(*SIZE, *SIZE)
    away = (pixels + lens_shapes(pixels, SIZE) @ LENS_PX).reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    return cv2.remap(fixed.pixels, away, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), moving.pixels


def valid_in(columns: slice) -> np.ndarray:
    valid = np.zeros(SIZE[::-1], bool)
    valid[:, columns] = True
    return valid


def pair_in(columns: slice) -> BandPair:
    return pair_of(*(raster_of(image, valid_in(columns), "image") for image in distorted_images()))


def true_positions(points: np.ndarray) -> np.ndarray:
    return geometry.apply(MATRIX, points + lens_shapes(points, SIZE) @ LENS_PX)


def refined(pair: BandPair) -> RefinedBand:
    """The band with a homography fitted to the common part."""
    points = geometry.lattice(*SIZE, 40, 30)
    seen = points[pair.fixed.valid[points[:, 1].astype(int), points[:, 0].astype(int)]]
    matrix = geometry.fit_homography(seen, true_positions(seen))
    joint = joint_result(matrix, covariance=0.0025 * np.eye(8))
    return RefinedBand.of(pair, Seed("structure", matrix, 20.0), joint)


def seed_of(band: RefinedBand) -> Seed:
    return Seed("structure", band.joint.fixed_to_moving, 20.0)


def by_homography(band: RefinedBand) -> Candidate:
    (plane,) = band.candidates("never")
    return plane


def with_relief(band: RefinedBand) -> Alignment:
    return fitted_to_windows(BandCandidates(band.pair, seed_of(band), None, [by_homography(band)]), band)


@pytest.fixture(scope="module")
def left() -> RefinedBand:
    """The band with pixels in its left half."""
    return refined(pair_in(LEFT))


def test_a_half_without_windows_has_the_error_of_unknown_lenses(left: RefinedBand) -> None:
    result = with_relief(left)
    assert (result.status, result.prediction.source) == ("predicted", "windows")
    assert [issue.code for issue in result.issues] == ["inaccurate"]
    assert "the expected error is above 0.5 px in" in result.reason
    assert "windows in the image" in result.reason
    points = geometry.lattice(*SIZE, 17, 13)
    errors = result.map(points) - true_positions(points)
    right = points[:, 0] > 330
    assert rms(errors[~right]) < 0.1 < 0.5 < rms(errors[right])
    assert 0.5 * rms(errors) < result.prediction.std_px < 1.0
    expected = result.error_px(points)
    assert np.median(expected[right]) > 2 * np.median(expected[points[:, 0] < 300])
    assert (np.linalg.norm(errors, axis=1) < 3 * expected).mean() > 0.95


def test_covered_images_georeferenced_files_and_failed_pairs_are_not_extrapolated(left: RefinedBand) -> None:
    everywhere, plane = by_homography(refined(pair_in(WHOLE))), by_homography(left)
    assert everywhere.issues == ()
    assert is_extrapolated(plane)
    mosaic = replace(plane, pair=replace(left.pair, seed_matrices={"geo": np.eye(3)}))
    failed = replace(plane, joint=replace(plane.joint, retrieval=0.1))
    assert not any(map(is_extrapolated, (everywhere, mosaic, failed)))


@pytest.mark.parametrize(
    ("facts", "status"),
    [
        ({"is_lens_known": True}, "aligned"),
        ({}, "predicted"),
        ({"is_lens_known": True, "relief_std_px": 4.0}, "predicted"),
    ],
)
def test_a_rig_of_the_whole_image_without_relief_prevents_extrapolation(
    left: RefinedBand, facts: dict[str, object], status: str
) -> None:
    band = refined(replace(left.pair, seed_std_px={"model": 1.0}, **facts))
    after = decided(band.pair, seed_of(band), [by_homography(band)])
    assert after.status == status
    if "relief_std_px" in facts:
        assert after.prediction.std_px > 1.5
        assert after.error_px([620.0, 240.0]) > 3.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset_px", "shift_px"),
    [((-20.0, 0.0), 20.0), ((0.0, 20.0), 0.0), ((20.0, 0.0), 0.0)],
    ids=["along the layout", "error of the tags", "beyond infinity"],
)
def test_unknown_relief_is_a_share_of_the_range(
    left: RefinedBand, offset_px: tuple[float, float], shift_px: float
) -> None:
    """The nearer the scene, the larger its shift from the mapping at infinity, along the layout of the lenses.

    The relief is unknown where no window is near.
    """
    pair, matrix = left.pair, left.joint.fixed_to_moving
    at_infinity = geometry.compose(geometry.translation(*np.negative(offset_px)), matrix)
    near = replace(pair, layout=(-1.0, 0.0), seed_matrices={**pair.seed_matrices, "rig": at_infinity})
    without, of_near = (with_relief(replace(left, warped=replace(left.warped, pair=one))) for one in (pair, near))
    relief_px = module._RELIEF_SHARE * shift_px
    for point, expected_px in (((630.0, 240.0), relief_px), ((60.0, 240.0), 0.0)):
        squares = [a.error_px(point) ** 2 for a in (of_near, without)]
        assert squares[0] - squares[1] == pytest.approx(expected_px**2, rel=0.1, abs=0.01)
    assert without.prediction.std_px <= of_near.prediction.std_px
    assert of_near.prediction.std_px <= np.hypot(without.prediction.std_px, relief_px)


def test_half_masked_arrays_are_predicted() -> None:
    fixed, moving = distorted_images()
    result = agalign.align(fixed, moving, fixed_valid=valid_in(RIGHT), moving_valid=valid_in(RIGHT))
    assert result.status == "predicted"
    points = geometry.lattice(*SIZE, 17, 13)
    assert rms(result.map(points) - true_positions(points)) < 2 * result.prediction.std_px
