"""Processes that do captures, of our own and of a Dask cluster, and what becomes of a capture whose process ends."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

import agalign
from agalign.batch import RunOptions, dask_executor, run_flight, workers
from agalign.batch.workers import Task, done_by, own_processes
from agalign.cameras.discover import discover
from agalign.config import SeedSettings, Settings
from agalign.errors import ConfigurationError
from agalign.products.sidecar import CaptureResult

pytestmark = pytest.mark.slow

SETTINGS = Settings()


def test_a_dask_cluster_does_the_captures(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two worker processes, one of which is killed while it does a capture."""
    monkeypatch.chdir(flight.parent)
    alone = agalign.align_folder(flight.name, tmp_path / "alone", settings=SETTINGS)
    with dask_executor("local", 2) as executor:
        reports = run_flight(discover(flight), tmp_path / "out", SETTINGS, RunOptions(executor=executor))
        workers_ = [p for p in psutil.Process().children(recursive=True) if is_worker(p)]
        assert len(workers_) == 2
        result = []
        for number, report in enumerate(reports):
            result.append(report)
            if number == 0:
                workers_[0].kill()
    assert [r.good for r in result] == [True, True]
    assert {r.label: r.result and without_seconds(r.result) for r in result} == {
        r.label: r.result and without_seconds(r.result) for r in alone
    }


def is_worker(process: psutil.Process) -> bool:
    """Dask names its workers where setproctitle is installed."""
    return any(text in " ".join(process.cmdline()) for text in ("spawn_main", "dask worker"))


def without_seconds(result: CaptureResult) -> CaptureResult:
    return result.model_copy(update={"bands": [b.model_copy(update={"seconds": 0.0}) for b in result.bands]})


def test_a_scheduler_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_DASK_ANSWERS_WITHIN_S", 0.5)
    with (
        pytest.raises(ConfigurationError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "),
        dask_executor("tcp://127.0.0.1:1"),
    ):
        pass


def test_a_killed_process_costs_one_capture_at_most(flight: Path, tmp_path: Path) -> None:
    tasks = [Task(c, tmp_path, Settings(seed=SeedSettings(only=True)), None) for c in discover(flight).captures]
    states = []
    with own_processes(1, None) as submit:
        for report in done_by(submit, [task for _ in range(4) for task in tasks], 8):
            if not states:
                (worker,) = (c for c in psutil.Process().children(recursive=True) if c.ppid() != os.getpid())
                worker.kill()
            states.append(report.state)
            assert report.state == "done" or "killed (signal 9" in (report.error or "")
    assert len(states) == 8
    assert states.count("done") >= 7


def test_a_capture_that_takes_too_long_ends_its_process_on_a_cluster() -> None:
    code = "import time; from agalign.batch.workers import _within; _within(0.3, time.sleep, 60)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 75
    code = "from agalign.batch.workers import _within; print(_within(30, max, 1, 2))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60).stdout == b"2\n"
