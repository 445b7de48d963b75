"""Settings and options: one immutable model for each stage, for the search for captures and for the run.

An unknown name of a setting or an invalid value raises pydantic's ValidationError. The docstring of a field is also the
help text of its command-line option, and its row in docs/reference/settings.md. Other parameters are constants in the
modules that use them, with their reasons.
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from operator import not_
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic import dataclasses as validated
from pydantic.fields import FieldInfo

from agalign.errors import ConfigurationError
from agalign.values import choices
from agalign.values.spectrum import band_key


def names_in(text: str | None) -> tuple[str, ...]:
    """Return the names in a list separated by commas."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def albedos(text: str | None) -> tuple[tuple[str, float], ...]:
    """Return (band in lower case, reflectance) from 'Blue=0.51,NIR=0.49', or ("", reflectance) from one number.

    Raises ConfigurationError for a reflectance that is not in (0, 1].
    """
    result: list[tuple[str, float]] = []
    for part in names_in(text):
        name, _, number = part.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not 0 < value <= 1:
            raise ConfigurationError(f"--panel-albedo {text}: '{part}' is not a reflectance between 0 and 1")
        result.append((name.strip().lower(), value))
    return tuple(result)


def _one_of_each_band(given: tuple[tuple[str, float], ...]) -> tuple[tuple[str, float], ...]:
    """Return reflectances of the panel. Raises ConfigurationError for two of a band."""
    keys = [band_key(name) for name, _ in given]
    if repeated := [name for number, (name, _) in enumerate(given) if keys[number] in keys[:number]]:
        raise ConfigurationError(f"--panel-albedo has two reflectances of {repeated[0] or 'all bands'}")
    return given


@dataclass(frozen=True)
class Option:
    """The command-line option of a field. The annotation of the field states what differs from it;
    `cli.command.field_options` adds the rest.
    """

    name: str = ""
    """Its name as an identifier; by default that of the field."""
    short: str = ""
    """A second name of one letter, with its dash."""
    type: Any = None
    default: Any = None
    """Its default; by default that of the field, if `type` is that of the field."""
    parse: Callable[[Any], Any] = lambda value: value
    """Returns the value of the field for that of the option."""
    alone: tuple[str, ...] = ()
    """Its value if it is given without one, as for True, and its value for False."""
    path: tuple[str, ...] = ()
    """Names of the model (settings, discover or run), of the stage, if any, and of the field."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """Help text and range."""

    @property
    def flag(self) -> str:
        """Its long name, with its dashes."""
        return f"--{self.name.replace('_', '-')}"

    def value_of(self, value: Any) -> Any:
        """Return the value that True or False stands for, if the option may be given alone; else the value itself."""
        return self.alone[not value] if self.alone and isinstance(value, bool) else value


def option_of(name: str, of_field: FieldInfo) -> Option:
    """Return the option that the annotation of a field describes."""
    option = next((m for m in of_field.metadata if isinstance(m, Option)), Option())
    return replace(option, name=option.name or name)


_OPTIONS = ConfigDict(extra="forbid", use_attribute_docstrings=True, arbitrary_types_allowed=True)
_RELIEF, _RADIOMETRY = Option("relief", alone=("always", "never")), Option(alone=("auto", "off"))
_GLOBS = Option(type=list[str] | None, parse=lambda globs: tuple(globs or ()))


@validated.dataclass(frozen=True, config=_OPTIONS)
class DiscoverOptions:
    """Options of `discover` and `align_folder`: which files and bands are used.

    In Python, names and globs are tuples, instead of texts with commas or repeated options.

    Examples
    --------
    >>> options = agalign.DiscoverOptions(bands=("Red", "NIR"), exclude=("*_0002_*",))
    >>> [capture.name for capture in agalign.discover("flight", options).captures]
    ['IMG_0001']
    """

    pattern: str | None = None
    """File names of a camera that is not recognised, for example '{capture}_{band}.tif'."""
    reference: str | None = None
    """Reference band, to whose pixel grid the others are aligned; by default green."""
    ignore_metadata: bool = False
    """Ignore the lens and rig tags of the camera."""
    with_rgb: bool = False
    """Also align the camera's colour photograph (JPEG), as three bands."""
    bands: Annotated[tuple[str, ...], Option(type=str | None, parse=names_in)] = ()
    """Bands to align, separated by commas; by default all."""
    order: choices.BandOrder = "index"
    """Order of the bands: camera's numbers, wavelength or name."""
    skip: tuple[Path, ...] = ()
    """Folders to skip, such as the output folder."""
    max_pixels: Annotated[int, Field(ge=1)] = choices.MAX_PIXELS
    """Refuse images with more pixels, without reading them."""
    jobs: Annotated[int, Field(ge=0, le=choices.MAX_JOBS)] = 1
    """Number of processes that read tags, 0 for one per core; with more, the calling script must be importable."""
    timeout_s: Annotated[float | None, Field(ge=1, le=1e6)] = None
    """Seconds after which reading the tags of a file is abandoned; by default unlimited. Needs a separate process."""
    include: Annotated[tuple[str, ...], _GLOBS] = ()
    """Use only files that match this glob by path or name; repeatable."""
    exclude: Annotated[tuple[str, ...], _GLOBS] = ()
    """Ignore files that match this glob; repeatable."""


