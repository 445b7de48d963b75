"""Rasters of the expected alignment error, of quality flags and of the relief, on the grid of the aligned files."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from agalign.cameras.pix4d import rig_unit_m
from agalign.cameras.tag_seeds import rig_seed
from agalign.errors import GeometryError
from agalign.host.held_sizes import WORK_TILE_PX
from agalign.pixels.masks import saturated
from agalign.rasters.geotiff import LayerDescription
from agalign.rasters.output_grid import Layer, is_inside
from agalign.rasters.product import Product, ProductContext, WrittenFile
from agalign.values import geometry, lens
from agalign.values.alignment import Alignment, relief_of
from agalign.values.capture import Band, Capture
from agalign.values.choices import QUALITY_MEANINGS, Interpolation, Quality
from agalign.values.geometry import Matrix, Points
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.lens import Lens
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MAX_PIXEL_ERROR_PX, ErrorOnGrid
from agalign.values.parallax import Relief, rounded
from agalign.values.resampling import is_under_kernel, source_positions, tiles

_SHARE_CELL_PX = 32
"""Side of the cells whose centres a share of the image is counted from: within 0.002 of that of all pixels for 19 of 20
bands, in a quarter of the time of cells of 16 px, which are within 0.001."""
RELIEF_UNITS = {"parallax": "px", "confidence": "1", "range": "m"}
"""Units by layer of the raster of the relief."""
Flags = NDArray[np.uint16]


class ErrorMap(Product):
    """The expected error of each moving band that is written."""

    kind = "error_map"
    suffix = ".error.tif"
    option = "error_map"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.error.tif: float32, px of the reference's file, a layer for each moving band."""
        with_pixels, reference, grid = context.with_pixels, context.capture.reference, context.grid
        layers = [
            LayerDescription(name, tags={"units": "px of the reference", "STATUS": alignment.status})
            for name, alignment in with_pixels.items()
        ]
        blocks = ((_error_px(a, reference, grid), index, 0, 0) for index, a in enumerate(with_pixels.values(), start=1))
        return self.write_layers(context, layers, blocks)


def error_map(alignment: Alignment, reference: Band, grid: OutputGrid) -> ErrorOnGrid | None:
    """Return the expected error of a band on a grid, px of the reference's file; None if it is unknown."""
    if alignment.error is None:
        return None

    def to_reference(positions_px: Points) -> Points:
        return grid.reference_positions(positions_px, reference.lens)

    is_along_axes = not (grid.undistorted and reference.lens is not None)
    return ErrorOnGrid.of(alignment.error, (grid.width, grid.height), to_reference, is_along_axes=is_along_axes)


