"""Estimate and render one capture, also as the task of a worker."""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from agalign.batch.capture_report import CaptureReport
from agalign.batch.output_files import earlier_result, is_removed, refuse_to_overwrite, remove_files
from agalign.batch.products import PRODUCTS
from agalign.batch.render import render
from agalign.batch.workers import failure_text
from agalign.cameras.metadata import exposed_after_s
from agalign.capture.align_bands import PairProgress, align_capture_bands
from agalign.config import Settings, WriteSettings
from agalign.errors import InputError, UnreadableFileError
from agalign.flight.fingerprint import input_digests, input_samples, input_states, joined_options
from agalign.flight.model import FlightModel, load_model
from agalign.host.files import written_below
from agalign.host.process_pool import A, R
from agalign.method.device import choose_device, keep_freed_memory, one_memory_error, one_thread
from agalign.pixels.capture_pixels import CapturePixels
from agalign.pixels.radiometry import with_checked_pixels
from agalign.pixels.raster import ReadTile, with_facts_of_pixels
from agalign.rasters.parallax_file import PARALLAX_KIND, PARALLAX_SUFFIX, write_parallax
from agalign.rasters.product import CapturePaths, RenderOptions
from agalign.rasters.read_alignment import alignments_of
from agalign.records.sidecar import Sidecar
from agalign.records.sidecar_file import file_part, read_with_change, write_sidecar
from agalign.values.alignment import Alignment, relief_of
from agalign.values.capture import Band, Capture
from agalign.values.choices import RadiometryChoice


def quiet(*_: object) -> None:
    """A progress callback that reports nothing."""


class StageClock:
    """Progress callback that forwards its calls and adds up the time of each stage."""

    def __init__(self, progress: PairProgress) -> None:
        self._progress = progress
        self._starts: list[tuple[float, tuple[str, str] | None]] = [(time.perf_counter(), None)]
        """Start time of each (band, stage); before the first, None."""

    def __call__(self, band: str, stage: str, share: float) -> None:
        """Report progress as `PairProgress`; a new band or stage ends the previous one."""
        if (band, stage) != self._starts[-1][1]:
            self._starts.append((time.perf_counter(), (band, stage)))
        self._progress(band, stage, share)

    @property
    def seconds(self) -> float:
        """Seconds since this timer was created."""
        return time.perf_counter() - self._starts[0][0]

    def stages(self) -> Mapping[tuple[str, str], float]:
        """Seconds by (band, stage), including the current stage."""
        seconds: defaultdict[tuple[str, str], float] = defaultdict(float)
        for (since, stage), (until, _) in pairwise([*self._starts, (time.perf_counter(), None)]):
            if stage is not None:
                seconds[stage] += until - since
        return dict(seconds)


@dataclass(frozen=True)
class Task:
    """One capture to process, as sent to a worker."""

    capture: Capture
    """Its bands already have the chosen radiometry (`with_radiometry`)."""
    out: Path
    settings: Settings
    model: Path | None = None
    """File of the model of the flight."""
    rendering: RenderOptions = field(default_factory=RenderOptions)
    is_estimated: bool = False
    """An earlier command has estimated it with the same settings: it is only rendered."""

    def absolute(self) -> "Task":
        """Return the task with absolute paths: workers may have another working folder."""
        model = None if self.model is None else self.model.absolute()
        return replace(self, capture=self.capture.with_absolute_paths(), out=self.out.absolute(), model=model)


def process_capture(task: Task, progress: PairProgress = quiet) -> CaptureReport:
    """Estimate a capture, unless that is done, and render it; return its report, without times of stages.

    The other bands are aligned where one cannot be. With the model of the flight, a network is learned from scratch
    only for bands that the model cannot align.
    Raises UnreadableFileError if the reference cannot be read, InputError or ConfigurationError if the capture or the
    installation lacks what a product needs, and OutputError.
    """
    began_s, settings, out, states = time.perf_counter(), task.settings, task.out, input_states(task.capture)
    read, path, once = CapturePixels().read, CapturePaths.of(task.capture, out).sidecar, cache(read_with_change)
    refuse_to_overwrite([task.capture], out, settings.write, once)
    earlier, is_intact = earlier_result(path, once)
    capture = with_facts_of_pixels(task.capture, read)
    if missing := missing_lens(capture, settings.write) or missing_radiometry(capture, settings.write.radiometry):
        raise InputError(f"{capture.reference.path}: {missing}")
    if settings.write.radiometry != "off":
        capture = replace(capture, bands=tuple(_checked(band, read) for band in capture.bands))
    for product in PRODUCTS:
        if product.is_enabled(settings.write):
            product.check(capture)
    if earlier is not None and is_intact and task.is_estimated:
        sidecar, alignments = earlier, alignments_of(earlier, path.parent)
    else:
        model = None if task.model is None else loaded_model(task.model, settings.joint.device)
        sidecar, alignments = estimate(capture, out, settings, model, progress, earlier, read, states)
    progress(capture.reference.name, "writing", 0.0)
    report = render(capture, out, settings, sidecar, alignments, task.rendering, read)
    return replace(report, seconds=time.perf_counter() - began_s)


