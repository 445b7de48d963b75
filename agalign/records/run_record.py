"""OUT/agalign-run.json: command, settings, versions, machine and results of a run; the first file that a run writes."""

import json
import platform
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from agalign._version import __version__
from agalign.config import Settings
from agalign.errors import SidecarError
from agalign.flight.groups import CameraOverview, camera_overviews
from agalign.host.files import RUN_FILE, read_model, read_regular, write_model
from agalign.host.libraries import library_versions
from agalign.host.processes import usable_cores
from agalign.host.text import counted, escape_controls, shortened, some_of
from agalign.records.panels_and_sky import PanelOrSkyPart
from agalign.records.sidecar import FilePart
from agalign.records.sidecar_file import label_of
from agalign.values.capture import Capture

RUN_START = b'{\n "schema": "agalign-run/'
"""How a run record of any version starts."""
_SCHEMA = "agalign-run/2"
_MAX_NAMED = 10
"""Captures that a sentence names."""
RunState = Literal["running", "interrupted", "finished"]
ProblemKind = Literal["", "skipped", "used", "failed", "kept", "not_written", "impossible"]
"""Of a file: `skipped`, or `used` in spite of the problem. Of a capture: `failed`; `kept` as an earlier run left it,
because input files are lost; an output was `not_written`, or is `impossible`, as no run can write it. Empty in records
of earlier versions.
"""
_IN_WORDS: Mapping[ProblemKind, tuple[str, str]] = {
    "skipped": ("file or capture took no part", "files or captures took no part"),
    "used": ("file was used in spite of a problem", "files were used in spite of a problem"),
    "failed": ("capture could not be processed", "captures could not be processed"),
    "kept": ("capture was kept as it was", "captures were kept as they were"),
    "not_written": ("output was not written", "outputs were not written"),
    "impossible": ("output is impossible", "outputs are impossible"),
    "": ("problem", "problems"),
}
"""What one problem of a kind is called, and several."""


class _Part(BaseModel):
    # A later version may add fields without another schema.
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class RefusalPart(_Part):
    """A band of a capture that is not aligned or missing, and why."""

    capture: str
    band: str
    status: str
    reason: str | None


class ProblemPart(_Part):
    """A problem of a file or of a capture."""

    of: str
    """Path of the file, or label of the capture."""
    problem: str
    kind: ProblemKind = ""


@dataclass(frozen=True)
class Finished:
    """What a run keeps of the report of a capture; the sidecars of a season would not fit into memory."""

    state: str
    pairs: Sequence[tuple[str, str, str | None]] = ()
    """As `Sidecar.pairs`."""
    sidecar: Path | None = None
    files: Sequence[FilePart] = ()
    """Those of the sidecar that exist."""
    seconds: float = 0.0


class NotInInputPart(_Part):
    """A result of an earlier run, of a capture that is not in the input."""

    capture: str
    same_as: str = ""
    """Capture of the input with the same exposure, whose result counts instead; empty if there is none."""


