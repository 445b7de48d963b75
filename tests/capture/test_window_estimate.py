"""Results by windows where descriptors fail, confirmed by held-out windows."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.capture import from_windows as module
from agalign.capture.band_pair import BandPair
from agalign.capture.from_windows import from_windows
from agalign.capture.verification import verified
from agalign.config import Settings
from agalign.pixels.masks import raster_of
from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Residual, Seed
from agalign.values.issues import RETRIEVAL, UNREADABLE, Issue
from agalign.verify.check import Evidence
from agalign.verify.checks import issues_of
from agalign.verify.mapping_check import FOLDS
from tests.conftest import textured_pair

SIZE = 800, 640
TRUTH = geometry.compose(
    geometry.translation(5.0, -3.0), np.array([[1.004, 0.002, 0], [-0.003, 0.998, 0], [0, 0, 1.0]])
)
SEED = Seed("structure", geometry.translation(5.0, -3.0), 20.0, trusted=True)
SILENT = Issue(RETRIEVAL, 0.05, 0.2)


def pair_of(fixed: np.ndarray, moving: np.ndarray) -> BandPair:
    images = (raster_of(image, None, "image") for image in (fixed, moving))
    return BandPair.of_images("moving", *images, {"identity": np.eye(3)})


@pytest.fixture(scope="module")
def pair() -> BandPair:
    return pair_of(*textured_pair(TRUTH, *SIZE))


def unaligned(pair: BandPair, issue: Issue = SILENT) -> Alignment:
    result = verified(pair, SEED, issue, Settings())
    assert result.status == "seed_only"
    return result


def test_windows_suffice_where_descriptors_fail(pair: BandPair) -> None:
    before = unaligned(pair)
    after = from_windows(pair, before)
    assert after.status == "aligned"
    assert after.issues == ()
    assert geometry.corner_error_px(before.fixed_to_moving, TRUTH, *SIZE) > 1
    assert geometry.corner_error_px(after.fixed_to_moving, TRUTH, *SIZE) < 0.3
    assert after.joint.recipe == "windows"
    # Only held-out windows verify the fit.
    assert 0.4 < len(after.residual.centres_px) / len(before.residual.centres_px) < 0.6


def test_windows_do_not_override_descriptors_or_other_failures(pair: BandPair) -> None:
    for issue in (Issue(UNREADABLE, detail="x"), Issue(FOLDS, 9.0, 4.0)):
        before = unaligned(pair, issue)
        assert from_windows(pair, before) is before
    aligned = replace(unaligned(pair), status="aligned", issues=())
    assert from_windows(pair, aligned) is aligned


def test_held_out_windows_must_confirm_the_fit() -> None:
    fixed, moving = textured_pair(TRUTH, *SIZE)
    other, _ = textured_pair(TRUTH, *SIZE, seed=5)
    moving[:, 480:] = other[:, 480:]  # the part beyond has unrelated content
    pair = pair_of(fixed, moving)
    before = unaligned(pair)
    assert from_windows(pair, before) is before


def test_a_seed_with_a_large_error_is_not_refined(pair: BandPair, monkeypatch: pytest.MonkeyPatch) -> None:
    before = unaligned(pair)
    monkeypatch.setattr(module, "_MAX_STEP_PX", 0.5)
    assert from_windows(pair, before) is before


def windows(count: int, measured: float = 1.0) -> Residual:
    centres = np.stack([100.0 * np.arange(count), np.zeros(count)], axis=1)
    shifts = np.full((count, 2), 0.1)
    shifts[round(measured * count) :] = np.nan
    return Residual.of(centres, shifts, np.full(count, 20.0))


@pytest.mark.parametrize(
    ("recipe", "residual", "is_accepted"),
    [("windows", windows(20), True), ("fast", windows(20), False), ("windows", windows(11), False),
     ("windows", windows(12), True), ("windows", windows(30, 0.7), False), ("windows", windows(30, 0.8), True)],
)  # fmt: skip
def test_without_descriptors_more_windows_are_required(recipe: str, residual: Residual, is_accepted: bool) -> None:
    joint = JointResult(
        np.eye(3), 0.1, 0.05, 0.004, 0, (1.0,), recipe, "homography", 0.01, ((0.1, 0.1),) * 4
    )  # fmt: skip
    codes = [issue.code for issue in issues_of(Evidence(joint, residual, (3000, 100)))]
    assert codes == ([] if is_accepted else ["retrieval"])
