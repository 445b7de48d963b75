"""Worker processes that are killed, stopped or cannot start: every task has its outcome, and no process is left."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
import pytest

from agalign.errors import WorkerError
from agalign.host import process_pool
from agalign.host.process_pool import ProcessPool

from ..builders import in_full_run
from ..conftest import raising
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


def pool(processes: int = 1, initializer: Callable[[], object] = int) -> ProcessPool:
    return ProcessPool(processes, CONTEXT, initializer)


def submitted(
    workers: ProcessPool, function: Callable[[Any], Any], arguments: Iterable[Any], timeout_s: float | None = None
) -> list[Future[Any]]:
    return [workers.submit(function, argument, timeout_s=timeout_s) for argument in arguments]


def outcomes(*call: Any, timeout_s: float | None = None) -> list[Any]:
    """The result or the error of each argument: `outcomes(workers, function, arguments)`."""
    futures = submitted(*call, timeout_s=timeout_s)
    errors = [f.exception() for f in futures]
    return [f.result() if e is None else f"{type(e).__name__}: {e}" for f, e in zip(futures, errors, strict=True)]


def process_id(workers: ProcessPool) -> int:
    """Id of the only process; raises the error of one that cannot start."""
    return workers.submit(os.getpid).result()


def test_large_arguments_and_results_pass_whole_and_in_order() -> None:
    with pool(2) as workers:
        assert outcomes(workers, bytes, [0, 1, LARGE, 2]) == [b"", bytes(1), bytes(LARGE), bytes(2)]
        assert outcomes(workers, len, [bytes(LARGE), b"a"]) == [LARGE, 1]


def test_workers_are_replaced_after_their_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "_MAX_TASKS_PER_WORKER", 2)
    with pool() as workers:
        seen = [process_id(workers) for _ in range(6)]
    assert [seen.count(p) for p in dict.fromkeys(seen)] == [2, 2, 2]


def test_what_is_cancelled_is_not_called() -> None:
    with pool() as workers:
        first, second, third = submitted(workers, tasks.sleep, [0.3, 3600.0, 0.0])
        assert second.cancel()
        assert [first.result(), third.result()] == [0.3, 0.0]


def test_a_failed_task_ends_no_worker() -> None:
    """Nor does an argument, a result or an error that cannot be pickled or unpickled."""
    expected = {
        "any": "KeyError: 'any'",
        "error that cannot be unpickled": "RuntimeError: TwoArgumentsError: a",
        "result that cannot be pickled": "lambda",
        "result that cannot be unpickled": "UnpicklingError",
    }
    with pool() as workers:
        before = process_id(workers)
        errors = outcomes(workers, tasks.unusual_outcome, [*expected, lambda: None])
        assert process_id(workers) == before
    assert all(said in error for said, error in zip([*expected.values(), "lambda"], errors, strict=True))


# ---- killed and stopped at each point of a task


def ended_while(point: str, number: int, times: int, folder: Path) -> tuple[Callable[[Any], Any], object]:
    """(function, argument) of a task during which its worker gets a signal, up to a total."""
    task = folder / "mark", number, times
    if point == "receiving":
        return tasks.received, tasks.WhenUnpickled(*task)
    return {"computing": tasks.signalled, "sending": tasks.sent_in_part}[point], task


@pytest.mark.parametrize(("kills", "processes"), [(1, 1), (1, 2), (2, 1)])
@pytest.mark.parametrize("point", ["receiving", "computing", "sending"])
def test_a_task_is_tried_again_after_one_kill_and_fails_after_two(
    point: str, kills: int, processes: int, tmp_path: Path
) -> None:
    function, argument = ended_while(point, signal.SIGKILL, kills, tmp_path)
    with pool(processes) as workers:
        assert outcomes(workers, function, [argument]) == ["WorkerDiedError: signal 9" if kills == 2 else None]
        assert outcomes(workers, function, [argument]) == [None]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_worker_that_takes_no_more_of_an_argument(number: int) -> None:
    """The thread waits within `send_bytes`, as the buffer of the pipe is full."""
    with pool() as workers:
        process = process_id(workers)
        os.kill(process, signal.SIGSTOP)
        threading.Timer(0.3, os.kill, (process, number)).start()
        is_killed = number == signal.SIGKILL
        outcome = outcomes(workers, len, [bytes(LARGE)], timeout_s=60 if is_killed else 1)
        assert outcome == [LARGE if is_killed else "TimeoutError: "]


@pytest.mark.slow
@pytest.mark.parametrize("point", ["computing", *map(in_full_run, ("receiving", "sending"))])
def test_a_stopped_worker_is_late(point: str, tmp_path: Path) -> None:
    """The other worker finishes meanwhile, and the task is not tried again."""
    function, argument = ended_while(point, signal.SIGSTOP, 1, tmp_path)
    with pool(2) as workers:
        (late,) = submitted(workers, function, [argument], timeout_s=5)
        assert outcomes(workers, tasks.sleep, [0.0] * 5) == [0.0] * 5
        assert isinstance(late.exception(), TimeoutError)


def test_a_task_fails_at_once_if_its_worker_exits() -> None:
    with pool() as workers:
        assert outcomes(workers, os._exit, [3]) == ["WorkerDiedError: exit code 3"]


@pytest.mark.parametrize("by_time_limit", [False, True])
def test_a_worker_killed_while_idle_costs_no_try(by_time_limit: bool, tmp_path: Path) -> None:
    """A time limit may end at the moment of the result."""
    function, argument = ended_while("computing", signal.SIGKILL, 1, tmp_path)
    with pool() as workers:
        process = psutil.Process(process_id(workers))
        if by_time_limit:
            workers._workers[0]._kill_late()
        else:
            process.kill()
            process.wait(60)
        assert outcomes(workers, function, [argument]) == [None]


@pytest.mark.parametrize("step_s", [86_400, -86_400])
def test_time_limits_do_not_run_on_the_clock_of_the_day(step_s: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that is set forward or back by a day in the middle of a task ends nothing."""
    clock_s = count(2 * 10**9, step_s)
    monkeypatch.setattr(time, "time", lambda: next(clock_s))
    with pool() as workers:
        assert outcomes(workers, tasks.sleep, [0.3, 0.3], timeout_s=30) == [0.3, 0.3]


