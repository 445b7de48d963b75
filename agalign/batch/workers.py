"""One capture as a task, and who does it: this process, others, or the workers of a cluster."""

import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
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
from functools import lru_cache
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
from agalign.values.process_pool import Outcome, ProcessPool, WorkerDiedError
from agalign.values.processes import follow_parent, threads_of_children, worker_context

_FAULTS = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RuntimeError, OSError, cv2.error)
_LOG = logging.getLogger(__name__)
_DASK_ANSWERS_WITHIN_S = 10
_LOOKS_EVERY_S = 5.0
"""How often the state of a cluster is checked while no task is done."""
_GIVEN_UP_EXIT_CODE = 75
_OUT_OF_MEMORY = "out of memory; try again with fewer --jobs, or with more memory"
_CAPTURES_A_PROCESS = 500
"""Libraries keep some kilobytes of each; then a process makes room for a new one."""


@dataclass(frozen=True)
class Task:
    """One capture to be done, as it travels to a worker."""

    capture: Capture
    out: Path
    settings: Settings
    model: Path | None
    max_preview_bytes: int = preview_bytes(1)

    def absolute(self) -> "Task":
        """With absolute paths: workers elsewhere have another working folder."""
        bands = tuple(replace(b, path=b.path.absolute()) for b in self.capture.bands)
        model = None if self.model is None else self.model.absolute()
        return replace(self, capture=replace(self.capture, bands=bands), out=self.out.absolute(), model=model)


T = TypeVar("T")
R = TypeVar("R")
Submit = Callable[[T], Future[R]]
CapturePool = ProcessPool[Task, CaptureReport]
OnStart = Callable[[Capture], None]


def do_capture(task: Task, on_pair: PairProgress = quiet) -> CaptureReport:
    """Do one capture; what can go wrong with it is in the report."""
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
        # A fault of this program: it must not cost the captures that follow.
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
    """The report of each task, as an executor does them. Raises WorkerError as `finished_by` does."""
    for task, result in finished_by(submit, tasks, maximum, loss):
        yield _report_of(result, task, timeout_s)


def finished_by(
    submit: Submit[T, R], tasks: Sequence[T], maximum: int, loss: Callable[[], str] = str
) -> Iterator[tuple[T, Callable[[], R]]]:
    """Each task and what returns or raises its result, as an executor does them.

    Never more than `maximum` are handed over at a time, so that a season's captures do not wait in memory. `loss`
    returns why no task can be done any more, or nothing. Raises WorkerError with that reason.
    """
    futures: dict[Future[R], T] = {}
    remaining = iter(tasks)
    try:
        for task in islice(remaining, maximum):
            futures[_submitted(submit, task)] = task
        while futures:
            done, _ = wait(futures, _LOOKS_EVERY_S, FIRST_COMPLETED)
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
    """The future of a task; an executor that lost its processes refuses it, which is this task's outcome."""
    try:
        return submit(task)
    except BrokenExecutor as error:
        refused: Future[R] = Future()
        refused.set_exception(error)
        return refused


def done_in(pool: CapturePool, tasks: Sequence[Task], timeout_s: float | None = None) -> Iterator[CaptureReport]:
    """The report of each task, as worker processes do them. Raises WorkerError where they cannot."""

    def report(outcome: Outcome[Task, CaptureReport]) -> CaptureReport:
        return _report_of(outcome.value, outcome.argument, timeout_s)

    return map(report, pool.run(tasks, timeout_s))


def _report_of(result: Callable[[], CaptureReport], task: Task, timeout_s: float | None) -> CaptureReport:
    report, problem = result_or_problem(result, timeout_s)
    return CaptureReport(task.capture.label, "error", error=problem) if report is None else report


def result_or_problem(result: Callable[[], R], timeout_s: float | None = None) -> tuple[R | None, str]:
    """Result of a task, or None and one line about its failure."""
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
        said = next(iter(str(error).splitlines()), type(error).__name__)
        if isinstance(error, CancelledError) or type(error).__module__.partition(".")[0] == "distributed":
            problem = f"the cluster lost it ({said}); run again to process the remaining captures"
        else:
            problem = f"agalign failed on it ({type(error).__name__}: {said}); please report this"
    return None, problem


