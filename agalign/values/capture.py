"""What a camera's files hold, as their tags say: the bands of a moment, their lenses and places."""

from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from agalign.values.geometry import Matrix
from agalign.values.lens import Lens


@dataclass(frozen=True)
class Georeference:
    """Georeference of a raster: `transform` maps (column, row, 1) with (0, 0) the CORNER of the top-left pixel,
    as GDAL and rasterio have it, to map units of `crs_wkt`.
    """

    transform: Matrix
    crs_wkt: str
    accuracy_m: float | None = None
    """Expected error (1 sigma, metres) where it was calculated from the camera's pose; None for a file's own."""


Quantity = Literal["radiance", "relative radiance", "reflectance", "relative reflectance", "temperature"]
"""Radiance in W / m^2 / sr / nm, reflectance 0 to 1, each of the two up to a factor that all bands share, and
temperature in degrees Celsius.
"""


RadiometrySource = Literal["camera calibration", "light sensor", "panel"]


@dataclass(frozen=True)
class Radiometry:
    """What turns a band's raw numbers into a physical quantity; `pixels.radiometry` has the equation."""

    quantity: Quantity
    black_level: float
    full_scale: float
    gain: float
    vignetting_centre_px: tuple[float, float] = (0.0, 0.0)
    vignetting: tuple[float, ...] = ()
    """k1 ... k6, per px, px^2 ..."""
    vignetting_divides: bool = True
    row_gradient: float = 0.0
    """Share of the signal that each row has more than the one above it."""
    by_sun: tuple[float, Quantity] | None = None
    """What radiance is to be multiplied by for reflectance, by the light sensor, and which kind of it that gives."""
    source: RadiometrySource = "camera calibration"
    """What made reflectance of radiance, if anything did."""

    @property
    def is_of_light(self) -> bool:
        """True for what reflectance can be made of."""
        return self.quantity in ("radiance", "relative radiance")


PanelSource = Literal["tags", "QR code", "look"]


@dataclass(frozen=True)
class Panel:
    """A calibration panel in a band's image."""

    seen_by: PanelSource
    serial: str = ""
    albedo: float | None = None
    """Its reflectance in the band, 0 to 1, where that is known."""
    corners_px: tuple[tuple[float, float], ...] = ()
    """Of an area within it, raw pixels of the file; none where it was not found."""
    in_scene: bool = False
    """The camera was not aimed at it: the image shows a scene that contains a panel."""


@dataclass(frozen=True)
class Band:
    """One band of a capture: where its pixels are, and its metadata."""

    name: str
    path: Path
    band_index: int
    """Index within the file, from 1."""
    width_px: int
    height_px: int
    dtype: str
    nodata: float | None = None
    has_mask: bool = False
    """True if the file has a mask or an alpha band."""
    wavelength_nm: float | None = None
    bandwidth_nm: float | None = None
    saturation_value: float | None = None
    """Raw value at and above which a pixel is taken as saturated."""
    lens: Lens | None = None
    to_rig: Matrix | None = None
    """Homography from this file's undistorted pixels (raw ones without a lens model) to a plane that all bands of the
    rig share, as far as the tags tell."""
    other_to_rig: Matrix | None = None
    """The same as other tags of the file have it, where makers give two."""
    parallax: tuple[float, float] | None = None
    """Direction in which its pixels move as the ground comes nearer, right and down, relative to the rig's other bands;
    in any unit."""
    lens_offset_m: tuple[float, float] | None = None
    """Position of the lens right of and below the rig's origin, metres; None where the tags do not give it."""
    one_lens: bool = False
    """The file's bands come through one lens and are aligned as one."""
    companion: bool = False
    """Part of a colour photograph: used only on request."""
    georeference: Georeference | None = None
    scale_offset: tuple[float, float] = (1.0, 0.0)
    """Factor for the numbers of the file, and offset to add then."""
    overviews: tuple[int, ...] = ()
    """Reductions at which the file holds the band too."""
    radiometry: Radiometry | None = None
    panel: Panel | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width_px, self.height_px

    @property
    def address(self) -> str:
        """The file's name, with the band's index where the file has several."""
        return self.path.name if self.band_index == 1 else f"{self.path.name}[{self.band_index}]"


