from dataclasses import replace

import numpy as np
import pytest

from agalign.values import geometry
from agalign.values.alignment import Alignment, JointResult, Residual, Seed
from agalign.values.issues import RETRIEVAL, SEED_DOES_NOT_FIT, Issue, sentence
from agalign.values.mapping import PixelMapping
from agalign.verify.acceptance import is_unchanged, status_of
from agalign.verify.check import Evidence
from agalign.verify.checks import issues_of

SEED = Seed("rig", np.eye(3), 100.0, 100.0, 5.0)
GOOD_JOINT = JointResult(np.eye(3), 0.1, 0.95, 0.004, 75, (0.5, 1.0), "fast", "homography", 0.05, ((0.07, 0.07),) * 4)
GOOD_RESIDUAL = Residual(np.zeros((50, 2)), np.zeros((50, 2)), 0.05, 0.2, 1.0)
HALF_WRONG = np.vstack([np.zeros((20, 2)), np.full((30, 2), 5.0)])
SIZE = (1280, 960)


def kinds(joint: JointResult = GOOD_JOINT, residual: Residual = GOOD_RESIDUAL) -> list[str]:
    return [d.code for d in issues_of(Evidence(joint, residual, SIZE))]


def test_a_good_result_has_no_issues() -> None:
    assert kinds() == []
    assert status_of((), GOOD_RESIDUAL, seed=False) == "aligned"


NAN = float("nan")


@pytest.mark.parametrize(
    ("joint", "residual", "expected"),
    [
        (replace(GOOD_JOINT, retrieval=0.1), GOOD_RESIDUAL, ["retrieval"]),
        (replace(GOOD_JOINT, corner_std_xy_px=((0.1, 0.1), (3.0, 4.0))), GOOD_RESIDUAL, ["corner_std_px"]),
        (replace(GOOD_JOINT, fixed_to_moving=np.diag([-1.0, 1, 1])), GOOD_RESIDUAL, ["folds"]),
        (
            replace(GOOD_JOINT, fixed_to_moving=np.array([[1, 0, 0], [0, 1, 0], [-7e-4, 0, 1.0]])),
            GOOD_RESIDUAL,
            ["folds"],
        ),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, centres_px=np.zeros((2, 2))), ["few_windows"]),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, coverage=0.4), ["coverage"]),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, median_px=2.5), ["residual_px"]),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, median_px=float("inf")), ["residual_px"]),
        (GOOD_JOINT, replace(GOOD_RESIDUAL, shifts_px=HALF_WRONG), ["close_windows"]),
        (replace(GOOD_JOINT, retrieval=NAN), GOOD_RESIDUAL, ["retrieval"]),
        (replace(GOOD_JOINT, retrieval=0.3, chance=1 / 16), GOOD_RESIDUAL, ["retrieval"]),
        (replace(GOOD_JOINT, corner_std_xy_px=((NAN, 0.1),) * 4), GOOD_RESIDUAL, ["corner_std_px"]),
        (replace(GOOD_JOINT, retrieval=0.1), replace(GOOD_RESIDUAL, median_px=2.5), ["retrieval", "residual_px"]),
    ],
)
def test_every_issue_is_sufficient_and_listed(joint: JointResult, residual: Residual, expected: list[str]) -> None:
    assert kinds(joint, residual) == expected
    issues = issues_of(Evidence(joint, residual, SIZE))
    assert status_of(issues, GOOD_RESIDUAL, seed=True) == "seed_only"
    assert status_of(issues, GOOD_RESIDUAL, seed=False) == "failed"
    assert all(sentence(d) for d in issues)


def test_an_issue_has_its_value_and_limit() -> None:
    (issue,) = issues_of(Evidence(replace(GOOD_JOINT, retrieval=0.1), GOOD_RESIDUAL, SIZE))
    assert issue == Issue(RETRIEVAL, 0.1, 0.2)
    assert "0.10" in sentence(issue)


def test_a_seed_that_does_not_fit_is_not_used() -> None:
    issues = (Issue(RETRIEVAL, 0.1, 0.2),)
    off = replace(GOOD_RESIDUAL, median_px=9.0)
    assert status_of(issues, off, seed=True) == "failed"
    failed = Alignment(PixelMapping(np.eye(3)), SIZE, "failed", (*issues, Issue(SEED_DOES_NOT_FIT)), SEED, residual=off)
    assert failed.reason is not None
    assert "rig seed is used unchanged, but the seed does not fit either" in failed.reason