# ---- workers that cannot start


def test_workers_that_cannot_start_fail_all_tasks_in_one_line() -> None:
    with pool(3, partial(int, "x")) as workers:
        errors = outcomes(workers, tasks.received, [1, 2])
        assert errors == [f"WorkerError: {workers.loss}"] * 2
        assert workers.loss.startswith("no worker process can be started (ValueError: invalid literal")


def test_a_worker_that_cannot_start_is_one_less(tmp_path: Path) -> None:
    with pool(3, partial(tasks.start_first_only, tmp_path)) as workers:
        assert len({process_id(workers) for _ in range(20)}) == 1


@pytest.mark.parametrize("what", ["pipe", "thread", "process"])
def test_a_system_that_is_short_of_something(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object, **__: object) -> None:
        raise OSError(11, "Resource unavailable") if what == "pipe" else RuntimeError("can't start new thread")

    owners = {"pipe": type(CONTEXT), "thread": threading.Thread, "process": CONTEXT.Process}
    monkeypatch.setattr(owners[what], "Pipe" if what == "pipe" else "start", short)
    with pytest.raises(WorkerError, match=r"no worker process can be started \(\w+Error: "), pool(2) as workers:
        process_id(workers)


def test_a_time_limit_without_a_thread_is_a_lack_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading.Timer, "start", raising(RuntimeError("can't start new thread")))
    with pool() as workers:
        assert outcomes(workers, len, [b"abc"], timeout_s=60) == ["MemoryError: "]
        assert outcomes(workers, len, [b"abc"]) == [3]


def test_a_worker_that_is_stopped_while_it_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "_START_TIMEOUT_S", 1.0)
    stop = partial(signal.raise_signal, signal.SIGSTOP)
    with pytest.raises(WorkerError, match="not ready after 1 s"), pool(1, stop) as workers:
        process_id(workers)


