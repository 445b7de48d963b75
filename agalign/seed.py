"""Coarse alignments to start from, each scored on the images, the best kept."""

import cv2
import numpy as np

from agalign import geometry
from agalign.config import SeedSettings
from agalign.geometry import Matrix
from agalign.records import Band, Raster, Seed, SeedKind
from agalign.structure import correlation_surface, find_peak, shrink, structure_field


def best_seed(fixed: Raster, moving: Raster, candidates: dict[SeedKind, Matrix], settings: SeedSettings) -> Seed:
    """The candidate under which the structures agree best, or one shifted onto the peak of their correlation.

    `candidates` are fixed_to_moving homographies at full resolution, in order of trust. Each is scored at no shift
    and at its best shift; a candidate whose best shift is below `least_shift_px` stays as it is.
    """
    scored = [
        seed for kind, matrix in candidates.items() for seed in scored_seeds(fixed, moving, kind, matrix, settings)
    ]
    if settings.force is not None and settings.force != "structure":
        return next(s for s in scored if s.kind == settings.force)
    if settings.force == "structure":
        scored = [s for s in scored if s.kind == "structure"] or scored
    return max(scored, key=lambda seed: seed.score)


def scored_seeds(
    fixed: Raster, moving: Raster, kind: SeedKind, fixed_to_moving: Matrix, settings: SeedSettings
) -> list[Seed]:
    """The candidate itself and, where the structures agree better a shift away, its `structure` variant."""
    width, height = fixed.size_px
    scale = min(1.0, settings.working_px / max(width, height))
    size = max(8, round(width * scale)), max(8, round(height * scale))
    scale_xy = size[0] / width, size[1] / height
    small_fixed = _single(shrink(fixed, size))
    small_moving = warped(_single(moving), fixed_to_moving, size, scale_xy)
    smoothing = settings.smoothing_px
    surface = correlation_surface(structure_field(small_fixed, smoothing), structure_field(small_moving, smoothing))
    peak = find_peak(surface, apart_px=max(size) // 16)
    if np.hypot(*peak.shift_px) < settings.least_shift_px:
        return [Seed(kind, fixed_to_moving, peak.sigma, peak.sigma, peak.runner_up_sigma)]
    shift = geometry.translation(peak.shift_px[0] / scale_xy[0], peak.shift_px[1] / scale_xy[1])
    shifted = geometry.compose(fixed_to_moving, shift)
    return [
        Seed(kind, fixed_to_moving, peak.sigma_at_zero, peak.sigma_at_zero, peak.runner_up_sigma),
        Seed("structure", shifted, peak.sigma, peak.sigma, peak.runner_up_sigma),
    ]


def is_trusted(seed: Seed, settings: SeedSettings) -> bool:
    """True where the images themselves leave no doubt that the seed is good to a few pixels."""
    return seed.peak_sigma >= max(settings.trusted_sigma, settings.trusted_ratio * seed.runner_up_sigma)


def geo_seed(reference: Band, moving: Band) -> Matrix | None:
    """fixed_to_moving from the two files' geotransforms; None where either has none or their CRS differ.

    Geotransforms count from the corner of the top-left pixel, this package from its centre: hence the half pixels.
    """
    here, there = reference.georeference, moving.georeference
    if here is None or there is None or here.crs_wkt != there.crs_wkt:
        return None
    to_corner = geometry.translation(0.5, 0.5)
    # Not geometry.invert: metres in the millions beside pixels of centimetres look singular to it.
    map_to_there: Matrix = np.linalg.inv(there.transform).astype(np.float64)
    return geometry.compose(geometry.invert(to_corner), map_to_there, here.transform, to_corner)


def overlay(reference: Band, moving: Band) -> Matrix:
    """The mapping that lays the moving file's outline on the reference's: identity where their sizes are equal."""
    scale = moving.width_px / reference.width_px, moving.height_px / reference.height_px
    return geometry.resolution_change(*scale)


def warped(
    moving: Raster, fixed_to_moving: Matrix, size_px: tuple[int, int], fixed_scale: tuple[float, float]
) -> Raster:
    """The moving raster resampled onto the fixed grid reduced by `fixed_scale`, without aliasing."""
    magnification = float(np.median(np.abs(geometry.local_scale(fixed_to_moving, *_full(size_px, fixed_scale)))))
    reduce = float(np.clip(fixed_scale[0] / magnification, 8 / min(moving.size_px), 1.0))
    moving_size = max(8, round(moving.size_px[0] * reduce)), max(8, round(moving.size_px[1] * reduce))
    moving_scale = moving_size[0] / moving.size_px[0], moving_size[1] / moving.size_px[1]
    small = shrink(moving, moving_size)
    matrix = geometry.rescale(fixed_to_moving, fixed_scale, moving_scale)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    pixels = cv2.warpPerspective(small.pixels, matrix, size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    valid = cv2.warpPerspective(small.valid.astype(np.float32), matrix, size_px, flags=flags, borderValue=0.0)
    return Raster(np.asarray(pixels, np.float32), np.asarray(valid > 0.99))


def _full(size_px: tuple[int, int], scale: tuple[float, float]) -> tuple[int, int]:
    return round(size_px[0] / scale[0]), round(size_px[1] / scale[1])


def _single(raster: Raster) -> Raster:
    """One channel: the mean of several."""
    return raster if raster.pixels.ndim == 2 else Raster(raster.pixels.mean(axis=0), raster.valid)