@validated.dataclass(frozen=True, config=_OPTIONS)
class RunOptions:
    """How to run. Two fields change results: with `align_panels`, calibration panels give no reflectance, and captures
    that take longer than `timeout_s` teach nothing and have none.

    In Python, `executor` is a concurrent.futures executor, such as that of `dask_executor`, instead of an address.

    Examples
    --------
    `settings` is that of the example of `align_folder`.

    >>> run = agalign.RunOptions(jobs=1, retry_failed=True)
    >>> reports = agalign.align_folder("flight", "aligned", settings=settings, run=run)
    >>> [report.state for report in reports]  # the run of the example has finished them
    ['kept', 'kept']
    """

    overwrite: bool = False
    """Process finished captures again."""
    jobs: Annotated[int, Field(ge=0, le=choices.MAX_JOBS), Option(short="-j", default=0)] = 1
    """Captures processed at the same time; 0 is one per core."""
    align_panels: bool = False
    """Also align captures of calibration panels and of the sky; panels then give no reflectance."""
    # Any concurrent.futures executor in Python, such as `agalign.dask_executor`.
    executor: Annotated[Executor | None, Option("dask", type=str | None)] = None
    """Address of a Dask scheduler, such as tcp://host:8786; 'local' starts workers on this machine."""
    retry_failed: bool = False
    """Process captures again whose status is not `ok`."""
    # An `executor` of the caller ignores it, except `dask_executor`.
    timeout_s: Annotated[float | None, Field(ge=1, le=1e6), Option("timeout")] = None
    """Seconds after which a capture, or the reading of the tags of a file, is abandoned; by default unlimited."""
    command: str = ""
    """Command line, for run record and report."""


class SettingsModel(BaseModel):
    """Base of the settings: immutable, and an unknown name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    @classmethod
    def flag(cls, field: str) -> str:
        """Return the long name of the command-line option of a field, with its dashes."""
        return option_of(field, cls.model_fields[field]).flag.replace("--start-", "--")  # --model sets `start_model`

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Return the fields that differ from their defaults."""
        for name, of_field in type(self).model_fields.items():
            if (value := getattr(self, name)) != of_field.get_default():
                yield name, value


class JointSettings(SettingsModel):
    """Joint optimisation of the descriptor and the homographies.

    Examples
    --------
    >>> joint = agalign.JointSettings(model_family="affine", rng_seed=7)
    >>> agalign.Settings(joint=joint)
    Settings(joint=JointSettings(model_family='affine', rng_seed=7))
    """

    recipe: choices.Recipe = "fast"
    """Algorithm: fast, the same from random network weights (scratch), or as published by Dong et al. 2018 (paper)."""
    sharing: choices.Sharing = "pseudo-siamese"
    """Network layers that both bands share: all (siamese), all but the first (pseudo-siamese) or none (unshared)."""
    model_family: choices.FamilyChoice = "auto"
    """Mapping to fit; auto uses the most general one that the images determine."""
    device: str = "auto"
    """Torch device: auto, cpu, cuda, cuda:1 …"""
    rng_seed: Annotated[int, Field(ge=0, le=choices.MAX_RNG_SEED)] = 0
    """Seed of the random number generator."""


