"""The sidecar of a capture, a JSON file next to its aligned stack: schema `agalign/1`.

All pixel coordinates are x right, y down, (0, 0) the centre of the top-left pixel. `fixed_to_moving` maps a pixel of
the reference to a pixel of the moving band; `grid` samples the complete mapping between the raw pixels of the files.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from agalign.config import CheckSettings
from agalign.values.alignment import Prediction
from agalign.values.choices import CaptureStatus, Geometry, ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.files import is_inside
from agalign.values.image import OutputGrid
from agalign.values.issues import MISSING_BAND, IssueKind
from agalign.values.mapping import POSITION_DECIMALS
from agalign.values.pixel_units import PixelScale
from agalign.verify.checks import KINDS

SCHEMA = "agalign/1"
Number = Annotated[float, Field(ge=-1e30, le=1e30)]
"""Sums and squares of such numbers are finite."""
Row = tuple[Number, Number, Number]
PointPx = tuple[Number, Number]
Count = Annotated[int, Field(gt=0)]
Positive = Annotated[Number, Field(gt=0)]


@dataclass(frozen=True)
class _FromProgram:
    """A conversion of the program's values. Values in a file are in their final form, and validated without it."""

    convert: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        converted = core_schema.no_info_before_validator_function(self.convert, schema)
        return core_schema.json_or_python_schema(json_schema=schema, python_schema=converted)


def _measured(decimals: int | None = None) -> _FromProgram:
    """Convert a number that is not finite to None, and others to these decimals."""

    def convert(value: object) -> object:
        if not isinstance(value, float):
            return value
        return None if not math.isfinite(value) else value if decimals is None else round(value, decimals)

    return _FromProgram(convert)


def _from_array(positions_px: object, decimals: int = POSITION_DECIMALS) -> object:
    return np.round(np.asarray(positions_px), decimals).tolist()


Matrix3x3 = Annotated[tuple[Row, Row, Row], _FromProgram(lambda matrix: np.asarray(matrix).tolist())]
PointsPx = Annotated[list[PointPx], _FromProgram(_from_array)]
Coefficients = Annotated[list[PointPx], _FromProgram(partial(_from_array, decimals=9))]
"""Nine decimals: they are multiplied by the square of the parallax, up to hundreds of px."""
Finite = Annotated[Number | None, _measured()]
Number2 = Annotated[Number, _measured(2)]
Number3 = Annotated[Number, _measured(3)]
Fraction4 = Annotated[Number | None, _measured(4)]
Fraction6 = Annotated[Number | None, _measured(6)]
"""Digits beyond the sixth depend on the order in which threads add up."""


def _inside_folder(name: str) -> str:
    if not is_inside(name):
        raise ValueError("names a file outside its folder")
    return name


RelativeFile = Annotated[str, AfterValidator(_inside_folder)]
"""A file in the sidecar's folder or below. A sidecar may come from anyone, and agalign reads and removes the files that
it lists.
"""


class _Part(BaseModel):
    """Validated from the JSON of a sidecar, or from the program's record with attributes of these names."""

    model_config = ConfigDict(
        extra="forbid", allow_inf_nan=False, populate_by_name=True, use_attribute_docstrings=True, from_attributes=True
    )


def _check_lengths(lists: list[list[PointPx]]) -> list[list[PointPx]]:
    """Return lists of points. Raises ValueError if they are empty or of different lengths."""
    lengths = {len(one) for one in lists}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError("its lists of points are empty or of different lengths")
    return lists


class _PointLists(_Part):
    """A part with lists of corresponding points."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_lengths([value for value in vars(self).values() if isinstance(value, list)])
        return self


class _Result(_Part):
    """A model of a part of the fields: it ignores the others when a sidecar is read."""

    model_config = ConfigDict(extra="ignore")


class CameraPart(_Part):
    """From the tags."""

    make: str
    """Manufacturer."""
    model: str
    """Model."""
    serial: str
    """Serial numbers, joined by `+`."""

    @property
    def name(self) -> str:
        """Manufacturer and model; empty if both are unknown."""
        return f"{self.make} {self.model}".strip()


class PositionPart(_Part):
    """GPS position of the reference band."""

    latitude: Number
    """Degrees, WGS 84."""
    longitude: Number
    """Degrees, WGS 84."""
    altitude_m: Number | None
    """Altitude in the tags, m."""


class ReferencePart(_Part):
    """Reference band."""

    band: str
    """Name of the band."""
    file: str
    """Image file."""
    band_index: Count
    """Band in that file, from 1."""
    width: Count
    """Width of the file, px."""
    height: Count
    """Height of the file, px."""
    georeferenced: bool = False
    """True if the file has map coordinates, as a mosaic has."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of the file."""
        return self.width, self.height


