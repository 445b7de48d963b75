"""Worker processes that are killed, stopped or cannot start: every task has its outcome, and no process is left."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
import pytest

from agalign.errors import WorkerError
from agalign.values import process_pool
from agalign.values.process_pool import Outcome, ProcessPool
from agalign.values.processes import Worker, follow_parent

from ..builders import in_full_run
from . import pool_tasks as tasks

CONTEXT = get_context("forkserver" if sys.platform == "linux" else "spawn")
LARGE = 3_000_000
"""Bytes: more than the buffer of any pipe."""


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """The test ends all processes but the fork server and its helper."""
    before = threading.active_count()
    yield
    assert worker_processes() == []
    assert threading.active_count() <= before + 1


def worker_processes() -> list[psutil.Process]:
    """Return the living processes that the fork server started."""
    result = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.ppid() != os.getpid() and process.status() != psutil.STATUS_ZOMBIE:
                result.append(process)
    return result


def pool(function: Callable[[Any], Any], processes: int = 1, **more: Any) -> ProcessPool[Any, Any]:
    return ProcessPool(function, processes, CONTEXT, more.pop("initializer", tasks.nothing), **more)


def value_or_error(outcome: Outcome[Any, Any]) -> object:
    return outcome.result if outcome.error is None else f"{type(outcome.error).__name__}: {outcome.error}"


def test_each_argument_has_its_result() -> None:
    with pool(tasks.size, 2) as workers:
        outcomes = list(workers.run([bytes(n) for n in range(100)]))
    assert sorted(o.number for o in outcomes) == list(range(100))
    assert all(o.value() == o.number == len(o.argument) for o in outcomes)


def test_large_arguments_and_results_pass_whole() -> None:
    with pool(tasks.size) as workers:
        assert [o.value() for o in workers.run([bytes(LARGE)])] == [LARGE]
    with pool(tasks.zeros) as workers:
        assert [len(o.value()) for o in workers.run([0, 1, 7999, 8000, 8001, LARGE])] == [0, 1, 7999, 8000, 8001, LARGE]


def test_workers_are_replaced_after_their_tasks() -> None:
    with pool(tasks.process_id, 1, max_tasks_per_worker=2) as workers:
        seen = [o.value() for o in workers.run(range(6))]
    assert [seen.count(p) for p in dict.fromkeys(seen)] == [2, 2, 2]


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (tasks.raise_key_error, "KeyError: 'what'"),
        (tasks.raise_unpicklable, "RuntimeError: TwoArgumentsError: a"),
        (tasks.unpicklable, "lambda"),
        (tasks.result_that_cannot_be_read, "UnpicklingError"),
    ],
)
def test_a_failed_task_ends_no_worker(function: Callable[[int], object], said: str) -> None:
    with pool(function) as workers:
        before = workers._workers[0]
        outcomes = [value_or_error(o) for o in workers.run([1, 2])]
        assert workers._workers[0] is before
    assert all(said in str(o) for o in outcomes)
    assert len(outcomes) == 2


def test_an_argument_that_cannot_be_pickled_costs_itself() -> None:
    with pool(tasks.received) as workers:
        outcomes = {o.number: value_or_error(o) for o in workers.run([1, lambda: None, 2])}
    assert outcomes[0] == outcomes[2] == "done"
    assert "lambda" in str(outcomes[1])


# ---- killed and stopped at each point of a task


def at_first(monkeypatch: pytest.MonkeyPatch, point: str, number: int, times: int) -> None:
    """Send a signal to the workers of the first tasks when they have part of it, or have sent part of the result."""
    send, receive = Worker.send, Worker.receive
    aimed_at: list[Worker] = []

    def signal_to(worker: Worker) -> None:
        aimed_at.remove(worker)
        time.sleep(0.05)
        assert worker.process.pid
        os.kill(worker.process.pid, number)

    def sending(self: Worker, message: bytes) -> None:
        nonlocal times
        send(self, message)
        if times:
            aimed_at.append(self)
            times -= 1
            if point == "receiving":
                signal_to(self)

    def receiving(self: Worker) -> bytes | None:
        # Nothing was read, so the buffer of the pipe is full: the process waits within `send_bytes`.
        if self in aimed_at and self.pipe.poll():
            signal_to(self)
        return receive(self)

    monkeypatch.setattr(Worker, "send", sending)
    monkeypatch.setattr(Worker, "receive", receiving)


def ended_while(
    point: str, number: int, times: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Callable[[Any], Any], object]:
    """(function, argument) of a task during which its worker gets a signal."""
    task = folder / "mark", number, times
    if point == "unpickling":
        return tasks.received, tasks.WhenUnpickled(*task)
    if point == "computing":
        return tasks.signalled, task
    at_first(monkeypatch, point, number, times)
    return (tasks.received, bytes(LARGE)) if point == "receiving" else (tasks.zeros, LARGE)


POINTS = ("receiving", "unpickling", "computing", "sending")


@pytest.mark.parametrize(("kills", "processes"), [(1, 1), (1, 2), (2, 1)])
@pytest.mark.parametrize("point", POINTS)
def test_a_task_is_tried_again_after_one_kill_and_fails_after_two(
    point: str, kills: int, processes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    function, argument = ended_while(point, signal.SIGKILL, kills, tmp_path, monkeypatch)
    with pool(function, processes) as workers:
        if kills == 2:
            (outcome,) = workers.run([argument])
            assert value_or_error(outcome) == "WorkerDiedError: signal 9"
        (outcome,) = workers.run([argument])
    assert outcome.value() in ("done", bytes(LARGE))


@pytest.mark.slow
@pytest.mark.parametrize("point", ["computing", *map(in_full_run, ("receiving", "unpickling", "sending"))])
def test_a_stopped_worker_is_late(point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other worker finishes meanwhile, and the task is not tried again."""
    function, argument = ended_while(point, signal.SIGSTOP, 1, tmp_path, monkeypatch)
    others = [1] * 5
    with pool(function, 2) as workers:
        outcomes = list(workers.run([argument, *others], timeout_s=5))
    assert [value_or_error(o) for o in outcomes if o.number == 0] == ["TimeoutError: "]
    assert all(o.error is None for o in outcomes if o.number)
    assert len(outcomes) == 6


