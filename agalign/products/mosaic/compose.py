"""A quick mosaic of a run: aligned captures on a horizontal plane, refined by tie points, with feathered seams.

It is for viewing: terrain is not corrected, which takes photogrammetry.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agalign.errors import ConfigurationError, InputError
from agalign.pixels.raster import open_raster
from agalign.products.indices.formulas import index_named
from agalign.products.indices.rasters import IndexReport, write_rasters
from agalign.products.mosaic.adjustment import adjusted, misfit_m, tie_pairs, tied_groups
from agalign.products.mosaic.placement import Placement, place_captures
from agalign.products.rasters.aligned_files import to_cog, with_nodata
from agalign.products.rasters.checked_raster import Block, LayerDescription, write_on_grid
from agalign.products.run.captures import AlignedBand, BandReader, LeftOut
from agalign.values import geometry
from agalign.values.capture import Georeference
from agalign.values.choices import MAX_PIXELS
from agalign.values.files import file_checksum
from agalign.values.geometry import Matrix
from agalign.values.image import FloatImage, Mask, OutputGrid, Tile
from agalign.values.interpolation import resample, source_window, tiles
from agalign.values.mapping import PixelMapping
from agalign.values.output_folder import locked
from agalign.values.pixel_units import Size

_TILE_PX = 512
"""Side of the tiles that are composed at once."""
_COMPRESSION = "zstd"
_COPIED_TAGS = "CAMERA", "TIFFTAG_DATETIME", "REFERENCE_BAND", "RADIOMETRY", "RADIOMETRY_SOURCE"
_UNTIED = "it has no tie points to those of the mosaic; --untied places it by its georeference"
_PURPOSE = "quick mosaic on a horizontal plane, for viewing; not an orthomosaic"


@dataclass(frozen=True)
class MosaicReport:
    """Result of a mosaic."""

    path: Path
    captures: int
    untied: Sequence[str]
    """Labels of captures without tie points to the others, which their georeference places."""
    pairs: int
    """Overlapping captures with tie points."""
    tie_points: int
    """Tie points that took no part in the adjustment: the misfits are measured on them."""
    misfit_m: tuple[float, float]
    """Between captures, so relative: distances of the tie points on the ground after the adjustment, median and p95;
    nan without tie points.
    """
    georeference_misfit_m: tuple[float, float]
    """The same by the georeference alone."""
    accuracy_m: float
    """On the map, so absolute: standard error of the georeference of a capture (median), without ground control."""
    height_is_assumed: bool
    """True if the scale is only known from the GPS positions."""
    left_out: LeftOut
    indices: Sequence[IndexReport] = ()


def mosaic(
    out: str | Path,
    target: str | Path,
    *,
    indices: Sequence[str] = (),
    gsd_m: float | None = None,
    untied: bool = False,
) -> MosaicReport:
    """Write a mosaic of the aligned captures of a run as a cloud-optimised GeoTIFF, with all bands.

    Captures with other bands or another quantity than most are left out. Tie points between overlapping captures refine
    their georeference. The largest group of captures that tie points join is written; with `untied` all captures,
    the others by their georeference. Indices, given by name, are written next to the
    mosaic, <target>_<index>.tif. `gsd_m` is the pixel size, by default the median of the captures. The ground
    is assumed to be a horizontal plane: for maps and measurements use photogrammetry.
    Raises InputError if no capture can be placed, read or joined to another, ConfigurationError for too many pixels, an
    unknown index or a target that is an input or not a .tif, OutputError, also if another process writes to its folder.
    """
    chosen_indices, path = [index_named(name) for name in indices], Path(target)
    flight = place_captures(Path(out))
    stacks = {band.file.resolve() for capture in flight.captures for band in capture.bands}
    if path.suffix.lower() not in (".tif", ".tiff") or path.resolve() in stacks:
        raise ConfigurationError(f"{path}: give the mosaic a new file that ends in .tif")
    with locked(path.parent, below=False):
        pairs = [pair.split() for pair in tie_pairs(flight.captures)]
        largest, *others = tied_groups(len(flight.captures), [used for used, _ in pairs])
        if others and not pairs and not untied:
            problem = "is not written, because no capture has tie points to another"
            raise InputError(f"{path}: {problem}; --untied places them by their georeference")
        apart = [k for group in others for k in group]
        chosen = sorted([*largest, *apart] if untied else largest)
        captures = adjusted(flight.captures, [used for used, _ in pairs])
        placed = [captures[k] for k in chosen]
        checks = [check for _, check in pairs if untied or check.first in largest]
        grid = _Grid.of(placed, gsd_m)
        accuracy_m = float(np.median([c.accuracy_m for c in placed]))
        misfit = misfit_m(checks, captures)
        tags = {"MOSAIC": _PURPOSE, "MISFIT_BETWEEN_CAPTURES_M": "" if not checks else f"{misfit[0]:.3f}"}
        # Geotransforms count from the corner of a pixel.
        on_map = geometry.translation(*flight.origin_m) @ grid.to_ground @ geometry.translation(-0.5, -0.5)
        _write(path, placed, grid, Georeference(on_map, flight.crs_wkt, accuracy_m), tags)
        labels, checksum = [captures[k].label for k in apart], file_checksum(path) if indices else ""
        of_mosaic = enumerate(placed[0].bands, start=1)
        bands = [AlignedBand(band.name, band.wavelength_nm, path, k, checksum) for k, band in of_mosaic]
        return MosaicReport(
            path,
            captures=len(placed),
            untied=labels if untied else [],
            pairs=len(checks),
            tie_points=sum(map(len, checks)),
            misfit_m=misfit,
            georeference_misfit_m=misfit_m(checks, flight.captures),
            accuracy_m=accuracy_m,
            height_is_assumed=any(c.height_is_assumed for c in placed),
            left_out=[*flight.left_out, *((label, _UNTIED) for label in labels if not untied)],
            indices=[*write_rasters(bands, chosen_indices, path.with_suffix(""), path.stem)],
        )


@dataclass(frozen=True)
class _Grid:
    """A north-up grid; `to_ground` maps its pixels to metres from the origin of the flight."""

    size_px: Size
    to_ground: Matrix

    @classmethod
    def of(cls, captures: Sequence[Placement], gsd_m: float | None) -> "_Grid":
        """Return the grid that covers the captures. Raises ConfigurationError for too many pixels."""
        step_m = gsd_m or float(np.median([c.gsd_m for c in captures]))
        outline_m = np.concatenate([c.outline_m for c in captures])
        (west, south), (east, north) = outline_m.min(axis=0), outline_m.max(axis=0)
        width, height = math.ceil((east - west) / step_m), math.ceil((north - south) / step_m)
        if width * height > MAX_PIXELS:
            raise ConfigurationError(f"the mosaic has {width} x {height} pixels, which is too many; increase --gsd")
        scaled = np.diag((step_m, -step_m, 1.0)) @ geometry.translation(0.5, 0.5)
        return cls((width, height), geometry.translation(west, north) @ scaled)

    def may_overlap(self, capture: Placement, tile: Tile) -> bool:
        """Return False if a capture is outside of a tile."""
        outline_px = geometry.apply(geometry.invert(self.to_ground), capture.outline_m) - (tile.x0, tile.y0)
        return bool((outline_px.max(axis=0) > 0).all() and (outline_px.min(axis=0) < (tile.width, tile.height)).all())

    def positions_in(self, capture: Placement, tile: Tile) -> FloatImage:
        """Return the position (height, width, 2) of each pixel of a tile in the rasters of a capture."""
        from_tile = self.to_ground @ geometry.translation(tile.x0, tile.y0)
        mapping = PixelMapping(geometry.invert(capture.to_ground) @ from_tile, moving_lens=capture.lens)
        return np.asarray(mapping.positions(Tile(0, 0, tile.width, tile.height), np.float32), np.float32)


def _write(
    path: Path, captures: Sequence[Placement], grid: _Grid, georeference: Georeference, tags: dict[str, str]
) -> None:
    """Write the mosaic of all bands."""
    dtype, layers, copied = _like(captures)
    nodata = math.nan if dtype.kind == "f" else 0.0

    def blocks() -> Iterator[Block]:
        for tile in tiles(Tile(0, 0, *grid.size_px), _TILE_PX):
            pixels, valid = _composed(captures, grid, tile)
            for number, band in enumerate(pixels, start=1):
                values = band if dtype.kind == "f" else np.rint(band)
                yield with_nodata(values.astype(dtype), valid, nodata), number, tile.x0, tile.y0

    whole, finish = OutputGrid(0, 0, *grid.size_px), partial(to_cog, compression=_COMPRESSION)
    options = {"compress": _COMPRESSION, "nodata": nodata, "interleave": "band"}
    tags = copied | tags
    write_on_grid(
        path, whole, georeference, layers, blocks(), tags=tags, dtype=dtype.name, options=options, finish=finish
    )


def _like(captures: Sequence[Placement]) -> tuple[np.dtype[Any], list[LayerDescription], dict[str, str]]:
    """(type, layers, tags) of the files of captures with equal contents; float32 for numbers that the files scale."""
    layers: dict[str, LayerDescription] = {}
    dtypes = []
    values: dict[str, set[str]] = {tag: set() for tag in _COPIED_TAGS}
    for band in (band for capture in captures for band in capture.bands):
        with open_raster(band.file) as source:
            k, tags = band.band_index, source.tags()
            scaled = (source.scales[k - 1], source.offsets[k - 1]) != (1.0, 0.0)
            dtypes.append("float32" if scaled else source.dtypes[k - 1])
            for tag in values.keys() & tags.keys():
                values[tag].add(tags[tag])
            imagery, colour = source.tags(k, ns="IMAGERY"), source.colorinterp[k - 1]
            own = {t: v for t, v in source.tags(k).items() if not t.startswith("STATISTICS_")}
            layers[band.name] = LayerDescription(band.name, source.units[k - 1] or "", own, imagery, colour=colour)
    copied = {tag: " and ".join(sorted(found)) for tag, found in values.items()}
    copied |= {"TIFFTAG_SOFTWARE": "agalign", "TIFFTAG_DATETIME": min(values["TIFFTAG_DATETIME"], default="")}
    return np.result_type(*dtypes), [*layers.values()], copied


def _composed(captures: Sequence[Placement], grid: _Grid, tile: Tile) -> tuple[FloatImage, Mask]:
    """The pixels of a tile (bands, height, width) and their mask: of the capture that has a pixel nearest to its
    centre, blended with the others within the width of a seam.
    """
    shape = tile.height, tile.width
    views = [(c, grid.positions_in(c, tile)) for c in captures if grid.may_overlap(c, tile)]
    central = [_centrality(positions, c.size_px) for c, positions in views]
    best = np.max([np.zeros(shape, np.float32), *central], axis=0)
    total, weight = np.zeros((len(captures[0].bands), *shape), np.float32), np.zeros(shape, np.float32)
    feather = 0.1  # width of a seam, as a share of half of the shorter side of a capture
    for is_filling in (False, True):  # occluded pixels of one capture with those of others
        for view, one in zip(views, central, strict=True):
            share = weight == 0 if is_filling else np.clip(1 - (best - one) / feather, 0, 1)
            share = np.where(one > 0, share, np.float32(0))
            if share.any():
                pixels, valid = _warped(*view)
                total += np.where(valid, pixels, 0) * share
                weight += np.where(valid, share, 0)
    return np.asarray(total / np.where(weight > 0, weight, 1), np.float32), weight > 0


def _centrality(positions: FloatImage, size_px: Size) -> FloatImage:
    """Distance (height, width) of positions in an image from its edge: 1 at its centre, negative outside."""
    inside_px = [np.minimum(positions[..., k], size_px[k] - 1 - positions[..., k]) for k in (0, 1)]
    return np.asarray(2 * np.minimum(*inside_px) / min(size_px), np.float32)


def _warped(capture: Placement, positions: FloatImage) -> tuple[FloatImage, Mask]:
    """All bands of a capture (bands, height, width) at positions in its rasters, and where all of them are valid.

    Bilinear: wider kernels overshoot at edges, and the bands are resampled for the second time.
    """
    valid = np.ones(positions.shape[:2], bool)
    result = np.zeros((len(capture.bands), *valid.shape), np.float32)
    source = source_window(positions, capture.size_px, is_smooth=True)
    if source is None:
        return result, ~valid
    with BandReader() as reader:
        for k, band in enumerate(capture.bands):
            pixels = reader.values(band, source)
            one, inside = resample(pixels, np.isfinite(pixels), positions, source, capture.size_px, "bilinear")
            result[k] = one
            valid &= inside
    return result, valid
