"""The rasters of the aligned bands on the output grid, as GeoTIFF or COG: a stack, or a file for each input file for
photogrammetry programs; their pixels, nodata value and tags.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.fill import fillnodata

from agalign.cameras.dji import Dji
from agalign.cameras.makers import camera_of
from agalign.cameras.metadata import read_tags
from agalign.cameras.pix4d import SAME_ROWS, GridRows, GridVignetting, vignetting_of, vignetting_on_grid
from agalign.cameras.tag_transfer import TransferredTags, band_tags, capture_tags
from agalign.cameras.tiff_directory import add_directories
from agalign.config import WriteSettings
from agalign.errors import AgalignError, UnreadableFileError
from agalign.host.files import file_name
from agalign.host.held_sizes import WORK_TILE_PX
from agalign.pixels.band_resampling import resample_tile
from agalign.pixels.gdal import open_local
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import open_raster, suffix_format
from agalign.rasters.band_reader import RAW
from agalign.rasters.geotiff import Block, LayerDescription, compressed, to_cog, write_on_grid
from agalign.rasters.output_grid import Layer, is_inside
from agalign.rasters.product import CapturePaths, Product, ProductContext, WrittenFile
from agalign.values import geometry
from agalign.values.capture import Band, Capture
from agalign.values.choices import Interpolation
from agalign.values.geometry import Points
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.radiometry import Quantity, Radiometry
from agalign.values.remedies import MISSING_BAND
from agalign.values.resampling import as_type, can_hold, tiles
from agalign.values.spectrum import Role, role_of_band

_MAX_VIGNETTING_ERROR = 0.01
"""Limit for the tags of aligned files, p95 of corrected pixels: a fifth of the accuracy of the cameras' calibration."""
_FILL_DISTANCE_PX = 100.0
"""Search distance of the interpolation of occluded pixels: GDAL's default, wider than any occlusion."""
UNITS: Mapping[Quantity, str] = {
    "radiance": "W m-2 sr-1 nm-1",
    "relative radiance": "",
    "reflectance": "1",
    "relative reflectance": "1",
    "temperature": "degC",
}
"""Units in the notation of UDUNITS."""

Pixels = NDArray[np.generic]


class BandFiles(Product):
    """An aligned raster for each input file; none if its bands failed."""

    kind = "band"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only the stack is written."""
        return settings.layout != "stack"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:
        """Return the files if they are enabled. Otherwise other files, such as stacks, may have these names."""
        names = dict.fromkeys(band_file_names(capture).values()) if self.is_enabled(settings) else ()
        return [paths.folder / name for name in names]

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write the files of all bands with pixels."""
        names = band_file_names(context.capture)
        layers = [layer for layer in context.layers if not layer.is_gap]
        vignettings = _vignettings(layers, context.grid) if context.is_raw else {}
        if any(v.error > _MAX_VIGNETTING_ERROR for v in vignettings.values()):
            # A program that corrects some bands of a capture only would change its indices.
            layers = [replace(layer, vignetting=_correction(layer.band)) for layer in layers]
            vignettings = {}
        by_file: dict[Path, list[Layer]] = {}
        for layer in layers:
            by_file.setdefault(names[layer.band.name], []).append(layer)
        written = []
        for name, of_file in by_file.items():
            band, path = of_file[0].band, context.paths.folder / name
            vignetting = vignettings.get(band.name)
            rows = _rows(of_file[0], context.grid)
            tags = band_tags(
                band, context.capture.reference, context.grid, vignetting, rows, radiometry=not context.is_raw
            )
            written.append(_written(self.kind, context, of_file, path, tags))
        return written


