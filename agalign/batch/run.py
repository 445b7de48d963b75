"""A run over many captures: select those to process, learn the model of each flight, process them."""

import stat
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from agalign.batch.capture import discard_outputs, paths_written, quiet
from agalign.batch.learn import learn_flight, learning_fingerprint
from agalign.batch.output_folder import is_full, locked
from agalign.batch.report import CaptureReport
from agalign.batch.runners import Runner, choose_runner
from agalign.batch.workers import Task, loaded_model, stamp
from agalign.cameras.discover import FolderScan
from agalign.capture.align import PairProgress
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, ConfigurationError, OutputError, SidecarError
from agalign.flight.fingerprint import fingerprint
from agalign.flight.groups import flight_camera, flights_of, is_flight_of, model_names
from agalign.flight.model import FlightModel, load_model, save_model
from agalign.flight.panels import PanelReading, read_panel, reflectance_factors, with_height, with_panels
from agalign.flight.sky import SkyCapture, sky_captures
from agalign.method.device import choose_device
from agalign.pixels.radiometry import with_radiometry
from agalign.products.flight_map import FlightMap
from agalign.products.footprint import above_elevation, with_approximate_georeference
from agalign.products.index_product import check_indices
from agalign.products.panels import write_panels, write_sky
from agalign.products.preview import preview_bytes
from agalign.products.product import CapturePaths
from agalign.products.run_record import RunPart, RunState, begun
from agalign.products.sidecar import CaptureResult
from agalign.products.sidecar_file import read_result
from agalign.products.stac import write_collections
from agalign.values.capture import Capture
from agalign.values.cores import usable_cores

_MAX_THREADS = 4
"""Maximum number of threads that train a network; more wait for the interpreter's lock."""


@dataclass(frozen=True)
class RunOptions:
    """How to run; no option changes the result of a capture."""

    overwrite: bool = False
    """Process finished captures again."""
    jobs: int = 1
    """Captures to process at the same time; 0 is one per core. Few captures are processed one after another."""
    align_panels: bool = False
    """Also align captures of calibration panels and of the sky."""
    executor: Executor | None = None
    """Executor that processes the captures, such as `dask_executor`; its workers need the same folders."""
    retry_failed: bool = False
    """Process captures again if a band is not aligned or missing."""
    timeout_s: float | None = None
    """Seconds after which the process of a capture is killed; ignored with an `executor` (`dask_executor` has its
    own)."""
    command: str = ""
    """Command line, for run record and report."""


@dataclass(frozen=True)
class Listener:
    """Events of a run."""

    on_start: Callable[[Capture], None] = quiet
    on_pair: PairProgress = quiet
    """Of captures in this process only."""
    on_learning: Callable[[str, float], None] = quiet
    """Camera of the network that is being learned, and the share that is done."""
    on_learnt: Callable[[str, float], None] = quiet
    """Camera of the network that was learned, and the seconds that it took."""


def run_flight(
    flight: FolderScan, out: Path, settings: Settings, options: RunOptions | None = None,
    listener: Listener | None = None, model: Path | None = None,
) -> Iterator[CaptureReport]:  # fmt: skip
    """Align the captures and yield the report of each; captures finished by an earlier run are kept.

    First a model is learned for every camera and flight, starting from `model` if given, and saved below OUT/models. A
    failed capture does not stop the others, and results do not depend on the order of the captures. The run is recorded
    in OUT/agalign-run.json.
    Raises OutputError if the output folder cannot be used, another run writes there or the disk is full, WorkerError if
    no worker process can be started or worker processes end one after another, InputError or ConfigurationError for
    `model`, ConfigurationError for a device.
    """
    options, listener = options or RunOptions(), listener or Listener()
    choose_device(settings.joint.device)
    check_indices(flight.captures, settings.write)
    _refuse_to_overwrite(flight, out, settings.write)
    given = None if model is None else _given_model(model, flight, settings)
    if given is not None:
        flight_settings = settings.flight.model_copy(update={"start": given.fingerprint})
        settings = settings.model_copy(update={"flight": flight_settings})
    with locked(out), _recorded(flight, out, settings, options.command) as record:
        for report in _reports(flight, out, settings, options, _with_seconds(listener, record), given):
            record.add(report.label, report.state, report.result, report.problems)
            if report.state == "done":
                record.capture_seconds[report.label] = report.seconds
            for (_, stage), seconds in report.stages.items():
                record.add_seconds(stage, seconds)
            yield report
            if report.problems and is_full(out):
                raise OutputError(f"{out}: the disk is full; free space, then the same command resumes the run")


