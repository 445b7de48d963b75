import logging
from pathlib import Path

import pytest

import agalign
from agalign import CaptureReport, FlightReports

from ..conftest import seeded, write_capture


def test_progress_is_reported_and_shown(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in "ab":
        write_capture(tmp_path / "in", "green", "red", name=name, size_px=(200, 160))
    seen: list[tuple[str, int, int]] = []
    caplog.set_level(logging.INFO, "agalign")
    options = {"progress": lambda report, done, total: seen.append((report.label, done, total))}
    reports = agalign.align_folder(tmp_path / "in", tmp_path / "out", settings=seeded("identity"), **options)
    assert sorted(seen, key=lambda s: s[1]) == [(reports[0].label, 1, 2), (reports[1].label, 2, 2)]
    assert [r.message for r in caplog.records if "of 2" in r.message] == [
        f"{n} of 2: {r.label}: done, 1 seed_only" for n, r in enumerate(reports, start=1)
    ]
    assert isinstance(reports, FlightReports)
    assert "2 captures: 2 done" in reports._repr_html_()
    assert "<td>red</td><td>seed_only</td>" in reports[0]._repr_html_()
    assert len(repr(reports[0]).replace(str(tmp_path), "")) < 250, "a console prints the report in a few lines"


def test_a_table_of_many_captures_is_short() -> None:
    html = FlightReports([CaptureReport(f"c{i}", "error", error="a <b>") for i in range(500)])._repr_html_()
    assert "500 captures: 500 error" in html
    assert "and 480 more" in html
    assert "a &lt;b&gt;" in html
    assert len(html) < 5000
