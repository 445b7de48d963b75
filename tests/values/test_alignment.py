"""What an alignment of reduced images says about the files, and how windows and corners scale with it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.geometry import PairScales
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.pixel_units import PixelScale

from ..builders import joint_result, residual_of

SCALES = PairScales(PixelScale(0.5, 0.25), PixelScale(0.2, 0.4))
POINTS = np.array([[3.0, 4.0], [100.0, 7.0], [41.5, 60.25]])


H = np.array([[1.02, 0.03, 5.0], [-0.02, 0.97, -3.0], [1e-5, -2e-5, 1.0]])
JOINT = joint_result(H, last_step_px=0.02, corner_std_xy_px=((0.3, 0.4), (0.1, 0.1), (0.2, 0.1), (0.1, 0.2)))


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


def test_an_alignment_between_images_is_the_same_between_files() -> None:
    seed = Seed("rig", geometry.translation(5, -3), 30.0)
    facts = seed, JOINT, residual_of(POINTS, (0.1, 0.1)), 1.5, {"ncc": 0.1}, {"ncc": 0.9}
    field = DisplacementField.sampled(lambda xy: np.sin(xy[:, ::-1] / 60), 10.0, (150, 100))
    mapping, candidates = PixelMapping(H, field=field), {"homography": 0.5, "field": 0.25}
    between_images = Alignment(mapping, (150, 100), (), *facts, candidates)
    between_files = between_images.in_file_px(SCALES, (300, 400))
    mapped = between_images.map(SCALES.fixed.positions(POINTS))
    assert between_files.mapping.field is not None
    assert between_files.mapping.field.scale == (1, 1)
    assert_allclose(SCALES.moving.positions(between_files.map(POINTS)), mapped, atol=0.01)
    assert_allclose(between_files.residual.centres_px, SCALES.fixed.inverse.positions(POINTS))
    assert_allclose(between_files.residual.shifts_px, [[0.2, 0.4]] * 3)
    assert_allclose(between_files.fixed_to_moving, SCALES.between_files(H))
    assert_allclose(between_files.seed.fixed_to_moving, SCALES.between_files(seed.fixed_to_moving))
    assert between_files.held_out_p95_px == pytest.approx({"homography": 0.5 * np.sqrt(8), "field": 0.25 * np.sqrt(8)})
    assert between_files.size_px == (300, 400)
    kept = ("space", "geometry", "status", "issues", "seconds", "before", "after", "prediction")
    assert [getattr(between_files, k) for k in kept] == [getattr(between_images, k) for k in kept]
    assert PairScales() == PairScales(PixelScale(1.0, 1.0), PixelScale(1.0, 1.0))


def test_the_error_is_infinite_where_no_position_is_known() -> None:
    known = MappingError((150, 100), covariance_px2=0.01 * np.eye(8), residual=residual_of(POINTS, (0.1, 0.1)))
    seed = Seed("rig", geometry.translation(5, -3), 30.0)
    alignment = Alignment(PixelMapping(H), (150, 100), (), seed, error=known)
    errors_px = alignment.error_px([[[np.nan, np.nan], [np.inf, 3.0]], [[3.0, 4.0], [100.0, 7.0]]])
    assert np.isfinite(errors_px).tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize(
    ("error_px", "noise_px", "sigma", "std_px"),
    [
        (1.0, 0.0, 40.0, 1.0),  # misalignment
        (0.8, 0.6, 48**0.5 / 0.6**0.5, 0.8),  # low peaks explain a part
        (0.0, 0.6, 48**0.5 / 0.6**0.5, 0.3),  # or all, but the noise is only known to a factor of two
    ],
)
@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_windows_show_the_error_beyond_the_noise_of_their_peaks(
    error_px: float, noise_px: float, sigma: float, std_px: float, wrong: float
) -> None:
    """Whether or not some of them are wrong peaks."""
    rng = np.random.default_rng(0)
    shifts_px = rng.normal(0, np.hypot(error_px, noise_px) / 2**0.5, (4000, 2))
    shifts_px[: int(4000 * wrong)] = rng.uniform(-20, 20, (int(4000 * wrong), 2))
    residual = residual_of(geometry.lattice(640, 480, 80, 50), shifts_px, sigma)
    assert 0.9 * std_px < residual.std_px < (2.0 if wrong else 1.1) * std_px
    assert residual.where(np.zeros(4000, bool)).std_px == np.inf
