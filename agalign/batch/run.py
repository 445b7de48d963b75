"""A run over many captures: select those to process, learn the model of each flight, process them."""

import logging
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

from agalign.batch import earlier_results, output_files
from agalign.batch.capture_report import CaptureReport
from agalign.batch.capture_task import Task, do_capture, loaded_model, quiet
from agalign.batch.crops import Flight, grids_of_captures
from agalign.batch.earlier_results import EarlierResults, Remaining
from agalign.batch.flight_learning import captures_to_learn_from, learn_flight
from agalign.batch.model_files import ModelFiles
from agalign.batch.selection import Selection, select_captures
from agalign.batch.workers import (
    MAX_THREADS,
    DaskExecutor,
    RunTasks,
    failure_text,
    numbers_of_workers,
    open_workers,
    serially,
)
from agalign.cameras.discover import FolderScan
from agalign.config import RunOptions, Settings
from agalign.errors import AgalignError, ConfigurationError, InputError, OutputError, SidecarError
from agalign.flight.fingerprint import learning_fingerprint
from agalign.flight.groups import difference, flight_camera, flights_of, is_flight_of
from agalign.flight.model import FlightModel, load_model, save_model
from agalign.flight.panel_readings import PanelReading
from agalign.flight.rig_file import read_rig
from agalign.flight.sky import SkyCapture
from agalign.host.files import MODELS_FOLDER, below_as_given, check_inside, path_problem, written_below
from agalign.host.output_folder import is_full, locked
from agalign.host.own_files import refuse_foreign
from agalign.host.processes import cores_for
from agalign.host.text import counted, name_problem
from agalign.method.device import choose_device, limit_threads
from agalign.rasters.product import CapturePaths, RenderOptions
from agalign.records.listed_files import states_of
from agalign.records.panels_and_sky import last_panels_and_sky
from agalign.records.run_record import Finished, ProblemKind, RunPart, RunState, begun, input_name, last_record
from agalign.records.sidecar import FilePart
from agalign.report.pages import outdate_pages, pages_exist, write_pages
from agalign.report.pair_totals import PairTotals
from agalign.report.panel_and_sky_files import panel_picture, write_panels, write_sky
from agalign.spectral_indices.rasters import check_indices, impossible_indices
from agalign.values.capture import Capture

_SAVED_EVERY_S = 60.0
"""Time between two writings of the run record during a run."""


@dataclass(frozen=True)
class Listener:
    """Events of a run."""

    on_pair: Callable[[Capture, str, str, float], None] = quiet
    """A capture that this process aligns, then as `PairProgress`."""
    on_learning: Callable[[str, float], None] = quiet
    """Camera of the network that is being learned, and the share that is done."""
    on_learned: Callable[[str, float], None] = quiet
    """Camera of the network that was learned, and the seconds that it took."""
    on_again: Callable[[str], object] = quiet
    """How many finished captures are estimated or rendered again, and why; called before any is replaced."""
    on_problem: Callable[[str], object] = quiet
    """Why a file is not in the pages, which are written at the end of the run."""
    on_end: Callable[[RunPart, PairTotals | None], object] = quiet
    """The record of the run, and the band pairs in its pages; None if those of an earlier run are kept, or if there are
    none.
    """


def run_flight(
    flight: FolderScan,
    out: Path,
    settings: Settings,
    options: RunOptions | None = None,
    listener: Listener | None = None,
    model: Path | None = None,
) -> Generator[CaptureReport, None, None]:
    """Align the captures and yield the report of each; captures finished by an earlier run are kept, or rendered again
    if only settings of the output have changed.

    First a model is learned for every camera and flight, starting from `model` if given, and saved below OUT/models. A
    failed capture does not stop the others, and results do not depend on the order of the captures. The run is recorded
    in OUT/agalign-run.json.
    Raises OutputError if the output folder cannot be used, another run writes there, the disk is full or outputs were
    removed, WorkerError if no worker process can be started or worker processes end one after another, InputError or
    ConfigurationError for `model`, ConfigurationError for a device, for a Dask worker that does not see the folders,
    for results of other captures of the same name, and for a radiometry or georeference that no capture has tags for.
    """
    run = _FlightRun(flight, out, settings, options or RunOptions(), listener or Listener()).checked(model)
    with locked(out):
        # What can be refused is refused before the record and the pages of an earlier run are touched.
        if isinstance(run.options.executor, DaskExecutor):
            run.options.executor.refuse_missing([*(c.reference.path for c in flight.captures[:1]), out])
        yield from _run_selected(run, run.selected())


