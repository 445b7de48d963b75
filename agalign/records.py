"""The values that travel between the stages: frozen, typed, numpy only."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from agalign.choices import ModelFamily, PairStatus, SeedKind, Space

Matrix = NDArray[np.float64]
FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics in raw pixels: x_px = fx * x / z + cx, after Brown-Conrady distortion.

    `distortion` is k1, k2, p1, p2, k3, k4, k5, k6 in OpenCV's order and for normalised coordinates; what is left out at
    the end is 0, and empty means none.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Matrix:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Georeference:
    """Where a raster lies: `transform` maps (column, row, 1) with (0, 0) the CORNER of the top-left pixel,
    as GDAL and rasterio have it, to map units of `crs_wkt`.
    """

    transform: Matrix
    crs_wkt: str


@dataclass(frozen=True)
class Radiometry:
    """What turns a band's raw numbers into a physical quantity; `radiometry` has the equation."""

    quantity: Literal["reflectance", "relative reflectance", "radiance"]
    """Reflectance by the light sensor, 0 to 1, or up to a factor that all bands share; without a light sensor
    radiance, W / m^2 / sr / nm or the maker's own unit.
    """
    black_level: float
    full_scale: float
    gain: float
    vignetting_centre_px: tuple[float, float] = (0.0, 0.0)
    vignetting: tuple[float, ...] = ()
    """k1 ... k6, per px, px^2 ..."""
    vignetting_divides: bool = True
    row_gradient: float = 0.0
    """Share of the signal that each row has more than the one above it."""


@dataclass(frozen=True)
class Band:
    """One band of a capture: where its pixels are and what the camera says of them."""

    name: str
    path: Path
    band_index: int
    """Index within the file, from 1."""
    width_px: int
    height_px: int
    dtype: str
    nodata: float | None = None
    has_mask: bool = False
    """True where the file has a mask or an alpha band beside the pixels."""
    wavelength_nm: float | None = None
    bandwidth_nm: float | None = None
    saturation_value: float | None = None
    """Raw value at and above which a pixel is taken as saturated."""
    lens: Lens | None = None
    to_rig: Matrix | None = None
    """Homography from this file's undistorted pixels (raw ones without a lens model) to a plane that all bands of the
    rig share, as far as the tags tell."""
    one_lens: bool = False
    """The file's bands come through one lens and are aligned as one."""
    companion: bool = False
    """Of a colour photograph beside the capture: takes part only where asked for."""
    georeference: Georeference | None = None
    scale_offset: tuple[float, float] = (1.0, 0.0)
    """What the file says that its numbers are to be multiplied by, and what to be added then."""
    overviews: tuple[int, ...] = ()
    """Reductions at which the file holds the band too."""
    radiometry: Radiometry | None = None

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


@dataclass(frozen=True)
class CameraIdentity:
    """What made the images, as far as their tags say."""

    make: str = ""
    model: str = ""
    serial: str = ""


@dataclass(frozen=True)
class Capture:
    """All bands of one moment, of which one is the reference."""

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
    missing_bands: tuple[str, ...] = ()

    @property
    def reference(self) -> Band:
        """The reference band."""
        return self.bands[self.reference_index]

    @property
    def moving(self) -> tuple[Band, ...]:
        """All bands but the reference."""
        return tuple(b for i, b in enumerate(self.bands) if i != self.reference_index)

    @property
    def label(self) -> str:
        """The capture's name below its folder, with forward slashes."""
        return (self.folder / self.name).as_posix()


@dataclass(frozen=True)
class Raster:
    """Pixels with their validity, as the estimation sees them."""

    pixels: FloatImage
    """(height, width) float32, or (channels, height, width)."""
    valid: Mask
    """(height, width), False where a pixel is nodata, saturated or outside the sensor."""
    lens: Lens | None = None
    """Of the camera that took it, in these pixels; None where positions are not to be corrected."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return int(self.valid.shape[1]), int(self.valid.shape[0])

    @property
    def channels(self) -> int:
        """1 for a single band."""
        return 1 if self.pixels.ndim == 2 else len(self.pixels)


@dataclass(frozen=True)
class Tile:
    """A rectangle of a pixel grid."""

    x0: int
    y0: int
    width: int
    height: int


@dataclass(frozen=True)
class Grid:
    """The pixels that are written, within the reference's: its pixel x lies at scale (x + 0.5) - 0.5 - x0."""

    x0: int
    y0: int
    width: int
    height: int
    scale_xy: tuple[float, float] = (1.0, 1.0)
    """Written pixels along one of the reference, in whole numbers a side."""
    undistorted: bool = False
    """The lens-corrected grid of the reference."""

    @property
    def scale(self) -> float:
        """`scale_xy` for what has one number for both."""
        return math.sqrt(self.scale_xy[0] * self.scale_xy[1])

    @property
    def tile(self) -> Tile:
        """The rectangle of the reference's grid at this scale."""
        return Tile(self.x0, self.y0, self.width, self.height)

    def px(self, x: float, y: float) -> tuple[float, float]:
        """Where a pixel of the reference lies."""
        sx, sy = self.scale_xy
        return sx * (x + 0.5) - 0.5 - self.x0, sy * (y + 0.5) - 0.5 - self.y0


