"""Products of several captures when one of them differs: its light sensor failed, or it lacks a band."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from synthetic_flights.aligned import list_stack, make_aligned

import agalign
from agalign.exports.programs import export
from agalign.rasters.geotiff import to_cog
from agalign.records.captures import differing_from_most
from agalign.records.sidecar_file import find_sidecars

from ..conftest import Shared, read_json
from ..program import agalign_here
from ..run_outputs import change

FIRST = "0000SET/IMG_0001"
REASON = "it has radiance, and 8 of 9 captures have reflectance"


@pytest.fixture(scope="module")
def run(shared: Shared) -> Path:
    """Nine captures; the first is radiance. Their stacks count as files of bands."""

    def fill(folder: Path) -> None:
        make_aligned(folder, 9)
        with rasterio.open(folder / f"{FIRST}.tif", "r+") as stack:
            stack.update_tags(RADIOMETRY="radiance")
            for index in stack.indexes:
                stack.update_tags(index, QUANTITY="radiance")
        for path in find_sidecars(folder):
            list_stack(path)
            (stack,) = read_json(path)["products"]
            change(path, products=[stack, stack | {"kind": "band"}])

    return shared("mixed", fill)


def test_an_export_is_of_one_quantity(run: Path, tmp_path: Path) -> None:
    report = export(run, tmp_path / "odm", "odm")
    assert (report.left_out, len(report.files)) == ([(FIRST, REASON)], 8)
    assert "The files contain reflectance by light sensor: OpenDroneMap must not" in report.notes[-1]


def test_a_flight_has_one_unit(run: Path) -> None:
    with pytest.warns(UserWarning, match=f"{FIRST}: left out: {REASON}"):
        flight = agalign.open_flight(run)
    assert FIRST not in flight.capture
    assert flight.sizes["capture"] == 8
    assert float(flight.NIR.max()) < 2


def test_medians_of_an_index_are_of_one_unit(run: Path, tmp_path: Path) -> None:
    done = agalign_here("indices", run, "-o", tmp_path)
    assert f"{FIRST} ndvi: not in the medians of captures: {REASON}" in " ".join(done.stderr.split())
    (row,) = [line for line in done.stdout.splitlines() if " ndvi " in line]
    assert row.split("│")[2].strip() == "8"


def test_the_exception_is_what_differs_from_most(run: Path, tmp_path: Path) -> None:
    """A band that the first capture lacks is not taken from the others; a file that cannot be read is named."""
    out = shutil.copytree(run, tmp_path / "out")
    (out / f"{FIRST}.tif").unlink()
    second = out / "0000SET" / "IMG_0002.json"
    change(
        second, bands=[part | ({"place": None} if part["band"] == "NIR" else {}) for part in read_json(second)["bands"]]
    )
    with pytest.warns(UserWarning, match="IMG_0002: left out: it has bands Green") as warned:
        flight = agalign.open_flight(out)
    assert f"{FIRST}.tif: cannot be read (No such file or directory); run again" in str(warned[0].message)
    assert (flight.sizes["capture"], "NIR" in flight) == (7, True)
    assert differing_from_most({}) == []


def test_a_killed_export_does_not_block_its_repeat(run: Path, tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from agalign.exports.programs import export\n"
        "real, done = os.link, []\n"
        "def link(*names):\n"
        "    real(*names); done.append(1)\n"
        "    if len(done) == 7: os.kill(os.getpid(), signal.SIGKILL)\n"
        "os.link = link\n"
        "export(Path(sys.argv[1]), Path(sys.argv[2]), 'pix4d')"
    )
    killed = subprocess.run([sys.executable, "-c", code, run, tmp_path / "to"], check=False, timeout=120)
    assert killed.returncode == -signal.SIGKILL
    assert os.listdir(tmp_path / "to")
    report = export(run, tmp_path / "to", "pix4d")
    assert sorted(p.name for p in (tmp_path / "to").iterdir()) == ["README.txt", "images"]
    assert all(path.is_file() for path in report.files)


def test_indices_of_cogs_are_cogs(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)
    path = tmp_path / "0000SET" / "IMG_0001.tif"
    to_cog(path)
    list_stack(path.with_suffix(".json"))
    assert agalign_here("indices", tmp_path).returncode == 0
    with rasterio.open(path.with_name("IMG_0001_ndvi.tif")) as index:
        assert index.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert np.isfinite(index.read(1)).all()
