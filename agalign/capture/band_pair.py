"""A moving image beside the reference, as the estimation sees the two, with the mappings that its tags offer."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.reference import Reference
from agalign.capture.tag_seeds import seed_candidates
from agalign.config import Settings
from agalign.errors import AgalignError
from agalign.flight.model import FlightModel
from agalign.flight.rig_prediction import unobserved_error_px
from agalign.pixels.grey import channel_mean
from agalign.pixels.raster import read_for_alignment
from agalign.pixels.resample import warped
from agalign.pixels.stripes import without_common_stripes
from agalign.values import geometry
from agalign.values.alignment import DisplacementField
from agalign.values.capture import Band, Capture
from agalign.values.choices import SeedKind, Space
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.issues import Issue
from agalign.values.mapping import PixelMapping

Candidates = Mapping[SeedKind, Matrix]
"""fixed_to_moving homographies between undistorted pixels, in order of trust."""
_STANDARD_DEVIATIONS = 3.0
_TAGS_STD_PX = 5.0
"""Rig tags are off by 2 px in the median and 12 at most on five cameras (docs/cameras.md)."""
_MIN_MODEL_STD_PX = 1.0
_PLAINLY_REDUCED = 0.7
_LONGEST_SIDE_PX = 4096
"""Larger images are reduced to this for estimation: it bounds memory and time; `full_resolution` refines the result."""
_COARSE_RATIO = 0.4
"""A moving band with fewer pixels than this for each pixel of the reference, along a line of the ground, is coarse: the
reference is reduced for it."""
_COARSE_OVERSAMPLING = 2.0
"""Pixels of the reduced reference for each pixel of a coarse band: more of them add no detail that both images show."""
_COARSE_MIN_PX = 128
"""Longer side of a reference that is reduced for a coarse band, at least: fewer pixels leave no room for windows."""
_NOT_REDUCED = (1.0, 1.0), (1.0, 1.0)


@dataclass(frozen=True)
class BandPair:
    """One moving image beside the reference."""

    name: str
    """The moving band's, or of several that one lens took, the first one's."""
    reference: Reference
    moving_image: Raster
    candidates: Candidates
    bands: tuple[Band, ...] = ()
    """The moving bands: one, but for colour photographs; none where the images are arrays."""
    scales: tuple[tuple[float, float], tuple[float, float]] = _NOT_REDUCED
    """(x, y) of the fixed and of the moving image relative to their files."""
    known_to_px: Mapping[SeedKind, float] = dataclasses.field(default_factory=dict)
    """Standard deviation of candidates of which one is known: px of the fixed image."""
    is_coarse: bool = False
    """The moving image shows so much less that the reference's is reduced for it."""
    field: DisplacementField | None = None
    """Displacements before any homography, px of the fixed image: what the flight's rig knows of the lenses."""

    @classmethod
    def of_images(
        cls, name: str, fixed: Raster, moving: Raster, candidates: Candidates, settings: Settings,
        known_to_px: Mapping[SeedKind, float] | None = None,
    ) -> "BandPair":  # fmt: skip
        """A single pair of images that are no files' reductions."""
        return cls(name, Reference(fixed, settings), moving, candidates, known_to_px=known_to_px or {})

    @property
    def space(self) -> Space:
        """What the homographies are between: without both lenses nothing can be undistorted."""
        both = self.reference.image.lens is not None and self.moving_image.lens is not None
        return "undistorted" if both else "pixel"

    @property
    def is_reduced(self) -> bool:
        """True where the files show so much more than the images that it is worth looking at them again."""
        return min(*self.scales[1], *(() if self.is_coarse else self.scales[0])) < _PLAINLY_REDUCED

    @property
    def reach_px(self) -> float:
        """How far from its seed it may lie, px of the fixed image: what a user knows is not left."""
        return _STANDARD_DEVIATIONS * self.known_to_px.get("user", np.inf)

    @property
    def is_known_to_a_rig(self) -> bool:
        """True where the captures of a flight told where this band lies."""
        return "model" in self.known_to_px

    @property
    def is_the_rigs(self) -> bool:
        """True where the homographies are between the pixels of the flight's rig: of a reference whose lens is known,
        undistorted ones.
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

    def mapping(self, fixed_to_moving: Matrix, local: DisplacementField | None = None) -> PixelMapping:
        """The complete mapping between the raw pixels of the two images, by all displacements or else the rig's."""
        return PixelMapping(fixed_to_moving, self.fixed.lens, self.moving.lens, local=local or self.field)

    def warped_moving(self, mapping: PixelMapping) -> Raster:
        """The moving image, one channel, on the reference's pixels."""
        return warped(channel_mean(self.moving_image), mapping, self.fixed.size_px)

    def is_expected(self, fixed_to_moving: Matrix, shift_px: tuple[float, float] = (0.0, 0.0)) -> bool:
        """True where a mapping, after a shift in px of the fixed image, agrees with some candidate within three of the
        candidate's standard errors.

        Both map the same moving point: its distance in the fixed image is what the standard errors refer to.
        """
        shifted = geometry.compose(fixed_to_moving, geometry.translation(*shift_px))
        middle = (np.array(self.fixed.size_px) - 1) / 2
        mapped = geometry.apply(shifted, middle)
        return any(
            np.linalg.norm(geometry.apply(geometry.invert(self.candidates[kind]), mapped) - middle)
            <= _STANDARD_DEVIATIONS * std_px
            for kind, std_px in self.known_to_px.items()
            if kind in self.candidates
        )

    @property
    def reference_file_px(self) -> tuple[int, int]:
        """(width, height) of the reference's file."""
        width, height = (round(n / s) for n, s in zip(self.fixed.size_px, self.scales[0], strict=True))
        return width, height

    def in_file_px(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the images as one between their files."""
        return geometry.rescale(fixed_to_moving, *((1 / x, 1 / y) for x, y in self.scales))


def read_pairs(
    capture: Capture, settings: Settings, model: FlightModel | None = None
) -> tuple[list[BandPair], dict[str, Issue]]:
    """(the pairs, one for each lens; {band: why it cannot take part}).

    What a flight's `model` knows is tried before what the tags say.
    Raises UnreadableFileError where the reference cannot be read.
    """
    longest = _LONGEST_SIDE_PX
    references = {longest: Reference(read_for_alignment(capture.reference, longest), settings)}
    pairs: list[BandPair] = []
    left_out: dict[str, Issue] = {}
    for bands in capture.moving_lenses:
        candidates = seed_candidates(capture.reference, bands[0], settings.seed)
        name = bands[0].name
        if model is not None and name in model.mappings:
            candidates = {"model": model.mappings[name], **candidates}
        if not candidates:
            absent = Issue("no_such_seed", detail=str(settings.seed.force))
            left_out |= dict.fromkeys((b.name for b in bands), absent)
            continue
        try:
            moving = _mean(read_for_alignment(b, longest) for b in bands)
        except AgalignError as error:
            left_out |= dict.fromkeys((b.name for b in bands), Issue("unreadable", detail=str(error)))
            continue
        maximum = longest_for(capture.reference, next(iter(candidates.values())))
        if maximum not in references:
            references[maximum] = Reference(read_for_alignment(capture.reference, maximum), settings)
        reference, is_coarse = references[maximum], maximum < min(longest, max(capture.reference.size_px))
        scales = _scale(reference.image, capture.reference), _scale(moving, bands[0])
        down: Candidates = {kind: geometry.rescale(m, *scales) for kind, m in candidates.items()}
        field = None if model is None or model.rig is None else model.rig.fields.get(name)
        field = None if field is None else field.rescaled(scales[0])
        known = _known_to_px(name, model, scales[0])
        pairs.append(BandPair(name, reference, moving, down, bands, scales, known, is_coarse, field))
    return _without_stripes(pairs, references[longest]), left_out


def _without_stripes(pairs: Sequence[BandPair], reference: Reference) -> list[BandPair]:
    """The pairs; those with this reference, without the pattern of rows and columns that their sensors share."""
    moving = [pair.moving_image for pair in pairs if pair.reference is reference]
    fixed, *cleaned = without_common_stripes([reference.image, *moving])
    same = reference if fixed is reference.image else Reference(fixed, reference.settings)
    images = iter(cleaned)
    return [
        replace(pair, reference=same, moving_image=next(images)) if pair.reference is reference else pair
        for pair in pairs
    ]


def longest_for(reference: Band, fixed_to_moving: Matrix) -> int:
    """Longer side that the reference's image is to have beside a moving band: its own, but where the band's pixels are
    much larger, a thermal camera's, so many that a few of them make one of the band's.
    """
    ratio = abs(float(geometry.local_scale(fixed_to_moving, *reference.size_px)[-1]))
    if not 0 < ratio < _COARSE_RATIO:
        return _LONGEST_SIDE_PX
    side = round(_COARSE_OVERSAMPLING * ratio * max(reference.size_px))
    return min(_LONGEST_SIDE_PX, max(side, _COARSE_MIN_PX))


def _known_to_px(band: str, model: FlightModel | None, scale: tuple[float, float]) -> dict[SeedKind, float]:
    """Tags are as good as their makers' parallax; the flight's mean as captures left out of it showed."""
    known: dict[SeedKind, float] = dict.fromkeys(("rig", "centre"), _TAGS_STD_PX * scale[0])
    if model is not None and model.rig is not None and band in model.rig.mean:
        mean, rig = model.rig.mean[band], model.rig
        # What a rig misses is in px of the band's own file.
        ratio = abs(float(geometry.local_scale(mean, *rig.size_px)[-1]))
        known["model"] = max(unobserved_error_px(rig, band, by_neighbours=False) / ratio, _MIN_MODEL_STD_PX) * scale[0]
    return known


def _mean(rasters: Iterable[Raster]) -> Raster:
    first, *others = rasters
    if not others:
        return first
    pixels = np.asarray(np.mean([first.pixels, *(r.pixels for r in others)], axis=0, dtype=np.float32))
    return replace(first, pixels=pixels, valid=np.logical_and.reduce([first.valid, *(r.valid for r in others)]))


def _scale(raster: Raster, band: Band) -> tuple[float, float]:
    return raster.size_px[0] / band.width_px, raster.size_px[1] / band.height_px
