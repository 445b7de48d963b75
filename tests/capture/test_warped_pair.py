"""A pair under a mapping: windows that are converted, compared, and measured again."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.capture.band_pair import BandPair
from agalign.capture.warped_pair import WarpedPair
from agalign.pixels.structure import Field
from agalign.values import geometry
from agalign.values.image import Raster
from agalign.values.residual import Residual

from ..builders import pair_of, residual_of, two_views

TRUTH = geometry.translation(6, -4)


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*two_views(TRUTH))


def test_a_converted_residual_equals_a_new_measurement(pair: BandPair) -> None:
    warped_pair = WarpedPair.of(pair, pair.mapping(geometry.translation(5.95, -3.95)))
    mapping = pair.mapping(np.array([[1.0001, 0, 6.0], [0, 0.9999, -4.0], [0, 0, 1.0]]))
    near, again = warped_pair.with_mapping(mapping), WarpedPair.of(pair, mapping)
    assert near.warped is warped_pair.warped
    np.testing.assert_allclose(near.residual.shifts_px, again.residual.shifts_px, atol=0.04)
    assert near.residual.median_px == pytest.approx(again.residual.median_px, abs=0.04)
    far = pair.mapping(geometry.translation(9, -4))
    assert warped_pair.with_mapping(far).warped is not warped_pair.warped


def test_of_two_mappings_the_better_has_smaller_shifts_in_more_of_the_same_windows(pair: BandPair) -> None:
    given, large = WarpedPair.of(pair, pair.mapping(TRUTH)), pair.reference.large_windows

    def pair_with(shift_px: float, measured: int) -> WarpedPair:
        shifts = np.where(np.arange(10)[:, None] < measured, (shift_px, 0.0), np.nan)
        return replace(given, residual=residual_of(np.zeros((10, 2)), shifts))

    assert pair_with(0.5, 10).is_better_than(pair_with(0.6, 10))
    assert pair_with(0.5, 10).is_better_than(pair_with(0.4, 5))
    assert not pair_with(0.5, 5).is_better_than(pair_with(0.4, 5))
    assert not pair_with(0.5, 0).is_better_than(pair_with(3.0, 1))
    # Residuals of two grids are not compared: the other mapping is measured again, so its 9 px do not count.
    assert not pair_with(0.5, 10).is_better_than(replace(pair_with(9.0, 10), windows=large))


def test_smaller_windows_are_measured_where_valid_areas_are_small() -> None:
    fixed, moving = two_views(np.eye(3), 640, 480)
    scattered = np.ones((480, 640), bool)
    scattered[np.arange(480) % 60 < 12] = False
    scattered[:, np.arange(640) % 60 < 12] = False
    usual, pair = pair_of(fixed, moving), pair_of(Raster(fixed.pixels, scattered), moving)
    residual = WarpedPair.of(pair, pair.mapping(np.eye(3))).residual
    assert residual.coverage > 0.9
    assert residual.median_px < 0.1
    usual_windows = WarpedPair.of(usual, usual.mapping(np.eye(3))).residual
    assert len(usual_windows.centres_px) == len(usual.reference.windows.origins)


def test_smaller_windows_are_used_where_larger_ones_have_no_peak(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter without a measured shift is not observed, whatever its texture."""
    pair = pair_of(*two_views(np.eye(3), 640, 480))
    correlated = pair.windows.correlated

    def without_a_quarter(moving: Raster) -> tuple[Residual, Field]:
        residual, cross = correlated(moving)
        is_lost = (residual.centres_px < (320, 240)).all(axis=1)
        return residual.with_shifts(np.where(is_lost[:, None], np.nan, residual.shifts_px)), cross

    assert WarpedPair.of(pair, pair.mapping(np.eye(3))).windows is pair.windows
    monkeypatch.setattr(pair.windows, "correlated", without_a_quarter)
    assert WarpedPair.of(pair, pair.mapping(np.eye(3))).windows is pair.reference.small_windows


def test_the_common_area_of_georeferenced_files_has_their_pixels_without_texture() -> None:
    fixed, moving = two_views(np.eye(3), 640, 480)
    for image in (fixed, moving):
        image.pixels[:, 320:] = image.pixels.mean()
    valid = np.arange(640) >= 64
    pair = pair_of(replace(fixed, valid=fixed.valid & valid), moving, {"geo": np.eye(3)})
    common_px = WarpedPair.of(pair, pair.mapping(np.eye(3))).common_px
    assert 64 <= common_px[:, 0].min() < 100
    assert common_px[:, 0].max() > 600