def _run_selected(run: "_FlightRun", selection: Selection) -> Iterator[CaptureReport]:
    """Process the captures of a run, record it, and yield the report of each capture. Raises as `run_flight`."""
    out = run.out
    finished: dict[str, Finished] = {}
    gone, again = list[str](), "the same command writes them again"
    began = saved = time.monotonic()
    with _recorded(run) as record:
        try:
            for report in run.reports(selection, record):
                for text in report.problems:
                    kinds: dict[str | None, ProblemKind] = dict.fromkeys(report.impossible_products, "impossible")
                    kinds |= {report.error: "failed", report.why_kept: "kept"}
                    record.add_problem(report.label, text, kinds.get(text, "not_written"))
                for (_, stage), seconds in report.stages.items():
                    record.stage_seconds[stage] += seconds
                one = Finished(report.state, seconds=report.seconds)
                if report.result is not None and report.path is not None:
                    # A finished capture may lack an index raster, which only `agalign indices` restores.
                    here = [p for p in report.result.files if earlier_results.outputs_exist(report.path, [p])]
                    one = replace(one, pairs=report.result.pairs, sidecar=report.path, files=here)
                    record.file_states[report.label] = run.file_states(report, report.path.parent, here)
                finished[report.label] = one
                if time.monotonic() - saved > _SAVED_EVERY_S:  # for the case that the run is killed
                    saved = time.monotonic()
                    record.count(finished)
                    record.write(out, "running", saved - began)
                yield report
                if report.problems and is_full(out):
                    raise OutputError(f"{out}: the disk is full; free space, then the same command resumes the run")
        finally:
            for label, one in finished.items():
                if one.sidecar is not None and not earlier_results.outputs_exist(one.sidecar, one.files):
                    gone.append(label)
                    finished[label] = Finished("error")
                    record.add_problem(label, f"its files were removed during the run; {again}", "failed")
            record.count(finished)
        if gone:
            what = f"outputs of {counted(len(gone), 'capture')} were removed during the run, such as of {gone[0]}"
            raise OutputError(f"{out}: {what}; {again}")


def plan_run(
    flight: FolderScan, out: Path, settings: Settings, options: RunOptions | None = None, model: Path | None = None
) -> dict[str, str]:
    """Return what `run_flight` would do with each capture, by label. Writes nothing.

    Only after learning is it known whether the crop of the flight changes, and finished captures are rendered again.
    Raises InputError and ConfigurationError like `run_flight` does.
    """
    run = _FlightRun(flight, out, settings, options or RunOptions()).checked(model)
    selection = run.selected()
    states = dict(selection.abandoned) | {s.capture.label: "left out as sky" for s in selection.sky}
    states |= {p.capture.label: "read as calibration panels" for p in selection.panels if p.capture.is_of_a_panel}
    for capture in selection.captures:
        states[capture.label] = run.remaining(capture).in_words
    return {c.label: states[c.label] for c in flight.captures}


@contextmanager
def _recorded(run: "_FlightRun") -> Iterator[RunPart]:
    """Write the run record at the beginning of a run, and with the pages at its end, also after an interruption."""
    began, earlier = time.monotonic(), last_record(run.out)
    record = begun(run.flight.folder, run.settings, run.flight.captures, run.options.command)
    states = {} if earlier is None else earlier.file_states
    # A file that appears later in the place of a deleted sidecar is not of agalign.
    record.file_states = {label: one for label, one in states.items() if (run.out / f"{label}.json").exists()}
    record.other_inputs = earlier_results.labels_of_other_inputs(earlier, record)
    record.not_in_input = list(earlier_results.results_not_in_input(run.flight, run.out, record.other_inputs))
    used = {band.path for capture in run.flight.captures for band in capture.bands}
    for problem in run.flight.problems:
        record.add_problem(str(problem.path), problem.text, "used" if problem.path in used else "skipped")
    record.write(run.out, "running", 0.0)
    try:
        yield record
    except BaseException:
        with suppress(AgalignError):
            run.end(record, "interrupted", time.monotonic() - began, earlier)
        raise
    run.end(record, "finished", time.monotonic() - began, earlier)


