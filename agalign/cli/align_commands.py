"""The commands that align: `align`, `demo` and `onto`."""

import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from agalign.batch.preload import preload_libraries
from agalign.cli.command import Command, Given
from agalign.cli.config_file import load_config
from agalign.cli.terminal import RAW_NUMBERS, Terminal, command_line
from agalign.errors import GeometryError
from agalign.host.processes import cores_for
from agalign.host.text import counted
from agalign.values.choices import MAX_MOSAIC_PIXELS

_command = partial(
    Command, on_interrupt="interrupted; finished captures are kept, and the same command resumes the run"
)


def _align(
    terminal: Terminal,
    given: Given,
    folder: Annotated[Path, typer.Argument()],
    model: Path | None = None,
    out: Annotated[Path | None, typer.Option("-o", "--out")] = None,
    dry_run: bool = False,
    config: Annotated[Path | None, typer.Option(is_eager=True, callback=load_config)] = None,  # noqa: ARG001 - applied
) -> int:
    """Align every capture below FOLDER.

    Options:
        folder: Folder with the images, sub-folders included.
        model: Start from the network and rig of an earlier flight of the same camera (OUT/models/….safetensors).
        out: Output folder; by default FOLDER-aligned.
        dry_run: Print which captures would be processed, and write nothing.
        config: TOML file with values of these options; 'agalign info --options' prints one.

    Examples:
        agalign flight/  align the bands of all captures, into flight-aligned/
        agalign flight/ -o aligned/ --radiometry  write reflectance, if the camera's tags are sufficient
        agalign flight/ -o aligned/ --layout bands  write a file per band with its tags, for photogrammetry
        agalign orchard/ --relief --error-map  correct parallax of trees; map the expected error
    """
    from agalign.config import DiscoverOptions, RunOptions, Settings
    from agalign.spectral_indices.formulas import chosen_indices

    source = folder.absolute() if folder.is_symlink() else folder.resolve()  # results are beside a link
    target = out or source.parent / f"{source.name}-aligned"
    settings = Settings.model_validate(given["settings"])
    dask = given["run"].pop("executor")
    options = RunOptions(**given["run"], command=command_line())
    cores = cores_for(options.jobs)
    requested = chosen_indices(settings.write.indices)
    load_ahead()
    from agalign.batch.workers import start_server_ahead
    from agalign.cli.align_run import conclude, find_captures, print_plan, run
    from agalign.spectral_indices.rasters import is_of_raw_numbers

    reading = DiscoverOptions(**given["discover"], skip=(target,), jobs=cores, timeout_s=options.timeout_s)
    flight = find_captures(folder, reading, terminal)
    if not dask and not dry_run:
        start_server_ahead(len(flight.captures), cores, has_timeout=options.timeout_s is not None)
    if any(is_of_raw_numbers(index, c, settings.write) for index in requested for c in flight.captures):
        terminal.problem(RAW_NUMBERS)
    if dry_run:
        return print_plan(flight, target, settings, options, terminal, model)
    return conclude(run(flight, target, settings, terminal, options, dask=dask, model=model), target, terminal)


def load_ahead() -> None:
    """Import torch and other large libraries in a thread, which takes two seconds, while the files are read."""

    def load() -> None:
        with suppress(Exception):  # reported at the next import
            preload_libraries()

    threading.Thread(target=load, daemon=True).start()


align = _command(
    _align,
    {
        "Input": "reference bands order with_rgb pattern ignore_metadata include exclude align_panels max_pixels",
        "Alignment": "seed only_seed relief accept_predicted model",
        "Output": "out interpolation crop undistort resolution layout radiometry panel_albedo pan_sharpen index "
        "georeference ground_elevation qa statistics relief_map fill_occluded error_map tie_points format "
        "compression",
        "Running": "device jobs dask overwrite retry_failed timeout dry_run config quiet verbose log_json",
        "Expert": "recipe sharing model_family each_alone rng_seed",
    },
)


