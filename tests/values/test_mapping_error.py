"""The expected error of a mapping: near windows and far from them, of predictions, under a relief, on a grid."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.fit.windows import RELIEF_CHECK_WINDOW_PX, FixedWindows
from agalign.pixels.structure import structure_field
from agalign.values import geometry
from agalign.values.geometry import PairScales
from agalign.values.image import Tile
from agalign.values.least_squares import shift_scale_px
from agalign.values.lens_shapes import lens_shapes, lens_std_px, shift_variance_px2
from agalign.values.mapping_error import ErrorOnGrid, MappingError
from agalign.values.moved_area import MovedArea
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale
from agalign.values.residual import Residual, noise_px

from ..builders import grid_px, residual_of, texture

SIZE = 640, 480
PIXELS = geometry.lattice(*SIZE, *SIZE)
SAME, HALF = PixelScale(1.0, 1.0), PixelScale(0.5, 0.5)


def error_of(corner_std_px: list[float], windows: Residual | None) -> MappingError:
    return MappingError(SIZE, np.diag(np.repeat(corner_std_px, 2) ** 2), windows)


def expected_px(error: MappingError, *point: float) -> float:
    return float(error.error_px(np.array([point]))[0])


def columns(count: int) -> Residual:
    """Columns of windows with a shift of 0.3 px."""
    return residual_of(grid_px(50 + 100 * np.arange(count), 50 + 100 * np.arange(4)), (0.3, 0.0))


def test_the_expected_error_is_the_covariance_at_corners_and_the_residual_near_windows() -> None:
    known = error_of([0.1, 0.5, 0.5, 0.1], None)
    for x, std_px in ((0.0, 0.1), (639.0, 0.5)):
        assert expected_px(known, x, 0.0) == pytest.approx(np.sqrt(2) * std_px)
    half, everywhere = (error_of([0.01] * 4, columns(count)) for count in (3, 7))
    for covered in (half, everywhere):
        assert 0.25 < expected_px(covered, 60.0, 240.0) < 0.4
    assert 0.25 < expected_px(everywhere, 620.0, 240.0) < 0.4


@pytest.mark.parametrize(
    ("facts", "added_px"), [({"field_std_px": 2.0}, 2.0), ({"relief_std_px": 3.0}, 3.0), ({"rig_std_px": 0.4}, None)]
)
def test_the_error_far_from_windows_is_that_of_unknown_lenses_of_the_field_and_of_the_relief(
    facts: dict[str, float], added_px: float | None
) -> None:
    half = error_of([0.01] * 4, columns(2))
    prior_px = lens_std_px(SIZE, calibrated=False)
    far, near = ((620.0, 240.0), (60.0, 240.0))
    assert expected_px(replace(half, lens_std_px=3 * prior_px), *far) > expected_px(half, *far) + 0.3
    with_facts = replace(half, **facts)
    for point, expected in ((far, added_px or 0.4), (near, 0.0 if added_px else 0.4)):
        added_px2 = expected_px(with_facts, *point) ** 2 - expected_px(half, *point) ** 2
        assert added_px2 == pytest.approx(expected**2, abs=1e-9)


def test_what_moved_raises_the_error_there_and_no_standard_error() -> None:
    still = error_of([0.1] * 4, None)
    small, large = (
        MovedArea(np.array([[100.0, 80], [n, 80], [n, 180], [100, 180]]), (m, 0.0))
        for n, m in ((200.0, 9.0), (140.0, -20.0))
    )
    moved = replace(still, moved=(large, small))  # where areas overlap, the longest shift counts
    for point, shift_px in (((150.0, 100.0), 9.0), ((120.0, 100.0), 20.0), ((99.0, 100.0), 0.0)):
        added_px2 = expected_px(moved, *point) ** 2 - expected_px(still, *point) ** 2
        assert added_px2 == pytest.approx(shift_px**2)
    assert moved.rms_px(PIXELS) == still.rms_px(PIXELS)
    on_grid = ErrorOnGrid.of(moved, SIZE).on_tile(Tile(90, 70, 120, 50))
    points_px = geometry.lattice(120, 50, 120, 50) + np.array([90, 70])
    np.testing.assert_allclose(on_grid.ravel(), moved.error_px(points_px), atol=0.01)
    at_double = moved.in_file_px(PairScales(HALF, SAME), (1280, 960), None)
    assert expected_px(at_double, 300.5, 200.5) == pytest.approx(2 * expected_px(moved, 150.0, 100.0), rel=1e-3)


def test_a_single_wrong_peak_is_no_error_and_noise_is_subtracted() -> None:
    centres_px = grid_px(50 + 100 * np.arange(7), 50 + 100 * np.arange(4))
    shifts_px = np.zeros_like(centres_px)
    shifts_px[10] = 20.0, 0.0
    assert expected_px(error_of([0.01] * 4, residual_of(centres_px, shifts_px)), *centres_px[10]) < 0.1
    alone_px = np.vstack([columns(4).centres_px, [[540.0, 250.0]]])
    of_alone = np.zeros_like(alone_px)
    of_alone[-1] = 12.0, 0.0
    assert expected_px(error_of([0.01] * 4, residual_of(alone_px, of_alone)), 540.0, 250.0) < 0.1
    of_alone[-5:] = 12.0, 0.0  # a column of such shifts is one
    assert expected_px(error_of([0.01] * 4, residual_of(alone_px, of_alone)), *alone_px[-3]) > 1.0
    noise = np.random.default_rng(0).normal(0, 0.98 / np.sqrt(2), centres_px.shape)
    known = error_of([0.01] * 4, residual_of(centres_px, noise, sigma=7.0))
    assert np.median(known.error_px(centres_px)) < 0.6


def test_the_other_windows_do_not_lower_the_error_where_most_of_the_near_ones_agree() -> None:
    centres_px = grid_px(50 + 100 * np.arange(7), 50 + 100 * np.arange(4))
    shifts_px = np.zeros_like(centres_px)
    shifts_px[[12, 13, 19, 20]] = 3.0, 0.0  # a square: windows in columns 5 and 6 of rows 1 and 2
    assert expected_px(error_of([0.01] * 4, residual_of(centres_px, shifts_px)), 560.0, 160.0) > 2.0


def test_a_prediction_by_others_has_its_standard_error_everywhere() -> None:
    predicted = MappingError(SIZE, rig_std_px=0.4)
    np.testing.assert_allclose(predicted.error_px(PIXELS[::997]), 0.4)
    assert predicted.rms_px(PIXELS[::997]) == pytest.approx(0.4)
    assert predicted.rms_px(np.empty((0, 2))) == np.inf
    np.testing.assert_allclose(MappingError(SIZE).error_px(PIXELS[:3]), 0.0)  # bands of one lens


@pytest.mark.parametrize("measured", [0.0, 0.1])
def test_few_windows_that_contradict_the_mapping_are_its_error(measured: float) -> None:
    """A thermal band that few windows predict has their error; without any, that of the covariance is left."""
    centres_px = grid_px(np.arange(56, 640, 56), np.arange(56, 480, 56))
    is_measured = np.arange(len(centres_px))[:, None] < measured * len(centres_px)
    error = error_of([0.01] * 4, residual_of(centres_px, np.where(is_measured, (15.0, 0.0), np.nan)))
    expected = 16.5 if measured else 0.01
    assert expected_px(error, *centres_px[0]) == pytest.approx(expected, rel=0.3)


def with_steps(scale: PixelScale = SAME) -> Parallax:
    """A relief whose standard error changes from pixel to pixel, on a raster of this scale."""
    width, height = (round(n * s) for n, s in zip(SIZE, scale, strict=True))
    std_px = np.random.default_rng(0).uniform(0, 0.5, (height, width)).astype(np.float32)
    ones = np.ones((height, width), np.float32)
    return Parallax(Relief(ones, ones, scale, 1 / scale.mean, std_px), (0.6, 0.8))


@pytest.mark.parametrize("scale", [SAME, HALF])
def test_the_error_of_the_relief_counts_where_it_is_larger_than_that_of_the_windows(scale: PixelScale) -> None:
    parallax = with_steps(scale)
    error = replace(error_of([0.05] * 4, columns(7)), parallax=parallax)
    points = np.random.default_rng(1).uniform(0, SIZE, (500, 2))
    modelled_px2, unmodelled_px2 = error.parts_px2(points)
    z_px2 = parallax.variance_px2(points)
    assert 0.1 < (z_px2 > unmodelled_px2).mean() < 0.9
    expected = np.sqrt(modelled_px2 + np.maximum(z_px2, unmodelled_px2))
    np.testing.assert_allclose(error.error_px(points), expected)


def test_the_fields_between_windows_that_verify_a_relief_are_near() -> None:
    """They are in the white fields of a chessboard; the windows of the fit are in the black ones."""
    image = texture(*SIZE)
    white = FixedWindows.on_chessboard(image.valid, structure_field(image), RELIEF_CHECK_WINDOW_PX, white=True)
    windows = residual_of(white.centres_px, (0.0, 0.0))
    error = error_of([0.1] * 4, windows)
    black_px = np.array([[320.0, 320.0], [320.0, 64.0]])  # centres of black fields
    distances_px = np.linalg.norm(white.centres_px[None] - black_px[:, None], axis=2).min(axis=1)
    assert distances_px.min() > 70
    assert (error._far(black_px) > 0.3).all()
    assert (replace(error, parallax=with_steps())._far(black_px) < 0.1).all()


@pytest.mark.parametrize("relief_std_px", [None, 0.3])
def test_the_error_of_a_predicted_baseline_grows_with_the_parallax(relief_std_px: float | None) -> None:
    """An object near the camera is off by more than the plane, whose parallax is 0."""
    z_px = np.zeros(SIZE[::-1], np.float32)
    z_px[100:200, 300:400] = 20.0
    std_px = None if relief_std_px is None else np.full_like(z_px, relief_std_px)
    parallax = Parallax(Relief(z_px, np.ones_like(z_px), std_px=std_px), (0.6, 0.8))
    error = MappingError(SIZE, rig_std_px=0.1, parallax=parallax, baseline_std=0.02)
    of_relief = relief_std_px or 0.0
    expected = [np.hypot(0.1, of_relief), np.sqrt(0.1**2 + of_relief**2 + (0.02 * 20) ** 2)]
    np.testing.assert_allclose(error.error_px(np.array([[50.0, 50.0], [350.0, 150.0]])), expected, rtol=1e-6)
    on_grid = ErrorOnGrid.of(error, SIZE).on_tile(Tile(0, 0, *SIZE))
    np.testing.assert_allclose([on_grid[50, 50], on_grid[150, 350]], expected, rtol=1e-5)


@pytest.mark.parametrize("parallax", [None, with_steps(), with_steps(HALF)])
def test_the_error_on_a_grid_is_that_of_its_pixels(parallax: Parallax | None) -> None:
    """This also holds on a tile, and on a grid that differs from the reference's, with axes bent by a lens."""
    error = replace(error_of([0.1, 0.5, 0.3, 0.1], columns(4)), parallax=parallax)
    tile = Tile(100, 60, 300, 200)
    at = (np.stack(np.meshgrid(np.arange(100, 400), np.arange(60, 260)), -1)).reshape(-1, 2).astype(float)
    complete = ErrorOnGrid.of(error, SIZE).on_tile(Tile(0, 0, *SIZE))
    ratio = complete.ravel() / error.error_px(PIXELS)
    # Between the nodes the median of windows has steps.
    assert np.percentile(np.abs(ratio - 1), 99) < 0.02
    assert np.abs(ratio - 1).max() < 0.1
    assert np.sqrt(np.square(complete).mean()) == pytest.approx(error.rms_px(PIXELS), rel=0.003)
    np.testing.assert_allclose(ErrorOnGrid.of(error, SIZE).on_tile(tile), complete[60:260, 100:400], rtol=1e-6)

    def to_reference(points_px: np.ndarray) -> np.ndarray:
        return 0.5 * points_px + (20.0, 10.0)

    for is_along_axes in (True, False):
        on_grid = ErrorOnGrid.of(error, SIZE, to_reference, is_along_axes=is_along_axes)
        np.testing.assert_allclose(on_grid.on_tile(tile).ravel(), error.error_px(to_reference(at)), rtol=0.02)


