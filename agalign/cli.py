"""The command line: parses, calls the library, prints."""

import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from agalign import cli_evaluate
from agalign._version import __version__
from agalign.errors import ConfigurationError
from agalign.terminal import EXIT_NOTHING, EXIT_OK, EXIT_PARTIAL, LogJson, Quiet, Verbose, Voice, exits

if TYPE_CHECKING:
    from agalign.batch import CaptureReport
    from agalign.config import Settings
    from agalign.discover import DiscoverOptions, Flight
    from agalign.records import Capture

app = typer.Typer(
    name="agalign",
    help="Co-register the bands of multispectral drone cameras. 'agalign FOLDER' aligns everything below FOLDER.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
_COMMANDS = ("align", "demo", "info", "report", "learn", "evaluate", "surface")


cli_evaluate.register(app)
_GOES_ON = "interrupted; what is finished stays, and the same command goes on from there"


class SeedChoice(StrEnum):
    """Kinds of seed that can be forced."""

    auto = "auto"
    rig = "rig"
    geo = "geo"
    structure = "structure"
    match = "match"
    identity = "identity"


class RecipeChoice(StrEnum):
    """Recipes of the joint aligner."""

    fast = "fast"
    paper = "paper"


class SharingChoice(StrEnum):
    """How much the two sides of the descriptor share."""

    siamese = "siamese"
    pseudo = "pseudo-siamese"
    unshared = "unshared"


class FamilyChoice(StrEnum):
    """Model families."""

    auto = "auto"
    homography = "homography"
    affine = "affine"
    translation = "translation"


class InterpolationChoice(StrEnum):
    """Resampling kernels."""

    nearest = "nearest"
    bilinear = "bilinear"
    cubic = "cubic"
    lanczos = "lanczos"


class CropChoice(StrEnum):
    """What part of the reference grid is written."""

    common = "common"
    none = "none"


class FormatChoice(StrEnum):
    """File formats of the stacks."""

    gtiff = "gtiff"
    cog = "cog"


class CompressionChoice(StrEnum):
    """Compressions of the stacks."""

    zstd = "zstd"
    deflate = "deflate"
    none = "none"


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
        help="Captures at a time; by default one a core, and one for short flights.",
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(help="Scheduler of a Dask cluster that does the captures, tcp://host:8786; it sees the same folders."),
]
IgnoreMetadata = Annotated[bool, typer.Option("--ignore-metadata", help="Use no lens or rig tags.")]


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(f"agalign {__version__}")
        raise typer.Exit


