"""What an alignment of reduced images says about the files, and how windows and corners scale with it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, PairScales, Residual, Seed
from agalign.values.displacement import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedFilePx, FixedImagePx, PixelScale

SCALES = PairScales(PixelScale(0.5, 0.25), PixelScale(0.2, 0.4))
POINTS = np.array([[3.0, 4.0], [100.0, 7.0], [41.5, 60.25]])


def homography() -> Matrix:
    return np.array([[1.02, 0.03, 5.0], [-0.02, 0.97, -3.0], [1e-5, -2e-5, 1.0]])


def joint(covariance: np.ndarray | None) -> JointResult[FixedImagePx]:
    std = ((0.3, 0.4), (0.1, 0.1), (0.2, 0.1), (0.1, 0.2))
    return JointResult(homography(), 0.1, 0.9, 0.01, 5, (1.0,), "fast", "homography", 0.02, std, covariance)


def field() -> DisplacementField:
    values = np.random.default_rng(0).normal(0, 1, (6, 8, 2))
    return DisplacementField(20.0, values)


def test_a_homography_between_images_and_files_maps_the_same_places() -> None:
    between_files = SCALES.between_files(homography())
    mapped = geometry.apply(homography(), SCALES.fixed.positions(POINTS))
    assert_allclose(SCALES.moving.positions(geometry.apply(between_files, POINTS)), mapped, atol=1e-9)
    assert_allclose(SCALES.between_images(between_files), homography(), atol=1e-9)


def test_a_rescaled_field_is_exact_however_much_larger_the_image_is() -> None:
    """A lattice whose first node is a pixel's centre has its origin between the pixels of a larger image."""
    small = field()
    scale = PixelScale(5.0, 4.0)
    large = small.rescaled(scale)
    assert_allclose(large(scale.positions(POINTS)), scale.displacements(small(POINTS)), atol=1e-12)
    assert_allclose(large.rescaled(scale.inverse)(POINTS), small(POINTS), atol=1e-12)


def test_a_field_taken_over_to_another_lattice_keeps_its_values_at_the_nodes() -> None:
    small = field()
    finer = small.rescaled(PixelScale(2.0, 2.0)).on_lattice(10.0, (300, 200))
    nodes = np.array([[0.0, 0.0], [120.0, 40.0], [200.0, 100.0]])
    assert_allclose(finer(nodes), 2 * small((nodes + 0.5) / 2 - 0.5), atol=1e-9)


def test_a_mapping_with_a_field_between_files_is_the_one_between_images() -> None:
    image = PixelMapping(homography(), local=field())
    files = image.rescaled(SCALES.fixed.inverse, SCALES.moving.inverse)
    assert_allclose(SCALES.moving.positions(files(POINTS)), image(SCALES.fixed.positions(POINTS)), atol=1e-9)


def test_the_covariance_of_corners_is_scaled_axis_by_axis() -> None:
    rng = np.random.default_rng(1)
    draws = rng.normal(0, 1, (8, 8))
    covariance = draws @ draws.T
    in_file = joint(covariance).in_file_px(SCALES)
    up = np.tile([2.0, 4.0], 4)
    assert in_file.corner_covariance_px2 is not None
    # The covariance of scaled numbers: C' = S C S.
    assert_allclose(in_file.corner_covariance_px2, np.diag(up) @ covariance @ np.diag(up))
    assert joint(None).in_file_px(SCALES).corner_covariance_px2 is None


def test_the_least_certain_corner_counts_on_either_grid() -> None:
    assert joint(None).corner_std_px == pytest.approx(0.5)
    assert joint(None).in_file_px(SCALES).corner_std_px == pytest.approx(np.hypot(0.3 * 2, 0.4 * 4))
    assert joint(None).in_file_px(SCALES).last_step_px == pytest.approx(0.02 * np.sqrt(8))


def test_windows_of_an_image_are_windows_of_its_file() -> None:
    centres, shifts = np.array([[9.5, 19.5], [30.0, 5.0], [1.0, 1.0]]), np.array([[0.3, 0.4], [1.0, 0], [np.nan] * 2])
    residual = Residual[FixedImagePx].of(centres, shifts, np.array([9.0, 8.0, 2.0]))
    in_file = residual.in_file_px(SCALES)
    assert_allclose(in_file.centres_px[0], [19.5, 79.5])
    assert_allclose(in_file.shifts_px[:2], [[0.6, 1.6], [2.0, 0.0]])
    assert in_file.median_px == pytest.approx((np.hypot(0.6, 1.6) + 2.0) / 2)
    assert in_file.coverage == residual.coverage == pytest.approx(2 / 3)
    assert_allclose(in_file.peaks_sigma, residual.peaks_sigma)


def test_an_alignment_between_images_is_the_same_between_files() -> None:
    seed = Seed("rig", geometry.translation(5, -3), 30.0)
    residual = Residual[FixedImagePx].of(POINTS, np.full((3, 2), 0.1), np.full(3, 9.0))
    between_images: Alignment[FixedImagePx] = Alignment(
        PixelMapping(homography(), local=field()),
        (150, 100),
        "aligned",
        (),
        seed,
        joint(None),
        residual,
        1.5,
        {"ncc": 0.1},
        {"ncc": 0.9},
        {"homography": FixedImagePx(0.5), "field": FixedImagePx(0.25)},
    )
    between_files: Alignment[FixedFilePx] = between_images.in_file_px(SCALES, (300, 400))
    mapped = between_images.map(SCALES.fixed.positions(POINTS))
    assert_allclose(SCALES.moving.positions(between_files.map(POINTS)), mapped, atol=1e-9)
    assert_allclose(between_files.fixed_to_moving, SCALES.between_files(homography()))
    assert_allclose(between_files.seed.fixed_to_moving, SCALES.between_files(seed.fixed_to_moving))
    assert between_files.candidates == pytest.approx({"homography": 0.5 * np.sqrt(8), "field": 0.25 * np.sqrt(8)})
    assert between_files.size_px == (300, 400)
    kept = ("space", "geometry", "status", "issues", "seconds", "before", "after", "prediction")
    assert [getattr(between_files, k) for k in kept] == [getattr(between_images, k) for k in kept]
    assert PairScales() == PairScales(PixelScale(1.0, 1.0), PixelScale(1.0, 1.0))


def test_of_two_residuals_the_better_has_smaller_shifts_in_more_windows() -> None:
    def residual(shift_px: float, measured: int) -> Residual[FixedImagePx]:
        shifts = np.full((10, 2), np.nan)
        shifts[:measured] = shift_px, 0.0
        return Residual[FixedImagePx].of(np.zeros((10, 2)), shifts, np.ones(10))

    assert residual(0.5, 10).is_better_than(residual(0.6, 10))
    assert residual(0.5, 10).is_better_than(residual(0.4, 5))
    assert not residual(0.5, 5).is_better_than(residual(0.4, 5))
    assert not residual(0.5, 0).is_better_than(residual(3.0, 1))
