"""The command that aligns a folder, and what `demo` shares with it."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from agalign.cli.terminal import (
    EXIT_NOTHING,
    EXIT_OK,
    EXIT_PARTIAL,
    LogJson,
    Quiet,
    RngSeed,
    Verbose,
    Voice,
    exits,
    shown,
)
from agalign.errors import ConfigurationError, NoSuchBandError, OutputError
from agalign.values.choices import (
    MOST_PIXELS,
    BandOrder,
    Compression,
    Crop,
    FamilyChoice,
    Interpolation,
    Layout,
    LocalUse,
    RadiometryChoice,
    RasterFormat,
    Recipe,
    Resolution,
    SeedChoice,
    Sharing,
)

if TYPE_CHECKING:
    from agalign.batch import CaptureReport, RunOptions
    from agalign.cameras.discover import DiscoverOptions, Flight
    from agalign.config import Settings
    from agalign.values.capture import Capture

GOES_ON = "interrupted; what is finished stays, and the same command goes on from there"

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder with the images, sub-folders included.", show_default=False)
]
Pattern = Annotated[
    str | None, typer.Option(help="File names as '{capture}_{band}.tif', where agalign does not know them.")
]
Reference = Annotated[str | None, typer.Option(help="Name of the reference band; by default green.")]
Jobs = Annotated[
    int,
    typer.Option(
        "--jobs",
        "-j",
        min=0,
        show_default=False,
        help="Captures at a time; by default one a core.",
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(
        help="Scheduler of a Dask cluster that does the captures, tcp://host:8786; it sees the same folders. "
        "'local' starts worker processes here."
    ),
]
IgnoreMetadata = Annotated[bool, typer.Option("--ignore-metadata", help="Use no lens or rig tags.")]
BandNames = Annotated[
    str | None, typer.Option("--bands", help="Names of the bands that take part, separated by commas; by default all.")
]
Order = Annotated[BandOrder, typer.Option(help="Of the bands: as the camera counts them, by wavelength, or by name.")]
WithRgb = Annotated[
    bool, typer.Option("--with-rgb", help="The camera's colour photograph (JPEG) takes part too, as three bands.")
]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command()(align)


def align(
    folder: FolderArgument,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Output folder; by default FOLDER with '-aligned' added.")
    ] = None,
    reference: Reference = None,
    bands: BandNames = None,
    order: Order = "index",
    with_rgb: WithRgb = False,
    pattern: Pattern = None,
    seed: Annotated[SeedChoice, typer.Option(help="Start from this kind of coarse alignment only.")] = "auto",
    only_seed: Annotated[
        bool, typer.Option("--only-seed", help="Stop at the coarse alignment; learn nothing.")
    ] = False,
    ignore_metadata: IgnoreMetadata = False,
    recipe: Annotated[Recipe, typer.Option(help="How to optimise: fast, or step by step as published.")] = "fast",
    sharing: Annotated[Sharing, typer.Option(help="What the descriptor's two sides share.")] = "pseudo-siamese",
    model_family: Annotated[
        FamilyChoice, typer.Option(help="Mapping to fit; auto is as rich as the images allow.")
    ] = "auto",
    interpolation: Annotated[Interpolation, typer.Option(help="Resampling of the moving bands.")] = "lanczos",
    crop: Annotated[
        Crop,
        typer.Option(
            help="Cut to the area all bands share, alike for all captures of a flight or for each by itself, or keep "
            "the reference's frame."
        ),
    ] = "flight",
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Write the lens-corrected grid of the reference.")
    ] = False,
    resolution: Annotated[
        Resolution, typer.Option(help="Of the output: the reference's, or the finest band's on the reference's frame.")
    ] = "reference",
    layout: Annotated[
        Layout, typer.Option(help="A stack of all bands, a file for each input file with its tags, or both.")
    ] = "stack",
    local: Annotated[
        LocalUse,
        typer.Option(
            help="Follow parallax over trees and buildings by a smooth field over the homography: where it is needed, "
            "wherever it helps, or not at all. --local alone is always."
        ),
    ] = "auto",
    accept_predicted: Annotated[
        float,
        typer.Option(
            min=0,
            help="A band whose own image cannot say where it lies counts as delivered where the flight's rig "
            "predicts it this well, px.",
        ),
    ] = 1.0,
    radiometry: Annotated[
        RadiometryChoice,
        typer.Option(
            help="Write float32: radiance by the camera's calibration, reflectance by its light sensor or by a panel; "
            "thermal bands in degrees C. --radiometry alone is auto: the last of these that all bands can be given."
        ),
    ] = "off",
    panel_albedo: Annotated[
        str | None,
        typer.Option(
            help="Reflectance of the calibration panel, as 0.51 or as Blue=0.51,NIR=0.49; by default what tags or its "
            "QR code say. With it a panel is also known by its looks."
        ),
    ] = None,
    align_panels: Annotated[
        bool, typer.Option("--align-panels", help="Align captures of calibration panels too, as any other.")
    ] = False,
    pan_sharpen: Annotated[
        bool,
        typer.Option(
            "--pan-sharpen",
            help="The bands at the panchromatic's resolution too, or at the colour photograph's with --with-rgb: "
            "<capture>.pan.tif.",
        ),
    ] = False,
    stac: Annotated[bool, typer.Option("--stac", help="A STAC item beside each capture's files.")] = False,
    error_map: Annotated[
        bool, typer.Option("--error-map", help="A raster of the error to expect at every pixel, <capture>.error.tif.")
    ] = False,
    format: Annotated[RasterFormat, typer.Option(help="Tiled GeoTIFF or cloud-optimised GeoTIFF.")] = "gtiff",
    compression: Annotated[
        Compression, typer.Option(help="Lossless; auto is zstd for stacks and deflate for single bands.")
    ] = "auto",
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1 …")] = "auto",
    rng_seed: RngSeed = 0,
    jobs: Jobs = 0,
    dask: Dask = None,
    model: Annotated[
        Path | None, typer.Option(help="Start from what an earlier flight of the same camera learnt: OUT/models/….")
    ] = None,
    each_alone: Annotated[
        bool, typer.Option("--each-alone", help="Learn every capture by itself instead of once a flight.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Do captures again that an earlier run finished.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Do those of them again in which a band is not aligned, or missing.")
    ] = False,
    timeout: Annotated[
        float | None, typer.Option(min=1, help="Seconds after which a capture is given up; by default never.")
    ] = None,
    max_pixels: Annotated[
        int, typer.Option(min=1, help="Images that declare more are refused before anything is read.")
    ] = MOST_PIXELS,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Align every capture below FOLDER."""
    voice = Voice(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(voice, GOES_ON):
        from agalign.batch import RunOptions
        from agalign.cameras.discover import DiscoverOptions
        from agalign.config import (
            CheckSettings,
            FlightSettings,
            JointSettings,
            LocalSettings,
            SeedSettings,
            Settings,
            WriteSettings,
        )
        from agalign.products.stac import need_stac

        whole = folder.resolve()
        target = out or whole.parent / f"{whole.name}-aligned"
        settings = Settings(
            seed=SeedSettings(force=None if seed == "auto" else seed, only=only_seed),
            joint=JointSettings(
                recipe=recipe, sharing=sharing, model_family=model_family, device=device, rng_seed=rng_seed
            ),
            flight=FlightSettings(together=not each_alone),
            check=CheckSettings(accept_predicted_px=accept_predicted),
            local=LocalSettings(use=local),
            write=WriteSettings(
                interpolation=interpolation, crop=crop, undistort=undistort, resolution=resolution, layout=layout,
                radiometry=radiometry, panel_albedo=albedos(panel_albedo), stac=stac, error_map=error_map,
                pan_sharpen=pan_sharpen,
                format=format, compression=compression,
            ),
        )  # fmt: skip
        options = DiscoverOptions(
            pattern, reference, ignore_metadata, with_rgb, band_names(bands), order, (target,), max_pixels
        )  # fmt: skip
        if stac:
            need_stac()
        flight = find_captures(folder, options, voice)
        how = RunOptions(overwrite, retry_failed, jobs, timeout, align_panels)
        outcome = run(flight, target, settings, voice, how, dask=dask, model=model)
        raise typer.Exit(conclude(flight, outcome, target, voice))


def albedos(text: str | None) -> tuple[tuple[str, float], ...]:
    """(band in lower case, reflectance) of a list 'Blue=0.51,NIR=0.49', or of one number for all, whose name is empty.

    Raises ConfigurationError.
    """
    found = []
    for part in band_names(text):
        name, _, number = part.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value <= 1:
            raise ConfigurationError(f"--panel-albedo {text}: '{part}' is no reflectance between 0 and 1")
        found.append((name.strip().lower(), value))
    return tuple(found)


def band_names(text: str | None) -> tuple[str, ...]:
    """The names in a list separated by commas."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def find_captures(folder: Path, options: "DiscoverOptions", voice: Voice, *, silent: bool = False) -> "Flight":
    """The captures below a folder; what is wrong with its files is said. Raises where there is none."""
    from agalign.cameras.discover import discover
    from agalign.errors import InputError

    flight = discover(folder, options)
    if not silent:
        for problem in flight.problems:
            voice.problem(problem.text, file=problem.path)
    if not flight.captures:
        if any(isinstance(p.error, NoSuchBandError) for p in flight.problems):
            raise NoSuchBandError(f"{folder}: no capture has a band '{options.reference}'")
        raise InputError(
            f"{folder}: no capture of two or more bands in it; 'agalign info {folder}' shows what was found"
        )
    bands = sum(len(c.bands) for c in flight.captures)
    if not silent:
        voice.event(
            "found",
            f"{len(flight.captures)} captures, {bands} bands in {folder}",
            captures=len(flight.captures),
            bands=bands,
        )
    return flight


@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    reports: "list[CaptureReport]"
    """In the flight's order."""
    complete: bool
    """False where captures were not begun, or the report could not be written."""


def run(
    flight: "Flight", out: Path, settings: "Settings", voice: Voice, how: "RunOptions", *,
    dask: str | None = None, model: Path | None = None, keep_tables: bool = False,
) -> Outcome:  # fmt: skip
    """Align the captures, saying how far it has come. Raises OutputError where nothing could be written."""
    from agalign.batch import Listener, run_flight
    from agalign.batch.workers import dask_executor

    reports: list[CaptureReport] = []
    done_pairs, all_pairs = 0, sum(len(c.moving) for c in flight.captures)
    pairs = {c.label: len(c.moving) for c in flight.captures}
    started = time.monotonic()
    cluster = nullcontext() if dask is None else dask_executor(dask, how.jobs, how.timeout_s)
    complete = True
    with cluster as executor, _progress(voice, all_pairs) as show:
        options = replace(how, executor=executor)
        current: Capture | None = None

        def on_start(capture: "Capture") -> None:
            nonlocal current
            voice.check()
            current = capture

        def on_learning(camera: str, share: float) -> None:
            voice.check()
            show(done_pairs, f"learning from {camera}: {share:.0%} at most")

        def on_learnt(camera: str, seconds: float) -> None:
            voice.event("learnt", camera=camera, seconds=round(seconds, 2))

        def on_pair(band: str, stage: str, share: float) -> None:
            voice.check()
            assert current is not None
            names = [b.name for b in current.moving]
            place = names.index(band) if band in names else len(names)
            show(
                done_pairs + place + (0.85 * share if stage in ("learning", "refining") else 0.0),
                f"{current.label} {band}: {stage}",
            )

        try:
            listener = Listener(on_start, on_pair, on_learning, on_learnt)
            for capture_report in run_flight(flight, out, settings, options, listener, model):
                voice.check()
                reports.append(capture_report if keep_tables else capture_report.without_tables())
                done_pairs += pairs[capture_report.label]
                show(done_pairs, capture_report.label)
                _tell(capture_report, voice, len(reports), len(flight.captures))
        except OutputError as error:
            if not reports:
                raise
            voice.problem(str(error))
            complete = False
        finally:
            complete = _write_pages(out, reports, voice) and complete
    places = {label: number for number, label in enumerate(pairs)}
    reports.sort(key=lambda r: places[r.label])
    voice.event("finished", seconds=round(time.monotonic() - started, 1), captures=len(reports))
    return Outcome(reports, complete)


def _write_pages(out: Path, reports: "list[CaptureReport]", voice: Voice) -> bool:
    """Also after an interruption: what is finished is reported. False where that could not be written."""
    from agalign.products.report import write_report
    from agalign.products.summary import write_summary

    try:
        if reports:
            write_summary(out)
            write_report(out)
    except OutputError as error:
        voice.problem(str(error))
        return False
    return True


@contextmanager
def _progress(voice: Voice, pairs: int) -> Iterator[Callable[[float, str], None]]:
    """A bar on a terminal, nothing elsewhere: there each capture prints a plain line."""
    if voice.quiet or voice.log_json or not voice.err.is_terminal:
        yield lambda _done, _text: None
        return
    columns = (
        BarColumn(bar_width=28), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )  # fmt: skip
    with Progress(*columns, console=voice.err, transient=True) as progress:
        task = progress.add_task("starting", total=pairs)
        yield lambda done, text: progress.update(task, completed=done, description=shown(text))


def _tell(report: "CaptureReport", voice: Voice, number: int, count: int) -> None:
    if report.panel is not None:
        text = f"[{number}/{count}] {report.label}: {report.panel}"
        voice.event("panel", text, capture=report.label, panel=report.panel)
        return
    for text in report.problems:
        voice.problem(f"{report.label}: {text}", capture=report.label)
    for (name, stage), seconds in report.stages.items() if voice.log_json else ():
        voice.event("stage", capture=report.label, pair=name, stage=stage, seconds=round(seconds, 4))
    if report.sidecar is None:
        return
    pairs = [b for b in report.sidecar.bands if b.status != "reference"]
    aligned, predicted = (sum(b.status == status for b in pairs) for status in ("aligned", "predicted"))
    also = f", {predicted} predicted" if predicted else ""
    kept = ", kept from an earlier run" if report.state == "kept" else ""
    seconds = sum(b.seconds for b in pairs)
    text = f"[{number}/{count}] {report.label}: {aligned} of {len(pairs)} aligned{also}, {seconds:.1f} s{kept}"
    if voice.verbose or not voice.err.is_terminal or voice.log_json:
        voice.event(
            "capture",
            text,
            capture=report.label,
            state=report.state,
            status=report.sidecar.status,
            aligned=aligned,
            predicted=predicted,
            pairs=len(pairs),
            seconds=round(report.seconds, 3),
        )
    for band in pairs:
        residual = band.metrics.after.residual_px if band.metrics else None
        shown = "" if residual is None else f", residual {residual:.3f} px"
        if voice.verbose or voice.log_json:
            voice.event(
                "pair", f"    {band.band}: {band.status}{shown}, {band.seconds:.1f} s",
                capture=report.label, band=band.band, status=band.status, reason=band.reason,
                residual_px=residual, seconds=band.seconds,
            )  # fmt: skip
        if band.status in ("predicted", "seed_only", "failed"):
            voice.problem(
                f"{report.label} {band.band}: {band.status}: {band.reason}", capture=report.label, band=band.band
            )


def conclude(flight: "Flight", outcome: Outcome, out: Path, voice: Voice) -> int:
    """The closing table, and the exit code."""
    from statistics import median

    reports = outcome.reports
    pairs = [b for r in reports if r.sidecar for b in r.sidecar.bands if b.status != "reference"]
    table = Table("Band", title=f"{sum(b.status == 'aligned' for b in pairs)} of {len(pairs)} band pairs aligned")
    for name in ("Aligned", "Predicted", "Seed only", "Failed", "Residual px, median", "Worst", "Seconds a pair"):
        table.add_column(name, justify="right")
    for name in dict.fromkeys(b.band for b in pairs):
        mine = [b for b in pairs if b.band == name]
        residuals = [b.metrics.after.residual_px for b in mine if b.status == "aligned" and b.metrics]
        known = [r for r in residuals if r is not None]
        counts = [str(sum(b.status == s for b in mine)) for s in ("aligned", "predicted", "seed_only", "failed")]
        worst = (f"{median(known):.3f}", f"{max(known):.3f}") if known else ("-", "-")
        table.add_row(shown(name), *counts, *worst, f"{median(b.seconds for b in mine):.1f}")
    if pairs:
        voice.result(table)
    voice.result(shown(f"Report: {out / 'index.html'}"))
    if reports and all(r.state == "panel" for r in reports):
        voice.problem("nothing but calibration panels there; --align-panels aligns them all the same")
        return EXIT_NOTHING
    if not any(r.useful for r in reports):
        voice.problem("no band pair could be aligned")
        alone = all(r.sidecar is None for r in reports)
        return EXIT_NOTHING if alone else EXIT_PARTIAL
    whole = outcome.complete and not flight.problems and all(r.good for r in reports)
    return EXIT_OK if whole else EXIT_PARTIAL
