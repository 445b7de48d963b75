"""Every example runs as it stands, on a synthetic flight."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio

import agalign

from .blocks import ROOT

pytestmark = pytest.mark.slow


def run(name: str, *arguments: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)], capture_output=True, text=True,
        check=False, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def aligned(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("examples") / "aligned"
    agalign.align_folder(desk / "flight", out)
    return out


def test_every_example_is_tested() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    examples = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert examples
    assert {name for name in examples if f'run("{name}"' in here} == examples


def test_two_arrays() -> None:
    assert run("two_arrays.py").startswith("aligned: ")


def test_one_capture(desk: Path, tmp_path: Path) -> None:
    told = run("one_capture.py", desk / "flight", tmp_path)
    assert told.count(": aligned, ") == 4


def test_whole_flight(desk: Path, tmp_path: Path) -> None:
    assert run("whole_flight.py", desk / "flight", tmp_path).count(" aligned ") == 12


def test_ndvi_over_a_flight(aligned: Path) -> None:
    assert run("ndvi_over_a_flight.py", aligned).count(" at 52.") == 3


def test_next_flight(desk: Path, tmp_path: Path) -> None:
    assert run("next_flight.py", desk / "flight", desk / "flight", tmp_path).count("4 of 4 aligned") == 3


def test_on_dask(desk: Path, tmp_path: Path) -> None:
    assert run("on_dask.py", desk / "flight", tmp_path).count(" done ") == 3


def test_two_dates(desk: Path, tmp_path: Path) -> None:
    told = run("two_dates.py", desk / "spring.tif", desk / "summer.tif", tmp_path / "change.tif")
    assert "px apart" in told
    with rasterio.open(tmp_path / "change.tif") as change, rasterio.open(desk / "spring.tif") as first:
        assert (change.shape, change.transform) == (first.shape, first.transform)
        assert np.isfinite(change.read(1)).mean() > 0.8
