"""Captures in worker processes, of agalign and of a Dask cluster, and after the end of a worker."""

import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import psutil
import pytest

import agalign
from agalign.batch import workers
from agalign.batch.capture_report import CaptureReport
from agalign.batch.capture_task import Task, do_capture
from agalign.batch.run import Listener, capture_reports, run_flight
from agalign.batch.workers import (
    DaskExecutor,
    RunTasks,
    dask_executor,
    failure_text,
    in_order,
    on_executor,
    open_workers,
)
from agalign.cameras.discover import discover
from agalign.config import RunOptions, Settings
from agalign.errors import ConfigurationError, WorkerError
from agalign.method.device import limit_threads
from agalign.rasters.product import CapturePaths
from agalign.records.sidecar_file import find_sidecars, read_checked

from ..conftest import raising, seeded
from ..host.pool_tasks import WhenUnpickled, signal_self, sleep, without_memory

pytestmark = pytest.mark.slow


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_a_dask_cluster_starts_without_a_warning_if_the_port_of_dask_is_in_use(
    recwarn: pytest.WarningsRecorder,
) -> None:
    with socket.socket() as taken:
        with suppress(OSError):  # another program has the port already
            taken.bind(("", 8787))
            taken.listen()
        with dask_executor("local", 1):
            pass
    assert [w for w in recwarn if "in use" in str(w.message)] == []


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_a_dask_cluster_processes_captures(flight: Path, aligned_flight: Path, tmp_path: Path) -> None:
    """Two worker processes; one is killed while it processes a capture."""
    with dask_executor("local", 2) as executor:
        reports = run_flight(discover(flight), tmp_path, Settings(), RunOptions(executor=executor))
        processes = [p for p in psutil.Process().children(recursive=True) if is_worker(p)]
        assert len(processes) == 2
        result = [next(reports)]
        processes[0].kill()
        result += reports
    assert [r.is_complete for r in result] == [True, True]
    here, alone = (
        [
            b.model_dump_json(exclude={"seconds"})
            for path in find_sidecars(out)
            for b in read_checked(path).without_tables().bands
        ]
        for out in (tmp_path, aligned_flight)
    )
    assert here == alone


def is_worker(process: psutil.Process) -> bool:
    """Dask names its workers where setproctitle is installed."""
    return any(text in " ".join(process.cmdline()) for text in ("spawn_main", "dask worker"))


