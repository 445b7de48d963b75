"""One capture as a task, and who does it: this process, others, or the workers of a cluster."""

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from multiprocessing import get_all_start_methods, get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Literal

import cv2

from agalign.batch.capture import process_capture, quiet
from agalign.capture.align import PairProgress
from agalign.config import Settings
from agalign.errors import AgalignError, ConfigurationError, WorkerError
from agalign.flight.model import FlightModel, load_model
from agalign.method.device import choose_device, keep_freed_memory, limit_threads, one_memory_error, one_thread
from agalign.products.sidecar import Sidecar
from agalign.values.capture import Capture

_FAULTS = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RuntimeError, OSError, cv2.error)
_LOG = logging.getLogger(__name__)
_MOST_READ_AHEAD_BYTES = 64 << 20
_DASK_ANSWERS_WITHIN_S = 10
MOST_HANDED_OVER = 1000
"""Captures that wait in an executor at a time: enough for any cluster, and little memory."""


@dataclass(frozen=True)
class CaptureReport:
    """What became of one capture."""

    label: str
    state: Literal["done", "kept", "error", "panel"]
    """`kept` means that an earlier run's result with the same settings was there, and `panel` that it shows a
    calibration panel and takes no part.
    """
    sidecar: Sidecar | None
    error: str | None = None
    panel: str | None = None
    """What the calibration panel is, in words."""

    def without_tables(self) -> "CaptureReport":
        """The same without the sidecar's long tables: a thousand of these are kept until a run ends."""
        if self.sidecar is None:
            return self
        bands = [
            b.model_copy(update={"grid": None, "metrics": b.metrics and b.metrics.model_copy(update={"tiles": []})})
            for b in self.sidecar.bands
        ]
        return replace(self, sidecar=self.sidecar.model_copy(update={"bands": bands}))

    @property
    def good(self) -> bool:
        """True where nothing is left to be wished for: every band pair of the capture is aligned, or predicted well
        enough, and none is missing.
        """
        return self.state == "panel" or (self.sidecar is not None and self.sidecar.status == "ok")

    @property
    def useful(self) -> bool:
        """True where at least one band pair is aligned or predicted."""
        return self.sidecar is not None and any(b.status in ("aligned", "predicted") for b in self.sidecar.bands)


@dataclass(frozen=True)
class Task:
    """One capture to be done, as it travels to a worker."""

    capture: Capture
    out: Path
    settings: Settings
    model: Path | None

    def absolute(self) -> "Task":
        """With absolute paths: workers elsewhere have another working folder."""
        bands = tuple(replace(b, path=b.path.absolute()) for b in self.capture.bands)
        model = None if self.model is None else self.model.absolute()
        return replace(self, capture=replace(self.capture, bands=bands), out=self.out.absolute(), model=model)


def do_capture(task: Task, on_pair: PairProgress = quiet) -> CaptureReport:
    """Do one capture; what can go wrong with it is in the report."""
    label = task.capture.label
    keep_freed_memory()
    try:
        device = task.settings.joint.device
        model = None if task.model is None else loaded_model(task.model, device, stamp(task.model))
        # Where memory is short, the captures that follow would fare no better.
        with one_thread(), one_memory_error():
            outcome = process_capture(task.capture, task.out, task.settings, on_pair, model)
    except AgalignError as error:
        return CaptureReport(label, "error", None, str(error))
    except _FAULTS as error:
        # A fault of this program: it must not cost the captures that follow.
        problem = f"{label}: agalign failed on it ({type(error).__name__}: {error}); please report this"
        _LOG.debug(problem, exc_info=True)
        return CaptureReport(label, "error", None, problem)
    return CaptureReport(label, "done", outcome.sidecar)


def on_executor(tasks: Sequence[Task], executor: Executor, most: int) -> Iterator[CaptureReport]:
    """Never more than `most` handed over at a time, so that a season's captures do not wait in memory."""
    futures: dict[Future[CaptureReport], Task] = {}
    remaining = iter(tasks)
    try:
        for task in islice(remaining, most):
            futures[executor.submit(do_capture, task)] = task
        while futures:
            done, _ = wait(futures, return_when=FIRST_COMPLETED)
            for future in done:
                task = futures.pop(future)
                yield _report_of(future, task)
                for following in islice(remaining, 1):
                    futures[executor.submit(do_capture, following)] = following
    except BrokenExecutor:
        raise WorkerError("a worker process ended without a word (out of memory?); try again with --jobs 1") from None
    finally:
        for future in futures:
            future.cancel()


def _report_of(future: "Future[CaptureReport]", task: Task) -> CaptureReport:
    try:
        return future.result()
    except BrokenExecutor:
        raise
    except MemoryError:
        return CaptureReport(task.capture.label, "error", None, f"{task.capture.label}: out of memory")
    except Exception as error:
        lost = isinstance(error, CancelledError) or type(error).__module__.partition(".")[0] == "distributed"
        if not lost:
            raise
        problem = f"{task.capture.label}: the cluster lost it ({error}); run again to do what is left"
        return CaptureReport(task.capture.label, "error", None, problem)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster as an executor. Each needs this package and sees the same folders.

    `address` is a scheduler's, such as tcp://host:8786. Raises ConfigurationError where Dask is not installed or the
    scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ConfigurationError("Dask is not installed; pip install 'agalign[dask]'") from None
    try:
        client = Client(address, set_as_default=False, timeout=_DASK_ANSWERS_WITHIN_S)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"no Dask scheduler answers at {address} ({error})") from None
    with client:
        yield client.get_executor(pure=False)


def start_worker(threads: int) -> None:
    """The interrupt key is for the main process, which lets the workers finish what they have begun."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit_threads(threads)


def worker_context() -> BaseContext:
    """How processes are started: from one that has loaded this module, where the system can, else each anew."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


@contextmanager
def threads_of_children(count: int) -> Iterator[None]:
    """Libraries read these once, when they are loaded: threads of several processes that wait for each other's cores
    take twice the time.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def read_ahead(capture: Capture) -> None:
    """Bring the files of the capture to come into the system's cache."""
    for path in {b.path for b in capture.bands}:
        with suppress(OSError):
            if path.stat().st_size <= _MOST_READ_AHEAD_BYTES:
                path.read_bytes()


def stamp(path: Path) -> int:
    """Workers live longer than runs: a model that was learnt anew has the same path and another stamp."""
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


@lru_cache(maxsize=8)
def loaded_model(path: Path, device: str, _stamp: int) -> FlightModel:
    """The model of a flight, read once by each worker. Raises InputError."""
    return load_model(path, lambda: choose_device(device))
