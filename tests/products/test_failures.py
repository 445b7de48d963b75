"""Failed bands, grouped by their cause."""

from agalign.products.report.facts import FailureGroups
from agalign.products.sidecar import CaptureResult
from agalign.verify.checks import KINDS

from .test_sidecar import NIR, example


def capture(*bands: tuple[str, str, str | None], missing: tuple[str, ...] = ()) -> CaptureResult:
    """A capture of bands with (name, status, kind of their issue)."""
    parts = []
    for name, status, kind in bands:
        issues = [] if kind is None else [{"kind": kind, "value": None, "limit": None}]
        parts.append(NIR | {"band": name, "status": status, "reason": kind, "doubts": issues})
    return example(bands=parts, missing_bands=missing).result()


def test_bands_of_one_cause_and_status_are_one_group_and_the_gravest_comes_first() -> None:
    result = FailureGroups()
    result.add(
        "one", capture(("Green", "reference", None), ("Blue", "aligned", None), ("NIR", "predicted", "retrieval"))
    )
    result.add("two", capture(("NIR", "predicted", "few_windows"), ("Red", "failed", "unreadable"), missing=("X",)))
    result.add("three", capture(("NIR", "seed_only", "repeats")))
    groups = result.groups()
    assert [g.status for g in groups] == ["failed", "seed_only", "missing", "predicted"]
    assert [b.capture for b in groups[-1].bands] == ["one", "two"]
    assert groups[-1].captures == 2
    assert groups[-1].advice.startswith("use those with a standard error of at most 1 px")
    assert "card" in groups[0].advice


def test_a_band_without_a_reason_is_reported_too() -> None:
    result = FailureGroups()
    result.add("one", capture(("NIR", "seed_only", None)))
    assert "no reason" in result.groups()[0].remedy.cause


def test_every_issue_has_a_remedy() -> None:
    assert len(KINDS) == 22
    assert all(kind.remedy.cause and kind.remedy.advice for kind in KINDS.values())
