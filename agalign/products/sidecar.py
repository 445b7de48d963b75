"""The sidecar of a capture, a JSON file next to its aligned stack: schema `agalign/1`.

All pixel coordinates are x right, y down, (0, 0) the centre of the top-left pixel. `fixed_to_moving` maps a pixel of
the reference to a pixel of the moving band; `grid` samples the complete mapping between the raw pixels of the files.
"""

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from agalign.errors import SidecarError
from agalign.values.choices import CaptureStatus, ModelFamily, PairStatus, PredictionSource, SeedKind, Space
from agalign.values.files import is_inside, open_regular, write_text
from agalign.verify.checks import KINDS

SCHEMA = "agalign/1"

Row = tuple[float, float, float]
Matrix3x3 = tuple[Row, Row, Row]
PointPx = tuple[float, float]
_MAX_BYTES = 1 << 26
"""A sidecar of many bands has a tenth of this; reading a larger file would take the memory."""
_MAX_QUOTED = 60
"""Characters of a wrong value in a message."""


def _inside_folder(name: str) -> str:
    if not is_inside(name):
        raise ValueError("names a file outside its folder")
    return name


RelativeFile = Annotated[str, AfterValidator(_inside_folder)]
"""A file in the sidecar's folder or below. Anyone may write a sidecar, and agalign reads and removes what it names."""
Count = Annotated[int, Field(gt=0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, populate_by_name=True)


class _Result(_Part):
    """Read from what holds more."""

    model_config = ConfigDict(extra="ignore")


class CameraPart(_Part):
    """What made the images."""

    make: str
    model: str
    serial: str


class PositionPart(_Part):
    """Where the camera was: WGS 84, degrees, and metres as the camera has them."""

    latitude: float
    longitude: float
    altitude_m: float | None


class ReferencePart(_Part):
    """The band whose pixel grid everything is aligned to."""

    band: str
    file: str
    band_index: Count
    width: Count
    height: Count


class HomographyPart(_Part):
    """A homography and the pixels it is between: `undistorted` ones where lens models are known."""

    fixed_to_moving: Matrix3x3
    space: Space


class SeedPart(_Part):
    """Where the optimisation started, in the same space as the homography."""

    kind: SeedKind
    fixed_to_moving: Matrix3x3
    peak_sigma: float
    runner_up_sigma: float


class GridPart(_Part):
    """The complete mapping, sampled: raw pixel of the reference file -> raw pixel of the moving file."""

    reference_px: list[PointPx]
    moving_px: list[PointPx]


def _known_kind(code: str) -> str:
    if code not in KINDS:
        raise ValueError(f"unknown kind of issue {code!r}")
    return code


class IssuePart(_Part):
    """One thing that speaks against an alignment: what was measured, and what it should have been."""

    kind: Annotated[str, AfterValidator(_known_kind), Field(json_schema_extra={"enum": list(KINDS)})]
    value: float | None
    limit: float | None


class JointPart(_Part):
    """How the joint optimisation ended."""

    accepted: bool = True
    """False where the result was doubted: the homography is the seed's then, and this describes what was rejected."""
    loss: float | None
    retrieval: float
    chance: float
    iterations: int
    levels: list[float]
    recipe: str
    model_family: ModelFamily
    last_step_px: float
    corner_std_px: float
    """Root mean square distance of the least certain corner from where it is mapped to."""
    corner_std_xy_px: list[PointPx]
    """Standard deviations along x and y at the corners of the reference, clockwise from the top left."""


class SimilarityPart(_Part):
    """Similarity on the common valid area; `mattes_mi` has elastix's sign (lower is better)."""

    mattes_mi: float | None = None
    nmi: float | None = None
    ncc: float | None = None
    gradient_correlation: float | None = None
    structure_ssim: float | None = None
    overlap: float | None = None
    residual_px: float | None = None
    """Median length of the local structure shifts, px."""
    residual_p95_px: float | None = None
    residual_coverage: float | None = None


class ResidualTile(_Part):
    """The local shift that one window shows after alignment; null where none could be measured."""

    centre_px: PointPx
    shift_px: tuple[float | None, float | None]


class MetricsResult(_Result):
    """Before: the files as they are. After: as written."""

    before: SimilarityPart
    after: SimilarityPart


class MetricsPart(MetricsResult):
    """The same with the shifts that windows show."""

    model_config = ConfigDict(extra="forbid")

    tiles: list[ResidualTile]


class LocalPart(_Part):
    """What a local field of displacements gains: 95th percentile of the shifts of windows left out of its fit, px."""

    applied: bool
    before_p95_px: float | None
    after_p95_px: float | None


class ReliefPart(_Part):
    """How the relief of the capture displaces a band. At a pixel x of the reference with the parallax z in `file`, the
    moving pixel is plane_px(x) + z slope(x), both interpolated by cubic splines between their nodes.
    """

    file: RelativeFile | None
    """The raster with the parallax, on the grid of the aligned files; null where nothing was written."""
    baseline: PointPx
    """Displacement in undistorted px of the reference for a px of parallax; the longest baseline has length 1."""
    occluded: float
    """Share of the reference's pixels that nearer parts of the scene occlude in this band."""
    reference_px: list[PointPx]
    plane_px: list[PointPx]
    """Where the reference plane maps the nodes, raw px of the moving file."""
    slope: list[PointPx]
    """Px of the moving file for a px of parallax, at the nodes."""


class PredictionPart(_Part):
    """Where the flight's rig has the band: from the capture's other bands, from the captures before and after, or from
    the flight's mean; or the mapping extrapolated from the windows in a part of the image. `std_px` is the root mean
    square error to be expected; `off_px` how far from there the band's own image has it, null where it does not show
    it. Both are in px of the band's own file.
    """

    source: Annotated[PredictionSource, Field(alias="from")]
    std_px: float
    off_px: float | None


class PlacePart(_Part):
    """The file with a band's aligned pixels, relative to the sidecar's folder, and the band's index there, from 1."""

    file: RelativeFile
    band_index: Count


class BandResult(_Result):
    """What became of one band of the capture."""

    band: str
    wavelength_nm: float | None
    file: str
    band_index: int
    status: PairStatus
    reason: str | None
    issues: list[IssuePart] = Field(default=[], alias="doubts")
    """Everything that speaks against it; the first is the one that `reason` tells."""
    homography: HomographyPart | None = None
    seed: SeedPart | None = None
    joint: JointPart | None = None
    metrics: MetricsResult | None = None
    local: LocalPart | None = None
    """A smooth displacement field of this band alone."""
    prediction: PredictionPart | None = None
    place: PlacePart | None = None
    seconds: float


class BandPart(BandResult):
    """The same with the mapping and the shifts of windows, which are long."""

    model_config = ConfigDict(extra="forbid")

    metrics: MetricsPart | None = None
    grid: GridPart | None = None
    relief: ReliefPart | None = None
    """The relief that this band shares with the others of its capture."""


class FilePart(_Part):
    """A file of single bands, relative to the sidecar's folder."""

    file: RelativeFile
    bytes: int
    nodata: float | str | None = None


class OutputPart(_Part):
    """The stack, relative to the sidecar's folder; null where only single bands were written.

    `nodata` is the stack's, or what the files of single bands have in common; null where they differ.
    `crop` is x0, y0, width, height on the reference's pixel grid, which has `scale` (x, y) times as many pixels along
    its sides as the reference's file.
    """

    file: RelativeFile | None
    bytes: int | None
    band_files: list[FilePart] = []
    radiometry: str | None = None
    """What was made of raw numbers, and by what, such as "reflectance by light sensor"; null for raw numbers."""
    crop: tuple[int, int, int, int]
    scale: tuple[float, float] = (1.0, 1.0)
    nodata: float | str | None


class ProductPart(_Part):
    """A file that was written for the capture, whatever its kind: `stack`, `band`, `picture`, `error_map` …"""

    kind: str
    file: RelativeFile
    bytes: int
    sha256: str


class ReliefPreviewPart(_Part):
    """The relief on the sheet, a picture in the first column of the last row."""

    parallax_px: tuple[float, float]
    """What is black and what is white, the nearest, there."""
    range_m: tuple[float, float] | None
    """The nearest and the farthest of the scene, 1st and 99th percentile; null where the range is unknown."""


class PreviewPart(_Part):
    """A sheet of small grey pictures of all bands, from which the report composes its views: a column for each band
    of `bands`, in their order, and rows of the unaligned raw files, of what was written, of a detail of either, and
    of the expected error where that was written, white for `error_full_px`. The last row has the relief where one
    displaces the bands.
    """

    file: RelativeFile
    tile_px: tuple[Count, Count]
    """(width, height) of a picture in rows 0, 1, 4 and 5, and of a detail in rows 2 and 3,"""
    detail_px: tuple[Count, Count]
    detail: tuple[float, float, float, float]
    """x0, y0, width, height of the detail as shares of the picture's sides."""
    error_full_px: float | None = None
    relief: ReliefPreviewPart | None = None


class CaptureResult(_Result):
    """What became of one capture. `status` is ok where every moving band is aligned, or predicted as well as was asked
    for.
    """

    schema_: Annotated[Literal["agalign/1"], Field(alias="schema")] = "agalign/1"
    agalign: str
    capture: RelativeFile
    capture_id: str
    flight_id: str
    captured_at: str
    position: PositionPart | None = None
    camera: CameraPart
    status: CaptureStatus
    missing_bands: list[str]
    reference: ReferencePart
    bands: Sequence[BandResult]
    output: OutputPart | None
    preview: PreviewPart | None = None
    accept_predicted_px: float | None = None
    """Standard error up to which `status` counts a predicted band as delivered, px; null in older sidecars."""
    products: list[ProductPart] = []
    """Every file that was written but the sidecar itself."""
    not_written: list[str] = []
    """Kinds of products that could not be written; another run with the same settings does the capture again."""
    settings: str
    """Fingerprint of the settings that made this; another run with the same need not do it again."""
    checksum: str | None = None
    """SHA-256 of this file's content as `content_checksum` has it; absent in sidecars of older versions."""

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
    """One capture, as its sidecar has it."""

    model_config = ConfigDict(extra="forbid")

    bands: list[BandPart]

    def result(self) -> CaptureResult:
        """The same without its bands' long tables, of which a season has no need at once."""
        short: dict[str, Any] = {"bands": {"__all__": {"grid": True, "relief": True, "metrics": {"tiles"}}}}
        return CaptureResult.model_validate(self.model_dump(by_alias=True, exclude=short))


def write_sidecar(path: Path, sidecar: Sidecar) -> Sidecar:
    """Write at once or not at all; returned with its checksum. Raises OutputError."""
    checksum = content_checksum(sidecar.model_dump_json(by_alias=True))
    whole = sidecar.model_copy(update={"checksum": checksum})
    write_text(path, compact_lists(whole.model_dump_json(by_alias=True, indent=1)))
    return whole


def content_checksum(text: str | bytes) -> str:
    """SHA-256 of a sidecar's JSON: of its canonical form (sorted keys, no spaces) without `checksum` and without every
    `seconds`, which differ from run to run.
    """
    content = json.loads(text, object_hook=_without_seconds)
    content.pop("checksum", None)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _without_seconds(part: dict[str, Any]) -> dict[str, Any]:
    part.pop("seconds", None)
    return part


_LIST_ELEMENT = r"(?=[-0-9ntf])"
"""A line of indented JSON that is a number, null, true or false in a list: names and texts begin with a quote."""


def compact_lists(text: str) -> str:
    """Indented JSON with each list of numbers on one line: legible matrices, and a third of the size."""
    text = re.sub(r"\[\n +" + _LIST_ELEMENT, "[", text)
    text = re.sub(r",\n +" + _LIST_ELEMENT, ", ", text)
    return re.sub(r"(?<=[0-9le])\n *\]", "]", text)


def read_sidecar(path: Path) -> Sidecar:
    """Raises SidecarError, naming the file and the field, where it is missing, malformed or of another version."""
    return _read(path, Sidecar)


def read_result(path: Path) -> CaptureResult:
    """A sidecar without its long tables, which take most of the time to read. Raises as `read_sidecar` does."""
    return _read(path, CaptureResult)


Model = TypeVar("Model", bound=CaptureResult)


def _read(path: Path, model: type[Model]) -> Model:
    try:
        with open_regular(path) as file:
            contents = file.read(_MAX_BYTES + 1)
        if len(contents) > _MAX_BYTES:
            raise SidecarError(
                f"{path}: over {_MAX_BYTES >> 20} MB are too many for a sidecar; delete it and run again"
            )
        return model.model_validate_json(contents)
    except OSError as error:
        raise SidecarError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValidationError as error:
        problems = {".".join(map(str, e["loc"])): e for e in error.errors(include_url=False)}
        (where, first), *_ = problems.items()
        if first["type"] == "json_invalid":
            raise SidecarError(f"{path}: not valid JSON ({first['msg']}); delete it and run again") from None
        if not where:
            raise SidecarError(f"{path}: not a sidecar of schema {SCHEMA!r}; delete it and run again") from None
        if "schema" in problems:
            result = _shortened(problems["schema"]["input"] if problems["schema"]["type"] != "missing" else None)
            raise SidecarError(f"{path}: schema is {result}, not {SCHEMA!r}; run again with --overwrite") from None
        raise SidecarError(f"{path}: {where}: {first['msg']}; run again with --overwrite") from None


def _shortened(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}…"


def find_sidecars(folder: Path) -> list[Path]:
    """The sidecars below an output folder, sorted; other JSON files are passed over, but not what cannot be read."""
    result = []
    for path in sorted(folder.rglob("*.json")):
        try:
            if not path.is_file():
                continue
            with open_regular(path) as file:
                head = file.read(200)
        except OSError:
            result.append(path)
            continue
        if b'"agalign/' in head:
            result.append(path)
    return result