class HomographyPart(_Part):
    """Homography."""

    fixed_to_moving: Matrix3x3
    """Maps a pixel of the reference to one of the moving band."""
    space: Space
    """`pixel`: between raw pixels. `undistorted`: between pixels without lens distortion (same focal length and
    principal point).
    """


class SeedPart(_Part):
    """Initial alignment, in the same space as the homography."""

    kind: SeedKind
    """`user`; `match` (learned descriptors matched); `model` (median mapping of the flight); `rig` (camera tags);
    `centre` (optical centres of DJI); `geo` (geotransforms); `structure` (phase correlation); `identity`.
    """
    fixed_to_moving: Matrix3x3
    """As in `homography`."""
    peak_sigma: Number
    """Height of its correlation peak, in standard deviations."""
    runner_up_sigma: Number
    """The same for the second highest peak."""


class LensPart(_Part):
    """Lens model of a camera, Brown-Conrady in OpenCV's convention, raw pixels of the file."""

    fx_px: Number
    """Focal length along x."""
    fy_px: Number
    """Focal length along y."""
    cx_px: Number
    """Optical centre, x."""
    cy_px: Number
    """Optical centre, y."""
    distortion: tuple[Number, ...]
    """k1, k2, p1, p2, k3, k4, k5, k6; omitted ones are 0."""


class FieldPart(_Part):
    """Displacement field of the raw pixels of the reference."""

    step_px: Positive
    """Spacing of the nodes, from the centre of the top-left pixel."""
    displacements_px: Annotated[list[list[PointPx]], AfterValidator(_check_lengths), _FromProgram(_from_array)]
    """(x, y) by row and column; cubic splines between the nodes."""


class GridPart(_PointLists):
    """The complete mapping, sampled at 17 x 13 points, or at up to 129 x 97 points if cubic interpolation (scipy's
    CloughTocher2DInterpolator or RectBivariateSpline) of fewer has errors above 0.02 px (p99). If there is a `relief`,
    use that instead.
    """

    reference_px: PointsPx
    """Raw pixels of the reference, row by row."""
    moving_px: PointsPx
    """The corresponding raw pixels of the band."""


def _known_kind(code: str) -> str:
    if code not in KINDS:
        raise ValueError(f"unknown kind of issue {code!r}")
    return code


def _code(kind: object) -> object:
    return kind.code if isinstance(kind, IssueKind) else kind


IssueCode = Annotated[
    str, AfterValidator(_known_kind), _FromProgram(_code), Field(json_schema_extra={"enum": list(KINDS)})
]


class IssuePart(_Part):
    """A reason for not accepting the alignment."""

    kind: IssueCode
    """Code of the reason."""
    value: Finite
    """Measured value."""
    limit: Finite
    """Limit of the check."""


class JointPart(_Part):
    """Result of the joint optimisation of descriptor and mapping."""

    accepted: bool = True
    """False if `homography` and `grid` are those of the seed or the prediction."""
    loss: Finite
    """Final loss; null if nothing was learned."""
    retrieval: Number
    """Share of held-out patches with the true counterpart as nearest descriptor."""
    chance: Number
    """Retrieval expected by chance."""
    iterations: int
    """Steps; 0 if nothing was learned."""
    levels: list[Number]
    """Scales of the images used; 1 is full resolution."""
    recipe: str
    """`flight` (frozen network of the flight), `fast` (learned on this capture), `paper`, or `windows` (windows
    alone).
    """
    model_family: ModelFamily
    """Mapping that was fitted."""
    last_step_px: Number
    """Movement of a corner in the last step, px."""
    corner_std_px: Annotated[Number, _measured(6)]
    """Standard error of the least certain corner, px of the reference."""
    corner_std_xy_px: PointsPx
    """Standard errors (x, y) at the corners, clockwise from the top left, px of the reference.
    """