@pytest.mark.parametrize("size_px", [(40_000, 48), (48, 40_000)])
def test_the_error_on_a_grid_wider_than_opencv_resamples(size_px: tuple[int, int]) -> None:
    on_grid = ErrorOnGrid.of(error_of([0.1, 0.5, 0.5, 0.1], None), size_px)
    width, height = size_px
    whole, end = on_grid.on_tile(Tile(0, 0, *size_px)), Tile(width - 48, height - 48, 48, 48)
    np.testing.assert_array_equal(whole[-48:, -48:], on_grid.on_tile(end))


@pytest.mark.parametrize("sigma", [1000.0, 10.0])
def test_the_error_between_images_is_that_between_files(sigma: float) -> None:
    """In px of the file, which are smaller; the noise of peaks too."""
    scales, peaks_sigma = PairScales(HALF, HALF), np.full(16, sigma)
    lens_px, windows = lens_std_px(SIZE, calibrated=False), replace(columns(4), peaks_sigma=peaks_sigma)
    covariance_px2 = np.diag(np.linspace(0.01, 0.1, 8))
    between_images = MappingError(SIZE, covariance_px2, windows, 0.2, lens_px, 0.3, 0.4, with_steps())
    parallax = with_steps().rescaled(PixelScale(2.0, 2.0))
    between_files = between_images.in_file_px(scales, (1280, 960), parallax)
    points = np.random.default_rng(2).uniform(1, (638, 478), (200, 2))
    expected = 2 * between_images.error_px(points)
    np.testing.assert_allclose(between_files.error_px(2 * points + 0.5), expected, rtol=0.01)


