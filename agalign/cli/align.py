"""The command `agalign align`, and options that other commands share with it."""

from pathlib import Path
from typing import Annotated

import typer

from agalign.cli.config_file import load_config
from agalign.cli.terminal import (
    INTERRUPTED,
    RAW_NUMBERS,
    LogJson,
    Quiet,
    Terminal,
    Verbose,
    command_line,
    examples,
    exits,
    of_alignment,
    of_expert,
    of_input,
    of_output,
    of_running,
)
from agalign.errors import ConfigurationError
from agalign.values.choices import (
    MAX_PIXELS,
    MAX_RNG_SEED,
    BandOrder,
    Compression,
    Crop,
    FamilyChoice,
    Interpolation,
    Layout,
    RadiometryChoice,
    RasterFormat,
    Recipe,
    ReliefUse,
    Resolution,
    SeedChoice,
    Sharing,
)
from agalign.values.cores import usable_cores
from agalign.values.memory_limit import check_address_space

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder with the images, sub-folders included.", show_default=False)
]
Pattern = Annotated[
    str | None,
    of_input(help="Pattern of file names of other cameras, as '{capture}_{band}.tif'."),
]
Reference = Annotated[str | None, of_input(help="Name of the reference band; by default green.")]
Jobs = Annotated[
    int,
    of_running(
        "--jobs", "-j", min=0, show_default=False, help="Captures processed at the same time; by default one per core."
    ),
]
Dask = Annotated[
    str | None,
    of_running(
        help="Address of a Dask scheduler, as tcp://host:8786; its workers need the same folders. 'local' starts "
        "worker processes on this machine."
    ),
]
IgnoreMetadata = Annotated[bool, of_input("--ignore-metadata", help="Use no lens or rig tags.")]
BandNames = Annotated[
    str | None,
    of_input("--bands", help="Names of the bands to align, separated by commas; by default all."),
]
Order = Annotated[
    BandOrder,
    of_input(help="Order of the bands: as numbered by the camera, by wavelength, or by name."),
]
WithRgb = Annotated[
    bool,
    of_input("--with-rgb", help="Also align the camera's colour photograph (JPEG), as three bands."),
]
Include = Annotated[
    list[str] | None,
    of_input(show_default=False, help="Use only files that match this glob by path or name; repeatable."),
]
Exclude = Annotated[
    list[str] | None,
    of_input(show_default=False, help="Ignore files that match this glob, such as '*/test/*'; repeatable."),
]


_EXAMPLES = examples(
    ("agalign flight/", "align the bands of all captures, into flight-aligned/"),
    ("agalign flight/ -o aligned/ --radiometry", "write reflectance, if the camera's tags are sufficient"),
    ("agalign flight/ -o aligned/ --layout bands", "write a file per band with its tags, for photogrammetry"),
    ("agalign orchard/ --relief --error-map", "correct parallax of trees; map the expected error"),
    ("agalign flight/ --model earlier/models/CAMERA.safetensors", "reuse the network and rig of an earlier flight"),
    ("agalign flight/ --retry-failed", "process failed captures again"),
)


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(align)