@dataclass(frozen=True)
class _FlightRun:
    """The steps of `run_flight`."""

    flight: FolderScan
    out: Path
    settings: Settings
    options: RunOptions
    listener: Listener = Listener()
    given: FlightModel | None = None
    """Model to start from."""
    results: EarlierResults = field(default_factory=EarlierResults)

    def checked(self, model: Path | None) -> Self:
        """Return the run, with a model to start from if one is given. Raises ConfigurationError for a device, an index,
        an output folder or a model that cannot be used.
        """
        if not name_problem(self.out) and (problem := path_problem(self.out)):
            raise ConfigurationError(f"{problem}, or choose another output folder with -o")
        choose_device(self.settings.joint.device)
        check_indices(self.flight.captures, self.settings.write)
        if self.out.resolve() == self.flight.folder.resolve():
            raise ConfigurationError(f"{self.out}: is the folder of the images; choose another output folder with -o")
        earlier = last_record(self.out)
        self.results.file_states.update({} if earlier is None else earlier.file_states)
        output_files.refuse_to_overwrite(self.flight.captures, self.out, self.settings.write, self.results)
        if earlier is None or earlier.input != input_name(self.flight.folder):  # else the images were moved in it
            output_files.refuse_results_elsewhere(self.flight.captures, self.out, self.results)
        output_files.refuse_foreign_run_files(self.out)
        check_inside(self.out / MODELS_FOLDER, self.out)
        return self if model is None else self._starting_from(model)

    def _starting_from(self, path: Path) -> Self:
        """Return the run with a model. Raises ConfigurationError if it does not fit the settings or the cameras."""
        settings = self.settings
        if not settings.learns_flights:
            reasons = {
                "--only-seed stops before a network is used": settings.seed.only,
                "--each-alone learns a network for each capture": not settings.flight.together,
                "recipe paper learns no network of a flight": settings.joint.recipe == "paper",
            }
            reason = next(text for text, applies in reasons.items() if applies)
            raise ConfigurationError(f"{path}: is not used, as {reason}; leave --model out, or the other option")
        model = load_model(path, lambda: choose_device(settings.joint.device))
        if model.net.sharing == "unshared" and settings.joint.sharing != "unshared":
            raise ConfigurationError(f"{path}: was learned unshared; add --sharing unshared")
        flights = flights_of(self.flight.captures)
        if flights and model.camera is not None and not any(is_flight_of(c, model.camera) for c in flights):
            what = difference(model.camera, flight_camera(flights[0]))
            raise ConfigurationError(f"{path}: {what}; leave --model out")
        flight_settings = settings.flight.model_copy(update={"start_model": model.fingerprint})
        return replace(self, given=model, settings=settings.model_copy(update={"flight": flight_settings}))

    def selected(self) -> Selection:
        """Return what the run does with each capture. Raises ConfigurationError as `select_captures`, and for a file of
        the user at the path of the picture of a panel.
        """
        selection = select_captures(self.flight.captures, self.settings.write, self.options)
        for reading in selection.panels:
            refuse_foreign(panel_picture(reading.capture.label, self.out))
        return selection

    def remaining(self, capture: Capture) -> Remaining:
        """Return what remains to be done for a capture."""
        return earlier_results.remaining(capture, self.out, self.settings, self.options, self.results)

    def file_states(self, report: CaptureReport, folder: Path, files: Sequence[FilePart]) -> str:
        """Return the states of those files of a report that are as they were written, given the folder of its sidecar,
        for the record. A rendering may keep index rasters of an earlier command.
        """
        self.results.changed_files(report.label, folder, [part for part in files if part.kind == "index"])
        written = [part for part in files if report.state == "done" and part.kind != "index"]
        compared = {*self.results.file_states[report.label].split(), *states_of(folder, written)}
        return " ".join(state for state in states_of(folder, files) if state in compared)

    def reports(self, selection: Selection, record: RunPart) -> Iterator[CaptureReport]:
        """Yield the report of each capture; add the time of learning to the record."""
        for label, reason in selection.abandoned.items():
            yield CaptureReport(label, "error", error=reason)
        for report, capture in self._excluded(selection.sky, selection.panels, record):
            removed = output_files.remove_outputs(capture, self.out, self.settings.write)
            reason = f"captures of a calibration panel or the sky are not aligned, as {capture.label}"
            yield replace(report, removed=tuple((path, reason) for path in removed))
        yield from self._aligned(selection.captures, record)

    def _excluded(
        self, sky: Sequence[SkyCapture], panels: Sequence[PanelReading], record: RunPart
    ) -> Iterator[tuple[CaptureReport, Capture]]:
        """Write the records of the sky and of the panels, and keep those of other inputs; yield the captures that are
        not aligned, with reports.
        """
        others = {label for labels in record.other_inputs.values() for label in labels}
        earlier_panels, earlier_sky = last_panels_and_sky(self.out)
        parts_of_sky = write_sky(sky, self.out, [part for part in earlier_sky if part.label in others])
        parts_of_panels = write_panels(panels, self.out, [part for part in earlier_panels if part.label in others])
        gone = {part.label for part in earlier_panels} - others.union(part.label for part in parts_of_panels)
        pictures = (panel_picture(label, self.out) for label in gone)
        output_files.remove_files([path for path in pictures if output_files.is_removed(path, {})], self.out)
        for excluded, part in zip(sky, parts_of_sky, strict=True):
            yield CaptureReport(part.label, "sky", sky=part.sentence), excluded.capture
        for reading, panel in zip(panels, parts_of_panels, strict=True):
            if panel.is_left_out:
                yield CaptureReport(panel.label, "panel", panel=panel.sentence), reading.capture

    def _aligned(self, captures: Sequence[Capture], record: RunPart) -> Iterator[CaptureReport]:
        """Learn the model of each flight, keep finished captures and process the others; yield their reports as they
        complete.
        """
        left, timeout_s = {c.label: self.remaining(c) for c in captures}, self.options.timeout_s
        on_cpu = choose_device(self.settings.joint.device).type == "cpu"
        cores = cores_for(self.options.jobs or (0 if on_cpu else 1))  # a GPU serves one process
        has_timeout = timeout_s is not None

        def numbers() -> tuple[int, int]:
            to_process = sum(one.is_processed for one in left.values())
            return numbers_of_workers(to_process, cores, has_timeout=has_timeout)

        def workers(processes: int, threads: int) -> AbstractContextManager[RunTasks]:
            return open_workers(self.options.executor, processes, limit_threads, threads, has_timeout=has_timeout)

        with ExitStack() as stack:
            before_learning = numbers()
            run_tasks = stack.enter_context(workers(*before_learning))
            learn = partial(learn_flight, run_tasks=run_tasks, threads=min(MAX_THREADS, cores), timeout_s=timeout_s)
            tasks = []
            renderings = list(self._renderings([*self._flights(captures, left, learn, record)], left))
            if numbers() != before_learning:  # finished captures get the crop of the new model
                stack.close()
                run_tasks = stack.enter_context(workers(*numbers()))
            for capture, model, rendering in renderings:
                one = left[capture.label]
                if not one.is_processed:
                    yield self._kept(capture, one)
                    continue
                is_estimated = one.step == "render"
                tasks.append(Task(capture, self.out, self.settings, model, rendering, is_estimated=is_estimated))
            for message in earlier_results.changes(left.values()):
                self.listener.on_again(message)
            yield from capture_reports(run_tasks, tasks, self.listener, timeout_s)

    def end(self, record: RunPart, state: RunState, seconds: float, earlier: RunPart | None) -> None:
        """Write the record, given that of the run before, and the pages unless they have the same results already.

        Raises OutputError.
        """
        is_kept, pairs = record.captures.keys() <= {"found", "kept", "panel", "sky"}, None
        if not is_kept or (earlier is not None and not record.has_same_results(earlier)):
            outdate_pages(self.out)
        try:
            record.end(self.out, state, seconds, earlier)
            if not pages_exist(self.out):
                pairs = write_pages(self.out, self.listener.on_problem).pairs
        except MemoryError:
            text = f"{self.out}: the report does not fit into memory; 'agalign report {self.out}' writes it elsewhere"
            logging.getLogger(__name__).warning(text)
        finally:
            self.listener.on_end(record, pairs)

    def _flights(
        self,
        captures: Sequence[Capture],
        left: Mapping[str, Remaining],
        learn: Callable[..., FlightModel | None],
        record: RunPart,
    ) -> Iterator[Flight]:
        """Yield the flights with the files of their models, which are learned where something needs them; `left` is
        what remains to be done, by label.
        """
        files = ModelFiles(self.out)
        for group in flights_of(captures):
            used = {self.results.models.get(CapturePaths.of(c, self.out).sidecar, "") for c in group} - {""}
            path = files.find(group, used)
            model = path if path is not None and _is_model(path) else None
            steps = {left[c.label].step for c in group}
            # Without the model, which may be damaged or deleted, captures that are rendered get another crop.
            if "estimate" in steps or ("render" in steps and used and model is None):
                model = self._model(group, path, files, learn, record)
            yield group, model

    def _renderings(
        self, flights: Sequence[Flight], left: dict[str, Remaining]
    ) -> Iterator[tuple[Capture, Path | None, RenderOptions]]:
        """Yield each capture with the model of its flight and how it is rendered; with another crop, it is again, which
        is noted in `left`.
        """
        kept = {label: one.grid for label, one in left.items() if one.grid is not None}
        grids = grids_of_captures(flights, kept, self.settings.write, self.out)
        for group, model in flights:
            for capture in group:
                common, fine = grids[capture.label]
                is_finished = left[capture.label].step == "nothing"
                if is_finished and common is not None and kept.get(capture.label, common) != common:
                    left[capture.label] = Remaining("render", ("crop of the flight",))
                yield capture, model, RenderOptions(len(self.flight.captures), common, fine)

    def _kept(self, capture: Capture, left: Remaining) -> CaptureReport:
        """Return the report of a capture that this run does not process."""
        path = CapturePaths.of(capture, self.out).sidecar
        with suppress(SidecarError):
            sidecar, change = self.results(path)
            if not change:
                impossible = impossible_indices(self.settings.write.indices, sidecar, path.parent)
                report = CaptureReport(capture.label, "kept", sidecar, path, why_kept=left.why_kept)
                return replace(report, impossible_products=impossible)
        why = left.why_kept or f"{path}: was changed during the run; the same command estimates the capture again"
        return CaptureReport(capture.label, "error", error=why, why_kept=left.why_kept)

    def _model(
        self,
        captures: Sequence[Capture],
        earlier: Path | None,
        files: ModelFiles,
        learn: Callable[..., FlightModel | None],
        record: RunPart,
    ) -> Path | None:
        """Return the path of the flight's model, from this or an earlier run; None if no model could be learned.

        `earlier` is the model by which captures of the flight were aligned.
        """
        settings, given = self.settings, self.given
        if not settings.learns_flights:
            return None
        read = {capture.label for capture in captures_to_learn_from(captures)}
        fingerprint = learning_fingerprint(captures, settings, read)
        # A run that is stopped before its first capture leaves a model that no sidecar names.
        path = files.find(captures, {fingerprint}) or earlier or files.new(captures)
        with suppress(AgalignError):
            if loaded_model(path, settings.joint.device).fingerprint == fingerprint:
                return path
        began = time.monotonic()
        start = given if given is not None and is_flight_of(captures, given.camera) else None
        model = learn(captures, settings, lambda _stage, share: self.listener.on_learning(path.stem, share), start)
        seconds = time.monotonic() - began
        record.stage_seconds["learning a flight"] += seconds
        self.listener.on_learned(path.stem, seconds)
        if model is None:
            return None
        with written_below(self.out):
            save_model(replace(model, fingerprint=fingerprint), path)
        files.add(path, fingerprint)
        return path


def _is_model(path: Path) -> bool:
    """True for a model file that can be read."""
    with suppress(InputError):
        read_rig(path)
        return True
    return False


def capture_reports(
    run_tasks: RunTasks, tasks: Sequence[Task], listener: Listener, timeout_s: float | None
) -> Iterator[CaptureReport]:
    """Yield the report of each task as it completes. In this process, the listener is called."""
    if run_tasks is serially:
        for task in tasks:
            yield do_capture(task, partial(listener.on_pair, task.capture))
        return
    for number, result in run_tasks(do_capture, [task.absolute() for task in tasks], timeout_s=timeout_s):
        try:
            report = _below(result(), tasks[number].out)
        except Exception as error:
            report = CaptureReport(tasks[number].capture.label, "error", error=failure_text(error, timeout_s))
        yield report


def _below(report: CaptureReport, out: Path) -> CaptureReport:
    """Return the report of a worker, whose paths are absolute, with paths below the output folder as it was given."""
    removed = tuple((below_as_given(path, out), reason) for path, reason in report.removed)
    return replace(report, path=None if report.path is None else below_as_given(report.path, out), removed=removed)
