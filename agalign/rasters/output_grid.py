"""The layers of a capture that are written, and their common pixel grid."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agalign.config import WriteSettings
from agalign.flight.rig import Rig
from agalign.flight.rig_prediction import extreme_mappings
from agalign.pixels.raster import ReadTile, read_tile
from agalign.values import geometry
from agalign.values.alignment import Alignment
from agalign.values.capture import Band, Capture
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.mapping import PixelMapping
from agalign.values.pixel_units import SAME_PIXELS, PixelScale, Size
from agalign.values.radiometry import Radiometry

SCALE_DECIMALS = 2
"""Of pixels of the finest band per pixel of the reference."""
_MAX_CELL_PX, _MIN_CELLS = 8, 64
"""The common area is found in cells of at most 8 px, and at least 64 cells along each axis if the image has as many."""


@dataclass(frozen=True)
class Layer:
    """One band of the output, and the source of its pixels."""

    band: Band
    mapping: PixelMapping | None
    """From output pixels, before the crop, to raw pixels of the file. None for a reference that is copied, and for a
    moving band without pixels.
    """
    size_px: Size | None = None
    """(width, height) of the output before the crop."""
    is_reference: bool = False
    read: ReadTile = read_tile
    """Reads the pixels of the file."""
    vignetting: Radiometry | None = None
    """Correction of the vignetting of raw numbers, if their file has no tags for it."""

    @property
    def is_gap(self) -> bool:
        """True if the band has no pixels: all of them are nodata."""
        return self.mapping is None and not self.is_reference

    @property
    def is_copied(self) -> bool:
        """True if the pixels are copied from the file."""
        return self.mapping is None and self.is_reference and self.vignetting is None

    def positions(self, output_px: Points, grid: OutputGrid) -> Points:
        """Return the positions (n, 2) in the layer's file of pixels (n, 2) of the output."""
        on_frame = np.add(output_px, (grid.x0, grid.y0))
        return on_frame if self.mapping is None else self.mapping(on_frame)


FlightLimits = Sequence[tuple[Matrix, Band]]
"""Extreme mappings (3, 3) from undistorted pixels of the reference to those of a moving band."""


def flight_limits(flights: Iterable[tuple[Sequence[Capture], Rig | None]]) -> FlightLimits:
    """Return the limits of flights of one camera, given the rig of each; captures may lack bands."""
    all_flights = [*flights]
    bands = {b.name: b for captures, _ in all_flights for c in captures for b in c.moving}
    rigs = [rig for _, rig in all_flights if rig is not None]
    mappings = ((matrix, name) for rig in rigs for name in rig.mean for matrix in extreme_mappings(rig, name))
    return [(matrix, bands[name]) for matrix, name in mappings if name in bands]


def output_layers(
    capture: Capture,
    alignments: Mapping[str, Alignment],
    settings: WriteSettings,
    common: OutputGrid | None = None,
    read: ReadTile = read_tile,
) -> tuple[list[Layer], OutputGrid]:
    """Return a layer for each of a capture's `stack_bands`, given the alignments of its usable moving bands, and their
    grid: the `common` one of the camera, if any. `read` reads the pixels of the files.
    """
    reference = capture.reference
    mappings = {b.name: alignments[b.name].mapping for b in capture.moving if b.name in alignments}
    frame = common or _frame(reference, mappings.values(), settings)
    if frame.undistorted or frame.scale != SAME_PIXELS:
        mappings[reference.name] = PixelMapping(geometry.identity())  # otherwise the reference is copied
    on_frame = {name: _on_frame(mapping, frame, reference) for name, mapping in mappings.items()}
    size_px = round(reference.width_px * frame.scale.x), round(reference.height_px * frame.scale.y)
    layers = [Layer(b, on_frame.get(b.name), size_px, b is reference, read) for b in capture.stack_bands]
    # The crop is calculated without relief, which may leave pixels of single bands without a value.
    mapped = [(layer.mapping.without_parallax, layer.band) for layer in layers if layer.mapping is not None]
    if common is None and settings.crop != "none" and (area := common_area(mapped, frame.width, frame.height)):
        frame = replace(frame, **vars(area))
    has_relief = any(mapping.parallax is not None for mapping in on_frame.values())
    return layers, replace(frame, has_gaps=has_relief or not _covers(mapped, frame))


def _frame(reference: Band, mappings: Iterable[PixelMapping], settings: WriteSettings) -> OutputGrid:
    """The pixel grid of the output before the crop: that of the reference, a finer one, or one without distortion."""
    scale = _finest_scale(mappings, reference) if settings.resolution == "finest" else 1.0
    return _frame_of_scale(reference, scale, undistorted=settings.undistort and reference.lens is not None)


def _frame_of_scale(reference: Band, scale: float, *, undistorted: bool) -> OutputGrid:
    """The pixel grid of the output before the crop, with a whole number of pixels."""
    size_px = round(reference.width_px * scale), round(reference.height_px * scale)
    return OutputGrid(0, 0, *size_px, PixelScale.between(reference.size_px, size_px), undistorted)


def _on_frame(mapping: PixelMapping, frame: OutputGrid, reference: Band) -> PixelMapping:
    """A mapping from the reference's raw pixels as a mapping from output pixels."""
    if reference.lens is not None and frame.undistorted:
        mapping = mapping.from_undistorted(reference.lens)
    return mapping if frame.scale == SAME_PIXELS else mapping.rescaled(frame.scale, SAME_PIXELS)