class FlightSettings(SettingsModel):
    """One network and rig for the captures of a flight; `together=False` uses neither (option --each-alone).

    Examples
    --------
    >>> settings = agalign.Settings(flight=agalign.FlightSettings(together=False))
    >>> settings.flight.together
    False
    """

    together: Annotated[bool, Option("each_alone", default=False, parse=not_)] = True
    """Align each capture without the network and rig of its flight."""
    start_model: str = ""
    """Fingerprint of the model that a run starts from, set by `run_flight`; runs with another one repeat a capture."""


class SeedSettings(SettingsModel):
    """Initial alignment. In Python, `force=None` stands for `auto`.

    Examples
    --------
    >>> settings = agalign.Settings(seed=agalign.SeedSettings(force="rig"))
    >>> settings.seed.force, agalign.SeedSettings().force
    ('rig', None)
    """

    force: Annotated[
        choices.SeedKind | None,
        Option("seed", type=choices.SeedChoice, default="auto", parse=lambda kind: None if kind == "auto" else kind),
    ] = None
    """Initial alignment: by camera tags (rig), georeference (geo), image structure (structure), matched features
    (match), or none (identity); auto uses the one with the highest score."""
    only: Annotated[bool, Option("only_seed")] = False
    """Stop after the initial alignment."""


class CheckSettings(SettingsModel):
    """Acceptance of predicted bands.

    Examples
    --------
    >>> settings = agalign.Settings(check=agalign.CheckSettings(accept_predicted_px=0.5))
    >>> settings.check.accept_predicted_px
    0.5
    """

    # The limits of the checks are constants in `verify`.

    accept_predicted_px: Annotated[float, Field(ge=0, le=1e6), Option("accept_predicted")] = 1.0
    """Largest expected error, px of the band's file, of a predicted band that indices may use."""


class ReliefSettings(SettingsModel):
    """Correction of parallax over trees, terraces, buildings and benches.

    Examples
    --------
    >>> settings = agalign.Settings(relief=agalign.ReliefSettings(use="always"))
    >>> settings.relief.use
    'always'
    """

    # A single moving lens gets a smooth displacement field instead, if left-out windows confirm it: no other band can
    # verify its relief.
    use: Annotated[choices.ReliefUse, BeforeValidator(_RELIEF.value_of), _RELIEF] = "auto"
    """Correct parallax (trees, terraces, close range) by a parallax map or a displacement field: always, never, or if
    the windows show parallax (auto). --relief alone means always."""


