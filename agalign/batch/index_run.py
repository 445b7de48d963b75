"""Spectral indices of all captures of a run: serially, in processes of this machine, or on an executor."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from agalign.errors import AgalignError
from agalign.products.flight_map import link_indices
from agalign.products.index_bands import bands_of, unit_of
from agalign.products.index_rasters import write_rasters
from agalign.products.index_table import IndexReport, IndexRow, row_of, update_table
from agalign.products.indices import Index
from agalign.products.sidecar_file import read_result, run_sidecars, update_products
from agalign.values.cores import usable_cores
from agalign.values.process_pool import ProcessPool
from agalign.values.processes import follow_parent, threads_of_children, worker_context

_CAPTURES_WORTH_A_PROCESS = 8
"""Starting a process takes as long as the indices of this many captures."""
_CAPTURES_A_PROCESS = 500
_MAX_WAITING_TASKS = 1000


@dataclass(frozen=True)
class IndexOptions:
    """How to calculate indices; no option changes their values."""

    overwrite: bool = False
    """Calculate indices again that an earlier command wrote from the same bands."""
    jobs: int = 0
    """Number of processes, each for one capture at a time; 0 is one per core."""
    executor: Executor | None = None
    """Executor that processes the captures instead; its workers need the same folders."""


@dataclass(frozen=True)
class IndexTask:
    """The indices to calculate for one capture, as sent to a worker."""

    out: Path
    """The output folder of the run."""
    sidecar: Path
    target: Path
    """Root folder of the indices: `out`, unless another one was given."""
    indices: tuple[Index, ...]
    overwrite: bool
    mask_qa: bool = False
    """Mask pixels that the quality raster flags as unusable."""

    @property
    def folder(self) -> Path:
        """Folder of the capture, relative to `out`."""
        return self.sidecar.parent.relative_to(self.out)

    @property
    def label(self) -> str:
        """The capture's name, with its folder."""
        return (self.folder / self.sidecar.stem).as_posix()


@dataclass(frozen=True)
class CaptureIndices:
    """Reports and table rows of the indices of one capture."""

    reports: Sequence[IndexReport]
    rows: Sequence[IndexRow] = ()


def index_tasks(
    out: Path, indices: Sequence[Index], target: Path, *, overwrite: bool = False, mask_qa: bool = False
) -> list[IndexTask]:
    """Return a task for each capture of a run. Raises InputError if the folder contains no run."""
    return [IndexTask(out, path, target, tuple(indices), overwrite, mask_qa) for path in run_sidecars(out)]


def unit_of_run(tasks: Sequence[IndexTask]) -> str:
    """Return the unit of the first capture with aligned bands that can be read; empty if there is none."""
    for task in tasks:
        with suppress(AgalignError):
            if unit := unit_of(bands_of(read_result(task.sidecar), task.sidecar.parent)):
                return unit
    return ""


def run_indices(tasks: Sequence[IndexTask], options: IndexOptions | None = None) -> Iterator[CaptureIndices]:
    """Write the indices of all captures, yield the reports of each, and finally write the table indices.csv.

    A failed capture is reported and does not stop the others. Raises WorkerError if no worker process can be started,
    and OutputError if the table cannot be written.
    """
    options = options or IndexOptions()
    rows: list[IndexRow] = []
    try:
        for done in _results(tasks, options):
            rows += done.rows
            yield done
    finally:
        if rows:  # also after an interruption
            link_indices(tasks[0].target, update_table(tasks[0].target, rows))


def do_indices(task: IndexTask) -> CaptureIndices:
    """Write the indices of one capture and return the reports, which include errors."""
    folder, base = task.folder, task.target / task.folder / task.sidecar.stem
    try:
        sidecar = read_result(task.sidecar)
    except AgalignError as error:
        return _failed(task, str(error))
    try:
        bands = bands_of(sidecar, task.sidecar.parent, mask_qa=task.mask_qa)
        reports = write_rasters(bands, task.indices, base, task.label, overwrite=task.overwrite)
        if task.target == task.out:
            rasters = [r.path for r in reports if r.path is not None and not r.kept]
            update_products(task.sidecar, [p for path in rasters for p in (path, path.with_suffix(".png"))])
    except AgalignError as error:
        reports = list(_failed(task, str(error)).reports)
    return CaptureIndices(reports, [row_of(r, sidecar, folder.as_posix(), task.target) for r in reports])


def _failed(task: IndexTask, problem: str) -> CaptureIndices:
    return CaptureIndices([IndexReport(task.label, index.name, problem=problem) for index in task.indices])


def _results(tasks: Sequence[IndexTask], options: IndexOptions) -> Iterator[CaptureIndices]:
    processes = min(options.jobs or usable_cores(), len(tasks) // _CAPTURES_WORTH_A_PROCESS)
    if options.executor is not None:
        yield from _on_executor(options.executor, tasks)
    elif processes > 1:
        yield from _in_processes(tasks, processes)
    else:
        yield from map(do_indices, tasks)


def _in_processes(tasks: Sequence[IndexTask], processes: int) -> Iterator[CaptureIndices]:
    with (
        threads_of_children(1),
        ProcessPool(
            do_indices, processes, worker_context(__name__), _start_worker, max_tasks_per_worker=_CAPTURES_A_PROCESS
        ) as pool,
    ):
        for outcome in pool.run(_absolute(tasks)):
            yield _result(outcome.value, outcome.argument)


def _on_executor(executor: Executor, tasks: Sequence[IndexTask]) -> Iterator[CaptureIndices]:
    from agalign.batch.workers import DaskExecutor, finished_by  # imports torch

    def submit(task: IndexTask) -> "Future[CaptureIndices]":
        return executor.submit(do_indices, task)

    loss = executor.loss if isinstance(executor, DaskExecutor) else str
    for task, result in finished_by(submit, _absolute(tasks), _MAX_WAITING_TASKS, loss):
        yield _result(result, task)


def _absolute(tasks: Sequence[IndexTask]) -> list[IndexTask]:
    """Return the tasks with absolute paths: workers may have another working folder."""
    return [replace(t, out=t.out.absolute(), sidecar=t.sidecar.absolute(), target=t.target.absolute()) for t in tasks]


def _result(result: Callable[[], CaptureIndices], task: IndexTask) -> CaptureIndices:
    try:
        return result()
    except Exception:
        from agalign.batch.workers import result_or_problem

        done, problem = result_or_problem(result)
        return _failed(task, problem) if done is None else done


def _start_worker() -> None:
    follow_parent()
    cv2.setNumThreads(1)
