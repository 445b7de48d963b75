"""Refining an alignment of reduced images on tiles of the files themselves.

The residual of the reduced images shows where both bands have structure. Tiles of full resolution are read there. The
shifts of the windows in half of them, like the black fields of a chessboard, move the homography, and those in the
other half verify the result. Memory is that of the windows of 48 tiles, whatever the size of the files.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agalign.capture.corner_fit import CornerFit, corner_correction, with_corners
from agalign.capture.verification import without_result
from agalign.errors import GeometryError, UnreadableFileError
from agalign.flight.factors import distance_px
from agalign.pixels.masks import learnable
from agalign.pixels.raster import OpenRaster, open_raster, read_window
from agalign.pixels.resample import resample_tile_of
from agalign.pixels.structure import structure_field
from agalign.values.alignment import Alignment, Residual
from agalign.values.capture import Band
from agalign.values.image import Raster, Tile
from agalign.values.issues import UNREADABLE, Issue
from agalign.values.mapping import PixelMapping, mapping_of
from agalign.values.pixel_units import FixedFilePx
from agalign.verify.check import Evidence
from agalign.verify.checks import issues_of
from agalign.verify.residuals import FixedWindows

_TILE_PX = 640
"""Side of a tile: 36 windows, which a few pixels of error of the reduced images do not move out of it."""
_MIN_CELLS, _MAX_CELLS = (4, 3), (8, 6)
"""(columns, rows) of the cells with a tile each: as many as tiles fit side by side, enough for eight unknowns in half
of them, and no more than memory allows."""
_ROUNDS = 3
"""A correction is right to first order: later rounds correct what the first leaves."""
_REST_PX = 0.02
"""A step that moves no corner by more is the last one: the windows' own noise is as large."""
_MAX_STEP_PX = 40.0
"""Displacement of a corner beyond which the windows contradict the reduced images instead of refining them."""


def at_full_resolution(reference: Band, moving: Band, alignment: Alignment[FixedFilePx]) -> Alignment[FixedFilePx]:
    """An alignment between the files of two bands, estimated on reduced images, refined at full resolution.

    The earlier alignment stays where the tiles show too little, or where the refined one does not pass verification. A
    moving file with an unreadable tile makes the alignment `failed`: its pixels could not be written either.
    Raises UnreadableFileError for the reference.
    """
    with open_raster(reference.path) as source:
        tiles = [_FixedTile.read(source, reference, *of_cell) for of_cell in _tiles(reference, alignment).items()]
    try:
        refined = _refined(alignment, moving, mapping_of(reference, moving, alignment), tiles, reference.size_px)
    except UnreadableFileError as error:
        issue = Issue(UNREADABLE, detail=str(error))
        failed: Alignment[FixedFilePx] = without_result(alignment.seed, alignment.space, issue)
        return replace(failed, seconds=alignment.seconds)
    return alignment if refined is None else refined


@dataclass(frozen=True)
class _FixedTile:
    """A tile of the reference, read and cut into windows once."""

    cell: tuple[int, int]
    tile: Tile
    windows: FixedWindows

    @classmethod
    def read(cls, source: OpenRaster, reference: Band, cell: tuple[int, int], tile: Tile) -> "_FixedTile":
        pixels, valid = read_window(source, reference, tile.x0, tile.y0, tile.width, tile.height)
        fixed = _raster(pixels, valid, reference)
        return cls(cell, tile, FixedWindows(fixed.valid, structure_field(fixed)))

    @property
    def is_for_fit(self) -> bool:
        """True for the black fields of the chessboard; the white ones verify."""
        return sum(self.cell) % 2 == 0

    def residual(self, source: OpenRaster, moving: Band, mapping: PixelMapping) -> Residual[FixedFilePx]:
        """The residual of its windows, px of the reference's file; `source` is the moving file."""
        warped = _raster(*resample_tile_of(source, moving, mapping, self.tile, "lanczos"), moving)
        in_tile = self.windows.residuals(warped)
        centres_px = in_tile.centres_px + np.array([self.tile.x0, self.tile.y0])
        return Residual[FixedFilePx].of(centres_px, in_tile.shifts_px, in_tile.peaks_sigma)