def test_a_task_fails_at_once_if_its_worker_exits() -> None:
    with pool(tasks.leave) as workers:
        assert [value_or_error(o) for o in workers.run([0, 3, 0])] == [0, "WorkerDiedError: exit code 3", 0]


def test_a_result_sent_before_the_kill_counts() -> None:
    with pool(tasks.sleep, 1) as workers:
        outcomes = workers.run([0.0, 0.2])
        assert next(outcomes).value() == 0.0
        time.sleep(1)  # the second result is in the pipe
        (worker,) = worker_processes()
        worker.kill()
        worker.wait()
        assert next(outcomes).value() == 0.2


@pytest.mark.parametrize("step_s", [86_400, -86_400])
def test_time_limits_do_not_run_on_the_clock_of_the_day(step_s: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that is set forward or back by a day in the middle of a task ends nothing."""
    clock_s = count(2 * 10**9, step_s)
    monkeypatch.setattr(time, "time", lambda: next(clock_s))
    with pool(tasks.sleep) as workers:
        assert [o.value() for o in workers.run([0.3, 0.3], timeout_s=30)] == [0.3, 0.3]


def test_a_result_that_arrived_in_time_is_not_a_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller may take longer over one outcome than the time limit of the next, here an hour."""
    clock, late_s = time.monotonic, 0.0
    monkeypatch.setattr(time, "monotonic", lambda: clock() + late_s)
    with pool(tasks.zeros, 2) as workers:
        outcomes = workers.run([1, LARGE, LARGE, LARGE], timeout_s=600)
        next(outcomes)
        while not all(worker.pipe.poll() for worker in workers._workers):
            time.sleep(0.01)
        late_s = 3600.0
        assert [len(o.value()) for o in outcomes] == [LARGE] * 3


# ---- workers that cannot start


def test_workers_that_cannot_start_end_the_run_in_one_line() -> None:
    with pool(tasks.received, 3, initializer=tasks.refuse) as workers, pytest.raises(WorkerError) as raised:
        list(workers.run([1, 2]))
    assert str(raised.value).startswith("no worker process can be started (ValueError: no room); ")


def test_a_worker_that_cannot_start_is_one_less(tmp_path: Path) -> None:
    with pool(tasks.process_id, 3, initializer=tasks.refuse_after_first, arguments=(tmp_path,)) as workers:
        assert len({o.value() for o in workers.run(range(20))}) == 1


@pytest.mark.parametrize("what", ["pipe", "thread", "process"])
def test_a_system_that_is_short_of_something(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread") if what == "thread" else OSError(11, "Resource unavailable")

    owners = {"pipe": type(CONTEXT), "thread": threading.Thread, "process": CONTEXT.Process}
    owner, name = owners[what], "Pipe" if what == "pipe" else "start"
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, short)
        workers = pool(tasks.received, 2)
        with workers, pytest.raises(WorkerError, match=r"no worker process can be started \(\w+Error: "):
            list(workers.run([1]))


def test_a_worker_that_is_stopped_while_it_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "_START_TIMEOUT_S", 1.0)
    stopping = pool(tasks.received, initializer=tasks.stop_forever)
    with stopping as workers, pytest.raises(WorkerError, match="not ready after 1 s"):
        list(workers.run([1]))


