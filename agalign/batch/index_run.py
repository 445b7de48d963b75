"""Spectral indices of all captures of a run: serially, in processes of this machine, or on an executor."""

import itertools
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2

from agalign.batch.capture_task import quiet
from agalign.batch.workers import failure_text, numbers_of_workers, open_workers, serially
from agalign.errors import AgalignError, ConfigurationError, SidecarError
from agalign.host.files import REPORT_FILE, RUN_FILE, below_as_given, written_below
from agalign.host.own_files import refuse_foreign_pages
from agalign.host.processes import cores_for
from agalign.rasters.band_reader import BandReader
from agalign.records.captures import bands_of
from agalign.records.cautions import RunFacts
from agalign.records.listed_files import ListedFiles
from agalign.records.run_record import counted_sidecars
from agalign.records.sidecar_file import add_products, label_of, read_checked, read_sidecar, run_sidecars
from agalign.spectral_indices.formulas import Index
from agalign.spectral_indices.indices_csv import refuse_foreign_table, to_check, update_table
from agalign.spectral_indices.rasters import IndexRasters, IndexReport, index_rasters, write_index


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
    facts: RunFacts = field(default_factory=RunFacts)
    """Facts of the run, which are read once for all captures."""
    file_states: str = ""
    """States of the files of the capture in the run record."""

    def absolute(self) -> "IndexTask":
        """Return the task with absolute paths: workers may have another working folder."""
        return replace(self, out=self.out.absolute(), sidecar=self.sidecar.absolute(), target=self.target.absolute())

    @property
    def label(self) -> str:
        """The capture's name, with its folder relative to `out`."""
        return label_of(self.sidecar, self.out)


def index_tasks(
    out: Path, indices: Sequence[Index], target: Path, *, overwrite: bool = False, mask_qa: bool = False
) -> list[IndexTask]:
    """Return a task for each capture of a run. Raises InputError if the folder contains no run, and ConfigurationError
    without indices, or if the target is that of another run, or has a table or page that no command has written, or an
    index of another flight, or if two captures have an index of the same name.
    """
    if not indices:
        raise ConfigurationError("no index is given; give names such as ndvi,ndre, or formulas as 'name=(N-R)/(N+R)'")
    if target.resolve() == out.resolve():
        target = out  # also if it is spelled differently, or is a link
        refuse_foreign_pages(out)
    elif (target / RUN_FILE).is_file():
        raise ConfigurationError(f"{target}: is the output folder of another run; choose another folder with -o")
    else:
        refuse_foreign_table(target)
    sidecars = counted_sidecars(run_sidecars(out), out)
    task = IndexTask(out, Path(), target, tuple(indices), overwrite, mask_qa, RunFacts.of(out))
    tasks = [replace(task, sidecar=path, file_states=states) for path, states in sidecars.items()]
    taken: dict[str, tuple[str, Index]] = {}
    for label, index in itertools.product((task.label for task in tasks), indices):
        other, of_other = taken.setdefault(f"{label}_{index.name}".lower(), (label, index))
        if other != label:
            formula = next((one.name for one in (index, of_other) if one.is_of_user), index.name)
            what = f"{label}_{index.name}.tif: would be an index of {other} and of {label}"
            raise ConfigurationError(f"{what}; give the formula '{formula}' another name")
    if target != out and target.is_dir():
        _refuse_indices_of_others(tasks)
    return tasks


def _refuse_indices_of_others(tasks: Sequence[IndexTask]) -> None:
    """Raise ConfigurationError for an index raster of another capture with the label of a task: cameras give the
    captures of each flight the same names.
    """
    for task in tasks:
        for raster in index_rasters(task.target / task.label):
            with suppress(SidecarError):  # reported when its task is done
                sidecar = read_sidecar(task.sidecar)
                files = {task.sidecar.parent / band.place.file for band in sidecar.bands if band.place is not None}
                if any(raster.is_of_other(file, sidecar.own_samples) for file in files):
                    raise ConfigurationError(f"{raster.path}: is of another flight; choose another folder with -o")


def run_indices(
    tasks: Sequence[IndexTask],
    jobs: int = 0,
    executor: Executor | None = None,
    on_problem: Callable[[str], object] = quiet,
) -> Generator[list[IndexReport], None, None]:
    """Write the indices of all captures, yield the reports of each, and finally write the table indices.csv, and the
    pages of the run if they are in the same folder. Files that are not in the pages are reported to `on_problem`.

    `jobs` is the maximum number of processes, each for one capture at a time; 0 is one per core. An `executor`
    processes the captures instead; its workers need the same folders.
    A failed capture is reported and does not stop the others. Raises WorkerError if no worker process can be started,
    and OutputError if the table or the pages cannot be written.
    """
    # Starting a process takes as long as the indices of eight captures.
    processes, _ = numbers_of_workers(len(tasks), cores_for(jobs), worth_a_process=8)
    rows: list[IndexReport] = []
    try:
        with open_workers(executor, processes, cv2.setNumThreads, preload=__name__) as run_tasks:
            sent = tasks if run_tasks is serially else [task.absolute() for task in tasks]
            for number, result in run_tasks(do_indices, sent):
                try:
                    reports = [_below(report, tasks[number].target) for report in result()]
                except Exception as error:
                    reports = _failed(tasks[number], failure_text(error))
                rows += reports
                yield reports
    finally:
        if rows:  # also after an interruption
            update_table(tasks[0].target, rows)
    if rows and (out := tasks[0].out) == tasks[0].target and (out / REPORT_FILE).is_file():
        from agalign.report.pages import write_pages  # workers do not need it

        write_pages(out, on_problem)


def do_indices(task: IndexTask) -> list[IndexReport]:
    """Write the indices of one capture; the reports include errors. Raises SidecarError."""
    sidecar, base = read_checked(task.sidecar).without_tables(), task.target / task.label
    try:
        with written_below(task.target):
            bands = bands_of(sidecar, task.sidecar.parent, mask_qa=task.mask_qa)
            files = ListedFiles.of(sidecar, task.sidecar.parent, task.file_states)
            written = partial(write_index, overwrite=task.overwrite, samples=sidecar.own_samples)
            with BandReader(files) as reader:
                reports = [written(reader, bands, index, base, task.label) for index in task.indices]
            if task.target == task.out:
                listed = {part.file for part in sidecar.products}
                # A command that was killed may have written a raster that the sidecar does not list.
                rasters = [r.path for r in reports if r.path is not None and not (r.kept and r.path.name in listed)]
                add_products(
                    task.sidecar, IndexRasters.kind, [p for path in rasters for p in (path, path.with_suffix(".png"))]
                )
        by_name = {index.name: index for index in task.indices}
        checks = [to_check(by_name[r.index], r.statistics.unit, sidecar, task.facts, task.label) for r in reports]
        reports = [r if r.problem else replace(r, problem=check) for r, check in zip(reports, checks, strict=True)]
    except AgalignError as error:
        reports = _failed(task, str(error))
    return [report.of(sidecar) for report in reports]


def _below(report: IndexReport, folder: Path) -> IndexReport:
    """Return the report of a worker, whose path is absolute, with its path below a folder as it was given."""
    return report if report.path is None else replace(report, path=below_as_given(report.path, folder))


def _failed(task: IndexTask, problem: str) -> list[IndexReport]:
    return [IndexReport(task.label, index.name, problem=problem) for index in task.indices]
