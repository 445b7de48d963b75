"""Coarse alignments to start from, each scored on the images, the best kept."""

from collections.abc import Mapping as MappingType
from contextlib import suppress

import cv2
import numpy as np

from agalign import geometry
from agalign.cameras import rig_seed
from agalign.choices import SeedKind
from agalign.config import SeedSettings
from agalign.errors import GeometryError
from agalign.geometry import Matrix
from agalign.mapping import Mapping
from agalign.raster import transformed
from agalign.records import Band, Raster, Seed, Tile
from agalign.structure import correlation_surface, find_peak, shrink, structure_field

_SAME_PEAK_PX = 2.0
"""A candidate no farther from the peak than this, in working px, is on its flank."""


def seed_candidates(reference: Band, moving: Band, settings: SeedSettings) -> dict[SeedKind, Matrix]:
    """The coarse mappings that metadata offers, in order of trust; identity is always among them."""
    candidates: dict[SeedKind, Matrix] = {}
    with suppress(GeometryError):  # numbers in the tags that make no camera
        rig = rig_seed(reference, moving)
        if rig is not None:
            candidates["rig"] = rig
    with suppress(GeometryError):
        geo = geo_seed(reference, moving)
        if geo is not None:
            candidates["geo"] = geo
    candidates["identity"] = overlay(reference, moving)
    if settings.force is not None and settings.force in candidates:
        return {settings.force: candidates[settings.force]}
    return candidates


def best_seed(fixed: Raster, moving: Raster, candidates: MappingType[SeedKind, Matrix], settings: SeedSettings) -> Seed:
    """The candidate under which the structures agree best, or one shifted onto the peak of their correlation.

    `candidates` are fixed_to_moving homographies at full resolution, in order of trust. Each is scored at no shift
    and at its best shift; a candidate whose best shift is below `least_shift_px` stays as it is. Where the flight's
    own mapping leaves no doubt, the others are not looked at.
    """
    scored: list[Seed] = []
    for kind, matrix in candidates.items():
        scored += scored_seeds(fixed, moving, kind, matrix, settings)
        best = max(scored, key=lambda seed: seed.score)
        if kind == "model" and is_trusted(best, settings):
            return best
    forced = [s for s in scored if s.kind == settings.force]
    return max(forced or scored, key=lambda seed: seed.score)