class SimilarityPart(_Part):
    """Similarity of pixels that are valid in both bands; in large images of a sample of at least 250,000."""

    mattes_mi: Fraction6 = None
    """Negative Mattes mutual information, nats, 32 bins: lower is better."""
    nmi: Fraction6 = None
    """Normalised mutual information, 1 to 2: higher is better."""
    ncc: Fraction6 = None
    """Normalised cross-correlation; negative if contrast is reversed."""
    gradient_correlation: Fraction6 = None
    """Correlation of gradient magnitudes: higher is better."""
    structure_ssim: Fraction6 = None
    """SSIM of the structure images: higher is better."""
    overlap: Fraction6 = None
    """Share of the image in which both bands are valid."""
    residual_px: Fraction6 = None
    """Median length of the shifts of the windows, px of the reference."""
    residual_p95_px: Fraction6 = None
    """Their 95th percentile, px of the reference."""
    residual_coverage: Fraction6 = None
    """Share of the textured windows with a measured shift."""


class ResidualTile(_Part):
    """Shift of a window after alignment."""

    centre_px: tuple[Number2, Number2]
    """Centre of the window, px of the reference."""
    shift_px: tuple[Fraction4, Fraction4]
    """Shift, px of the reference; null if none could be measured."""
    peak_sigma: Fraction4 = None
    """Height of the correlation peak, standard deviations."""
    cell: tuple[int, int] | None = None
    """Column and row in the complete grid of windows."""


class MetricsResult(_Result):
    """Similarity before and after alignment."""

    before: SimilarityPart
    """Files as they are."""
    after: SimilarityPart
    """Bands as written."""


class MetricsPart(MetricsResult):
    """Similarity before and after alignment."""

    model_config = ConfigDict(extra="forbid")

    tiles: list[ResidualTile]
    """Shifts of the windows; with recipe `windows`, of those left out of the fit."""


class GeometryPart(_Part):
    """What the mapping has in addition to homography and lens models."""

    kind: Geometry
    """`homography`: nothing; `field`: a smooth displacement field; `relief`: the parallax of the capture;
    `relief and field`: both.
    """
    held_out_p95_px: dict[Geometry, Fraction4]
    """p95 of the shifts of held-out windows, px, for each geometry that was fitted."""

    @property
    def homography_p95_px(self) -> float | None:
        """The p95 of a homography."""
        return self.held_out_p95_px.get("homography")

    @property
    def p95_px(self) -> float | None:
        """The p95 of the geometry that was chosen."""
        return self.held_out_p95_px.get(self.kind)


class ReliefPart(_PointLists):
    """Displacement by the parallax of the capture: a pixel x of the reference with parallax z maps to plane_px(x) + z
    slope(x) + z^2 curvature(x), interpolated by cubic splines.
    """

    file: RelativeFile | None
    """[Raster](#the-relief-raster) with the parallax."""
    baseline: PointPx
    """Displacement per px of parallax, undistorted px of the reference; the longest baseline has length 1."""
    occluded: Annotated[Number, _measured(4)]
    """Share of the reference pixels that are occluded in the band."""
    reference_px: PointsPx
    """Nodes: those of `grid`."""
    plane_px: PointsPx
    """Where the reference plane maps them, raw px of the moving file."""
    slope: Coefficients
    """Px of the moving file per px of parallax."""
    curvature: Coefficients | None = None
    """The same per px of parallax squared; null in files of earlier versions, which are less accurate."""


class PredictionPart(_Part):
    """Mapping that is predicted without the image of the band, or extrapolated from a part of it."""

    source: Annotated[PredictionSource, Field(alias="from")]
    """`bands` (other bands of the capture), `neighbours` (other captures), `flight` (mean), or `windows` (a part of the
    image).
    """
    std_px: Annotated[Number, _measured(4)]
    """Standard error over the image (root mean square), px of the band's own file."""
    off_px: Fraction4
    """Distance of the image's own alignment from the prediction, px of the band's own file."""


class PlacePart(_Part):
    """Where the aligned pixels of the band are."""

    file: RelativeFile
    """Path."""
    band_index: Count
    """Band in that file, from 1."""


