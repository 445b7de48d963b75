"""Which pixels are written of a capture: its layers, and the grid that they have in common."""

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

_FLIGHT_MARGIN_PX = 2
"""What captures that the rig was not learnt on may differ by."""
_BORDER_POINTS = 64


@dataclass(frozen=True)
class Layer:
    """One band of the output: where its pixels come from.

    `mapping` leads from the written pixels, before they are cut, to raw pixels of the file. The reference has none
    where its own pixels are copied, and a moving band has none where there is nothing to write.
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
    capture: Capture, alignments: Mapping[str, Alignment], settings: WriteSettings, rig: Rig | None = None
) -> tuple[list[Layer], OutputGrid]:
    """The layers of a capture, whose usable moving bands have these alignments, and the grid they are written on.

    With the flight's `rig` the grid is that of all its captures: one flight, one geometry.
    """
    reference = capture.reference
    mappings = {b.name: mapping_of(reference, b, alignments[b.name]) for b in capture.moving if b.name in alignments}
    scale = _finest_scale(mappings.values(), reference) if settings.resolution == "finest" else 1.0
    own = PixelMapping(geometry.identity())
    undistorted = settings.undistort and reference.lens is not None
    size_px = round(reference.width_px * scale), round(reference.height_px * scale)
    scales = size_px[0] / reference.width_px, size_px[1] / reference.height_px

    def on_grid(mapping: PixelMapping) -> PixelMapping:
        """A mapping of the reference's raw pixels as one of the pixels that are written."""
        if reference.lens is not None and undistorted:
            mapping = mapping.from_undistorted(reference.lens)
        return mapping if scale == 1.0 else mapping.rescaled(scales, (1.0, 1.0))

    mappings = {name: on_grid(mapping) for name, mapping in mappings.items()}
    copied = scale == 1.0 and not undistorted
    layers = [
        Layer(b, None if copied else on_grid(own), is_reference=True)
        if b is reference
        else Layer(b, mappings.get(b.name))
        for b in capture.bands
    ]
    moved = [(layer.mapping, layer.band) for layer in layers if layer.mapping is not None]
    crop = Tile(0, 0, *size_px)
    if settings.crop != "none":
        whole = [] if rig is None or settings.crop == "common" else _of_the_flight(capture, rig)
        given = [(on_grid(mapping), band) for mapping, band in whole]
        # The reference's own border takes part where it is resampled too.
        given += [(m, b) for m, b in moved if b is reference]
        result = common_area(given if whole else moved, *size_px)
        crop = crop if result is None else _inset(result, _FLIGHT_MARGIN_PX if whole else 0)
    grid = OutputGrid(crop.x0, crop.y0, crop.width, crop.height, scales, undistorted, not _covers(moved, crop))
    return layers, grid


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
    """True where every pixel of a tile lies inside every moving image: where those along its border do."""
    x, y = (np.linspace(a, a + n - 1, _BORDER_POINTS) for a, n in ((tile.x0, tile.width), (tile.y0, tile.height)))
    sides = [(x, np.full_like(x, v)) for v in y[[0, -1]]] + [(np.full_like(y, v), y) for v in x[[0, -1]]]
    border = np.concatenate([np.stack(side, axis=-1) for side in sides])
    for mapping, band in mappings:
        there = mapping(border)
        if not ((there >= 0) & (there <= np.subtract(band.size_px, 1))).all():
            return False
    return True


def _finest_scale(mappings: Iterable[PixelMapping], reference: Band) -> float:
    """How many of the finest band's pixels lie along one of the reference's, in the middle of the image."""
    middle = (np.array(reference.size_px) - 1) / 2
    finest = 1.0
    for mapping in mappings:
        across = np.stack([mapping(middle + d) - mapping(middle - d) for d in 0.5 * np.eye(2)])
        finest = max(finest, math.sqrt(abs(float(np.linalg.det(across)))))
    return round(finest, 2)


def common_area(mappings: list[tuple[PixelMapping, Band]], width_px: int, height_px: int) -> Tile | None:
    """The largest rectangle of the reference grid that lies inside every moving image; None where there is none."""
    step = max(1, min(8, width_px // 64, height_px // 64))
    x = _cell_edges(width_px, step)
    y = _cell_edges(height_px, step)
    inside = np.ones((len(y), len(x)), dtype=bool)
    for mapping, band in mappings:
        there = mapping.at_crossings(x, y)
        with np.errstate(invalid="ignore"):
            inside &= (there >= 0).all(axis=-1) & (there <= np.subtract(band.size_px, 1)).all(axis=-1)
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