@contextmanager
def own_processes(jobs: int) -> Iterator[CapturePool]:
    """So many processes of our own, which load what they need while the caller does something else."""
    threads = max(1, usable_cores() // jobs)
    context = worker_context(__name__)
    with (
        threads_of_children(threads),
        ProcessPool(
            do_capture, jobs, context, start_worker, (threads,), max_tasks_per_worker=_CAPTURES_A_PROCESS
        ) as pool,
    ):
        yield pool


LOCAL = "local"
"""In place of a scheduler's address: a cluster of worker processes on this machine."""


@contextmanager
def dask_executor(address: str, jobs: int = 0, timeout_s: float | None = None) -> Iterator[Executor]:
    """The workers of a Dask cluster as an executor. Each needs this package and sees the same folders.

    `address` is a scheduler's, such as tcp://host:8786, or `local` for so many worker processes here, 0 being one a
    core. What a lost worker was doing is done by another. A capture that takes longer than the timeout ends its worker,
    which its nanny replaces; the scheduler tries it on other workers, as often as its setting `allowed-failures` has
    it, before it is abandoned. Raises ConfigurationError where Dask is not installed, the scheduler does not answer, or
    a worker lacks this version of the package.
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
                # Without a dashboard nobody sees the profile, which costs a few percent.
                stack.enter_context(dask.config.set({"distributed.worker.profile.enabled": False}))
                cluster = LocalCluster(
                    n_workers=jobs or usable_cores(), threads_per_worker=1, processes=True, dashboard_address=None
                )
                address = stack.enter_context(cluster).scheduler_address
            client = Client(address, set_as_default=False, timeout=_DASK_ANSWERS_WITHIN_S)
        except RuntimeError as error:
            raise ConfigurationError(f"no Dask cluster can be started here ({error})") from None
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"no Dask scheduler answers at {address} ({error})") from None
        _check_versions(stack.enter_context(client))
        # Workers import the libraries of a capture while the flight is learned here.
        for worker in client.ncores():
            fire_and_forget(client.submit(import_module, __name__, workers=[worker], pure=False))
        yield DaskExecutor(client, timeout_s)


def _check_versions(client: Any) -> None:
    """Raise ConfigurationError where a worker cannot load this version of the package.

    A worker without the package ends when it receives a task, and the run would wait for other workers.
    """
    # Workers without the package know the built-in functions only.
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
    """What Dask logs of a lost scheduler is a traceback; the run reports it in one line."""
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
    """The workers of a Dask cluster. A task that takes too long ends its worker."""

    def __init__(self, client: Any, timeout_s: float | None) -> None:
        self._client, self._executor, self._timeout_s = client, client.get_executor(pure=False), timeout_s

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        return self._executor.submit(_within, self._timeout_s, _on_worker, __version__, function, *arguments, **named)

    def loss(self) -> str:
        """Return why no task can be done any more; nothing while the scheduler answers."""
        if self._client.status == "running":
            return ""
        return (
            "the Dask scheduler does not answer any more; finished captures are kept, and the same command resumes "
            "the run"
        )


def _on_worker(version: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call a function in one thread, as Dask sets OMP_NUM_THREADS for libraries that read it.

    Raises ConfigurationError on a worker of another version, which may have joined during the run.
    """
    if version != __version__:
        raise ConfigurationError(f"a Dask worker has agalign {__version__}; install agalign {version} there")
    limit_threads(1)
    return function(*arguments, **named)


def _within(timeout_s: float | None, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """What hangs in a library hears nothing: only the end of its process ends it."""
    if timeout_s is None:
        return function(*arguments, **named)
    alarm = threading.Timer(timeout_s, os._exit, (_GIVEN_UP_EXIT_CODE,))
    alarm.start()
    try:
        return function(*arguments, **named)
    finally:
        alarm.cancel()


def start_worker(threads: int) -> None:
    """What a worker process does first."""
    follow_parent()
    limit_threads(threads)


def stamp(path: Path) -> int:
    """Workers live longer than runs: a model that was learned again has the same path and another stamp."""
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


@lru_cache(maxsize=8)
def loaded_model(path: Path, device: str, _stamp: int) -> FlightModel:
    """The model of a flight, read once by each worker. Raises InputError."""
    return load_model(path, lambda: choose_device(device))