def band_file_names(capture: Capture) -> dict[str, Path]:
    """Return the file of each band in layout `bands`, relative to the capture's output folder.

    It has the name of the input file, with the band's name if several bands of that file have a lens each, and with the
    folder if input files of the same name are in several folders.
    """
    bands_per_file = Counter(b.path for b in capture.bands)
    # Files of several bands with a lens each.
    split = {b.path for b in capture.bands if not b.one_lens and bands_per_file[b.path] > 1}
    files = bands_per_file.keys()
    has_namesakes = len({p.stem for p in files}) < len(files)
    by_folder = has_namesakes and len({p.parent for p in files}) > 1
    names: dict[str, Path] = {}
    taken: dict[str, Path] = {}  # in lower case: some file systems ignore it
    band_names: dict[str, str] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{file_name(band.name, band_names)}" if band.path in split else band.path.stem
        folder = band.path.parent.name if by_folder else ""
        suffix = band.path.suffix if suffix_format(band.path) == "TIFF" else ".tif"
        name = Path(folder, f"{stem}{suffix}")
        # The name of the stack, or of another input file with a different suffix.
        is_stack = str(name).lower() == f"{capture.name}.tif".lower()
        if is_stack or taken.get(str(name).lower(), band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[str(name).lower()] = band.path
        names[band.name] = name
    return names


def _vignettings(layers: Sequence[Layer], grid: OutputGrid) -> dict[str, GridVignetting]:
    """The vignetting of bands on the output grid; none for bands without its tags or without pixels."""
    result = {}
    min_points = 30  # pixels of the lattice of 25 x 19 that must be inside a band: a polynomial has six coefficients
    for layer in layers:
        correction = _correction(layer.band)
        output_px, positions_px = _lattice(layer, grid)
        if correction is not None and len(output_px) >= min_points:
            result[layer.band.name] = vignetting_on_grid(correction, output_px, positions_px)
    return result


def _rows(layer: Layer, grid: OutputGrid) -> GridRows:
    """The rows of a band's file as a linear function of the rows of the output, by least squares."""
    output_px, positions_px = _lattice(layer, grid)
    y = output_px[:, 1]
    if len(np.unique(y)) < 2:
        return SAME_ROWS
    step, first = np.polyfit(y, positions_px[:, 1], 1).tolist()
    return GridRows(first, step)


def _lattice(layer: Layer, grid: OutputGrid) -> tuple[Points, Points]:
    """(pixels (n, 2) of the output inside a band, their positions in its file)."""
    output_px = geometry.lattice(grid.width, grid.height, 25, 19)
    positions_px = layer.positions(output_px, grid)
    inside = is_inside(positions_px, layer.band)
    return output_px[inside], positions_px[inside]


def _correction(band: Band) -> Radiometry | None:
    """The correction of a band's vignetting: that of its calibration, which is of the image as it is, also if a program
    resized it; without a calibration by the tags of the file, unless these are of another image.
    """
    known = band.radiometry
    if known is not None and any(known.vignetting) and known.vignetting_divides:
        return replace(known, quantity="relative radiance", full_scale=1.0, gain=1.0, row_gradient=0.0)
    if band.has_other_lens:
        return None
    with suppress(UnreadableFileError):
        tags = read_tags(band.path, band.page)
        return vignetting_of(tags, band.size_px, divides=not isinstance(camera_of(tags), Dji))
    return None


class Stack(Product):
    """A raster of the same bands in the same order for all captures of a camera. A band that failed or is missing is
    all nodata, and its tags STATUS and REASON say why.
    """

    kind = "stack"
    suffix = ".tif"

    def is_enabled(self, settings: WriteSettings) -> bool:
        """True unless only files of single bands are written."""
        return settings.layout != "bands"

    def write(self, context: ProductContext) -> list[WrittenFile]:
        """Write <capture>.tif."""
        tags = capture_tags(context.capture.reference, context.grid)
        return [_written(self.kind, context, context.layers, context.paths.file(self.suffix), tags)]


def _written(
    kind: str, context: ProductContext, layers: Sequence[Layer], path: Path, tags: TransferredTags
) -> WrittenFile:
    """Write layers as the bands of one file, and return it."""
    nodata = write_raster(context, layers, path, tags, is_stack=kind == Stack.kind)
    bands, is_flat = tuple(layer.band.name for layer in layers), any(layer.vignetting for layer in layers)
    return WrittenFile(kind, path, bands, nodata, is_flat=is_flat)


def write_raster(
    context: ProductContext,
    layers: Sequence[Layer],
    path: Path,
    tags: TransferredTags | None = None,
    *,
    is_stack: bool = False,
) -> float | None:
    """Write layers of a capture as the bands of one file atomically; return its nodata value.

    The type is that of the layers if all have the same, else the smallest type that represents them all; float32 after
    radiometric calibration. A nodata value is declared if the reference declares one, for floats, or if some pixel
    needs it; valid moving pixels that equal it change by the smallest step. A COG gets no `tags`: tags that GDAL does
    not write itself would break its layout.
    Raises OutputError, or UnreadableFileError for an input.
    """
    capture, settings, raw = context.capture, context.settings.write, context.is_raw
    dtype = np.result_type(*(layer.band.dtype for layer in layers)) if raw else np.dtype(np.float32)
    nodata = nodata_value(context, layers, dtype)
    # GDAL writes no COG of uncompressed pixels that are interleaved by band.
    interleave = "pixel" if (settings.format, settings.compression) == ("cog", "none") else "band"
    options: dict[str, object] = {"interleave": interleave, "photometric": "minisblack", "nodata": nodata}
    options |= compressed(dtype.name, settings.compression, is_stack=is_stack)
    overviews = list(capture.reference.overviews) if settings.format == "gtiff" else []

    def finish(partial: Path) -> None:
        if overviews or settings.statistics:
            with open_local(partial, "r+") as dataset:
                if settings.statistics:
                    dataset.stats(approx=False)  # GDAL stores in the file what it computes
                if overviews:
                    dataset.build_overviews(overviews, Resampling.average)
        if settings.format == "cog":
            to_cog(partial)
        elif tags is not None:
            add_directories(partial, *tags)

    blocks, georeference = _blocks(context, layers, dtype, nodata), capture.reference.georeference
    descriptions, own_tags, grid = _descriptions(context, layers), _tags(capture, layers, raw=raw), context.grid
    write_on_grid(
        path, grid, georeference, descriptions, blocks, tags=own_tags, dtype=dtype.name, options=options, finish=finish
    )
    return nodata


def is_aligned_raster(path: Path) -> bool:
    """Return True for a file that `write_raster` has written."""
    return "REFERENCE_BAND" in tags_of(path)


def tags_of(path: Path) -> dict[str, str]:
    """Return the tags of a raster; none for another file, or one that cannot be read."""
    with suppress(AgalignError), open_raster(path) as source:
        return dict(source.tags())
    return {}


def _tags(capture: Capture, layers: Sequence[Layer], *, raw: bool) -> dict[str, str]:
    """The tags of a file."""
    known = [] if raw else [layer.band.radiometry for layer in layers if layer.band.radiometry is not None]
    return {
        "TIFFTAG_DATETIME": capture.known_time[:19].replace("-", ":").replace("T", " "),
        "CAPTURE_ID": capture.capture_id,
        "CAMERA": capture.camera.name,
        "REFERENCE_BAND": capture.reference.name,
        "RADIOMETRY": " and ".join(dict.fromkeys(r.quantity for r in known)),
        "RADIOMETRY_SOURCE": " and ".join(dict.fromkeys(r.source for r in known)),
        "VIGNETTING": "corrected" if any(layer.vignetting for layer in layers) else "",
    }


def _descriptions(context: ProductContext, layers: Sequence[Layer]) -> list[LayerDescription]:
    result, raw = [], context.is_raw
    is_calibrated = not raw and any(layer.band.radiometry is not None for layer in layers)
    for layer, colour in zip(layers, _colours(layers), strict=True):
        band = layer.band
        quantity = None if raw or band.radiometry is None else band.radiometry.quantity
        # A band without calibration, as of a photograph, has not the quantity of the file.
        known = quantity or ("" if layer.is_gap else RAW)
        tags = {"QUANTITY": known} if is_calibrated and known else {}
        if layer.is_gap:
            alignment = context.alignments.get(band.name)
            why_missing = str(context.capture.unreadable_bands.get(band.name, MISSING_BAND.cause))
            status, reason = ("missing", why_missing) if alignment is None else (alignment.status, alignment.reason)
            tags |= {"STATUS": status, "REASON": reason or why_missing}
        if band.wavelength_nm is not None:
            tags |= {"wavelength": f"{band.wavelength_nm:g}", "wavelength_units": "nm"}
            if band.bandwidth_nm is not None:
                tags["fwhm"] = f"{band.bandwidth_nm:g}"
        unit, scale_offset = "" if quantity is None else UNITS[quantity], band.scale_offset if raw else (1.0, 0.0)
        result.append(LayerDescription(band.name, unit, tags, scale_offset, colour))
    return result


def _colours(layers: Sequence[Layer]) -> Sequence[ColorInterp | None]:
    """The colour interpretation of each layer. If there are red, green and blue, the first band of each is displayed as
    such by viewers; else the first layer is grey. None for a single layer.
    """
    if len(layers) == 1:
        return [None]
    roles, undefined = [role_of_band(layer.band) for layer in layers], ColorInterp.undefined
    colours: tuple[Role, ...] = ("red", "green", "blue")
    if not set(colours) <= set(roles):
        return [ColorInterp.gray, *[undefined] * (len(layers) - 1)]
    result = [undefined] * len(layers)
    for role in colours:
        result[roles.index(role)] = ColorInterp[role]
    return result


def _blocks(
    context: ProductContext, layers: Sequence[Layer], dtype: np.dtype[Any], nodata: float | None
) -> Iterator[Block]:
    """Yield the pixels of layers."""
    grid = context.grid
    for index, layer in enumerate(layers, start=1):
        for tile in tiles(grid, WORK_TILE_PX):
            if layer.is_gap:
                pixels: Pixels = np.full((tile.height, tile.width), 0 if nodata is None else nodata, dtype=dtype)
            else:
                pixels, valid = _tile_of(layer, tile, context.settings.write)
                pixels = pixels.astype(dtype, copy=False)
                if nodata is not None:
                    pixels = with_nodata(pixels, valid, nodata)
            yield pixels, index, tile.x0 - grid.x0, tile.y0 - grid.y0


def _tile_of(layer: Layer, tile: Tile, settings: WriteSettings) -> tuple[Pixels, Mask]:
    """The pixels (height, width) of a layer that has any on a tile, and their mask."""
    radiometry = layer.vignetting if settings.radiometry == "off" else layer.band.radiometry
    pixels, valid = layer_pixels(layer, tile, settings.interpolation, radiometry)
    if layer.vignetting is not None:
        pixels = as_type(pixels.astype(np.float32) + layer.vignetting.black_level, np.dtype(layer.band.dtype))
    if settings.fill_occluded and layer.mapping is not None:
        occluded = layer.mapping.hidden(tile) & is_inside(layer.mapping.positions(tile), layer.band)
        if occluded.any() and valid.any():  # GDAL's inverse distance weighting
            distance_px = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, 3)
            occluded &= distance_px < _FILL_DISTANCE_PX
            filled = fillnodata(np.where(valid, pixels, 0).astype(np.float32), valid, _FILL_DISTANCE_PX)
            return np.where(occluded, as_type(filled, pixels.dtype), pixels), valid | occluded
    return pixels, valid


