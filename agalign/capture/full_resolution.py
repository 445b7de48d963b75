"""An alignment that was found on reduced images, sharpened on tiles of the files themselves.

The reduced images say where both show the same; there, tiles of full resolution are read, laid on each other, and the
shifts of their windows move the homography. Memory is that of a few tiles, whatever the size of the files.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from agalign.capture.corner_fit import fit_corners
from agalign.config import CheckSettings
from agalign.pixels.masks import learnable
from agalign.pixels.raster import open_raster, read_window
from agalign.pixels.resample import resample_tile
from agalign.pixels.structure import structure_field
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, Residual
from agalign.values.capture import Band
from agalign.values.image import Raster, Tile
from agalign.values.mapping import PixelMapping, mapping_of
from agalign.verify.residuals import FixedWindows

_TILE_PX = 640
_COLUMNS, _ROWS = 8, 6
"""A tile in each cell of the image."""
_ROUNDS = 3
_MIN_WINDOWS = 24
_REST_PX = 0.02
_MAX_STEP_PX = 40.0
"""Of a corner: beyond, the windows contradict what the reduced images say."""


def at_full_resolution(reference: Band, moving: Band, alignment: Alignment, check: CheckSettings) -> Alignment:
    """An alignment between the files of two bands, found on their reductions, moved to where full resolution has it.

    Where the tiles show too little it stays as it is. Raises UnreadableFileError.
    """
    best, tiles = alignment, _tiles(reference, alignment)
    shown = _shifts(reference, moving, mapping_of(reference, moving, best), tiles, check)
    for _ in range(_ROUNDS):
        known = np.isfinite(shown.shifts_px[:, 0])
        if known.sum() < _MIN_WINDOWS:
            return best
        fixed_lens = reference.lens if alignment.space == "undistorted" else None
        at, there = (lens.undistort(fixed_lens, p[known]) for p in (shown.centres_px, _seen_at(shown)))
        fit = fit_corners(at, there - at, shown.peaks_sigma[known], reference.size_px)
        if not np.abs(fit.mean_px).max() <= _MAX_STEP_PX:
            return best
        change = geometry.moving_corners(fit.mean_px, *reference.size_px)
        step = replace(best, fixed_to_moving=geometry.compose(best.fixed_to_moving, change))
        again = _shifts(reference, moving, mapping_of(reference, moving, step), tiles, check)
        if not again.median_px < shown.median_px:
            break
        best, shown = _known_to(step, fit.covariance_px2, again), again
        if np.abs(fit.mean_px).max() <= _REST_PX:
            break
    return best


def _known_to(alignment: Alignment, covariance_px2: np.ndarray, residual: Residual) -> Alignment:
    joint = alignment.joint
    if joint is not None:
        std = np.sqrt(np.diag(covariance_px2)).reshape(4, 2)
        pairs = tuple((float(x), float(y)) for x, y in std)
        joint = replace(
            joint,
            fixed_to_moving=alignment.fixed_to_moving,
            corner_std_xy_px=pairs,
            corner_covariance_px2=covariance_px2,
        )
    return replace(alignment, joint=joint, residual=residual)


def _seen_at(residual: Residual) -> np.ndarray:
    return residual.centres_px + residual.shifts_px


def _tiles(reference: Band, alignment: Alignment) -> list[Tile]:
    """Around the window of each cell that stands out most on the reduced images."""
    residual, (width, height) = alignment.residual, reference.size_px
    if residual is None:
        return []
    side_x, side_y = min(_TILE_PX, width), min(_TILE_PX, height)
    best: dict[tuple[int, int], tuple[float, Tile]] = {}
    for (x, y), shift, sigma in zip(residual.centres_px, residual.shifts_px, residual.peaks_sigma, strict=True):
        if not math.isfinite(shift[0]):
            continue
        cell = int(x / width * _COLUMNS), int(y / height * _ROWS)
        x0, y0 = (int(np.clip(v - s / 2, 0, n - s)) for v, s, n in ((x, side_x, width), (y, side_y, height)))
        if cell not in best or sigma > best[cell][0]:
            best[cell] = float(sigma), Tile(x0, y0, side_x, side_y)
    return [tile for _, tile in best.values()]


def _shifts(
    reference: Band, moving: Band, mapping: PixelMapping, tiles: Sequence[Tile], check: CheckSettings
) -> Residual:
    """What the windows of all tiles show, px of the reference's file."""
    result = list(_in_tiles(reference, moving, mapping, tiles, check))
    if not result:
        return Residual.of(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    centres, shifts, sigma = (np.concatenate(part) for part in zip(*result, strict=True))
    return Residual.of(centres, shifts, sigma)


def _in_tiles(
    reference: Band, moving: Band, mapping: PixelMapping, tiles: Sequence[Tile], check: CheckSettings
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    for tile in tiles:
        with open_raster(reference.path) as source:
            pixels, valid = read_window(source, reference, tile.x0, tile.y0, tile.width, tile.height)
        fixed = _raster(pixels, valid, reference)
        there = _raster(*resample_tile(moving, mapping, tile, "lanczos"), moving)
        windows = FixedWindows(fixed.valid, structure_field(fixed, check.smoothing_px), check)
        residual = windows.residuals(there)
        yield residual.centres_px + np.array([tile.x0, tile.y0]), residual.shifts_px, residual.peaks_sigma


def _raster(pixels: np.ndarray, valid: np.ndarray, band: Band) -> Raster:
    known = learnable(valid, pixels, band.saturation_value)
    return Raster(np.where(known, pixels, 0).astype(np.float32), known)
