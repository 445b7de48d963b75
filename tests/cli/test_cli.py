"""End to end, through the same entry point as a user's."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio
import tifffile
from scipy.interpolate import CloughTocher2DInterpolator

import agalign as agalign_package

from ..conftest import read_json, save_known_model, textured_image, write_band
from ..program import agalign, agalign_here

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["IMG_0001", "IMG_0002"])
def test_a_flight_is_aligned(flight: Path, aligned_flight: Path, name: str) -> None:
    data = read_json(aligned_flight / "0000SET" / "000" / f"{name}.json")
    jsonschema.validate(data, read_json(Path(agalign_package.__file__).parent / "sidecar.schema.json"))
    assert (data["status"], data["output"]["nodata"]) == ("ok", None)
    assert [b["band"] for b in data["bands"] if b["status"] == "reference"] == ["Green"]
    assert [b["status"] for b in data["bands"]].count("aligned") == 4
    truth = read_json(flight / "truth.json")[name]["bands"]
    for band in (b for b in data["bands"] if b["status"] == "aligned"):
        ties = np.array(truth[band["file"]]["ties"])
        mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
        assert len(band["grid"]["reference_px"]) >= 17 * 13
        error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
        assert np.nanmedian(error) < 0.1
        assert band["homography"]["space"] == "undistorted"
        assert band["metrics"]["after"]["residual_px"] < 0.3


def test_the_stack_is_what_the_sidecar_says(flight: Path, aligned_flight: Path) -> None:
    folder = aligned_flight / "0000SET" / "000"
    data = read_json(folder / "IMG_0001.json")
    x0, y0, width, height = data["output"]["crop"]
    with rasterio.open(folder / data["output"]["file"]) as stack:
        assert stack.shape == (height, width)
        assert stack.descriptions == ("Blue", "Green", "Red", "NIR", "Red edge")
        assert set(stack.dtypes) == {"uint16"}
        assert stack.crs is None
        source = tifffile.imread(flight / "0000SET" / "000" / data["reference"]["file"])
        np.testing.assert_array_equal(stack.read(2), source[y0 : y0 + height, x0 : x0 + width])
        green, red = stack.read(2).astype(float), stack.read(3).astype(float)
    assert np.corrcoef(green.ravel(), red.ravel())[0, 1] > 0.75
    assert (folder / "IMG_0001.png").read_bytes()[:4] == b"\x89PNG"


@pytest.fixture
def aligned_copy(aligned_flight: Path, tmp_path: Path) -> Path:
    """An output that a test may change."""
    return shutil.copytree(aligned_flight, tmp_path / "out")


def test_summary_and_report(aligned_copy: Path) -> None:
    rows = list(csv.DictReader((aligned_copy / "summary.csv").read_text().splitlines()))
    assert [r["status"] for r in rows] == ["aligned"] * 8
    assert all(float(r["mattes_mi_after"]) < float(r["mattes_mi_before"]) for r in rows)
    before = (aligned_copy / "index.html").read_text()
    assert "8 of 8" in before
    assert '"picture":"0000SET/000/IMG_0001.png"' in before
    (aligned_copy / "index.html").unlink()
    assert agalign_here("report", aligned_copy).returncode == 0
    assert (aligned_copy / "index.html").read_text() == before


def test_report_tells_of_sidecars_it_cannot_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"schema": "agalign/1"}')
    done = agalign_here("report", tmp_path)
    assert done.returncode == 3
    assert "a.json" in done.stderr


def test_log_json_is_a_json_object_a_line(aligned_flight: Path) -> None:
    events = [json.loads(line) for line in (aligned_flight.parent / "log.jsonl").read_text().splitlines()]
    assert [e["event"] for e in events].count("pair") == 8
    assert events[-1]["event"] == "finished"


def test_a_second_run_keeps_what_is_done(flight: Path, aligned_copy: Path) -> None:
    stack = aligned_copy / "0000SET" / "000" / "IMG_0001.tif"
    before = stack.stat().st_mtime_ns
    done = agalign_here(flight, "-o", aligned_copy)
    assert done.returncode == 0
    assert "kept from an earlier run" in done.stderr
    assert stack.stat().st_mtime_ns == before


def test_one_hopeless_band_does_not_stop_the_others(flight: Path, tmp_path: Path) -> None:
    shutil.copytree(flight / "0000SET", tmp_path / "in")
    images = tmp_path / "in" / "000"
    for path in images.glob("IMG_0002_*"):
        path.unlink()
    for index, pixels in (
        (1, np.full((360, 480), 5000)),
        (3, np.random.default_rng(0).integers(5000, 50000, (360, 480))),
    ):
        path = images / f"IMG_0001_{index}.tif"
        with tifffile.TiffFile(path) as tiff:
            offset = tiff.pages[0].dataoffsets[0]
        with path.open("r+b") as file:
            file.seek(offset)
            file.write(pixels.astype("<u2").tobytes())
    done = agalign_here(tmp_path / "in", "-o", tmp_path / "out", "--relief", "never")
    assert done.returncode == 3
    data = read_json(tmp_path / "out" / "000" / "IMG_0001.json")
    status = {b["band"]: b["status"] for b in data["bands"]}
    assert data["status"] == "degraded"
    assert status["Blue"] in ("failed", "seed_only")
    assert status["Red"] in ("failed", "seed_only")
    assert status["NIR"] == status["Red edge"] == "aligned"
    assert "IMG_0001 Blue" in done.stderr
    with rasterio.open(tmp_path / "out" / "000" / "IMG_0001.tif") as stack:
        assert stack.count == 5
        for index, name in enumerate(stack.descriptions, start=1):
            assert stack.read_masks(index).any() == (status[name] != "failed")


def write_pair(folder: Path, seed_of_nir: int = 1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in (("a_green", textured_image(300, 240, 1)), ("a_nir", -textured_image(300, 240, seed_of_nir))):
        tifffile.imwrite(folder / f"{name}.tif", (image * 4000 + 20000).astype(np.uint16))


@pytest.mark.parametrize(
    ("seed_of_nir", "options", "message"),
    [
        pytest.param(2, ["--relief", "never"], "a nir: ", marks=pytest.mark.full),
        (1, ["--seed", "rig"], "this band has no rig seed; omit --seed"),
    ],
)
def test_bands_that_cannot_be_aligned_exit_with_3(
    tmp_path: Path, seed_of_nir: int, options: list[str], message: str
) -> None:
    write_pair(tmp_path / "in", seed_of_nir)
    done = agalign_here(tmp_path / "in", "-o", tmp_path / "out", *options)
    assert done.returncode == 3
    assert message in done.stderr
    assert read_json(tmp_path / "out" / "a.json")["status"] == "failed"


def test_an_input_is_never_overwritten(tmp_path: Path) -> None:
    write_pair(tmp_path)
    before = (tmp_path / "a_nir.tif").read_bytes()
    done = agalign_here(tmp_path, "-o", tmp_path)
    assert done.returncode == 2
    assert "is the folder of the images" in done.stderr
    assert (tmp_path / "a_nir.tif").read_bytes() == before


def test_a_repaired_input_and_a_damaged_output_are_done_again(tmp_path: Path) -> None:
    write_pair(tmp_path / "in")
    good = (tmp_path / "in" / "a_nir.tif").read_bytes()
    (tmp_path / "in" / "a_nir.tif").write_bytes(good[: len(good) // 2])
    first = agalign_here(tmp_path / "in", "-o", tmp_path / "out", "--log-json")
    assert first.returncode == 3
    problems = [json.loads(line) for line in first.stderr.splitlines()]
    assert any("a_nir.tif" in p.get("message", "") for p in problems)
    assert not (tmp_path / "out" / "a.tif").exists()
    (tmp_path / "in" / "a_nir.tif").write_bytes(good)
    assert agalign_here(tmp_path / "in", "-o", tmp_path / "out").returncode == 0
    stack = tmp_path / "out" / "a.tif"
    size = stack.stat().st_size
    stack.write_bytes(b"")
    again = agalign_here(tmp_path / "in", "-o", tmp_path / "out")
    assert again.returncode == 0
    assert "kept" not in again.stderr
    assert stack.stat().st_size == size


def limited(limit: str, value: int) -> Callable[[], None]:
    """For a new process: set a limit of its resources."""
    resource = pytest.importorskip("resource", reason="limits of resources are POSIX")

    def set_limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(getattr(resource, limit), (value, value))

    return set_limit


def test_a_full_disk_is_said_and_leaves_no_half_file(tmp_path: Path) -> None:
    write_pair(tmp_path / "in")
    done = agalign(tmp_path / "in", "-o", tmp_path / "out", preexec_fn=limited("RLIMIT_FSIZE", 60_000))
    assert done.returncode == 1
    assert "cannot be written" in done.stderr
    assert not (tmp_path / "out" / "a.tif").exists()
    assert not list((tmp_path / "out").glob(".*"))


def test_too_little_address_space_is_refused_before_libraries_are_loaded(tmp_path: Path) -> None:
    done = agalign(tmp_path, "-o", tmp_path / "out", preexec_fn=limited("RLIMIT_AS", 1_200_000_000))
    assert done.returncode == 1
    assert done.stderr.startswith("agalign: the address space of this process is limited to 1.20 GB")


def test_info(flight: Path) -> None:
    done = agalign_here("info", flight, "--json")
    assert done.returncode == 0
    data = json.loads(done.stdout)
    assert [c["label"] for c in data["captures"]] == ["0000SET/000/IMG_0001", "0000SET/000/IMG_0002"]
    assert data["captures"][0]["seeds"] == ["rig", "structure", "identity"]
    assert [b["name"] for b in data["captures"][0]["bands"] if b["reference"]] == ["Green"]
    table = agalign_here("info", flight)
    assert "IMG_0002" in table.stdout
    assert "[Green]" in table.stdout


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
    table = agalign_here("info", path).stdout
    assert "[Red]" in table
    assert "+9.4, +6.0" in table
    save_known_model(path, has_rig=False)
    assert "no rig" in agalign_here("info", path).stdout


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["nowhere"], 1, "nowhere"),
        (["info", "nowhere"], 1, "nowhere"),
        (["report", "nowhere"], 1, "nowhere"),
        (["export", "nowhere", "--for", "odm"], 1, "nowhere: no sidecars there"),
        (["export", "nowhere", "--for", "excel"], 2, "excel"),
        (["align", "{flight}", "-o", "{tmp}/o", "--reference", "SWIR"], 2, "SWIR"),
        (["align", "{flight}", "-o", "{tmp}/o", "--device", "abacus"], 2, "abacus"),
        (["align", "{flight}", "-o", "{tmp}/o", "--device", "cuda:99"], 2, "device 'cuda:99' cannot be used"),
        (["align", "{flight}", "--dry-run", "--device", "cuda:99"], 2, "device 'cuda:99' cannot be used"),
        (["align", "{flight}", "-o", "{tmp}/o", "--pattern", "x"], 2, "pattern"),
        (["align", "{flight}", "-o", "{tmp}/file"], 1, "file"),
        (["ndvi", "nowhere"], 1, "nowhere"),
        (["ndiv", "{tmp}"], 2, "did you mean 'ndvi'"),
        (["info", "broken.safetensors"], 1, "broken.safetensors"),
        (["align"], 2, "folder"),
    ],
)
def test_bad_input_is_one_clear_line(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, word: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    monkeypatch.chdir(tmp_path)
    done = agalign_here(*(a.format(flight=flight, tmp=tmp_path) for a in arguments))
    assert done.returncode == code
    assert word in done.stderr
    assert "Traceback" not in done.stderr
    if code == 1:
        assert len([line for line in done.stderr.splitlines() if line.startswith("agalign: ")]) == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(("option", "text"), [("--help", "FOLDER"), ("--version", "agalign ")])
def test_help_and_version(option: str, text: str) -> None:
    assert text in agalign(option).stdout


def test_help_imports_nothing_that_is_slow_to_load() -> None:
    code = """