def test_an_aligned_input_is_unchanged() -> None:
    within = replace(GOOD_JOINT, fixed_to_moving=geometry.translation(0.1, 0.1))
    beyond = replace(GOOD_JOINT, fixed_to_moving=geometry.translation(0.4, 0.1))
    precise = replace(within, corner_std_xy_px=((0.01, 0.0),) * 4)
    assert is_unchanged(within, np.eye(3), SIZE)
    assert not is_unchanged(beyond, np.eye(3), SIZE)
    assert not is_unchanged(precise, np.eye(3), SIZE)
    # The limit is in px of the file: in an image reduced to a third it is a third as large.
    assert not is_unchanged(within, np.eye(3), SIZE, scale=1 / 3)


def windows(off: np.ndarray) -> Residual:
    """12 x 9 windows with a spacing of 112 px, some with a shift of 3 px."""
    centres = np.stack(np.meshgrid(np.arange(12), np.arange(9)), axis=-1).reshape(-1, 2) * 112.0 + 56
    shifts = np.where(off.reshape(-1, 1), [3.0, 0.0], [0.05, 0.0])
    return Residual(centres, shifts, 0.05, 0.2, 1.0)


def test_misaligned_clusters_are_an_issue_but_scattered_windows_are_not() -> None:
    scattered, corner, third = (np.zeros((9, 12), bool) for _ in range(3))
    scattered[::4, ::3] = True
    scattered[0, 0] = scattered[8, 9] = False
    corner[:2, :3] = True
    third[:, 8:] = True
    assert kinds(residual=windows(scattered)) == []
    assert kinds(residual=windows(corner)) == ["cluster"]
    assert kinds(residual=windows(third)) == ["close_windows", "cluster"]


def test_windows_without_a_measurement_are_not_misaligned() -> None:
    residual = windows(np.zeros((9, 12), bool))
    residual.shifts_px[:20] = np.nan
    assert kinds(residual=residual) == []


def shifted(count_off: int, off_px: float, total: int = 100, spacing_px: float = 100.0) -> Residual:
    """A row of windows, some of them misaligned at scattered positions."""
    centres = np.stack([np.arange(total) * spacing_px, np.zeros(total)], axis=1)
    shifts = np.zeros((total, 2))
    shifts[: 3 * count_off : 3, 0] = off_px
    return Residual(centres, shifts, 0.0, 0.0, 1.0)


def at_limits(**changes: float) -> Residual:
    return replace(GOOD_RESIDUAL, **changes)


@pytest.mark.parametrize(
    ("within", "beyond", "code", "value", "limit"),
    [
        (at_limits(coverage=0.6), at_limits(coverage=0.59), "coverage", 0.59, 0.6),
        (at_limits(median_px=1.0), at_limits(median_px=1.01), "residual_px", 1.01, 1.0),
        (shifted(0, 0.0, 4), shifted(0, 0.0, 3), "few_windows", 3, 4),
    ],
)  # fmt: skip
def test_windows_pass_at_their_limits(
    within: Residual, beyond: Residual, code: str, value: float, limit: float
) -> None:  # fmt: skip
    assert issues_of(Evidence(GOOD_JOINT, within, SIZE)) == ()
    (issue,) = issues_of(Evidence(GOOD_JOINT, beyond, SIZE))
    assert (issue.code, issue.value, issue.limit) == (code, value, limit)