@app.command()
def align(
    folder: FolderArgument,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Output folder; by default FOLDER with '-aligned' added.")
    ] = None,
    reference: Reference = None,
    pattern: Pattern = None,
    seed: Annotated[SeedChoice, typer.Option(help="Start from this kind of coarse alignment only.")] = SeedChoice.auto,
    ignore_metadata: IgnoreMetadata = False,
    recipe: Annotated[
        RecipeChoice, typer.Option(help="How to optimise: fast, or step by step as published.")
    ] = RecipeChoice.fast,
    sharing: Annotated[
        SharingChoice, typer.Option(help="What the descriptor's two sides share.")
    ] = SharingChoice.pseudo,
    model_family: Annotated[
        FamilyChoice, typer.Option(help="Mapping to fit; auto is as rich as the images allow.")
    ] = FamilyChoice.auto,
    interpolation: Annotated[
        InterpolationChoice, typer.Option(help="Resampling of the moving bands.")
    ] = InterpolationChoice.lanczos,
    crop: Annotated[
        CropChoice, typer.Option(help="Cut to the area all bands share, or keep the reference's frame.")
    ] = CropChoice.common,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Write the lens-corrected grid of the reference.")
    ] = False,
    format: Annotated[
        FormatChoice, typer.Option(help="Tiled GeoTIFF or cloud-optimised GeoTIFF.")
    ] = FormatChoice.gtiff,
    compression: Annotated[
        CompressionChoice, typer.Option(help="Lossless compression of the stacks.")
    ] = CompressionChoice.zstd,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1 …")] = "auto",
    rng_seed: Annotated[
        int, typer.Option(min=0, help="Seed of all random numbers; the same seed gives the same result.")
    ] = 0,
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
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Align every capture below FOLDER."""
    voice = Voice(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(voice, _GOES_ON):
        from agalign.config import FlightSettings, JointSettings, SeedSettings, Settings, WriteSettings
        from agalign.discover import DiscoverOptions

        target = out or folder.absolute().parent / f"{folder.absolute().name}-aligned"
        settings = Settings(
            seed=SeedSettings.model_validate({"force": None if seed is SeedChoice.auto else seed.value}),
            joint=JointSettings(
                recipe=recipe.value, sharing=sharing.value, model_family=model_family.value,
                device=device, rng_seed=rng_seed,
            ),
            flight=FlightSettings(together=not each_alone),
            write=WriteSettings(
                interpolation=interpolation.value, crop=crop.value, undistort=undistort,
                format=format.value, compression=compression.value,
            ),
        )  # fmt: skip
        options = DiscoverOptions(pattern, reference, ignore_metadata, (target,))
        flight = _discover(folder, options, voice)
        reports = _run(flight, target, settings, voice, overwrite=overwrite, jobs=jobs, dask=dask, model=model)
        raise typer.Exit(_conclude(flight, reports, target, voice))


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(help="Folder to make.")] = Path("agalign-demo"),
    captures: Annotated[int, typer.Option(min=1, max=1000, help="Captures to make.")] = 3,
    jobs: Jobs = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1 …")] = "auto",
    rng_seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Make a synthetic flight, align it, and compare the result with the known truth."""
    voice = Voice(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(voice, _GOES_ON):
        from agalign.batch import prepare_output
        from agalign.config import JointSettings, Settings
        from agalign.demo import make_flight, score_against_truth
        from agalign.discover import DiscoverOptions

        source, target = out / "flight", out / "aligned"
        prepare_output(source)
        voice.event(
            "make", f"Painting a field and photographing it: {captures} captures of 5 bands …", captures=captures
        )
        truth = make_flight(source, captures, rng_seed=rng_seed)
        flight = _discover(source, DiscoverOptions(), voice)
        settings = Settings(joint=JointSettings(device=device, rng_seed=rng_seed))
        reports = _run(flight, target, settings, voice, overwrite=True, jobs=jobs, keep_tables=True)
        table = Table("Capture", "Band", "Status", title="Error against the truth, px")
        for name in ("before", "median", "95 %"):
            table.add_column(name, justify="right")
        for s in score_against_truth(reports, truth):
            table.add_row(s.capture, s.band, s.status, f"{s.before_px:.1f}", f"{s.median_px:.3f}", f"{s.p95_px:.3f}")
        voice.result(table)
        raise typer.Exit(_conclude(flight, reports, target, voice))


@app.command()
def info(
    folder: FolderArgument,
    pattern: Pattern = None,
    reference: Reference = None,
    ignore_metadata: IgnoreMetadata = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Show what was found: cameras, captures, bands, seeds, and what is missing."""
    voice = Voice(quiet=False, verbose=False, log_json=False)
    with exits(voice):
        from agalign.discover import DiscoverOptions

        flight = _discover(folder, DiscoverOptions(pattern, reference, ignore_metadata), voice, silent=as_json)
        rows = [_facts(c) for c in flight.captures]
        if as_json:
            problems = [{"file": str(p.path), "problem": p.text} for p in flight.problems]
            typer.echo(json.dumps({"folder": str(folder), "captures": rows, "problems": problems}, indent=1))
        else:
            table = Table("Capture", "Camera", "Taken", "Bands (reference in brackets)", "Size", "Seeds", "Missing")
            for row in rows:
                bands = ", ".join(f"[{b['name']}]" if b["reference"] else str(b["name"]) for b in row["bands"])
                size = "{width} x {height}".format(**row["bands"][0])
                cells = (row["label"], row["camera"], row["captured_at"][:19], bands, size, ", ".join(row["seeds"]))
                table.add_row(*(escape(c) for c in cells), escape(", ".join(row["missing_bands"])))
            voice.result(table)
            found = f"{len(rows)} captures, {sum(len(r['bands']) for r in rows)} bands, {len(flight.problems)} problems"
            voice.result(found)
        raise typer.Exit(EXIT_NOTHING if not rows else EXIT_PARTIAL if flight.problems else EXIT_OK)


@app.command()
def report(
    out: Annotated[Path, typer.Argument(help="Output folder of an earlier run.", show_default=False)],
) -> None:
    """Rebuild the report and the summary from the sidecars."""
    voice = Voice(quiet=False, verbose=False, log_json=False)
    with exits(voice):
        from agalign.errors import InputError
        from agalign.report import write_report
        from agalign.sidecar import find_sidecars
        from agalign.summary import write_summary

        if not out.is_dir() or not find_sidecars(out):
            raise InputError(f"{out}: no sidecars there; give the output folder of a run")
        unreadable: list[str] = []
        summary = write_summary(out, unreadable.append)
        for text in unreadable:
            voice.problem(text)
        voice.result(escape(f"{write_report(out)}\n{summary}"))
        raise typer.Exit(EXIT_PARTIAL if unreadable else EXIT_OK)


def _facts(capture: "Capture") -> dict[str, Any]:
    """What `info` shows of a capture."""
    from agalign.cameras import rig_seed
    from agalign.seed import geo_seed

    kinds = {
        "rig": any(rig_seed(capture.reference, b) is not None for b in capture.moving),
        "geo": any(geo_seed(capture.reference, b) is not None for b in capture.moving),
    }
    bands = [
        {
            "name": b.name, "file": str(b.path), "band_index": b.band_index, "wavelength_nm": b.wavelength_nm,
            "width": b.width_px, "height": b.height_px, "dtype": b.dtype, "nodata": b.nodata,
            "lens_model": b.lens is not None, "reference": b is capture.reference,
        }
        for b in capture.bands
    ]  # fmt: skip
    return {
        "label": capture.label,
        "camera": f"{capture.camera.make} {capture.camera.model}".strip() or "unknown",
        "serial": capture.camera.serial,
        "captured_at": capture.captured_at,
        "capture_id": capture.capture_id,
        "flight_id": capture.flight_id,
        "bands": bands,
        "seeds": [kind for kind, there in kinds.items() if there] + ["structure", "identity"],
        "missing_bands": list(capture.missing_bands),
    }


def main() -> None:
    """Entry point: a first argument that is no command is the folder to align."""
    arguments = sys.argv[1:]
    if arguments and arguments[0] not in _COMMANDS and not _is_root_option(arguments[0]):
        arguments = ["align", *arguments]
    # Threads that spin while they wait cost a multiple of the time where another program wants the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # The matrices here are small: a second BLAS thread does nothing but spin.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.getLogger("rasterio").setLevel(logging.CRITICAL)
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    app(args=arguments, prog_name="agalign")


def _is_root_option(argument: str) -> bool:
    return argument in ("--help", "-h", "--version")


def _discover(folder: Path, options: "DiscoverOptions", voice: Voice, *, silent: bool = False) -> "Flight":
    from agalign.discover import discover
    from agalign.errors import InputError

    flight = discover(folder, options)
    if not silent:
        for problem in flight.problems:
            voice.problem(problem.text, file=problem.path)
    if not flight.captures:
        if any("for the reference; this capture has" in p.text for p in flight.problems):
            raise ConfigurationError(f"{folder}: no capture has a band '{options.reference}'")
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


def _run(
    flight: "Flight", out: Path, settings: "Settings", voice: Voice, *,
    overwrite: bool, jobs: int, dask: str | None = None, model: Path | None = None, keep_tables: bool = False,
) -> "list[CaptureReport]":  # fmt: skip
    from agalign.batch import Listener, RunOptions, dask_executor, run_flight
    from agalign.joint import choose_device

    # One process feeds a GPU; and to start one costs as much as two captures.
    on_cpu = choose_device(settings.joint.device).type == "cpu"
    worth_starting = min(os.cpu_count() or 1, len(flight.captures) // 4) if on_cpu else 1
    reports: list[CaptureReport] = []
    done_pairs, all_pairs = 0, sum(len(c.moving) for c in flight.captures)
    pairs = {c.label: len(c.moving) for c in flight.captures}
    started = time.monotonic()
    cluster = nullcontext() if dask is None else dask_executor(dask)
    with cluster as executor, _progress(voice, all_pairs) as show, _interruptible() as check_interrupt:
        options = RunOptions(overwrite, jobs or max(1, worth_starting), executor)
        current: Capture | None = None

        def on_start(capture: "Capture") -> None:
            nonlocal current
            check_interrupt()
            current = capture

        def on_learning(camera: str, share: float) -> None:
            check_interrupt()
            show(done_pairs, f"learning from {camera}: {share:.0%} at most")

        def on_pair(band: str, stage: str, share: float) -> None:
            check_interrupt()
            assert current is not None
            names = [b.name for b in current.moving]
            place = names.index(band) if band in names else len(names)
            show(
                done_pairs + place + (0.85 * share if stage in ("learning", "refining") else 0.0),
                f"{current.label} {band}: {stage}",
            )

        try:
            listener = Listener(on_start, on_pair, on_learning)
            for capture_report in run_flight(flight, out, settings, options, listener, model):
                check_interrupt()
                reports.append(capture_report if keep_tables else capture_report.without_tables())
                done_pairs += pairs[capture_report.label]
                show(done_pairs, capture_report.label)
                _tell(capture_report, voice, len(reports), len(flight.captures))
        finally:
            _write_pages(out, reports)
    reports.sort(key=lambda r: list(pairs).index(r.label))
    voice.event("finished", seconds=round(time.monotonic() - started, 1), captures=len(reports))
    return reports


def _write_pages(out: Path, reports: "list[CaptureReport]") -> None:
    """Also after an interruption: what is finished is reported."""
    from agalign.report import write_report
    from agalign.summary import write_summary

    if reports:
        write_summary(out)
        write_report(out)


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Yields a check that raises KeyboardInterrupt once SIGINT has come.

    The exception that Python itself raises is lost where it falls into a callback from a C library.
    """
    came = False

    def on_interrupt(_number: int, _frame: object) -> None:
        nonlocal came
        came = True
        raise KeyboardInterrupt

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


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
        yield lambda done, text: progress.update(task, completed=done, description=escape(text))


def _tell(report: "CaptureReport", voice: Voice, number: int, count: int) -> None:
    if report.sidecar is None:
        voice.problem(f"{report.label}: {report.error}", capture=report.label)
        return
    pairs = [b for b in report.sidecar.bands if b.status != "reference"]
    aligned = sum(b.status == "aligned" for b in pairs)
    kept = ", kept from an earlier run" if report.state == "kept" else ""
    seconds = sum(b.seconds for b in pairs)
    text = f"[{number}/{count}] {report.label}: {aligned} of {len(pairs)} aligned, {seconds:.1f} s{kept}"
    if voice.verbose or not voice.err.is_terminal or voice.log_json:
        voice.event(
            "capture",
            text,
            capture=report.label,
            state=report.state,
            status=report.sidecar.status,
            aligned=aligned,
            pairs=len(pairs),
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
        if band.status in ("seed_only", "failed"):
            voice.problem(
                f"{report.label} {band.band}: {band.status}: {band.reason}", capture=report.label, band=band.band
            )


def _conclude(flight: "Flight", reports: "list[CaptureReport]", out: Path, voice: Voice) -> int:
    """The closing table, and the exit code."""
    from statistics import median

    pairs = [b for r in reports if r.sidecar for b in r.sidecar.bands if b.status != "reference"]
    table = Table("Band", title=f"{sum(b.status == 'aligned' for b in pairs)} of {len(pairs)} band pairs aligned")
    for name in ("Aligned", "Seed only", "Failed", "Residual px, median", "Worst", "Seconds a pair"):
        table.add_column(name, justify="right")
    for name in dict.fromkeys(b.band for b in pairs):
        mine = [b for b in pairs if b.band == name]
        residuals = [b.metrics.after.residual_px for b in mine if b.status == "aligned" and b.metrics]
        known = [r for r in residuals if r is not None]
        counts = [str(sum(b.status == s for b in mine)) for s in ("aligned", "seed_only", "failed")]
        worst = (f"{median(known):.3f}", f"{max(known):.3f}") if known else ("-", "-")
        table.add_row(escape(name), *counts, *worst, f"{median(b.seconds for b in mine):.1f}")
    voice.result(table)
    voice.result(escape(f"Report: {out / 'index.html'}"))
    if not any(r.useful for r in reports):
        voice.problem("no band pair could be aligned")
        alone = all(r.sidecar is None for r in reports)
        return EXIT_NOTHING if alone else EXIT_PARTIAL
    return EXIT_OK if all(r.good for r in reports) and not flight.problems else EXIT_PARTIAL


if __name__ == "__main__":
    main()
