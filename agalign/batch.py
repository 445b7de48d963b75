"""Many captures: which are still to be done, each one done, one summary."""

import csv
import io
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from agalign.cameras import known_cameras
from agalign.config import Settings
from agalign.describe import fingerprint
from agalign.discover import Flight
from agalign.errors import AgalignError, ConfigurationError, OutputError, SidecarError
from agalign.geometry import Matrix
from agalign.pipeline import PairProgress, output_paths, process_capture, quiet
from agalign.records import Band, Capture
from agalign.sidecar import BandPart, Sidecar, find_sidecars, read_sidecar, write_text

SUMMARY_COLUMNS = (
    "folder", "capture", "band", "wavelength_nm", "status", "reason", "seed", "retrieval", "corner_std_px",
    "residual_px", "residual_p95_px", "residual_coverage", "mattes_mi_before", "mattes_mi_after", "nmi_before",
    "nmi_after", "ncc_before", "ncc_after", "gradient_correlation_before", "gradient_correlation_after",
    "structure_ssim_before", "structure_ssim_after", "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class CaptureReport:
    """What became of one capture."""

    label: str
    state: Literal["done", "kept", "error"]
    """`kept` means that an earlier run's result with the same settings was there."""
    sidecar: Sidecar | None
    error: str | None = None

    @property
    def good(self) -> bool:
        """True where every band pair of the capture is aligned and none is missing."""
        return self.sidecar is not None and self.sidecar.status == "ok"

    @property
    def useful(self) -> bool:
        """True where at least one band pair is aligned."""
        return self.sidecar is not None and any(b.status == "aligned" for b in self.sidecar.bands)


def rig_seed(reference: Band, moving: Band) -> Matrix | None:
    """The first camera's answer that has one: bands carry their rig's data themselves."""
    for camera in known_cameras():
        found = camera.rig_seed(reference, moving)
        if found is not None:
            return found
    return None


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


def run_flight(
    flight: Flight,
    out: Path,
    settings: Settings,
    *,
    overwrite: bool = False,
    on_pair: PairProgress = quiet,
    on_start: Callable[[Capture], None] = quiet,
) -> Iterator[CaptureReport]:
    """Align the captures one after another, yielding each as it is done; those done before are kept.

    One capture's failure never stops the others. Raises OutputError where the output folder cannot be used.
    """
    prepare_output(out)
    _refuse_to_overwrite_inputs(flight, out)
    for capture in flight.captures:
        on_start(capture)
        earlier = None if overwrite else finished_before(capture, out, settings)
        if earlier is not None:
            yield CaptureReport(capture.label, "kept", earlier)
            continue
        try:
            outcome = process_capture(capture, out, rig_seed, settings, on_pair)
        except AgalignError as error:
            yield CaptureReport(capture.label, "error", None, str(error))
            continue
        yield CaptureReport(capture.label, "done", outcome.sidecar)


def _refuse_to_overwrite_inputs(flight: Flight, out: Path) -> None:
    sources = {band.path.resolve() for capture in flight.captures for band in capture.bands}
    for capture in flight.captures:
        stack, _ = output_paths(capture, out)
        if stack.resolve() in sources:
            raise ConfigurationError(f"{stack}: is an image to be aligned; choose another output folder with -o")


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
    size = stack.stat().st_size if stack.is_file() else None
    return sidecar if size == (sidecar.output.bytes if sidecar.output else None) else None


def write_summary(out: Path, on_problem: Callable[[str], None] = quiet) -> Path:
    """OUT/summary.csv from all sidecars below OUT, a row per band pair; unreadable ones are told to `on_problem`.

    Raises OutputError.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, SUMMARY_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for folder, sidecar in sidecars_below(out, on_problem):
        writer.writerows(_row(folder, sidecar, band) for band in sidecar.bands if band.status != "reference")
    path = out / "summary.csv"
    write_text(path, table.getvalue())
    return path


def sidecars_below(out: Path, on_problem: Callable[[str], None] = quiet) -> Iterable[tuple[str, Sidecar]]:
    """(folder relative to OUT, sidecar) of every readable sidecar; `on_problem` is told of the others."""
    for path in find_sidecars(out):
        try:
            yield path.parent.relative_to(out).as_posix(), read_sidecar(path)
        except SidecarError as error:
            on_problem(str(error))


def _row(folder: str, sidecar: Sidecar, band: BandPart) -> dict[str, object]:
    row: dict[str, object] = {
        "folder": folder,
        "capture": sidecar.capture,
        "band": band.band,
        "wavelength_nm": band.wavelength_nm,
        "status": band.status,
        "reason": band.reason,
        "seed": band.seed.kind if band.seed else None,
        "seconds": band.seconds,
    }
    if band.joint is not None:
        row |= {"retrieval": round(band.joint.retrieval, 4), "corner_std_px": round(band.joint.corner_std_px, 4)}
    if band.metrics is not None:
        before, after = band.metrics.before.model_dump(), band.metrics.after.model_dump()
        row |= {k: _short(after[k]) for k in ("residual_px", "residual_p95_px", "residual_coverage")}
        for name in ("mattes_mi", "nmi", "ncc", "gradient_correlation", "structure_ssim"):
            row |= {f"{name}_before": _short(before[name]), f"{name}_after": _short(after[name])}
    return row


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