@pytest.mark.parametrize(
    ("within", "beyond", "code", "value", "limit"),
    [
        ({"retrieval": 0.2}, {"retrieval": 0.19}, "retrieval", 0.19, 0.2),
        ({"retrieval": 0.5, "chance": 0.1}, {"retrieval": 0.49, "chance": 0.1}, "retrieval", 0.49, 0.5),
        ({"corner_std_xy_px": ((2.0, 0.0),)}, {"corner_std_xy_px": ((2.01, 0.0),)}, "corner_std_px", 2.01, 2.0),
        ({"fixed_to_moving": geometry.normalised(np.diag([2.0, 0.5, 1.0]))},
         {"fixed_to_moving": np.array([[1, 0, 0], [0, 1, 0], [-5e-4, 0, 1.0]])}, "folds", None, 4.0),
    ],
)  # fmt: skip
def test_results_pass_at_their_limits(
    within: dict[str, object], beyond: dict[str, object], code: str, value: float | None, limit: float
) -> None:
    assert issues_of(Evidence(replace(GOOD_JOINT, **within), GOOD_RESIDUAL, SIZE)) == ()
    joint = replace(GOOD_JOINT, **beyond)
    (issue,) = issues_of(Evidence(joint, GOOD_RESIDUAL, SIZE))
    assert (issue.code, issue.limit) == (code, limit)
    scale = geometry.local_scale(joint.fixed_to_moving, *SIZE)
    assert issue.value == pytest.approx(scale.max() / scale.min() if value is None else value)


def test_nine_in_ten_windows_must_be_close() -> None:
    assert kinds(residual=shifted(10, 1.5)) == []
    assert kinds(residual=shifted(11, 1.5)) == ["close_windows"]
    assert kinds(residual=shifted(11, 1.0)) == []
    (issue,) = issues_of(Evidence(GOOD_JOINT, shifted(11, 1.5), SIZE))
    assert (issue.value, issue.limit, issue.detail) == (pytest.approx(0.89), 0.9, "1 px")


def test_the_limit_is_a_pixel_of_the_file_where_the_images_are_reduced() -> None:
    within = Evidence(GOOD_JOINT, shifted(11, 0.7), SIZE)
    assert issues_of(within) == ()
    assert [issue.code for issue in issues_of(replace(within, file_px=0.65))] == ["close_windows"]


@pytest.mark.parametrize(("total", "allowed"), [(100, 4), (125, 4), (150, 5), (200, 7)])
def test_the_windows_of_a_cluster_are_counted(total: int, allowed: int) -> None:
    """The limit is five adjacent windows or 4 % of the measured ones, whichever is larger."""
    for count in (allowed, allowed + 1):
        residual = shifted(0, 0.0, total)
        residual.shifts_px[10 : 10 + count, 0] = 2.0
        assert kinds(residual=residual) == ([] if count == allowed else ["cluster"]), (total, count)


def test_windows_with_a_gap_are_not_a_cluster() -> None:
    residual = shifted(0, 0.0)
    residual.shifts_px[10:20:2, 0] = 2.0
    assert kinds(residual=residual) == []


@pytest.mark.parametrize(
    ("coverage", "median_px", "status"),
    [(0.3, 8.0, "seed_only"), (0.29, 8.0, "failed"), (0.3, 8.1, "failed")],
)  # fmt: skip
def test_a_seed_is_used_up_to_its_limits(coverage: float, median_px: float, status: str) -> None:
    residual = at_limits(coverage=coverage, median_px=median_px)
    assert status_of((Issue(RETRIEVAL, 0.1, 0.2),), residual, seed=True) == status
    assert status_of((Issue(RETRIEVAL, 0.1, 0.2),), residual, seed=False) == "failed"


@pytest.mark.parametrize("magnification", [0.5, 1.0, 3.0])
def test_an_input_is_unchanged_within_px_of_the_fixed_image_at_any_scale(magnification: float) -> None:
    given = np.diag([magnification, magnification, 1.0])
    uncertain = replace(GOOD_JOINT, corner_std_xy_px=((0.5, 0.5),) * 4)
    for shift_px, expected in ((0.24, True), (0.26, False)):
        result = replace(uncertain, fixed_to_moving=geometry.compose(given, geometry.translation(shift_px, 0.0)))
        assert is_unchanged(result, given, SIZE) == expected


def test_an_input_is_unchanged_within_three_standard_errors() -> None:
    certain = replace(GOOD_JOINT, corner_std_xy_px=((0.03, 0.0),) * 4)
    for shift_px, expected in ((0.089, True), (0.091, False)):
        assert (
            is_unchanged(replace(certain, fixed_to_moving=geometry.translation(shift_px, 0)), np.eye(3), SIZE)
            == expected
        )
