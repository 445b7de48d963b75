"""A pool of worker processes that share no lock: a killed or stopped worker cannot block the others.

In concurrent.futures, loky, multiprocess, billiard, mpire and pebble, workers share a queue or a lock, and most stop
all workers when one is killed.
"""

import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.context import BaseContext
from typing import Any, Generic, Protocol, Self, TypeVar

from agalign.errors import WorkerError
from agalign.values.processes import ENDS_WITHIN_S, ExitCode, Worker

_MAX_DEATHS = 3
"""Maximum number of workers that end in a row without a finished task between them; then the run ends."""
_START_TIMEOUT_S = 120.0
"""Importing torch from a network drive takes up to a minute."""
_POLL_INTERVAL_S = 1.0
"""On Windows, SIGINT is handled only between two waits."""

A = TypeVar("A")
R = TypeVar("R")


class Apply(Protocol):
    """Applies a function to each argument and yields the results in order, as `map` does in this process.

    Function, arguments and results can be pickled. Raises the errors of the function, and WorkerError for lost workers.
    """

    def __call__(self, function: Callable[[A], R], arguments: Sequence[A], /) -> Iterator[R]: ...


class WorkerDiedError(Exception):
    """The worker process of a task ended before the task was done."""

    def __init__(self, exit_code: int | None) -> None:
        super().__init__(exit_code)
        self.exit_code = exit_code

    def __str__(self) -> str:
        if self.exit_code is None:
            return "killed"
        return f"signal {-self.exit_code}" if self.exit_code < 0 else f"exit code {self.exit_code}"


@dataclass(frozen=True)
class Outcome(Generic[A, R]):
    """The result of a task, or its error."""

    number: int
    """Index of the argument, from 0."""
    argument: A
    result: R | None = None
    error: Exception | None = None
    """Exception of the function, TimeoutError after the time limit, or WorkerDiedError."""

    def value(self) -> R:
        """The result. Raises the error."""
        if self.error is not None:
            raise self.error
        return self.result  # type: ignore[return-value]


@dataclass(eq=False)
class _Task(Generic[A]):
    number: int
    argument: A
    tries: int = 0


