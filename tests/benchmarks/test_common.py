"""What the benchmarks share: errors at tie points, sections of documents, watched processes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from common import band_errors, read_ties, table, watched, with_section

from agalign import read_alignment
from agalign.records.sidecar_file import find_sidecars, read_sidecar, write_sidecar
from agalign.values import geometry
from agalign.values.alignment import Prediction

pytestmark = pytest.mark.full


@pytest.mark.parametrize("reference", ["Green", "Blue"])
def test_the_error_is_that_of_the_mapping_at_the_ties(aligned_flight: Path, tmp_path: Path, reference: str) -> None:
    """Also if the ties have another reference than the run."""
    (path, *_), copy = find_sidecars(aligned_flight), tmp_path / "IMG_0001.json"
    whole = read_sidecar(path)
    prediction = Prediction(np.eye(3), "flight", 0.7)
    changes = {
        "NIR": {"status": "predicted", "prediction": prediction},
        "Red": {"status": "failed", "homography": None},
    }
    bands = {b.band: b.model_copy(update=changes.get(b.band, {})) for b in whole.bands}
    write_sidecar(copy, whole.model_copy(update={"bands": [*bands.values()]}))
    at, entries = geometry.lattice(480, 360, 5, 4), {}
    here = at if reference == "Green" else read_alignment(path, reference).map(at)
    for name in ("NIR", "Red edge", "Red"):
        there = np.add(read_alignment(path, name).map(at), (0.3, 0.4))
        entries[Path(bands[name].file).name] = {"ties": np.hstack([here, there]).tolist()}
    (tmp_path / "ties.json").write_text(
        json.dumps({"a": {"reference": Path(bands[reference].file).name, "bands": entries}})
    )
    errors = band_errors(tmp_path, read_ties(tmp_path / "ties.json"))
    known_std_px = {"NIR": 0.7, "Red edge": bands["Red edge"].joint.corner_std_px}
    assert {b.part.band: b.std_px for b in errors} == known_std_px
    assert all(b.is_usable for b in errors)
    np.testing.assert_allclose([(b.median_px, b.p95_px) for b in errors], 0.5, atol=1e-3)


def test_a_section_replaces_what_is_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- kills -->\nold\n<!-- end of kills -->\nafter\n")
    new = table([("a", "b"), ("1|2", "3")])
    assert new == "| a | b |\n|---|---|\n| 1\\|2 | 3 |"
    assert with_section(page, "kills", new) == f"before\n<!-- kills -->\n{new}<!-- end of kills -->\nafter\n"
    with pytest.raises(SystemExit, match="has no section"):
        with_section(page, "soak", new)


def test_a_watched_process_has_its_children() -> None:
    child = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(2)'])"
    run = watched([sys.executable, "-c", child])
    assert run.code == 0
    assert run.samples[:, 3].max() == 2
    assert not run.left
    assert 0 < run.largest_gb < 10  # of a child, it starts at that of this process
