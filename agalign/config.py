"""Settings: one immutable, validated model for each stage.

An unknown name or an invalid value raises pydantic's ValidationError. docs/options.md lists all settings. Other
parameters are constants in the modules that use them, with their reasons.
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
        """Return the fields that differ from their defaults."""
        for name, field in type(self).model_fields.items():
            if (value := getattr(self, name)) != field.get_default():
                yield name, value


class JointSettings(Stage):
    """Joint optimisation of the descriptor and the homographies."""

    recipe: Recipe = "fast"
    """`paper` is the published algorithm; `fast` gives the same result sooner."""
    sharing: Sharing = "pseudo-siamese"
    """Layers that the networks of reference and moving band share: all (siamese), all but the first (pseudo-siamese),
    or none (unshared)."""
    model_family: FamilyChoice = "auto"
    """Mapping to fit; `auto` is the most general one that the images determine."""
    device: str = "auto"
    """Torch device: cpu, cuda, cuda:1 and so on; `auto` is CUDA if it is available."""
    rng_seed: Annotated[int, Field(ge=0, le=MAX_RNG_SEED)] = 0
    """The same seed gives the same result, bit by bit."""


class FlightSettings(Stage):
    """One network for many captures."""

    together: bool = True
    """False learns a network for each capture."""
    start: str = ""
    """Fingerprint of the model that a run starts from, set by `run_flight`; runs with another one repeat a capture."""


class SeedSettings(Stage):
    """Initial alignment."""

    force: SeedKind | None = None
    """Use only this kind of seed."""
    only: bool = False
    """Stop after the initial alignment."""


class CheckSettings(Stage):
    """Acceptance of predicted bands. The limits of the checks are in their modules in `verify`."""

    accept_predicted_px: Annotated[float, Field(ge=0)] = 1.0
    """Largest standard error at which a predicted band counts as usable, px of its file."""


class ReliefSettings(Stage):
    """Correction of parallax over trees, terraces, buildings and benches."""

    use: ReliefUse = "auto"
    """`auto` estimates one relief for all bands of a capture if its windows show parallax. A single moving lens, whose
    relief no other band can verify, gets a smooth displacement field instead, if left-out windows confirm it."""

    @field_validator("use", mode="before")
    @classmethod
    def _yes_or_no(cls, value: object) -> object:
        return {True: "always", False: "never"}.get(value, value) if isinstance(value, bool) else value


class WriteSettings(Stage):
    """Output files."""

    interpolation: Interpolation = "lanczos"
    """RMS error on a random image of waves of up to 0.25 cycles/px, relative to its standard deviation: Lanczos 1.4 %,
    OpenCV's cubic kernel 3.0 %, bilinear 16 %."""
    crop: Crop = "flight"
    """Area to write: shared by all bands of all captures (`flight`), by all bands of the capture (`common`), or the
    whole frame of the reference (`none`)."""
    format: RasterFormat = "gtiff"
    compression: Compression = "auto"
    """auto is Zstandard for stacks and Deflate for files of single bands."""
    undistort: bool = False
    """Remove the lens distortion of the reference from the output."""
    layout: Layout = "stack"
    """One stack per capture, one file per input file, or both."""
    resolution: Resolution = "reference"
    """Pixel size of the output: that of the reference, or of the finest band."""
    georeference: bool = False
    """Write an approximate georeference from position, altitude, yaw and focal length."""
    ground_elevation_m: float | None = None
    """Elevation of the ground in the height system of the camera's GPS, if neither tags nor a panel give the height."""
    statistics: bool = False
    """Store minimum, maximum, mean and standard deviation of the aligned bands in their files."""
    qa: bool = False
    """Write a raster of quality flags."""
    stac: bool = False
    """Write a STAC item for each capture."""
    indices: tuple[str, ...] = ()
    """Names of the spectral indices to write, such as ndvi and ndre."""
    pan_sharpen: bool = False
    """Also write the narrow bands at the resolution of the panchromatic band."""
    error_map: bool = False
    """Write a raster of the expected error at every pixel."""
    tie_points: bool = False
    """Write the measured windows of each band as CSV and GeoJSON."""
    relief_map: bool = False
    """Add confidence and range to the raster of the relief."""
    fill_occluded: bool = False
    """Interpolate pixels that are occluded in a band, instead of writing nodata."""
    radiometry: RadiometryChoice = "off"
    """Write float32 instead of raw numbers: radiance by the camera's calibration (`camera`), reflectance by light
    sensor (`sun`) or by panel; `auto` is panel if available for all bands, else sun, else camera. Thermal bands are
    written in degrees C.
    """
    panel_albedo: tuple[tuple[str, Annotated[float, Field(gt=0, le=1)]], ...] = ()
    """(band in lower case, reflectance 0 to 1) of the calibration panel; an empty name stands for all other bands. It
    takes precedence over tags and QR code. If it is given, panels without tags and code are recognised too."""

    @field_validator("radiometry", mode="before")
    @classmethod
    def _yes_or_no(cls, value: object) -> object:
        return {True: "auto", False: "off"}.get(value, value) if isinstance(value, bool) else value


class Settings(Stage):
    """All settings that change results."""

    seed: SeedSettings = SeedSettings()
    joint: JointSettings = JointSettings()
    flight: FlightSettings = FlightSettings()
    check: CheckSettings = CheckSettings()
    relief: ReliefSettings = ReliefSettings()
    write: WriteSettings = WriteSettings()

    @property
    def learns_flights(self) -> bool:
        """True if one network is learned for a flight before its captures are aligned."""
        return self.joint.recipe == "fast" and self.flight.together and not self.seed.only
