"""Processes that do captures, of our own and of a Dask cluster, and what becomes of a capture whose process ends."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import psutil
import pytest

import agalign
from agalign.batch import RunOptions, dask_executor, run_flight, workers
from agalign.batch.capture import Task, start_worker
from agalign.batch.report import CaptureReport
from agalign.batch.run import Listener, capture_reports
from agalign.batch.workers import DaskExecutor, Run, in_order, on_executor, own_processes
from agalign.cameras.discover import discover
from agalign.config import SeedSettings, Settings
from agalign.errors import ConfigurationError, WorkerError
from agalign.products.sidecar import CaptureResult

from ..values.pool_tasks import signal_self, sleep, without_memory

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
    monkeypatch.setattr(workers, "_DASK_TIMEOUT_S", 0.5)
    with (
        pytest.raises(ConfigurationError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "),
        dask_executor("tcp://127.0.0.1:1"),
    ):
        pass


def seeds_only(flight: Path, out: Path) -> list[Task]:
    return [Task(c, out, Settings(seed=SeedSettings(only=True)), None) for c in discover(flight).captures]


def reports_of(run: Run, tasks: list[Task]) -> Iterator[CaptureReport]:
    return capture_reports(run, tasks, Listener(), timeout_s=10)


def only_worker() -> psutil.Process:
    (worker,) = (c for c in psutil.Process().children(recursive=True) if c.ppid() != os.getpid())
    return worker


def test_a_process_killed_once_costs_no_capture(flight: Path, tmp_path: Path) -> None:
    tasks = seeds_only(flight, tmp_path)
    with own_processes(1, start_worker) as run:
        reports = reports_of(run, tasks * 4)
        states = [next(reports).state]
        only_worker().kill()
        states += [r.state for r in reports]
    assert states == ["done"] * 8


def test_a_process_killed_twice_costs_its_capture(flight: Path, tmp_path: Path) -> None:
    capture, *_ = tasks = seeds_only(flight, tmp_path)
    mark = tmp_path / "mark"
    deadly = replace(capture, settings=KillsWhenRead(mark, 2))
    with own_processes(1, start_worker) as run:
        reports = {r.label: r for r in reports_of(run, [deadly, *tasks[1:]])}
    lost = reports.pop(capture.capture.label)
    assert (lost.state, lost.error) == (
        "error",
        "its worker process was killed (signal 9; out of memory?); run again to process the remaining captures",
    )
    assert [r.state for r in reports.values()] == ["done"] * (len(tasks) - 1)


def test_results_of_learning_tasks_come_in_order_and_a_lost_worker_ends_the_run(
    tmp_path: Path,
) -> None:
    """The first argument takes longest; the loss of a worker twice, as by a lack of memory, is one line."""
    with own_processes(2, start_worker) as run:
        assert list(in_order(run, sleep, [0.6, 0.0, 0.1])) == [0.6, 0.0, 0.1]
    with ThreadPoolExecutor(2) as threads:
        assert list(in_order(on_executor(threads), sleep, [0.3, 0.0, 0.1])) == [0.3, 0.0, 0.1]
    with (
        own_processes(1, start_worker) as run,
        pytest.raises(WorkerError, match="the flight cannot be learned: its worker process"),
    ):
        list(in_order(run, partial(signal_self, number=signal.SIGKILL, times=2), [tmp_path / "mark"]))
    with own_processes(1, start_worker) as run, pytest.raises(MemoryError):
        list(in_order(run, without_memory, [0]))


def test_a_stopped_process_is_told_as_late(flight: Path, tmp_path: Path) -> None:
    capture, *_ = tasks = seeds_only(flight, tmp_path)
    deadly = replace(capture, settings=KillsWhenRead(tmp_path / "mark", 1, signal.SIGSTOP))
    with own_processes(1, start_worker, timeout_s=10) as run:
        reports = {r.label: r for r in reports_of(run, [deadly, *tasks[1:]])}
    assert reports.pop(capture.capture.label).error == "stopped after 10 s (--timeout)"
    assert [r.state for r in reports.values()] == ["done"] * (len(tasks) - 1)


def test_an_executor_that_loses_its_processes_costs_the_captures(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also those that it refuses to take afterwards."""
    monkeypatch.setattr(workers, "_MAX_WAITING_TASKS", 1)
    capture, *_ = seeds_only(flight, tmp_path)
    deadly = replace(capture, settings=KillsWhenRead(tmp_path / "mark", 1))
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        reports = list(reports_of(on_executor(executor), [deadly, capture, capture]))
    assert {r.error for r in reports} == {
        "the executor lost its processes (out of memory?); run again to process the remaining captures"
    }


