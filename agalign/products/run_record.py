"""OUT/agalign-run.json: what a run was, with what, on what, and what came of it; written before anything else is."""

import platform
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agalign._version import __version__
from agalign.config import Settings
from agalign.errors import SidecarError
from agalign.flight.overview import camera_overviews
from agalign.products.sidecar import CaptureResult, compact_lists
from agalign.values.capture import Capture
from agalign.values.cores import usable_cores
from agalign.values.files import RUN_FILE, write_text
from agalign.values.text import harmless

_LIBRARIES = ("torch", "numpy", "rasterio", "opencv-python-headless", "tifffile", "pydantic")
_MAX_BYTES = 1 << 28
"""A record of 100,000 captures has a tenth of this."""

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
    """A file that took no part, or a capture that came to nothing, and why."""

    of: str
    problem: str


class CameraOverviewPart(_Part):
    """The captures of one camera, as `agalign info` begins with them."""

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
    """One run. `running` is also what a run that was killed has left."""

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
    """How many were found, and how many are done, kept, panel, sky, error."""
    pairs: dict[str, int]
    """How many band pairs have which status."""
    stage_seconds: dict[str, float]
    """What the captures that were done cost, added over workers, and the learning before them."""
    capture_seconds: dict[str, float]
    """The same by capture."""
    refused: list[RefusalPart]
    problems: list[ProblemPart]


def problem_of(what: str, text: str) -> ProblemPart:
    """Names of files may contain characters that are not printable; those are escaped."""
    return ProblemPart(of=harmless(what), problem=harmless(text))


@dataclass
class Tally:
    """What a run has come to so far."""

    captures: Counter[str] = field(default_factory=Counter)
    pairs: Counter[str] = field(default_factory=Counter)
    stage_seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    capture_seconds: dict[str, float] = field(default_factory=dict)
    refused: list[RefusalPart] = field(default_factory=list)
    problems: list[ProblemPart] = field(default_factory=list)

    def add(self, label: str, state: str, result: CaptureResult | None, problems: Iterable[str]) -> None:
        """One capture more."""
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
    """A run that has just begun."""
    cameras = [CameraOverviewPart.model_validate(asdict(o)) for o in camera_overviews(captures)]
    return RunPart(
        state="running", started_at=datetime.now(UTC).isoformat(timespec="seconds"), seconds=0.0,
        input=harmless(str(folder)), command=harmless(command), cameras=cameras, versions=_versions(),
        machine=_machine(settings),
        settings=settings.model_dump(mode="json"), captures={}, pairs={}, stage_seconds={}, capture_seconds={},
        refused=[], problems=[],
    )  # fmt: skip


def write_run_record(out: Path, run: RunPart, tally: Tally, state: RunState, seconds: float) -> None:
    """OUT/agalign-run.json of a run that has come so far. Raises OutputError."""
    facts = {
        "state": state, "seconds": round(seconds, 2), "captures": dict(tally.captures), "pairs": dict(tally.pairs),
        "refused": tally.refused, "problems": tally.problems,
        "stage_seconds": {k: round(v, 3) for k, v in sorted(tally.stage_seconds.items())},
        "capture_seconds": {k: round(v, 3) for k, v in sorted(tally.capture_seconds.items())},
    }  # fmt: skip
    part = run.model_copy(update=facts)
    write_text(out / RUN_FILE, compact_lists(part.model_dump_json(by_alias=True, indent=1)) + "\n")


def read_run_record(out: Path) -> RunPart | None:
    """Of the last run into a folder; None where there is none. Raises SidecarError for a file that is none of ours."""
    path = out / RUN_FILE
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SidecarError(f"{path}: is too large for what it should be; run again")
        return RunPart.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError):
        raise SidecarError(f"{path}: cannot be read; run again") from None


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