@contextmanager
def _recorded(flight: FolderScan, out: Path, settings: Settings, command: str) -> Iterator[RunPart]:
    """Write the run record at the beginning and at the end of a run, also after an interruption."""
    record, began = begun(flight.folder, settings, flight.captures, command), time.monotonic()
    for problem in flight.problems:
        record.add_problem(str(problem.path), problem.text)

    def write(state: RunState) -> None:
        record.write(out, state, time.monotonic() - began)

    write("running")
    try:
        yield record
    except BaseException:
        with suppress(OutputError):
            write("interrupted")
        raise
    write("finished")


def _with_seconds(listener: Listener, record: RunPart) -> Listener:
    def on_learnt(camera: str, seconds: float) -> None:
        record.add_seconds("learning a flight", seconds)
        listener.on_learnt(camera, seconds)

    return replace(listener, on_learnt=on_learnt)


def _reports(
    flight: FolderScan, out: Path, settings: Settings, options: RunOptions, listener: Listener,
    given: FlightModel | None,
) -> Iterator[CaptureReport]:  # fmt: skip
    sky, captures = _sky(flight.captures, options)
    flight_map = FlightMap(out)
    for excluded, facts in zip(sky, write_sky(sky, out), strict=True):
        discard_outputs(excluded.capture, out, settings.write)
        flight_map.add(excluded.capture, "sky")
        yield CaptureReport(excluded.capture.label, "sky", sky=facts.sentence)
    panels, captures = _panels(captures, settings.write, options)
    for reading, part in zip(panels, write_panels(panels, out), strict=True):
        if not reading.capture.is_of_a_panel:
            continue
        discard_outputs(reading.capture, out, settings.write)
        flight_map.add(reading.capture, "panel")
        yield CaptureReport(reading.capture.label, "panel", panel=part.sentence)
    # Captures of each flight, name of its model, and those captures that must be processed.
    unfinished: list[tuple[Sequence[Capture], str, list[Capture]]] = []
    captures = [_calibrated(capture, panels, settings.write) for capture in captures]
    _require_georeference(captures, settings.write)
    groups = flights_of(captures)
    for group, name in zip(groups, model_names(groups), strict=True):
        pending = []
        for capture in group:
            kept = _kept(capture, out, settings, options)
            if kept is None:
                pending.append(capture)
            else:
                flight_map.add(capture, kept.status, kept)
                yield CaptureReport(capture.label, "kept", kept, CapturePaths.of(capture, out).sidecar)
        if pending:
            unfinished.append((group, name, pending))
    count, cores = sum(len(pending) for _, _, pending in unfinished), _cores(options, settings)
    with choose_runner(
        count, cores, options.executor, options.timeout_s, listener.on_start, listener.on_pair
    ) as runner:
        tasks: list[Task] = []
        for of_flight, name, pending in unfinished:
            path = _learn(of_flight, out / "models" / name, settings, listener, given, runner, min(_MAX_THREADS, cores))
            tasks += [Task(c, out, settings, path, preview_bytes(len(flight.captures))) for c in pending]
        by_label = {c.label: c for c in captures}
        for report in runner.reports(tasks):
            status = "failed" if report.result is None else report.result.status
            flight_map.add(by_label[report.label], status, report.result)
            yield report
    flight_map.write()
    if settings.write.stac:
        write_collections(captures, out)


def plan_run(flight: FolderScan, out: Path, settings: Settings, options: RunOptions | None = None) -> dict[str, str]:
    """Return what `run_flight` would do with each capture, by label. Writes nothing.

    Raises ConfigurationError like `run_flight` does.
    """
    options = options or RunOptions()
    choose_device(settings.joint.device)
    check_indices(flight.captures, settings.write)
    _refuse_to_overwrite(flight, out, settings.write)
    sky, captures = _sky(flight.captures, options)
    panels, captures = _panels(captures, settings.write, options)
    states = {s.capture.label: "left out as sky" for s in sky}
    states |= {p.capture.label: "read as calibration panels" for p in panels if p.capture.is_of_a_panel}
    for raw in captures:
        kept = _kept(_calibrated(raw, panels, settings.write), out, settings, options)
        states[raw.label] = "to be aligned" if kept is None else "kept from an earlier run"
    return {c.label: states[c.label] for c in flight.captures}


def _calibrated(capture: Capture, panels: Sequence[PanelReading], settings: WriteSettings) -> Capture:
    """Return the capture with its radiometry, its height above the ground if the elevation of the ground or a panel
    determines it, and its approximate georeference if `settings` ask for it.
    """
    capture = with_radiometry(capture, settings.radiometry, reflectance_factors(capture, panels))
    if settings.ground_elevation_m is not None:
        capture = above_elevation(capture, settings.ground_elevation_m)
    capture = with_height(capture, panels)
    return with_approximate_georeference(capture) if settings.georeference else capture


