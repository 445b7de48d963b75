"""What the benchmarks share: errors at tie points, sections of documents, watched processes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from common import Section, band_errors, read_ties, watched

from agalign.values import geometry

pytestmark = pytest.mark.full


def test_the_error_is_that_of_the_grid_at_the_ties(tmp_path: Path) -> None:
    here = geometry.lattice(100, 80, 17, 13)
    grid = {"reference_px": here.tolist(), "moving_px": (here + np.array((3.3, 0.4))).tolist()}
    band = {"band": "NIR", "status": "aligned", "grid": grid, "prediction": None, "seconds": 1.0}
    bands = [
        band | {"file": "a_2.tif", "joint": {"corner_std_px": 0.2}},
        band
        | {"file": "a_3.tif", "joint": None, "status": "predicted", "prediction": {"from": "flight", "std_px": 0.7}},
        band | {"file": "a_4.tif", "joint": None, "status": "failed", "grid": None},
        band | {"file": "not in the truth.tif", "joint": None},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"schema": "agalign/1", "capture": "a", "bands": bands}))
    entry = {"ties": [[10, 10, 13, 10], [50, 40, 53, 40]]}
    truth = {"a": {"reference": "a_1.tif", "bands": {f"a_{k}.tif": entry for k in (2, 3, 4)}}}
    (tmp_path / "ties.json").write_text(json.dumps(truth))
    result = band_errors(tmp_path, read_ties(tmp_path / "ties.json"))
    assert [(b.file, b.status, b.source, b.std_px) for b in result] == [
        ("a_2.tif", "aligned", "", 0.2),
        ("a_3.tif", "predicted", "flight", 0.7),
    ]
    np.testing.assert_allclose([(b.median_px, b.p95_px) for b in result], 0.5, atol=1e-5)


def test_a_section_replaces_what_is_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- kills -->\nold\n<!-- end of kills -->\nafter\n")
    section = Section("kills", page)
    section.say("New.")
    section.table([("a", "b"), ("1|2", "3")])
    table = "| a | b |\n|---|---|\n| 1\\|2 | 3 |"
    assert page.read_text() == f"before\n<!-- kills -->\n\nNew.\n\n{table}\n\n<!-- end of kills -->\nafter\n"
    with pytest.raises(SystemExit, match="has no section"):
        Section("soak", page).say("text")


def test_a_watched_process_has_its_children() -> None:
    child = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(2)'])"
    run = watched([sys.executable, "-c", child])
    assert run.code == 0
    assert run.samples[:, 4].max() == 2
    assert not run.left
    assert 0 < run.largest_gb < 10  # of a child, it starts at that of this process