class KillsWhenRead(Settings):
    """Settings that send a signal to the process that unpickles them, so many times in all."""

    def __init__(self, mark: Path, times: int, number: int = signal.SIGKILL) -> None:
        super().__init__(seed=SeedSettings(only=True))
        self._given = mark, times, number

    def __reduce__(self) -> tuple[object, ...]:
        return kill_and_read, self._given


def kill_and_read(mark: Path, times: int, number: int) -> Settings:
    signal_self(mark, number, times)
    return Settings(seed=SeedSettings(only=True))


def test_a_capture_that_takes_too_long_ends_its_process_on_a_cluster() -> None:
    code = "import time; from agalign.batch.workers import _within; _within(0.3, time.sleep, 60)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 75
    code = "from agalign.batch.workers import _within; print(_within(30, max, 1, 2))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60).stdout == b"2\n"


class Client:
    """A Dask client with the answers of its workers."""

    def __init__(self, versions: dict[str, object], status: str = "running") -> None:
        self.versions, self.status = versions, status

    def run(self, *_: object, **__: object) -> dict[str, object]:
        return self.versions

    def get_executor(self, **_: object) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1)


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ("0.0.9", "the Dask worker at tcp://b:1 has agalign 0.0.9; install agalign"),
        (
            ModuleNotFoundError("No module named 'agalign'"),
            r"the Dask worker at tcp://b:1 cannot load agalign \(No mod",
        ),
    ],
)
def test_a_dask_worker_without_this_version_is_refused(answer: object, problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem):
        workers._check_versions(Client({"tcp://a:1": agalign.__version__, "tcp://b:1": answer}))
    workers._check_versions(Client({"tcp://a:1": agalign.__version__}))


def test_a_dask_scheduler_without_workers_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    workers._check_versions(Client({}))
    assert caplog.messages == ["agalign: no worker is connected to the Dask scheduler; the run waits for one"]


def test_a_dask_worker_of_another_version_that_joins_later_does_nothing() -> None:
    assert workers._on_worker(agalign.__version__, max, 1, 2) == 2
    with pytest.raises(ConfigurationError, match=r"^a Dask worker has agalign .*; install agalign 0\.0\.9 there$"):
        workers._on_worker("0.0.9", max, 1, 2)


@pytest.mark.parametrize("ends", [True, False])
def test_a_lost_dask_scheduler_ends_the_run_in_one_line(
    ends: bool, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Futures of a lost scheduler are cancelled, or never end."""
    monkeypatch.setattr(workers, "_POLL_INTERVAL_S", 0.01)
    executor = DaskExecutor(Client({}, "connecting"), None)

    def submit(*_: object) -> "Future[CaptureReport]":
        future: Future[CaptureReport] = Future()
        if ends:
            future.cancel()
            future.set_running_or_notify_cancel()
        return future

    monkeypatch.setattr(executor, "submit", submit)
    with pytest.raises(WorkerError, match=r"^the Dask scheduler does not answer any more; finished captures are kept"):
        list(reports_of(on_executor(executor), seeds_only(flight, tmp_path)))


def test_workers_start_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fork server needs one for its socket."""

    def fails() -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", fails)
    assert workers.worker_context(workers.__name__).get_start_method() == "spawn"


def test_a_dask_cluster_that_cannot_be_started_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")

    def fails(**_: object) -> None:
        raise RuntimeError("Cluster failed to start: No usable temporary directory found")

    monkeypatch.setattr(distributed, "LocalCluster", fails)
    with (
        pytest.raises(ConfigurationError, match=r"^no Dask cluster can be started here \(Cluster failed to start"),
        dask_executor("local"),
    ):
        pass
