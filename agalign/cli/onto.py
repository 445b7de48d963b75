"""The command `agalign onto`: align georeferenced mosaics of other dates or sensors to the grid of a reference."""

from pathlib import Path
from typing import Annotated

import typer

from agalign.cli.align import Jobs
from agalign.cli.terminal import (
    LogJson,
    Quiet,
    RngSeed,
    Terminal,
    Verbose,
    exits,
    of_alignment,
    of_input,
    of_output,
    of_running,
)
from agalign.values.choices import MAX_MOSAIC_PIXELS, Compression, Interpolation, RasterFormat, ReliefUse
from agalign.values.memory_limit import check_address_space


def onto(
    reference: Annotated[Path, typer.Argument(help="The mosaic with the output grid.", show_default=False)],
    moving: Annotated[list[Path], typer.Argument(help="Mosaics of other dates or sensors.", show_default=False)],
    out: Annotated[
        Path | None,
        of_output("--out", "-o", help="Output folder; by default REFERENCE-aligned.", show_default=False),
    ] = None,
    band: Annotated[
        str | None,
        of_input("--reference", "--band", show_default=False, help="Band of REFERENCE to compare; by default green."),
    ] = None,
    relief: Annotated[
        ReliefUse,
        of_alignment(
            help="Add a smooth displacement field to the homography. auto: if windows not used in its fit confirm it."
        ),
    ] = "auto",
    interpolation: Annotated[Interpolation, of_output(help="Resampling of the moving mosaics.")] = "lanczos",
    format: Annotated[RasterFormat, of_output(help="Tiled GeoTIFF or cloud-optimised GeoTIFF.")] = "gtiff",
    compression: Annotated[Compression, of_output(help="Lossless compression.")] = "auto",
    device: Annotated[str, of_running(help="auto, cpu, cuda, cuda:1 …")] = "auto",
    rng_seed: RngSeed = 0,
    jobs: Jobs = 1,
    overwrite: Annotated[bool, of_running("--overwrite", help="Process finished mosaics again.")] = False,
    max_pixels: Annotated[
        int, of_input(min=1, help="Refuse mosaics with more pixels than this, without reading them.")
    ] = MAX_MOSAIC_PIXELS,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Align georeferenced mosaics of other dates or sensors to the grid of REFERENCE.

    Grids, resolutions and coordinate reference systems may differ. For each MOVING, agalign writes a sidecar and a
    raster on the grid of REFERENCE, with one band of REFERENCE (--reference) and all bands of MOVING.
    """
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal):
        check_address_space()
        from agalign.batch import RunOptions
        from agalign.cameras.discover import FolderScan
        from agalign.cameras.mosaics import captures_onto, distance_km
        from agalign.cli.run import conclude, run
        from agalign.config import FlightSettings, JointSettings, ReliefSettings, Settings, WriteSettings

        target = out or reference.absolute().parent / f"{reference.stem}-aligned"
        settings = Settings(
            joint=JointSettings(device=device, rng_seed=rng_seed),
            flight=FlightSettings(together=False),
            relief=ReliefSettings(use=relief),
            write=WriteSettings(interpolation=interpolation, crop="none", format=format, compression=compression),
        )
        flight = FolderScan(reference.parent, tuple(captures_onto(reference, moving, band, max_pixels)), ())
        for capture in flight.captures:
            offset_km = distance_km(capture.reference, capture.moving[0])
            if offset_km:
                path = capture.moving[0].path
                terminal.problem(
                    f"{path}: is {offset_km:,.1f} km away from the reference, by its coordinates", file=path
                )
        totals = run(flight, target, settings, terminal, RunOptions(overwrite, jobs=jobs, align_panels=True))
        raise typer.Exit(conclude(totals, target, terminal))