def error_lattice_px(alignment: Alignment, reference: Band, grid: OutputGrid, step_px: int) -> NDArray[np.float32]:
    """Return the expected error (rows, columns) on a lattice over a grid, px of the reference's file; nan where it is
    unknown.
    """
    columns, rows = (max(2, -(-n // step_px)) for n in (grid.width, grid.height))
    points = grid.reference_positions(geometry.lattice(grid.width, grid.height, columns, rows), reference.lens)
    nodes = alignment.error_px(points).reshape(rows, columns)
    return np.where(np.isfinite(nodes), nodes, np.nan).astype(np.float32)


def error_shares(alignment: Alignment, reference: Band, grid: OutputGrid) -> tuple[float, float]:
    """Return the share of a grid where the expected error exceeds 1 px, or is unknown, and that of areas that moved,
    as the quality raster flags them.
    """
    error = error_map(alignment, reference, grid) if alignment.error is not None and alignment.error.moved else None
    if error is None:
        columns, rows = (-(-n // _SHARE_CELL_PX) for n in (grid.width, grid.height))
        cell_px = np.divide((grid.width, grid.height), (columns, rows))
        centres_px = geometry.lattice(columns, rows, columns, rows) * cell_px + (cell_px - 1) / 2
        error_px = alignment.error_px(grid.reference_positions(centres_px, reference.lens))
        return float((~(error_px <= MAX_PIXEL_ERROR_PX)).mean()), 0.0
    whole = Tile(0, 0, grid.width, grid.height)  # a lattice would miss most of a small area
    return float((error.on_tile(whole) > MAX_PIXEL_ERROR_PX).mean()), float((error.moved_px(whole) > 0).mean())


def _error_px(alignment: Alignment, reference: Band, grid: OutputGrid) -> NDArray[np.float32]:
    """Expected error (height, width) on a grid, rounded below its accuracy: the raster compresses better."""
    error = error_map(alignment, reference, grid)
    if error is None:
        return np.full((grid.height, grid.width), np.nan, np.float32)
    result, step_px = error.on_tile(Tile(0, 0, grid.width, grid.height)), 0.001
    return np.asarray(np.round(result / step_px) * step_px, np.float32)


class QualityRaster(Product):
    """The quality flags of all bands."""

    kind = "qa"
    suffix = ".qa.tif"
    option = "qa"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.qa.tif. Raises OutputError, or UnreadableFileError for an input."""
        grid, reference = context.grid, context.capture.reference
        errors = {name: error_map(a, reference, grid) for name, a in context.with_pixels.items()}
        predicted = {name for name, alignment in context.with_pixels.items() if alignment.status == "predicted"}

        interpolation = context.settings.write.interpolation

        def flags_on(tile: Tile) -> list[Flags]:
            bands = [
                _flags(layer, tile, grid, errors, interpolation, is_predicted=layer.band.name in predicted)
                for layer in context.layers
            ]
            window = np.s_[tile.y0 - grid.y0 :, tile.x0 - grid.x0 :]
            for layer, flags in zip(context.layers, bands, strict=True):
                if (clipped := context.clipped.get(layer.band.name)) is not None:
                    flags[clipped[window][: tile.height, : tile.width]] |= Quality.SATURATED.value
            return [np.bitwise_or.reduce(bands), *bands]

        tags = {"flag_masks": ", ".join(str(int(flag)) for flag in Quality), "flag_meanings": QUALITY_MEANINGS}
        # The first layer has the flags that are set in any band.
        layers = [LayerDescription(name) for name in ("all bands", *(layer.band.name for layer in context.layers))]
        blocks = (
            (flags, index, tile.x0 - grid.x0, tile.y0 - grid.y0)
            for tile in tiles(grid, WORK_TILE_PX)
            for index, flags in enumerate(flags_on(tile), start=1)
        )
        # There is no nodata value: 0 means that no flag is set.
        return self.write_layers(context, layers, blocks, tags, dtype="uint16", options={"interleave": "band"})


def _flags(
    layer: Layer,
    tile: Tile,
    grid: OutputGrid,
    errors: Mapping[str, ErrorOnGrid | None],
    interpolation: Interpolation,
    *,
    is_predicted: bool,
) -> Flags:
    """Flags (height, width) of a band on a tile; `errors` has the expected error by band, None if it is unknown."""
    if layer.is_gap:
        return np.full((tile.height, tile.width), Quality.MISSING.value, np.uint16)
    result = np.full((tile.height, tile.width), Quality.PREDICTED.value if is_predicted else 0, np.uint16)
    masks = _of_source(layer, tile, interpolation)
    if layer.band.name in errors:
        error = errors[layer.band.name]
        on_grid = Tile(tile.x0 - grid.x0, tile.y0 - grid.y0, tile.width, tile.height)
        error_px = np.full((tile.height, tile.width), np.inf) if error is None else error.on_tile(on_grid)
        masks[Quality.ERROR_OVER_HALF_PX] = error_px > 0.5
        masks[Quality.ERROR_OVER_1_PX] = error_px > MAX_PIXEL_ERROR_PX
        masks[Quality.MOVED] = np.zeros_like(error_px, bool) if error is None else error.moved_px(on_grid) > 0
    for flag, mask in masks.items():
        result[mask] |= flag.value
    return result


def _of_source(layer: Layer, tile: Tile, interpolation: Interpolation) -> dict[Quality, Mask]:
    """The flags of a band's file on a tile, each (height, width)."""
    band = layer.band
    if layer.mapping is None:
        pixels, valid = layer.read(band, tile)
        return {Quality.NODATA: ~valid, Quality.SATURATED: saturated(valid, pixels, band.saturation_value)}
    positions, source = source_positions(layer.mapping, tile, layer.size_px, band.size_px)
    inside = is_inside(positions, band)
    if source is None:
        return {Quality.OUTSIDE: ~inside}
    pixels, valid = layer.read(band, source)
    of_validity: Interpolation = "nearest" if interpolation == "nearest" else "bilinear"  # as in `resample`
    in_window = (positions - (source.x0, source.y0)).astype(np.float32)
    is_saturated = saturated(valid, pixels, band.saturation_value)
    return {
        Quality.OUTSIDE: ~inside,
        Quality.NODATA: inside & is_under_kernel(~valid, in_window, of_validity),
        Quality.SATURATED: inside & is_under_kernel(is_saturated, in_window, interpolation),
        Quality.OCCLUDED: inside & layer.mapping.hidden(tile),
    }


class ReliefMap(Product):
    """The relief that displaces the bands of a capture, whenever one was estimated; the sidecar refers to it."""

    kind = "relief"
    suffix = ".relief.tif"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.relief.tif."""
        relief = relief_of(context.with_pixels)
        if relief is None:
            return []
        names = RELIEF_UNITS if context.settings.write.relief_map else ("parallax",)
        layers = relief_layers(context.capture, context.with_pixels, relief, context.grid, names=names)
        descriptions = [LayerDescription(name, RELIEF_UNITS[name]) for name in layers]
        blocks = ((values, index, 0, 0) for index, values in enumerate(layers.values(), start=1))
        return self.write_layers(context, descriptions, blocks)


def relief_layers(
    capture: Capture,
    alignments: Mapping[str, Alignment],
    relief: Relief,
    grid: OutputGrid,
    size_px: tuple[int, int] | None = None,
    *,
    names: Collection[str] = RELIEF_UNITS,
) -> dict[str, NDArray[np.float32]]:
    """Return layers (height, width) on a grid, those of these names: `parallax` in px of the reference's file along a
    baseline of length 1, `confidence` from 0 to 1, and `range` in metres along the optical axis, nan where it is
    unknown.

    With `size_px` (width, height) the same area is sampled at that size.
    """
    columns, rows = size_px or (grid.width, grid.height)
    x, y = np.meshgrid(np.linspace(0, grid.width - 1, columns), np.linspace(0, grid.height - 1, rows))
    points = grid.reference_positions(np.stack([x, y], axis=-1), capture.reference.lens)
    parallax_px = relief(points)
    layers: dict[str, Callable[[], NDArray[np.float32]]] = {
        "parallax": lambda: rounded(parallax_px),
        "confidence": lambda: rounded(Relief(relief.confidence, relief.confidence, relief.scale)(points)),
        "range": lambda: _range_m(capture, alignments, points, parallax_px),  # most of the time
    }
    return {name: layers[name]() for name in names}


def _range_m(
    capture: Capture, alignments: Mapping[str, Alignment], points: NDArray[np.float64], parallax_px: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Range (height, width), nan if baselines, focal length or the orientation of the lenses are unknown."""
    reference, unit_m, known = capture.reference, rig_unit_m(capture.bands), []
    for band in capture.moving:
        alignment = alignments.get(band.name)
        if alignment is None or alignment.mapping.parallax is None or alignment.space != "undistorted":
            continue
        with suppress(GeometryError):
            at_infinity = rig_seed(reference, band)
            if at_infinity is not None and band.lens_offset is not None and reference.lens_offset is not None:
                baseline_m = np.subtract(reference.lens_offset, band.lens_offset) * unit_m
                known.append((alignment.mapping, at_infinity, baseline_m))
    if not known or reference.lens is None:
        return np.full(parallax_px.shape, np.nan, np.float32)
    mappings, at_infinity_of, baselines_m = zip(*known, strict=True)
    inverse_m = inverse_range(mappings, at_infinity_of, np.array(baselines_m), reference.lens, points, parallax_px)
    max_range_m = 1e5  # the parallax of a larger range cannot be distinguished from that of an infinite one
    with np.errstate(divide="ignore"):
        range_m = np.where(inverse_m > 1 / max_range_m, 1 / inverse_m, np.nan)
    return np.asarray(range_m, np.float32)


def inverse_range(
    mappings: Sequence[PixelMapping],
    at_infinity: Sequence[Matrix],
    directions_m: NDArray[np.float64],
    reference_lens: Lens,
    points_px: Points,
    parallax_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return 1 / Z (height, width), per metre, at raw pixels (height, width, 2) of the reference with a parallax.

    `mappings` are the complete mappings of the bands and `at_infinity` their fixed_to_moving at infinite range,
    undistorted px. `directions_m` (bands, 2) are the directions in which points move when the scene comes nearer: the
    negative positions of the lenses relative to the reference, metres.

    In a lens displaced by B_b (metres, right and down in the image), a point at range Z along the optical axis is
    shifted by

        d_b = -f B_b / Z

    relative to its position at infinite range (Hartley & Zisserman 2004, Eq. 9.6), in px of the reference with focal
    length f. The homography at infinite range follows from the orientations of the lenses in the tags. 1 / Z is the
    least squares solution over all bands.
    """
    focal_px = np.array([reference_lens.fx_px, reference_lens.fy_px])
    weights = directions_m * focal_px
    low, high = points_px.reshape(-1, 2).min(axis=0), points_px.reshape(-1, 2).max(axis=0)
    node_count = 33  # along both axes of the grid on which mappings are evaluated
    x, y = (np.linspace(a, max(b, a + 1), node_count) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    levels = float(parallax_px.min()), float(parallax_px.max()) + 1.0
    values = []
    for level in levels:
        total = np.zeros(nodes.shape[:2])
        for mapping, infinite, weight in zip(mappings, at_infinity, weights, strict=True):
            undistorted = mapping.without_parallax.undistorted(nodes)
            assert mapping.parallax is not None
            moved = undistorted + level * np.array(mapping.parallax.baseline)
            observed = geometry.apply(geometry.invert(infinite), geometry.apply(mapping.fixed_to_moving, moved))
            total += (observed - lens.undistort(reference_lens, nodes)) @ weight
        values.append(total / (weights**2).sum())
    # Linear interpolation in the parallax between two levels.
    low_value, high_value = (RegularGridInterpolator((y, x), v)(points_px[..., ::-1]) for v in values)
    share = (parallax_px - levels[0]) / (levels[1] - levels[0])
    return np.asarray(low_value + share * (high_value - low_value))