class ProcessPool(Generic[A, R]):
    """Applies a function to arguments in worker processes, which start in the background at once.

    If a signal kills a worker, its task is tried again once, after the others. A worker that cannot be started, or
    fails in `initializer`, reduces the size of the pool. A worker is replaced after `max_tasks_per_worker` tasks.
    """

    def __init__(
        self,
        function: Callable[[A], R],
        processes: int,
        context: BaseContext,
        initializer: Callable[..., object],
        arguments: tuple[Any, ...] = (),
        *,
        max_tasks_per_worker: int = sys.maxsize,
    ) -> None:
        self._function, self._max_tasks = function, max_tasks_per_worker
        self._worker_arguments = context, initializer, arguments
        max_windows_processes = 30  # Windows waits for at most 63 objects; a worker has two
        self._size = min(processes, max_windows_processes) if sys.platform == "win32" else processes
        self._workers: list[Worker] = []
        self._leaving: list[Worker] = []
        self._waiting: deque[_Task[A]] = deque()
        self._deaths, self._last_death_s, self._given_up = 0, 0.0, ""
        self._start(self._size)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_reason: object) -> None:
        """End all processes: close the pipes of idle ones, kill the others."""
        for worker in self._workers:
            if worker.task is None:
                worker.let_end()
        until_s = time.monotonic() + ENDS_WITHIN_S
        for worker in self._workers:
            if not worker.idle:
                worker.kill(max(until_s - time.monotonic(), 0.0))
        for worker in (*self._leaving, *self._workers):
            if worker.exit_code(max(until_s - time.monotonic(), 0.0)) is None:
                worker.kill(max(until_s - time.monotonic(), 0.0))
                worker.exit_code()
        self._workers, self._leaving = [], []

    def run(self, arguments: Iterable[A], timeout_s: float | None = None) -> Iterator[Outcome[A, R]]:
        """Yield the outcome of each task as it completes. The worker of a task that exceeds the timeout is killed.

        Raises WorkerError if no worker can be started, or if workers end one after another.
        """
        self._waiting.extend(_Task(number, argument) for number, argument in enumerate(arguments))
        while self._is_unfinished():
            outcomes = [*self._assign(timeout_s)]
            if not outcomes:
                self._wait()
                for worker in list(self._workers):
                    outcomes += self._check(worker)
                outcomes += self._assign(timeout_s)  # before the caller takes time over the outcomes
            yield from outcomes
            if self._given_up and self._is_unfinished():
                raise WorkerError(self._given_up)

    def _is_unfinished(self) -> bool:
        return bool(self._waiting) or any(worker.task for worker in self._workers)

    def _start(self, count: int) -> None:
        for _ in range(count):
            try:
                worker = Worker(*self._worker_arguments)
            except (OSError, RuntimeError, MemoryError) as error:
                self._one_less(f"{type(error).__name__}: {error}")
            else:
                worker.deadline_s = worker.created_s + _START_TIMEOUT_S
                self._workers.append(worker)

    def _one_less(self, problem: str) -> None:
        """Reduce the size of the pool after a worker could not be started; at size 0 the run ends."""
        self._size -= 1
        if self._size == 0:
            advice = "close other programs, or try --jobs 1"
            self._given_up = f"no worker process can be started ({problem}); {advice}"

    def _assign(self, timeout_s: float | None) -> Iterator[Outcome[A, R]]:
        """Send waiting tasks to idle workers, and start new workers for the remaining tasks.

        Yields the outcome of tasks that cannot be sent.
        """
        for worker in [worker for worker in self._workers if worker.idle]:
            while self._waiting and worker.idle and worker in self._workers:
                yield from self._send(self._waiting.popleft(), worker, timeout_s)
        coming = sum(not worker.ready for worker in self._workers)
        if not self._given_up:
            self._start(min(self._size - len(self._workers), len(self._waiting) - coming))

    def _send(self, task: _Task[A], worker: Worker, timeout_s: float | None) -> list[Outcome[A, R]]:
        """Send a task to an idle worker; return the outcome of a task that cannot be sent."""
        try:
            message = pickle.dumps((self._function, task.argument), pickle.HIGHEST_PROTOCOL)
        except Exception as error:
            return [Outcome(task.number, task.argument, error=error)]
        try:
            worker.send(message)
        except OSError:  # the worker ended while it was idle
            self._waiting.appendleft(task)
            self._remove(worker)
        else:
            worker.task = task
            worker.deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        return []

    def _wait(self) -> None:
        """Wait until a worker sends a message, ends, or exceeds its deadline."""
        left_s = min((worker.kill_time_s for worker in self._workers), default=0.0) - time.monotonic()
        objects = [o for worker in self._workers for o in worker.waits_for()]
        wait(objects, min(max(left_s, 0.0), _POLL_INTERVAL_S))

    def _check(self, worker: Worker) -> list[Outcome[A, R]]:
        """Receive a message of a worker; check whether it has ended or exceeds its deadline."""
        task, message = worker.task, worker.receive()
        if message is not None:
            return self._take(worker, message)
        if worker.has_ended():
            return self._remove(worker)
        if time.monotonic() < worker.kill_time_s:
            return []
        self._end(worker)
        if task is not None:
            return [Outcome(task.number, task.argument, error=TimeoutError())]
        self._one_less(f"not ready after {_START_TIMEOUT_S:g} s")
        return []

    def _take(self, worker: Worker, message: bytes) -> list[Outcome[A, R]]:
        """Process a message of a worker: it is ready, its start has failed, or it returns the result of its task."""
        try:
            good, value = pickle.loads(message)
        except Exception as error:
            good, value = False, error
        worker.deadline_s, task, worker.task = None, worker.task, None
        if task is None:
            worker.ready = good
            if not good:
                self._end(worker)
                self._one_less(str(value))
            return []
        self._deaths = 0
        worker.finished += 1
        if worker.finished >= self._max_tasks:
            self._end(worker)
        if good:
            return [Outcome(task.number, task.argument, value)]
        return [Outcome(task.number, task.argument, error=value)]

    def _end(self, worker: Worker) -> None:
        """Remove a worker from the pool and end it, without waiting for that."""
        self._workers.remove(worker)
        worker.let_end() if worker.idle else worker.kill()
        self._leaving = [one for one in [*self._leaving, worker] if one.exit_code(0) is None]

    def _remove(self, worker: Worker) -> list[Outcome[A, R]]:
        """Remove a worker that has ended; return the outcome of its task unless that is tried again."""
        task, code = worker.task, worker.exit_code()
        self._end(worker)
        by_signal = code is not None and (code < 0 or code == ExitCode.LOST_SERVER)
        if code == ExitCode.REIMPORTED:
            guard = "put its calls below a line 'if __name__ == \"__main__\":'"
            self._size, self._given_up = 0, f"the calling script runs again in each worker process; {guard}"
            return []
        if not (worker.ready or by_signal):
            self._one_less(worker.problem or f"ended with exit code {code}")
            return []
        error: Exception = MemoryError() if code == ExitCode.OUT_OF_MEMORY else WorkerDiedError(code)
        self._count_death(worker, error)
        if task is None:
            return []
        task.tries += 1
        max_tries = 2  # a signal may kill a worker for reasons other than its task, such as a lack of memory
        if by_signal and task.tries < max_tries:
            self._waiting.append(task)
            return []
        return [Outcome(task.number, task.argument, error=error)]

    def _count_death(self, worker: Worker, error: Exception) -> None:
        """Count a worker that has ended; after several in a row the run ends."""
        # Workers killed at the same time count once: count only workers created after the last counted death.
        if worker.created_s > self._last_death_s:
            self._deaths, self._last_death_s = self._deaths + 1, time.monotonic()
        if self._deaths >= _MAX_DEATHS:
            self._given_up = (
                f"{_MAX_DEATHS} worker processes one after another ended before they finished anything (the last by "
                f"{error}; out of memory?); finished captures are kept; try again with fewer --jobs"
            )
