"""A pool of worker processes that share no lock: a killed or stopped worker cannot block the others.

Each worker has a pipe and a thread of this process, which waits for it. In concurrent.futures, loky, multiprocess,
billiard, mpire and pebble, workers share a queue or a lock, and most stop all workers when one is killed. An executor
of concurrent.futures with one worker hangs if that is killed while it sends a result.
"""

import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from queue import SimpleQueue
from typing import Any, Self, TypeVar

from agalign.errors import WorkerError, is_out_of_memory
from agalign.host.processes import (
    WorkerExit,
    environment_of_children,
    follow_parent,
    silence_libraries,
    without_interrupt_key,
    worker_context,
)

_MAX_DEATHS = 8
"""Number of workers that end in a row without a finished task between them, from which no more are started: the machine
lacks memory. Some neighbouring captures that no worker survives, such as damaged ones, cost only themselves."""
_MAX_TRIES = 2
"""A signal may kill a worker for reasons other than its task, such as a lack of memory."""
_MAX_TASKS_PER_WORKER = 500
"""Then a worker is replaced: libraries leak some kilobytes per capture."""
_START_TIMEOUT_S = 120.0
"""Importing torch from a network drive takes up to a minute."""
_ENDS_WITHIN_S = 10.0
"""Timeout for the end of a killed process, which takes milliseconds unless it waits for a disk or file server."""
_PROCESS_LOCK = threading.Lock()
"""Starting a process polls all others. Two threads that poll one process get a wrong exit code."""

A = TypeVar("A")
R = TypeVar("R")


class WorkerDiedError(Exception):
    """The worker process of a task ended before the task was done."""

    def __init__(self, exit_code: int | None) -> None:
        super().__init__(exit_code)
        self.exit_code = exit_code

    @property
    def by_signal(self) -> bool:
        """True if a signal ended the process."""
        return self.exit_code is None or self.exit_code < 0

    def __str__(self) -> str:
        if self.exit_code is None:
            return "unknown signal"
        return f"signal {-self.exit_code}" if self.exit_code < 0 else f"exit code {self.exit_code}"


class _Worker:
    """A worker process with one task at a time."""

    def __init__(self, context: BaseContext, initializer: Callable[[], object]) -> None:
        """Start the process. Raises OSError, RuntimeError or MemoryError if the system lacks something for it."""
        self.created_s = time.monotonic()
        self._has_ended = self._is_late = False
        self.pipe, worker_end = context.Pipe()
        # BaseContext has no Process in typeshed.
        self._process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=(worker_end, initializer), daemon=True
        )
        try:
            with without_interrupt_key():
                self._start()
        finally:
            worker_end.close()  # the process has the only other copy: the pipe ends with it

    def _start(self) -> None:
        """Start the process. A fork server that was killed refuses connections shortly before its end is known."""
        try:
            self._process.start()
        except (ConnectionError, EOFError):
            time.sleep(1)
            self._process.start()

    def answer(self, message: bytes | None, timeout_s: float | None = None) -> bytes:
        """Send a task, if any, and return the answer.

        Raises WorkerDiedError if the process ends first, and TimeoutError if it is killed at the time limit.
        """
        limit = threading.Timer(timeout_s or 0.0, self._kill_late)
        limit.daemon = True
        if timeout_s is not None:
            limit.start()
        try:
            if message is not None:
                self.pipe.send_bytes(message)
            return self.pipe.recv_bytes()
        except (EOFError, OSError):
            code = self._exit_code()
            raise TimeoutError if self._is_late else WorkerDiedError(code) from None
        except MemoryError:  # a part of the answer remains in the pipe
            self.kill()
            raise
        finally:
            limit.cancel()
            if timeout_s is not None:
                limit.join()

    def ended_idle(self) -> bool:
        """True if the process has ended without a task (one that is idle sends nothing), or is about to."""
        return self._is_late or self.pipe.poll()

    def _kill_late(self) -> None:
        self._is_late = True
        self.kill()

    def kill(self) -> None:
        """Kill the process."""
        if not self._has_ended:
            self._process.kill()
            if sys.platform != "win32":
                # `multiprocessing` regards a process as ended if its fork server was killed.
                with suppress(OSError):
                    os.kill(self._process.pid, signal.SIGKILL)

    def end(self) -> None:
        """Kill the process and wait for its end."""
        self.kill()
        self._exit_code()
        self.pipe.close()

    def _exit_code(self) -> int | None:
        """Wait for the end and return the exit code: -n for signal n, None if it is not known."""
        self._has_ended = bool(wait([self._process.sentinel], _ENDS_WITHIN_S))
        with _PROCESS_LOCK:
            code: int | None = self._process.exitcode
        return None if code == WorkerExit.LOST_SERVER else code


