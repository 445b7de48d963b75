"""Windows that verify an estimate take no part in it, whichever windows drop out at invalid borders.

Held-out windows are recognised by their position: pixels are changed there, and no estimate may move.
"""

import cv2
import numpy as np
import pytest

from agalign.capture.candidate import BandCandidates, RefinedBand
from agalign.capture.reference import Reference
from agalign.fit.held_out import chessboard
from agalign.fit.windows import FixedWindows, Shifts
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.alignment import Alignment, Seed
from agalign.values.geometry import Points
from agalign.values.image import Raster
from agalign.values.issues import RETRIEVAL, Issue
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.residual import Residual

from ..builders import estimation_of, fitted_to_windows, in_full_run, joint_result, pair_of, texture, whole
from ..conftest import textured_image

BLURRED_PX, SHARP_PX = 160, 100
"""Sides of the windows of blurred and of sharp images."""
BORDERS_PX = [0, 10, 14, 17, 40]
"""Invalid columns at the left: up to a tenth of a window, the window is measured."""
SEED = Seed("structure", geometry.identity(), 20.0, trusted=True)


def with_border(image: np.ndarray, border_px: int) -> Raster:
    valid = np.ones(image.shape, bool)
    valid[:, :border_px] = False
    return raster_of(image, valid, "moving")


def moved_inside(image: np.ndarray, centres_px: Points, side_px: int, off_px: float) -> np.ndarray:
    """The image with its content moved inside the windows with these centres (n, 2).

    A margin remains, as the structure at a pixel depends on those around it.
    """
    result, margin_px = image.copy(), side_px // 8
    moved = cv2.warpAffine(image, np.array([[1.0, 0, off_px], [0, 1, 0]]), image.shape[::-1], flags=cv2.INTER_CUBIC)
    for x, y in np.round(centres_px - (side_px - 1) / 2).astype(int):
        inside = np.s_[y + margin_px : y + side_px - margin_px, x + margin_px : x + side_px - margin_px]
        result[inside] = moved[inside]
    return result


@pytest.mark.slow
@pytest.mark.parametrize("border_px", [0, in_full_run(10), 14, in_full_run(17), in_full_run(40)])
def test_a_window_that_verifies_an_alignment_by_windows_takes_no_part_in_what_it_verifies(border_px: int) -> None:
    """The mapping follows half of what moves in every second window; a fit to the others does not follow it at all."""
    fixed = cv2.GaussianBlur(textured_image(6 * BLURRED_PX, 5 * BLURRED_PX), (0, 0), 3)
    moving = -np.roll(fixed, (-3, 5), axis=(0, 1))

    def aligned(image: np.ndarray) -> Alignment:
        pair = pair_of(whole(fixed), with_border(image, border_px))
        result = fitted_to_windows(BandCandidates(pair, SEED, Issue(RETRIEVAL, 0.05, 0.2)))
        assert (result.status, result.joint.recipe) == ("aligned", "windows")
        return result

    before, off_px = aligned(moving), 0.3
    black = chessboard(before.residual).numbers == 0
    after = aligned(moved_inside(moving, before.map(before.residual.centres_px[black]), BLURRED_PX, off_px))
    change_px = (after.residual.shifts_px - before.residual.shifts_px)[:, 0]
    assert np.median(change_px[black]) == pytest.approx(off_px, abs=0.06)
    assert np.median(change_px[~black]) == pytest.approx(-off_px, abs=0.06)


@pytest.mark.parametrize("border_px", BORDERS_PX)
def test_the_map_estimate_without_a_colour_ignores_its_windows(border_px: int) -> None:
    columns, rows = 6, 5
    fixed = textured_image(columns * SHARP_PX, rows * SHARP_PX)
    cells = np.array([(column, row) for column in range(columns) for row in range(rows)])
    of_colour = [(cells[cells.sum(axis=1) % 2 == colour] + 0.5) * SHARP_PX - 0.5 for colour in (0, 1)]
    result = joint_result(np.eye(3), covariance=np.eye(8))

    def by_fold(image: np.ndarray) -> tuple[np.ndarray, ...]:
        pair = pair_of(whole(fixed), with_border(image, border_px))
        estimation = estimation_of(BandCandidates(pair, SEED), RefinedBand.of(pair, SEED, result))
        return estimation._combined()[0].by_fold

    def change_px(one: np.ndarray, other: np.ndarray) -> float:
        return geometry.corner_error_px(one, other, *fixed.shape[::-1])

    before = by_fold(-fixed)
    for colour in (0, 1):
        after = by_fold(moved_inside(-fixed, of_colour[1 - colour], SHARP_PX, 0.6))
        assert change_px(after[1 - colour], before[1 - colour]) < 0.01
        assert change_px(after[colour], before[colour]) > 0.1


@pytest.mark.parametrize("border_px", BORDERS_PX)
def test_windows_that_verify_a_field_share_no_pixels_with_those_of_the_fit(border_px: int) -> None:
    """With borders as well: windows keep their fold, and no robust weight depends on the window that is predicted."""
    image = texture(640, 480)
    moving, estimator = with_border(image.pixels, border_px), Reference(image).displacement_field
    fitted = estimator.windows.residuals(moving)
    rng = np.random.default_rng(0)
    noise_px = rng.normal(0, 0.3, fitted.shifts_px.shape)
    flat, nowhere = PixelMapping(geometry.identity()), DisplacementField(24.0, np.zeros((21, 28, 2)))

    def held_out(shifts_px: np.ndarray) -> Residual:
        return estimator._held_out(moving, flat, nowhere, nowhere, Shifts.of(fitted.with_shifts(shifts_px)))[1]

    before = held_out(noise_px)
    for chosen in rng.permutation(len(before.centres_px))[:5]:
        distance_px = np.abs(fitted.centres_px - before.centres_px[chosen]).max(axis=1)
        shares_pixels = distance_px < (estimator.windows.side + estimator.verification.side) / 2
        after = held_out(noise_px + np.where(shares_pixels[:, None], 5.0, 0.0))
        np.testing.assert_allclose(after.shifts_px[chosen], before.shifts_px[chosen], atol=1e-9)
        assert np.nanmax(np.abs(after.shifts_px - before.shifts_px)) > 0.1


@pytest.mark.parametrize("border_px", BORDERS_PX)
@pytest.mark.parametrize("size_px", [(640, 480), (701, 389), (512, 384)])
def test_windows_of_a_relief_share_no_pixels_with_those_that_verify_it(
    size_px: tuple[int, int], border_px: int
) -> None:
    image = texture(*size_px)
    moving = with_border(image.pixels, border_px)
    reference = Reference(image)

    def covered(windows: FixedWindows) -> np.ndarray:
        result = np.zeros(image.valid.shape, bool)
        for x, y in (windows.residuals(moving).centres_px - (windows.side - 1) / 2).astype(int):
            result[y : y + windows.side, x : x + windows.side] = True
        return result

    fit, held_out = (covered(windows) for windows in (reference.relief_fit_windows, reference.relief_check_windows))
    assert not (fit & held_out).any()
    # Both are all over the image.
    assert min(fit.mean(), held_out.mean()) > 0.3
    for mask in (fit, held_out):
        quarters = (half for rows in np.array_split(mask, 2) for half in np.array_split(rows, 2, axis=1))
        assert all(quarter.mean() > 0.15 for quarter in quarters)