class RunPart(_Part):
    """Record of one run. A run that was killed leaves the state `running`."""

    schema_: Annotated[Literal["agalign-run/2"], Field(alias="schema")] = "agalign-run/2"
    agalign: str = __version__
    state: RunState
    started_at: str
    """ISO 8601, UTC."""
    seconds: float
    input: str
    """The input folder. Sidecars name images relative to it, but those of captures in `other_inputs`."""
    command: str = ""
    """The command line; empty for a run from Python."""
    cameras: list[CameraOverview] = []
    """Summary of the captures of each camera, as `agalign info` prints it."""
    versions: dict[str, str] = {}
    machine: dict[str, str | int] = {}
    settings: dict[str, Any] = {}
    """Those with which the captures were processed; if none could be, those of the run before."""
    labels: list[str] = []
    """Labels of the captures found."""
    captures: Counter[str] = Counter()
    """Number of captures found, done, kept, panel, sky, and error. A capture is counted as error if its files were
    removed before the end of the run."""
    pairs: Counter[str] = Counter()
    """Number of band pairs by status."""
    stage_seconds: defaultdict[str, float] = defaultdict(float)
    """Processing time by stage, summed over workers; includes learning the flight."""
    capture_seconds: dict[str, float] = {}
    """Processing time by capture."""
    refused: list[RefusalPart] = []
    problems: list[ProblemPart] = []
    other_inputs: dict[str, list[str]] = {}
    """Labels of captures that earlier runs found in other input folders, by folder."""
    not_in_input: list[NotInInputPart] = []
    file_states: dict[str, str] = {}
    """States in which runs left the files of each capture, by label (`records.listed_files`)."""

    def count(self, finished: Mapping[str, Finished]) -> None:
        """Count the captures that are finished, given by label, and their band pairs."""
        pairs = [(label, *pair) for label, one in finished.items() for pair in one.pairs]
        self.captures = Counter(found=len(self.labels)) + Counter(one.state for one in finished.values())
        self.pairs = Counter(status for _, _, status, _ in pairs)
        self.capture_seconds = {label: one.seconds for label, one in finished.items() if one.state == "done"}
        self.refused = [
            RefusalPart(capture=label, band=band, status=status, reason=reason)
            for label, band, status, reason in pairs
            if status != "aligned"
        ]

    def add_problem(self, what: str, text: str, kind: ProblemKind) -> None:
        """Add a problem of a file or capture; characters that are not printable are escaped."""
        self.problems.append(ProblemPart(of=escape_controls(what), problem=escape_controls(text), kind=kind))

    @property
    def problems_in_words(self) -> str:
        """The number of problems of each kind, in words."""
        counts = Counter(part.kind for part in self.problems)
        return ", ".join(f"{n} {words[n > 1]}" for kind, words in _IN_WORDS.items() if (n := counts[kind]))

    def notes_on_input(self) -> list[str]:
        """Return a line about the results of captures that the input no longer has, and one about renamed captures."""
        gone = [part.capture for part in self.not_in_input if not part.same_as]
        twice = [f"{part.capture} (now {part.same_as})" for part in self.not_in_input if part.same_as]
        lines = []
        if gone:
            have = f"{counted(len(gone), 'capture')} of earlier runs {'is' if len(gone) == 1 else 'are'}"
            lines.append(f"{have} not in the input of the last run, and still counted: {some_of(gone, _MAX_NAMED)}")
        if twice:
            have = f"{counted(len(twice), 'capture')} of earlier runs {'has' if len(twice) == 1 else 'have'}"
            lines.append(f"{have} another name in the input, and not counted twice: {some_of(twice, _MAX_NAMED)}")
        return [f"{line}; delete the files that are not needed" for line in lines]

    def end(self, out: Path, state: RunState, seconds: float, earlier: "RunPart | None") -> None:
        """Write the record at the end of a run, given that of the run before. Raises OutputError."""
        # Rasters that no capture has were not made with the settings of this run.
        if earlier is not None and not self.captures["done"] + self.captures["kept"]:
            self.settings = earlier.settings
        self.write(out, state, seconds)

    def has_same_results(self, earlier: "RunPart") -> bool:
        """Return True if the pages of an earlier run are true of this one, if the results have not changed."""
        names = "settings", "labels", "problems", "not_in_input"
        return earlier.state == "finished" and all(getattr(self, name) == getattr(earlier, name) for name in names)

    def write(self, out: Path, state: RunState, seconds: float) -> None:
        """Write OUT/agalign-run.json with the results so far. Raises OutputError."""
        facts: dict[str, Any] = {"state": state, "seconds": round(seconds, 2)}
        for name in ("stage_seconds", "capture_seconds"):
            facts[name] = {k: round(v, 3) for k, v in sorted(getattr(self, name).items())}
        write_model(out / RUN_FILE, self.model_copy(update=facts))


def input_name(folder: Path) -> str:
    """Return the path of an input folder as the record has it."""
    return escape_controls(str(folder.resolve()))


def begun(folder: Path, settings: Settings, captures: Sequence[Capture] = (), command: str = "") -> RunPart:
    """Return the record of a run that starts now."""
    system = {"system": platform.system(), "release": platform.release(), "processor": platform.machine()}
    return RunPart(
        state="running",
        started_at=datetime.now(UTC).isoformat(timespec="seconds"),
        seconds=0.0,
        input=input_name(folder),
        command=escape_controls(command),
        cameras=camera_overviews(captures),
        versions=library_versions(),
        machine={**system, "cores": usable_cores(), "device": settings.joint.device},
        settings=settings.model_dump(mode="json"),
        labels=[capture.label for capture in captures],
    )


