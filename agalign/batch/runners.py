"""The ways to do the captures of a run: one after another, in threads, in processes, or on an executor such as
Dask's.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Protocol, Self

from agalign.batch.capture import quiet
from agalign.batch.report import CaptureReport
from agalign.batch.workers import DaskExecutor, OnStart, Task, do_capture, done_by, done_in, own_processes
from agalign.capture.align import PairProgress
from agalign.pixels.raster import without_warnings
from agalign.values.capture import Capture
from agalign.values.processes import CAPTURES_WORTH_A_PROCESS

_MAX_WAITING_TASKS = 1000
"""In an executor: enough for any cluster, and little memory."""
_MAX_THREADS = 4
"""More wait for the interpreter's lock."""
_MAX_READ_AHEAD_BYTES = 64 << 20
"""Larger files would push what the current capture reads out of the system's cache."""


class Runner(Protocol):
    """A way to do captures. Processes start when it is entered, and have ended when it is left."""

    name: str

    def __enter__(self) -> Self: ...

    def __exit__(self, *reason: object) -> None: ...

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """The report of each task, as it is done."""
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

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """As `Runner` has it; the listeners are called."""
        with ThreadPoolExecutor(1) as reader:
            for number, task in enumerate(tasks, start=1):
                self._on_start(task.capture)
                for following in tasks[number : number + 1]:
                    reader.submit(_read_ahead, following.capture)
                yield do_capture(task, self._on_pair)


class ProcessRunner:
    """Captures in processes of this machine, which load what they need while the flight is learned."""

    name = "processes"

    def __init__(self, processes: int, timeout_s: float | None = None) -> None:
        self._processes, self._timeout_s = processes, timeout_s
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._pool = self._stack.enter_context(own_processes(self._processes))
        return self

    def __exit__(self, *reason: object) -> None:
        self._stack.__exit__(*reason)  # type: ignore[arg-type]

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """As `Runner` has it."""
        return done_in(self._pool, [task.absolute() for task in tasks], self._timeout_s)


class ExecutorRunner:
    """Captures on an executor of the caller's, which stays open."""

    name = "executor"

    def __init__(self, executor: Executor, timeout_s: float | None = None) -> None:
        self._executor, self._timeout_s = executor, timeout_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        pass

    def reports(self, tasks: Sequence[Task]) -> Iterator[CaptureReport]:
        """As `Runner` has it."""
        absolute = [task.absolute() for task in tasks]
        loss = self._executor.loss if isinstance(self._executor, DaskExecutor) else str
        return done_by(
            lambda task: self._executor.submit(do_capture, task), absolute, _MAX_WAITING_TASKS, self._timeout_s, loss
        )


class ThreadRunner(ExecutorRunner):
    """A few captures in threads of this process, which takes less time than to start processes for them."""

    name = "threads"

    def __init__(self, threads: int) -> None:
        super().__init__(ThreadPoolExecutor(threads))
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        # Filters of warnings are of the whole process: threads that change them restore each other's.
        self._stack.enter_context(without_warnings())
        self._stack.enter_context(self._executor)
        return self

    def __exit__(self, *reason: object) -> None:
        self._stack.__exit__(*reason)  # type: ignore[arg-type]


def choose_runner(
    captures: int, cores: int, executor: Executor | None, timeout_s: float | None, on_start: OnStart,
    on_pair: PairProgress,
) -> Runner:  # fmt: skip
    """The executor, where there is one; processes where there are captures enough for two, or where a timeout may have
    to end one; else threads, or for one core or capture none.
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
    """Bring the files of a capture into the system's cache."""
    for path in {b.path for b in capture.bands}:
        with suppress(OSError):
            if path.stat().st_size <= _MAX_READ_AHEAD_BYTES:
                path.read_bytes()
