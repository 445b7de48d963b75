"""Captures and their bands, with the metadata from the tags of the files."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import dataclasses as validated

from agalign.errors import Reason
from agalign.values.fields import RECORD, Name, Number, equal
from agalign.values.geometry import Matrix
from agalign.values.image import Tile
from agalign.values.lens import Lens
from agalign.values.pixel_units import PixelScale
from agalign.values.radiometry import Radiometry


@dataclass(frozen=True)
class Georeference:
    """Georeference of a raster: `transform` maps (column, row, 1) with (0, 0) the CORNER of the top-left pixel,
    as in GDAL and rasterio, to map units of `crs_wkt`.
    """

    transform: Matrix
    crs_wkt: str
    accuracy_m: float | None = None
    """Expected error (1 sigma, metres) if it was calculated from the camera's pose; None if it is from the file."""


class CaptureTime(NamedTuple):
    """The time of a capture."""

    utc: datetime
    """In UTC; the clock of the camera as it is if its time zone is unknown."""
    source: Literal["camera", "clock of the camera (time zone unknown)"]

    @classmethod
    def of(cls, captured_at: str) -> "CaptureTime | None":
        """Return the time in `Capture.captured_at`; None for another text."""
        with suppress(ValueError, OverflowError):
            moment = datetime.fromisoformat(captured_at)
            if moment.tzinfo is None:
                return cls(moment.replace(tzinfo=UTC), "clock of the camera (time zone unknown)")
            return cls(moment.astimezone(UTC), "camera")
        return None


MIN_APART_S = 2.0
"""Between the exposures of two bands that are not of one moment: times in tags may have whole seconds, and those of one
capture differ by less.
"""


def is_clock_set(time: str) -> bool:
    """Return False for a time, which begins with the year, of a clock that was not set: cameras count from 1970."""
    return time >= "1971"


def known_time_s(captured_at: str) -> float | None:
    """Return the Unix time of `Capture.captured_at`; None if it is unknown or the clock was not set."""
    time = CaptureTime.of(captured_at) if is_clock_set(captured_at) else None
    return None if time is None else time.utc.timestamp()


PanelSource = Literal["tags", "QR code", "look"]


@dataclass(frozen=True)
class Panel:
    """A calibration panel in a band's image."""

    seen_by: PanelSource
    serial: str = ""
    albedo: float | None = None
    """Its reflectance in the band, 0 to 1, if known."""
    corners_px: tuple[tuple[float, float], ...] = ()
    """Corners of an area within it, raw px of the file; empty if it was not found."""
    in_scene: bool = False
    """The image shows a scene that contains the panel, instead of the panel alone, or only one cue indicates a panel:
    it is aligned."""
    cues: tuple[str, ...] = ()
    """Evidence that the image shows a panel, in words."""

    def rescaled(self, scale: PixelScale) -> "Panel":
        """Return the panel in the image resized by `scale`."""
        return replace(self, corners_px=tuple((x, y) for x, y in map(scale.positions, self.corners_px)))


