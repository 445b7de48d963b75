"""Aligning a flight from the command line: reports of captures, and summary.

The commands import this module when they run, because the libraries that it needs take half a second.
"""

import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from concurrent.futures import Executor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from agalign.batch.workers import dask_executor
from agalign.cameras.discover import FolderScan, discover
from agalign.cli.terminal import MAX_LISTED, ExitCode, Terminal, explain, progress
from agalign.config import DiscoverOptions, RunOptions, Settings
from agalign.errors import InputError, OutputError, WorkerError
from agalign.flight.groups import camera_overviews
from agalign.host.files import REPORT_FILE
from agalign.host.text import counted, escape_controls
from agalign.records.panels_and_sky import exclusions, last_panels_and_sky
from agalign.records.run_record import RunPart
from agalign.records.sidecar import BandResult
from agalign.report.pages import pair_totals
from agalign.report.pair_totals import PairTotals
from agalign.report.summary_csv import rounded
from agalign.values.capture import Capture

if TYPE_CHECKING:
    from agalign.batch.capture_report import CaptureReport
    from agalign.batch.run import Listener


def find_captures(folder: Path, options: DiscoverOptions, terminal: Terminal) -> FolderScan:
    """Return the captures below a folder, and print them. Raises InputError or NoSuchBandError if there are none."""
    flight = discover(folder, options)
    print_found(flight, terminal)
    if flight.captures:
        return flight
    raise InputError(
        f"{folder}: no capture of two or more bands in it; 'agalign info {folder}' lists its files, and why each "
        "kind is not used"
    )


def print_found(flight: FolderScan, terminal: Terminal) -> None:
    """Print the problems of files, the number of captures and bands if there are any, and a warning about 8 bits."""
    print_problems(flight, terminal)
    captures, bands = len(flight.captures), sum(len(c.bands) for c in flight.captures)
    if captures:
        text = f"{counted(captures, 'capture')}, {counted(bands, 'band')} in {flight.folder}"
        terminal.event("found", text, captures=captures, bands=bands)
    if flight.eight_bit:
        text = (
            f"{counted(len(flight.eight_bit), 'capture')} with 8 bits per band: 256 levels, and the tone "
            "curve of a picture, limit radiometry and indices; export 16-bit TIFFs where the camera has them"
        )
        terminal.event("eight_bit", text, captures=len(flight.eight_bit))


def print_problems(flight: FolderScan, terminal: Terminal) -> None:
    """Print the problems of files: at most `MAX_LISTED` lines per cause, and the number of further files.

    With --log-json, print a line for each file.
    """
    by_cause: dict[str, list[str]] = defaultdict(list)
    for problem in flight.problems:
        # Group by message without numbers, because sizes differ between files with the same cause.
        cause = re.sub(r"\d+", "0", problem.text.replace(str(problem.path), "").replace(problem.path.name, ""))
        by_cause[cause].append(problem.path.name)
        if terminal.log_json or len(by_cause[cause]) <= MAX_LISTED:
            terminal.problem(problem.text, file=problem.path)
    for names in by_cause.values():
        if len(names) > MAX_LISTED and not terminal.log_json:
            same = f"{len(names) - MAX_LISTED} more files with the same problem as {names[MAX_LISTED - 1]}"
            terminal.problem(f"{flight.folder}: {same}; 'agalign info --json' lists all")


def print_plan(
    flight: FolderScan, out: Path, settings: Settings, options: RunOptions, terminal: Terminal, model: Path | None
) -> int:
    """Print what a run would do with each capture; return the exit code."""
    from agalign.batch.run import plan_run

    states = plan_run(flight, out, settings, options, model)
    for camera in camera_overviews(flight.captures):
        terminal.result(camera.text)
    counts = Counter(states.values())
    for label, state in states.items():
        terminal.event("plan", f"{label}: {state}" if terminal.verbose else "", capture=label, state=state)
    text = ", ".join(f"{counted(number, 'capture')} {state}" for state, number in counts.items())
    terminal.result(f"Into {out}: {text}; nothing was written")
    return ExitCode.OK if flight.is_complete else ExitCode.PARTIAL


