"""Failed bands, grouped by their cause."""

from agalign.products.report.facts import FailureGroups
from agalign.products.sidecar import CaptureResult

from .test_sidecar import NIR, example


def capture(*bands: tuple[str, str, str | None], missing: tuple[str, ...] = ()) -> CaptureResult:
    """A capture of bands with (name, status, kind of their issue)."""
    parts = []
    for name, status, kind in bands:
        issues = [] if kind is None else [{"kind": kind, "value": None, "limit": None}]
        parts.append(NIR | {"band": name, "status": status, "reason": kind, "doubts": issues})
    return example(bands=parts, missing_bands=missing).result()


def test_bands_are_grouped_by_cause_and_status_most_severe_first() -> None:
    result = FailureGroups()
    result.add(
        "one", capture(("Green", "reference", None), ("Blue", "aligned", None), ("NIR", "predicted", "retrieval"))
    )
    result.add("two", capture(("NIR", "predicted", "few_windows"), ("Red", "failed", "unreadable"), missing=("X",)))
    result.add("three", capture(("NIR", "seed_only", "repeats")))
    result.add("four", capture(("NIR", "seed_only", None)))
    groups = result.groups()
    assert [g.status for g in groups] == ["failed", "seed_only", "seed_only", "missing", "predicted"]
    assert sum("no reason" in g.remedy.cause for g in groups) == 1
    assert [b.capture for b in groups[-1].bands] == ["one", "two"]
    assert groups[-1].captures == 2
    assert groups[-1].advice.startswith(
        "indices use those with a standard error (prediction.std_px) within --accept-predicted"
    )
    assert "card" in groups[0].advice