def _work(pipe: Connection, initializer: Callable[[], object]) -> None:
    """Main function of a worker process: initialise, then process tasks until the parent closes the pipe."""
    follow_parent()
    try:
        pipe.send_bytes(_answer(lambda: bool(initializer())))  # its result, such as a module, may not be picklable
        while True:
            pipe.send_bytes(_answer(partial(_call, pipe.recv_bytes())))
    except (EOFError, OSError):
        return
    except MemoryError:
        os._exit(WorkerExit.OUT_OF_MEMORY)


def _call(task: bytes) -> object:
    function, arguments = pickle.loads(task)
    return function(*arguments)


def _answer(call: Callable[[], object]) -> bytes:
    """Return the pickled (True, result) or (False, exception) of a call."""
    try:
        return pickle.dumps((True, call()), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)  # some exceptions can be pickled, but not unpickled
        except Exception:
            answer = pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer


@dataclass(eq=False)
class _Task:
    call: tuple[Callable[..., Any], tuple[Any, ...]]
    timeout_s: float | None
    future: "Future[Any]"
    tries: int = 0


class ProcessPool:
    """Calls functions in worker processes, which start in the background at once.

    If a signal kills a worker, its task is tried again once, after the others. A worker that cannot be started, or
    fails in `initializer`, reduces the size of the pool.
    """

    def __init__(
        self, processes: int, context: BaseContext, initializer: Callable[[], object] = silence_libraries
    ) -> None:
        """Raises WorkerError if no thread can be started."""
        self._worker_arguments = context, initializer
        self._tasks: SimpleQueue[_Task | None] = SimpleQueue()
        self._workers: list[_Worker] = []
        self.loss = ""
        """Why no task can complete any more; empty while tasks can."""
        self._deaths, self._last_death_s = 0, 0.0
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._size = processes
        for _ in range(processes):
            # Signal handlers run in the main thread, so none of them interrupts the start of a process.
            thread = threading.Thread(target=self._serve, daemon=True)
            try:
                thread.start()
                self._threads.append(thread)
            except RuntimeError as error:
                self._one_less(error)
        if not self._threads:
            raise WorkerError(self.loss)

    def submit(self, function: Callable[..., R], /, *arguments: Any, timeout_s: float | None = None) -> "Future[R]":
        """Schedule a call; the worker is killed if it takes longer than the timeout.

        The future raises the error of the function, TimeoutError, WorkerDiedError, or WorkerError if no worker can be
        started or workers end one after another.
        """
        future: Future[R] = Future()
        self._tasks.put(_Task((function, arguments), timeout_s, future))
        return future

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_reason: object) -> None:
        """Kill all processes."""
        self.loss = self.loss or "the pool is closed"
        for worker in list(self._workers):
            worker.kill()
        self._tasks.put(None)
        until_s = time.monotonic() + _ENDS_WITHIN_S
        for thread in self._threads:
            thread.join(max(until_s - time.monotonic(), 0.0))

    def _serve(self) -> None:
        """Give tasks to one worker after another, in a thread; end if one cannot be started."""
        try:
            while not self.loss:
                self._use_one_worker()
        except Exception as error:
            self._one_less(error)
        while self.loss and (task := self._next_task()) is not None:
            task.future.set_exception(WorkerError(self.loss))

    def _use_one_worker(self) -> None:
        """Start a worker and give it tasks until it ends. Raises any exception if it cannot be started."""
        with _PROCESS_LOCK:
            if self.loss:
                return
            worker = _Worker(*self._worker_arguments)
            self._workers.append(worker)
        try:
            if not self.loss:  # the pool may have been closed before the worker was in the list
                self._await_start(worker)
                self._use(worker)
        except WorkerDiedError as error:
            self._count_death(worker, error)
        finally:
            self._workers.remove(worker)
            worker.end()

    def _await_start(self, worker: _Worker) -> None:
        """Wait until a worker is ready.

        Raises WorkerDiedError if a signal killed it, the exception of the initializer, or WorkerError.
        """
        if not worker.pipe.poll(_START_TIMEOUT_S):
            raise WorkerError(f"not ready after {_START_TIMEOUT_S:g} s")
        try:
            is_ready, error = pickle.loads(worker.answer(None))
        except WorkerDiedError as death:
            if death.by_signal:
                raise
            if death.exit_code == WorkerExit.REIMPORTED:
                guard = "put its calls below a line 'if __name__ == \"__main__\":'"
                self.loss = f"the calling script runs again in each worker process; {guard}"
            raise WorkerError(f"ended with {death}") from None
        if not is_ready:
            raise error

    def _use(self, worker: _Worker) -> None:
        """Give tasks to a worker until it is replaced or the pool is closed. Raises WorkerDiedError."""
        for task in islice(iter(self._next_task, None), _MAX_TASKS_PER_WORKER):
            if worker.ended_idle():
                self._tasks.put(task)
                raise WorkerDiedError(None)
            task.tries += 1
            try:
                message = pickle.dumps(task.call, pickle.HIGHEST_PROTOCOL)
                is_good, value = pickle.loads(worker.answer(message, task.timeout_s))
            except TimeoutError as error:
                task.future.set_exception(error)
                return
            except WorkerDiedError as error:
                out_of_memory = error.exit_code == WorkerExit.OUT_OF_MEMORY
                if error.by_signal and task.tries < _MAX_TRIES:
                    self._tasks.put(task)
                else:
                    task.future.set_exception(MemoryError() if out_of_memory else error)
                raise
            except Exception as error:  # what cannot be pickled, or no thread for the time limit
                is_good, value = False, MemoryError() if is_out_of_memory(error) else error
            self._deaths = 0
            (task.future.set_result if is_good else task.future.set_exception)(value)

    def _next_task(self) -> _Task | None:
        """Wait for a task that is not cancelled; None if the pool is closed."""
        while (task := self._tasks.get()) is not None:
            if task.future.running() or task.future.set_running_or_notify_cancel():
                return task
        self._tasks.put(None)  # for the other threads
        return None

    def _one_less(self, error: Exception) -> None:
        """Reduce the size of the pool by a worker that could not be started; at size 0 the pool is lost."""
        problem = str(error) if isinstance(error, WorkerError) else f"{type(error).__name__}: {error}"
        with self._lock:
            self._size -= 1
            if self._size == 0 and not self.loss:
                advice = "close other programs, or try --jobs 1"
                self.loss = f"no worker process can be started ({problem}); {advice}"

    def _count_death(self, worker: _Worker, error: WorkerDiedError) -> None:
        """Count a worker that has ended; after several in a row the pool is lost."""
        with self._lock:
            # Workers killed at the same time count once: count only workers created after the last counted death.
            if worker.created_s > self._last_death_s:
                self._deaths, self._last_death_s = self._deaths + 1, time.monotonic()
            if self._deaths >= _MAX_DEATHS:
                self.loss = (
                    f"{_MAX_DEATHS} worker processes one after another ended before they finished anything (the last "
                    f"by {error}; out of memory?); finished captures are kept; try again with fewer --jobs"
                )


@contextmanager
def open_pool(
    processes: int, threads: int, initializer: Callable[[], object], preload: str = ""
) -> Iterator[ProcessPool]:
    """Provide worker processes with this number of threads each, as `worker_context` starts them."""
    with environment_of_children(threads), ProcessPool(processes, worker_context(preload), initializer) as pool:
        yield pool