def _fitted(
    moving: Band, start: PixelMapping, tiles: Sequence[_FixedTile], size_px: tuple[int, int]
) -> tuple[PixelMapping, CornerFit] | None:
    """The mapping corrected in rounds, as long as the median shift falls, and the last correction; None without any."""
    result: tuple[PixelMapping, CornerFit] | None = None
    mapping, residual = start, _residual(moving, start, tiles)
    for _ in range(_ROUNDS):
        fit = corner_correction(mapping, residual, size_px)
        if fit is None or not fit.max_px <= _MAX_STEP_PX:
            break
        try:
            step = replace(mapping, fixed_to_moving=fit.applied_to(mapping.fixed_to_moving, size_px))
        except GeometryError:
            break
        again = _residual(moving, step, tiles)
        if not again.median_px < residual.median_px:
            break
        result, mapping, residual = (step, fit), step, again
        if fit.max_px <= _REST_PX:
            break
    return result


def _refined(
    alignment: Alignment[FixedFilePx],
    moving: Band,
    start: PixelMapping,
    tiles: Sequence[_FixedTile],
    size_px: tuple[int, int],
) -> Alignment[FixedFilePx] | None:
    """The alignment moved to the fit of half of the tiles, with its uncertainty and the residual of the other half.

    None where that half does not confirm it, or any check rejects it. Raises UnreadableFileError.
    """
    fitted = _fitted(moving, start, [t for t in tiles if t.is_for_fit], size_px)
    if fitted is None or alignment.joint is None:
        return None
    mapping, fit = fitted
    held_out = [t for t in tiles if not t.is_for_fit]
    before, after = _residual(moving, start, held_out), _residual(moving, mapping, held_out)
    if not after.median_px < before.median_px:
        return None
    joint = with_corners(alignment.joint, mapping.fixed_to_moving, fit.covariance_px2)
    prediction = alignment.prediction
    if prediction is not None:
        off_px = distance_px(mapping.fixed_to_moving, prediction.fixed_to_moving, size_px)
        prediction = replace(prediction, off_px=off_px)
    if issues_of(Evidence(joint, after, size_px, prediction=prediction)):
        return None
    return replace(
        alignment, fixed_to_moving=mapping.fixed_to_moving, joint=joint, residual=after, prediction=prediction
    )


def _tiles(reference: Band, alignment: Alignment[FixedFilePx]) -> dict[tuple[int, int], Tile]:
    """By cell (column, row): a tile inside the cell, around its window with the highest peak on the reduced images."""
    residual, size_px = alignment.residual, reference.size_px
    if residual is None:
        return {}
    counts = [min(max(n // _TILE_PX, low), high) for n, low, high in zip(size_px, _MIN_CELLS, _MAX_CELLS, strict=True)]
    best: dict[tuple[int, int], tuple[float, Tile]] = {}
    for centre, shift, sigma in zip(residual.centres_px, residual.shifts_px, residual.peaks_sigma, strict=True):
        if not math.isfinite(shift[0]):
            continue
        (column, x0, width), (row, y0, height) = (
            _side(v, n, count) for v, n, count in zip(centre, size_px, counts, strict=True)
        )
        if (column, row) not in best or sigma > best[column, row][0]:
            best[column, row] = float(sigma), Tile(x0, y0, width, height)
    return {cell: tile for cell, (_, tile) in best.items()}


def _side(centre_px: float, length_px: int, cells: int) -> tuple[int, int, int]:
    """(cell, start, side) of the tile around a position, along one axis of an image, without leaving the cell."""
    cell = min(max(int(centre_px / length_px * cells), 0), cells - 1)
    first, end = cell * length_px // cells, (cell + 1) * length_px // cells
    side = min(_TILE_PX, end - first)
    return cell, int(np.clip(centre_px - side / 2, first, end - side)), side


def _residual(moving: Band, mapping: PixelMapping, tiles: Sequence[_FixedTile]) -> Residual[FixedFilePx]:
    """The residual of the windows of all tiles, px of the reference's file. Raises UnreadableFileError for the moving
    file.
    """
    with open_raster(moving.path) as source:
        parts = [tile.residual(source, moving, mapping) for tile in tiles]
    if not parts:
        return Residual[FixedFilePx].of(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    return Residual[FixedFilePx].of(
        np.concatenate([p.centres_px for p in parts]), np.concatenate([p.shifts_px for p in parts]),
        np.concatenate([p.peaks_sigma for p in parts]),
    )  # fmt: skip


def _raster(pixels: np.ndarray, valid: np.ndarray, band: Band) -> Raster:
    known = learnable(valid, pixels, band.saturation_value)
    return Raster(np.where(known, pixels, 0).astype(np.float32), known)
