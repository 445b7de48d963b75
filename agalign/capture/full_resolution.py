"""Refinement of an alignment of reduced images on tiles of the files at full resolution.

Tiles are read around windows of the reduced images with a measured shift. They form a chessboard: the homography is
fitted to the windows in the tiles of one colour and verified with those of the other. Memory is limited by the maximum
number of tiles, independent of the size of the files.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from agalign.errors import UnreadableFileError
from agalign.fit.window_fit import fit_in_rounds
from agalign.fit.windows import FixedWindows
from agalign.flight.rig import distance_px
from agalign.pixels.band_resampling import resample_tile
from agalign.pixels.masks import learnable
from agalign.pixels.raster import OpenRaster, open_raster, read_tile
from agalign.pixels.structure import structure_field
from agalign.values.alignment import Alignment, Residual
from agalign.values.capture import Band
from agalign.values.image import Raster, Tile
from agalign.values.issues import UNREADABLE, Issue
from agalign.values.mapping import PixelMapping
from agalign.verify.checks import Evidence, issues_of

_TILE_PX = 640
"""Side of a tile with 36 windows; an error of a few pixels of the reduced images does not move their content out of
it."""

_Tiles = Sequence[tuple[Tile, FixedWindows]]
"""Tiles with the windows of the reference."""


def at_full_resolution(reference: Band, moving: Band, alignment: Alignment) -> Alignment:
    """Refine an alignment between the files of two bands that was estimated on reduced images.

    It is returned unchanged if the tiles have too little structure or the refined one does not pass verification. It is
    `failed` if a tile of the moving file cannot be read, because its pixels could not be written either. Raises
    UnreadableFileError for the reference.
    """
    with open_raster(reference.path, reference.page) as source:
        for_fit, held_out = (
            [(tile, _windows(source, reference, tile)) for tile in of_colour]
            for of_colour in _tiles(reference, alignment)
        )
    try:
        refined = _refined(alignment, moving, for_fit, held_out, reference.size_px)
    except UnreadableFileError as error:
        issue = Issue(UNREADABLE, detail=str(error))
        without = replace(alignment, mapping=alignment.seed_mapping, issues=(issue,), prediction=None)
        return replace(without, joint=None, residual=None)
    return alignment if refined is None else refined


def _windows(source: OpenRaster, reference: Band, tile: Tile) -> FixedWindows:
    fixed = _raster(*read_tile(reference, tile, source), reference)
    return FixedWindows(fixed.valid, structure_field(fixed))


def _refined(
    alignment: Alignment, moving: Band, for_fit: _Tiles, held_out: _Tiles, size_px: tuple[int, int]
) -> Alignment | None:
    """Return the alignment fitted to half of the tiles, with its covariance and the residual of the other half.

    None if the median shift of that half does not decrease or a check finds an issue. Raises UnreadableFileError.
    """
    max_step_px = 40.0  # a larger displacement of a corner contradicts the alignment of the reduced images
    fitted = fit_in_rounds(
        alignment.mapping,
        lambda mapping: _residual(moving, mapping, for_fit),
        size_px,
        lambda fit: fit.max_px <= max_step_px,
    )
    if fitted is None or alignment.joint is None:
        return None
    mapping, fit = fitted
    before, after = (_residual(moving, m, held_out) for m in (alignment.mapping, mapping))
    if not after.median_px < before.median_px:
        return None
    joint = alignment.joint.with_homography(mapping.fixed_to_moving, fit.covariance_px2)
    prediction = alignment.prediction
    if prediction is not None:
        off_px = distance_px(mapping.fixed_to_moving, prediction.fixed_to_moving, size_px)
        prediction = replace(prediction, off_px=off_px)
    if issues_of(Evidence(joint, after, size_px, prediction=prediction)):
        return None
    return replace(alignment, mapping=mapping, joint=joint, residual=after, prediction=prediction)


def _tiles(reference: Band, alignment: Alignment) -> tuple[list[Tile], list[Tile]]:
    """Return, for each cell, a tile around the window with the highest peak in the reduced images, by colour."""
    residual, size_px = alignment.residual, reference.size_px
    if residual is None:
        return [], []
    # (columns, rows) of cells with one tile each: half of them determine eight parameters, all of them fit into memory.
    min_cells, max_cells = (4, 3), (8, 6)
    counts = [min(max(n // _TILE_PX, low), high) for n, low, high in zip(size_px, min_cells, max_cells, strict=True)]
    best: dict[tuple[int, int], Tile] = {}
    for index in np.argsort(residual.peaks_sigma, kind="stable"):
        if math.isfinite(residual.shifts_px[index, 0]):
            (column, x0, width), (row, y0, height) = map(_side, residual.centres_px[index], size_px, counts)
            best[column, row] = Tile(x0, y0, width, height)
    black, white = ([tile for cell, tile in best.items() if sum(cell) % 2 == colour] for colour in (0, 1))
    return black, white


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
        for tile, windows in tiles:
            # GDAL's block cache serves neighbouring tiles of the open file.
            warped = resample_tile(moving, mapping, tile, "lanczos", read=partial(read_tile, dataset=source))
            part = windows.residuals(_raster(*warped, moving))
            origin_px = np.array([tile.x0, tile.y0])
            centres_px = part.centres_px + origin_px
            cells = (centres_px // windows.side).astype(np.int64)  # windows share no pixels, so each has its own
            parts.append(replace(part, centres_px=centres_px, cells=cells))
    return Residual.joined(parts)


def _raster(pixels: np.ndarray, valid: np.ndarray, band: Band) -> Raster:
    usable = learnable(valid, pixels, band.saturation_value)
    return Raster(np.where(usable, pixels, 0).astype(np.float32), usable)