def estimate(
    capture: Capture,
    out: Path,
    settings: Settings,
    model: FlightModel | None,
    progress: PairProgress,
    earlier: Sidecar | None,
    read: ReadTile,
    states: Mapping[str, str],
) -> tuple[Sidecar, dict[str, Alignment]]:
    """Align the bands of a capture; write its sidecar, and its parallax if it has a relief.

    Returns the sidecar and the alignments as a reader of the file has them: a later command renders the same bytes.

    The sidecar lists the products of the `earlier` one, which describe another estimate, until they are rendered again.
    A parallax file without the mark of the program is kept.
    `read` reads the pixels of the files, whose `states` were taken before. Raises UnreadableFileError if the reference
    cannot be read, or if a file was changed meanwhile, and OutputError.
    """
    began_s, paths = time.perf_counter(), CapturePaths.of(capture, out)
    alignments = align_capture_bands(capture, settings, model, progress, read)
    facts_of_input = {"input_samples": input_samples(capture), "input_digests": input_digests(capture)}
    states_now = input_states(capture)
    if changed := [b for b in capture.bands if states.get(b.name) != states_now.get(b.name)]:
        raise UnreadableFileError(f"{changed[0].path}: was changed while it was read", "run again")
    progress(capture.reference.name, "writing", 0.0)
    relief, path, parallax = relief_of(alignments), paths.file(PARALLAX_SUFFIX), None
    if relief is not None:
        write_parallax(path, relief, capture.reference.georeference)
        parallax = file_part(PARALLAX_KIND, path, paths.folder)
    delayed = [b for b in capture.moving if alignments[b.name].status != "aligned"]
    delays_s = {b.name: s for b in delayed if (s := exposed_after_s(b, capture.reference)) is not None}
    result = Sidecar.estimated(capture, alignments, settings, delays_s)
    facts: dict[str, Any] = {
        "parallax": parallax,
        "model": "" if model is None else model.fingerprint,
        **facts_of_input,
        "input_states": dict(states),
        "seconds": time.perf_counter() - began_s,
    }
    if earlier is not None:
        facts |= {"products": earlier.products, "options": joined_options(result.options, earlier.options)}
    written = write_sidecar(paths.sidecar, result.model_copy(update=facts))
    if relief is None and is_removed(path, {}):
        remove_files([path], out)
    # Their mappings have the decimals of the file, and hold the positions of all pixels.
    return written, written.alignments({name: alignment.mapping for name, alignment in alignments.items()})


def _checked(band: Band, read: ReadTile) -> Band:
    """Return a band as `with_checked_pixels`; one that cannot be read is unchanged, and its pair fails with the reason.

    Raises InputError.
    """
    with suppress(UnreadableFileError):
        return with_checked_pixels(band, read)
    return band


def missing_lens(capture: Capture, settings: WriteSettings) -> str:
    """Return that the lens of the reference is not known, if its grid is to be lens-corrected; empty otherwise."""
    is_lacking = settings.undistort and capture.reference.lens is None
    return "the lens is not known: its tags lack a lens model that is used; leave --undistort out" if is_lacking else ""


def missing_radiometry(capture: Capture, choice: RadiometryChoice) -> str:
    """Return what the bands of a capture lack for the radiometry of a run, and the remedy; empty if nothing."""
    lacking = [b for b in capture.bands if b.radiometry is None and not b.is_from_photograph]
    if choice == "off" or not lacking:
        return ""
    if without := [b for b in lacking if b.missing_calibration]:  # no choice works without a calibration
        return f"{without[0].missing_calibration} in {', '.join(b.name for b in without)}; leave --radiometry out"
    bands = ", ".join(b.name for b in lacking) + next((f" ({b.implausible})" for b in lacking if b.implausible), "")
    missing = {
        "sun": f"no usable tags of a light sensor in {bands}; choose --radiometry camera or panel",
        "panel": f"no calibration panel for {bands}: {capture.without_panel or 'none was measured'}; or choose "
        "--radiometry sun or camera",
    }
    return missing.get(choice, f"no tags for radiance in {bands}; leave --radiometry out")


@one_thread()
@one_memory_error()
def in_one_thread(function: Callable[[A], R], argument: A) -> R:
    """Call a function that uses one thread; memory errors of libraries are MemoryError."""
    keep_freed_memory()
    return function(argument)


def do_capture(task: Task, on_pair: PairProgress = quiet) -> CaptureReport:
    """Process one capture and return its report, which includes errors."""
    label, clock = task.capture.label, StageClock(on_pair)
    try:
        with written_below(task.out):
            report = in_one_thread(partial(process_capture, progress=clock), task)
    except Exception as error:
        # A defect of agalign in one capture must not stop the others.
        report = CaptureReport(label, "error", error=failure_text(error), seconds=clock.seconds)
        logging.getLogger(__name__).debug("%s: %s", label, report.error, exc_info=True)
    return replace(report, stages=clock.stages())


def loaded_model(path: Path, device: str) -> FlightModel:
    """Return the model in a file, which each worker reads again if it has been changed. Raises InputError."""
    changed_ns = 0
    with suppress(OSError):
        changed_ns = path.stat().st_mtime_ns
    return _loaded_model(path, device, changed_ns)


@lru_cache(maxsize=8)
def _loaded_model(path: Path, device: str, _changed_ns: int) -> FlightModel:
    return load_model(path, lambda: choose_device(device))