def test_the_error_of_an_accurate_mapping_with_unknown_lenses_is_the_same_between_files() -> None:
    """The least error of a shift, which limits what the windows say about the lenses, is in px of the images."""
    windows = residual_of(columns(4).centres_px, (0.01, 0.0))
    error = MappingError(SIZE, np.zeros((8, 8)), windows, lens_std_px=lens_std_px(SIZE, calibrated=False))
    points = np.random.default_rng(2).uniform(1, (638, 478), (200, 2))
    between_files = error.in_file_px(PairScales(HALF, HALF), (1280, 960), None)
    np.testing.assert_allclose(between_files.error_px(2 * points + 0.5), 2 * error.error_px(points), rtol=0.02)


def test_windows_with_much_noise_say_little_of_the_error() -> None:
    """Their noise is known only to a factor, here to 1.4. They overlap, as under a relief."""
    rng = np.random.default_rng(0)
    centres_px = geometry.lattice(449, 289, 15, 10)
    peaks_sigma = np.where(np.arange(150) % 2 == 0, 30.0, 7.5)
    noise = 1.4 * noise_px(peaks_sigma)
    shifts_px = rng.normal(size=(150, 2)) * np.sqrt((0.1**2 + noise**2) / 2)[:, None]
    residual = replace(residual_of(centres_px, shifts_px), peaks_sigma=peaks_sigma)
    assert 0.08 < residual.where(peaks_sigma > 10).std_px <= residual.std_px < 0.2
    error = MappingError((449, 289), np.zeros((8, 8)), residual).error_px(centres_px)
    assert np.sqrt(np.square(error).mean()) < 0.25


