"""OUT/agalign-run.json: command, settings, versions, machine and results of a run; the first file that a run writes."""

import platform
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from agalign._version import __version__
from agalign.config import Settings
from agalign.flight.overview import camera_overviews
from agalign.products.json_file import read_model, write_model
from agalign.products.sidecar import CaptureResult
from agalign.values.capture import Capture
from agalign.values.cores import usable_cores
from agalign.values.files import RUN_FILE
from agalign.values.text import harmless

_LIBRARIES = ("torch", "numpy", "rasterio", "opencv-python-headless", "tifffile", "pydantic")

RunState = Literal["running", "interrupted", "finished"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class RefusalPart(_Part):
    """A band that is not aligned, and why."""

    capture: str
    band: str
    status: str
    reason: str | None


class ProblemPart(_Part):
    """A file that was left out or a capture that failed, and the reason."""

    of: str
    problem: str


class CameraOverviewPart(_Part):
    """Summary of the captures of one camera, as `agalign info` prints it."""

    camera: str
    serial: str
    captures: int
    bands: list[str]
    size_px: tuple[int, int]
    first_at: str
    last_at: str
    height_m: float | None
    altitude_m: tuple[float, float] | None
    gsd_m: float | None
    gsd_per_height: float | None = None
    radiometry: list[str]


class RunPart(_Part):
    """Record of one run. A run that was killed leaves the state `running`."""

    schema_: Annotated[Literal["agalign-run/1"], Field(alias="schema")] = "agalign-run/1"
    agalign: str = __version__
    state: RunState
    started_at: str
    """ISO 8601, UTC."""
    seconds: float
    input: str
    command: str = ""
    """The command line; empty for a run from Python."""
    cameras: list[CameraOverviewPart] = []
    versions: dict[str, str]
    machine: dict[str, str | int]
    settings: dict[str, Any]
    captures: dict[str, int]
    """Number of captures found, done, kept, panel, sky, and error."""
    pairs: dict[str, int]
    """Number of band pairs by status."""
    stage_seconds: dict[str, float]
    """Processing time by stage, summed over workers; includes learning the flight."""
    capture_seconds: dict[str, float]
    """Processing time by capture."""
    refused: list[RefusalPart]
    problems: list[ProblemPart]


def problem_of(what: str, text: str) -> ProblemPart:
    """Return a problem of a file or capture; characters that are not printable are escaped."""
    return ProblemPart(of=harmless(what), problem=harmless(text))


@dataclass
class Tally:
    """Results of a run so far."""

    captures: Counter[str] = field(default_factory=Counter)
    pairs: Counter[str] = field(default_factory=Counter)
    stage_seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    capture_seconds: dict[str, float] = field(default_factory=dict)
    refused: list[RefusalPart] = field(default_factory=list)
    problems: list[ProblemPart] = field(default_factory=list)

    def add(self, label: str, state: str, result: CaptureResult | None, problems: Iterable[str]) -> None:
        """Add the result of a capture."""
        self.captures[state] += 1
        self.problems += [problem_of(label, text) for text in problems]
        for band in [] if result is None else result.bands:
            if band.status == "reference":
                continue
            self.pairs[band.status] += 1
            if band.status != "aligned":
                refusal = RefusalPart(capture=label, band=band.band, status=band.status, reason=band.reason)
                self.refused.append(refusal)


def begun(folder: Path, settings: Settings, captures: Sequence[Capture] = (), command: str = "") -> RunPart:
    """Return the record of a run that starts now."""
    cameras = [CameraOverviewPart.model_validate(asdict(o)) for o in camera_overviews(captures)]
    return RunPart(
        state="running", started_at=datetime.now(UTC).isoformat(timespec="seconds"), seconds=0.0,
        input=harmless(str(folder)), command=harmless(command), cameras=cameras, versions=_versions(),
        machine=_machine(settings),
        settings=settings.model_dump(mode="json"), captures={}, pairs={}, stage_seconds={}, capture_seconds={},
        refused=[], problems=[],
    )  # fmt: skip


def write_run_record(out: Path, run: RunPart, tally: Tally, state: RunState, seconds: float) -> None:
    """Write OUT/agalign-run.json with the results so far. Raises OutputError."""
    facts = {
        "state": state, "seconds": round(seconds, 2), "captures": dict(tally.captures), "pairs": dict(tally.pairs),
        "refused": tally.refused, "problems": tally.problems,
        "stage_seconds": {k: round(v, 3) for k, v in sorted(tally.stage_seconds.items())},
        "capture_seconds": {k: round(v, 3) for k, v in sorted(tally.capture_seconds.items())},
    }  # fmt: skip
    write_model(out / RUN_FILE, run.model_copy(update=facts))


def read_run_record(out: Path) -> RunPart | None:
    """Return the record of the last run into a folder, if any. Raises SidecarError for a file of another format."""
    return read_model(out / RUN_FILE, RunPart)


def _versions() -> dict[str, str]:
    result = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            result[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            result[name] = "unknown"
    return result


def _machine(settings: Settings) -> dict[str, str | int]:
    return {
        "system": platform.system(), "release": platform.release(), "processor": platform.machine(),
        "cores": usable_cores(), "device": settings.joint.device,
    }  # fmt: skip