import sys
slow = {"torch", "rasterio", "numpy", "pydantic", "rich.console", "typer.rich_utils", "importlib.metadata"}
sys.argv = ["agalign", "--help"]
from agalign.cli.main import main
try:
    main()
except SystemExit:
    print(slow & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("set()")


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX here")
def test_an_interrupted_run_goes_on_where_it_was(flight: Path, model_path: Path, tmp_path: Path) -> None:
    arguments = [str(flight), "-o", str(tmp_path / "out"), "--jobs", "1", "--model", str(model_path)]
    first = tmp_path / "out" / "0000SET" / "000" / "IMG_0001.json"
    command = [sys.executable, "-m", "agalign", *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not first.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert first.exists()
    assert not list((tmp_path / "out").rglob(".*"))
    assert not (first.parent / "IMG_0002.json").exists()
    done = agalign_here(*arguments)
    assert done.returncode == 0
    assert "IMG_0001: 4 of 4 aligned" in done.stderr
    assert done.stderr.count("kept from an earlier run") == 1


def test_seeds_alone_are_no_alignment(flight: Path, tmp_path: Path) -> None:
    done = agalign_here(flight, "-o", tmp_path, "--only-seed", "--bands", "green,red,blue", "--layout", "bands")
    assert done.returncode == 3, done.stderr
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
