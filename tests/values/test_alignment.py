"""What an alignment of reduced images says about the files, and how windows and corners scale with it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from agalign.values import geometry
from agalign.values.alignment import Alignment, PairScales, Residual, Seed
from agalign.values.displacement import DisplacementField
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import FixedImagePx, PixelScale

from ..builders import joint_result, residual_of

SCALES = PairScales(PixelScale(0.5, 0.25), PixelScale(0.2, 0.4))
POINTS = np.array([[3.0, 4.0], [100.0, 7.0], [41.5, 60.25]])


H = np.array([[1.02, 0.03, 5.0], [-0.02, 0.97, -3.0], [1e-5, -2e-5, 1.0]])
FIELD = DisplacementField(20.0, np.random.default_rng(0).normal(0, 1, (6, 8, 2)))
JOINT = joint_result(H, last_step_px=0.02, corner_std_xy_px=((0.3, 0.4), (0.1, 0.1), (0.2, 0.1), (0.1, 0.2)))


def test_a_homography_between_images_and_files_maps_the_same_places() -> None:
    between_files = SCALES.between_files(H)
    mapped = geometry.apply(H, SCALES.fixed.positions(POINTS))
    assert_allclose(SCALES.moving.positions(geometry.apply(between_files, POINTS)), mapped, atol=1e-9)
    assert_allclose(SCALES.between_images(between_files), H, atol=1e-9)
    image = PixelMapping(H, local=FIELD)
    files = image.rescaled(SCALES.fixed.inverse, SCALES.moving.inverse)
    assert_allclose(SCALES.moving.positions(files(POINTS)), image(SCALES.fixed.positions(POINTS)), atol=1e-9)


def test_a_rescaled_field_is_exact_however_much_larger_the_image_is() -> None:
    """A lattice whose first node is a pixel's centre has its origin between the pixels of a larger image."""
    scale = PixelScale(5.0, 4.0)
    large = FIELD.rescaled(scale)
    assert_allclose(large(scale.positions(POINTS)), scale.displacements(FIELD(POINTS)), atol=1e-12)
    assert_allclose(large.rescaled(scale.inverse)(POINTS), FIELD(POINTS), atol=1e-12)


def test_a_field_taken_over_to_another_lattice_keeps_its_values_at_the_nodes() -> None:
    finer = FIELD.rescaled(PixelScale(2.0, 2.0)).on_lattice(10.0, (300, 200))
    nodes = np.array([[0.0, 0.0], [120.0, 40.0], [200.0, 100.0]])
    assert_allclose(finer(nodes), 2 * FIELD((nodes + 0.5) / 2 - 0.5), atol=1e-9)


def test_the_standard_errors_of_corners_are_scaled_axis_by_axis() -> None:
    draws = np.random.default_rng(1).normal(0, 1, (8, 8))
    covariance = draws @ draws.T
    in_file = replace(JOINT, corner_covariance_px2=covariance).in_file_px(SCALES)
    up = np.tile([2.0, 4.0], 4)
    assert in_file.corner_covariance_px2 is not None
    # The covariance of scaled numbers: C' = S C S.
    assert_allclose(in_file.corner_covariance_px2, np.diag(up) @ covariance @ np.diag(up))
    assert JOINT.in_file_px(SCALES).corner_covariance_px2 is None
    # The least certain corner counts.
    assert JOINT.corner_std_px == pytest.approx(0.5)
    assert in_file.corner_std_px == pytest.approx(np.hypot(0.3 * 2, 0.4 * 4))
    assert in_file.last_step_px == pytest.approx(0.02 * np.sqrt(8))


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
    facts = seed, JOINT, residual_of(POINTS, (0.1, 0.1)), 1.5, {"ncc": 0.1}, {"ncc": 0.9}
    mapping, candidates = PixelMapping(H, local=FIELD), {"homography": FixedImagePx(0.5), "field": FixedImagePx(0.25)}
    between_images = Alignment(mapping, (150, 100), "aligned", (), *facts, candidates)
    between_files = between_images.in_file_px(SCALES, (300, 400))
    mapped = between_images.map(SCALES.fixed.positions(POINTS))
    assert_allclose(SCALES.moving.positions(between_files.map(POINTS)), mapped, atol=1e-9)
    assert_allclose(between_files.fixed_to_moving, SCALES.between_files(H))
    assert_allclose(between_files.seed.fixed_to_moving, SCALES.between_files(seed.fixed_to_moving))
    assert between_files.candidates == pytest.approx({"homography": 0.5 * np.sqrt(8), "field": 0.25 * np.sqrt(8)})
    assert between_files.size_px == (300, 400)
    kept = ("space", "geometry", "status", "issues", "seconds", "before", "after", "prediction")
    assert [getattr(between_files, k) for k in kept] == [getattr(between_images, k) for k in kept]
    assert PairScales() == PairScales(PixelScale(1.0, 1.0), PixelScale(1.0, 1.0))


def test_of_two_residuals_the_better_has_smaller_shifts_in_more_windows() -> None:
    def residual(shift_px: float, measured: int) -> Residual:
        shifts = np.where(np.arange(10)[:, None] < measured, (shift_px, 0.0), np.nan)
        return residual_of(np.zeros((10, 2)), shifts)

    assert residual(0.5, 10).is_better_than(residual(0.6, 10))
    assert residual(0.5, 10).is_better_than(residual(0.4, 5))
    assert not residual(0.5, 5).is_better_than(residual(0.4, 5))
    assert not residual(0.5, 0).is_better_than(residual(3.0, 1))