class BandResult(_Result):
    """Result of one band."""

    band: str
    """Name of the band."""
    wavelength_nm: Number | None
    """Centre wavelength, nm."""
    file: str
    """Image file."""
    band_index: int
    """Band in that file, from 1."""
    status: PairStatus
    """`reference`, `aligned`, `predicted`, `seed_only` or `failed`."""
    reason: str | None
    """Why the band is not aligned, in words."""
    issues: list[IssuePart] = Field(default=[], alias="doubts")
    """All reasons for not accepting the alignment; `reason` is the first."""
    homography: HomographyPart | None = None
    """Mapping without lenses and displacements."""
    seed: SeedPart | None = None
    """Initial alignment, in the same space as the homography."""
    joint: JointPart | None = None
    """Result of the joint optimisation of descriptor and mapping."""
    metrics: MetricsResult | None = None
    """Similarity before and after."""
    geometry: GeometryPart | None = None
    """What the mapping has in addition to homography and lens models."""
    prediction: PredictionPart | None = None
    """Prediction."""
    place: PlacePart | None = None
    """Where the aligned pixels of the band are."""
    seconds: Number3
    """Share of the capture's processing time, equal for all its bands."""
    saturated: Fraction4 = None
    """Share of saturated pixels in the file."""


class BandPart(BandResult):
    """Result of one band, with its complete mapping."""

    model_config = ConfigDict(extra="forbid")

    metrics: MetricsPart | None = None
    """Similarity and shifts."""
    lenses: tuple[LensPart, LensPart] | None = None
    """Of the reference and the band, if the homography is between undistorted pixels."""
    field: FieldPart | None = None
    """Displacement field of the raw pixels of the reference."""
    grid: GridPart | None = None
    """The complete mapping, sampled."""
    relief: ReliefPart | None = None
    """Displacement by parallax."""
    size_px: tuple[Count, Count] | None = None
    """Width and height of the file."""
    levels: list[list[Fraction6]] = []
    """Means of the written pixels in 6 rows of 8 equal blocks; empty for thermal bands and RGB companions."""


class FilePart(_Part):
    """File of a single band."""

    file: RelativeFile
    """Path."""
    bytes: int
    """Size."""
    nodata: float | str | None = None
    """Nodata value; `"nan"` for NaN."""


class IlluminationPart(_Part):
    """Illumination of a band."""

    band: str
    """Its name."""
    irradiance: Number | None = None
    """By the light sensor, on a horizontal plane, W / m^2 / nm (DJI: relative)."""
    reflectance_per_radiance: Positive
    """Factor by which radiance was multiplied."""


class OutputPart(_Part):
    """Written rasters."""

    file: RelativeFile | None
    """The stack; null with `--layout bands`."""
    bytes: int | None
    """Its size."""
    band_files: list[FilePart] = []
    """Files of single bands."""
    radiometry: str | None = None
    """Conversion of raw numbers, such as `reflectance by panel and light sensor`."""
    panel_age_s: Number | None = None
    """Time to the nearest panel, if one was used."""
    illumination: list[IlluminationPart] = []
    """Bands that were converted to reflectance."""
    crop: tuple[int, int, Count, Count]
    """x0, y0, width, height on the reference grid times `scale`."""
    scale: tuple[Positive, Positive] = (1.0, 1.0)
    """Output pixels per reference pixel along x and y."""
    undistorted: bool = False
    """True for the lens-corrected grid of the reference."""
    vignetting_corrected: bool = False
    """True if vignetting is corrected in the files of single bands."""
    nodata: float | str | None
    """Nodata value of the stack, or of all single bands; null if they differ. Integers without one in the input: 0,
    or another value that no valid pixel has.
    """

    @property
    def grid(self) -> OutputGrid:
        """The grid of the rasters."""
        return OutputGrid(*self.crop, PixelScale(*self.scale), self.undistorted)


class ProductPart(_Part):
    """A file written for the capture."""

    kind: str
    """`stack`, `band`, `pan_sharpened`, `relief`, `error_map`, `qa`, `tie_points`, `index`, `picture`,
    `preview` or `stac_item`."""
    file: RelativeFile
    """Path."""
    bytes: int
    """Size."""
    sha256: str
    """Checksum."""


class ReliefPreviewPart(_Part):
    """Picture of the parallax: first column, last row."""

    parallax_px: tuple[Number2, Number2]
    """Parallax shown as black and as white (nearest), px."""
    range_m: tuple[Number3, Number3] | None
    """1st and 99th percentile of the range, m; null if unknown."""


class PreviewPart(_Part):
    """Pictures for the report, a column per band. Rows: input, output, a detail of each, expected errors (if
    `error_full_px` is not null), relief (if any).
    """

    file: RelativeFile
    """Path."""
    tile_px: tuple[Count, Count]
    """Width and height of a whole picture."""
    detail_px: tuple[Count, Count]
    """Width and height of a detail."""
    detail: tuple[Number, Number, Number, Number]
    """x0, y0, width, height of the detail, as shares of the image."""
    error_full_px: Number | None = None
    """Expected error shown as white, px."""
    relief: ReliefPreviewPart | None = None
    """Picture of the relief."""


