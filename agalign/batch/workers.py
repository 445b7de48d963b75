"""Processing a capture as a task: in this process, in worker processes, or on the workers of a cluster."""

import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import cv2

from agalign._version import __version__
from agalign.batch.capture import process_capture, quiet
from agalign.batch.report import CaptureReport, StageClock
from agalign.capture.align import PairProgress
from agalign.config import Settings
from agalign.errors import AgalignError, ConfigurationError, WorkerError
from agalign.flight.model import FlightModel, load_model
from agalign.method.device import choose_device, keep_freed_memory, limit_threads, one_memory_error, one_thread
from agalign.products.preview import preview_bytes
from agalign.values.capture import Capture
from agalign.values.cores import usable_cores
from agalign.values.process_pool import ProcessPool, WorkerDiedError
from agalign.values.processes import WORKER_MODULE, follow_parent, threads_of_children, worker_context

_FAULTS = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RuntimeError, OSError, cv2.error)
_LOG = logging.getLogger(__name__)
_DASK_TIMEOUT_S = 10
_POLL_INTERVAL_S = 5.0
"""Interval at which the state of a cluster is checked while no task completes."""
_TIMEOUT_EXIT_CODE = 75
_OUT_OF_MEMORY = "out of memory; try again with fewer --jobs, or with more memory"
_CAPTURES_A_PROCESS = 500
"""Number of captures after which a process is replaced: libraries leak some kilobytes per capture."""


@dataclass(frozen=True)
class Task:
    """One capture to process, as sent to a worker."""

    capture: Capture
    out: Path
    settings: Settings
    model: Path | None
    max_preview_bytes: int = preview_bytes(1)

    def absolute(self) -> "Task":
        """Return the task with absolute paths: workers may have another working folder."""
        model = None if self.model is None else self.model.absolute()
        return replace(self, capture=self.capture.with_absolute_paths(), out=self.out.absolute(), model=model)


T = TypeVar("T")
R = TypeVar("R")
Submit = Callable[[T], Future[R]]
CallPool = ProcessPool[Callable[[], Any], Any]
"""Worker processes that call functions."""
OnStart = Callable[[Capture], None]


def do_capture(task: Task, on_pair: PairProgress = quiet) -> CaptureReport:
    """Process one capture and return its report, which includes errors."""
    label, clock = task.capture.label, StageClock(on_pair)
    keep_freed_memory()
    try:
        device = task.settings.joint.device
        model = None if task.model is None else loaded_model(task.model, device, stamp(task.model))
        with one_thread(), one_memory_error():
            outcome = process_capture(task.capture, task.out, task.settings, clock, model, task.max_preview_bytes)
    except AgalignError as error:
        problem = str(error)
    except MemoryError:
        problem = _OUT_OF_MEMORY
    except _FAULTS as error:
        # A defect of agalign in one capture must not stop the others.
        problem = f"agalign failed on it ({type(error).__name__}: {error}); please report this"
        _LOG.debug("%s: %s", label, problem, exc_info=True)
    else:
        return CaptureReport(
            label, "done", outcome.sidecar.result(), outcome.path, shortcomings=outcome.shortcomings,
            seconds=clock.seconds, stages=clock.stages(),
        )  # fmt: skip
    return CaptureReport(label, "error", error=problem, seconds=clock.seconds, stages=clock.stages())


def done_by(
    submit: Submit[Task, CaptureReport], tasks: Sequence[Task], maximum: int, timeout_s: float | None = None,
    loss: Callable[[], str] = str,
) -> Iterator[CaptureReport]:  # fmt: skip
    """Yield the report of each task of an executor. Raises WorkerError like `finished_by`."""
    for task, result in finished_by(submit, tasks, maximum, loss):
        yield _report_of(result, task, timeout_s)


def finished_by(
    submit: Submit[T, R], tasks: Sequence[T], maximum: int, loss: Callable[[], str] = str
) -> Iterator[tuple[T, Callable[[], R]]]:
    """Yield each task of an executor as it completes, with a function that returns or raises its result.

    At most `maximum` tasks are submitted at a time, which limits memory. `loss` returns the reason why no task can
    complete any more, or an empty string. Raises WorkerError with that reason.
    """
    futures: dict[Future[R], T] = {}
    remaining = iter(tasks)
    try:
        for task in islice(remaining, maximum):
            futures[_submitted(submit, task)] = task
        while futures:
            done, _ = wait(futures, _POLL_INTERVAL_S, FIRST_COMPLETED)
            if not done and (reason := loss()):  # futures of a lost cluster may never be done
                raise WorkerError(reason)
            for future in done:
                task = futures.pop(future)
                if (future.cancelled() or future.exception() is not None) and (reason := loss()):
                    raise WorkerError(reason)
                yield task, future.result
                for following in islice(remaining, 1):
                    futures[_submitted(submit, following)] = following
    finally:
        for future in futures:
            future.cancel()


