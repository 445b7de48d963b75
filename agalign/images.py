"""A capture's images as the estimation sees them, each beside the reference and with the seeds that its tags offer."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from agalign import geometry
from agalign.choices import SeedKind
from agalign.config import Settings
from agalign.errors import AgalignError
from agalign.geometry import Matrix
from agalign.raster import read_for_alignment
from agalign.records import Band, Capture, Raster
from agalign.seed import seed_candidates

Candidates = Mapping[SeedKind, Matrix]


@dataclass(frozen=True)
class PairImages:
    """The reference and the moving bands that one lens took."""

    reference: Band
    moving_bands: tuple[Band, ...]
    """One, but for colour photographs."""
    fixed: Raster
    moving: Raster
    candidates: Candidates
    """fixed_to_moving between undistorted pixels of the two images, in order of trust."""

    @property
    def name(self) -> str:
        """The moving band's, or the first one's."""
        return self.moving_bands[0].name

    @property
    def scales(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(x, y) of the fixed and of the moving image relative to their files."""
        return _scale(self.fixed, self.reference), _scale(self.moving, self.moving_bands[0])

    def in_file_px(self, fixed_to_moving: Matrix) -> Matrix:
        """A homography between the images as one between their files."""
        return geometry.rescale(fixed_to_moving, *((1 / x, 1 / y) for x, y in self.scales))


def moving_lenses(capture: Capture) -> list[tuple[Band, ...]]:
    """The moving bands, those together that one lens took; without those that the reference's own lens took."""
    groups: dict[object, list[Band]] = {}
    for index, band in enumerate(capture.moving):
        if not _through_the_references_lens(band, capture):
            groups.setdefault(band.path if band.one_lens else index, []).append(band)
    return [tuple(group) for group in groups.values()]


def bands_of_the_references_lens(capture: Capture) -> list[Band]:
    """Moving bands that lie on the reference by construction."""
    return [b for b in capture.moving if _through_the_references_lens(b, capture)]


def _through_the_references_lens(band: Band, capture: Capture) -> bool:
    return band.one_lens and band.path == capture.reference.path


def read_pairs(
    capture: Capture, settings: Settings, known: Mapping[str, Matrix] | None = None
) -> tuple[list[PairImages], dict[str, str]]:
    """(the pairs, {band: why it cannot be read}).

    `known` are mappings by band, undistorted px of the files, to try before what the tags say.
    Raises UnreadableFileError where the reference cannot be read.
    """
    reference, longest = capture.reference, settings.joint.longest_side_px
    whole = read_for_alignment(reference, longest)
    pairs: list[PairImages] = []
    unreadable: dict[str, str] = {}
    for bands in moving_lenses(capture):
        try:
            moving = _mean(read_for_alignment(b, longest) for b in bands)
        except AgalignError as error:
            unreadable |= dict.fromkeys((b.name for b in bands), str(error))
            continue
        candidates = seed_candidates(reference, bands[0], settings.seed)
        if known is not None and bands[0].name in known and settings.seed.force is None:
            candidates = {"model": known[bands[0].name], **candidates}
        # Without both lenses nothing can be undistorted.
        lenses = whole.lens is not None and moving.lens is not None
        fixed, moving = (r if lenses else replace(r, lens=None) for r in (whole, moving))
        scales = _scale(fixed, reference), _scale(moving, bands[0])
        down: Candidates = {kind: geometry.rescale(m, *scales) for kind, m in candidates.items()}
        pairs.append(PairImages(reference, bands, fixed, moving, down))
    return pairs, unreadable


def _mean(rasters: Iterable[Raster]) -> Raster:
    first, *others = rasters
    if not others:
        return first
    pixels = np.asarray(np.mean([first.pixels, *(r.pixels for r in others)], axis=0, dtype=np.float32))
    return replace(first, pixels=pixels, valid=np.logical_and.reduce([first.valid, *(r.valid for r in others)]))


def _scale(raster: Raster, band: Band) -> tuple[float, float]:
    return raster.size_px[0] / band.width_px, raster.size_px[1] / band.height_px
