"""Band pairs: the reference and a moving image at the resolution of the estimation, with initial mappings."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agalign.cameras.tag_seeds import tag_seeds
from agalign.capture.reference import LONGEST_SIDE_PX, Reference, is_coarse, longest_for
from agalign.config import SeedSettings
from agalign.errors import AgalignError
from agalign.fit.windows import FixedWindows
from agalign.flight.model import FlightModel
from agalign.flight.rig import Rig
from agalign.flight.rig_prediction import unobserved_error_px
from agalign.pixels.band_resampling import MIN_VALID_SHARE, channel_mean, textured, warped
from agalign.pixels.raster import ReadTile, read_for_alignment
from agalign.pixels.stripes import without_common_stripes
from agalign.pixels.structure import blur_px
from agalign.values import geometry
from agalign.values.capture import Band, Capture, relative_parallax
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import SAME_SCALES, Matrix, PairScales
from agalign.values.image import Raster
from agalign.values.issues import BLANK_MOVING, FEW_VALID, NO_SUCH_SEED, UNREADABLE, Issue, IssueKind
from agalign.values.lens_shapes import lens_std_px
from agalign.values.mapping import DisplacementField, PixelMapping

SeedMatrices = Mapping[SeedKind, Matrix]
"""fixed_to_moving homographies between undistorted pixels, in order of preference."""
_TAGS: tuple[SeedKind, ...] = "rig", "centre"
"""Initial mappings by tags."""
_MAX_ERROR_STD = 3.0
"""Maximum error of an initial mapping in standard errors."""


@dataclass(frozen=True)
class BandPair:
    """The reference and one moving image."""

    name: str
    """Name of the moving band, or of the first of several bands of one lens."""
    reference: Reference
    moving_image: Raster
    seed_matrices: SeedMatrices
    bands: tuple[Band, ...] = ()
    """The moving bands: one, or three of an RGB image; empty for arrays."""
    scales: PairScales = SAME_SCALES
    """Scales of the two images relative to their files."""
    seed_std_px: Mapping[SeedKind, float] = dataclasses.field(default_factory=dict)
    """Standard errors of these, where known."""
    is_coarse: bool = False
    """The moving image has so few pixels that the reference is reduced for it."""
    field: DisplacementField | None = None
    """Displacement field of the lenses by the flight's rig, px of the fixed image; applied before a homography."""
    is_lens_known: bool = False
    """The flight's rig contains the mapping of the band in all parts of the image."""
    relief_std_px: float = 0.0
    """RMS displacement by the reliefs of the flight, which a homography does not contain, px of the fixed image."""
    layout: tuple[float, float] | None = None
    """Direction (x, y) in which points move in the moving image, relative to the reference, when the scene comes
    nearer, in a unit common to the camera's bands; None if the tags do not contain it."""

    @property
    def space(self) -> Space:
        """The pixels between which the homographies are: undistorted ones if both lenses are known."""
        both = self.reference.image.lens is not None and self.moving_image.lens is not None
        return "undistorted" if both else "pixel"

    @property
    def file_pixel_size_px(self) -> float:
        """Size of a pixel of the reference's file, px of the fixed image; 1 for a coarse band, which has lower
        resolution.
        """
        return 1.0 if self.is_coarse else self.scales.fixed.mean

    @property
    def max_shift_px(self) -> float:
        """Maximum distance of what a search or a fit to windows finds from its seed; infinite unless the user gave
        the seed. In repetitive scenes, it is that of every result.
        """
        return self.seed_std_px.get("user", math.inf) * _MAX_ERROR_STD

    @property
    def has_rig(self) -> bool:
        """True if the flight's rig contains this band."""
        return "model" in self.seed_std_px

    @property
    def has_rig_pixels(self) -> bool:
        """True if the homographies are between the same pixels as those of the flight's rig.

        These are undistorted if the lens of the reference is known.
        """
        return self.space == ("pixel" if self.reference.image.lens is None else "undistorted")

    @cached_property
    def is_blurred(self) -> bool:
        """True if one of the images is blurred: shifts of small windows are then noisy."""
        max_sharp_px = 2.5  # length at which a sharp image varies
        return max(self.reference.blur_px, blur_px(channel_mean(self.moving_image))) > max_sharp_px

    @property
    def is_georeferenced(self) -> bool:
        """True if georeferences align the two rasters."""
        return "geo" in self.seed_matrices

    @property
    def lens_std_px(self) -> NDArray[np.float64]:
        """(4,) standard deviations of the lens shapes that the lenses of the two images do not contain."""
        return lens_std_px(self.fixed.size_px, calibrated=self.space == "undistorted")

    @property
    def unknown_lens_std_px(self) -> NDArray[np.float64] | None:
        """(4,) standard deviations of lens shapes that nothing determines; None if a rig does, or without lenses."""
        return None if self.is_lens_known or self.is_georeferenced else self.lens_std_px

    @property
    def windows(self) -> FixedWindows:
        """The windows that verify an alignment; `WarpedPair.of` takes small ones where these cover less of it."""
        return self.reference.large_windows if self.is_blurred else self.reference.windows

    @property
    def sizes_px(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of the fixed and the moving image."""
        return self.fixed.size_px, self.moving_image.size_px

    @property
    def fixed(self) -> Raster:
        """The reference image, with its lens if the homographies are between undistorted pixels."""
        return self.reference.image if self.space == "undistorted" else self.reference.raw

    @property
    def moving(self) -> Raster:
        """The moving image, with its lens if the homographies are between undistorted pixels."""
        return self.moving_image if self.space == "undistorted" else replace(self.moving_image, lens=None)

    def mapping(self, fixed_to_moving: Matrix) -> PixelMapping:
        """Return the complete mapping between raw pixels of the images."""
        return PixelMapping(fixed_to_moving, self.fixed.lens, self.moving.lens, field=self.field)

    def warped_moving(self, mapping: PixelMapping) -> Raster:
        """Warp the channel mean of the moving image to the grid of the reference."""
        return warped(channel_mean(self.moving_image), mapping, self.fixed.size_px)

    @property
    def expected_kind(self) -> SeedKind | None:
        """The kind of initial mapping with the smallest standard error, of equal ones the preferred; None if no error
        is known.
        """
        known = (kind for kind in self.seed_matrices if kind in self.seed_std_px)
        return min(known, key=self.seed_std_px.__getitem__, default=None)

    def is_expected(self, fixed_to_moving: Matrix, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """Return True if a mapping agrees with that of `expected_kind` within _MAX_ERROR_STD standard errors.

        The mapping is shifted first by `shift_px` of the fixed image. The distance is measured in the fixed image, to
        which the standard errors refer, between the image centre and the point that the initial mapping maps to the
        same moving point.
        """
        kind = self.expected_kind
        if kind is None:
            return False
        shifted = geometry.compose(fixed_to_moving, geometry.translation(*shift_px))
        centre_px = (np.array(self.fixed.size_px) - 1) / 2
        mapped_px = geometry.apply(shifted, centre_px)
        expected_px = geometry.apply(geometry.invert(self.seed_matrices[kind]), mapped_px)
        return float(np.linalg.norm(expected_px - centre_px)) <= self.seed_std_px[kind] * _MAX_ERROR_STD

    @property
    def reference_file_px(self) -> tuple[int, int]:
        """(width, height) of the reference's file."""
        width, height = (round(n / s) for n, s in zip(self.fixed.size_px, self.scales.fixed, strict=True))
        return width, height

    def in_reference_file_px(self, distance_px: float) -> float:
        """Convert a distance in the fixed image to the reference's file."""
        return distance_px / self.scales.fixed.mean

    def in_moving_file_px(self, distance_px: float, fixed_to_moving: Matrix) -> float:
        """Convert a distance in the fixed image to the moving file, for a homography between the images."""
        between_files = self.scales.between_files(fixed_to_moving)
        return self.in_reference_file_px(distance_px) * geometry.magnification(between_files, *self.reference_file_px)


def read_pairs(
    capture: Capture, settings: SeedSettings, model: FlightModel | None = None, read: ReadTile | None = None
) -> tuple[list[BandPair], dict[str, Issue]]:
    """Read the pairs of a capture, one for each lens; return them and the issues of bands that cannot be used.

    The mappings of a flight's `model` precede those of the tags. `read` reads the pixels of the files, by default
    `read_tile`. Raises UnreadableFileError if the reference cannot be read.
    """
    references = {LONGEST_SIDE_PX: Reference(read_for_alignment(capture.reference, LONGEST_SIDE_PX, read))}
    pairs: list[BandPair] = []
    unusable: dict[str, Issue] = {}
    for bands in capture.moving_lenses:
        matrices = tag_seeds(capture.reference, bands[0], settings)
        if model is not None and bands[0].name in model.mappings:
            matrices = {"model": model.mappings[bands[0].name], **matrices}
        if not matrices:
            issue = Issue(NO_SUCH_SEED, detail=str(settings.force))
            unusable |= dict.fromkeys((b.name for b in bands), issue)
            continue
        by_name: dict[str, Raster] = {}
        for band in bands:
            try:
                by_name[band.name] = read_for_alignment(band, LONGEST_SIDE_PX, read)
            except AgalignError as error:
                unusable[band.name] = Issue(UNREADABLE, detail=str(error))
        if not by_name:
            continue
        longest = longest_for(capture.reference.size_px, next(iter(matrices.values())))
        if longest not in references:
            references[longest] = Reference(read_for_alignment(capture.reference, longest, read))
        usable = {name: image for name, image in by_name.items() if textured(image)} or by_name
        unusable |= {n: blank_issue(image, BLANK_MOVING) for n, image in by_name.items() if n not in usable}
        moving = _mean(_mostly_valid(list(usable.values())))
        pair = _pair(capture.reference, references[longest], bands, moving, matrices, model)
        pairs.append(replace(pair, bands=tuple(b for b in bands if b.name in usable)))
    return _without_stripes(pairs, references[LONGEST_SIDE_PX]), unusable


def _without_stripes(pairs: Sequence[BandPair], reference: Reference) -> list[BandPair]:
    """Remove the common row and column pattern from the images of the pairs with this reference."""
    moving = [pair.moving_image for pair in pairs if pair.reference is reference]
    fixed, *cleaned = without_common_stripes([reference.image, *moving])
    cleaned_reference = reference if fixed is reference.image else Reference(fixed)
    images = iter(cleaned)
    return [
        replace(pair, reference=cleaned_reference, moving_image=next(images)) if pair.reference is reference else pair
        for pair in pairs
    ]


def _pair(
    band: Band,
    reference: Reference,
    bands: Sequence[Band],
    moving: Raster,
    matrices: SeedMatrices,
    model: FlightModel | None,
) -> BandPair:
    """Create the pair of `reference`, the image of `band`, perhaps reduced, and the image of `bands`."""
    name = bands[0].name
    scales = PairScales.of((band.size_px, bands[0].size_px), (reference.image.size_px, moving.size_px))
    reduced: SeedMatrices = {kind: scales.between_images(matrix) for kind, matrix in matrices.items()}
    tags_std_px = 5.0  # their errors in flights have medians of 2 to 9 px and a maximum of 12 px (benchmarks/seeds.py)
    std_px: dict[SeedKind, float] = dict.fromkeys(_TAGS, tags_std_px * scales.fixed.mean)
    layout = relative_parallax(band, bands[0])
    coarse = is_coarse(band.size_px, next(iter(matrices.values())))
    pair = BandPair(name, reference, moving, reduced, tuple(bands), scales, std_px, coarse, layout=layout)
    return pair if model is None or model.rig is None or not pair.has_rig_pixels else _with_rig(pair, model.rig)


def _with_rig(pair: BandPair, rig: Rig) -> BandPair:
    """Return the pair with what the rig of the flight tells about it."""
    field, scale = rig.fields.get(pair.name), pair.scales.fixed
    pair = replace(pair, field=None if field is None else field.rescaled(scale))
    if pair.name not in rig.mean:
        return pair
    min_std_px = 1.0  # of the mean: captures differ by this in height and tilt
    std_px = max(unobserved_error_px(rig, pair.name, by_neighbours=False), min_std_px) * scale.mean
    return replace(
        pair,
        seed_std_px={**pair.seed_std_px, "model": std_px},
        is_lens_known=rig.covers(pair.name),
        relief_std_px=rig.parallax_px.get(pair.name, 0.0) * scale.mean,
    )


def blank_issue(image: Raster, kind: IssueKind) -> Issue:
    """Return the issue of an image that is not `textured`: few valid pixels, or `kind` if all are invalid or equal."""
    share = float(image.valid.mean())
    name = kind.code.removeprefix("blank_")
    return Issue(FEW_VALID, share, MIN_VALID_SHARE, name) if 0 < share <= MIN_VALID_SHARE else Issue(kind)


def _mostly_valid(images: Sequence[Raster]) -> list[Raster]:
    """Return the images without those that are valid in less than half of the area of another: they would mask it."""
    min_share = 0.5
    areas = [np.count_nonzero(image.valid) for image in images]
    return [image for image, area in zip(images, areas, strict=True) if area >= min_share * max(areas)]


def _mean(rasters: Iterable[Raster]) -> Raster:
    """Return the mean of rasters of one size; pixels are valid if they are valid in all."""
    first, *others = rasters
    if not others:
        return first
    pixels = np.asarray(np.mean([first.pixels, *(r.pixels for r in others)], axis=0, dtype=np.float32))
    return replace(first, pixels=pixels, valid=np.logical_and.reduce([first.valid, *(r.valid for r in others)]))
