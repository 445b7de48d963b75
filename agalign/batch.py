"""Many captures: which are still to be done, each one done, one summary."""

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import cv2

from agalign.choices import Layout
from agalign.config import Settings
from agalign.discover import Flight
from agalign.errors import AgalignError, ConfigurationError, OutputError, SidecarError, WorkerError
from agalign.fingerprint import fingerprint
from agalign.flight import (
    FlightModel,
    camera_key,
    flights_of,
    learn_flight,
    learning_fingerprint,
    load_model,
    model_names,
    save_model,
)
from agalign.joint import choose_device, limit_threads, one_thread
from agalign.pair import PairProgress
from agalign.pipeline import output_paths, process_capture, quiet
from agalign.records import Capture
from agalign.sidecar import Sidecar, read_sidecar
from agalign.write import band_file_names

_FAULTS = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RuntimeError, cv2.error)
_LOG = logging.getLogger(__name__)
_MOST_READ_AHEAD_BYTES = 64 << 20
_DASK_ANSWERS_WITHIN_S = 10
_MOST_HANDED_OVER = 1000
"""Captures that wait in an executor at a time: enough for any cluster, and little memory."""


@dataclass(frozen=True)
class CaptureReport:
    """What became of one capture."""

    label: str
    state: Literal["done", "kept", "error"]
    """`kept` means that an earlier run's result with the same settings was there."""
    sidecar: Sidecar | None
    error: str | None = None

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
        """True where every band pair of the capture is aligned and none is missing."""
        return self.sidecar is not None and self.sidecar.status == "ok"

    @property
    def useful(self) -> bool:
        """True where at least one band pair is aligned."""
        return self.sidecar is not None and any(b.status == "aligned" for b in self.sidecar.bands)


def prepare_output(out: Path) -> None:
    """Make the output folder. Raises OutputError where it cannot be made or written to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise OutputError(f"{out}: no permission to write there; choose another folder with -o")
    except FileExistsError:
        raise OutputError(f"{out}: is a file; choose another folder with -o") from None
    except OSError as error:
        raise OutputError(f"{out}: cannot be made ({error.strerror or error})") from None


@dataclass(frozen=True)
class RunOptions:
    """How a run goes about it: nothing here changes a result."""

    overwrite: bool = False
    """Do captures again that an earlier run finished."""
    jobs: int = 1
    """Captures at a time, each in a process of its own where there are several."""
    executor: Executor | None = None
    """Where the captures are done instead: any executor whose workers see the same folders (`dask_executor` is one)."""


@dataclass(frozen=True)
class Listener:
    """What a run tells while it runs."""

    on_start: Callable[[Capture], None] = quiet
    on_pair: PairProgress = quiet
    """Of captures in this process only."""
    on_learning: Callable[[str, float], None] = quiet
    """The camera whose network is learnt, and the share that is behind."""


def run_flight(
    flight: Flight, out: Path, settings: Settings, options: RunOptions | None = None,
    listener: Listener | None = None, model: Path | None = None,
) -> Iterator[CaptureReport]:  # fmt: skip
    """Align the captures, yielding each as it is done; those done before are kept.

    A network is learnt for every camera and flight first and saved below OUT/models; `model` is one to start from.
    One capture's failure never stops the others, and no result depends on the order in which they are done.
    Raises OutputError where the output folder cannot be used, InputError or ConfigurationError for `model`.
    """
    options, listener = options or RunOptions(), listener or Listener()
    prepare_output(out)
    _refuse_to_overwrite_inputs(flight, out, settings.write.layout)
    known = None if model is None else _given_model(model, flight, settings)
    if known is not None:
        used = settings.flight.model_copy(update={"start": known.fingerprint})
        settings = settings.model_copy(update={"flight": used})
    waiting: list[Task] = []
    groups = flights_of(flight.captures)
    for group, name in zip(groups, model_names(groups), strict=True):
        left = []
        for capture in group:
            earlier = None if options.overwrite else finished_before(capture, out, settings)
            if earlier is None:
                left.append(capture)
            else:
                yield CaptureReport(capture.label, "kept", earlier)
        if left:
            path = _learn(group, out / "models" / name, settings, listener, known)
            waiting += [Task(c, out, settings, path) for c in left]
    if options.executor is not None:
        yield from _on_executor([t.absolute() for t in waiting], options.executor, _MOST_HANDED_OVER)
    elif options.jobs > 1 and len(waiting) > 1:
        jobs = min(options.jobs, len(waiting))
        threads = max(1, (os.cpu_count() or 1) // jobs)
        with (
            _threads_of_children(threads),
            ProcessPoolExecutor(jobs, get_context("spawn"), _start_worker, (threads,)) as pool,
        ):
            yield from _on_executor(waiting, pool, 2 * jobs)
    else:
        with ThreadPoolExecutor(1) as reader:
            for number, task in enumerate(waiting, start=1):
                listener.on_start(task.capture)
                for following in waiting[number : number + 1]:
                    reader.submit(_read_ahead, following.capture)
                yield do_capture(task, listener.on_pair)


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
    try:
        device = task.settings.joint.device
        model = None if task.model is None else _loaded(task.model, device, _stamp(task.model))
        with one_thread():
            outcome = process_capture(task.capture, task.out, task.settings, on_pair, model)
    except AgalignError as error:
        return CaptureReport(label, "error", None, str(error))
    except _FAULTS as error:
        if "memory" in str(error):  # as torch and OpenCV say it: the captures that follow would fare no better
            raise MemoryError(str(error)) from None
        # A fault of this program: it must not cost the captures that follow.
        problem = f"{label}: agalign failed on it ({type(error).__name__}: {error}); please report this"
        _LOG.debug(problem, exc_info=True)
        return CaptureReport(label, "error", None, problem)
    return CaptureReport(label, "done", outcome.sidecar)


def _on_executor(tasks: Sequence[Task], executor: Executor, most: int) -> Iterator[CaptureReport]:
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


def _start_worker(threads: int) -> None:
    """The interrupt key is for the main process, which lets the workers finish what they have begun."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit_threads(threads)