def test_windows_of_several_captures_have_the_weights_of_one() -> None:
    """Their centres are the same, and the tolerated noise is relative to their spacing."""
    rng = np.random.default_rng(1)
    centres_px = geometry.lattice(1680, 1120, 15, 10)
    one = replace(residual_of(centres_px, rng.normal(size=(150, 2))), peaks_sigma=rng.uniform(7, 30, 150))
    three = Residual.joined([one] * 3)
    assert three.spacing_px == one.spacing_px > 100
    assert three.std_px == pytest.approx(one.std_px)


def test_lens_shapes_have_the_variance_of_shifts_whether_by_their_rms_or_by_their_robust_scale() -> None:
    """Of normally distributed shifts, both are the standard deviation of a coordinate."""
    shifts_px = np.random.default_rng(0).normal(0.0, 0.3, (400, 2))
    residual = residual_of(geometry.lattice(640, 480, 20, 20), shifts_px, sigma=1000.0)
    by_scale_px2 = shift_variance_px2(shift_scale_px(residual.lengths_px), with_shapes=True)
    covariance = 1e-6 * np.eye(8)
    error = MappingError((640, 480), covariance, residual, lens_std_px=np.full(4, 100.0))
    scaled = replace(error, residual=residual.with_shifts(2 * shifts_px))
    ratios = np.diag(scaled._with_lenses)[8:] / np.diag(error._with_lenses)[8:]
    np.testing.assert_allclose(ratios, 4.0, rtol=0.01)
    design = lens_shapes(residual.centres_px, error.size_px).reshape(-1, 4)
    corners = geometry.over_corners(residual.centres_px, *error.size_px).reshape(-1, 8)
    free = design - corners @ np.linalg.lstsq(corners, design, rcond=None)[0]
    expected_px2 = by_scale_px2 * np.diag(np.linalg.inv(free.T @ free))
    np.testing.assert_allclose(np.diag(error._with_lenses)[8:], expected_px2, rtol=0.1)
