"""The expected error of radiance and reflectance, from the tags to the report."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

import agalign
from agalign.cameras.tiff_directory import EXIF, GPS, XMP, add_directories, byte_string, read_directories
from agalign.values.radiometry import total_percent

from ..conftest import read_json, seeded
from ..program import agalign_here
from ..run_outputs import table_in

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")]
SIDECAR = Path("0000SET", "000", "IMG_0002.json")


def test_the_parts_of_the_error_are_in_the_sidecar_and_the_table(by_sun: Path) -> None:
    sidecar = agalign.CaptureReport("", "done", path=by_sun / SIDECAR).sidecar
    part = sidecar.output.band_radiometry[0]
    assert {e.name for e in part.errors} >= {"factory calibration", "light sensor"}
    assert part.std_percent == pytest.approx(total_percent(part.errors), abs=2e-3)
    assert [p.band for p in sidecar.output.band_radiometry] == sidecar.output.bands
    rows = [row for row in table_in(by_sun / "summary.csv") if row["capture"] == "IMG_0002"]
    assert {float(row["radiometry_std_percent"]) for row in rows} == {
        round(sidecar.output.std_percent(row["band"]), 4) for row in rows
    }


def test_a_missing_correction_is_named_on_the_screen_and_in_the_report(flight: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(flight, tmp_path / "in"))
    for path in folder.rglob("*.tif"):
        tags = read_directories(path)
        described = re.sub(rb"<Camera:Vignetting(\w+)>.*?</Camera:Vignetting\1>", b"", tags[0][XMP].data, flags=re.S)
        add_directories(path, {XMP: byte_string(described)}, tags[EXIF], tags[GPS])
    done = agalign_here(folder, "-o", tmp_path / "out", "--seed", "rig", "--only-seed", "--radiometry", "sun")
    text = " ".join(done.stderr.split())
    assert "radiance and reflectance lack a correction: the tags do not have its factor (by about 12%)" in text
    page = (tmp_path / "out" / "index.html").read_text()
    assert "radiance and reflectance lack a correction" in page
    (part, *_) = read_json(tmp_path / "out" / SIDECAR)["output"]["band_radiometry"]
    assert {"name": "vignetting", "std_percent": 12.0, "state": "missing"} in part["errors"]


def test_files_that_gdal_put_beside_a_raster_go_with_it(flight: Path, tmp_path: Path) -> None:
    """Overviews of the former pixels would be shown of the new ones."""
    agalign.align_folder(flight, tmp_path, settings=seeded())
    stack = tmp_path / "0000SET" / "000" / "IMG_0001.tif"
    with rasterio.open(stack) as source:
        before = source.read(4)
    beside = [Path(f"{stack}.ovr"), Path(f"{stack}.aux.xml")]
    others = [stack.with_name("notes.aux.xml"), stack.with_name("IMG_0001.txt")]
    for path in (*beside, *others):
        path.write_bytes(b"x")
    agalign.align_folder(flight, tmp_path, settings=seeded(radiometry="sun"))
    with rasterio.open(stack) as source:
        assert not np.array_equal(source.read(4), before)
    assert [path.exists() for path in (*beside, *others)] == [False, False, True, True]


def test_a_grid_is_not_undistorted_without_a_lens(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("red", "nir"):
        with rasterio.open(
            tmp_path / f"f_{name}.tif", "w", driver="GTiff", width=128, height=96, count=1, dtype="uint16"
        ) as file:
            file.write(rng.integers(0, 4000, (96, 128)).astype(np.uint16), 1)
    done = agalign_here(tmp_path, "-o", tmp_path / "out", "--undistort")
    assert done.returncode == 2
    assert "the lens is not known" in done.stderr
    assert "Traceback" not in done.stderr