def _submitted(submit: Submit[T, R], task: T) -> "Future[R]":
    """Submit a task and return its future; if the executor is broken, its error is the outcome of the task."""
    try:
        return submit(task)
    except BrokenExecutor as error:
        failed: Future[R] = Future()
        failed.set_exception(error)
        return failed


def done_in(pool: CallPool, tasks: Sequence[Task], timeout_s: float | None = None) -> Iterator[CaptureReport]:
    """Yield the report of each task of a process pool. Raises WorkerError if no worker process can be started."""
    for outcome in pool.run([partial(do_capture, task) for task in tasks], timeout_s):
        yield _report_of(outcome.value, tasks[outcome.number], timeout_s)


def applied_in(pool: CallPool, function: Callable[[T], R], arguments: Sequence[T]) -> Iterator[R]:
    """Apply a function to arguments in a process pool, like `values.apply.Apply`."""
    outcomes = pool.run([partial(function, argument) for argument in arguments])
    return _in_order((outcome.number, outcome.value) for outcome in outcomes)


def applied_by(executor: Executor, function: Callable[[T], R], arguments: Sequence[T], maximum: int) -> Iterator[R]:
    """Apply a function to arguments on an executor, like `values.apply.Apply`; at most `maximum` at a time."""
    executor = executor.without_timeout() if isinstance(executor, DaskExecutor) else executor
    loss = executor.loss if isinstance(executor, DaskExecutor) else str

    def submit(number: int) -> Future[R]:
        return executor.submit(function, arguments[number])

    return _in_order(finished_by(submit, range(len(arguments)), maximum, loss))


def _in_order(finished: Iterable[tuple[int, Callable[[], R]]]) -> Iterator[R]:
    """Yield the results of numbered tasks in the order of the numbers. Raises WorkerError for lost workers."""
    waiting: dict[int, Callable[[], R]] = {}
    following = 0
    for number, result in finished:
        waiting[number] = result
        while following in waiting:
            yield _value_of(waiting.pop(following))
            following += 1


def _value_of(result: Callable[[], R]) -> R:
    try:
        return result()
    except (AgalignError, MemoryError):
        raise
    except (Exception, CancelledError) as error:
        _, problem = result_or_problem(result)
        raise WorkerError(f"the flight cannot be learned: {problem}") from error


def _report_of(result: Callable[[], CaptureReport], task: Task, timeout_s: float | None) -> CaptureReport:
    report, problem = result_or_problem(result, timeout_s)
    return CaptureReport(task.capture.label, "error", error=problem) if report is None else report


def result_or_problem(result: Callable[[], R], timeout_s: float | None = None) -> tuple[R | None, str]:
    """Return (result of a task, ""), or (None, one line about its failure)."""
    try:
        return result(), ""
    except TimeoutError:
        problem = f"stopped after {timeout_s or 0:g} s (--timeout)"
    except WorkerDiedError as error:
        problem = (
            f"its worker process was killed ({error}; out of memory?); run again to process the remaining captures"
        )
    except BrokenExecutor:
        problem = "the executor lost its processes (out of memory?); run again to process the remaining captures"
    except MemoryError:
        problem = _OUT_OF_MEMORY
    except AgalignError as error:
        problem = str(error)
    except (Exception, CancelledError) as error:
        first_line = next(iter(str(error).splitlines()), type(error).__name__)
        if isinstance(error, CancelledError) or type(error).__module__.partition(".")[0] == "distributed":
            problem = f"the cluster lost it ({first_line}); run again to process the remaining captures"
        else:
            problem = f"agalign failed on it ({type(error).__name__}: {first_line}); please report this"
    return None, problem


def _call(function: Callable[[], Any]) -> Any:
    return function()