@dataclass(frozen=True)
class Band:
    """One band of a capture: its file and its metadata.

    Examples
    --------
    >>> capture = agalign.discover("flight").captures[0]
    >>> nir = next(band for band in capture.bands if band.name == "NIR")
    >>> nir.size_px, nir.dtype, nir.wavelength_nm
    ((480, 360), 'uint16', 840.0)
    >>> nir.address, nir.lens is not None
    ('IMG_0001_4.tif', True)
    """

    name: str
    """Name of the band, such as NIR; unique in its capture."""
    path: Path
    """Image file."""
    band_index: int
    """Index within the file, from 1; the page, if each band has a page of its own."""
    width_px: int
    """Width of the image."""
    height_px: int
    """Height of the image."""
    dtype: str
    """Type of the pixels, such as uint16."""
    nodata: float | None = None
    """Value of pixels without data; None if the file declares none."""
    has_mask: bool = False
    """True if the file has a mask or an alpha band."""
    colour: str = ""
    """Red, Green or Blue for the channels of a colour image."""
    page: int = 0
    """Number of its page in a TIFF with several, from 1; 0 in files with one."""
    wavelength_nm: float | None = None
    """Central wavelength; None if it is unknown."""
    bandwidth_nm: float | None = None
    """Width of the spectral band; None if it is unknown."""
    saturation_value: float | None = None
    """Raw value at and above which a pixel counts as saturated."""
    lens: Lens | None = None
    """Lens model from the tags."""
    to_rig: Matrix | None = None
    """Homography from this file's undistorted pixels (raw ones without a lens model) to a plane that all bands of the
    rig share, from the tags."""
    other_to_rig: Matrix | None = None
    """The same from other tags of the file, if the maker writes both."""
    parallax_direction: tuple[float, float] | None = None
    """Direction (right, down) in which its pixels move as the range decreases, relative to the other bands of the rig,
    in any unit."""
    lens_offset: tuple[float, float] | None = None
    """Position of the lens right of and below the rig's origin, in the unit of `cameras.pix4d.rig_unit_m`; None if the
    tags do not contain it."""
    one_lens: bool = False
    """The bands of the file share one lens and are aligned as one."""
    is_from_photograph: bool = False
    """Part of a colour photograph: used only on request."""
    georeference: Georeference | None = None
    """Georeference of the file."""
    scale_offset: tuple[float, float] = (1.0, 0.0)
    """(scale, offset): value = scale * number in the file + offset."""
    missing: tuple[Tile, ...] = ()
    """Parts at the end of a damaged file that it has no pixels of: all have one value. Known of the bands that
    `pixels.raster.with_facts_of_pixels` returns."""
    overviews: tuple[int, ...] = ()
    """Reduction factors of the overviews in the file."""
    radiometry: Radiometry | None = None
    """Radiometric calibration from the tags."""
    missing_calibration: str = ""
    """Why it has no radiometric calibration, with the missing tags; empty if it has one or the camera has none."""
    implausible: str = ""
    """Tag that is implausible or lacking, which leaves out `radiometry` or its factor to reflectance, in words."""
    panel: Panel | None = None
    """Calibration panel in the image."""
    has_other_lens: bool = False
    """True if lens and vignetting in its file are those of another image, which a program cropped or resized."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width_px, self.height_px

    @property
    def missing_rows(self) -> int:
        """Number of rows at the end of the image that lack pixels, all or some."""
        return self.height_px - min((part.y0 for part in self.missing), default=self.height_px)

    @property
    def index_in_page(self) -> int:
        """Index within the file or the page that `open_raster` opens, from 1."""
        return 1 if self.page else self.band_index

    @property
    def address(self) -> str:
        """The file's name, followed by the band's index unless that is 1."""
        return self.path.name if self.band_index == 1 else f"{self.path.name}[{self.band_index}]"


@validated.dataclass(frozen=True, config=RECORD)
class Position:
    """GPS position of the camera.

    Examples
    --------
    >>> position = agalign.discover("flight").captures[0].position
    >>> position.latitude, position.longitude, round(position.altitude_m, 1)
    (52.0, 5.0, 23.0)
    >>> position.text
    '52.0000 N, 5.0000 E'
    """

    latitude: Number
    """Degrees, WGS 84."""
    longitude: Number
    """Degrees, WGS 84."""
    altitude_m: Number | None = None
    """Altitude in the tags, m above the camera's datum."""

    @property
    def text(self) -> str:
        """Latitude and longitude with the letters of the hemispheres."""
        north, east = "NS"[self.latitude < 0], "EW"[self.longitude < 0]
        return f"{abs(self.latitude):.4f} {north}, {abs(self.longitude):.4f} {east}"


def relative_parallax(reference: Band, moving: Band) -> tuple[float, float] | None:
    """Return the difference of the directions of parallax of two bands of a rig; None if unknown."""
    if reference.parallax_direction is None or moving.parallax_direction is None:
        return None
    (x, y), (reference_x, reference_y) = moving.parallax_direction, reference.parallax_direction
    return x - reference_x, y - reference_y


