"""A pool of worker processes that share no lock: a killed or stopped worker cannot block the others.

In concurrent.futures, loky, multiprocess, billiard, mpire and pebble, workers share a queue or a lock, and most stop
all workers when one is killed.
"""

import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.context import BaseContext
from typing import Any, Generic, Self, TypeVar

from agalign.errors import WorkerError
from agalign.values.processes import REIMPORTED_EXIT_CODE
from agalign.values.worker_process import ENDS_WITHIN_S, LOST_SERVER_EXIT_CODE, Worker, is_out_of_memory

_MAX_DEATHS = 3
"""Maximum number of workers that end in a row without a finished task between them; then the run ends."""
_MAX_TRIES = 2
"""A signal may kill a worker for reasons other than its task, such as a lack of memory."""
_START_TIMEOUT_S = 120.0
"""Importing torch from a network drive takes up to a minute."""
_CHUNK_TIMEOUT_S = 1.0
"""Extension of a deadline after each chunk of a result: the caller may take time over outcomes while a worker sends."""
_POLL_INTERVAL_S = 1.0
"""On Windows, SIGINT is handled only between two waits."""
_MAX_WINDOWS_PROCESSES = 30
"""Windows waits for at most 63 objects; a worker has two."""

A = TypeVar("A")
R = TypeVar("R")


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


@dataclass(eq=False)
class _Place(Generic[A]):
    """A worker and its current task."""

    worker: Worker
    deadline_s: float | None
    task: _Task[A] | None = None
    finished: int = 0

    @property
    def idle(self) -> bool:
        return self.worker.ready and self.task is None

    @property
    def kill_time_s(self) -> float:
        """Time at which the worker is killed, monotonic clock."""
        return float("inf") if self.deadline_s is None else max(self.deadline_s, self.worker.heard_s + _CHUNK_TIMEOUT_S)


_ADVICE = "close other programs, or try --jobs 1"
_UNGUARDED = (
    "the calling script runs again in each worker process; put its calls below a line 'if __name__ == \"__main__\":'"
)


