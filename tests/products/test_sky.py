"""A capture of the sky in a flight, start to end."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

import agalign
from agalign.batch import RunOptions
from agalign.config import SeedSettings, Settings
from agalign.errors import SidecarError
from agalign.products.panels import SKY_FILE, read_sky
from agalign.products.report import write_pages

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
ONLY_SEED = Settings(seed=SeedSettings(only=True))


@pytest.fixture
def with_sky(flight: Path, tmp_path: Path) -> Path:
    """One capture of a scene, and one of the sky."""
    folder = tmp_path / "flight"
    (folder / "sky").mkdir(parents=True)
    for path in sorted(flight.rglob("IMG_0001_*.tif")):
        shutil.copy(path, folder)
    glow = np.linspace(30000, 40000, 60).astype(np.uint16)
    for band in ("Blue", "Green", "NIR"):
        tifffile.imwrite(folder / "sky" / f"S1_{band}.tif", np.tile(glow, (48, 1)))
    return folder


@pytest.mark.slow
def test_the_sky_is_left_out_and_named(with_sky: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    reports = agalign.align_folder(with_sky, out, settings=ONLY_SEED)
    assert {r.label: r.state for r in reports} == {"sky/S1": "sky", "IMG_0001": "done"}
    assert next(r for r in reports if r.state == "sky").good
    (part,) = read_sky(out)
    assert (part.folder, part.capture, [b.band for b in part.bands]) == ("sky", "S1", ["Blue", "Green", "NIR"])
    assert part.cues == ["its folder or name contains 'sky'", "no band has texture"]
    assert not list(out.rglob("S1*"))
    table = csv.DictReader((out / "summary.csv").read_text().splitlines())
    rows = [r for r in table if r["status"] == "sky"]
    assert [(r["folder"], r["capture"], r["band"]) for r in rows] == [("sky", "S1", b.band) for b in part.bands]
    assert "Sky captures" in (out / "index.html").read_text()
    assert json.loads((out / "agalign-run.json").read_text())["captures"] == {"found": 2, "sky": 1, "done": 1}
    # Aligned like any other where the user wants it, and no record of the earlier run is left.
    again = agalign.align_folder(with_sky, out, settings=ONLY_SEED, run=RunOptions(align_panels=True))
    assert {r.label: r.state for r in again} == {"sky/S1": "done", "IMG_0001": "kept"}
    assert not (out / SKY_FILE).exists()


@pytest.mark.slow
def test_info_names_the_sky(with_sky: Path) -> None:
    command = [sys.executable, "-m", "agalign", "info", str(with_sky)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("sky/S1: "))
    assert line == "sky/S1: shows the sky (its folder or name contains 'sky', no band has texture); not aligned"
    rows = json.loads(subprocess.run([*command, "--json"], capture_output=True, text=True, check=False).stdout)
    assert {row["label"]: bool(row["sky"]) for row in rows["captures"]} == {"IMG_0001": False, "sky/S1": True}


def test_a_damaged_record_is_one_line(tmp_path: Path) -> None:
    (tmp_path / SKY_FILE).write_text('{"schema": "agalign-sky/1"')
    with pytest.raises(SidecarError, match=r"sky\.json: cannot be read; run again"):
        read_sky(tmp_path)
    problems: list[str] = []
    write_pages(tmp_path, problems.append)
    assert len(problems) == 1
