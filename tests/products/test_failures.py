"""What fell short, told once for each cause."""

from agalign.products.report.facts import FailureGroups
from agalign.products.sidecar import BandResult, CameraPart, CaptureResult, IssuePart, ReferencePart
from agalign.verify.checks import KINDS


def band(name: str, status: str, kind: str | None = None) -> BandResult:
    issues = [] if kind is None else [IssuePart(kind=kind, value=None, limit=None)]
    return BandResult(
        band=name, wavelength_nm=None, file="a.tif", band_index=1, status=status, reason=f"{kind}", doubts=issues,
        seconds=0.1,
    )  # type: ignore[arg-type]  # fmt: skip


def capture(*bands: BandResult, missing: tuple[str, ...] = ()) -> CaptureResult:
    return CaptureResult(
        agalign="1", capture="a", capture_id="", flight_id="", captured_at="", status="degraded",
        camera=CameraPart(make="", model="", serial=""), missing_bands=list(missing), output=None, settings="",
        reference=ReferencePart(band="Green", file="a.tif", band_index=1, width=4, height=3), bands=bands,
    )  # fmt: skip


def test_bands_of_one_cause_and_status_are_one_group_and_the_gravest_comes_first() -> None:
    result = FailureGroups()
    result.add(
        "one", capture(band("Green", "reference"), band("Blue", "aligned"), band("NIR", "predicted", "retrieval"))
    )
    result.add(
        "two", capture(band("NIR", "predicted", "few_windows"), band("Red", "failed", "unreadable"), missing=("X",))
    )
    result.add("three", capture(band("NIR", "seed_only", "repeats")))
    groups = result.groups()
    assert [g.status for g in groups] == ["failed", "seed_only", "missing", "predicted"]
    assert [b.capture for b in groups[-1].bands] == ["one", "two"]
    assert groups[-1].captures == 2
    assert groups[-1].advice.startswith("use those with a standard error of at most 1 px")
    assert "card" in groups[0].advice


def test_a_band_without_a_reason_is_told_too() -> None:
    result = FailureGroups()
    result.add("one", capture(band("NIR", "seed_only")))
    assert "no reason" in result.groups()[0].remedy.cause


def test_every_doubt_has_a_remedy() -> None:
    assert len(KINDS) == 22
    for kind in KINDS.values():
        assert kind.remedy.cause
        assert kind.remedy.advice
