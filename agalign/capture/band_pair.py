"""A pair of a moving image and the reference, in the form that estimation takes, with its candidate mappings."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.reference import Reference
from agalign.capture.tag_seeds import seed_candidates
from agalign.config import SeedSettings
from agalign.errors import AgalignError
from agalign.flight.model import FlightModel
from agalign.flight.rig_prediction import unobserved_error_px
from agalign.pixels.grey import channel_mean
from agalign.pixels.raster import read_for_alignment
from agalign.pixels.resample import warped
from agalign.pixels.stripes import without_common_stripes
from agalign.values import geometry
from agalign.values.alignment import SAME_SCALES, DisplacementField, PairScales
from agalign.values.capture import Band, Capture
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.issues import NO_SUCH_SEED, UNREADABLE, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import (
    FixedFilePx,
    FixedImagePoints,
    FixedImagePx,
    MovingFilePx,
    MovingImagePoints,
    PixelScale,
)
from agalign.values.relief import Parallax

Candidates = Mapping[SeedKind, Matrix]
"""fixed_to_moving homographies between undistorted pixels, in order of trust."""
_STANDARD_DEVIATIONS = 3.0
"""Errors of candidates beyond this many standard deviations are not expected."""
_TAGS_STD_PX = 5.0
"""Rig tags are off by 2 px in the median and 12 at most on five cameras (docs/cameras.md)."""
_MIN_MODEL_STD_PX = 1.0
"""Captures of a flight differ by as much in height and tilt, whatever the rig's own errors."""
_PLAINLY_REDUCED = 0.7
"""Scale of the images relative to their files below which the files are worth another look."""
_LONGEST_SIDE_PX = 2700
"""Larger images are reduced to this for estimation: it bounds memory and time; `full_resolution` refines the result.
The bands of most cameras have fewer pixels (2592 on the Mavic 3M)."""
_COARSE_RATIO = 0.4
"""A moving band with fewer pixels than this for each pixel of the reference, along a line of the ground, is coarse: the
reference is reduced for it."""
_COARSE_OVERSAMPLING = 2.0
"""Pixels of the reduced reference for each pixel of a coarse band: more of them add no detail that both images show."""
_COARSE_MIN_PX = 128
"""Longer side of a reference that is reduced for a coarse band, at least: fewer pixels leave no room for windows."""