class WriteSettings(SettingsModel):
    """Output files.

    In Python, `indices` is a tuple of names, and `panel_albedo` a tuple of (band in lower case, reflectance), where an
    empty name stands for all other bands.

    Examples
    --------
    >>> agalign.WriteSettings(layout="bands", indices=("ndvi", "ndre"), radiometry="panel", panel_albedo=(("", 0.51),))
    WriteSettings(layout='bands', indices=('ndvi', 'ndre'), radiometry='panel', panel_albedo=(('', 0.51),))
    >>> agalign.WriteSettings().interpolation, agalign.WriteSettings().compression
    ('lanczos', 'auto')
    """

    # RMS error on a random image of waves of up to 0.25 cycles/px, relative to its standard deviation: Lanczos 1.4 %,
    # OpenCV's cubic kernel 3.0 %, bilinear 16 %.
    interpolation: choices.Interpolation = "lanczos"
    """Resampling of the moving bands."""
    crop: choices.Crop = "flight"
    """Area to write: covered by all bands in all captures of a camera (flight; without a rig, as of two captures:
    common) or in this capture (common), or the whole reference band (none)."""
    format: choices.RasterFormat = "gtiff"
    """Tiled GeoTIFF or cloud-optimised GeoTIFF."""
    compression: choices.Compression = "auto"
    """Lossless compression; auto is zstd for stacks, else deflate."""
    undistort: bool = False
    """Remove the lens distortion of the reference band from the output."""
    layout: choices.Layout = "stack"
    """Write one multiband file per capture (stack), one file with the camera's tags per band (bands), or both."""
    resolution: choices.Resolution = "reference"
    """Pixel size: of the reference band, or the smallest of all bands (finest)."""
    georeference: bool = False
    """Write an approximate georeference from GPS, altitude and yaw."""
    ground_elevation_m: Annotated[float | None, Field(ge=-1000, le=9000), Option("ground_elevation")] = None
    """Elevation of the ground, m, in the GPS height system, if the tags lack the height above ground."""
    statistics: bool = False
    """Store statistics (minimum, maximum, mean, standard deviation) in the files."""
    qa: bool = False
    """Write quality flags (saturated, occluded, predicted …): <capture>.qa.tif."""
    indices: Annotated[
        tuple[str, ...],
        Option("index", type=str | None, parse=names_in),
        AfterValidator(lambda names: tuple(name.strip().lower() for name in names)),
    ] = ()
    """Spectral indices, separated by commas: ndvi, ndre …; 'agalign indices' computes others later."""
    pan_sharpen: bool = False
    """Write <capture>.pan.tif: the bands at the resolution of the panchromatic band, or with --with-rgb of the
    photograph."""
    error_map: bool = False
    """Write the expected error of each pixel: <capture>.error.tif."""
    tie_points: bool = False
    """Write the tie points: <capture>.ties.csv and .ties.geojson."""
    relief_map: bool = False
    """Add confidence and range (m) to <capture>.relief.tif."""
    fill_occluded: bool = False
    """Interpolate occluded pixels; by default they are nodata."""
    radiometry: Annotated[choices.RadiometryChoice, BeforeValidator(_RADIOMETRY.value_of), _RADIOMETRY] = "off"
    """Convert raw numbers to radiance (camera), or to reflectance by the light sensor (sun) or by a calibration panel
    and the light sensor, if any (panel). auto, or --radiometry alone: the first that all bands have of panel with
    light sensor, sun, panel alone, camera. Thermal bands become degrees C."""
    # (band in lower case, reflectance); an empty name means all other bands.
    panel_albedo: Annotated[
        tuple[tuple[str, Annotated[float, Field(gt=0, le=1)]], ...],
        Option(type=str | None, parse=albedos),
        AfterValidator(_one_of_each_band),
    ] = ()
    """Reflectance of the calibration panel, such as 0.51 or Blue=0.51,NIR=0.49, instead of that in tags or QR code."""


class Settings(SettingsModel):
    """All settings that change results, one immutable model for each stage.

    An unknown name or an invalid value raises pydantic's ValidationError.

    Examples
    --------
    >>> settings = agalign.Settings(write=agalign.WriteSettings(format="cog", qa=True))
    >>> settings.write.format, settings.write.interpolation
    ('cog', 'lanczos')
    """

    seed: SeedSettings = SeedSettings()
    joint: JointSettings = JointSettings()
    flight: FlightSettings = FlightSettings()
    check: CheckSettings = CheckSettings()
    relief: ReliefSettings = ReliefSettings()
    write: WriteSettings = WriteSettings()

    @property
    def for_mosaics(self) -> "Settings":
        """The settings for mosaics, which are not captures of one flight and keep the grid of their reference."""
        flight = self.flight.model_copy(update={"together": False})
        return self.model_copy(update={"flight": flight, "write": self.write.model_copy(update={"crop": "none"})})

    @property
    def learns_flights(self) -> bool:
        """True if one network is learned for a flight before its captures are aligned."""
        return self.joint.recipe != "paper" and self.flight.together and not self.seed.only