@dataclass
class RunTotals:
    """Totals of a run so far; reports are not kept, which limits memory."""

    is_complete: bool
    """All captures are good, no file has a problem, and the report is written."""
    asked: dict[str, int]
    """Number of band pairs of each capture."""
    record: RunPart | None = None
    """That of the run, which has counted its captures; None until its end."""
    finished: int = 0
    """Number of captures that were reported."""
    skipped: int = 0
    """Number of those that needed no time."""
    pairs: PairTotals = field(default_factory=PairTotals)
    """All band pairs below the output folder, as the report counts them; known at the end of the run."""
    removed: dict[str, list[Path]] = field(default_factory=lambda: defaultdict(list))
    """Files of earlier commands that were removed, by reason."""
    panel_ages_s: dict[str, list[float | None]] = field(default_factory=lambda: defaultdict(list))
    """Times between captures and the nearest panel, by the quantity that raw numbers were converted to."""

    def add(self, report: "CaptureReport") -> None:
        """Add the report of a capture."""
        self.finished += 1
        self.skipped += report.state in ("kept", "panel", "sky")
        self.is_complete &= report.is_complete
        for path, reason in report.removed:
            self.removed[reason].append(path)
        output = None if report.result is None else report.result.output
        if output is not None and output.radiometry is not None:
            self.panel_ages_s[output.radiometry].append(output.panel_age_s)

    def end(self, record: RunPart, pairs: PairTotals | None) -> None:
        """Keep the record of the run at its end, and the band pairs in the report if it was written."""
        self.record, self.pairs = record, pairs or self.pairs

    @property
    def states(self) -> Counter[str]:
        """Number of captures by state, after the end of the run."""
        counts = Counter[str]() if self.record is None else self.record.captures
        return counts - Counter(found=counts["found"])


def run(
    flight: FolderScan,
    out: Path,
    settings: Settings,
    terminal: Terminal,
    options: RunOptions,
    *,
    dask: str | None = None,
    model: Path | None = None,
) -> RunTotals:
    """Align the captures, print progress, and return the totals.

    Raises OutputError or WorkerError if no capture could be processed.
    """
    from agalign.batch.run import run_flight

    asked = {c.label: len(c.moving) + len(c.missing_bands) for c in flight.captures}
    totals, problems, started = RunTotals(flight.is_complete, asked), list[str](), time.monotonic()
    with cluster(dask, options.jobs) as executor, progress(terminal, len(flight.captures)) as show_line:
        options = replace(options, executor=executor)

        def show(share: float, text: str) -> None:
            show_line(totals.finished + share, text, totals.skipped)

        listener = replace(_listener(terminal, show), on_problem=problems.append, on_end=totals.end)
        try:
            with closing(run_flight(flight, out, settings, options, listener, model)) as reports:
                for report in reports:
                    terminal.check()
                    totals.add(report)
                    show(0.0, report.label)
                    _print_report(report, terminal, totals.finished, len(flight.captures))
        except (OutputError, WorkerError) as error:
            if not totals.finished:
                raise
            problems.append(str(error))
    for problem in problems:
        terminal.problem(problem)
    totals.is_complete &= not problems
    if not totals.pairs.captures:  # the report was not written, and that of an earlier run is kept: read all sidecars
        totals.pairs = pair_totals(out)
    seconds = round(time.monotonic() - started, 1)
    terminal.event("finished", seconds=seconds, captures=totals.states.total(), **totals.states)
    return totals


def _listener(terminal: Terminal, show: Callable[[float, str], None]) -> "Listener":
    """Return a listener that shows the progress of a run as a share of a capture and a text."""
    from agalign.batch.run import Listener

    def on_learning(camera: str, share: float) -> None:
        terminal.check()
        show(0.0, f"learning from {camera}: {share:.0%} at most")

    def on_pair(capture: Capture, band: str, stage: str, share: float) -> None:
        terminal.check()
        names = [*(b.name for b in capture.moving), band]
        finished = names.index(band) + (0.85 * share if stage in ("learning", "refining") else 0.0)
        show(finished / max(len(capture.moving), 1), f"{capture.label} {band}: {stage}")

    return Listener(
        on_pair,
        on_learning,
        on_learned=lambda camera, seconds: terminal.event("learned", camera=camera, seconds=round(seconds, 2)),
        on_again=lambda text: terminal.event("again", text, message=text),
    )


def cluster(dask: str | None, jobs: int) -> AbstractContextManager[Executor | None]:
    """Connect to a Dask cluster if its address is given."""
    return nullcontext() if dask is None else dask_executor(dask, jobs)


def _print_report(report: "CaptureReport", terminal: Terminal, number: int, count: int) -> None:
    """Print or log a finished capture: its stages with --log-json, its pairs also with --verbose."""
    heading = f"[{number}/{count}] {report.label}"
    for kind, text in (("panel", report.panel), ("sky", report.sky)):
        if text is not None:
            terminal.event(kind, f"{heading}: {text}", capture=report.label, **{kind: text})
            return
    for text in report.problems:
        terminal.problem(f"{report.label}: {text}", capture=report.label)
    if terminal.log_json:
        for (name, stage), stage_s in report.stages.items():
            terminal.event("stage", capture=report.label, pair=name, stage=stage, seconds=round(stage_s, 4))
    result, seconds = report.result, round(report.seconds, 3)
    if result is None:
        terminal.event("capture", capture=report.label, state=report.state, seconds=seconds)
        return
    counts = Counter(status for _, status, _ in result.pairs)
    aligned, predicted = counts["aligned"], counts["predicted"]
    also = f", {predicted} predicted" if predicted else ""
    how = "kept from an earlier run" if report.state == "kept" else f"{report.seconds:.1f} s"
    # On a terminal, the progress line suffices.
    is_printed = terminal.verbose or not terminal.err.is_terminal
    terminal.event(
        "capture",
        f"{heading}: {aligned} of {counts.total()} aligned{also}, {how}" if is_printed else "",
        capture=report.label,
        state=report.state,
        status=result.status,
        aligned=aligned,
        predicted=predicted,
        pairs=counts.total(),
        seconds=seconds,
    )
    if terminal.verbose or terminal.log_json:
        for band in result.moving:
            _print_pair(report.label, band, terminal)


