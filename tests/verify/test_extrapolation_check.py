"""Quarters of the image without a measured window."""

import numpy as np

from agalign.values import geometry
from agalign.values.alignment import Residual
from agalign.values.issues import sentence
from agalign.values.mapping import PixelMapping
from agalign.verify.checks import KINDS
from agalign.verify.extrapolation_check import (
    EXTRAPOLATED,
    issues_of_extrapolation,
    points_in_frame,
    unobserved_quarters,
)

SIZE = 1000, 800
CENTRES = np.stack(np.meshgrid(np.arange(50.0, 1000, 100), np.arange(50.0, 800, 100)), -1).reshape(-1, 2)
WHOLE = geometry.lattice(*SIZE, 24, 18)


def test_windows_everywhere_cover_all_quarters() -> None:
    assert unobserved_quarters(CENTRES, SIZE) == []


def test_windows_that_end_near_the_centre_do_not_cover_the_other_half() -> None:
    # 612 px, an eighth of the width beyond the centre
    assert unobserved_quarters(CENTRES[CENTRES[:, 0] < 620], SIZE) == ["top right", "bottom right"]
    assert unobserved_quarters(CENTRES[CENTRES[:, 0] < 680], SIZE) == []
    assert unobserved_quarters(CENTRES[CENTRES[:, 1] > 400], SIZE) == ["top left", "top right"]
    assert unobserved_quarters(CENTRES[(CENTRES < 400).any(axis=1)], SIZE) == ["bottom right"]


def test_one_window_is_too_few() -> None:
    others = CENTRES[(CENTRES < 400).any(axis=1)]
    assert unobserved_quarters(np.vstack([others, [[800.0, 700.0]]]), SIZE) == ["bottom right"]
    assert unobserved_quarters(np.vstack([others, [[800.0, 700.0], [900.0, 700.0]]]), SIZE) == []


def test_areas_outside_the_moving_image_need_no_window() -> None:
    left = CENTRES[CENTRES[:, 0] < 450]
    frame = points_in_frame(PixelMapping(geometry.translation(500, 0)), SIZE, SIZE)
    assert frame[:, 0].max() < 500
    assert unobserved_quarters(left, SIZE, frame) == []
    assert len(points_in_frame(PixelMapping(np.eye(3)), SIZE, SIZE)) == len(WHOLE)


def test_only_measured_windows_count_and_the_reason_names_the_quarters() -> None:
    shifts = np.where(CENTRES[:, :1] < 450, 0.1, np.nan) * np.ones((1, 2))
    residual = Residual.of(CENTRES, shifts, np.full(len(CENTRES), 20.0))
    (issue,) = issues_of_extrapolation(residual, SIZE, WHOLE)
    assert issue.kind is EXTRAPOLATED is KINDS["extrapolated"]
    assert "top right and bottom right" in sentence(issue)
    assert issue.value == 2
    assert issues_of_extrapolation(Residual.of(CENTRES, CENTRES * 0, residual.peaks_sigma), SIZE, WHOLE) == ()
