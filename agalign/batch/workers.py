"""Calling a function with each of many tasks: in this process, in threads, in worker processes, or on the workers of a
cluster.
"""

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
    ThreadPoolExecutor,
    wait,
)
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from agalign._version import __version__
from agalign.batch.preload import preload_libraries
from agalign.errors import AgalignError, ConfigurationError, WorkerError
from agalign.host.process_pool import A, ProcessPool, R, WorkerDiedError, open_pool
from agalign.host.processes import (
    WORKER_MODULE,
    cores_for,
    environment_of_children,
    usable_cores,
    without_interrupt_key,
    worker_context,
)
from agalign.pixels.gdal import without_warnings
from agalign.values.arguments import checked
from agalign.values.choices import MAX_JOBS

_DASK_TIMEOUT_S = 10
_POLL_INTERVAL_S = 1.0
"""Interval at which the loss of workers is checked while no task completes. On Windows, SIGINT waits as long."""
_NO_WORKER = "agalign: no worker is connected to the Dask scheduler; the run waits for one"
_CAPTURES_WORTH_A_PROCESS = 2
"""Minimum number of captures per process: starting one takes the time of one capture, while a flight is learned."""
MAX_THREADS = 4
"""Maximum number of threads that train a network or process captures; more wait for the interpreter's lock."""
_MAX_WAITING_TASKS = 1000
"""Maximum number of tasks submitted to an executor at a time: enough for any cluster, and little memory."""


Completed: TypeAlias = Iterator[tuple[int, Callable[[], R]]]
"""The tasks as they complete: the index of each, and a function that returns or raises its result."""


class RunTasks(Protocol):
    """Calls a function with each task, and yields the tasks as they complete.

    Function, tasks and results can be pickled, except in this process. The time limit applies to each call in worker
    processes and on a Dask cluster. Raises WorkerError if no worker can be started or workers end one after another.
    """

    def __call__(
        self, function: Callable[[A], R], tasks: Sequence[A], /, *, timeout_s: float | None = None
    ) -> Completed[R]: ...


def serially(function: Callable[[A], R], tasks: Sequence[A], /, **_: object) -> Completed[R]:
    """Run the tasks in this process and thread: each when its result is requested."""
    for number, task in enumerate(tasks):
        yield number, partial(function, task)


