"""End to end, through the same entry point as a user's."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
from scipy.interpolate import CloughTocher2DInterpolator

from agalign.records.sidecar import Sidecar

from ..conftest import read_json, save_known_model, textured_image, write_band, write_capture
from ..program import agalign_here

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["IMG_0001", "IMG_0002"])
def test_a_flight_is_aligned(flight: Path, aligned_flight: Path, name: str) -> None:
    data = read_json(aligned_flight / "0000SET" / "000" / f"{name}.json")
    jsonschema.validate(data, Sidecar.json_schema())
    assert (data["status"], data["output"]["nodata"]) == ("ok", None)
    assert [b["band"] for b in data["bands"] if b["status"] == "reference"] == ["Green"]
    assert [b["status"] for b in data["bands"]].count("aligned") == 4
    truth = read_json(flight / "truth.json")[name]["bands"]
    for band in (b for b in data["bands"] if b["status"] == "aligned"):
        ties = np.array(truth[Path(band["file"]).name]["ties"])
        mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
        assert len(band["grid"]["reference_px"]) >= 17 * 13
        error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
        assert np.nanmedian(error) < 0.1
        assert band["homography"]["space"] == "undistorted"
        assert band["metrics"]["after"]["residual_px"] < 0.3


@pytest.fixture
def aligned_copy(aligned_flight: Path, tmp_path: Path) -> Path:
    """An output that a test may change."""
    return shutil.copytree(aligned_flight, tmp_path / "out")


def test_summary_report_and_log(aligned_flight: Path, aligned_copy: Path) -> None:
    """The command `report` writes the page of the run again; all have the time of a capture."""
    rows = list(csv.DictReader((aligned_copy / "summary.csv").read_text().splitlines()))
    assert [r["status"] for r in rows] == ["aligned"] * 8
    assert all(float(r["mattes_mi_after"]) < float(r["mattes_mi_before"]) for r in rows)
    before = (aligned_copy / "index.html").read_text()
    assert "Every band of every capture is aligned." in before
    assert '"picture":"0000SET/000/IMG_0001.png"' in before
    (aligned_copy / "index.html").unlink()
    done = agalign_here("report", aligned_copy, "--json")
    assert done.returncode == 0
    assert (aligned_copy / "index.html").read_text() == before
    events = [json.loads(line) for line in (aligned_flight.parent / "log.jsonl").read_text().splitlines()]
    assert [e["event"] for e in events].count("pair") == 8
    assert events[-1]["event"] == "finished"
    reported = json.loads(done.stdout)["captures"]
    seconds = {e["capture"]: e["seconds"] for e in events if e["event"] == "capture"}
    assert {c["label"] for c in reported} == set(seconds)
    assert len(seconds) == 2
    # A sidecar's time includes the bands one after another, and ends before the sidecar is written.
    assert all(sum(b["seconds"] for b in c["bands"]) < c["seconds"] <= seconds[c["label"]] for c in reported)


def test_a_blank_input_and_a_damaged_output_are_done_again_when_they_are_repaired(tmp_path: Path) -> None:
    """The blank band does not stop the other one."""
    write_capture(tmp_path / "in", "green", "red", "nir", name="a")
    nir, stack = tmp_path / "in" / "a_nir.tif", tmp_path / "out" / "a.tif"
    command, good = (nir.parent, "-o", stack.parent, "--relief", "never"), nir.read_bytes()
    write_band(nir, np.full((240, 300), 5000, np.uint16))
    first = agalign_here(*command)
    assert first.returncode == 3
    assert "a nir: failed: the moving band is constant or all invalid" in first.stderr
    bands = read_json(stack.with_suffix(".json"))["bands"]
    assert {b["band"]: b["status"] for b in bands} == {"green": "reference", "red": "aligned", "nir": "failed"}
    with rasterio.open(stack) as written:
        has_pixels = {n: written.read_masks(i).any() for i, n in enumerate(written.descriptions, start=1)}
    assert has_pixels == {"green": True, "red": True, "nir": False}
    nir.write_bytes(good)
    assert agalign_here(*command).returncode == 0
    size = stack.stat().st_size
    stack.write_bytes(b"")
    again = agalign_here(*command)
    assert again.returncode == 0
    assert "kept" not in again.stderr
    assert stack.stat().st_size == size


def test_info_shows_the_rig_of_a_model(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_known_model(path)
    rig = json.loads(agalign_here("info", path, "--json").stdout)["rig"]
    nir, red = rig["bands"]
    assert (rig["captures"], rig["factors"]) == (4, ["distance"])
    assert nir["offset_px"] == pytest.approx([8 + 0.8 * 1.75, 6], abs=0.1)
    assert np.abs([*nir["baseline"], *red["baseline"]]) == pytest.approx([0.8, 0, 0, 0.6], abs=0.02)
    assert nir["from_bands_px"] < 0.5 < nir["from_flight_px"]
    assert nir["field_px"] is None
    assert nir["pixel_size_px"] == pytest.approx(1, abs=0.01)
    table = agalign_here("info", path).stdout
    assert "[Red]" in table
    assert "+9.4, +6.0" in table
    assert "error of its prediction (RMS, px of the band)" in table
    save_known_model(path, has_rig=False)
    assert "no rig" in agalign_here("info", path).stdout


@pytest.mark.slow
def test_info_tells_the_flights_of_models_apart(model_path: Path) -> None:
    lines = agalign_here("info", model_path).stdout.splitlines()
    assert "flight: 2026-06-21 10:00:01 to 2026-06-21 10:00:02, in the folder 0000SET/000 of its input" in lines
    facts = json.loads(agalign_here("info", model_path, "--json").stdout)
    assert (facts["folder"], len(facts["captured_at"])) == ("0000SET/000", 2)


def test_the_names_of_the_package_and_the_help_import_nothing_that_is_slow_to_load() -> None:
    code = """
import agalign, sys
slow = {"cv2", "numpy", "pydantic", "rasterio", "scipy", "torch", "rich.console", "typer.rich_utils"}
slow |= {"importlib.metadata"}
dir(agalign)
sys.argv = ["agalign", "--help"]
from agalign.cli.main import main
try:
    main()
except SystemExit:
    print(slow & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("set()")


def test_seeds_alone_are_no_alignment(flight: Path, tmp_path: Path) -> None:
    done = agalign_here(flight, "-o", tmp_path, "--only-seed", "--bands", "green,red,blue", "--layout", "bands")
    assert done.returncode == 3, done.stderr
    assert "only the seed was requested" in done.stderr
    data = read_json(tmp_path / "0000SET" / "000" / "IMG_0001.json")
    assert [b["band"] for b in data["bands"]] == ["Blue", "Green", "Red"]
    assert {b["status"] for b in data["bands"]} == {"reference", "seed_only"}
    assert data["output"]["file"] is None
    assert data["bands"][2]["place"] == {"file": "IMG_0001_3.tif", "band_index": 1}
    assert not (tmp_path / "models").exists()
    assert (tmp_path / "0000SET" / "000" / "IMG_0001.png").is_file()


def test_info_is_json_whatever_the_nodata(tmp_path: Path) -> None:
    for name in ("red", "nir"):
        write_band(tmp_path / f"field_{name}.tif", textured_image(80, 60), nodata=np.nan)
    result = json.loads(agalign_here("info", tmp_path, "--json").stdout, parse_constant=pytest.fail)
    assert [b["nodata"] for b in result["captures"][0]["bands"]] == ["nan", "nan"]
