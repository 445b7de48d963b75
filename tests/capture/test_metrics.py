"""What is measured of the final alignment of a pair."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.capture.metrics import with_metrics
from agalign.values import geometry
from agalign.values.alignment import Alignment, Prediction, Seed
from agalign.values.issues import CLOSE_WINDOWS, Issue
from agalign.values.mapping_error import MappingError

from ..builders import pair_of, residual_of, texture, two_views

TRUTH = geometry.translation(6, -4)


def test_what_moved_is_in_the_error_of_an_aligned_band_and_changes_nothing_else() -> None:
    fixed, moving = two_views(TRUTH, 640, 480)
    body = texture(100, 100, seed=9).pixels
    for image, x, y in ((fixed, 300, 200), (moving, 315, 196)):  # 9 px beyond the mapping
        image.pixels[y : y + 100, x : x + 100] = body
    pair = pair_of(fixed, moving)
    seed, error = Seed("rig", TRUTH, 30.0), MappingError((640, 480), rig_std_px=0.1)
    residual = residual_of(np.zeros((10, 2)), (0.1, 0.0))
    aligned = Alignment(pair.mapping(TRUTH), (640, 480), (), seed, residual=residual, error=error, std_px=0.1)
    measured = with_metrics(aligned, pair)
    after = measured.after
    assert (after.residual_px, after.residual_p95_px, after.residual_coverage) == (0.1, 0.1, 1.0)
    assert measured.error is not None
    (area,) = measured.error.moved
    np.testing.assert_allclose(area.shift_px, (9, 0), atol=0.3)
    assert (measured.status, measured.std_px, measured.mapping) == ("aligned", 0.1, aligned.mapping)
    assert measured.error_px([[350, 250], [100, 100]]) == pytest.approx([9, 0.1], abs=0.3)
    prediction = Prediction(TRUTH, "windows", 0.4)
    predicted = replace(aligned, issues=(Issue(CLOSE_WINDOWS, 0.8, 0.9),), prediction=prediction)
    assert with_metrics(predicted, pair).error == error
    uncertain = replace(aligned, residual=residual_of(np.zeros((10, 2)), (2.5, 0.0)))  # 9 px may be an error like these
    assert with_metrics(uncertain, pair).error == error
