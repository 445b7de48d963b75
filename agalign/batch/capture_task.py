"""Align one capture and write its products and its sidecar, also as the task of a worker; the report of it."""

import logging
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Literal

from agalign.batch.workers import failure_text
from agalign.capture.align_bands import PairProgress, align_capture_bands
from agalign.config import Settings, WriteSettings
from agalign.errors import AgalignError, ConfigurationError, InputError, OutputError, SidecarError, UnreadableFileError
from agalign.flight.model import FlightModel, load_model
from agalign.method.device import choose_device, keep_freed_memory, one_memory_error, one_thread
from agalign.pixels.radiometry import check_pixels
from agalign.pixels.raster import with_saturation_values
from agalign.products.indices.rasters import outdated_rasters
from agalign.products.product import CapturePaths, ProductContext
from agalign.products.rasters.aligned_files import band_file_names, is_aligned_raster
from agalign.products.rasters.layout import FlightLimits, output_layers
from agalign.products.registry import PRODUCTS
from agalign.products.report.preview import preview_bytes
from agalign.products.sidecar.convert import sidecar_of
from agalign.products.sidecar.file import read_result, read_sidecar, write_sidecar
from agalign.products.sidecar.schema import CaptureResult, Sidecar
from agalign.values.capture import Capture
from agalign.values.choices import RadiometryChoice
from agalign.values.files import check_inside
from agalign.values.image import OutputGrid
from agalign.values.process_pool import A, R
from agalign.values.text import counted


def quiet(*_: object) -> None:
    """A progress callback that reports nothing."""


@dataclass(frozen=True)
class CaptureReport:
    """State and result of one capture."""

    label: str
    """Folder and number of the capture, as 0000SET/000/IMG_0001."""
    state: Literal["done", "kept", "error", "panel", "sky"]
    """`kept`: an earlier run with the same settings has finished the capture. `panel` and `sky`: the capture shows a
    calibration panel or the sky, and is not aligned.
    """
    result: CaptureResult | None = field(default=None, repr=False)
    """Content of the sidecar, without the long tables."""
    path: Path | None = None
    """Path of the sidecar."""
    error: str | None = None
    """Why the capture has no result, one line."""
    panel: str | None = None
    """Description of the calibration panel."""
    sky: str | None = None
    """Why the capture counts as sky."""
    failed_products: tuple[str, ...] = ()
    """Products that could not be written, and why."""
    seconds: float = 0.0
    """Processing time in this run."""
    stages: Mapping[tuple[str, str], float] = field(default_factory=dict, repr=False)
    """Processing time by (band, stage), s."""

    @property
    def sidecar(self) -> Sidecar | None:
        """The complete sidecar, read from its file; None if there is none. Raises SidecarError."""
        return None if self.path is None else read_sidecar(self.path)

    @property
    def is_complete(self) -> bool:
        """True if every band pair is aligned or predicted accurately enough, none is missing, and all products are
        written; also for panels and the sky.
        """
        done = self.result is not None and self.result.status == "ok" and not self.failed_products
        return self.state in ("panel", "sky") or done

    @property
    def problems(self) -> tuple[str, ...]:
        """Errors, except bands that are not aligned; those are in the sidecar."""
        return self.failed_products if self.error is None else (self.error, *self.failed_products)

    @property
    def summary(self) -> str:
        """The state, with the number of bands by status, or the error."""
        if self.result is None:
            return f"{self.state}: {self.error or self.panel or self.sky}"
        statuses = Counter(status for _, status, _ in self.result.pairs)
        return f"{self.state}, " + ", ".join(f"{number} {status}" for status, number in statuses.items())

    def _repr_html_(self) -> str:
        """A short table for notebooks."""
        if self.result is None:
            return f"<p><b>{escape(self.label)}</b>: {escape(self.summary)}</p>"
        residuals_px = [None if b.metrics is None else b.metrics.after.residual_px for b in self.result.bands]
        rows = "".join(
            f"<tr><td>{escape(b.band)}</td><td>{b.status}</td><td>{'' if px is None else f'{px:.3f}'}</td>"
            f"<td>{escape(b.reason or '')}</td></tr>"
            for b, px in zip(self.result.bands, residuals_px, strict=True)
        )
        head = "<tr><th>band</th><th>status</th><th>residual, px</th><th>reason</th></tr>"
        return f"<p><b>{escape(self.label)}</b>: {self.result.status}</p><table>{head}{rows}</table>"


