"""What the benchmarks share: errors at tie points, sections of documents, watched processes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from common import band_errors, read_ties, report, watched
from synthetic_flights.aligned import sidecar_of

from agalign.values import geometry

pytestmark = pytest.mark.full


@pytest.mark.parametrize("reference", ["IMG_0001_1.tif", "IMG_0001_2.tif"])
def test_the_error_is_that_of_the_mapping_at_the_ties(tmp_path: Path, reference: str) -> None:
    """Also if the ties have the second band as their reference, from which the first one is shifted by (3.3, 0.4)."""
    whole = sidecar_of("IMG_0001", 1, (160, 120), raw=False).model_dump(mode="json", by_alias=True)
    shift = geometry.translation(3.3, 0.4).tolist()
    joint = dict.fromkeys(("loss", "retrieval", "chance", "last_step_px"), 0.1) | {"iterations": 1, "levels": [1.0]}
    joint |= {"recipe": "fast", "model_family": "homography"}
    joint |= {"corner_std_px": 0.2, "corner_std_xy_px": [[0.1, 0.1]] * 4}
    first, aligned, predicted, failed = whole["bands"]
    mapped = {
        "homography": {"fixed_to_moving": shift, "space": "pixel"},
        "seed": {"kind": "rig", "fixed_to_moving": shift, "peak_sigma": 9.0, "runner_up_sigma": 3.0},
    }
    prediction = {"from": "flight", "std_px": 0.7, "off_px": None}
    bands = [
        aligned | mapped | {"joint": joint},
        predicted | mapped | {"status": "predicted", "prediction": prediction},
        failed | {"status": "failed"},
        aligned | mapped | {"file": "not in the truth.tif", "band": "x"},
    ]
    (tmp_path / "a.json").write_text(json.dumps(whole | {"bands": [first, *bands]}))
    at = np.array([[10.0, 10], [50, 40]])
    in_reference = at + np.array((0.0, 0.0) if reference == first["file"] else (3.3, 0.4))
    entry = {"ties": np.hstack([in_reference, at + np.array((3.0, 0.0))]).tolist()}
    truth = {"a": {"reference": reference, "bands": {f"IMG_0001_{k}.tif": entry for k in (2, 3, 4)}}}
    (tmp_path / "ties.json").write_text(json.dumps(truth))
    result = band_errors(tmp_path, read_ties(tmp_path / "ties.json"))
    assert [(b.part.file, b.part.status, b.is_usable, b.std_px) for b in result] == [
        ("IMG_0001_2.tif", "aligned", True, 0.2),
        ("IMG_0001_3.tif", "predicted", True, 0.7),
    ]
    np.testing.assert_allclose([(b.median_px, b.p95_px) for b in result], 0.5, atol=1e-5)


def test_a_section_replaces_what_is_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- kills -->\nold\n<!-- end of kills -->\nafter\n")
    report("kills", page, "New.", [("a", "b"), ("1|2", "3")])
    table = "| a | b |\n|---|---|\n| 1\\|2 | 3 |"
    assert page.read_text() == f"before\n<!-- kills -->\n\nNew.\n\n{table}\n\n<!-- end of kills -->\nafter\n"
    with pytest.raises(SystemExit, match="has no section"):
        report("soak", page, "text")


def test_a_watched_process_has_its_children() -> None:
    child = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(2)'])"
    run = watched([sys.executable, "-c", child])
    assert run.code == 0
    assert run.samples[:, 3].max() == 2
    assert not run.left
    assert 0 < run.largest_gb < 10  # of a child, it starts at that of this process
