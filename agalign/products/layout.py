"""Which pixels of a capture are written: its layers, and their common grid."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.flight.rig import Rig
from agalign.flight.rig_prediction import extreme_mappings
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.mapping import PixelMapping, mapping_of
from agalign.values.pixel_units import SAME_PIXELS, FixedFilePx, PixelScale

_FLIGHT_MARGIN_PX = 2
"""How far captures that the rig was not learnt on may exceed its extremes."""
_BORDER_POINTS = 64


@dataclass(frozen=True)
class Layer:
    """One band of the output: where its pixels come from.

    `mapping` leads from the written pixels, before they are cut, to raw pixels of the file. The reference has none
    where its own pixels are copied, and a moving band has none if there is nothing to write.
    """

    band: Band
    mapping: PixelMapping | None
    is_reference: bool = False

    @property
    def is_gap(self) -> bool:
        """True where there is nothing to write."""
        return self.mapping is None and not self.is_reference

    @property
    def is_copied(self) -> bool:
        """True where pixels are the file's own."""
        return self.mapping is None and self.is_reference


def output_layers(
    capture: Capture, alignments: Mapping[str, Alignment[FixedFilePx]], settings: WriteSettings, rig: Rig | None = None
) -> tuple[list[Layer], OutputGrid]:
    """The layers of a capture with these alignments of its usable moving bands, and the grid they are written on.

    With the flight's `rig` the grid is that of all its captures: one flight, one geometry.
    """
    pixels = _OutputPixels.of(capture, alignments, settings)
    layers = _layers(capture, alignments, pixels)
    # The crop is that of the reference plane; relief may leave pixels of single bands without a value.
    moved = [(layer.mapping.of_the_plane, layer.band) for layer in layers if layer.mapping is not None]
    crop = _crop(capture, moved, pixels, settings, rig)
    has_relief = any(layer.mapping is not None and layer.mapping.parallax is not None for layer in layers)
    has_gaps = has_relief or not _covers(moved, crop)
    grid = OutputGrid(crop.x0, crop.y0, crop.width, crop.height, pixels.scale, pixels.undistorted, has_gaps)
    return layers, grid


@dataclass(frozen=True)
class _OutputPixels:
    """The reference's pixels as they are written, before the crop: finer, or without lens distortion."""

    reference: Band
    size_px: tuple[int, int]
    undistorted: bool

    @classmethod
    def of(
        cls, capture: Capture, alignments: Mapping[str, Alignment[FixedFilePx]], settings: WriteSettings
    ) -> "_OutputPixels":
        reference, scale = capture.reference, 1.0
        if settings.resolution == "finest":
            scale = _finest_scale(_mappings(capture, alignments).values(), reference)
        size_px = round(reference.width_px * scale), round(reference.height_px * scale)
        return cls(reference, size_px, settings.undistort and reference.lens is not None)

    @property
    def scale(self) -> PixelScale:
        """Output pixels per pixel of the reference's file."""
        return PixelScale.between(self.reference.size_px, self.size_px)

    @property
    def are_copied(self) -> bool:
        """True where the reference's pixels are written as they are."""
        return self.size_px == self.reference.size_px and not self.undistorted

    def on_grid(self, mapping: PixelMapping) -> PixelMapping:
        """Return a mapping of the reference's raw pixels as one of the output pixels."""
        if self.reference.lens is not None and self.undistorted:
            mapping = mapping.from_undistorted(self.reference.lens)
        return mapping if self.size_px == self.reference.size_px else mapping.rescaled(self.scale, SAME_PIXELS)


def _mappings(capture: Capture, alignments: Mapping[str, Alignment[FixedFilePx]]) -> dict[str, PixelMapping]:
    """Raw pixels of the reference to raw pixels of each usable moving band."""
    usable = [b for b in capture.moving if b.name in alignments]
    return {b.name: mapping_of(capture.reference, b, alignments[b.name]) for b in usable}


def _layers(capture: Capture, alignments: Mapping[str, Alignment[FixedFilePx]], pixels: _OutputPixels) -> list[Layer]:
    mappings = {name: pixels.on_grid(mapping) for name, mapping in _mappings(capture, alignments).items()}
    own = None if pixels.are_copied else pixels.on_grid(PixelMapping(geometry.identity()))
    return [
        Layer(b, own, is_reference=True) if b is capture.reference else Layer(b, mappings.get(b.name))
        for b in capture.bands
    ]


def _crop(
    capture: Capture, moved: list[tuple[PixelMapping, Band]], pixels: _OutputPixels, settings: WriteSettings,
    rig: Rig | None,
) -> Tile:  # fmt: skip
    """The rectangle of the output pixels that is written."""
    whole = Tile(0, 0, *pixels.size_px)
    if settings.crop == "none":
        return whole
    of_flight = [] if rig is None or settings.crop == "common" else _of_the_flight(capture, rig)
    if not of_flight:
        return common_area(moved, *pixels.size_px) or whole
    limits = [(pixels.on_grid(mapping), band) for mapping, band in of_flight]
    # The reference's own border takes part where it is resampled too.
    limits += [(mapping, band) for mapping, band in moved if band is capture.reference]
    area = common_area(limits, *pixels.size_px)
    return whole if area is None else _inset(area, _FLIGHT_MARGIN_PX)