def _demo(
    terminal: Terminal,
    given: Given,
    out: Annotated[Path, typer.Argument()] = Path("agalign-demo"),
    captures: Annotated[int, typer.Option(min=1, max=1000)] = 3,
) -> int:
    """Make a synthetic flight, align it, and compare the result with the ground truth.

    Options:
        out: Output folder.
        captures: Number of captures.
    """
    from agalign.cli.align_run import conclude, find_captures, run
    from agalign.config import DiscoverOptions, RunOptions, Settings
    from agalign.host.output_folder import prepare_output
    from agalign.synthetic.flight import make_flight, refuse_other_images, score_against_truth

    source, target = out / "flight", out / "aligned"
    prepare_output(source)
    refuse_other_images(source)
    terminal.event(
        "make", f"Rendering a synthetic flight: {counted(captures, 'capture')} of 5 bands …", captures=captures
    )
    settings = Settings.model_validate(given["settings"])
    truth = make_flight(source, captures, rng_seed=settings.joint.rng_seed)
    flight = find_captures(source, DiscoverOptions(), terminal)
    totals = run(flight, target, settings, terminal, RunOptions(overwrite=True, **given["run"]))
    headers = ("Capture", "Band", "Status", "before", "median", "p95")
    rows = [
        (s.capture, s.band, s.status, f"{s.before_px:.1f}", f"{s.median_px:.3f}", f"{s.p95_px:.3f}")
        for s in score_against_truth(target, truth)
    ]
    terminal.table(headers, rows, "Error relative to the ground truth, px", texts=3)
    return conclude(totals, target, terminal)


demo = _command(_demo, {"Running": "jobs device rng_seed quiet verbose log_json"})


def _onto(
    terminal: Terminal,
    given: Given,
    reference: Annotated[Path, typer.Argument()],
    moving: Annotated[list[Path], typer.Argument()],
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None,
    band: Annotated[str | None, typer.Option("--band")] = None,
) -> int:
    """Align georeferenced mosaics of other dates or sensors to the grid of REFERENCE.

    Grids, resolutions and coordinate reference systems may differ. A mosaic is aligned if its expected error is at
    most half a pixel of REFERENCE in 90% of the common area. Its output has the band of REFERENCE (--band), then its
    own.

    Options:
        reference: The mosaic with the output grid.
        moving: Mosaics to align.
        out: Output folder; by default REFERENCE-aligned.
        band: Band of REFERENCE that the bands of MOVING are aligned to; by default green.
        relief: Add a smooth displacement field to the homography: always, never, or if it reduces the residuals of
            held-out windows (auto).
        jobs: Mosaics processed at the same time; 0 is one per core.
        overwrite: Process finished mosaics again.
        max_pixels: Refuse mosaics with more pixels, without reading them.
    """
    from agalign.cameras.discover import mosaics_apart_km, mosaics_onto
    from agalign.cli.align_run import conclude, run
    from agalign.config import RunOptions, Settings
    from agalign.records.sidecar_file import check_products

    target = out or reference.absolute().parent / f"{reference.stem}-aligned"
    settings = Settings.model_validate(given["settings"]).for_mosaics
    flight = mosaics_onto(reference, moving, band, given["discover"]["max_pixels"])
    check_products([reference, *moving])
    for capture in flight.captures:
        path = capture.moving[0].path
        try:
            offset_km = mosaics_apart_km(capture.reference, capture.moving[0])
        except GeometryError as error:
            terminal.problem(f"{path}: cannot be compared with the reference by its {error}", file=path)
            continue
        if offset_km:
            terminal.problem(f"{path}: is {offset_km:,.1f} km away from the reference, by its coordinates", file=path)
    totals = run(flight, target, settings, terminal, RunOptions(**given["run"], align_panels=True))
    return conclude(totals, target, terminal)


onto = _command(
    _onto,
    {
        "Output": "out interpolation format compression",
        "Input": "band max_pixels",
        "Alignment": "relief",
        "Running": "device rng_seed jobs overwrite quiet verbose log_json",
    },
    defaults={"jobs": 1, "max_pixels": MAX_MOSAIC_PIXELS},
)
