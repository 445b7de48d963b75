"""What a user chooses: one frozen, validated object for each stage.

An unknown name or an impossible value raises pydantic's ValidationError. docs/options.md lists all settings. Other
numbers that decide something are constants in the module that uses them, with their reasons.
"""

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from agalign.values.choices import (
    MAX_RNG_SEED,
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
    SeedKind,
    Sharing,
)

Positive = Annotated[int, Field(gt=0)]


class Stage(BaseModel):
    """Base of the settings: immutable, and an unknown name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Print only what differs from the defaults."""
        for name, field in type(self).model_fields.items():
            if (value := getattr(self, name)) != field.get_default():
                yield name, value


class JointSettings(Stage):
    """Joint optimisation of the descriptor and the homographies."""

    recipe: Recipe = "fast"
    """`paper` follows the published algorithm step by step; `fast` reaches the same result sooner."""
    sharing: Sharing = "pseudo-siamese"
    """Layers that the descriptors of the reference and of a moving band share: all (siamese), all but the first
    (pseudo-siamese), or none (unshared)."""
    model_family: FamilyChoice = "auto"
    """Mappings to fit; `auto` takes the richest one that the images determine."""
    device: str = "auto"
    """Of torch: cpu, cuda, cuda:1 and so on; `auto` is CUDA where it is available."""
    rng_seed: Annotated[int, Field(ge=0, le=MAX_RNG_SEED)] = 0
    """The same seed gives the same result, bit by bit."""


class FlightSettings(Stage):
    """One network for many captures."""

    together: bool = True
    """False learns every capture alone."""
    start: str = ""
    """Fingerprint of the model that a run starts from, set by `run_flight`: a result is kept only by runs with it."""


class SeedSettings(Stage):
    """Coarse alignment."""

    force: SeedKind | None = None
    """Use this kind of seed whatever its score."""
    only: bool = False
    """Stop at the seed: nothing is learnt or optimised."""


class CheckSettings(Stage):
    """What counts as delivered. The limits of each check are in its module in `verify`."""

    accept_predicted_px: Annotated[float, Field(ge=0)] = 1.0
    """Largest standard error of a predicted band that counts as delivered, px of its file."""


class ReliefSettings(Stage):
    """Parallax beyond the homography, over trees, terraces, buildings and benches."""

    use: ReliefUse = "auto"
    """`auto` estimates one relief for all bands of a capture where its windows show parallax. A band that has no other
    to be verified by gets a smooth displacement field, where parallax may be the only reason against it or where no rig
    of a flight knows the distortion that the lenses leave."""

    @field_validator("use", mode="before")
    @classmethod
    def _yes_or_no(cls, value: object) -> object:
        return {True: "always", False: "never"}.get(value, value) if isinstance(value, bool) else value


class WriteSettings(Stage):
    """The aligned stacks."""

    interpolation: Interpolation = "lanczos"
    """RMS error on a random image of waves of up to 0.25 cycles/px, relative to its standard deviation: Lanczos 1.4 %,
    OpenCV's cubic kernel 3.0 %, bilinear 16 %."""
    crop: Crop = "flight"
    """The area that all bands share in all captures of the flight, where its rig is known, or in each by itself; or
    none."""
    format: RasterFormat = "gtiff"
    compression: Compression = "auto"
    """auto is Zstandard for stacks and Deflate for files of single bands."""
    undistort: bool = False
    """Write the lens-corrected grid of the reference instead of its own."""
    layout: Layout = "stack"
    """One file a capture, one for each of its files, or both."""
    resolution: Resolution = "reference"
    """The reference's own pixels, or as many more as the finest band has."""
    georeference: bool = False
    """Give rasters of single captures an approximate georeference, by position, altitude, yaw and focal length."""
    ground_elevation_m: float | None = None
    """Of the ground, in the altitudes of the camera's GPS: for heights where neither tags nor a panel give them."""
    statistics: bool = False
    """Store minimum, maximum, mean and standard deviation of each band in the rasters, as `gdalinfo -stats` does."""
    qa: bool = False
    """A raster of quality flags next to them."""
    stac: bool = False
    """A STAC item for each capture."""
    indices: tuple[str, ...] = ()
    """Names of the spectral indices to write of each capture, such as ndvi and ndre."""
    pan_sharpen: bool = False
    """The narrow bands at the panchromatic band's resolution, in addition to the others."""
    error_map: bool = False
    """A raster of the expected error at every pixel."""
    tie_points: bool = False
    """The windows in which each band was measured, as CSV and GeoJSON."""
    relief_map: bool = False
    """The confidence and the range of the relief in its raster, next to the parallax."""
    fill_occluded: bool = False
    """Interpolate pixels that nearer parts of the scene occlude in a band, instead of nodata."""
    radiometry: RadiometryChoice = "off"
    """Write float32 instead of raw numbers: radiance as the camera's own calibration has it, reflectance by the light
    sensor, or by a panel; auto is the last of these that every band can be given. Thermal bands are in degrees C then.
    """
    panel_albedo: tuple[tuple[str, Annotated[float, Field(gt=0, le=1)]], ...] = ()
    """Reflectance of the calibration panel, 0 to 1, by band in lower case, or for all others by the empty name; before
    what tags or its code say. Where it is given, a panel is also known by its looks."""

    @field_validator("radiometry", mode="before")
    @classmethod
    def _yes_or_no(cls, value: object) -> object:
        return {True: "auto", False: "off"}.get(value, value) if isinstance(value, bool) else value


class Settings(Stage):
    """Everything that a run depends on."""

    seed: SeedSettings = SeedSettings()
    joint: JointSettings = JointSettings()
    flight: FlightSettings = FlightSettings()
    check: CheckSettings = CheckSettings()
    relief: ReliefSettings = ReliefSettings()
    write: WriteSettings = WriteSettings()

    @property
    def learns_flights(self) -> bool:
        """True where one network is learnt for a flight before its captures."""
        return self.joint.recipe == "fast" and self.flight.together and not self.seed.only