def _print_pair(capture: str, band: BandResult, terminal: Terminal) -> None:
    residual = rounded(band.metrics.after.residual_px) if band.metrics else None
    measured = "" if residual is None else f", residual {residual:.3f} px"
    terminal.event(
        "pair",
        f"    {band.band}: {band.status}{measured}, {band.seconds:.1f} s",
        capture=capture,
        band=band.band,
        status=band.status,
        reason=band.reason,
        residual_px=residual,
        seconds=band.seconds,
    )
    if band.status != "aligned":
        terminal.problem(f"{capture} {band.band}: {band.status}: {band.reason}", capture=capture, band=band.band)


def conclude(totals: RunTotals, out: Path, terminal: Terminal) -> int:
    """Print the table of bands and the failures; return the exit code."""
    excluded = [part for parts in last_panels_and_sky(out) for part in parts if part.is_left_out]
    _print_totals(totals, {part.label for part in excluded}, terminal)
    for reason, paths in totals.removed.items():
        terminal.problem(f"{counted(len(paths), 'file')} of an earlier command removed, such as {paths[0]}: {reason}")
    for line in exclusions(excluded):
        terminal.result(line)
    for line in [] if totals.record is None else totals.record.notes_on_input():
        terminal.problem(f"{out}: {line}")
    if (out / REPORT_FILE).is_file():
        terminal.result(f"Report: {out / REPORT_FILE}")
    states = totals.states
    if states and states.keys() <= {"panel", "sky"}:
        or_sky = " or the sky" if states["sky"] else ""
        terminal.problem(f"all captures show calibration panels{or_sky}; --align-panels aligns them like any other")
        return ExitCode.NOTHING
    if not states["done"] + states["kept"]:
        terminal.problem("no capture could be processed")
        return ExitCode.NOTHING
    statuses = totals.pairs.statuses
    if not statuses["aligned"] + statuses["predicted"]:
        terminal.problem("no band pair could be aligned")
        return ExitCode.PARTIAL
    # The report may count results of other runs too.
    is_usable = totals.pairs.unusable_captures.isdisjoint(map(escape_controls, totals.asked))
    return ExitCode.OK if totals.is_complete and is_usable else ExitCode.PARTIAL


def _print_totals(totals: RunTotals, excluded: Collection[str], terminal: Terminal) -> None:
    """Print the table of bands, what to check and what was not written, given the captures that are not aligned."""
    statuses, captures, states = totals.pairs.statuses, totals.pairs.captures, totals.states
    uncounted = [label for label in totals.asked if escape_controls(label) not in captures and label not in excluded]
    asked = statuses.total() + sum(totals.asked[label] for label in uncounted)
    written = states["done"] + states["kept"]
    lost = len(totals.asked) - written - states["panel"] - states["sky"]  # one may have a result of an earlier run
    if statuses:
        missing = f"; {counted(lost, 'capture')} not written" if lost else ""
        _print_table(totals.pairs, f"{statuses['aligned']} of {asked} band pairs aligned{missing}", terminal)
    explain(totals.pairs.groups(), terminal)
    if lost:
        of_all = f"{lost} of {counted(lost + written, 'capture')}"
        terminal.problem(f"{of_all} could not be written, for the reasons above; mend them, and repeat the command")
    for quantity, ages_s in totals.panel_ages_s.items():
        age_s = max((one for one in ages_s if one is not None), default=None)
        age = "" if age_s is None else f", at most {age_s / 60:.0f} min from a panel"
        terminal.result(f"Written as {quantity}: {counted(len(ages_s), 'capture')}{age}")


def _print_table(pairs: PairTotals, title: str, terminal: Terminal) -> None:
    """Print a row per band: number of pairs by status, residuals, time."""
    columns, rows = ["aligned", "predicted", "seed_only", "failed"], []
    if pairs.statuses["missing"]:
        columns.append("missing")
    for name, band in pairs.bands.items():
        px, seconds = band.residuals_px, f"{median(band.seconds):.1f}" if band.seconds else "-"
        residuals = (f"{median(px):.3f}", f"{max(px):.3f}") if px else ("-", "-")
        rows.append((name, *(str(band.statuses[status]) for status in columns), *residuals, seconds))
    titles = (status.replace("_", " ").capitalize() for status in columns)
    headers = ("Band", *titles, "Residual px, median", "Worst", "Seconds per pair")
    terminal.table(headers, rows, title, texts=1)