@contextmanager
def _threads_of_children(count: int) -> Iterator[None]:
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


def _read_ahead(capture: Capture) -> None:
    """Bring the files of the capture to come into the system's cache."""
    for path in {b.path for b in capture.bands}:
        with suppress(OSError):
            if path.stat().st_size <= _MOST_READ_AHEAD_BYTES:
                path.read_bytes()


def _given_model(path: Path, flight: Flight, settings: Settings) -> FlightModel:
    """The model to start from. Raises ConfigurationError where it is of no use here."""
    if settings.joint.recipe != "fast" or not settings.flight.together or settings.seed.only:
        raise ConfigurationError("a model is of use only where one network is learnt for a flight, by recipe fast")
    model = load_model(path, lambda: choose_device(settings.joint.device))
    if model.net.sharing == "unshared" and settings.joint.sharing != "unshared":
        raise ConfigurationError(f"{path}: was learnt unshared; add --sharing unshared")
    if model.camera and flight.captures and not any(camera_key(c) == model.camera for c in flight.captures):
        here = camera_key(flight.captures[0])
        raise ConfigurationError(f"{path}: was learnt for {model.camera}; the images here are of {here}")
    return model


def _learn(
    captures: Sequence[Capture], path: Path, settings: Settings, listener: Listener, known: FlightModel | None
) -> Path | None:
    """The path of the flight's model, learnt now or found from an earlier run; None where none could be learnt."""
    if settings.joint.recipe != "fast" or not settings.flight.together or settings.seed.only:
        return None
    start = known if known is not None and known.camera in ("", camera_key(captures[0])) else None
    device = settings.joint.device
    if path.is_file():
        with suppress(AgalignError):
            if _loaded(path, device, _stamp(path)).fingerprint == learning_fingerprint(captures, settings):
                return path

    def progress(_stage: str, share: float) -> None:
        listener.on_learning(path.stem, share)

    model = learn_flight(captures, settings, progress, start)
    if model is None:
        return None
    save_model(model, path)
    return path


def _stamp(path: Path) -> int:
    """Workers live longer than runs: a model that was learnt anew has the same path and another stamp."""
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


@lru_cache(maxsize=8)
def _loaded(path: Path, device: str, _stamp: int) -> FlightModel:
    return load_model(path, lambda: choose_device(device))


def _refuse_to_overwrite_inputs(flight: Flight, out: Path, layout: Layout) -> None:
    if out.resolve() == flight.folder.resolve():
        raise ConfigurationError(f"{out}: is the folder of the images; choose another output folder with -o")
    sources = {band.path.resolve() for capture in flight.captures for band in capture.bands}
    for capture in flight.captures:
        stack, _ = output_paths(capture, out)
        written = (
            [stack] if layout == "stack" else [stack, *(stack.parent / n for n in band_file_names(capture).values())]
        )
        for path in written:
            if path.resolve() in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder with -o")


def finished_before(capture: Capture, out: Path, settings: Settings) -> Sidecar | None:
    """The sidecar of an earlier run with the same settings and bands whose outputs are still there."""
    stack, path = output_paths(capture, out)
    if not path.is_file():
        return None
    try:
        sidecar = read_sidecar(path)
    except SidecarError:
        return None
    if sidecar.settings != fingerprint(capture, settings):
        return None
    return sidecar if _outputs_are_there(sidecar, path.parent, stack) else None


def _outputs_are_there(sidecar: Sidecar, folder: Path, stack: Path) -> bool:
    output = sidecar.output
    if output is None:
        return not stack.is_file()
    files = [(f.file, f.bytes) for f in output.band_files]
    files += [] if output.file is None or output.bytes is None else [(output.file, output.bytes)]
    return all((folder / name).is_file() and (folder / name).stat().st_size == size for name, size in files)