@contextmanager
def own_processes(jobs: int) -> Iterator[CallPool]:
    """Start a pool of `jobs` worker processes, which import their libraries in the background."""
    threads = max(1, usable_cores() // jobs)
    context = worker_context(WORKER_MODULE)
    with (
        threads_of_children(threads),
        ProcessPool(_call, jobs, context, start_worker, (threads,), max_tasks_per_worker=_CAPTURES_A_PROCESS) as pool,
    ):
        yield pool


LOCAL = "local"
"""Value of `--dask` instead of a scheduler's address: start worker processes on this machine."""


@contextmanager
def dask_executor(address: str, jobs: int = 0, timeout_s: float | None = None) -> Iterator[Executor]:
    """Connect to a Dask cluster as an executor. Its workers need this version of agalign and the same folders.

    `address` is that of a scheduler, such as tcp://host:8786, or `local` for `jobs` worker processes on this machine; 0
    is one per core. Tasks of a lost worker are repeated by another. A capture that exceeds the timeout ends its worker,
    which its nanny restarts; the scheduler retries the capture as often as its setting `allowed-failures` permits.
    Raises ConfigurationError if Dask is not installed, the scheduler does not answer, or a worker has another version.
    """
    try:
        import dask
        from distributed import Client, LocalCluster, fire_and_forget
    except ImportError:
        raise ConfigurationError("Dask is not installed; pip install 'agalign[dask]'") from None
    with ExitStack() as stack:
        stack.enter_context(_quiet_dask())
        try:
            if address == LOCAL:
                # The profile appears on the dashboard only, and takes a few percent of the time.
                stack.enter_context(dask.config.set({"distributed.worker.profile.enabled": False}))
                cluster = LocalCluster(
                    n_workers=jobs or usable_cores(), threads_per_worker=1, processes=True, dashboard_address=None
                )
                address = stack.enter_context(cluster).scheduler_address
            client = Client(address, set_as_default=False, timeout=_DASK_TIMEOUT_S)
        except RuntimeError as error:
            raise ConfigurationError(f"no Dask cluster can be started here ({error})") from None
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"no Dask scheduler answers at {address} ({error})") from None
        _check_versions(stack.enter_context(client))
        # Workers import their libraries while this process learns the flight.
        for worker in client.ncores():
            fire_and_forget(client.submit(import_module, WORKER_MODULE, workers=[worker], pure=False))
        yield DaskExecutor(client, timeout_s)


def _check_versions(client: Any) -> None:
    """Raise ConfigurationError if a worker has no or another version of agalign.

    A worker without agalign ends when it receives a task, and the run would wait for other workers.
    """
    # A built-in function, because a worker without agalign cannot unpickle one of this package.
    versions = client.run(eval, "__import__('agalign._version', fromlist=['_']).__version__", on_error="return")
    if not versions:
        _LOG.warning("agalign: no worker is connected to the Dask scheduler; the run waits for one")
    for worker, version in sorted(versions.items()):
        if isinstance(version, Exception):
            problem = f"cannot load agalign ({version})"
        elif version != __version__:
            problem = f"has agalign {version}"
        else:
            continue
        raise ConfigurationError(f"the Dask worker at {worker} {problem}; install agalign {__version__} there")


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Silence the tracebacks that Dask logs for a lost scheduler; the run reports it in one line."""
    loggers = [logging.getLogger(name) for name in ("distributed.client", "distributed.deploy.spec", "tornado")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class DaskExecutor(Executor):
    """The workers of a Dask cluster. A task that exceeds the timeout ends its worker."""

    def __init__(self, client: Any, timeout_s: float | None) -> None:
        self._client, self._executor, self._timeout_s = client, client.get_executor(pure=False), timeout_s

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        return self._executor.submit(_within, self._timeout_s, _on_worker, __version__, function, *arguments, **named)

    def without_timeout(self) -> "DaskExecutor":
        """Return the same executor without a time limit."""
        return DaskExecutor(self._client, None)

    def loss(self) -> str:
        """Return why no task can complete any more; empty while the scheduler answers."""
        if self._client.status == "running":
            return ""
        return (
            "the Dask scheduler does not answer any more; finished captures are kept, and the same command resumes "
            "the run"
        )


def _on_worker(version: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function in one thread; OMP_NUM_THREADS, which Dask sets, does not limit all libraries.

    Raises ConfigurationError on a worker with another version, which may have joined during the run.
    """
    if version != __version__:
        raise ConfigurationError(f"a Dask worker has agalign {__version__}; install agalign {version} there")
    limit_threads(1)
    return function(*arguments, **named)


def _within(timeout_s: float | None, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function; end this process if it takes longer: code that hangs in a library cannot be interrupted."""
    if timeout_s is None:
        return function(*arguments, **named)
    alarm = threading.Timer(timeout_s, os._exit, (_TIMEOUT_EXIT_CODE,))
    alarm.start()
    try:
        return function(*arguments, **named)
    finally:
        alarm.cancel()


def start_worker(threads: int) -> None:
    """Initialise a worker process."""
    follow_parent()
    limit_threads(threads)


def stamp(path: Path) -> int:
    """Return the modification time of a model, ns: it changes when the model is learned again."""
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


@lru_cache(maxsize=8)
def loaded_model(path: Path, device: str, _stamp: int) -> FlightModel:
    """Return the model in a file, which each worker reads once per `stamp`. Raises InputError."""
    return load_model(path, lambda: choose_device(device))