class ProcessPool(Generic[A, R]):
    """Applies a function to arguments in worker processes, which start in the background at once.

    If a signal kills a worker, its task is tried again once, after the others. A worker that cannot be started, or
    fails in `initializer`, reduces the size of the pool. A worker is replaced after `max_tasks_per_worker` tasks.
    """

    def __init__(
        self, function: Callable[[A], R], processes: int, context: BaseContext,
        initializer: Callable[..., object], arguments: tuple[Any, ...] = (), *, max_tasks_per_worker: int = sys.maxsize,
    ) -> None:  # fmt: skip
        self._function, self._max_tasks = function, max_tasks_per_worker
        self._worker_arguments = context, initializer, arguments
        self._size = min(processes, _MAX_WINDOWS_PROCESSES) if sys.platform == "win32" else processes
        self._places: list[_Place[A]] = []
        self._leaving: list[Worker] = []
        self._waiting: deque[_Task[A]] = deque()
        self._deaths, self._last_death_s, self._given_up = 0, 0.0, ""
        self._start(self._size)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_reason: object) -> None:
        """End all processes: close the pipes of idle ones, kill the others."""
        workers = [*self._leaving, *(place.worker for place in self._places)]
        for place in self._places:
            if place.task is None:
                place.worker.let_end()
        until_s = time.monotonic() + ENDS_WITHIN_S
        for place in self._places:
            if not place.idle:
                place.worker.kill(max(until_s - time.monotonic(), 0.0))
        for worker in workers:
            if worker.exit_code(max(until_s - time.monotonic(), 0.0)) is None:
                worker.kill(max(until_s - time.monotonic(), 0.0))
                worker.exit_code()
        self._places, self._leaving = [], []

    def run(self, arguments: Iterable[A], timeout_s: float | None = None) -> Iterator[Outcome[A, R]]:
        """Yield the outcome of each task as it completes. The worker of a task that exceeds the timeout is killed.

        Raises WorkerError if no worker can be started, or if workers end one after another.
        """
        self._waiting.extend(_Task(number, argument) for number, argument in enumerate(arguments))
        while self._is_unfinished():
            outcomes = [*self._assign(timeout_s)]
            if not outcomes:
                self._wait()
                for place in list(self._places):
                    outcomes += self._check(place)
                outcomes += self._assign(timeout_s)  # before the caller takes time over the outcomes
            yield from outcomes
            if self._given_up and self._is_unfinished():
                raise WorkerError(self._given_up)

    def _is_unfinished(self) -> bool:
        return bool(self._waiting) or any(place.task for place in self._places)

    def _start(self, count: int) -> None:
        for _ in range(count):
            try:
                worker = Worker(*self._worker_arguments)
            except (OSError, RuntimeError, MemoryError) as error:
                self._one_less(f"{type(error).__name__}: {error}")
            else:
                self._places.append(_Place(worker, worker.created_s + _START_TIMEOUT_S))

    def _one_less(self, problem: str) -> None:
        """Reduce the size of the pool after a worker could not be started; at size 0 the run ends."""
        self._size -= 1
        if self._size == 0:
            self._given_up = f"no worker process can be started ({problem}); {_ADVICE}"

    def _assign(self, timeout_s: float | None) -> Iterator[Outcome[A, R]]:
        """Send waiting tasks to idle workers, and start new workers for the remaining tasks.

        Yields the outcome of tasks that cannot be sent.
        """
        for place in [place for place in self._places if place.idle]:
            while self._waiting and place.idle and place in self._places:
                task = self._waiting.popleft()
                try:
                    message = pickle.dumps((self._function, task.argument), pickle.HIGHEST_PROTOCOL)
                except Exception as error:
                    yield Outcome(task.number, task.argument, error=error)
                    continue
                try:
                    place.worker.send(message)
                except OSError:  # the worker ended while it was idle
                    self._waiting.appendleft(task)
                    self._remove(place)
                else:
                    place.task = task
                    place.deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        coming = sum(not place.worker.ready for place in self._places)
        if not self._given_up:
            self._start(min(self._size - len(self._places), len(self._waiting) - coming))

    def _wait(self) -> None:
        """Wait until a worker sends a message, ends, or exceeds its deadline."""
        left_s = min((place.kill_time_s for place in self._places), default=0.0) - time.monotonic()
        objects = [o for place in self._places for o in place.worker.waits_for()]
        wait(objects, min(max(left_s, 0.0), _POLL_INTERVAL_S))

    def _check(self, place: _Place[A]) -> list[Outcome[A, R]]:
        """Receive a message of a worker; check whether it has ended or exceeds its deadline."""
        worker, task = place.worker, place.task
        message = worker.receive()
        if message is not None:
            return self._take(place, message)
        if worker.has_ended():
            return self._remove(place)
        if time.monotonic() < place.kill_time_s:
            return []
        self._end(place)
        if task is not None:
            return [Outcome(task.number, task.argument, error=TimeoutError())]
        self._one_less(f"not ready after {_START_TIMEOUT_S:g} s")
        return []

    def _take(self, place: _Place[A], message: bytes) -> list[Outcome[A, R]]:
        """Process a message of a worker: it is ready, its start has failed, or it returns the result of its task."""
        try:
            good, value = pickle.loads(message)
        except Exception as error:
            good, value = False, error
        place.deadline_s, task, place.task = None, place.task, None
        if task is None:
            place.worker.ready = good
            if not good:
                self._end(place)
                self._one_less(str(value))
            return []
        self._deaths = 0
        place.finished += 1
        if place.finished >= self._max_tasks:
            self._end(place)
        if good:
            return [Outcome(task.number, task.argument, value)]
        return [Outcome(task.number, task.argument, error=value)]

    def _end(self, place: _Place[A]) -> None:
        """Remove a worker from the pool and end it, without waiting for that."""
        self._places.remove(place)
        place.worker.let_end() if place.idle else place.worker.kill()
        self._leaving = [worker for worker in [*self._leaving, place.worker] if worker.exit_code(0) is None]

    def _remove(self, place: _Place[A]) -> list[Outcome[A, R]]:
        """Remove a worker that has ended; return the outcome of its task unless that is tried again."""
        worker, task = place.worker, place.task
        code = worker.exit_code()
        self._end(place)
        by_signal = code is not None and (code < 0 or code == LOST_SERVER_EXIT_CODE)
        if code == REIMPORTED_EXIT_CODE:
            self._size, self._given_up = 0, _UNGUARDED
            return []
        if not (worker.ready or by_signal):
            self._one_less(worker.problem or f"ended with exit code {code}")
            return []
        error: Exception = MemoryError() if is_out_of_memory(code) else WorkerDiedError(code)
        # Workers killed at the same time count once: count only workers created after the last counted death.
        if worker.created_s > self._last_death_s:
            self._deaths, self._last_death_s = self._deaths + 1, time.monotonic()
        if self._deaths >= _MAX_DEATHS:
            self._given_up = (
                f"{_MAX_DEATHS} worker processes one after another ended before they finished anything (the last by "
                f"{error}; out of memory?); finished captures are kept; try again with fewer --jobs"
            )
        if task is None:
            return []
        task.tries += 1
        if by_signal and task.tries < _MAX_TRIES:
            self._waiting.append(task)
            return []
        return [Outcome(task.number, task.argument, error=error)]
