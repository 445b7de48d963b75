"""Runners for the captures of a run: serial, threads, processes, or an executor such as Dask's."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Protocol, Self

from agalign.batch.capture import quiet
from agalign.batch.report import CaptureReport
from agalign.batch.workers import (
    DaskExecutor,
    OnStart,
    Task,
    applied_by,
    applied_in,
    do_capture,
    done_by,
    done_in,
    own_processes,
)
from agalign.capture.align import PairProgress
from agalign.pixels.raster import without_warnings
from agalign.values.apply import A, R
from agalign.values.capture import Capture
from agalign.values.processes import CAPTURES_WORTH_A_PROCESS

_MAX_WAITING_TASKS = 1000
"""Maximum number of tasks submitted to an executor at a time: enough for any cluster, and little memory."""
_MAX_THREADS = 4
"""More threads wait for the interpreter's lock."""
_MAX_READ_AHEAD_BYTES = 64 << 20
"""Larger files could displace files of the current capture from the page cache."""


class Runner(Protocol):
    """Processes captures. Worker processes start on `__enter__` and end on `__exit__`."""

    name: str

    def __enter__(self) -> Self: ...

    def __exit__(self, *reason: object) -> None: ...

    def apply(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]:
        """Apply a function to arguments, as `values.apply.Apply`."""
        ...

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """Yield the report of each task as it completes."""
        ...


class SerialRunner:
    """Captures one after another in this process; the next one's files are read in the meantime."""

    name = "serial"

    def __init__(self, on_start: OnStart = quiet, on_pair: PairProgress = quiet) -> None:
        self._on_start, self._on_pair = on_start, on_pair

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        pass

    def apply(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]:
        """Apply a function to arguments one after another."""
        return map(function, arguments)

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """Yield the report of each task in order, and call the listeners."""
        with ThreadPoolExecutor(1) as reader:
            for number, task in enumerate(tasks, start=1):
                self._on_start(task.capture)
                for following in tasks[number : number + 1]:
                    reader.submit(_read_ahead, following.capture)
                yield do_capture(task, self._on_pair)


class ProcessRunner:
    """Captures in processes of this machine."""

    name = "processes"

    def __init__(self, processes: int, timeout_s: float | None = None) -> None:
        self._processes, self._timeout_s = processes, timeout_s
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._pool = self._stack.enter_context(own_processes(self._processes))
        return self

    def __exit__(self, *reason: object) -> None:
        self._stack.__exit__(*reason)  # type: ignore[arg-type]

    def apply(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]:
        """Apply a function to arguments in the processes."""
        return applied_in(self._pool, function, arguments)

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """Yield the report of each task as it completes."""
        return done_in(self._pool, [task.absolute() for task in tasks], self._timeout_s)


class ExecutorRunner:
    """Captures on an executor of the caller, which is not shut down."""

    name = "executor"

    def __init__(self, executor: Executor, timeout_s: float | None = None) -> None:
        self._executor, self._timeout_s = executor, timeout_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        pass

    def apply(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]:
        """Apply a function to arguments on the executor."""
        return applied_by(self._executor, function, arguments, _MAX_WAITING_TASKS)

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """Yield the report of each task as it completes."""
        absolute = [task.absolute() for task in tasks]
        loss = self._executor.loss if isinstance(self._executor, DaskExecutor) else str
        return done_by(
            lambda task: self._executor.submit(do_capture, task), absolute, _MAX_WAITING_TASKS, self._timeout_s, loss
        )


class ThreadRunner(ExecutorRunner):
    """Captures in threads of this process: for a few captures faster than starting processes."""

    name = "threads"

    def __init__(self, threads: int) -> None:
        super().__init__(ThreadPoolExecutor(threads))
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        # Warning filters are global: threads that change and restore them would interfere.
        self._stack.enter_context(without_warnings())
        self._stack.enter_context(self._executor)
        return self

    def __exit__(self, *reason: object) -> None:
        self._stack.__exit__(*reason)  # type: ignore[arg-type]


def choose_runner(
    captures: int, cores: int, executor: Executor | None, timeout_s: float | None, on_start: OnStart,
    on_pair: PairProgress,
) -> Runner:  # fmt: skip
    """Return the runner for this number of captures and cores.

    Captures run on the executor if there is one; in processes if there are enough captures for two, or for a timeout
    (threads cannot be killed); else in threads, or serially with one core or capture.
    """
    if executor is not None:
        return ExecutorRunner(executor, timeout_s)
    if timeout_s is not None and captures:
        return ProcessRunner(min(cores, captures), timeout_s)
    processes = min(cores, captures // CAPTURES_WORTH_A_PROCESS)
    if processes > 1:
        return ProcessRunner(processes)
    threads = min(cores, captures, _MAX_THREADS)
    return ThreadRunner(threads) if threads > 1 else SerialRunner(on_start, on_pair)


def _read_ahead(capture: Capture) -> None:
    """Read the files of a capture into the page cache."""
    for path in {b.path for b in capture.bands}:
        with suppress(OSError):
            if path.stat().st_size <= _MAX_READ_AHEAD_BYTES:
                path.read_bytes()