@dataclass(frozen=True)
class Seed:
    """A coarse mapping to start from and how well the images agree under it."""

    kind: SeedKind
    fixed_to_moving: Matrix
    score: float
    """By which candidates are compared: the height of the correlation at this mapping, in standard deviations."""
    peak_sigma: float = 0.0
    """Height of the correlation peak above its surroundings, in standard deviations."""
    runner_up_sigma: float = 0.0
    """The same for the second highest separate peak."""


@dataclass(frozen=True)
class JointResult:
    """What the joint optimisation ended with."""

    fixed_to_moving: Matrix
    loss: float
    retrieval: float
    """Share of held-out patches whose nearest descriptor in the other image is the right one."""
    chance: float
    """The retrieval that guessing would give."""
    iterations: int
    levels: tuple[float, ...]
    """Resolutions worked at, coarse to fine; 1 is full."""
    recipe: str
    model_family: ModelFamily
    last_step_px: float
    corner_std_xy_px: tuple[tuple[float, float], ...]
    """Standard deviations along x and y of the mapping at the corners of the reference, clockwise from the top left,
    px of the reference: from the curvature at the solution and what the patches disagree by."""

    @property
    def corner_std_px(self) -> float:
        """Root mean square distance of the least certain corner from where it is mapped to."""
        return max(math.hypot(*std) for std in self.corner_std_xy_px)


@dataclass(frozen=True)
class Residual:
    """Local shifts that an alignment leaves, measured independently of how it was found."""

    centres_px: NDArray[np.float64]
    """(n, 2) tile centres on the reference grid."""
    shifts_px: NDArray[np.float64]
    """(n, 2) where the moving band's structure lies minus where the reference's does; nan where not measured."""
    median_px: float
    p95_px: float
    coverage: float
    """Share of the tiles with enough structure in which a shift could be measured."""
    peaks_sigma: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    """(n,) how far each tile's correlation peak stands out, in standard deviations: the error of a shift falls with its
    square."""


@dataclass(frozen=True)
class LocalField:
    """A smooth field of displacements on an image, px, by its values on a lattice."""

    step_px: float
    displacements_px: NDArray[np.float64]
    """(rows, columns, 2); the first lies at (0, 0)."""

    def __call__(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """The displacement (..., 2) at points (..., 2), by cubic splines; beyond the lattice that of its edge."""
        points = np.asarray(points_px)
        at = points.reshape(-1, 2)[:, ::-1].T / self.step_px
        planes = np.moveaxis(self.displacements_px, -1, 0)
        found = [map_coordinates(plane, at, order=3, mode="nearest") for plane in planes]
        return np.stack(found, axis=-1).reshape(points.shape)

    def plus(self, other: "LocalField") -> "LocalField":
        """X -> x + d(x) with this field, measured again under it: d(x) + other(x)."""
        return LocalField(self.step_px, self.displacements_px + other.displacements_px)


@dataclass(frozen=True)
class LocalResult:
    """A field of displacements, where it gains something, and what it gains on windows it was not fitted to."""

    field: LocalField | None
    before_p95_px: float
    after_p95_px: float


@dataclass(frozen=True)
class Alignment:
    """The mapping found for one band pair and everything known about it."""

    fixed_to_moving: Matrix
    """Between undistorted pixels where both lenses are known, else between raw pixels."""
    space: Space
    status: PairStatus
    reason: str | None
    seed: Seed
    joint: JointResult | None
    residual: Residual | None
    seconds: float
    before: Mapping[str, float] = field(default_factory=dict)
    after: Mapping[str, float] = field(default_factory=dict)
    local: LocalResult | None = None
    """Displacements in raw px of the reference, before the homography; None where they were not asked for."""