def _of_the_flight(capture: Capture, rig: Rig) -> list[tuple[PixelMapping, Band]]:
    """Where the rig has the capture's bands in the nearest and the farthest captures of the flight."""
    reference = capture.reference
    return [
        (PixelMapping(matrix, reference.lens, band.lens if reference.lens is not None else None), band)
        for band in capture.moving
        if band.name in rig.mean and (band.lens is None) == (reference.lens is None)
        for matrix in extreme_mappings(rig, band.name)
    ]


def _inset(tile: Tile, margin_px: int) -> Tile:
    if 2 * margin_px >= min(tile.width, tile.height) // 2:
        return tile
    return Tile(tile.x0 + margin_px, tile.y0 + margin_px, tile.width - 2 * margin_px, tile.height - 2 * margin_px)


def _covers(mappings: list[tuple[PixelMapping, Band]], tile: Tile) -> bool:
    """True where every pixel of a tile is inside every moving image; only those along its border are tested."""
    x, y = (np.linspace(a, a + n - 1, _BORDER_POINTS) for a, n in ((tile.x0, tile.width), (tile.y0, tile.height)))
    sides = [(x, np.full_like(x, v)) for v in y[[0, -1]]] + [(np.full_like(y, v), y) for v in x[[0, -1]]]
    border = np.concatenate([np.stack(side, axis=-1) for side in sides])
    for mapping, band in mappings:
        mapped = mapping(border)
        if not ((mapped >= 0) & (mapped <= np.subtract(band.size_px, 1))).all():
            return False
    return True


def _finest_scale(mappings: Iterable[PixelMapping], reference: Band) -> float:
    """Pixels of the finest band per pixel of the reference along a line in the middle of the image, at least 1."""
    middle = (np.array(reference.size_px) - 1) / 2
    finest = 1.0
    for mapping in mappings:
        across = np.stack([mapping(middle + d) - mapping(middle - d) for d in 0.5 * np.eye(2)])
        finest = max(finest, math.sqrt(abs(float(np.linalg.det(across)))))
    return round(finest, 2)


def common_area(mappings: list[tuple[PixelMapping, Band]], width_px: int, height_px: int) -> Tile | None:
    """Return the largest rectangle of the reference grid that is inside every moving image; None for no such."""
    step = max(1, min(8, width_px // 64, height_px // 64))
    x = _cell_edges(width_px, step)
    y = _cell_edges(height_px, step)
    inside = np.ones((len(y), len(x)), dtype=bool)
    for mapping, band in mappings:
        mapped = mapping.at_crossings(x, y)
        with np.errstate(invalid="ignore"):
            inside &= (mapped >= 0).all(axis=-1) & (mapped <= np.subtract(band.size_px, 1)).all(axis=-1)
    # A cell counts where its four corners do: between them the mapping is all but straight.
    cells = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    result = _largest_rectangle(cells, np.diff(x), np.diff(y))
    if result is None:
        return None
    top, bottom, left, right = result
    x0, y0 = int(x[left]), int(y[top])
    return Tile(x0, y0, int(x[right]) - x0 + 1, int(y[bottom]) - y0 + 1)


def _cell_edges(length_px: int, step: int) -> NDArray[np.float64]:
    return np.append(np.arange(0, length_px - 1, step), length_px - 1).astype(np.float64)


def _largest_rectangle(
    cells: Mask, widths: NDArray[np.float64], heights: NDArray[np.float64]
) -> tuple[int, int, int, int] | None:
    """(top, bottom, left, right) in cell edges of the all-True rectangle of the largest area.

    A histogram with a stack, row by row; rows and columns like the one before them are taken as one with it.
    """
    first_rows, first_columns = _changes(cells), _changes(cells.T)
    rows, columns = ([*firsts.tolist(), n] for firsts, n in zip((first_rows, first_columns), cells.shape, strict=True))
    left_edge = np.concatenate([[0.0], np.cumsum(widths)])[columns].tolist()
    top_edge = np.concatenate([[0.0], np.cumsum(heights)])[rows].tolist()
    best_area, best = 0.0, None
    since = [0] * len(first_columns)
    for row, line in enumerate(cells[np.ix_(first_rows, first_columns)].tolist()):
        since = [begun if one else row + 1 for begun, one in zip(since, line, strict=True)]
        bottom = top_edge[row + 1]
        stack: list[tuple[int, float, int]] = []
        for column, top in enumerate([*since, row + 1]):
            start, height = column, bottom - top_edge[top]
            while stack and stack[-1][1] >= height:
                start, stacked, stacked_top = stack.pop()
                area = stacked * (left_edge[column] - left_edge[start])
                if area > best_area:
                    best_area, best = area, (rows[stacked_top], rows[row + 1], columns[start], columns[column])
            stack.append((start, height, top))
    return best


def _changes(cells: Mask) -> NDArray[np.int64]:
    """The rows that differ from the one before, the first among them."""
    return np.flatnonzero(np.append(True, (cells[1:] != cells[:-1]).any(axis=1)))
