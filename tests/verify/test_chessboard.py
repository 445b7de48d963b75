"""Windows of verification share no pixels with windows of the fit."""

import numpy as np
import pytest

from agalign.capture.reference import Reference
from agalign.pixels.structure import structure_field
from agalign.values.image import Raster
from agalign.verify.residuals import FixedWindows

from ..conftest import textured_image


def covered(windows: FixedWindows, size_px: tuple[int, int]) -> np.ndarray:
    result = np.zeros(size_px[::-1], bool)
    for x, y in windows.origins:
        result[y : y + windows.side, x : x + windows.side] = True
    return result


@pytest.mark.parametrize("size_px", [(640, 480), (701, 389), (512, 384)])
def test_the_windows_of_a_fit_and_of_its_verification_share_no_pixel(size_px: tuple[int, int]) -> None:
    reference = Reference(Raster(textured_image(*size_px), np.ones(size_px[::-1], bool)))
    fit, held_out = (covered(w, size_px) for w in (reference.fit_windows, reference.held_out_windows))
    assert not (fit & held_out).any()
    # Both are all over the image.
    for mask in (fit, held_out):
        assert mask.mean() > 0.3
        height, width = mask.shape
        for rows in (mask[: height // 2], mask[height // 2 :]):
            assert all(half.mean() > 0.15 for half in (rows[:, : width // 2], rows[:, width // 2 :]))
    assert reference.fit_windows.side != reference.held_out_windows.side


def test_three_by_three_windows_in_each_field() -> None:
    image = Raster(textured_image(512, 384), np.ones((384, 512), bool))
    for white in (False, True):
        windows = FixedWindows.on_chessboard(image.valid, structure_field(image), 48, white=white)
        assert len(windows.origins) == 9 * 6
        fields = {(x // 128, y // 128) for x, y in windows.origins}
        assert {(column + row) % 2 for column, row in fields} == {int(white)}
        assert all(x % 128 + 48 <= 128 and y % 128 + 48 <= 128 for x, y in windows.origins)
    np.testing.assert_array_equal(windows.centres_px, np.array(windows.origins) + 23.5)