def layer_pixels(
    layer: Layer, tile: Tile, interpolation: Interpolation, radiometry: Radiometry | None
) -> tuple[Pixels, Mask]:
    """Return the pixels of a layer (height, width) on a tile, calibrated if `radiometry` is given, and their mask."""
    if layer.mapping is not None:
        size_px, read = layer.size_px, layer.read
        return resample_tile(layer.band, layer.mapping, tile, interpolation, radiometry, size_px=size_px, read=read)
    pixels, valid = layer.read(layer.band, tile)
    return pixels if radiometry is None else calibrated(pixels, radiometry, tile.x0, tile.y0), valid


def nodata_value(context: ProductContext, layers: Sequence[Layer], dtype: np.dtype[Any]) -> float | None:
    """Return the nodata value of a file with these layers; None if every pixel is valid. Raises UnreadableFileError."""
    declared, grid = context.capture.reference.nodata, context.grid
    if not context.is_raw:
        return math.nan
    if declared is not None and not math.isinf(declared) and can_hold(dtype, declared):
        return declared
    if dtype.kind == "f":
        return math.nan  # input files may contain nan without declaring it; sidecars cannot contain infinite numbers
    may_lack_pixels = any(
        la.is_gap or la.band.nodata is not None or la.band.has_mask or la.band.missing for la in layers
    )
    return _unused_value(layers, grid, dtype) if grid.has_gaps or may_lack_pixels else None


