"""The sidecar of a capture, a JSON file next to its aligned stack: schema `agalign/3`.

It is the whole result of the estimation, together with the raster of the parallax of a capture that has one: rasters
are rendered from it and the files of the capture. Its parts are the records of the program themselves (`values`), or
the models below.

All pixel coordinates are x right, y down, (0, 0) the centre of the top-left pixel. `fixed_to_moving` maps a pixel of
the reference to a pixel of the moving band; `grid` samples the complete mapping between the raw pixels of the files.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import compress
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from agalign._version import __version__
from agalign.config import Settings
from agalign.flight.fingerprint import estimation_fingerprint
from agalign.records.sidecar_samples import sampled_mapping, sampled_parallax
from agalign.values.alignment import (
    COVARIANCE_DECIMALS,
    Alignment,
    JointResult,
    Prediction,
    Seed,
    has_same_pixel_size,
    in_both_px,
    is_usable,
)
from agalign.values.capture import Band, CameraIdentity, Capture, Pose, Position, source_file
from agalign.values.choices import CaptureStatus, Geometry, PairStatus, Space
from agalign.values.fields import (
    RECORD,
    Array,
    Count,
    Matrix3x3,
    Measured,
    Message,
    Name,
    Number,
    Number3,
    Number4,
    Number6,
    PointsPx,
    Positive,
    RelativeFile,
    SourceFile,
    equal,
)
from agalign.values.image import OutputGrid
from agalign.values.issues import Issue
from agalign.values.lens import Lens
from agalign.values.lens_shapes import CORNERS, SHAPES
from agalign.values.mapping import DisplacementField, PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.moved_area import MovedArea
from agalign.values.parallax import Parallax, Relief
from agalign.values.pixel_units import PixelScale, Size
from agalign.values.radiometry import RadiometricError
from agalign.values.remedies import MISSING_BAND
from agalign.values.residual import Residual, Similarity

SCHEMA = "agalign/3"
SampledPx = Annotated[NDArray[np.float64], Array((None, 2), 3)]
"""Their rounding is small compared with the error of interpolation between them."""
Slopes = Annotated[NDArray[np.float64], Array((None, 2), 5)]
Curvatures = Annotated[NDArray[np.float64], Array((None, 2), 7)]
"""They are multiplied by the parallax and by its square: 0.0005 px of rounding each for 100 px."""
_SAME_IN_ALIGNMENT = "issues", "seed", "joint", "prediction", "seconds"
"""What a band has as its alignment has it; the rest has other names in a file, or is divided differently."""
_SAME_IN_ERROR = "covariance_px2", "rig_std_px", "lens_std_px", "field_std_px", "relief_std_px", "moved", "baseline_std"
"""What the entry of an error has as the error has it."""


def _values(record: object, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False, **RECORD)
    __eq__ = equal


class ReferencePart(_Part):
    """Reference band."""

    band: Name
    """Name."""
    file: SourceFile
    """Image file; absolute if it is outside the input folder."""
    band_index: Count
    """Band of the file, from 1."""
    width: Count
    """Size of the file, px."""
    height: Count
    """Size of the file, px."""
    georeferenced: bool = False
    """True if the file has map coordinates."""

    @classmethod
    def of(cls, capture: Capture) -> Self:
        """Return the entry of the reference of a capture."""
        band, (width, height) = capture.reference, capture.reference.size_px
        place = band.georeference
        is_mosaic = place is not None and place.accuracy_m is None  # else it was calculated from GPS
        return cls(
            band=band.name,
            file=source_file(capture, band),
            band_index=band.band_index,
            width=width,
            height=height,
            georeferenced=is_mosaic,
        )

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of the file."""
        return self.width, self.height


class HomographyPart(_Part):
    """Homography."""

    fixed_to_moving: Matrix3x3
    """Maps pixels of the reference to the band."""
    space: Space
    """`pixel` (raw), or `undistorted` (without lens distortion; same focal length and principal point)."""