def _require_georeference(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError if an approximate georeference is asked for and no capture has the metadata for it."""
    if settings.georeference and captures and all(c.reference.georeference is None for c in captures):
        raise ConfigurationError(
            "--georeference: no capture has position, altitude, yaw and focal length in its tags, and a height above "
            "the ground; where only the height is missing, give --ground-elevation"
        )


def _kept(capture: Capture, out: Path, settings: Settings, options: RunOptions) -> CaptureResult | None:
    """Return the result of an earlier run; None if the capture must be processed (again)."""
    earlier = None if options.overwrite else finished_before(capture, out, settings)
    return None if earlier is None or (options.retry_failed and earlier.status != "ok") else earlier


def _sky(captures: Sequence[Capture], options: RunOptions) -> tuple[list[SkyCapture], list[Capture]]:
    """Return (captures of the sky, other captures)."""
    return ([], list(captures)) if options.align_panels else sky_captures(captures)


def _panels(
    captures: Sequence[Capture], settings: WriteSettings, options: RunOptions
) -> tuple[list[PanelReading], list[Capture]]:
    """Return (readings of calibration panels, captures to align); a scene that contains a panel is in both."""
    if options.align_panels:
        return [], list(captures)
    albedos = dict(settings.panel_albedo)
    seen = with_panels(captures, without_code=bool(albedos))
    panels = [read_panel(c, albedos) for c in seen if c.panel is not None]
    return panels, [c for c in seen if not c.is_of_a_panel]


def _cores(options: RunOptions, settings: Settings) -> int:
    """Return how many captures to process at a time by default: one per core, or one on a GPU."""
    on_cpu = choose_device(settings.joint.device).type == "cpu"
    return options.jobs or (usable_cores() if on_cpu else 1)


def _given_model(path: Path, flight: FolderScan, settings: Settings) -> FlightModel:
    """Load the model to start from. Raises ConfigurationError if it does not fit the settings or the cameras."""
    if not settings.learns_flights:
        raise ConfigurationError("a model needs one network per flight, which only recipe fast learns")
    model = load_model(path, lambda: choose_device(settings.joint.device))
    if model.net.sharing == "unshared" and settings.joint.sharing != "unshared":
        raise ConfigurationError(f"{path}: was learned unshared; add --sharing unshared")
    flights = flights_of(flight.captures)
    if flights and not any(is_flight_of(captures, model.camera) for captures in flights):
        here = flight_camera(flights[0])
        raise ConfigurationError(f"{path}: was learned for {model.camera}; the images here are of {here}")
    return model


def _learn(
    captures: Sequence[Capture], path: Path, settings: Settings, listener: Listener, given: FlightModel | None,
    runner: Runner, threads: int,
) -> Path | None:  # fmt: skip
    """Return the path of the flight's model, from this or an earlier run; None if no model could be learned."""
    if not settings.learns_flights:
        return None
    start = given if given is not None and is_flight_of(captures, given.camera) else None
    device = settings.joint.device
    if path.is_file():
        with suppress(AgalignError):
            if loaded_model(path, device, stamp(path)).fingerprint == learning_fingerprint(captures, settings):
                return path

    def progress(_stage: str, share: float) -> None:
        listener.on_learning(path.stem, share)

    began = time.monotonic()
    model = learn_flight(captures, settings, progress, start, runner.apply, threads)
    listener.on_learnt(path.stem, time.monotonic() - began)
    if model is None:
        return None
    save_model(model, path)
    return path


def _refuse_to_overwrite(flight: FolderScan, out: Path, settings: WriteSettings) -> None:
    """Raise ConfigurationError if an output would replace an input image or an output of another capture."""
    if out.resolve() == flight.folder.resolve():
        raise ConfigurationError(f"{out}: is the folder of the images; choose another output folder with -o")
    sources = {band.path.resolve() for capture in flight.captures for band in capture.bands}
    resolved: dict[Path, Path] = {}
    written: dict[str, Capture] = {}
    for capture in flight.captures:
        for path in paths_written(capture, out, settings):
            if path.parent not in resolved:
                resolved[path.parent] = path.parent.resolve()
            if resolved[path.parent] / path.name in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder with -o")
            other = written.setdefault(str(path).lower(), capture)
            if other is not capture:
                raise ConfigurationError(
                    f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
                )


def finished_before(capture: Capture, out: Path, settings: Settings) -> CaptureResult | None:
    """Return the result of an earlier run with the same settings and bands if all its outputs exist, else None."""
    path = CapturePaths.of(capture, out).sidecar
    try:
        sidecar = read_result(path)
    except SidecarError:
        return None
    if sidecar.settings != fingerprint(capture, settings):
        return None
    return sidecar if not sidecar.not_written and _outputs_exist(sidecar, path.parent) else None


def _outputs_exist(sidecar: CaptureResult, folder: Path) -> bool:
    """True if every file that the sidecar lists exists with its size; checksums would take minutes."""
    try:
        states = [((folder / name).stat(), size) for name, size in sidecar.files.items()]
    except OSError:
        return False
    return all(stat.S_ISREG(state.st_mode) and state.st_size == size for state, size in states)
