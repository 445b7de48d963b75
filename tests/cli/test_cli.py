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
from agalign.cameras.discover import FolderScan
from agalign.cli.main import COMMANDS
from agalign.config import Settings
from agalign.flight.learn_rig import learn_rig
from agalign.flight.model import FlightModel, save_model
from agalign.flight.rig import Observation, Rig
from agalign.method.descriptor import Descriptor
from agalign.values.geometry import translation

from ..conftest import textured_image
from ..program import agalign, agalign_here

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]


@pytest.fixture(scope="module")
def aligned(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    out = tmp_path_factory.mktemp("out with spaces é")
    return out, agalign(flight, "-o", out, "--log-json")


def test_a_flight_is_aligned(flight: Path, aligned: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, done = aligned
    assert done.returncode == 0, done.stderr
    schema = json.loads((Path(agalign_package.__file__).parent / "sidecar.schema.json").read_text())
    truth = json.loads((flight / "truth.json").read_text())
    for name in ("IMG_0001", "IMG_0002"):
        data = json.loads((out / "0000SET" / "000" / f"{name}.json").read_text())
        jsonschema.validate(data, schema)
        assert data["status"] == "ok"
        assert data["output"]["nodata"] is None
        assert len(data["bands"]) == 5
        for band in data["bands"]:
            if band["status"] == "reference":
                assert band["band"] == "Green"
                continue
            assert band["status"] == "aligned"
            ties = np.array(truth[name]["bands"][band["file"]]["ties"])
            mapping = CloughTocher2DInterpolator(band["grid"]["reference_px"], band["grid"]["moving_px"])
            assert len(band["grid"]["reference_px"]) >= 17 * 13
            error = np.linalg.norm(mapping(ties[:, :2]) - ties[:, 2:], axis=1)
            assert np.nanmedian(error) < 0.1
            assert band["homography"]["space"] == "undistorted"
            assert band["metrics"]["after"]["residual_px"] < 0.3


def test_the_stack_is_what_the_sidecar_says(
    flight: Path, aligned: tuple[Path, subprocess.CompletedProcess[str]]
) -> None:
    out, _ = aligned
    data = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    x0, y0, width, height = data["output"]["crop"]
    with rasterio.open(out / "0000SET" / "000" / data["output"]["file"]) as stack:
        assert stack.shape == (height, width)
        assert stack.descriptions == ("Blue", "Green", "Red", "NIR", "Red edge")
        assert set(stack.dtypes) == {"uint16"}
        assert stack.crs is None
        source = tifffile.imread(flight / "0000SET" / "000" / data["reference"]["file"])
        np.testing.assert_array_equal(stack.read(2), source[y0 : y0 + height, x0 : x0 + width])
        green, red = stack.read(2).astype(float), stack.read(3).astype(float)
    assert np.corrcoef(green.ravel(), red.ravel())[0, 1] > 0.75
    picture = out / "0000SET" / "000" / "IMG_0001.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_summary_and_report(aligned: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, _ = aligned
    rows = list(csv.DictReader((out / "summary.csv").read_text().splitlines()))
    assert len(rows) == 8
    assert {r["status"] for r in rows} == {"aligned"}
    assert all(float(r["mattes_mi_after"]) < float(r["mattes_mi_before"]) for r in rows)
    page = (out / "index.html").read_text()
    assert "8 of 8" in page
    assert '"picture":"0000SET/000/IMG_0001.png"' in page
    before = page
    (out / "index.html").unlink()
    done = agalign_here("report", out)
    assert done.returncode == 0
    assert (out / "index.html").read_text() == before


def test_report_tells_of_sidecars_it_cannot_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"schema": "agalign/1"}')
    done = agalign_here("report", tmp_path)
    assert done.returncode == 3
    assert "a.json" in done.stderr


def test_log_json_is_a_json_object_a_line(aligned: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    _, done = aligned
    events = [json.loads(line) for line in done.stderr.splitlines()]
    assert [e["event"] for e in events].count("pair") == 8
    assert events[-1]["event"] == "finished"
    assert done.stdout == ""


def test_a_second_run_keeps_what_is_done(flight: Path, aligned: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, _ = aligned
    stack = out / "0000SET" / "000" / "IMG_0001.tif"
    before = stack.stat().st_mtime_ns
    done = agalign_here(flight, "-o", out)
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
    done = agalign_here(tmp_path / "in", "-o", tmp_path / "out")
    assert done.returncode == 3
    data = json.loads((tmp_path / "out" / "000" / "IMG_0001.json").read_text())
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


def test_unrelated_bands_exit_with_3(tmp_path: Path) -> None:
    for name, seed in (("a_red", 1), ("a_nir", 2)):
        pixels = (textured_image(300, 240, seed) * 4000 + 20000).astype(np.uint16)
        tifffile.imwrite(tmp_path / f"{name}.tif", pixels)
    done = agalign_here(tmp_path, "-o", tmp_path / "out")
    assert done.returncode == 3
    assert json.loads((tmp_path / "out" / "a.json").read_text())["status"] == "failed"


def write_pair(folder: Path, seed: int = 1, second: int | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    fixed = textured_image(300, 240, seed)
    moving = fixed if second is None else textured_image(300, 240, second)
    for name, image in (("a_green", fixed), ("a_nir", -moving)):
        tifffile.imwrite(folder / f"{name}.tif", (image * 4000 + 20000).astype(np.uint16))


def test_an_input_is_never_overwritten(tmp_path: Path) -> None:
    pixels = np.stack([textured_image(300, 240), textured_image(300, 240)])
    tifffile.imwrite(tmp_path / "ortho.tif", pixels, planarconfig="separate", photometric="minisblack")
    before = (tmp_path / "ortho.tif").read_bytes()
    done = agalign_here(tmp_path, "-o", tmp_path)
    assert done.returncode == 2
    assert "is the folder of the images" in done.stderr
    assert (tmp_path / "ortho.tif").read_bytes() == before


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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="file size limits are POSIX")
def test_a_full_disk_is_said_and_leaves_no_half_file(tmp_path: Path) -> None:
    import resource

    write_pair(tmp_path / "in")

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    done = agalign(tmp_path / "in", "-o", tmp_path / "out", preexec_fn=limit)
    assert done.returncode == 1
    assert "cannot be written" in done.stderr
    assert not (tmp_path / "out" / "a.tif").exists()
    assert not list((tmp_path / "out").glob(".*"))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of the address space are POSIX")
def test_too_little_address_space_is_refused_before_libraries_are_loaded(tmp_path: Path) -> None:
    import resource

    write_pair(tmp_path / "in")
    limits = 1_200_000_000, 1_200_000_000
    done = agalign(
        tmp_path / "in", "-o", tmp_path / "out", preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, limits)
    )
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


@pytest.fixture
def model_file(tmp_path: Path) -> Callable[[Rig | None], Path]:
    def save(rig: Rig | None) -> Path:
        net = Descriptor("pseudo-siamese", (1, 1, 1), half_rectified=True, unit_length=True)
        path = tmp_path / "model.safetensors"
        save_model(FlightModel(net, "Camera 7", ("NIR", "[Red]"), {}, "", rig), path)
        return path

    return save


def test_info_shows_the_rig_of_a_model(model_file: Callable[[Rig | None], Path]) -> None:
    captures = []
    for k, height in enumerate((-2.0, 0.5, 3.0, 6.0)):
        mappings = {"NIR": translation(8 + 0.8 * height, 6), "[Red]": translation(-3, 4 + 0.6 * height)}
        captures.append(Observation(float(k), mappings, dict.fromkeys(mappings, 0.05)))
    path = model_file(learn_rig(captures, (640, 480), {}))
    rig = json.loads(agalign_here("info", path, "--json").stdout)["rig"]
    nir, red = rig["bands"]
    assert (rig["captures"], rig["factors"]) == (4, ["distance"])
    assert nir["offset_px"] == pytest.approx([8 + 0.8 * 1.75, 6], abs=0.1)
    assert np.abs(nir["baseline"]) == pytest.approx([0.8, 0], abs=0.02)
    assert np.abs(red["baseline"]) == pytest.approx([0, 0.6], abs=0.02)
    assert nir["from_bands_px"] < 0.5 < nir["from_flight_px"]
    assert nir["field_px"] is None
    table = agalign_here("info", path).stdout
    assert "[Red]" in table
    assert "+9.4, +6.0" in table


def test_info_of_a_model_without_a_rig(model_file: Callable[[Rig | None], Path]) -> None:
    done = agalign_here("info", model_file(None))
    assert done.returncode == 0
    assert "no rig" in done.stdout


def test_info_of_what_is_no_model_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "broken.safetensors"
    path.write_bytes(b"nothing")
    done = agalign_here("info", path)
    assert done.returncode == 1
    assert str(path) in done.stderr.replace("\n", "")
    assert "Traceback" not in done.stderr


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
        (["align", "{flight}", "--seed", "luck"], 2, "luck"),
        (["align"], 2, "folder"),
    ],
)
def test_bad_input_is_one_clear_line(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, word: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    done = agalign_here(*(a.format(flight=flight, tmp=tmp_path) for a in arguments))
    assert done.returncode == code
    assert word in done.stderr
    if code == 1:
        assert len([line for line in done.stderr.splitlines() if line.startswith("agalign: ")]) == 1
    assert not (tmp_path / "o").exists()


def test_help_and_version() -> None:
    assert "FOLDER" in agalign("--help").stdout
    assert agalign("--version").stdout.startswith("agalign ")


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
def test_an_interrupted_run_goes_on_where_it_was(flight: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "agalign", str(flight), "-o", str(tmp_path / "out"), "--jobs", "1"]
    first = tmp_path / "out" / "0000SET" / "000" / "IMG_0001.json"
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
    done = agalign_here(flight, "-o", tmp_path / "out")
    assert done.returncode == 0
    assert "IMG_0001: 4 of 4 aligned" in done.stderr
    assert done.stderr.count("kept from an earlier run") == 1


def test_indices_of_a_run(aligned: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, _ = aligned
    done = agalign_here("ndvi", out, "--index", "ndvi,GNDVI")
    assert done.returncode == 0, done.stderr
    assert "4 of 4 written" in done.stdout
    assert "raw numbers, not reflectance" in done.stderr
    assert len(list(out.rglob("*_gndvi.tif"))) == len(list(out.rglob("*_ndvi.png"))) == 2
    misspelt = agalign_here("ndiv", out)
    assert (misspelt.returncode, "did you mean 'ndvi'" in misspelt.stderr) == (2, True)
    assert agalign_here("ndvi", out, "--index", "xyz").returncode == 2
    assert agalign_here("ndvi", out, "--index", "savi").returncode == 1
    assert agalign_here("ndvi", out / "nowhere").returncode == 1


def test_seeds_alone_are_no_alignment(flight: Path, tmp_path: Path) -> None:
    done = agalign_here(flight, "-o", tmp_path, "--only-seed", "--bands", "green,red,blue", "--layout", "bands")
    assert done.returncode == 3, done.stderr
    data = json.loads((tmp_path / "0000SET" / "000" / "IMG_0001.json").read_text())
    assert [b["band"] for b in data["bands"]] == ["Blue", "Green", "Red"]
    assert {b["status"] for b in data["bands"]} == {"reference", "seed_only"}
    assert data["output"]["file"] is None
    assert data["bands"][2]["place"] == {"file": "IMG_0001_3.tif", "band_index": 1}
    assert not (tmp_path / "models").exists()
    assert (tmp_path / "0000SET" / "000" / "IMG_0001.png").is_file()


def test_info_is_json_whatever_the_nodata(tmp_path: Path) -> None:
    for name in ("red", "nir"):
        profile = {"driver": "GTiff", "width": 80, "height": 60, "count": 1, "dtype": "float32", "nodata": np.nan}
        (tmp_path / "in").mkdir(exist_ok=True)
        with rasterio.open(tmp_path / "in" / f"field_{name}.tif", "w", **profile) as dataset:
            dataset.write(textured_image(80, 60)[None])

    def no_constant(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    result = json.loads(agalign_here("info", tmp_path / "in", "--json").stdout, parse_constant=no_constant)
    assert [b["nodata"] for b in result["captures"][0]["bands"]] == ["nan", "nan"]


def test_a_seed_that_there_is_not_is_told(tmp_path: Path) -> None:
    write_pair(tmp_path / "in")
    done = agalign_here(tmp_path / "in", "-o", tmp_path / "out", "--seed", "rig")
    assert done.returncode == 3
    assert "this band has no rig seed; omit --seed" in done.stderr


def test_wrong_words_are_usage_errors(flight: Path, tmp_path: Path) -> None:
    for options in (("--layout", "pile"), ("--order", "size"), ("--seed", "luck"), ("--compression", "lzma")):
        done = agalign_here(flight, "-o", tmp_path, *options)
        assert done.returncode == 2
        assert "is unknown; choose from" in done.stderr


@pytest.mark.parametrize("command", ["align", "onto"])
@pytest.mark.parametrize(
    ("arguments", "use"),
    [
        (["--relief"], "always"), (["--relief", "never"], "never"), (["--relief", "-q"], "always"), ([], "auto"),
        (["--local"], "always"), (["--local", "never"], "never"), (["--local", "-q"], "always"),
        (["--local=never"], "never"), (["--local=always", "-q"], "always"), (["--relief=never"], "never"),
    ],
)  # fmt: skip
def test_relief_alone_is_always_and_local_is_its_old_name(
    command: str, arguments: list[str], use: str, capsys: pytest.CaptureFixture[str]
) -> None:
    images = ["flight"] if command == "align" else ["a.tif", "b.tif"]
    context = COMMANDS[command].built(command).make_context(command, [*images, *arguments])
    assert context.params["relief"] == use
    was_old = any(a.startswith("--local") for a in arguments)
    assert ("--local is deprecated; use --relief" in capsys.readouterr().err) == was_old


@pytest.mark.parametrize(("arguments", "chosen"), [
    (["--local"], ("always", False, False)), (["--local=never"], ("never", False, False)), ([], ("auto", False, False)),
    (["--relief", "--relief-map", "--fill-occluded"], ("always", True, True)),
])  # fmt: skip
def test_options_of_relief_become_settings(
    arguments: list[str], chosen: tuple[str, bool, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agalign.cli import main
    from agalign.cli import run as cli_run

    seen: list[Settings] = []

    def run(_flight: object, _out: Path, settings: Settings, *_: object, **__: object) -> None:
        seen.append(settings)
        raise SystemExit(0)

    monkeypatch.setattr(cli_run, "run", run)
    monkeypatch.setattr(cli_run, "find_captures", lambda folder, *_: FolderScan(folder, (), ()))
    monkeypatch.setattr(cli_run, "load_ahead", lambda: None)
    monkeypatch.setattr(sys, "argv", ["agalign", str(tmp_path), *arguments])
    with pytest.raises(SystemExit):
        main.main()
    (settings,) = seen
    assert (settings.relief.use, settings.write.relief_map, settings.write.fill_occluded) == chosen
