"""Many captures: which are still to be done, what their flight learns first, and each one done."""

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
from agalign.batch.runners import choose_runner
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
from agalign.products.panels import write_panels
from agalign.products.preview import preview_bytes
from agalign.products.product import CapturePaths
from agalign.products.run_record import RunState, Tally, begun, problem_of, write_run_record
from agalign.products.sidecar import CaptureResult
from agalign.products.sidecar_file import read_result
from agalign.products.sky import write_sky
from agalign.products.stac import write_collections
from agalign.values.capture import Capture
from agalign.values.cores import usable_cores

_MAX_THREADS = 4
"""Threads that learn a flight: more wait for the interpreter."""


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
    """Align the captures, yielding each as it is done; those done before are kept.

    A network is learnt for every camera and flight first and saved below OUT/models; `model` is one to start from.
    One capture's failure never stops the others, and no result depends on the order in which they are done. What the
    run was is in OUT/agalign-run.json.
    Raises OutputError where the output folder cannot be used, another run writes there or the disk is full, WorkerError
    where no worker process can be started or they end one after another, InputError or ConfigurationError for `model`,
    ConfigurationError for a device.
    """
    options, listener = options or RunOptions(), listener or Listener()
    choose_device(settings.joint.device)
    check_indices(flight.captures, settings.write)
    _refuse_to_overwrite(flight, out, settings.write)
    known = None if model is None else _given_model(model, flight, settings)
    if known is not None:
        used = settings.flight.model_copy(update={"start": known.fingerprint})
        settings = settings.model_copy(update={"flight": used})
    with locked(out), _recorded(flight, out, settings, options.command) as tally:
        for report in _reports(flight, out, settings, options, _with_seconds(listener, tally), known):
            tally.add(report.label, report.state, report.result, report.problems)
            if report.state == "done":
                tally.capture_seconds[report.label] = report.seconds
            for (_, stage), seconds in report.stages.items():
                tally.stage_seconds[stage] += seconds
            yield report
            if report.problems and is_full(out):
                raise OutputError(f"{out}: the disk is full; free space, then the same command resumes the run")


@contextmanager
def _recorded(flight: FolderScan, out: Path, settings: Settings, command: str) -> Iterator[Tally]:
    """A tally that is written at the beginning and at the end of a run, however it ends."""
    tally, began = Tally(), time.monotonic()
    tally.captures["found"] = len(flight.captures)
    tally.problems += [problem_of(str(p.path), p.text) for p in flight.problems]
    run = begun(flight.folder, settings, flight.captures, command)

    def write(state: RunState) -> None:
        write_run_record(out, run, tally, state, time.monotonic() - began)

    write("running")
    try:
        yield tally
    except BaseException:
        with suppress(OutputError):
            write("interrupted")
        raise
    write("finished")


def _with_seconds(listener: Listener, tally: Tally) -> Listener:
    def on_learnt(camera: str, seconds: float) -> None:
        tally.stage_seconds["learning a flight"] += seconds
        listener.on_learnt(camera, seconds)

    return replace(listener, on_learnt=on_learnt)


def _reports(
    flight: FolderScan, out: Path, settings: Settings, options: RunOptions, listener: Listener,
    known: FlightModel | None,
) -> Iterator[CaptureReport]:  # fmt: skip
    sky, captures = _sky(flight.captures, options)
    on_map = FlightMap(out)
    for left_out, facts in zip(sky, write_sky(sky, out), strict=True):
        discard_outputs(left_out.capture, out, settings.write)
        on_map.add(left_out.capture, "sky")
        yield CaptureReport(left_out.capture.label, "sky", sky=facts.sentence)
    panels, captures = _panels(captures, settings.write, options)
    for reading, part in zip(panels, write_panels(panels, out), strict=True):
        if not reading.capture.is_of_a_panel:
            continue
        discard_outputs(reading.capture, out, settings.write)
        on_map.add(reading.capture, "panel")
        yield CaptureReport(reading.capture.label, "panel", panel=part.sentence)
    left: list[tuple[Sequence[Capture], str, list[Capture]]] = []
    captures = [_calibrated(capture, panels, settings.write) for capture in captures]
    _need_georeference(captures, settings.write)
    groups = flights_of(captures)
    for group, name in zip(groups, model_names(groups), strict=True):
        mine = []
        for capture in group:
            kept = _kept(capture, out, settings, options)
            if kept is None:
                mine.append(capture)
            else:
                on_map.add(capture, kept.status, kept)
                yield CaptureReport(capture.label, "kept", kept, CapturePaths.of(capture, out).sidecar)
        if mine:
            left.append((group, name, mine))
    count, cores = sum(len(mine) for _, _, mine in left), _cores(options, settings)
    with choose_runner(
        count, cores, options.executor, options.timeout_s, listener.on_start, listener.on_pair
    ) as runner:
        tasks: list[Task] = []
        for whole, name, mine in left:
            path = _learn(whole, out / "models" / name, settings, listener, known, min(_MAX_THREADS, cores))
            tasks += [Task(c, out, settings, path, preview_bytes(len(flight.captures))) for c in mine]
        by_label = {c.label: c for c in captures}
        for report in runner.reports(tasks):
            status = "failed" if report.result is None else report.result.status
            on_map.add(by_label[report.label], status, report.result)
            yield report
    on_map.write()
    if settings.write.stac:
        write_collections(captures, out)


