"""Refinement of an alignment of reduced images on tiles of the files at full resolution.

Tiles are read around windows of the reduced images with a measured shift. The homography is fitted to the windows in
them. Memory is limited by the maximum number of tiles, independent of the size of the files.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import Candidate, mapping_error
from agalign.errors import UnreadableFileError
from agalign.fit.held_out import chessboard
from agalign.fit.window_fit import cross_fitted
from agalign.fit.windows import FixedWindows, residual_under
from agalign.pixels.band_resampling import resample_tile
from agalign.pixels.masks import learnable
from agalign.pixels.raster import OpenRaster, open_raster, read_tile
from agalign.pixels.structure import structure_field
from agalign.values.alignment import Alignment
from agalign.values.capture import Band
from agalign.values.image import Raster, Tile
from agalign.values.issues import UNREADABLE, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import Size
from agalign.values.residual import Residual

_TILE_PX = 640
"""Side of a tile with 36 windows; an error of a few pixels of the reduced images does not move their content out of
it."""

_Tiles = Sequence[tuple[tuple[int, int], Tile, FixedWindows]]
"""Tiles with the windows of the reference; first the column and row of the cell that each tile is in."""


def is_worth_refining(pair: BandPair, alignment: Alignment) -> bool:
    """Return True for an aligned band without a relief whose images lack detail of the files that its result shows.

    A moving file with finer pixels than the reference's is sampled at the reference's, so reducing it to these loses
    nothing.
    """
    if alignment.status != "aligned" or alignment.mapping.parallax is not None:
        return False
    max_scale = 0.7  # of the images relative to their files
    fixed_px = min(pair.scales.fixed)
    moving_pixels = pair.in_moving_file_px(fixed_px, alignment.fixed_to_moving)  # to one of the reference's file
    of_moving = min(pair.scales.moving) * max(1.0, moving_pixels)
    return (of_moving if pair.is_coarse else min(of_moving, fixed_px)) < max_scale


def at_full_resolution(reference: Band, start: Candidate) -> Candidate | Issue | None:
    """Return the candidate that is fitted to tiles of the files, from one by the reduced images, whose displacement
    field it has. The field may be fitted to the pixels of the tiles, so the windows that it is not fitted to, in the
    reduced images, have to pass the checks too.

    None if the tiles have too little structure, or if the shifts of held-out windows do not decrease. The issue
    UNREADABLE if a tile of the moving file cannot be read, because its pixels could not be written either. Raises
    UnreadableFileError for the reference.
    """
    pair = start.pair
    up = pair.scales.fixed.inverse, pair.scales.moving.inverse
    residual, mapping = start.residual.in_file_px(pair.scales), start.mapping.rescaled(*up)
    with open_raster(reference.path, reference.page) as source:
        tiles = _tiles(residual, reference.size_px)
        chosen = [(cell, tile, _windows(source, reference, tile)) for cell, tile in tiles.items()]
    max_moved_px = 40.0  # a larger displacement of a corner contradicts the alignment of the reduced images
    try:
        fitted = cross_fitted(
            mapping,
            lambda at: _residual(pair.bands[0], at, chosen),
            reference.size_px,
            chessboard,
            min((windows.side for *_, windows in chosen), default=_TILE_PX),
            max_moved_px=max_moved_px,
        )
    except UnreadableFileError as unreadable:
        return Issue(UNREADABLE, detail=str(unreadable))
    if fitted is None or start.joint is None or fitted.held_out.median_px >= fitted.at_start.median_px:
        return None
    down, scale = fitted.mapping.rescaled(pair.scales.fixed, pair.scales.moving), pair.scales.fixed
    factors = np.tile(scale, 4)
    joint = start.joint.with_homography(down.fixed_to_moving, fitted.fit.covariance_px2 * np.outer(factors, factors))
    held_out = fitted.held_out.rescaled(scale)
    error = mapping_error(pair, down, joint.covariance_px2, held_out)
    of_field = None if down.field is None else residual_under(start.residual, start.mapping, down)
    refined = Candidate(
        pair,
        down,
        error,
        held_out,
        joint,
        other_residual=of_field,
        held_out_p95_px=start.held_out_p95_px,
        refined_from=start,
    )
    return refined.with_relief_std_px(start.error.relief_std_px)


def _windows(source: OpenRaster, reference: Band, tile: Tile) -> FixedWindows:
    fixed = _raster(*read_tile(reference, tile, source), reference)
    return FixedWindows(fixed.valid, structure_field(fixed))


def _tiles(residual: Residual, size_px: Size) -> dict[tuple[int, int], Tile]:
    """Return a tile for each cell of the reference (width, height), by its column and row: around the window with the
    highest peak in the reduced images.
    """
    # (columns, rows) of cells with one tile each: a few determine eight parameters, all of them fit into memory.
    min_cells, max_cells = (4, 3), (8, 6)
    counts = [min(max(n // _TILE_PX, low), high) for n, low, high in zip(size_px, min_cells, max_cells, strict=True)]
    best: dict[tuple[int, int], Tile] = {}
    for index in np.argsort(residual.peaks_sigma, kind="stable"):
        if math.isfinite(residual.shifts_px[index, 0]):
            (column, x0, width), (row, y0, height) = map(_side, residual.centres_px[index], size_px, counts)
            best[column, row] = Tile(x0, y0, width, height)
    return best


def _side(centre_px: float, length_px: int, cells: int) -> tuple[int, int, int]:
    """Return (cell, start, side) of the tile around a position along one axis; the tile is inside its cell."""
    cell = min(max(int(centre_px / length_px * cells), 0), cells - 1)
    first, end = cell * length_px // cells, (cell + 1) * length_px // cells
    side = min(_TILE_PX, end - first)
    return cell, int(np.clip(centre_px - side / 2, first, end - side)), side


def _residual(moving: Band, mapping: PixelMapping, tiles: _Tiles) -> Residual:
    """Measure the residual of the windows of all tiles, px of the reference's file. Raises UnreadableFileError."""
    parts = [Residual(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty((0, 2), np.int64))]
    with open_raster(moving.path, moving.page) as source:
        for cell, tile, windows in tiles:
            # GDAL's block cache serves neighbouring tiles of the open file.
            warped = resample_tile(moving, mapping, tile, "lanczos", read=partial(read_tile, dataset=source))
            part = windows.residuals(_raster(*warped, moving))
            # The windows of neighbouring tiles are adjacent, as a misaligned area may be in several.
            centres_px = part.centres_px + np.array([tile.x0, tile.y0])
            cells = part.cells + np.array(cell) * (np.array([tile.width, tile.height]) // windows.side)
            parts.append(replace(part, centres_px=centres_px, cells=cells))
    return Residual.joined(parts)


def _raster(pixels: np.ndarray, valid: np.ndarray, band: Band) -> Raster:
    usable = learnable(valid, pixels, band.saturation_value)
    return Raster(np.where(usable, pixels, 0).astype(np.float32), usable)