class FlightReports(list[CaptureReport]):
    """The reports of a run, which a notebook shows as a table."""

    def _repr_html_(self) -> str:
        max_rows = 20
        counts = Counter(report.state for report in self)
        total = ", ".join(f"{number} {state}" for state, number in counts.items())
        head = "<tr><th>capture</th><th>state</th><th>bands</th></tr>"
        rows = "".join(
            f"<tr><td>{escape(report.label)}</td><td>{report.state}</td><td>{escape(report.summary)}</td></tr>"
            for report in self[:max_rows]
        )
        more = f"<p>and {len(self) - max_rows} more</p>" if len(self) > max_rows else ""
        return f"<p>{counted(len(self), 'capture')}: {total}</p><table>{head}{rows}</table>{more}"


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
    max_preview_bytes: int = preview_bytes(1)
    """About the largest size of the preview."""
    limits: FlightLimits = ()
    """Limits of the flights of the camera."""
    common: OutputGrid | None = None
    """Grid of the captures of the camera, if they share one."""

    def absolute(self) -> "Task":
        """Return the task with absolute paths: workers may have another working folder."""
        model = None if self.model is None else self.model.absolute()
        return replace(self, capture=self.capture.with_absolute_paths(), out=self.out.absolute(), model=model)


def process_capture(task: Task, progress: PairProgress = quiet) -> CaptureReport:
    """Align a capture, write its products and its sidecar, and return its report, without times of stages.

    The other bands are aligned where one cannot be. With the model of the flight, a network is learned from scratch
    only for bands that the model cannot align.
    Raises UnreadableFileError if the reference cannot be read, InputError or ConfigurationError if the capture or the
    installation lacks what a product needs, and OutputError.
    """
    began_s, settings, out = time.perf_counter(), task.settings, task.out
    capture = with_saturation_values(task.capture)
    paths = CapturePaths.of(capture, out)
    refuse_to_overwrite([capture], out, settings.write)
    if missing := missing_radiometry(capture, settings.write.radiometry):
        raise InputError(f"{capture.reference.path}: {missing}")
    for band in capture.bands if settings.write.radiometry != "off" else ():
        with suppress(UnreadableFileError):  # the band pair fails with this reason
            check_pixels(band)
    for product in PRODUCTS:
        if product.is_enabled(settings.write):
            product.check(capture)
    model = None if task.model is None else loaded_model(task.model, settings.joint.device)
    alignments = align_capture_bands(capture, settings, model, progress)
    progress(capture.reference.name, "writing", 0.0)
    whole = OutputGrid(0, 0, *capture.reference.size_px)
    context = ProductContext(capture, paths, settings, alignments, (), whole, task.max_preview_bytes, task.limits)
    if context.with_pixels:
        layers, grid = output_layers(capture, context.with_pixels, settings.write, task.common)
        context = replace(context, layers=layers, grid=grid)
    discard_outputs(capture, out, settings.write)
    failures = _write_products(context)
    sidecar = write_sidecar(paths.sidecar, sidecar_of(context, list(failures), time.perf_counter() - began_s))
    # Products that need the same file fail with the same message.
    lost = (*dict.fromkeys(failures.values()), *lost_reflectance(capture, settings.write.radiometry))
    result = sidecar.result()
    return CaptureReport(capture.label, "done", result, paths.sidecar, failed_products=lost, seconds=sidecar.seconds)


def _write_products(context: ProductContext) -> dict[str, str]:
    """Write the enabled products; return {kind: message} of optional ones that failed. Raises like `Product.write`."""
    failures: dict[str, str] = {}
    for product in PRODUCTS:
        if not product.is_enabled(context.settings.write) or (product.needs_layers and not context.layers):
            continue
        try:
            for file in product.write(context):
                # At once: the sidecar also lists the files before an error, so that they are removed later.
                context.written.append(file)
        except AgalignError as error:
            if product.is_required:
                raise
            failures[product.kind] = str(error)
    return failures