def test_a_scheduler_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_DASK_TIMEOUT_S", 0.5)
    with (
        pytest.raises(ConfigurationError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "),
        dask_executor("tcp://127.0.0.1:1"),
    ):
        pass


def seeds_only(flight: Path, out: Path) -> list[Task]:
    return [Task(c, out, seeded()) for c in discover(flight).captures]


def reports_of(run: RunTasks, tasks: list[Task]) -> Iterator[CaptureReport]:
    return capture_reports(run, tasks, Listener(), timeout_s=600)


def test_paths_of_workers_are_below_the_folder_as_it_was_given(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    task, _ = seeds_only(flight, Path("out"))
    sidecar = CapturePaths.of(task.capture, task.out).sidecar
    do_capture(task)
    with ThreadPoolExecutor(1) as threads:
        (report,) = reports_of(on_executor(threads), [replace(task, settings=seeded(layout="bands"))])
    assert (report.path, report.removed) == (sidecar, ((sidecar.with_suffix(".tif"), "--layout bands"),))
    assert not sidecar.is_absolute()


def deadly(task: Task, folder: Path, times: int) -> Task:
    """A task that kills the processes that receive it, up to a number of times."""
    return replace(task, settings=WhenUnpickled(folder / "mark", signal.SIGKILL, times))


@pytest.mark.full
def test_a_process_that_is_killed_twice_costs_its_capture(flight: Path, tmp_path: Path) -> None:
    one, other = seeds_only(flight, tmp_path)
    with open_workers(None, 1, limit_threads, has_timeout=True) as run:
        reports = {r.label: (r.state, r.error) for r in reports_of(run, [deadly(one, tmp_path, 2), other])}
    killed = "its worker process was killed (signal 9; out of memory?); run again to process the remaining captures"
    assert reports == {one.capture.label: ("error", killed), other.capture.label: ("done", None)}


def test_results_of_learning_tasks_come_in_order_and_a_lost_worker_ends_the_run(tmp_path: Path) -> None:
    """The first argument takes longest; the loss of a worker twice, as by a lack of memory, is one line."""
    with open_workers(None, 2, limit_threads) as run:
        assert list(in_order(run, sleep, [0.6, 0.0, 0.1])) == [0.6, 0.0, 0.1]
    with ThreadPoolExecutor(2) as threads:
        assert list(in_order(on_executor(threads), sleep, [0.3, 0.0, 0.1])) == [0.3, 0.0, 0.1]
    with open_workers(None, 1, limit_threads, has_timeout=True) as run:
        with pytest.raises(WorkerError, match="the flight cannot be learned: its worker process"):
            list(in_order(run, partial(signal_self, number=signal.SIGKILL, times=2), [tmp_path / "mark"]))
        with pytest.raises(MemoryError):
            list(in_order(run, without_memory, [0]))
        late = in_order(run, sleep, [0.0, 3600.0, 0.1], timeout_s=1.0, if_late=lambda seconds: -seconds)
        assert list(late) == [0.0, -3600.0, 0.1]
        with pytest.raises(WorkerError, match="the flight cannot be learned"):
            list(in_order(run, sleep, [3600.0], timeout_s=1.0))


@pytest.mark.full
def test_an_executor_that_loses_its_processes_costs_the_captures(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also those that it refuses to take afterwards."""
    monkeypatch.setattr(workers, "_MAX_WAITING_TASKS", 1)
    task, *_ = seeds_only(flight, tmp_path)
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        reports = list(reports_of(on_executor(executor), [deadly(task, tmp_path, 1), task, task]))
    assert {r.error for r in reports} == {
        "the executor lost its processes (out of memory?); run again to process the remaining captures"
    }


def test_a_capture_that_takes_too_long_ends_its_process_on_a_cluster() -> None:
    call = f"_on_worker({agalign.__version__!r}, time.sleep, 60, timeout_s=0.3)"
    code = f"import time; from agalign.batch.workers import _on_worker; {call}"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 75


def test_a_time_limit_is_named_where_a_cluster_does_not_say_why_a_task_ended_its_workers() -> None:
    killed = type("KilledWorker", (Exception,), {"__module__": "distributed.scheduler"})("on 4 workers")
    assert failure_text(killed, 60.0) == "its workers were ended, after 60 s (--timeout) or for memory"
    assert failure_text(killed).startswith("the cluster lost it (on 4 workers)")


def client(versions: dict[str, object], status: str = "running", executor: object = None) -> mock.Mock:
    """A Dask client with the answers of its workers."""
    methods = {"run.return_value": versions, "get_executor.return_value": executor}
    return mock.Mock(status=status, **methods)


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ("0.0.9", "has agalign 0.0.9; install agalign"),
        (ModuleNotFoundError("No module named 'agalign'"), r"cannot load agalign \(No mod"),
    ],
)
def test_a_dask_worker_without_this_version_is_refused(answer: object, problem: str) -> None:
    with pytest.raises(ConfigurationError, match=f"the Dask worker at tcp://b:1 {problem}"):
        workers._check_versions(client({"tcp://a:1": agalign.__version__, "tcp://b:1": answer}))
    workers._check_versions(client({"tcp://a:1": agalign.__version__}))
    assert workers._on_worker(agalign.__version__, abs, -2, timeout_s=30) == 2
    with pytest.raises(ConfigurationError, match=r"^a Dask worker has agalign .*; install agalign 0\.0\.9 there$"):
        workers._on_worker("0.0.9", abs, -2)


def test_a_dask_worker_without_the_folders_ends_the_run_before_it_begins(flight: Path, tmp_path: Path) -> None:
    """Each capture would be reported as a file that does not exist, which the user sees here."""
    image = discover(flight).captures[0].reference.path
    executor = DaskExecutor(client({"tcp://a:1": None, "tcp://b:1": image, "tcp://c:1": OSError("ended")}))
    problem = f"^{re.escape(str(image))}: the Dask worker at tcp://b:1 does not see it; mount the same folders"
    with pytest.raises(ConfigurationError, match=problem):
        list(run_flight(discover(flight), tmp_path / "out", Settings(), RunOptions(executor=executor)))
    assert list((tmp_path / "out").iterdir()) == []
    assert workers._missing([flight, tmp_path / "out"]) is None
    assert workers._missing([flight, tmp_path / "elsewhere"]) == tmp_path / "elsewhere"


def test_a_dask_scheduler_without_workers_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    waits = "agalign: no worker is connected to the Dask scheduler; the run waits for one"
    workers._check_versions(client({}))
    assert caplog.messages == [waits]
    of_cluster = client({})
    of_cluster.ncores.side_effect = {"tcp://a:1": 1}, {"tcp://a:1": 1}, {}, {}, {"tcp://b:1": 1}, OSError, {}
    executor = DaskExecutor(of_cluster)
    assert {executor.checked_loss() for _ in range(6)} == {""}
    assert caplog.messages == [waits] * 3, "when the last worker is gone, once each time"


@pytest.mark.parametrize("ends", [True, False])
def test_a_lost_dask_scheduler_ends_the_run_in_one_line(
    ends: bool, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Futures of a lost scheduler are cancelled, or never end."""
    monkeypatch.setattr(workers, "_POLL_INTERVAL_S", 0.01)
    future: Future[CaptureReport] = Future()
    if ends:
        future.cancel()
        future.set_running_or_notify_cancel()
    executor = DaskExecutor(client({}, "connecting", mock.Mock(**{"submit.return_value": future})))
    with pytest.raises(WorkerError, match=r"^the Dask scheduler does not answer any more; finished captures are kept"):
        list(reports_of(on_executor(executor), seeds_only(flight, tmp_path)))


def test_workers_start_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fork server needs one for its socket."""
    monkeypatch.setattr(tempfile, "gettempdir", raising(FileNotFoundError("No usable temporary directory found")))
    assert workers.worker_context(workers.__name__).get_start_method() == "spawn"


def test_a_dask_cluster_that_cannot_be_started_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "LocalCluster", raising(RuntimeError("Cluster failed to start: No temporary")))
    message = r"^no Dask cluster can be started here \(Cluster failed to start"
    with pytest.raises(ConfigurationError, match=message), dask_executor("local"):
        pass