def numbers_of_workers(
    captures: int, cores: int, *, has_timeout: bool = False, worth_a_process: int = _CAPTURES_WORTH_A_PROCESS
) -> tuple[int, int]:
    """Return (processes, threads) for `open_workers` that process these captures: with few, a process is not worth its
    start, but only processes can be stopped at a timeout.
    """
    processes = min(cores, captures if has_timeout else captures // worth_a_process)
    return processes, min(cores, captures, MAX_THREADS)


def _threads_of_each(processes: int) -> int:
    return max(1, usable_cores() // processes)


def start_server_ahead(captures: int, cores: int, *, has_timeout: bool) -> None:
    """Start the fork server early if a run of this many captures will use workers: it imports WORKER_MODULE while this
    process imports the same.
    """
    processes, _ = numbers_of_workers(captures, cores, has_timeout=has_timeout)
    if processes > 1:
        with environment_of_children(_threads_of_each(processes)):
            worker_context(WORKER_MODULE)


@contextmanager
def open_workers(
    executor: Executor | None,
    processes: int,
    initializer: Callable[[int], object],
    threads: int = 1,
    *,
    preload: str = WORKER_MODULE,
    has_timeout: bool = False,
) -> Iterator[RunTasks]:
    """Run tasks on the executor if there is one; else in processes of this machine if there are several or there is a
    timeout (threads cannot be killed); else in threads, or serially.

    `initializer` gets the number of threads of a process, and `preload` is a module that imports what it needs. The
    processes start in the background.
    """
    if executor is not None:
        yield on_executor(executor)
    elif processes > 1 or (processes and has_timeout):
        of_each = _threads_of_each(processes)
        with open_pool(processes, of_each, partial(initializer, of_each), preload) as pool:
            yield on_executor(pool)
    elif threads > 1:
        # Warning filters are global: threads that change and restore them would interfere.
        with without_warnings(), ThreadPoolExecutor(threads) as thread_pool:
            yield on_executor(thread_pool)
    else:
        yield serially


def on_executor(executor: "Executor | ProcessPool") -> RunTasks:
    """Run tasks on an executor, which is not shut down; only those of this package have a time limit."""

    def run_tasks(function: Callable[[A], R], tasks: Sequence[A], /, *, timeout_s: float | None = None) -> Completed[R]:
        if isinstance(executor, (ProcessPool, DaskExecutor)):
            loss = executor.checked_loss if isinstance(executor, DaskExecutor) else lambda: executor.loss
            return _completed(partial(executor.submit, function, timeout_s=timeout_s), tasks, loss)
        return _completed(partial(_submitted, executor, function), tasks, str)

    return run_tasks


def _completed(submit: Callable[[A], "Future[R]"], tasks: Sequence[A], loss: Callable[[], str]) -> Completed[R]:
    """Submit the tasks, and yield them. Raises WorkerError if there is a reason for the `loss` of all workers."""
    futures: dict[Future[R], int] = {}
    remaining = iter(enumerate(tasks))

    def submit_some(count: int) -> None:
        futures.update((submit(task), number) for number, task in islice(remaining, count))

    try:
        submit_some(_MAX_WAITING_TASKS)
        while futures:
            done, _ = wait(futures, _POLL_INTERVAL_S, FIRST_COMPLETED)
            if not done and (reason := loss()):  # futures of a lost cluster may never be done
                raise WorkerError(reason)
            for future in done:
                if (future.cancelled() or future.exception() is not None) and (reason := loss()):
                    raise WorkerError(reason)
                yield futures.pop(future), future.result
                submit_some(1)
    finally:
        for future in futures:
            future.cancel()


def _submitted(executor: Executor, function: Callable[[A], R], task: A) -> "Future[R]":
    """Submit a task and return its future; if the executor is broken, its error is the outcome of the task."""
    try:
        return executor.submit(function, task)
    except BrokenExecutor as error:
        failed: Future[R] = Future()
        failed.set_exception(error)
        return failed


def in_order(
    run_tasks: RunTasks,
    function: Callable[[A], R],
    tasks: Sequence[A],
    /,
    *,
    timeout_s: float | None = None,
    if_late: Callable[[A], R] | None = None,
) -> Iterator[R]:
    """Yield the results in the order of the tasks, as `map` does. Raises AgalignError, and MemoryError.

    A task that exceeds the time limit has the result of `if_late`.
    """
    waiting: dict[int, Callable[[], R]] = {}
    following = 0
    for number, result in run_tasks(function, tasks, timeout_s=timeout_s):
        waiting[number] = result
        while following in waiting:
            try:
                value = waiting.pop(following)()
            except (AgalignError, MemoryError):
                raise
            except Exception as error:
                if if_late is None or not (isinstance(error, TimeoutError) or _may_be_late(error, timeout_s)):
                    raise WorkerError(f"the flight cannot be learned: {failure_text(error)}") from error
                value = if_late(tasks[following])
            yield value
            following += 1


def _may_be_late(error: Exception, timeout_s: float | None) -> bool:
    """Return True if Dask reports that a task with a time limit has ended its workers: it does not say why."""
    return timeout_s is not None and type(error).__name__ == "KilledWorker"


def failure_text(error: Exception, timeout_s: float | None = None) -> str:
    """Return one line about the error of a task or of its worker."""
    run_again = "run again to process the remaining captures"
    match error:
        case TimeoutError() if timeout_s is not None:
            return f"stopped after {timeout_s:g} s (--timeout)"
        case WorkerDiedError():
            return f"its worker process was killed ({error}; out of memory?); {run_again}"
        case BrokenExecutor():
            return f"the executor lost its processes (out of memory?); {run_again}"
        case MemoryError():
            return "out of memory; try again with fewer --jobs, or with more memory"
        case AgalignError():
            return str(error)
    if _may_be_late(error, timeout_s):
        return f"its workers were ended, after {timeout_s:g} s (--timeout) or for memory"
    first_line = next(iter(str(error).splitlines()), type(error).__name__)
    if isinstance(error, CancelledError) or type(error).__module__.partition(".")[0] == "distributed":
        return f"the cluster lost it ({first_line}); {run_again}"
    return f"agalign failed on it ({type(error).__name__}: {first_line}); please report this"


@checked
@contextmanager
def dask_executor(address: str, jobs: int = 0) -> Iterator[Executor]:
    """Connect to a Dask cluster and return its executor, for `RunOptions(executor=...)`; use it in a `with` block.

    The workers need the same version of agalign and the same folders under the same paths. The tasks of a lost worker
    are repeated by the others. A capture that exceeds the timeout ends its worker, which its nanny restarts; the
    scheduler retries the capture as often as its setting `allowed-failures` permits.

    Parameters
    ----------
    address
        Address of a Dask scheduler, such as tcp://host:8786, or `local` to start workers on this machine.
    jobs
        Number of worker processes with `local`; 0 is one per core.

    Returns
    -------
    context manager of concurrent.futures.Executor
        The connection, and with `local` the workers, end with the `with` block.

    Raises
    ------
    ConfigurationError
        `jobs` is out of range, Dask is not installed, the scheduler does not answer, or a worker has a different
        version of agalign.

    Examples
    --------
    >>> with agalign.dask_executor("local", jobs=1) as executor:
    ...     reports = agalign.align_folder("flight", "aligned", run=agalign.RunOptions(executor=executor))
    >>> len(reports)
    2
    """
    if not 0 <= jobs <= MAX_JOBS:
        raise ConfigurationError(f"jobs is {jobs}; give 1 to {MAX_JOBS}, or 0 for one per core")
    try:
        import dask
        from distributed import Client, LocalCluster, fire_and_forget
    except ImportError:
        raise ConfigurationError("Dask is not installed; in a checkout: pip install '.[dask]'") from None
    with ExitStack() as stack:
        # The run reports a lost scheduler in one line; Dask logs tracebacks.
        for logger in map(logging.getLogger, ("distributed.client", "distributed.deploy.spec", "tornado")):
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        try:
            if address == "local":
                # The profile appears on the dashboard only, and takes a few percent of the time.
                stack.enter_context(dask.config.set({"distributed.worker.profile.enabled": False}))
                stack.enter_context(environment_of_children(threads=1))
                with without_interrupt_key():  # of a terminal, for all its processes: the workers end with the cluster
                    cluster = LocalCluster(
                        n_workers=cores_for(jobs),
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address=None,
                        # Its HTTP server runs without dashboard too: any free port, of this machine alone.
                        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                        silence_logs=logging.CRITICAL,
                    )
                address = stack.enter_context(cluster).scheduler_address
            client = Client(address, set_as_default=False, timeout=_DASK_TIMEOUT_S)
        except RuntimeError as error:
            raise ConfigurationError(f"no Dask cluster can be started here ({error})") from None
        except Exception as error:  # Dask's, of many classes
            reason = str(error) or type(error).__name__
            raise ConfigurationError(f"no Dask scheduler answers at {address} ({reason})") from None
        _check_versions(stack.enter_context(client))
        # Workers import their libraries while this process learns the flight.
        for worker in client.ncores():
            fire_and_forget(client.submit(preload_libraries, workers=[worker], pure=False))
        yield DaskExecutor(client)


def _check_versions(client: Any) -> None:
    """Raise ConfigurationError if a worker has no or another version of agalign.

    A worker without agalign ends when it receives a task, and the run would wait for other workers.
    """
    # A built-in function, because a worker without agalign cannot unpickle one of this package.
    versions = client.run(eval, "__import__('agalign._version', fromlist=['_']).__version__", on_error="return")
    if not versions:
        logging.getLogger(__name__).warning(_NO_WORKER)
    for worker, version in sorted(versions.items()):
        if version != __version__:
            problem = f"cannot load agalign ({version})" if isinstance(version, Exception) else f"has agalign {version}"
            raise ConfigurationError(f"the Dask worker at {worker} {problem}; install agalign {__version__} there")


class DaskExecutor(Executor):
    """The workers of a Dask cluster."""

    def __init__(self, client: Any) -> None:
        self._client, self._executor = client, client.get_executor(pure=False)
        self._has_workers = bool(client.ncores())

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        return self._executor.submit(_on_worker, __version__, function, *arguments, **named)

    def refuse_missing(self, paths: Sequence[Path]) -> None:
        """Raise ConfigurationError if a worker does not see one of some paths, WorkerError without a scheduler."""
        try:
            missing = self._client.run(_missing, [path.absolute() for path in paths], on_error="return")
        except Exception as error:  # Dask's, of many classes
            raise WorkerError(self.loss or f"the Dask workers do not answer ({error})") from None
        for worker, path in sorted(missing.items()):
            if isinstance(path, Path):  # not the error of a worker that ended
                text = f"the Dask worker at {worker} does not see it; mount the same folders there under the same paths"
                raise ConfigurationError(f"{path}: {text}")

    @property
    def loss(self) -> str:
        """Why no task can complete any more; empty while the scheduler answers."""
        if self._client.status == "running":
            return ""
        return (
            "the Dask scheduler does not answer any more; finished captures are kept, and the same command resumes "
            "the run"
        )

    def checked_loss(self) -> str:
        """Return the `loss`; log a warning if the last worker is gone, as the tasks wait for another one."""
        if not self.loss:
            with suppress(Exception):  # Dask's, of many classes, if the scheduler is lost now
                had_workers, self._has_workers = self._has_workers, bool(self._client.ncores())
                if had_workers and not self._has_workers:
                    logging.getLogger(__name__).warning(_NO_WORKER)
        return self.loss


def _missing(paths: Sequence[Path]) -> Path | None:
    return next((path for path in paths if not path.exists()), None)


def _on_worker(version: str, function: Callable[..., R], *arguments: Any, timeout_s: float | None = None) -> R:
    """Call a function in one thread; OMP_NUM_THREADS, which Dask sets, does not limit all libraries.

    Ends this process if it takes longer than the timeout: code that hangs in a library cannot be interrupted.
    Raises ConfigurationError on a worker with another version, which may have joined during the run.
    """
    if version != __version__:
        raise ConfigurationError(f"a Dask worker has agalign {__version__}; install agalign {version} there")
    alarm = threading.Timer(timeout_s or 0.0, os._exit, (75,))
    if timeout_s is not None:
        alarm.start()
    try:
        from agalign.method.device import limit_threads

        limit_threads(1)
        return function(*arguments)
    finally:
        alarm.cancel()