@dataclass(frozen=True)
class BandPair:
    """One moving image and the reference."""

    name: str
    """The name of the moving band, or of the first of several bands of one lens."""
    reference: Reference
    moving_image: Raster
    candidates: Candidates
    bands: tuple[Band, ...] = ()
    """The moving bands: one, or three of a colour photograph; none where the images are arrays."""
    scales: PairScales = SAME_SCALES
    """Of the two images relative to their files."""
    known_to_px: Mapping[SeedKind, FixedImagePx] = dataclasses.field(default_factory=dict)
    """Standard errors of candidates, where known."""
    is_coarse: bool = False
    """The moving image has so few pixels that the reference is reduced for it."""
    field: DisplacementField | None = None
    """Displacements before any homography, px of the fixed image: the flight's field of the lenses."""
    layout: tuple[float, float] | None = None
    """Direction (x, y) in which the moving image moves relative to the reference as the scene comes nearer, in the unit
    of the camera's other bands; None where the tags do not give it.
    """

    @classmethod
    def of_images(
        cls, name: str, fixed: Raster, moving: Raster, candidates: Candidates,
        known_to_px: Mapping[SeedKind, FixedImagePx] | None = None,
    ) -> "BandPair":  # fmt: skip
        """A single pair of images at their own resolution."""
        return cls(name, Reference(fixed), moving, candidates, known_to_px=known_to_px or {})

    @property
    def space(self) -> Space:
        """The pixels between which the homographies are: undistorted ones where both lenses are known."""
        both = self.reference.image.lens is not None and self.moving_image.lens is not None
        return "undistorted" if both else "pixel"

    @property
    def is_reduced(self) -> bool:
        """True where the files have enough more pixels than the images for a refinement on them."""
        return min(*self.scales.moving, *(() if self.is_coarse else self.scales.fixed)) < _PLAINLY_REDUCED

    @property
    def file_px(self) -> float:
        """Length of a pixel of the reference's file, px of the fixed image; 1 where a coarse band decides what can be
        resolved.
        """
        return 1.0 if self.is_coarse else min(self.scales.fixed)

    @property
    def reach_px(self) -> FixedImagePx:
        """Largest distance of a result from its seed: infinite unless the user gave the seed."""
        return self.known_to_px.get("user", FixedImagePx(math.inf)) * _STANDARD_DEVIATIONS

    @property
    def is_known_to_a_rig(self) -> bool:
        """True where the flight's rig has a mapping of this band."""
        return "model" in self.known_to_px

    @property
    def has_rig_pixels(self) -> bool:
        """True where the homographies are between the same pixels as those of the flight's rig.

        These are undistorted where the lens of the reference is known.
        """
        return self.space == ("pixel" if self.reference.image.lens is None else "undistorted")

    @property
    def fixed(self) -> Raster:
        """The reference's image, with its lens where the homographies are between undistorted pixels."""
        return self.reference.image if self.space == "undistorted" else self.reference.raw

    @property
    def moving(self) -> Raster:
        """The moving image, likewise."""
        return self.moving_image if self.space == "undistorted" else replace(self.moving_image, lens=None)

    def mapping(
        self, fixed_to_moving: Matrix, local: DisplacementField | None = None, parallax: Parallax | None = None
    ) -> PixelMapping:
        """The complete mapping between the raw pixels of the two images, by all displacements or else the rig's."""
        lenses = self.fixed.lens, self.moving.lens
        return PixelMapping(fixed_to_moving, *lenses, local=local or self.field, parallax=parallax)

    def warped_moving(self, mapping: PixelMapping) -> Raster:
        """The moving image, one channel, on the reference's pixels."""
        return warped(channel_mean(self.moving_image), mapping, self.fixed.size_px)

    def is_expected(self, fixed_to_moving: Matrix, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """True where a mapping, after a shift in px of the fixed image, agrees with some candidate within three of the
        candidate's standard errors.

        Both map the same moving point: its distance in the fixed image is what the standard errors refer to.
        """
        shifted = geometry.compose(fixed_to_moving, geometry.translation(*shift_px))
        middle = FixedImagePoints((np.array(self.fixed.size_px) - 1) / 2)
        mapped = MovingImagePoints(geometry.apply(shifted, middle))
        return any(
            self._distance_px(middle, mapped, self.candidates[kind]) <= std_px * _STANDARD_DEVIATIONS
            for kind, std_px in self.known_to_px.items()
            if kind in self.candidates
        )

    @staticmethod
    def _distance_px(fixed: FixedImagePoints, moving: MovingImagePoints, fixed_to_moving: Matrix) -> FixedImagePx:
        """Distance of a point (2,) of the fixed image from the one that a homography maps to a point (2,) of the
        moving image.
        """
        return FixedImagePx(np.linalg.norm(geometry.apply(geometry.invert(fixed_to_moving), moving) - fixed))

    @property
    def reference_file_px(self) -> tuple[int, int]:
        """(width, height) of the reference's file."""
        width, height = (round(n / s) for n, s in zip(self.fixed.size_px, self.scales.fixed, strict=True))
        return width, height

    def in_moving_file_px(self, distance_px: FixedImagePx, fixed_to_moving: Matrix) -> MovingFilePx:
        """A distance in the fixed image as one in the moving file, under a homography between the images."""
        between_files = self.scales.between_files(fixed_to_moving)
        magnification = float(geometry.local_scale(between_files, *self.reference_file_px)[-1])
        return MovingFilePx(distance_px / min(self.scales.fixed) * abs(magnification))


def read_pairs(
    capture: Capture, settings: SeedSettings, model: FlightModel | None = None
) -> tuple[list[BandPair], dict[str, Issue]]:
    """(the pairs, one for each lens; {band: why it cannot take part}).

    The mappings of a flight's `model` come before those of the tags.
    Raises UnreadableFileError where the reference cannot be read.
    """
    references = {_LONGEST_SIDE_PX: Reference(read_for_alignment(capture.reference, _LONGEST_SIDE_PX))}
    pairs: list[BandPair] = []
    left_out: dict[str, Issue] = {}
    for bands in capture.moving_lenses:
        candidates = _candidates(capture.reference, bands[0], settings, model)
        if not candidates:
            issue = Issue(NO_SUCH_SEED, detail=str(settings.force))
            left_out |= dict.fromkeys((b.name for b in bands), issue)
            continue
        try:
            moving = _mean(read_for_alignment(b, _LONGEST_SIDE_PX) for b in bands)
        except AgalignError as error:
            left_out |= dict.fromkeys((b.name for b in bands), Issue(UNREADABLE, detail=str(error)))
            continue
        longest = longest_for(capture.reference, next(iter(candidates.values())))
        if longest not in references:
            references[longest] = Reference(read_for_alignment(capture.reference, longest))
        pairs.append(_pair(capture.reference, references[longest], longest, bands, moving, candidates, model))
    return _without_stripes(pairs, references[_LONGEST_SIDE_PX]), left_out


def _without_stripes(pairs: Sequence[BandPair], reference: Reference) -> list[BandPair]:
    """The pairs; those with this reference, without the pattern of rows and columns that their sensors share."""
    moving = [pair.moving_image for pair in pairs if pair.reference is reference]
    fixed, *cleaned = without_common_stripes([reference.image, *moving])
    same = reference if fixed is reference.image else Reference(fixed)
    images = iter(cleaned)
    return [
        replace(pair, reference=same, moving_image=next(images)) if pair.reference is reference else pair
        for pair in pairs
    ]


def _candidates(reference: Band, moving: Band, settings: SeedSettings, model: FlightModel | None) -> Candidates:
    """fixed_to_moving between undistorted pixels of the files; none where a forced kind is not available."""
    candidates = seed_candidates(reference, moving, settings)
    if model is not None and moving.name in model.mappings:
        return {"model": model.mappings[moving.name], **candidates}
    return candidates


def _pair(
    band: Band, reference: Reference, longest: int, bands: Sequence[Band], moving: Raster, candidates: Candidates,
    model: FlightModel | None,
) -> BandPair:  # fmt: skip
    """The pair of `reference`, the image of `band` with its longer side at most `longest`, and the `moving` image."""
    name = bands[0].name
    is_coarse = longest < min(_LONGEST_SIDE_PX, max(band.size_px))
    scales = PairScales(
        PixelScale.between(band.size_px, reference.image.size_px), PixelScale.between(bands[0].size_px, moving.size_px)
    )
    reduced: Candidates = {kind: scales.between_images(matrix) for kind, matrix in candidates.items()}
    field = None if model is None or model.rig is None else model.rig.fields.get(name)
    field = None if field is None else field.rescaled(scales.fixed)
    known = _known_to_px(name, model, scales.fixed)
    return BandPair(
        name, reference, moving, reduced, tuple(bands), scales, known, is_coarse, field, _layout(band, bands[0])
    )


def _layout(reference: Band, moving: Band) -> tuple[float, float] | None:
    """Difference of the directions of parallax of two bands."""
    if reference.parallax is None or moving.parallax is None:
        return None
    return moving.parallax[0] - reference.parallax[0], moving.parallax[1] - reference.parallax[1]


def longest_for(reference: Band, fixed_to_moving: Matrix) -> int:
    """Longer side to which the reference is reduced for a moving band, px.

    Only a band with much larger pixels, as of a thermal camera, needs fewer than the usual maximum.
    """
    ratio = abs(float(geometry.local_scale(fixed_to_moving, *reference.size_px)[-1]))
    if not 0 < ratio < _COARSE_RATIO:
        return _LONGEST_SIDE_PX
    side = round(_COARSE_OVERSAMPLING * ratio * max(reference.size_px))
    return min(_LONGEST_SIDE_PX, max(side, _COARSE_MIN_PX))


def _known_to_px(band: str, model: FlightModel | None, scale: PixelScale) -> dict[SeedKind, FixedImagePx]:
    """Standard errors of candidates: of tags, and of the flight's mean. `scale` is that of the fixed image."""
    known: dict[SeedKind, FixedImagePx] = dict.fromkeys(("rig", "centre"), FixedImagePx(_TAGS_STD_PX * scale.x))
    if model is not None and model.rig is not None and band in model.rig.mean:
        mean, rig = model.rig.mean[band], model.rig
        # The errors of a rig are in px of the band's own file.
        ratio = abs(float(geometry.local_scale(mean, *rig.size_px)[-1]))
        error_px = FixedFilePx(unobserved_error_px(rig, band, by_neighbours=False) / ratio)
        known["model"] = FixedImagePx(max(error_px, _MIN_MODEL_STD_PX) * scale.x)
    return known


def _mean(rasters: Iterable[Raster]) -> Raster:
    first, *others = rasters
    if not others:
        return first
    pixels = np.asarray(np.mean([first.pixels, *(r.pixels for r in others)], axis=0, dtype=np.float32))
    return replace(first, pixels=pixels, valid=np.logical_and.reduce([first.valid, *(r.valid for r in others)]))