def common_grid(reference: Band, settings: WriteSettings, limits: FlightLimits) -> OutputGrid | None:
    """Return the grid of all captures of a camera, given the limits of its flights; None if each has its own."""
    of_flight = _mappings_of_flight(reference, limits)
    if settings.crop != "flight" or not of_flight:
        return None
    frame = _frame(reference, [mapping for mapping, _ in of_flight], settings)
    mapped = [(_on_frame(mapping, frame, reference), band) for mapping, band in of_flight]
    if frame.undistorted or frame.scale != SAME_PIXELS:  # a reference that is resampled has a border too
        mapped.append((_on_frame(PixelMapping(geometry.identity()), frame, reference), reference))
    area = common_area(mapped, frame.width, frame.height)
    if area is None:
        return frame
    # The crop of a flight is smaller by this: captures that the rig was not learned from may exceed its extremes.
    margin_px = 2
    if min(area.width, area.height) // 2 > 2 * margin_px:
        size_px = area.width - 2 * margin_px, area.height - 2 * margin_px
        area = Tile(area.x0 + margin_px, area.y0 + margin_px, *size_px)
    return replace(frame, **vars(area))


def at_finest_scale(
    common: OutputGrid, reference: Band, limits: FlightLimits, scale: float | None = None
) -> OutputGrid | None:
    """Return the pixels of the finest band in a common grid, given the limits of the flights of the camera. `scale` is
    that of earlier files, which another rig may have determined; None without a scale and limits.
    """
    mappings = [mapping for mapping, _ in _mappings_of_flight(reference, limits)]
    if scale is None and not mappings:
        return None
    scale = scale or _finest_scale(mappings, reference)
    frame = _frame_of_scale(reference, scale, undistorted=common.undistorted)
    factor, decimals = frame.scale.over(common.scale), 6
    left, top = (math.ceil(round(v, decimals)) for v in np.multiply((common.x0, common.y0), factor).tolist())
    ends = common.x0 + common.width, common.y0 + common.height
    right, bottom = (math.floor(round(v, decimals)) for v in np.multiply(ends, factor).tolist())
    return replace(frame, x0=left, y0=top, width=right - left, height=bottom - top)


def _mappings_of_flight(reference: Band, limits: FlightLimits) -> list[tuple[PixelMapping, Band]]:
    """The limits as mappings between files, without bands of which only one of both has a lens."""
    return [
        (PixelMapping(matrix, reference.lens, band.lens), band)
        for matrix, band in limits
        if (band.lens is None) == (reference.lens is None)
    ]


def _covers(mappings: list[tuple[PixelMapping, Band]], tile: Tile) -> bool:
    """True if every pixel of a tile is inside every moving image, tested at 64 points of each side."""
    x, y = (np.linspace(a, a + n - 1, 64) for a, n in ((tile.x0, tile.width), (tile.y0, tile.height)))
    sides = [(x, np.full_like(x, v)) for v in y[[0, -1]]] + [(np.full_like(y, v), y) for v in x[[0, -1]]]
    border = np.concatenate([np.stack(side, axis=-1) for side in sides])
    return all(is_inside(mapping(border), band).all() for mapping, band in mappings)


def is_inside(positions: NDArray[np.floating[Any]], band: Band) -> Mask:
    """Return True for positions (..., 2) within the image of a band; False for nan."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((positions >= 0) & (positions <= np.subtract(band.size_px, 1))).all(axis=-1))


def _finest_scale(mappings: Iterable[PixelMapping], reference: Band) -> float:
    """Pixels of the finest band per pixel of the reference along a line, in the centre of the image; at least 1."""
    centre = (np.array(reference.size_px) - 1) / 2
    finest = 1.0
    for mapping in mappings:
        jacobian = np.stack([mapping(centre + d) - mapping(centre - d) for d in 0.5 * np.eye(2)])
        finest = max(finest, math.sqrt(abs(float(np.linalg.det(jacobian)))))
    return round(finest, SCALE_DECIMALS)


def common_area(mappings: list[tuple[PixelMapping, Band]], width_px: int, height_px: int) -> Tile | None:
    """Return the largest rectangle of a grid of this size that is inside every moving image; None if there is none."""
    step = max(1, min(_MAX_CELL_PX, width_px // _MIN_CELLS, height_px // _MIN_CELLS))
    x, y = (np.append(np.arange(0.0, n - 1, step), n - 1) for n in (width_px, height_px))
    inside = np.ones((len(y), len(x)), dtype=bool)
    for mapping, band in mappings:
        inside &= is_inside(mapping.at_crossings(x, y), band)
    # A cell is inside if its four corners are: between them the mapping is almost linear.
    cells = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    result = _largest_rectangle(cells, x.tolist(), y.tolist())
    if result is None:
        return None
    top, bottom, left, right = result
    x0, y0 = int(x[left]), int(y[top])
    return Tile(x0, y0, int(x[right]) - x0 + 1, int(y[bottom]) - y0 + 1)


def _largest_rectangle(cells: Mask, x: Sequence[float], y: Sequence[float]) -> tuple[int, int, int, int] | None:
    """(top, bottom, left, right), as indices of the edges x of columns and y of rows, of the rectangle of True cells
    with the largest area.

    The largest rectangle in a histogram, with a stack, for each row: the histogram is the height of the True cells that
    end in the row.
    """
    best_area, best = 0.0, None
    tops = [0] * cells.shape[1]
    for row, line in enumerate(cells.tolist()):
        tops = [top if is_inside else row + 1 for top, is_inside in zip(tops, line, strict=True)]
        stack: list[tuple[int, float, int]] = []
        for column, top in enumerate([*tops, row + 1]):
            start, height = column, y[row + 1] - y[top]
            while stack and stack[-1][1] >= height:
                start, bar_height, bar_top = stack.pop()
                area = bar_height * (x[column] - x[start])
                if area > best_area:
                    best_area, best = area, (bar_top, row + 1, start, column)
            stack.append((start, height, top))
    return best
