"""A camera counts from 1970 until its clock is set: all files have that as an unknown time."""

import re
import shutil
from pathlib import Path

import pytest
import rasterio

import agalign

from ..conftest import read_json, seeded
from ..program import agalign_here
from ..run_outputs import table_in


@pytest.mark.slow
def test_a_clock_that_was_not_set_is_no_time_in_any_file(flight: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(flight, folder)
    for path in folder.rglob("*.tif"):
        path.write_bytes(path.read_bytes().replace(b"2026:06:21", b"1970:01:01").replace(b"2026-06-21", b"1970-01-01"))
    (capture, other) = agalign.discover(folder).captures
    assert capture.captured_at.startswith("1970-01-01T10:00:01")
    assert capture.time_s < other.time_s
    assert capture.known_time == ""
    agalign.align_folder(folder, out, settings=seeded("rig"))
    texts = [path for path in out.rglob("*") if path.suffix in (".json", ".geojson", ".csv")]
    assert len(texts) == 5
    # The date, not "1970" alone: seconds and matrices of a sidecar may have these digits.
    assert [path.name for path in texts if re.search("1970[-:]01", path.read_text())] == []
    assert read_json(out / f"{capture.label}.json")["captured_at"] == ""
    rasters = [path for path in out.rglob("*.tif") if b"1970:01:01" in path.read_bytes()]
    assert rasters == []
    with rasterio.open(out / f"{capture.label}.tif") as stack:
        assert "TIFFTAG_DATETIME" not in stack.tags()
    page = (out / "index.html").read_text()
    assert '"captured_at":""' in page
    assert "1970-01" not in agalign_here("info", folder, "--json").stdout
    # The same captures are kept.
    assert {report.state for report in agalign.align_folder(folder, out, settings=seeded("rig"))} == {"kept"}
    assert [row["status"] for row in table_in(out / "summary.csv")] == ["seed_only"] * 8