def distance_km(one: Position, other: Position) -> float:
    """Return the distance on the ground by the haversine formula with the mean radius, which is accurate to 0.5 %."""
    at = np.radians([[place.longitude, place.latitude] for place in (one, other)])
    x, y = np.sin((at[1] - at[0]) / 2) ** 2
    return float(2 * 6371.0 * np.arcsin(np.sqrt(min(1.0, y + np.cos(at[:, 1]).prod() * x))))


HeightSource = Literal["tags", "panel", "ground elevation", "assumed"]


@validated.dataclass(frozen=True, config=RECORD)
class Pose:
    """Orientation and height of the camera.

    Examples
    --------
    >>> pose = agalign.discover("flight").captures[0].pose
    >>> round(pose.heading_deg), round(pose.pitch_deg), pose.focal_length_px
    (-95, -1, 545.0)
    >>> pose.height_m is None  # the tags do not contain it
    True
    """

    heading_deg: Number
    """Direction of the image's top, degrees clockwise from north."""
    pitch_deg: Number = 0.0
    """Angle of the optical axis ahead of nadir, degrees."""
    roll_deg: Number = 0.0
    """Angle of the optical axis to the left of nadir, degrees."""
    height_m: Number | None = None
    """Height above the ground, m."""
    focal_length_px: Number | None = None
    """Focal length of the reference, px."""
    height_from: HeightSource = "tags"
    """Source of `height_m`."""


@validated.dataclass(frozen=True, config=RECORD)
class CameraIdentity:
    """Camera, from the tags.

    Examples
    --------
    >>> camera = agalign.discover("flight").captures[0].camera
    >>> camera.name, camera.serial
    ('MicaSense RedEdge-M', 'SY01-0000001-AG')
    >>> dual = type(camera).of("MicaSense", "RedEdge-MX", ["RX01", "RX02"])
    >>> dual.serial, len(dual.serials), dual.unit
    ('RX01+RX02', 2, 'RX01+RX02')
    """

    make: Name = ""
    """From the tags."""
    model: Name = ""
    """From the tags."""
    serial: Name = ""
    """Serial numbers, joined by `+`."""
    lens_calibration: Name = ""
    """Checksum of the lens calibration in the tags, where it alone tells two cameras without serial numbers apart."""

    @classmethod
    def of(cls, make: str, model: str, serials: Iterable[str]) -> "CameraIdentity":
        """Return the camera with these serial numbers."""
        return cls(make, model, "+".join(serials))

    @property
    def name(self) -> str:
        """Manufacturer and model; empty if both are unknown."""
        return f"{self.make} {self.model}".strip()

    @property
    def unit(self) -> str:
        """Which camera of its model it is: the serial numbers, else the lens calibration; empty if both are unknown."""
        return self.serial or self.lens_calibration

    @property
    def serials(self) -> frozenset[str]:
        """The serial numbers: two of a dual camera."""
        return frozenset(self.serial.split("+")) - {""}