def with_nodata(pixels: Pixels, valid: Mask, nodata: float) -> Pixels:
    """Return pixels (height, width) with nodata where they are not valid.

    Valid pixels that equal nodata change by the smallest step of their type.
    """
    dtype = pixels.dtype
    if not math.isnan(nodata):
        if dtype.kind == "f":
            step = float(np.spacing(np.abs(dtype.type(nodata)) + 1))
        else:
            step = 1 if nodata < np.iinfo(str(dtype)).max else -1
        pixels = np.where(valid & (pixels == nodata), dtype.type(nodata + step), pixels)
    return np.where(valid, pixels, dtype.type(nodata))


def _unused_value(layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any]) -> float:
    """The first of 0, the largest value of the type, 1, 2 … that no copied band contains: copied pixels then keep their
    values. 0 if there is none, as with all 256 values of 8 bits.
    """
    copied = []
    for layer in (one for one in layers if one.is_copied):
        read = (layer.read(layer.band, tile) for tile in tiles(grid, WORK_TILE_PX))
        copied += [np.unique(pixels[valid] if layer.band.missing else pixels) for pixels, valid in read]
    limits = np.iinfo(str(dtype))
    # All values of a 16-bit type; for larger types the first ones are sufficient.
    candidates = itertools.chain([0, limits.max], range(1, min(limits.max, 1 << 16)))
    return float(next((v for v in candidates if not any((values == v).any() for values in copied)), 0))