# ---- storms


def test_a_start_is_tried_again_if_the_fork_server_refuses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server was killed, and its parent does not know it yet."""
    start, starts = CONTEXT.Process.start, []

    def refused_first(process: Any) -> None:
        starts.append(process)
        if len(starts) == 1:
            raise ConnectionRefusedError
        start(process)

    monkeypatch.setattr(CONTEXT.Process, "start", refused_first)
    with pool(tasks.size) as workers:
        assert [outcome.value() for outcome in workers.run([b"abc"])] == [3]
    assert len(starts) == 2


def test_workers_killed_together_do_not_end_the_run() -> None:
    with pool(tasks.sleep, 6) as workers:
        outcomes = workers.run([0.0, *[0.3] * 12])
        next(outcomes)
        for worker in worker_processes():
            worker.kill()
        assert all(o.value() == 0.3 for o in outcomes)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no fork server here")
def test_tasks_are_tried_again_if_the_fork_server_is_killed() -> None:
    with pool(tasks.sleep, 2) as workers:
        outcomes = workers.run([0.0, *[0.3] * 6])
        next(outcomes)
        psutil.Process(worker_processes()[0].ppid()).kill()
        assert all(o.value() == 0.3 for o in outcomes)


def test_libraries_log_nothing_in_workers() -> None:
    with pool(tasks.log_level, 1, initializer=follow_parent) as workers:
        levels = [o.value() for o in workers.run(["rasterio", "tifffile"])]
    assert levels == ["CRITICAL", "CRITICAL"]


# ---- ends


SCRIPT = """
import signal
import sys
from multiprocessing import get_context
from agalign.values.process_pool import ProcessPool
from agalign.values.processes import follow_parent
from tests.values.pool_tasks import sleep
if __name__ == "__main__":
    # A shell starts jobs in the background with this signal ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with ProcessPool(sleep, 4, get_context(sys.argv[1]), follow_parent) as workers:
        outcomes = workers.run([0.0] * 4 + [3600.0] * 8)
        for _ in range(4):
            next(outcomes)
        print("begun", flush=True)
        list(outcomes)
"""


@pytest.mark.slow
@pytest.mark.parametrize("target", ["parent", in_full_run("group")])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, in_full_run(signal.SIGINT)])
@pytest.mark.parametrize("method", ["forkserver", in_full_run("spawn")])
def test_no_process_outlives_its_parent(method: str, number: int, target: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), method]
    root = Path(__file__).resolve().parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "start_new_session": True, "env": environment}
    with subprocess.Popen(command, **given) as process:
        try:
            assert process.stdout.readline() == b"begun\n"
            children = psutil.Process(process.pid).children(recursive=True)
            assert len(children) >= 4
            (os.killpg if target == "group" else os.kill)(process.pid, number)
            assert process.wait() != 0
        finally:
            process.kill()
    psutil.wait_procs(children)