def scored_seeds(
    fixed: Raster, moving: Raster, kind: SeedKind, fixed_to_moving: Matrix, settings: SeedSettings
) -> list[Seed]:
    """The candidate itself and, where the structures agree better a shift away, its `structure` variant.

    On a sliver of common area the peak of the correlation means nothing: such a candidate scores 0.
    """
    width, height = fixed.size_px
    scale = min(1.0, settings.working_px / max(width, height))
    size = max(8, round(width * scale)), max(8, round(height * scale))
    scale_xy = size[0] / width, size[1] / height
    small_fixed = single(shrink(fixed, size))
    mapping = Mapping(fixed_to_moving, fixed.lens, moving.lens)
    small_moving = warped(single(moving), mapping, size, scale_xy)
    if small_moving.valid.mean() < settings.least_overlap:
        return [Seed(kind, fixed_to_moving, 0.0)]
    smoothing = settings.smoothing_px
    surface = correlation_surface(structure_field(small_fixed, smoothing), structure_field(small_moving, smoothing))
    peak = find_peak(surface, apart_px=max(size) // 16)
    if np.hypot(*peak.shift_px) < settings.least_shift_px:
        return [Seed(kind, fixed_to_moving, peak.sigma, peak.sigma, peak.runner_up_sigma)]
    shift = geometry.translation(peak.shift_px[0] / scale_xy[0], peak.shift_px[1] / scale_xy[1])
    shifted = geometry.compose(fixed_to_moving, shift)
    # Where the peak is another place, it is what this candidate has to stand up to.
    rival = peak.sigma if np.hypot(*peak.shift_px) > _SAME_PEAK_PX else peak.runner_up_sigma
    unmoved = Seed(kind, fixed_to_moving, peak.sigma_at_zero, peak.sigma_at_zero, rival)
    # The correlation is circular: its peak may lay the images beside each other.
    points = Mapping(shifted, fixed.lens, moving.lens)(geometry.lattice(width, height, 16, 12))
    if ((points >= 0) & (points <= np.subtract(moving.size_px, 1))).all(axis=1).mean() < settings.least_overlap:
        return [unmoved]
    return [unmoved, Seed("structure", shifted, peak.sigma, peak.sigma, peak.runner_up_sigma)]


def is_trusted(seed: Seed, settings: SeedSettings) -> bool:
    """True where the images themselves leave no doubt that the seed is good to a few pixels."""
    return seed.peak_sigma >= max(settings.trusted_sigma, settings.trusted_ratio * seed.runner_up_sigma)


def geo_seed(reference: Band, moving: Band) -> Matrix | None:
    """fixed_to_moving from the two files' geotransforms; None where either has none.

    Between two coordinate reference systems it is the homography nearest to the transformation. Geotransforms count
    from the corner of the top-left pixel, this package from its centre: hence the half pixels. Raises GeometryError.
    """
    here, there = reference.georeference, moving.georeference
    if here is None or there is None:
        return None
    to_corner = geometry.translation(0.5, 0.5)
    # Not geometry.invert: metres in the millions beside pixels of centimetres look singular to it.
    try:
        map_to_there: Matrix = np.linalg.inv(there.transform).astype(np.float64)
    except np.linalg.LinAlgError:
        raise GeometryError(f"{moving.path}: its geotransform cannot be inverted") from None
    if here.crs_wkt == there.crs_wkt:
        return geometry.compose(geometry.invert(to_corner), map_to_there, here.transform, to_corner)
    points = geometry.lattice(*reference.size_px, 9, 7)
    on_map = transformed(geometry.apply(here.transform, points + 0.5), here.crs_wkt, there.crs_wkt)
    found, _ = cv2.findHomography(points, geometry.apply(map_to_there, on_map) - 0.5, 0)
    if found is None or not np.isfinite(found).all():
        raise GeometryError(f"{moving.path}: lies where {reference.path.name}'s coordinates do not reach")
    return geometry.normalised(found)


def overlay(reference: Band, moving: Band) -> Matrix:
    """The mapping that lays the moving file's outline on the reference's: identity where their sizes are equal."""
    scale = moving.width_px / reference.width_px, moving.height_px / reference.height_px
    return geometry.resolution_change(*scale)


def warped(
    moving: Raster, mapping: Mapping, size_px: tuple[int, int], fixed_scale: tuple[float, float] = (1.0, 1.0)
) -> Raster:
    """The moving raster resampled onto the fixed grid reduced by `fixed_scale` to `size_px`, without aliasing.

    `mapping` is between the raw pixels of the two images at their full size.
    """
    if size_px == moving.size_px and not mapping.bends and np.array_equal(mapping.fixed_to_moving, np.eye(3)):
        return moving
    full = round(size_px[0] / fixed_scale[0]), round(size_px[1] / fixed_scale[1])
    magnification = float(np.median(np.abs(geometry.local_scale(mapping.fixed_to_moving, *full))))
    reduce = float(np.clip(fixed_scale[0] / magnification, 8 / min(moving.size_px), 1.0))
    moving_size = max(8, round(moving.size_px[0] * reduce)), max(8, round(moving.size_px[1] * reduce))
    moving_scale = moving_size[0] / moving.size_px[0], moving_size[1] / moving.size_px[1]
    small = shrink(moving, moving_size)
    positions = mapping.rescaled(fixed_scale, moving_scale).positions(Tile(0, 0, *size_px)).astype(np.float32)
    positions = np.nan_to_num(positions, nan=-1e6)
    pixels = cv2.remap(small.pixels, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = small.valid.astype(np.uint8) * 255
    valid = cv2.remap(known, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return Raster(np.asarray(pixels, np.float32), np.asarray(valid == 255))


def single(raster: Raster) -> Raster:
    """One channel: the mean of several."""
    return raster if raster.pixels.ndim == 2 else Raster(raster.pixels.mean(axis=0), raster.valid, raster.lens)