class GridPart(_Part):
    """The complete mapping on a lattice: 17 x 13 points, or up to 129 x 97 if cubic interpolation of fewer has errors
    above 0.02 px (p99). If there is a `relief`, use that instead.
    """

    reference_px: PointsPx
    """Raw pixels of the reference, row by row."""
    moving_px: SampledPx
    """The corresponding raw pixels of the band."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_lengths(self.reference_px, self.moving_px)
        return self


class MetricsPart(_Part):
    """Similarity before and after alignment, and shifts of windows."""

    before: Similarity
    """Files as they are."""
    after: Similarity
    """Bands as written."""
    windows: Residual | None = None
    """Shifts of windows that the fit did not use, under the mapping."""


class GeometryPart(_Part):
    """Addition to homography and lens models."""

    kind: Geometry
    """`homography` (nothing), `field` (displacements), `relief` (parallax), or `relief and field`."""
    held_out_p95_px: dict[Geometry, Annotated[float, Measured(4, math.inf)]]
    """p95 of the shifts of held-out windows, px, by geometry."""

    @property
    def homography_p95_px(self) -> float | None:
        """The p95 of a homography."""
        return self.held_out_p95_px.get("homography")

    @property
    def p95_px(self) -> float | None:
        """The p95 of the geometry that was chosen."""
        return self.held_out_p95_px.get(self.kind)


class ReliefPart(_Part):
    """Mapping with parallax: pixel x of the reference with parallax z maps to plane_px(x) + z slope(x) + z^2
    curvature(x), interpolated by cubic splines.
    """

    file: RelativeFile | None
    """[Parallax](outputs.md#parallax) on the grid of the stack."""
    baseline: tuple[Number, Number]
    """Displacement per px of parallax, undistorted px of the reference; the longest baseline has length 1."""
    occluded: Number4
    """Share of occluded pixels."""
    reference_px: PointsPx
    """Nodes: those of `grid`."""
    plane_px: SampledPx
    """Their positions at parallax 0, raw px of the band."""
    slope: Slopes
    """Px of the band per px of parallax."""
    curvature: Curvatures | None = None
    """The same per px of parallax squared."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        lists = self.reference_px, self.plane_px, self.slope, self.curvature
        _check_lengths(*(one for one in lists if one is not None))
        return self


def _check_lengths(*lists: NDArray[np.float64]) -> None:
    if len({len(one) for one in lists}) != 1 or not len(lists[0]):
        raise ValueError("its lists of points are empty or of different lengths")


class ErrorPart(_Part):
    """Parts of the expected error of a mapping, px of the reference, beside those of windows and parallax."""

    std_px: Number4
    """Expected error of the band: its RMS over the area that both images show, without the shifts of `moved`."""
    std_band_px: Number4 | None = None
    """The same in px of the band."""
    covariance_px2: Annotated[NDArray[np.float64], Array((None, None), COVARIANCE_DECIMALS)] | None = None
    """Covariance of the corners (8 x 8), clockwise from the top left, x and y in turn, or with lens shapes (12 x 12);
    null for a prediction by other bands or captures, whose windows are no part of the error."""
    rig_std_px: Number4 = 0.0
    """Part that is the same everywhere: of predictions and second layers."""
    lens_std_px: Annotated[NDArray[np.float64], Array((SHAPES,), 6)] | None = None
    """Standard deviations of the lens shapes that neither tags nor a rig determine."""
    field_std_px: Number4 = 0.0
    """Spread of the displacement field."""
    relief_std_px: Number4 = 0.0
    """Spread of the parallax that a mapping without it lacks, where no window is near."""
    baseline_std: Number6 = 0.0
    """Standard error of the baseline, px per px of parallax."""
    moved: tuple[MovedArea, ...] = ()
    """Areas that contradict the mapping: what they show moved between the exposures, or is near the camera."""

    @property
    def in_words(self) -> str:
        """The expected error, in px of the band too if its pixels differ from those of the reference."""
        if self.std_band_px is None:
            return f"{self.std_px:.2f} px of the reference"
        return in_both_px(self.std_px, self.std_band_px)

    @property
    def other_px(self) -> float | None:
        """The expected error in px of the band, if these differ from those of the reference; else None."""
        if self.std_band_px is None or has_same_pixel_size(self.std_px, self.std_band_px):
            return None
        return self.std_band_px

    @field_validator("covariance_px2")
    @classmethod
    def _has_size(cls, covariance: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        if covariance is not None and covariance.shape not in ((CORNERS,) * 2, (CORNERS + SHAPES,) * 2):
            raise ValueError("it is neither 8 x 8 nor 12 x 12")
        return covariance

    @classmethod
    def of(cls, alignment: Alignment) -> Self | None:
        """Return the entry of an alignment; None if its error is unknown."""
        error = alignment.error
        if error is None or not math.isfinite(alignment.std_px):
            return None
        return cls(std_px=alignment.std_px, std_band_px=alignment.std_band_px, **_values(error, _SAME_IN_ERROR))

    def mapping_error(self, size_px: Size, residual: Residual | None, parallax: Parallax | None) -> MappingError:
        """Return the error of a mapping of a reference (width, height), with the residual and parallax of the band."""
        residual = None if self.covariance_px2 is None else residual
        return MappingError(size_px, residual=residual, parallax=parallax, **_values(self, _SAME_IN_ERROR))


class PlacePart(_Part):
    """Where the aligned pixels of the band are."""

    file: RelativeFile
    """Path."""
    band_index: Count
    """Band of the file, from 1."""


class BandResult(_Part):
    """Result of one band, with its complete mapping."""

    band: Name
    """Name."""
    wavelength_nm: Number | None
    """Centre wavelength, nm."""
    file: SourceFile
    """Image file; absolute if it is outside the input folder."""
    band_index: int
    """Band of the file, from 1."""
    size_px: tuple[Count, Count] | None = None
    """Width and height of the file."""
    status: PairStatus
    """`reference`, `aligned`, `predicted`, `seed_only` or `failed`."""
    reason: Message | None
    """Why the band is not aligned."""
    issues: tuple[Issue, ...] = ()
    """All reasons; `reason` is the first."""
    homography: HomographyPart | None = None
    """Mapping without lenses and displacements."""
    lenses: tuple[Lens, Lens] | None = None
    """Lenses of reference and band (Brown-Conrady, OpenCV's convention), if the homography is between undistorted
    pixels."""
    field: DisplacementField | None = None
    """Displacements of the reference's pixels."""
    grid: GridPart | None = None
    """The complete mapping, sampled."""
    relief: ReliefPart | None = None
    """Displacement by parallax."""
    seed: Seed | None = None
    """Initial alignment."""
    joint: JointResult | None = None
    """Estimate from descriptors and windows."""
    metrics: MetricsPart | None = None
    """Similarity and shifts before and after."""
    geometry: GeometryPart | None = None
    """Addition to homography and lens models."""
    prediction: Prediction | None = None
    """Mapping by the rig, or extrapolated from a part of the image."""
    exposed_after_s: Number3 | None = None
    """Delay of the exposure relative to the reference, s; null if the band is aligned."""
    error: ErrorPart | None = None
    """Parts of the expected error; null if it is unknown."""
    place: PlacePart | None = None
    """Where the aligned pixels of the band are."""
    saturated: Number4 | None = None
    """Share of saturated pixels, within the crop."""
    missing_rows: int = 0
    """Rows at the end of an incomplete file without pixels; they are nodata."""
    share_over_1_px: Number4 | None = None
    """Share of the output's pixels whose expected error exceeds 1 px of the reference or is unknown."""
    moved_share: Number4 | None = None
    """Share of the pixels of the output in areas that moved."""
    seconds: Number3
    """Share of the capture's processing time."""

    @classmethod
    def of_reference(cls, capture: Capture) -> Self:
        """Return the entry of the reference band of a capture."""
        return cls(**_source(capture, capture.reference), status="reference", reason=None, seconds=0.0)

    @classmethod
    def of(cls, band: Band, alignment: Alignment, capture: Capture) -> Self:
        """Return the entry of a moving band of a capture."""
        mapping, relief = alignment.mapping, None
        grid_px = sampled_mapping(mapping.without_parallax, alignment.size_px)
        if mapping.parallax is not None:
            hidden, baseline = mapping.parallax.hidden, mapping.parallax.baseline
            occluded = 0.0 if hidden is None else float(hidden.mean())
            tables = dict(zip(("plane_px", "slope", "curvature"), sampled_parallax(mapping, grid_px), strict=True))
            relief = ReliefPart(file=None, baseline=baseline, occluded=occluded, reference_px=grid_px, **tables)
        fixed, moving = mapping.fixed_lens, mapping.moving_lens
        return cls(
            **_source(capture, band),
            status=alignment.status,
            reason=alignment.reason,
            homography=HomographyPart(fixed_to_moving=mapping.fixed_to_moving, space=alignment.space),
            lenses=None if fixed is None or moving is None else (fixed, moving),
            field=mapping.field,
            grid=GridPart(reference_px=grid_px, moving_px=mapping(grid_px)),
            relief=relief,
            metrics=MetricsPart(before=alignment.before, after=alignment.after, windows=alignment.residual),
            geometry=GeometryPart(kind=alignment.geometry, held_out_p95_px=dict(alignment.held_out_p95_px)),
            error=ErrorPart.of(alignment),
            **_values(alignment, _SAME_IN_ALIGNMENT),
        )

    def mapping(self, relief: Relief | None) -> PixelMapping:
        """Return the mapping of a moving band that has one, given the relief of the capture."""
        assert self.homography is not None
        fixed, moving = self.lenses or (None, None)
        parallax = None
        if self.relief is not None and relief is not None:
            parallax = Parallax(relief, self.relief.baseline).with_occlusions()
        return PixelMapping(self.homography.fixed_to_moving, fixed, moving, field=self.field, parallax=parallax)

    def alignment(self, size_px: Size, mapping: PixelMapping) -> Alignment:
        """Return the alignment of a moving band, given (width, height) of the reference and the mapping of the band."""
        assert self.seed is not None
        metrics = self.metrics or MetricsPart(before=Similarity(), after=Similarity())
        residual = metrics.windows
        return Alignment(
            mapping,
            size_px,
            residual=residual,
            before=metrics.before,
            after=metrics.after,
            held_out_p95_px={} if self.geometry is None else self.geometry.held_out_p95_px,
            is_seed_usable=self.status == "seed_only",
            error=None if self.error is None else self.error.mapping_error(size_px, residual, mapping.parallax),
            std_px=math.inf if self.error is None else self.error.std_px,
            moving_size_px=self.size_px,
            **_values(self, _SAME_IN_ALIGNMENT),
        )

    def is_usable(self, accept_predicted_px: float) -> bool:
        """Return True for the reference, an aligned band, or a predicted band with an accepted expected error."""
        return is_usable(self.status, self.prediction, accept_predicted_px)

    def without_tables(self) -> Self:
        """Return the entry without its long tables."""
        metrics = None if self.metrics is None else self.metrics.model_copy(update={"windows": None})
        return self.model_copy(update={"grid": None, "field": None, "relief": None, "metrics": metrics})


def _source(capture: Capture, band: Band) -> dict[str, Any]:
    """The file of a band."""
    facts = {"band": band.name, "wavelength_nm": band.wavelength_nm, "size_px": band.size_px}
    facts |= {"missing_rows": band.missing_rows}
    return facts | {"file": source_file(capture, band), "band_index": band.band_index}


class IlluminationPart(_Part):
    """Illumination of a band."""

    band: Name
    """Its name."""
    irradiance: Number | None = None
    """By the light sensor, horizontal plane, W/m²/nm (DJI: relative)."""
    reflectance_per_radiance: Positive
    """Factor by which radiance was multiplied."""


class BandRadiometryPart(_Part):
    """Quantity and expected error of a band."""

    band: Name
    """Its name."""
    quantity: Name = ""
    """Such as `reflectance` or `temperature`."""
    source: Name = ""
    """Such as `panel and light sensor`."""
    std_percent: Number3
    """Expected error (1 sigma), percent: root of the sum of the squares of `errors`. Null for a temperature."""
    errors: list[RadiometricError]
    """What its values depend on, with the error by each."""
    cell_means: Annotated[NDArray[np.float64], Array((12, 16), nullable=True)] | None = None
    """Mean of the values in each of 12 x 16 equal cells of the band's own image, row by row; null for a dark image."""


class OutputPart(_Part):
    """Written rasters."""

    file: RelativeFile | None
    """The stack; null with `--layout bands`."""
    bands: list[Name] = []
    """Bands of the stack, in order; missing ones are nodata."""
    radiometry: Name | None = None
    """All quantities and sources, such as `reflectance by panel and light sensor`."""
    panel_age_s: Number | None = None
    """Time to the nearest panel."""
    illumination: list[IlluminationPart] = []
    """Bands with reflectance."""
    band_radiometry: list[BandRadiometryPart] = []
    """Bands that were converted."""
    crop: tuple[int, int, Count, Count]
    """x0, y0, width, height on the reference grid times `scale`."""
    scale: tuple[Positive, Positive] = (1.0, 1.0)
    """Output pixels per reference pixel along x and y."""
    undistorted: bool = False
    """True for a lens-corrected reference grid."""
    vignetting_corrected: bool = False
    """True if vignetting is corrected in the files of single bands."""
    nodata: float | Name | None
    """Nodata value (`"nan"` for NaN); null if it differs between single bands."""
    without_reflectance: Message | None = None
    """Implausible tag that made `--radiometry auto` write radiance."""

    @property
    def light_sources(self) -> dict[str, str]:
        """What the reflectance or relative reflectance of each band is by, for bands that have it; in sidecars without
        quantities of bands, the text about all bands.
        """
        of_all = self.radiometry or ""
        parts = (part for part in self.band_radiometry if "reflectance" in (part.quantity or of_all))
        return {part.band: part.source or of_all for part in parts}

    def std_percent(self, band: str) -> float | None:
        """Return the expected error of a band's radiance or reflectance, percent; None for another band."""
        return next((part.std_percent for part in self.band_radiometry if part.band == band), None)

    @property
    def grid(self) -> OutputGrid:
        """The grid of the rasters."""
        return OutputGrid(*self.crop, PixelScale(*self.scale), self.undistorted)


class FilePart(_Part):
    """A file that belongs to the capture."""

    kind: Name
    """`parallax` (of the estimation); `stack`, `band`, `pan_sharpened`, `relief`, `error_map`, `qa`, `tie_points`,
    `index`, `picture` or `preview`."""
    file: RelativeFile
    """Path."""
    bytes: int
    """Size."""
    sha256: str
    """Checksum."""


class ReliefPreviewPart(_Part):
    """Picture of the parallax: first column, below the expected errors."""

    parallax_px: tuple[Number, Number]
    """Parallax shown as black and as white (nearest), px."""
    range_m: tuple[Number3, Number3] | None
    """1st and 99th percentile of the range, m; null if unknown."""


class PreviewPart(_Part):
    """Pictures for the report, a column per band. Rows: input, output, a detail of each, expected errors, relief,
    indices of the input (if any).
    """

    file: RelativeFile
    """Path."""
    tile_px: tuple[Count, Count]
    """Width and height of a picture."""
    detail_px: tuple[Count, Count]
    """Width and height of a detail."""
    detail: tuple[Number, Number, Number, Number]
    """x0, y0, width, height of the detail, as shares of the image."""
    error_full_px: Number | None = None
    """Expected error shown as white, px."""
    relief: ReliefPreviewPart | None = None
    """Picture of the relief."""
    indices: list[Name] = []
    """Indices of the unaligned bands, a column each; black and white are the ends of their colour scale."""

    @property
    def rows(self) -> dict[str, tuple[int, int, int]]:
        """(top, width and height of a picture) of each row, px, by what it shows."""
        of_file = ("before", "after", "before_detail", "after_detail", "error", "relief", "indices")
        is_there = (True, True, True, True, self.error_full_px is not None, self.relief is not None, self.indices)
        result, top = {}, 0
        for name in compress(of_file, is_there):
            width, height = self.detail_px if name.endswith("detail") else self.tile_px
            result[name] = top, width, height
            top += height
        return result


class Sidecar(_Part):
    """Result of one capture."""

    model_config = ConfigDict(
        json_schema_extra={"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:{SCHEMA}"}
    )

    schema_: Annotated[Literal["agalign/3"], Field(alias="schema")] = "agalign/3"
    """Version of the format, `agalign/3`; later ones may differ."""
    agalign: Name
    """Version of the program."""
    capture: RelativeFile
    """Name of the capture."""
    capture_id: Name
    """From the tags."""
    flight_id: Name
    """From the tags."""
    captured_at: Name
    """Time in the tags, ISO 8601; empty if unknown or the clock was not set."""
    position: Position | None = None
    """GPS position of the reference band."""
    pose: Pose | None = None
    """Orientation and height of the camera."""
    camera: CameraIdentity
    """The camera."""
    status: CaptureStatus
    """`ok`: all bands exist, from complete files, and are `aligned`, or `predicted` within `accept_predicted_px`.
    `failed`: all moving bands are. Else `degraded`."""
    missing_bands: list[Name]
    """Bands that the capture lacks."""
    unreadable_bands: dict[Name, Message] = {}
    """Why missing bands are unreadable."""
    reference: ReferencePart
    """Reference band."""
    bands: Annotated[list[BandResult], Field(min_length=1)]
    """All bands, with the reference."""
    parallax: FilePart | None = None
    """Parallax raster on the pixels of the reference."""
    accept_predicted_px: Number
    """Largest expected error of a predicted band for indices, px of the band."""
    estimated_with: str
    """Fingerprint of everything that the estimation depends on, apart from the contents of the files."""
    model: str = ""
    """Fingerprint of the model of the flight; empty without one."""
    output: OutputPart | None = None
    """Written rasters."""
    footprint: list[tuple[Number, Number]] | None = None
    """Longitude and latitude of the corners of the rasters, degrees, counter-clockwise; the first is repeated."""
    footprint_accuracy_m: Number | None = None
    """Standard error of the farthest corner, m."""
    preview: PreviewPart | None = None
    """Preview image."""
    products: list[FilePart] = []
    """Rendered files."""
    not_written: list[Name] = []
    """Kinds of products that could not be written."""
    rendered_with: str = ""
    """Fingerprint of everything that the products depend on; empty until all are written."""
    options: dict[str, dict[str, Any]] | None = None
    """Settings that differ from the defaults."""
    input_samples: dict[str, str] = {}
    """Hash of some bytes of each band's file."""
    input_digests: dict[str, str] = {}
    """SHA-256 of each band's file."""
    input_states: dict[str, str] = {}
    """Size of each band's file, and the times of its modification and of its last change, ns."""
    seconds: Number3 = 0.0
    """Processing time."""
    checksum: str | None = None
    """SHA-256 of the JSON with sorted keys and no spaces, without `checksum` and `seconds`."""

    @property
    def own_samples(self) -> set[str]:
        """The `input_samples` of files that no other capture has: several mosaics may have one reference."""
        shared = {self.reference.band} if self.reference.georeferenced else set()
        return {sample for band, sample in self.input_samples.items() if band not in shared}

    @classmethod
    def estimated(
        cls,
        capture: Capture,
        alignments: Mapping[str, Alignment],
        settings: Settings,
        exposed_after_s: Mapping[str, float] | None = None,
    ) -> Self:
        """Return the sidecar of a capture whose bands are aligned, and nothing is rendered, without facts about files.

        `exposed_after_s` are the delays of bands that are not aligned, relative to the reference.
        """
        reference, accept_predicted_px = capture.reference, settings.check.accept_predicted_px
        bands = [
            BandResult.of_reference(capture) if b is reference else BandResult.of(b, alignments[b.name], capture)
            for b in capture.bands
        ]
        delays_s = exposed_after_s or {}
        bands = [b.model_copy(update={"exposed_after_s": delays_s.get(b.band)}) for b in bands]
        status = capture_status(bands, capture.missing_bands, accept_predicted_px)
        return cls(
            agalign=__version__,
            capture=capture.name,
            capture_id=capture.capture_id,
            flight_id=capture.flight_id,
            captured_at=capture.known_time,
            position=capture.position,
            pose=capture.pose,
            camera=capture.camera,
            status=status,
            missing_bands=list(capture.missing_bands),
            unreadable_bands={name: str(why) for name, why in capture.unreadable_bands.items()},
            reference=ReferencePart.of(capture),
            bands=bands,
            accept_predicted_px=accept_predicted_px,
            estimated_with=estimation_fingerprint(capture, settings),
            options=settings.model_dump(mode="json", exclude_defaults=True),
        )

    @field_validator("bands")
    @classmethod
    def _has_reference(cls, bands: list[BandResult], given: ValidationInfo) -> list[BandResult]:
        reference = given.data.get("reference")
        if reference is not None and reference.band not in [b.band for b in bands]:
            raise ValueError(f"none of them is the reference band {reference.band!r}")
        return bands

    @property
    def moving(self) -> list[BandResult]:
        """All bands but the reference."""
        return [band for band in self.bands if band.status != "reference"]

    @property
    def usable(self) -> list[BandResult]:
        """The moving bands that indices can use."""
        return [band for band in self.moving if band.is_usable(self.accept_predicted_px)]

    @property
    def pairs(self) -> list[tuple[str, str, str | None]]:
        """(band, status, reason) of every band that is to be aligned; missing bands have the status `missing`."""
        moving = [(b.band, str(b.status), b.reason) for b in self.moving]
        unreadable = self.unreadable_bands
        return [*moving, *((name, "missing", unreadable.get(name, MISSING_BAND.cause)) for name in self.missing_bands)]

    def largest_residual(self, measure: Literal["residual_px", "residual_p95_px"]) -> float | None:
        """Return the largest residual of the aligned bands, px of the reference; None if no window measures one."""
        measured = (b.metrics.after for b in self.bands if b.status == "aligned" and b.metrics is not None)
        known_px = (px for after in measured if math.isfinite(px := getattr(after, measure)))
        return max(known_px, default=None)

    @property
    def write_options(self) -> dict[str, Any]:
        """Settings of the last rendering that differ from the defaults."""
        return (self.options or {}).get("write", {})

    @property
    def files(self) -> list[FilePart]:
        """All files of the capture."""
        return [*self.products, *([] if self.parallax is None else [self.parallax])]

    def mappings(self, relief: Relief | None) -> dict[str, PixelMapping]:
        """Return the mappings of the moving bands by name, given the relief of the capture."""
        return {b.band: b.mapping(relief) for b in self.bands if b.homography is not None and b.seed is not None}

    def alignments(self, mappings: Mapping[str, PixelMapping]) -> dict[str, Alignment]:
        """Return the alignments of the moving bands by name, given their mappings."""
        size_px = self.reference.size_px
        return {b.band: b.alignment(size_px, mappings[b.band]) for b in self.bands if b.band in mappings}

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema of the file, without the examples of docstrings, which are Python."""
        schema = cls.model_json_schema(mode="serialization")
        for part in schema["$defs"].values():
            part["description"] = part["description"].partition("\n\nExamples\n")[0]
        return schema

    def without_tables(self) -> Self:
        """Return the sidecar without the long tables of its bands: those of a season would not fit into memory."""
        return self.model_copy(update={"bands": [b.without_tables() for b in self.bands]})


def capture_status(
    bands: Iterable[BandResult], missing_bands: Sequence[str], accept_predicted_px: float
) -> CaptureStatus:
    """Return `ok` if all moving bands are usable and nothing is missing, `failed` if all failed, else `degraded`."""
    bands = list(bands)
    moving = [b for b in bands if b.status != "reference"]
    if all(b.is_usable(accept_predicted_px) for b in moving):
        return "degraded" if missing_bands or any(b.missing_rows for b in bands) else "ok"
    return "failed" if all(b.status == "failed" for b in moving) else "degraded"