def read_run_record(out: Path) -> RunPart | None:
    """Return the record of the last run into a folder, if any. Raises SidecarError for a file of another format."""
    try:
        return read_model(out / RUN_FILE, RunPart)
    except SidecarError:
        if version := _other_version(out / RUN_FILE):
            what = f"was written by agalign {version} and cannot be read by agalign {__version__}"
            raise SidecarError(f"{out / RUN_FILE}: {what}; run again into a new folder") from None
        raise


def _other_version(path: Path) -> str:
    """Return the version that wrote a record, if it is another one or has another schema; empty if it is unknown."""
    with suppress(OSError, ValueError):
        facts = json.loads(read_regular(path))
        if isinstance(facts, dict) and str(facts.get("schema", "")).startswith("agalign-run/"):
            version = shortened(str(facts.get("agalign", "of unknown version")))
            return "" if (facts["schema"], version) == (_SCHEMA, __version__) else version
    return ""


def last_record(out: Path) -> RunPart | None:
    """Return the record of the last run into a folder; None without one, and for one that cannot be read, which the
    commands that need it name.
    """
    with suppress(SidecarError):
        return read_run_record(out)
    return None


def file_states(out: Path) -> dict[str, str]:
    """Return the states in which runs left the files below an output folder, by label of the capture."""
    record = last_record(out)
    return {} if record is None else record.file_states


def renamed_captures(out: Path) -> frozenset[str]:
    """Return the labels of results below an output folder that do not count, because the exposure has a result under
    its present name.
    """
    record = last_record(out)
    renamed = [part for part in ([] if record is None else record.not_in_input) if part.same_as]
    return frozenset(part.capture for part in renamed if (out / f"{part.same_as}.json").is_file())


def counted_sidecars(sidecars: Iterable[Path], out: Path) -> dict[Path, str]:
    """Return the sidecars below an output folder, without those of renamed captures, and the states in which runs left
    the files of each.
    """
    states, renamed = file_states(out), renamed_captures(out)
    labels = {path: label_of(path, out) for path in sidecars}
    return {path: states.get(label, "") for path, label in labels.items() if label not in renamed}


@dataclass(frozen=True)
class UnfinishedRun:
    """What the last run into a folder did not do."""

    state: RunState
    found: int
    """Number of captures that were to be aligned."""
    missing: list[str]
    """Labels of those without a result."""
    erroneous: list[str]
    """Labels of those with a result and an error: some or all of their files are of an earlier run."""
    kept: list[str]
    """Labels of those that cannot be processed, as input files are lost."""

    @property
    def sentence(self) -> str:
        """Describe what is missing, without a full stop; empty if there is none."""
        states: dict[RunState, str] = {
            "running": "the run did not end: it was killed, or is still running",
            "interrupted": "the run was stopped before its end",
        }
        parts, of_all = [states[self.state]] if self.state in states else [], f"of {counted(self.found, 'capture')}"
        if self.missing:
            verb = "has" if len(self.missing) == 1 else "have"
            parts.append(f"{len(self.missing)} {of_all} {verb} no result: {some_of(self.missing, _MAX_NAMED)}")
        if self.erroneous:
            what = f"errors in {len(self.erroneous)} {of_all}, whose files may be of an earlier run"
            parts.append(f"{what}: {some_of(self.erroneous, _MAX_NAMED)}")
        parts += ["the same command resumes it"] if parts else []
        if self.kept:
            verb = "was" if len(self.kept) == 1 else "were"
            what = f"{len(self.kept)} {of_all} {verb} not processed, as input files are missing or damaged"
            remedy = "copy them from the card again, or align without them by --overwrite"
            parts.append(f"{what}: {some_of(self.kept, _MAX_NAMED)}; {remedy}")
        return "; ".join(parts)


def unfinished_run(
    record: RunPart | None, not_aligned: Iterable[PanelOrSkyPart], labels: Collection[str]
) -> UnfinishedRun | None:
    """Return what the last run into a folder did not do, given its panels and captures of the sky, and the labels of
    the captures that have a result; None without a record.
    """
    if record is None:
        return None
    excluded = {part.label for part in not_aligned if part.is_left_out}
    wanted = [label for label in record.labels if label not in excluded]
    kept = {part.of for part in record.problems if part.kind == "kept"}
    with_error = {part.of for part in record.problems if part.kind != "impossible"} - kept
    missing = [label for label in wanted if label not in labels]
    erroneous = [label for label in wanted if label in labels and escape_controls(label) in with_error]
    return UnfinishedRun(
        record.state, len(wanted), missing, erroneous, [label for label in wanted if escape_controls(label) in kept]
    )
