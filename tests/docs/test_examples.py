"""Every example runs as it stands, on a synthetic flight."""

import os
import re
import signal
import subprocess
import sys
import time
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


def test_the_notebook(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(ROOT / "examples" / "flight.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are not kept in the repository"
    first, *others = (cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert "import agalign\n" not in first, "own flights skip the first cell"
    assert "IMG_" not in "".join(others), "other flights have other names"
    nbclient.NotebookClient(notebook, timeout=60, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in outputs)
    assert "2 of 2: 0000SET/000/IMG_000" in text
    assert sum("image/png" in o.get("data", {}) for o in outputs) == 3
    tables = [o["data"]["text/html"] for o in outputs if "text/html" in o.get("data", {})]
    assert "2 captures: 2 done" in tables[0]
    medians = [float(v) for v in re.findall(r"IMG_000\d +(-?[\d.]+)", text)]
    assert len(medians) == 2
    assert all(0.1 < v < 0.9 for v in medians)


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
@pytest.mark.parametrize(("code", "ends", "listed"), [(0, 0, False), (3, 0, True), (1, 1, False), (2, 2, False)])
def test_many_flights_go_on_after_exit_code_3(tmp_path: Path, code: int, ends: int, listed: bool) -> None:
    """In SLURM's script, with make, and in the container of a Kubernetes job."""
    for name in ("one", "two"):
        (tmp_path / "flights" / name).mkdir(parents=True)
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "agalign").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\nexit {code}\n')
    (tmp_path / "bin" / "agalign").chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}", "FLIGHTS": str(tmp_path / "flights"),
        "OUT": str(tmp_path / "out"), "SLURM_ARRAY_TASK_ID": "2",
    }  # fmt: skip

    def exit_code(*command: str) -> int:
        return subprocess.run(command, env=environment, capture_output=True, check=False).returncode

    (tmp_path / "out").mkdir()
    assert exit_code("bash", str(ROOT / "examples" / "slurm.sh")) == ends
    assert "flights/two/ -o" in (tmp_path / "calls").read_text()
    incomplete = tmp_path / "out" / "incomplete.txt"
    assert (incomplete.read_text() if incomplete.exists() else "") == ("two\n" if listed else "")
    make = exit_code("make", "-f", str(ROOT / "examples" / "flights.mk"), f"FLIGHTS={tmp_path / 'flights'}",
                     f"OUT={tmp_path / 'made'}")  # fmt: skip
    assert (make == 0) == (ends == 0)
    assert len(list((tmp_path / "made").glob("*.done"))) == (2 if ends == 0 else 0)
    yaml = pytest.importorskip("yaml")
    job = yaml.safe_load((ROOT / "examples" / "kubernetes-job.yaml").read_text(encoding="utf-8"))
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert exit_code(*container["command"], *container["args"]) == ends


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_slurm_requeues_a_flight_that_reaches_the_time_limit(tmp_path: Path) -> None:
    """SLURM sends SIGTERM to every process of the script, and to its shell."""
    (tmp_path / "flights" / "one").mkdir(parents=True)
    waits = f"#!/bin/sh\ntrap 'exit 143' TERM\ntouch {tmp_path}/started\nwhile :; do sleep 0.05; done\n"
    for name, script in (("agalign", waits), ("scontrol", f'#!/bin/sh\necho "$@" > {tmp_path}/requeued\n')):
        (tmp_path / name).write_text(script)
        (tmp_path / name).chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "FLIGHTS": str(tmp_path / "flights"),
        "OUT": str(tmp_path), "SLURM_ARRAY_TASK_ID": "1", "SLURM_JOB_ID": "7",
    }  # fmt: skip
    job = subprocess.Popen(["bash", str(ROOT / "examples" / "slurm.sh")], env=environment, start_new_session=True)
    for _ in range(200):
        if (tmp_path / "started").exists():
            break
        time.sleep(0.05)
    os.killpg(job.pid, signal.SIGTERM)
    assert job.wait(20) == 0
    assert (tmp_path / "requeued").read_text() == "requeue 7\n"


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
    assert told.startswith("offset before alignment: ")
    with rasterio.open(tmp_path / "change.tif") as change, rasterio.open(desk / "spring.tif") as first:
        assert (change.shape, change.transform) == (first.shape, first.transform)
        assert np.isfinite(change.read(1)).mean() > 0.8