class CaptureResult(_Result):
    """Result of one capture."""

    schema_: Annotated[Literal["agalign/1"], Field(alias="schema")] = "agalign/1"
    """Version of this format."""
    agalign: str
    """Version of the program."""
    capture: RelativeFile
    """Name of the capture."""
    capture_id: str
    """Capture id in the tags."""
    flight_id: str
    """Flight id in the tags."""
    captured_at: str
    """Time in the tags, ISO 8601."""
    position: PositionPart | None = None
    """GPS position of the reference band."""
    camera: CameraPart
    """From the tags."""
    status: CaptureStatus
    """`ok`: every band is there, and aligned or predicted within `accept_predicted_px`. `failed`: all
    moving bands are `failed`. Else `degraded`.
    """
    missing_bands: list[str]
    """Bands that only other captures have."""
    reference: ReferencePart
    """Reference band."""
    bands: Annotated[Sequence[BandResult], Field(min_length=1)]
    """One entry per band, the reference included."""
    output: OutputPart | None
    """Written rasters; null if all moving bands are `failed`."""
    preview: PreviewPart | None = None
    """Preview image."""
    accept_predicted_px: Number | None = None
    """Standard error up to which indices may use a predicted band, px."""
    products: list[ProductPart] = []
    """All other files of the capture."""
    not_written: list[str] = []
    """Kinds of products that could not be written."""
    settings: str
    """Fingerprint of options, input and version; a run with the same one skips the capture."""
    options: dict[str, dict[str, Any]] | None = None
    """Settings that differ from the defaults, by stage and name; null in older sidecars."""
    input_samples: dict[str, str] = {}
    """Hash of some bytes of the file of each band: it identifies captures without tags."""
    seconds: Number3 = 0.0
    """Processing time, with reading and writing."""
    checksum: str | None = None
    """SHA-256 of the content as JSON with sorted keys and no spaces, without `checksum` and `seconds`."""

    @field_validator("bands")
    @classmethod
    def _has_reference(cls, bands: Sequence[BandResult], given: ValidationInfo) -> Sequence[BandResult]:
        reference = given.data.get("reference")
        if reference is not None and reference.band not in [b.band for b in bands]:
            raise ValueError(f"none of them is the reference band {reference.band!r}")
        return bands

    @property
    def max_predicted_px(self) -> float:
        """Standard error up to which indices may use a predicted band, px; the default in older sidecars."""
        given = self.accept_predicted_px
        return CheckSettings().accept_predicted_px if given is None else given

    @property
    def pairs(self) -> list[tuple[str, str, str | None]]:
        """(band, status, reason) of every band that is to be aligned; missing bands have the status `missing`."""
        moving = [(b.band, str(b.status), b.reason) for b in self.bands if b.status != "reference"]
        return [*moving, *((name, "missing", MISSING_BAND.cause) for name in self.missing_bands)]

    @property
    def files(self) -> dict[str, int]:
        """Size in bytes of every file that the sidecar lists, by its path relative to the sidecar's folder."""
        files = {part.file: part.bytes for part in self.products}
        if self.output is not None:
            files |= {part.file: part.bytes for part in self.output.band_files}
            if self.output.file is not None and self.output.bytes is not None:
                files[self.output.file] = self.output.bytes
        return files


class Sidecar(CaptureResult):
    """Result of one capture, with the complete mappings of its bands."""

    model_config = ConfigDict(extra="forbid")

    bands: Annotated[list[BandPart], Field(min_length=1)]
    """One entry per band, the reference included."""

    def result(self) -> CaptureResult:
        """Return the sidecar without the long tables of its bands: those of a season would not fit into memory."""
        tables: dict[str, Any] = {**dict.fromkeys(("grid", "field", "relief"), True), "metrics": {"tiles"}}
        return CaptureResult.model_validate(self.model_dump(by_alias=True, exclude={"bands": {"__all__": tables}}))


def is_usable(status: PairStatus, prediction: Prediction | PredictionPart | None, accept_predicted_px: float) -> bool:
    """Return True for the reference, an aligned band, or a predicted band with an accepted standard error."""
    if status == "predicted":
        return prediction is not None and prediction.std_px <= accept_predicted_px
    return status in ("reference", "aligned")