def plan_run(flight: FolderScan, out: Path, settings: Settings, options: RunOptions | None = None) -> dict[str, str]:
    """Return what `run_flight` would do with each capture, by its label, and write nothing.

    Raises ConfigurationError as `run_flight` does.
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
    """The capture with the radiometry to be written, its height above the ground where the ground's elevation or a
    panel shows it, and the georeference that this allows where it was asked for.
    """
    capture = with_radiometry(capture, settings.radiometry, reflectance_factors(capture, panels))
    if settings.ground_elevation_m is not None:
        capture = above_elevation(capture, settings.ground_elevation_m)
    capture = with_height(capture, panels)
    return with_approximate_georeference(capture) if settings.georeference else capture


def _need_georeference(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError where an approximate georeference was asked for and no capture can have one."""
    if settings.georeference and captures and all(c.reference.georeference is None for c in captures):
        raise ConfigurationError(
            "--georeference: no capture has position, altitude, yaw and focal length in its tags, and a height above "
            "the ground; where only the height is missing, give --ground-elevation"
        )


def _kept(capture: Capture, out: Path, settings: Settings, options: RunOptions) -> CaptureResult | None:
    """The result of an earlier run; None where the capture is to be done (again)."""
    earlier = None if options.overwrite else finished_before(capture, out, settings)
    return None if earlier is None or (options.retry_failed and earlier.status != "ok") else earlier


def _sky(captures: Sequence[Capture], options: RunOptions) -> tuple[list[SkyCapture], list[Capture]]:
    """(the captures of the sky, the other captures)."""
    return ([], list(captures)) if options.align_panels else sky_captures(captures)


def _panels(
    captures: Sequence[Capture], settings: WriteSettings, options: RunOptions
) -> tuple[list[PanelReading], list[Capture]]:
    """(the readings of calibration panels, the captures to align: a scene that contains a panel is one of them)."""
    if options.align_panels:
        return [], list(captures)
    albedos = dict(settings.panel_albedo)
    seen = with_panels(captures, without_code=bool(albedos))
    panels = [read_panel(c, albedos) for c in seen if c.panel is not None]
    return panels, [c for c in seen if not c.is_of_a_panel]


def _cores(options: RunOptions, settings: Settings) -> int:
    """How many captures are worked on at a time where that costs nothing: one where a GPU does the work."""
    on_cpu = choose_device(settings.joint.device).type == "cpu"
    return options.jobs or (usable_cores() if on_cpu else 1)


def _given_model(path: Path, flight: FolderScan, settings: Settings) -> FlightModel:
    """The model to start from. Raises ConfigurationError where it is of no use here."""
    if not settings.learns_flights:
        raise ConfigurationError("a model is of use only where one network is learnt for a flight, by recipe fast")
    model = load_model(path, lambda: choose_device(settings.joint.device))
    if model.net.sharing == "unshared" and settings.joint.sharing != "unshared":
        raise ConfigurationError(f"{path}: was learnt unshared; add --sharing unshared")
    flights = flights_of(flight.captures)
    if flights and not any(is_flight_of(captures, model.camera) for captures in flights):
        here = flight_camera(flights[0])
        raise ConfigurationError(f"{path}: was learnt for {model.camera}; the images here are of {here}")
    return model


def _learn(
    captures: Sequence[Capture], path: Path, settings: Settings, listener: Listener, known: FlightModel | None,
    at_once: int,
) -> Path | None:  # fmt: skip
    """The path of the flight's model, learnt now or found from an earlier run; None where none could be learnt."""
    if not settings.learns_flights:
        return None
    start = known if known is not None and is_flight_of(captures, known.camera) else None
    device = settings.joint.device
    if path.is_file():
        with suppress(AgalignError):
            if loaded_model(path, device, stamp(path)).fingerprint == learning_fingerprint(captures, settings):
                return path

    def progress(_stage: str, share: float) -> None:
        listener.on_learning(path.stem, share)

    began = time.monotonic()
    model = learn_flight(captures, settings, progress, start, at_once)
    listener.on_learnt(path.stem, time.monotonic() - began)
    if model is None:
        return None
    save_model(model, path)
    return path


def _refuse_to_overwrite(flight: FolderScan, out: Path, settings: WriteSettings) -> None:
    """Neither an input nor what another capture writes. Raises ConfigurationError."""
    if out.resolve() == flight.folder.resolve():
        raise ConfigurationError(f"{out}: is the folder of the images; choose another output folder with -o")
    sources = {band.path.resolve() for capture in flight.captures for band in capture.bands}
    there: dict[Path, Path] = {}
    written: dict[str, Capture] = {}
    for capture in flight.captures:
        for path in paths_written(capture, out, settings):
            if path.parent not in there:
                there[path.parent] = path.parent.resolve()
            if there[path.parent] / path.name in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder with -o")
            other = written.setdefault(str(path).lower(), capture)
            if other is not capture:
                raise ConfigurationError(
                    f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
                )


def finished_before(capture: Capture, out: Path, settings: Settings) -> CaptureResult | None:
    """Result of an earlier run with the same settings and bands, if its outputs still exist."""
    path = CapturePaths.of(capture, out).sidecar
    try:
        sidecar = read_result(path)
    except SidecarError:
        return None
    if sidecar.settings != fingerprint(capture, settings):
        return None
    return sidecar if not sidecar.not_written and _outputs_are_there(sidecar, path.parent) else None


def _outputs_are_there(sidecar: CaptureResult, folder: Path) -> bool:
    """True where every file that the sidecar lists is there, with its size: checksums would take minutes."""
    try:
        states = [((folder / name).stat(), size) for name, size in sidecar.files.items()]
    except OSError:
        return False
    return all(stat.S_ISREG(state.st_mode) and state.st_size == size for state, size in states)