# ---- storms


@pytest.mark.parametrize("error", [ConnectionRefusedError, EOFError])
def test_a_start_is_tried_again_if_the_fork_server_fails(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server was killed: its parent does not know it yet, or waits for its answer."""
    start, starts = CONTEXT.Process.start, []

    def refused_first(process: Any) -> None:
        starts.append(process)
        if len(starts) == 1:
            raise error
        start(process)

    monkeypatch.setattr(CONTEXT.Process, "start", refused_first)
    with pool() as workers:
        assert outcomes(workers, len, [b"abc"]) == [3]
    assert len(starts) == 2


def test_workers_killed_together_do_not_end_the_run() -> None:
    with pool(6) as workers:
        outcomes(workers, tasks.sleep, [0.1] * 6)
        futures = submitted(workers, tasks.sleep, [0.3] * 12)
        for worker in worker_processes():
            worker.kill()
        assert [f.result() for f in futures] == [0.3] * 12


def test_workers_that_end_one_after_another_fail_all_tasks(tmp_path: Path) -> None:
    function, argument = ended_while("computing", signal.SIGKILL, 99, tmp_path)
    with pool() as workers:
        errors = outcomes(workers, function, [argument] * 9)
    said = "8 worker processes one after another ended before they finished anything (the last by signal 9"
    assert all(said in error for error in errors)


def test_three_tasks_in_a_row_that_no_worker_survives_cost_only_themselves(tmp_path: Path) -> None:
    deadly = [(tmp_path / str(number), signal.SIGKILL, 2) for number in range(3)]
    harmless = (tmp_path / "none", signal.SIGKILL, 0)
    with pool() as workers:
        results = outcomes(workers, tasks.signalled, [*deadly, harmless])
    assert results == ["WorkerDiedError: signal 9"] * 3 + [None]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no fork server here")
def test_tasks_are_done_if_the_fork_server_is_killed() -> None:
    with pool(2) as workers:
        server = psutil.Process(process_id(workers)).parent()
        futures = submitted(workers, tasks.sleep, [0.3] * 6)
        server.kill()
        assert [f.result() for f in futures] == [0.3] * 6


def test_a_worker_is_killed_if_its_fork_server_was() -> None:
    """`multiprocessing` regards it as ended."""
    with pool() as workers:
        process = psutil.Process(process_id(workers))
        process.parent().kill()
        assert outcomes(workers, tasks.sleep, [3600.0], timeout_s=0.5) == ["TimeoutError: "]
        process.wait(60)


def test_libraries_log_nothing_in_workers() -> None:
    with pool() as workers:
        assert outcomes(workers, tasks.log_level, ["rasterio", "tifffile"]) == ["CRITICAL", "CRITICAL"]


# ---- ends


SCRIPT = """
import signal
import sys
from multiprocessing import get_context
from agalign.host.process_pool import ProcessPool
from tests.host.pool_tasks import sleep
# A shell starts jobs in the background with this signal ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
with ProcessPool(4, get_context(sys.argv[1])) as workers:
    futures = [workers.submit(sleep, seconds) for seconds in [0.1] * 4 + [3600.0] * 8]
    for number, future in enumerate(futures):
        future.result()
        if number == 3:
            print("begun", flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("target", ["parent", in_full_run("group")])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, in_full_run(signal.SIGINT)])
@pytest.mark.parametrize("method", ["forkserver", in_full_run("spawn")])
def test_no_process_outlives_its_parent(method: str, number: int, target: str) -> None:
    root = Path(__file__).resolve().parents[2]
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "start_new_session": True, "cwd": root}
    with subprocess.Popen([sys.executable, "-c", SCRIPT, method], **given) as process:
        try:
            assert process.stdout.readline() == b"begun\n"
            children = psutil.Process(process.pid).children(recursive=True)
            assert len(children) >= 4
            (os.killpg if target == "group" else os.kill)(process.pid, number)
            assert process.wait() != 0
        finally:
            process.kill()
    psutil.wait_procs(children)