def paths_written(capture: Capture, out: Path, settings: WriteSettings) -> list[Path]:
    """Return the paths of all files that a run with these settings may write or remove for a capture."""
    paths = CapturePaths.of(capture, out)
    return [paths.sidecar, *(p for product in PRODUCTS for p in product.paths(capture, paths, settings))]


def refuse_to_overwrite(captures: Sequence[Capture], out: Path, settings: WriteSettings) -> None:
    """Raise ConfigurationError if an output would replace an input image or an output of another capture."""
    sources = {band.path.resolve() for capture in captures for band in capture.bands}
    resolved: dict[Path, Path] = {}
    written: dict[str, Capture] = {}
    for capture in captures:
        for path in paths_written(capture, out, settings):
            if path.parent not in resolved:
                resolved[path.parent] = check_inside(path.parent, out).resolve()
            if resolved[path.parent] / path.name in sources:
                raise ConfigurationError(f"{path}: is an image to be aligned; choose another output folder")
            other = written.setdefault(str(path).lower(), capture)
            if other is not capture:
                raise ConfigurationError(
                    f"{path}: would be written of {other.label} and of {capture.label}; rename one's files"
                )


def discard_outputs(capture: Capture, out: Path, settings: WriteSettings) -> None:
    """Remove the outputs of an earlier run for a capture, and the indices calculated from them.

    Otherwise a sidecar could describe rasters of another run, and bands on an old grid could remain among new ones.
    Anyone may have written the sidecar: of its other files, only aligned rasters named as bands of this capture are
    removed. Files that cannot be removed are overwritten later, or their writer reports the error.
    """
    paths, sources = CapturePaths.of(capture, out), {band.path.resolve() for band in capture.bands}
    old = paths_written(capture, out, settings)
    with suppress(SidecarError):
        listed = [paths.folder / name for name in read_result(paths.sidecar).files]
        # Also of a band that this run leaves out; a file with a sidecar is the stack of another capture.
        pattern = re.compile(rf"{re.escape(capture.name)}(\d|[._].+)\.tiff?", re.IGNORECASE)
        own = [p for p in listed if pattern.fullmatch(p.name) and not p.with_suffix(".json").exists()]
        own += [paths.folder / name for name in band_file_names(capture).values()]
        old += [p for p in own if p in listed and is_aligned_raster(p)]
        old += outdated_rasters(paths.file(""))
    for path in old:
        with suppress(OSError, OutputError):
            check_inside(path.parent, out)
            if path.resolve() not in sources:
                path.unlink(missing_ok=True)


def missing_radiometry(capture: Capture, choice: RadiometryChoice) -> str:
    """Return what the bands of a capture lack for the radiometry of a run, and the remedy; empty if nothing."""
    lacking = [b for b in capture.bands if b.radiometry is None and not b.companion]
    if choice == "off" or not lacking:
        return ""
    if uncalibrated := [b for b in lacking if b.uncalibrated]:  # no choice works without a calibration
        return f"{uncalibrated[0].uncalibrated} in {', '.join(b.name for b in uncalibrated)}; leave --radiometry out"
    bands = ", ".join(b.name for b in lacking) + next((f" ({b.implausible})" for b in lacking if b.implausible), "")
    missing = {
        "sun": f"no usable tags of a light sensor in {bands}; choose --radiometry camera or panel",
        "panel": f"no usable calibration panel of known reflectance was recorded within hours for {bands}; give "
        "--panel-albedo for a panel without QR code, or choose --radiometry sun or camera",
    }
    return missing.get(choice, f"no tags for radiance in {bands}; leave --radiometry out")


def lost_reflectance(capture: Capture, choice: RadiometryChoice) -> tuple[str, ...]:
    """Return the implausible tag that makes `auto` write radiance instead of reflectance; empty if there is none."""
    lost = (b for b in capture.bands if b.implausible and b.radiometry is not None and b.radiometry.is_of_light)
    return tuple(f"not written as reflectance: {b.name}: {b.implausible}" for b in lost if choice == "auto")[:1]


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