def align(
    folder: FolderArgument,
    reference: Reference = None,
    bands: BandNames = None,
    order: Order = "index",
    with_rgb: WithRgb = False,
    pattern: Pattern = None,
    ignore_metadata: IgnoreMetadata = False,
    include: Include = None,
    exclude: Exclude = None,
    align_panels: Annotated[
        bool,
        of_input("--align-panels", help="Also align captures of calibration panels and of the sky."),
    ] = False,
    max_pixels: Annotated[
        int,
        of_input(min=1, help="Refuse images with more pixels than this, without reading them."),
    ] = MAX_PIXELS,
    seed: Annotated[
        SeedChoice, of_alignment(help="Use only this kind of initial alignment; by default the best of all.")
    ] = "auto",
    only_seed: Annotated[
        bool,
        of_alignment("--only-seed", help="Stop after the initial alignment."),
    ] = False,
    relief: Annotated[
        ReliefUse,
        of_alignment(
            help="Correct parallax (trees, terraces, buildings, close range) by one relief for all bands of a capture. "
            "auto: if windows show parallax. --relief alone means always."
        ),
    ] = "auto",
    accept_predicted: Annotated[
        float,
        of_alignment(
            min=0,
            help="Largest standard error, px, at which a predicted band counts as usable.",
        ),
    ] = 1.0,
    model: Annotated[
        Path | None,
        of_alignment(help="Reuse the network and rig of an earlier flight of the same camera: OUT/models/…."),
    ] = None,
    out: Annotated[
        Path | None,
        of_output("-o", "--out", help="Output folder; by default FOLDER with '-aligned' added."),
    ] = None,
    interpolation: Annotated[Interpolation, of_output(help="Resampling of the moving bands.")] = "lanczos",
    crop: Annotated[
        Crop,
        of_output(
            help="Area to write. flight: shared by all bands of all captures; common: shared by all bands of the "
            "capture; none: the whole frame of the reference."
        ),
    ] = "flight",
    undistort: Annotated[
        bool,
        of_output("--undistort", help="Remove the lens distortion of the reference from the output."),
    ] = False,
    resolution: Annotated[
        Resolution,
        of_output(help="Pixel size of the output: that of the reference, or of the finest band."),
    ] = "reference",
    layout: Annotated[
        Layout,
        of_output(help="Write one stack per capture, one file with tags per input file, or both."),
    ] = "stack",
    radiometry: Annotated[
        RadiometryChoice,
        of_output(
            help="Write float32. camera: radiance by the camera's calibration; sun, panel: reflectance by light sensor "
            "or calibration panel; auto (--radiometry alone): panel if available for all bands, else sun, else camera. "
            "Thermal bands are written in degrees C."
        ),
    ] = "off",
    panel_albedo: Annotated[
        str | None,
        of_output(
            help="Reflectance of the calibration panel, as 0.51 or as Blue=0.51,NIR=0.49; by default from tags or QR "
            "code. With this option, panels without tags and code are recognised too."
        ),
    ] = None,
    pan_sharpen: Annotated[
        bool,
        of_output(
            "--pan-sharpen",
            help="Also write the bands at the resolution of the panchromatic band, or of the colour photograph with "
            "--with-rgb: <capture>.pan.tif.",
        ),
    ] = False,
    index: Annotated[
        str | None,
        of_output(
            show_default=False,
            help="Also write spectral indices, names separated by commas: ndvi, ndre …; 'agalign indices' adds others.",
        ),
    ] = None,
    georeference: Annotated[
        bool,
        of_output(
            "--georeference",
            help="Write an approximate georeference from GPS, altitude and yaw; a tag has its expected error.",
        ),
    ] = False,
    ground_elevation: Annotated[
        float | None,
        of_output(
            show_default=False,
            help="Elevation of the ground, m, in the height system of the camera's GPS; for footprints, if the tags "
            "contain no height above ground.",
        ),
    ] = None,
    qa: Annotated[
        bool,
        of_output("--qa", help="Write a raster of quality flags (saturated, occluded, glint …), <capture>.qa.tif."),
    ] = False,
    statistics: Annotated[
        bool,
        of_output(
            "--statistics",
            help="Store minimum, maximum, mean and standard deviation in aligned bands (gdalinfo -stats).",
        ),
    ] = False,
    stac: Annotated[
        bool, of_output("--stac", help="Write a STAC item per capture and a collection per flight.")
    ] = False,
    relief_map: Annotated[
        bool,
        of_output("--relief-map", help="Add confidence and range (m) to the raster of a capture's relief."),
    ] = False,
    fill_occluded: Annotated[
        bool,
        of_output(
            "--fill-occluded", help="Interpolate pixels that are occluded in a band; by default they are nodata."
        ),
    ] = False,
    error_map: Annotated[
        bool,
        of_output("--error-map", help="Write a raster of the expected error at every pixel, <capture>.error.tif."),
    ] = False,
    tie_points: Annotated[
        bool,
        of_output(
            "--tie-points",
            help="Write the measured tie points of each band with residual and weight: <capture>.ties.csv "
            "and .ties.geojson.",
        ),
    ] = False,
    format: Annotated[RasterFormat, of_output(help="Write tiled GeoTIFF or cloud-optimised GeoTIFF.")] = "gtiff",
    compression: Annotated[
        Compression,
        of_output(help="Lossless compression; auto is zstd for stacks and deflate for single bands."),
    ] = "auto",
    device: Annotated[str, of_running(help="Torch device: auto, cpu, cuda, cuda:1 …")] = "auto",
    jobs: Jobs = 0,
    dask: Dask = None,
    overwrite: Annotated[
        bool,
        of_running("--overwrite", help="Process finished captures again."),
    ] = False,
    retry_failed: Annotated[
        bool,
        of_running("--retry-failed", help="Process captures again if a band is not aligned or missing."),
    ] = False,
    timeout: Annotated[
        float | None,
        of_running(min=1, help="Seconds after which a capture is abandoned; by default unlimited."),
    ] = None,
    dry_run: Annotated[bool, of_running("--dry-run", help="Print what would be done, and write nothing.")] = False,
    config: Annotated[  # noqa: ARG001 - its callback applies the file
        Path | None,
        of_running(
            is_eager=True,
            callback=load_config,
            show_default=False,
            help="Read these options from a TOML file; 'agalign info --options' prints one.",
        ),
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
    recipe: Annotated[Recipe, of_expert(help="Algorithm: fast, or the published one (paper).")] = "fast",
    sharing: Annotated[
        Sharing, of_expert(help="Layers that the networks of both bands share: all, all but the first, or none.")
    ] = "pseudo-siamese",
    model_family: Annotated[
        FamilyChoice,
        of_expert(help="Mapping to fit; auto is the most general one that the images determine."),
    ] = "auto",
    each_alone: Annotated[
        bool,
        of_expert("--each-alone", help="Learn a network per capture instead of one per flight."),
    ] = False,
    rng_seed: Annotated[
        int,
        of_expert(min=0, max=MAX_RNG_SEED, help="Seed of all random numbers; the same seed gives the same result."),
    ] = 0,
) -> None:
    """Align every capture below FOLDER."""
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal, INTERRUPTED):
        check_address_space()
        from agalign.cameras.discover import DiscoverOptions
        from agalign.cli.run import conclude, find_captures, load_ahead, print_plan, run
        from agalign.config import (
            CheckSettings,
            FlightSettings,
            JointSettings,
            ReliefSettings,
            SeedSettings,
            Settings,
            WriteSettings,
        )
        from agalign.products.stac import need_stac
        from agalign.values.processes import start_server_ahead

        source = folder.resolve()
        target = out or source.parent / f"{source.name}-aligned"
        settings = Settings(
            seed=SeedSettings(force=None if seed == "auto" else seed, only=only_seed),
            joint=JointSettings(
                recipe=recipe, sharing=sharing, model_family=model_family, device=device, rng_seed=rng_seed
            ),
            flight=FlightSettings(together=not each_alone),
            check=CheckSettings(accept_predicted_px=accept_predicted),
            relief=ReliefSettings(use=relief),
            write=WriteSettings(
                interpolation=interpolation, crop=crop, undistort=undistort, resolution=resolution, layout=layout,
                radiometry=radiometry, panel_albedo=albedos(panel_albedo), stac=stac,
                indices=tuple(name.lower() for name in band_names(index)), error_map=error_map, tie_points=tie_points,
                relief_map=relief_map, fill_occluded=fill_occluded,
                pan_sharpen=pan_sharpen, georeference=georeference, ground_elevation_m=ground_elevation, qa=qa,
                statistics=statistics,
                format=format, compression=compression,
            ),
        )  # fmt: skip
        options = DiscoverOptions(
            pattern, reference, ignore_metadata, with_rgb, band_names(bands), order, (target,), max_pixels,
            jobs or usable_cores(), tuple(include or ()), tuple(exclude or ()),
        )  # fmt: skip
        if stac:
            need_stac()
        load_ahead()
        flight = find_captures(folder, options, terminal)
        if not dask and not dry_run:
            start_server_ahead(len(flight.captures), jobs or usable_cores())
        from agalign.batch import RunOptions

        run_options = RunOptions(
            overwrite, jobs, align_panels, retry_failed=retry_failed, timeout_s=timeout, command=command_line()
        )
        if index and radiometry == "off" and any(b.dtype[0] in "ui" for c in flight.captures for b in c.bands):
            terminal.problem(RAW_NUMBERS)
        if dry_run:
            raise typer.Exit(print_plan(flight, target, settings, run_options, terminal))
        totals = run(flight, target, settings, terminal, run_options, dask=dask, model=model)
        raise typer.Exit(conclude(totals, target, terminal))


def albedos(text: str | None) -> tuple[tuple[str, float], ...]:
    """Return (band in lower case, reflectance) from 'Blue=0.51,NIR=0.49', or ("", reflectance) from one number.

    Raises ConfigurationError for a reflectance that is not in (0, 1].
    """
    result = []
    for part in band_names(text):
        name, _, number = part.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value <= 1:
            raise ConfigurationError(f"--panel-albedo {text}: '{part}' is not a reflectance between 0 and 1")
        result.append((name.strip().lower(), value))
    return tuple(result)


def band_names(text: str | None) -> tuple[str, ...]:
    """Return the names in a list separated by commas."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())
