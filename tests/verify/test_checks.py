"""The list of checks and the order in which they run."""

from dataclasses import replace

import numpy as np
import pytest

from agalign.pixels.structure import Field
from agalign.values.alignment import JointResult, Prediction, Residual
from agalign.values.issues import Issue, IssueKind, Remedy
from agalign.verify import checks
from agalign.verify.check import Check, Evidence
from agalign.verify.checks import CHECKS, KINDS, issues_of

JOINT = JointResult(np.eye(3), 0.1, 0.95, 0.004, 75, (1.0,), "fast", "homography", 0.05, ((0.07, 0.07),) * 4)
RESIDUAL = Residual(np.zeros((50, 2)), np.zeros((50, 2)), 0.05, 0.2, 1.0)
GOOD = Evidence(JOINT, RESIDUAL, (1280, 960))
PREDICTION = Prediction(np.eye(3), "bands", std_px=0.2)


class RepetitiveImages:
    """Images that also match with a shift of 16 px to the right."""

    reduced_scale = (0.5, 0.5)

    def __init__(self, expected_within_px: float = np.inf) -> None:
        self.expected_within_px = expected_within_px

    def reduced_spectra(self) -> tuple[Field, Field]:
        rng = np.random.default_rng(0)
        tile = rng.normal(size=(64, 8)) + 1j * rng.normal(size=(64, 8))
        spectrum = np.fft.fft2(np.tile(tile, (1, 8))).astype(np.complex64)
        return spectrum, spectrum

    def is_expected(self, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        return float(np.hypot(*shift_px)) <= self.expected_within_px


def codes(evidence: Evidence) -> list[str]:
    return [issue.code for issue in issues_of(evidence)]


def test_every_check_lists_its_kinds_and_codes_are_unique() -> None:
    kinds = [kind for check in CHECKS for kind in check.kinds]
    assert len(kinds) == len({k.code for k in kinds}) == 9
    assert all(KINDS[kind.code] is kind for kind in kinds)
    assert codes(GOOD) == []


@pytest.mark.parametrize(
    ("off_px", "std_px", "expected"),
    [(None, 0.2, []), (2.9, 0.2, []), (3.1, 0.2, ["unexpected_px"]), (4.9, 1.0, []), (5.1, 1.0, ["unexpected_px"]),
     (np.nan, 0.2, ["unexpected_px"])],
)  # fmt: skip
def test_a_result_far_from_the_rig_is_an_issue(off_px: float | None, std_px: float, expected: list[str]) -> None:
    assert codes(replace(GOOD, prediction=replace(PREDICTION, off_px=off_px, std_px=std_px))) == expected


def test_a_repetitive_scene_is_an_issue_unless_aliases_are_excluded() -> None:
    (issue,) = issues_of(replace(GOOD, images=RepetitiveImages()))
    assert issue.code == "repeats"
    assert issue.value is not None
    assert issue.value % 16 == pytest.approx(0)
    assert issue.value > 0
    assert codes(replace(GOOD, images=RepetitiveImages(expected_within_px=5.0))) == []
    assert codes(replace(GOOD, images=RepetitiveImages(expected_within_px=-1.0))) == ["repeats"]


def test_costly_checks_run_only_where_the_others_pass() -> None:
    bad = replace(GOOD, joint=replace(JOINT, retrieval=0.0), images=RepetitiveImages())
    assert codes(bad) == ["retrieval"]


def test_a_new_check_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = IssueKind("too_late", "taken at night", Remedy("the sun is down", "fly at noon"))
    monkeypatch.setattr(checks, "CHECKS", (*CHECKS, Check((kind,), lambda _: [Issue(kind)])))
    assert codes(GOOD) == ["too_late"]
