"""The notebook and the scripts for clusters; test_documents.py runs the Python examples."""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from .blocks import ROOT

EXAMPLES = ROOT / "examples"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="shell scripts")]


@pytest.mark.full
def test_the_notebook(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(EXAMPLES / "flight.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are not kept in the repository"
    first, *others = (cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert "import agalign\n" not in first, "own flights skip the first cell"
    assert "IMG_" not in "".join(others), "other flights have other names"
    nbclient.NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in outputs)
    assert "2 of 2: 0000SET/000/IMG_000" in text
    assert sum("image/png" in o.get("data", {}) for o in outputs) == 2
    tables = [o["data"]["text/html"] for o in outputs if "text/html" in o.get("data", {})]
    assert "2 captures: 2 done" in tables[0]
    medians = [float(v) for v in re.findall(r"IMG_000\d +(-?[\d.]+)", text)]
    assert len(medians) == 2
    assert all(0.1 < v < 0.9 for v in medians)


def make_script(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{text}\n")
    (folder / name).chmod(0o755)


def environment(folder: Path, **more: str) -> dict[str, str]:
    """Scripts of `folder` are found first, and its flights are to be aligned."""
    path = f"{folder}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "FLIGHTS": str(folder / "flights"), "OUT": str(folder / "out"), **more}


@pytest.mark.parametrize(("code", "ends"), [(0, 0), (3, 0), (1, 1), (2, 2)])
def test_many_flights_go_on_after_exit_code_3(tmp_path: Path, code: int, ends: int) -> None:
    """In SLURM's script, with make, and in the container of a Kubernetes job."""
    yaml = pytest.importorskip("yaml")
    for name in ("flights/one", "flights/two", "out"):
        (tmp_path / name).mkdir(parents=True)
    make_script(tmp_path, "agalign", f'echo "$@" >> {tmp_path}/calls\nexit {code}')

    def exit_code(*command: str | Path) -> int:
        variables = environment(tmp_path, SLURM_ARRAY_TASK_ID="2")
        return subprocess.run(command, env=variables, capture_output=True, check=False).returncode

    assert exit_code("bash", EXAMPLES / "slurm.sh") == ends
    assert "flights/two/ -o" in (tmp_path / "calls").read_text()
    incomplete = tmp_path / "out" / "incomplete.txt"
    assert (incomplete.read_text() if incomplete.exists() else "") == ("two\n" if code == 3 else "")
    made = tmp_path / "made"
    make = exit_code("make", "-f", EXAMPLES / "flights.mk", f"FLIGHTS={tmp_path / 'flights'}", f"OUT={made}")
    assert (make == 0) == (ends == 0)
    assert len(list(made.glob("*.done"))) == (2 if ends == 0 else 0)
    job = yaml.safe_load((EXAMPLES / "kubernetes-job.yaml").read_text(encoding="utf-8"))
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert exit_code(*container["command"], *container["args"]) == ends


def test_slurm_requeues_a_flight_that_reaches_the_time_limit(tmp_path: Path) -> None:
    """SLURM sends SIGTERM to every process of the script, and to its shell."""
    (tmp_path / "flights" / "one").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    make_script(tmp_path, "agalign", f"trap 'exit 143' TERM\ntouch {tmp_path}/started\nwhile :; do sleep 0.05; done")
    make_script(tmp_path, "scontrol", f'echo "$@" > {tmp_path}/requeued')
    variables = environment(tmp_path, SLURM_ARRAY_TASK_ID="1", SLURM_JOB_ID="7")
    job = subprocess.Popen(["bash", str(EXAMPLES / "slurm.sh")], env=variables, start_new_session=True)
    while not (tmp_path / "started").exists():
        time.sleep(0.05)
    os.killpg(job.pid, signal.SIGTERM)
    assert job.wait() == 0
    assert (tmp_path / "requeued").read_text() == "requeue 7\n"