@dataclass(frozen=True)
class Position:
    """Where the camera was: WGS 84, degrees, and metres as the camera has them."""

    latitude: float
    longitude: float
    altitude_m: float | None = None


HeightSource = Literal["tags", "panel", "ground elevation", "assumed"]


@dataclass(frozen=True)
class Pose:
    """How the camera hung when a capture was taken."""

    heading_deg: float
    """Of the image's upward direction, clockwise from north."""
    pitch_deg: float = 0.0
    """By how much it looked ahead of straight down."""
    roll_deg: float = 0.0
    """How far it looked to the left of that: positive if the right side of the aircraft is down."""
    height_m: float | None = None
    """Above the ground."""
    focal_length_px: float | None = None
    """Of the reference."""
    height_from: HeightSource = "tags"
    """What `height_m` was derived from."""


@dataclass(frozen=True)
class CameraIdentity:
    """What made the images, as far as their tags say."""

    make: str = ""
    model: str = ""
    serial: str = ""


@dataclass(frozen=True)
class Capture:
    """All bands of one moment; one of them is the reference."""

    name: str
    folder: Path
    """Folder below the input folder, relative to it: where the outputs go below the output folder."""
    bands: tuple[Band, ...]
    reference_index: int
    camera: CameraIdentity = field(default_factory=CameraIdentity)
    capture_id: str = ""
    flight_id: str = ""
    captured_at: str = ""
    position: Position | None = None
    pose: Pose | None = None
    motion: tuple[float, float] | None = None
    """How fast the ground passes through the image, right and down, focal lengths a second, as far as the tags tell."""
    missing_bands: tuple[str, ...] = ()
    elevation_deg: float | None = None
    """Angle of the optical axis above the horizon: -90 straight down; None where the tags do not give it."""

    @property
    def reference(self) -> Band:
        """The reference band."""
        return self.bands[self.reference_index]

    @property
    def moving(self) -> tuple[Band, ...]:
        """All bands but the reference."""
        return tuple(b for i, b in enumerate(self.bands) if i != self.reference_index)

    @property
    def moving_lenses(self) -> list[tuple[Band, ...]]:
        """The moving bands, those together that one lens took; without those that the reference's own lens took."""
        groups: dict[object, list[Band]] = {}
        for index, band in enumerate(self.moving):
            if not self._is_of_the_references_lens(band):
                groups.setdefault(band.path if band.one_lens else index, []).append(band)
        return [tuple(group) for group in groups.values()]

    @property
    def bands_of_the_references_lens(self) -> list[Band]:
        """Moving bands that lie on the reference by construction."""
        return [b for b in self.moving if self._is_of_the_references_lens(b)]

    def _is_of_the_references_lens(self, band: Band) -> bool:
        return band.one_lens and band.path == self.reference.path

    @property
    def panel(self) -> Panel | None:
        """The calibration panel in it, as the first band that shows it has it."""
        return next((b.panel for b in self.bands if b.panel is not None), None)

    @property
    def is_of_a_panel(self) -> bool:
        """True for a capture that was taken of a calibration panel; False where a scene contains one."""
        return self.panel is not None and not self.panel.in_scene

    @property
    def time_s(self) -> float | None:
        """Seconds from 1970 to the capture, UTC where `captured_at` names no time zone; None where it is unknown."""
        with suppress(ValueError):
            moment = datetime.fromisoformat(self.captured_at)
            return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        return None

    @property
    def label(self) -> str:
        """The capture's name below its folder, with forward slashes."""
        return (self.folder / self.name).as_posix()
