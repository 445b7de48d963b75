"""Failed bands, grouped by their cause."""

from typing import Any

import pytest

from agalign.products.report.facts import PairTotals
from agalign.products.sidecar.schema import CaptureResult

from .test_sidecar import NIR, example


def capture(*bands: tuple[str, str, str | None], missing: tuple[str, ...] = (), **changes: Any) -> CaptureResult:
    """A capture of bands with (name, status, kind of their issue)."""
    parts = []
    for name, status, kind in bands:
        issues = [] if kind is None else [{"kind": kind, "value": None, "limit": None}]
        parts.append(NIR | {"band": name, "status": status, "reason": kind, "doubts": issues})
    return example(bands=parts, missing_bands=missing, **changes).result()


def test_bands_are_grouped_by_cause_and_status_most_severe_first() -> None:
    result = PairTotals()
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


def with_reference(name: str, missing: tuple[str, ...] = (), flight_id: str = "") -> CaptureResult:
    reference = {"band": name, "file": "x.tif", "band_index": 1, "width": 10, "height": 8}
    bands = [(name, "reference", None)]
    bands += [(b, "aligned", None) for b in ("Blue", "Green") if b != name and b not in missing]
    return capture(*bands, missing=missing, reference=reference, flight_id=flight_id)


@pytest.mark.parametrize(
    ("references", "odd"),
    [
        ("Green Green Green", []),
        ("Blue Green Green", [0]),  # the exception differs from most captures, not from the first
        ("Blue Green Blue Green", [0, 2]),  # half lack green: a band that is missing is the flight's
        ("Blue Blue Green Blue", [2]),
    ],
)
def test_captures_with_another_reference_than_most_of_their_flight_are_named(references: str, odd: list[int]) -> None:
    result, names = PairTotals(), references.split()
    # As `with_missing_bands`: a band of at least half of the captures is missing in the others.
    missing = ("Green",) if 2 * names.count("Green") >= len(names) else ()
    for number, name in enumerate(names):
        result.add(f"IMG_{number}", with_reference(name, missing if name == "Blue" else ()))
    result.add("IMG_9", with_reference("Red", flight_id="another"))
    groups = [g for g in result.groups() if g.status == "other_reference"]
    assert [b.capture for g in groups for b in g.bands] == [f"IMG_{number}" for number in odd]
    if odd:
        usual = {"Blue": "Green", "Green": "Blue"}[names[odd[0]]]
        assert (
            groups[0].bands[0].reason
            == f"on the grid of {names[odd[0]]}; most captures of the flight are on that of {usual}"
        )


def test_missing_bands_count_among_those_to_align() -> None:
    result = PairTotals()
    result.add("one", capture(("Green", "reference", None), ("NIR", "aligned", None), missing=("Red",)))
    result.add("two", capture(("Green", "reference", None), ("NIR", "failed", "unreadable"), ("Red", "aligned", None)))
    assert result.statuses == {"aligned": 2, "missing": 1, "failed": 1}
    assert {name: dict(band.statuses) for name, band in result.bands.items()} == {
        "NIR": {"aligned": 1, "failed": 1},
        "Red": {"missing": 1, "aligned": 1},
    }
