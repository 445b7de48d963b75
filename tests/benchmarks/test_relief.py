"""The scores of benchmarks/relief.py are right for mappings, rasters and masks that are known."""

from typing import Any

import cv2
import numpy as np
import pytest
from peers import dis_flow
from relief import Score, occlusion_scores, range_errors, residuals
from synthetic_flights.depth import BandTruth

pytestmark = pytest.mark.full

WIDTH, HEIGHT = 96, 64
HERE = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(np.float64)
NONE, ALL = np.zeros((HEIGHT, WIDTH), bool), np.ones((HEIGHT, WIDTH), bool)
WHOLE = np.s_[:, :]


def known(**masks: np.ndarray) -> BandTruth:
    plain: dict[str, Any] = {"hidden": NONE, "inside": ALL, "moved": NONE}
    return BandTruth((HERE + np.array((3, -2))).astype(np.float32), **(plain | masks))


def test_residuals_are_of_what_is_visible_and_still() -> None:
    left, top = HERE[..., 0] < 48, HERE[..., 1] < 8
    truth = known(hidden=left, moved=top)
    mapping = truth.moving_px + np.where(left | top, 100.0, 0.25)[..., None] * (0.6, 0.8)
    expected = {"median_px": 0.25, "p90_px": 0.25, "beyond_1_px": 0.0}
    assert residuals(mapping, truth, WHOLE) == pytest.approx(expected, abs=1e-4)
    claimed_px = np.where(HERE[..., 0] < 60, 0.1, 0.2)  # 12 of 48 columns are more than twice as far off
    shares = residuals(mapping, truth, WHOLE, claimed_px)
    assert (shares["within_1"], shares["within_2"]) == (0.0, 0.75)
    written = np.s_[4:60, 50:90]
    partly = np.full_like(mapping, np.nan)
    partly[written] = (truth.moving_px + np.where(HERE[..., 0] < 60, 2.0, 0.25)[..., None] * (0.6, 0.8))[written]
    expected = {"median_px": 0.25, "p90_px": 2.0, "beyond_1_px": 0.25}
    assert residuals(partly, truth, written) == pytest.approx(expected, abs=1e-4)
    assert not residuals(None, truth, WHOLE)
    assert not residuals(mapping, known(hidden=ALL), WHOLE)
    assert residuals(np.full_like(mapping, np.nan), truth, WHOLE)["p90_px"] == np.inf


def test_wrong_is_aligned_and_off_or_of_another_scene() -> None:
    def wrong(status: str, p90_px: float) -> bool:
        return Score("agalign", "flat", True, 0, status=status, p90_px=p90_px).wrong

    assert [wrong("aligned", p90) for p90 in (0.2, 1.0, 1.1, np.inf, np.nan)] == [False, False, True, True, True]
    assert not wrong("predicted", 5.0)
    assert not wrong("failed", np.nan)


def test_range_is_compared_where_there_is_one() -> None:
    expected_m = 1 + HERE[..., 0] / 100
    range_m = np.where(HERE[..., 1] < 16, np.nan, 1.02 * expected_m)
    assert range_errors(range_m, expected_m) == pytest.approx({"range_error": 0.02, "density": 0.75})
    assert not range_errors(None, expected_m), "without --relief-map"


def test_occlusions_are_pixels_without_data_to_one_px() -> None:
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[10:30, 40:50] = True
    pixels = np.full((HEIGHT, WIDTH), 7.0)
    pixels[10:30, 41:47] = np.nan  # the right columns are missed, but for the one next to the mask
    pixels[40:50, 20:32] = np.nan  # half of the masked pixels are wrong
    pixels[:, 80:] = np.nan  # outside the band's image
    result = occlusion_scores(pixels, known(hidden=hidden, inside=HERE[..., 0] < 80), WHOLE)
    assert result == pytest.approx({"precision": 0.5, "recall": 0.8})
    assert not occlusion_scores(None, known(), WHOLE)


def test_the_dense_flow_finds_a_shift_on_top_of_its_start() -> None:
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.normal(size=(240, 320)).astype(np.float32), (0, 0), 2.5)
    reference, moving = ground[20:220, 20:300], ground[18:218, 23:303]
    here = np.stack(np.meshgrid(np.arange(280), np.arange(200)), axis=-1).astype(np.float64)
    start = np.array((-2.0, 0.9))
    # The content at (x, y) of the reference is at (x - 3, y + 2) of the moving image; the start is 1.5 px off.
    mapping = dis_flow(reference, moving, here + start)
    error = np.linalg.norm(mapping - here - (-3, 2), axis=-1)[40:-40, 40:-40]
    assert np.median(error) < 0.15