@dataclass(frozen=True)
class Capture:
    """All bands of one moment; one of them is the reference. `discover` returns captures.

    Examples
    --------
    >>> capture = agalign.discover("flight").captures[0]
    >>> capture.label, capture.reference.name, [band.name for band in capture.moving]
    ('0000SET/000/IMG_0001', 'Green', ['Blue', 'Red', 'NIR', 'Red edge'])
    >>> capture.captured_at, capture.time_s, round(capture.altitude_m, 1)
    ('2026-06-21T10:00:01+00:00', 1782036001.0, 23.0)
    >>> capture.panel is None, capture.is_of_a_panel
    (True, False)
    """

    __eq__ = equal

    name: str
    """Common part of the names of its files, such as IMG_0001."""
    folder: Path
    """Folder relative to the input folder; outputs are written to the same folder below the output folder."""
    bands: tuple[Band, ...]
    """File, size and metadata of each band."""
    reference_index: int
    """Index of the reference in `bands`, from 0."""
    camera: CameraIdentity = field(default_factory=CameraIdentity)
    """Manufacturer, model and serial number, as far as the tags contain them."""
    capture_id: str = ""
    """Identifier in the tags; empty if there is none."""
    flight_id: str = ""
    """Identifier of the flight in the tags; empty if there is none."""
    captured_at: str = ""
    """ISO 8601, with the offset from UTC if the tags or the camera's maker define it, else by the camera's clock."""
    position: Position | None = None
    """GPS position; None if the tags do not contain it."""
    pose: Pose | None = None
    """Orientation and height of the camera; None if the tags do not contain them."""
    motion: tuple[float, float] | None = None
    """Velocity of the ground in the image (right, down), focal lengths per second; None if unknown."""
    missing_bands: tuple[str, ...] = ()
    """Names of bands that other captures of its camera have."""
    unreadable_bands: Mapping[str, Reason] = field(default_factory=dict)
    """Those of `missing_bands` with a file that cannot be read: `what` is wrong with it, and the `remedy`."""
    camera_bands: tuple[Band, ...] = ()
    """Bands of its camera, without files, in the order of the stacks; empty if they are those of the capture."""
    elevation_deg: float | None = None
    """Angle of the optical axis above the horizon: -90 straight down; None if the tags do not contain it."""
    without_panel: str = ""
    """Why no calibration panel gives its reflectance, and the remedy; empty if one does, or if none was searched."""
    root: Path | None = None
    """Input folder, which files are named relative to; None if it is unknown."""

    def with_absolute_paths(self) -> "Capture":
        """Return the capture with absolute paths, for processes with another working folder."""
        root = None if self.root is None else self.root.absolute()
        return replace(self, root=root, bands=tuple(replace(b, path=b.path.absolute()) for b in self.bands))

    @property
    def reference(self) -> Band:
        """The reference band."""
        return self.bands[self.reference_index]

    @property
    def has_several_files(self) -> bool:
        """False for one multiband file."""
        return len({b.path for b in self.bands}) > 1

    @property
    def moving(self) -> tuple[Band, ...]:
        """All bands but the reference."""
        return tuple(b for i, b in enumerate(self.bands) if i != self.reference_index)

    @property
    def stack_bands(self) -> tuple[Band, ...]:
        """The bands of a stack: those of the camera, in one order for all its captures, then any others."""
        own, of_camera = {b.name: b for b in self.bands}, {b.name: b for b in self.camera_bands}
        return tuple((of_camera | own).values())

    @property
    def moving_lenses(self) -> list[tuple[Band, ...]]:
        """The moving bands grouped by lens, without those that share the lens of the reference."""
        groups: dict[object, list[Band]] = {}
        for index, band in enumerate(self.moving):
            if not (band.one_lens and band.path == self.reference.path):
                groups.setdefault(band.path if band.one_lens else index, []).append(band)
        return [tuple(group) for group in groups.values()]

    @property
    def panel(self) -> Panel | None:
        """The calibration panel, from the first band with one; None without a panel."""
        return next((b.panel for b in self.bands if b.panel is not None), None)

    @property
    def is_of_a_panel(self) -> bool:
        """True for an image that is not aligned because it shows a calibration panel; False for a scene with one."""
        return self.panel is not None and not self.panel.in_scene

    @property
    def altitude_m(self) -> float | None:
        """Altitude in the tags, above sea level or an ellipsoid; None if it is unknown."""
        return None if self.position is None else self.position.altitude_m

    @property
    def time_s(self) -> float | None:
        """Unix time of the capture, s, by the camera's clock if its time zone is unknown; None if it is unknown."""
        moment = CaptureTime.of(self.captured_at)
        return None if moment is None else moment.utc.timestamp()

    @property
    def known_time(self) -> str:
        """`captured_at` as all files and messages have it: empty if the clock of the camera was not set and counts from
        1970.
        """
        return self.captured_at if is_clock_set(self.captured_at) else ""

    @property
    def label(self) -> str:
        """The capture's name below its folder, with forward slashes."""
        return (self.folder / self.name).as_posix()


def source_file(capture: Capture, band: Band) -> str:
    """Return the path of the file of a band, with forward slashes: relative to the input folder if it is there, else
    absolute.
    """
    if capture.root is not None and band.path.is_relative_to(capture.root):
        return band.path.relative_to(capture.root).as_posix()
    return band.path.absolute().as_posix()
