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
    LocalUse,
    RadiometryChoice,
    RasterFormat,
    Recipe,
    Resolution,
    SeedKind,
    Sharing,
)
from agalign.values.issues import Issue

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
    working_px: Positive = 384
    """Longer side of the images on which seeds are scored."""
    smoothing_px: float = 1.0
    min_overlap: float = 0.2
    """Share of the reference that the moving image must cover for a candidate to be scored."""
    trusted_sigma: float = 12.0
    """Correlation peak, in standard deviations, of a seed that is good to a few pixels. Unrelated images reach 9."""
    trusted_ratio: float = 1.5
    """How far a trusted seed's peak must stand above the second highest."""
    min_shift_px: float = 0.25
    """Structure shifts below this, in working px, are noise and leave a candidate as it is."""


class CheckSettings(Stage):
    """What an alignment must show to be called `aligned`. docs/method.md has the figures behind the limits."""

    tile_px: Positive = 112
    """Side of the windows in which residual shifts are measured."""
    smoothing_px: float = 1.0
    min_strength: float = 0.05
    """Mean structure below which a window holds nothing to measure."""
    min_peak_sigma: float = 7.0
    """Correlation peak, in standard deviations of its surface, from which a window's shift is believed."""
    min_retrieval: float = 0.2
    """Held-out retrieval; chance is below 0.01, unrelated images reach 0.05."""
    min_times_chance: float = 5.0
    """The same in multiples of what guessing gives, where few keypoints could be drawn."""
    max_residual_px: float = 1.0
    """Median length of the windows' residual shifts."""
    min_coverage: float = 0.6
    """Share of the windows with structure in which a shift could be measured."""
    min_close: float = 0.9
    """Share of the windows in which a shift was measured where it is at most `max_residual_px`."""
    min_cluster: Positive = 5
    """So many windows beside each other that lie farther apart are a place that is not aligned,"""
    max_cluster: float = 0.04
    """where they are also this share of those measured."""
    max_alias_peak: float = 0.75
    """Height of the next correlation peak over that of the place found, from which the scene is taken to repeat."""
    min_windows: Positive = 4
    min_seed_coverage: float = 0.3
    """The same as `min_coverage` for a seed that is used as it is."""
    max_seed_residual_px: float = 8.0
    """The same as `max_residual_px` for a seed that is used as it is."""
    max_corner_std_px: float = 2.0
    """Standard deviation of the mapped corners."""
    max_unexpected_px: float = 3.0
    """An alignment farther than this from what the flight's rig says is not believed,"""
    max_unexpected_std: float = 5.0
    """where that is also so many of the prediction's standard deviations."""
    accept_predicted_px: Annotated[float, Field(ge=0)] = 1.0
    """A band whose place the rig predicts this well counts as delivered."""
    max_snap_px: float = 0.25
    """An input already aligned is left untouched where the result is within three standard deviations of no change,
    and within this."""


class LocalScale(Stage):
    """How fine a field of displacements is, px."""

    window_px: Positive
    """Side of the windows in which shifts are measured, half of which they overlap."""
    lattice_px: Positive


class LocalSettings(Stage):
    """A smooth field of displacements over the homography, for parallax over trees, terraces and buildings."""

    use: LocalUse = "auto"
    """auto fits a field where nothing but some windows that lie apart stands against an alignment, and where no rig of
    a flight knows what the lenses leave."""
    scale: LocalScale = LocalScale(window_px=64, lattice_px=48)
    finer_scale: LocalScale = LocalScale(window_px=32, lattice_px=24)
    """For what stands so high above the ground that the first cannot follow it."""
    max_windows: Positive = 4000
    """In larger images they lie farther apart."""
    smoothness: tuple[float, ...] = (0.3, 1.0, 4.0, 16.0, 64.0)
    """Weights of the field's second differences beside one window's shift, of which the windows left out of a fit
    choose."""
    pull: float = 0.003
    """The same of its own length."""
    min_spread_px: float = 0.05
    outlier_spreads: float = 4.0
    """A window that the field misses by so many times what it misses most by has half a vote."""
    reweightings: Positive = 4
    rounds: Positive = 2
    max_rounds: Positive = 4
    settled_px: float = 0.2
    """Median of what the windows still show, above which there are as many rounds."""
    min_windows: Positive = 24
    min_gain_sigma: float = 4.0
    """A field is kept where the squared shifts of windows left out of its fit fall by so many standard errors, and
    their 95th percentile does not rise."""

    @field_validator("use", mode="before")
    @classmethod
    def _yes_or_no(cls, value: object) -> object:
        return {True: "always", False: "never"}.get(value, value) if isinstance(value, bool) else value

    def is_wanted_for(self, issues: tuple[Issue, ...], *, rig_known: bool) -> bool:
        """True where a field is to be tried for a result that has these doubts."""
        mendable = all(d.kind in ("close_windows", "cluster", "residual_px") for d in issues)
        return mendable and (self.use == "always" or (self.use == "auto" and (bool(issues) or not rig_known)))


class WriteSettings(Stage):
    """The aligned stacks."""

    interpolation: Interpolation = "lanczos"
    """Lanczos has half the error of OpenCV's cubic kernel on band-limited images, bilinear five times as much:
    docs/method.md has the figures."""
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
    stac: bool = False
    """A STAC item beside each capture's files."""
    pan_sharpen: bool = False
    """The narrow bands at the panchromatic band's resolution, beside the others."""
    error_map: bool = False
    """A raster of the error to be expected at every pixel, beside them."""
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
    local: LocalSettings = LocalSettings()
    write: WriteSettings = WriteSettings()

    @property
    def learns_flights(self) -> bool:
        """True where one network is learnt for a flight before its captures."""
        return self.joint.recipe == "fast" and self.flight.together and not self.seed.only
