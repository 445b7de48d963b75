"""Aligned rasters, tiled GeoTIFF or COG, on the reference's pixel grid: a stack of all bands, a file for each input
file, or both.
"""

import errno
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.shutil import copy as copy_dataset
from rasterio.transform import Affine
from rasterio.windows import Window

from agalign.cameras.pix4d import FromSource
from agalign.cameras.tag_transfer import TransferredTags, band_tags, capture_tags
from agalign.cameras.tiff_directory import add_directories
from agalign.config import WriteSettings
from agalign.errors import OutputError
from agalign.pixels.radiometry import calibrated
from agalign.pixels.raster import GDAL_ENVIRONMENT, TIFF_SUFFIXES, open_raster, read_window, why, without_warnings
from agalign.pixels.resample import resample_tile, tiles
from agalign.products.layout import Layer
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Georeference, Quantity
from agalign.values.files import complete_file
from agalign.values.image import Mask, OutputGrid, Tile
from agalign.values.mapping import PixelMapping

Pixels = NDArray[np.generic]
UNITS: Mapping[Quantity, str] = {
    "radiance": "W m-2 sr-1 nm-1", "relative radiance": "", "reflectance": "1", "relative reflectance": "1",
    "temperature": "degC",
}  # fmt: skip
"""In the words of UDUNITS."""
_FOUND_PX = 0.1
_TILE_PX = 2048
_MAX_VALUES_TRIED = 1 << 16


@dataclass(frozen=True)
class Written:
    """What was written of a capture."""

    folder: Path
    grid: OutputGrid
    stack: Path | None
    contents: Mapping[Path, tuple[str, ...]]
    """Of every file, the names of its bands in their order."""
    nodata: Mapping[Path, float | None]
    """Of every file, the value that it declares."""
    gaps: frozenset[str]
    """Bands that are all nodata in the stack."""

    @property
    def band_files(self) -> list[Path]:
        """All files but the stack."""
        return [path for path in self.contents if path != self.stack]

    @property
    def places(self) -> dict[str, tuple[Path, int]]:
        """By band that holds something: a file, the stack where there is one, and its index there, from 1."""
        return {
            name: (path, index)
            for path in [*self.band_files, *([self.stack] if self.stack is not None else [])]
            for index, name in enumerate(self.contents[path], start=1)
            if name not in self.gaps
        }


def write_capture(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, stack: Path, settings: WriteSettings
) -> Written:
    """Write what the layout asks for, each file complete or not at all; `stack` is the stack's path.

    Raises OutputError, or UnreadableFileError for an input.
    """
    contents: dict[Path, tuple[str, ...]] = {}
    nodata: dict[Path, float | None] = {}

    def write(path: Path, some: Sequence[Layer], tags: TransferredTags) -> None:
        nodata[path] = write_raster(capture, some, grid, path, settings, tags)
        contents[path] = tuple(layer.band.name for layer in some)

    reference = capture.reference
    if settings.layout != "stack":
        names = band_file_names(capture)
        for name in dict.fromkeys(names.values()):
            some = [layer for layer in layers if names[layer.band.name] == name and not layer.is_gap]
            if some:
                source, back = some[0].band.path, _from_source(some[0], grid)
                write(
                    stack.parent / name, some,
                    band_tags(source, reference, grid, back, radiometry=settings.radiometry != "off"),
                )  # fmt: skip
    if settings.layout != "bands":
        write(stack, layers, capture_tags(reference, grid))
    gaps = frozenset(layer.band.name for layer in layers if layer.is_gap)
    return Written(stack.parent, grid, stack if stack in contents else None, contents, nodata, gaps)


def band_file_names(capture: Capture) -> dict[str, Path]:
    """By band: the file for it in layout `bands`, below the capture's output folder.

    It keeps the name of the file it comes from; where several bands of a file have lenses of their own, or the bands'
    folders tell them apart, those are part of it.
    """
    several = {b.path for b in capture.bands if sum(b.path == o.path for o in capture.bands) > 1 and not b.one_lens}
    folders = {b.path.parent for b in capture.bands}
    same_name = len({b.path.stem for b in capture.bands}) < len({b.path for b in capture.bands})
    names: dict[str, Path] = {}
    taken: dict[Path, Path] = {}
    for band in capture.bands:
        stem = f"{band.path.stem}_{_in_file_name(band.name)}" if band.path in several else band.path.stem
        folder = band.path.parent.name if same_name and len(folders) > 1 else ""
        suffix = band.path.suffix if band.path.suffix.lower() in TIFF_SUFFIXES else ".tif"
        name = Path(folder, f"{stem}{suffix}")
        # The stack has its own name, and so has each file.
        if name == Path(f"{capture.name}.tif") or taken.get(name, band.path) != band.path:
            name = Path(folder, f"{stem}_{band.path.suffix[1:].lower()}.tif")
        taken[name] = band.path
        names[band.name] = name
    return names


def _in_file_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "-." else "_" for c in text)


def write_raster(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, path: Path, settings: WriteSettings,
    tags: TransferredTags | None = None,
) -> float | None:  # fmt: skip
    """Write layers as the bands of one file, complete or not at all; returns its nodata value.

    The type is the layers' where all share it, else the smallest that holds them all; float32 after radiometry. A
    nodata value is declared only where some pixel needs it; valid moving pixels that happen to equal it are moved by
    the smallest step. Tags that TIFF libraries do not write are left out of a COG, whose layout they would break.
    Raises OutputError, or UnreadableFileError for an input.
    """
    raw = settings.radiometry == "off"
    dtype = np.result_type(*(layer.band.dtype for layer in layers)) if raw else np.dtype(np.float32)
    nodata = _nodata(capture, layers, grid, dtype, settings)
    whole = len(layers) == len(capture.bands) and settings.layout != "bands"
    compression = _compression(settings, whole=whole)
    profile = _profile(capture.reference, len(layers), grid, dtype, nodata, compression, settings.tile_px)
    try:
        with complete_file(path) as partial:
            with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT):
                with rasterio.open(partial, "w", **profile) as dataset:
                    _describe(dataset, capture, layers, settings)
                    for index, layer in enumerate(layers, start=1):
                        _write_layer(dataset, index, layer, grid, nodata, settings)
                if capture.reference.overviews and settings.format == "gtiff":
                    with rasterio.open(partial, "r+") as dataset:
                        dataset.build_overviews(list(capture.reference.overviews), Resampling.average)
                if tags is not None:
                    add_directories(partial, tags.first, tags.exif, tags.gps)
                if settings.format == "cog":
                    _to_cog(partial, compression)
            verify(partial)
    except (RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({why(error)})") from None
    return nodata


def _from_source(layer: Layer, grid: OutputGrid) -> FromSource:
    """Where a pixel of the layer's file lies in the reference's pixels: the mapping the other way, by iteration."""
    to_file = PixelMapping(geometry.identity()) if layer.mapping is None else layer.mapping
    middle = np.array([grid.x0 + grid.width / 2, grid.y0 + grid.height / 2])

    def from_source(x: float, y: float) -> tuple[float, float]:
        at = middle
        try:
            for _ in range(20):
                here = to_file(at)
                step = np.stack([to_file(at + d) - here for d in np.eye(2)], axis=-1)
                at = at + np.linalg.solve(step, np.array([x, y]) - here)
        except np.linalg.LinAlgError:
            return math.nan, math.nan
        if not np.abs(to_file(at) - (x, y)).max() < _FOUND_PX:
            return math.nan, math.nan
        return (at[0] + 0.5) / grid.scale_xy[0] - 0.5, (at[1] + 0.5) / grid.scale_xy[1] - 0.5

    return from_source


# ---- pixels


def _write_layer(
    dataset: Any, index: int, layer: Layer, grid: OutputGrid, nodata: float | None, settings: WriteSettings
) -> None:
    dtype = np.dtype(dataset.dtypes[0])
    for tile in tiles(grid.tile, settings.work_tile_px):
        pixels, valid = _tile_of(layer, tile, settings)
        if pixels is None:
            pixels = np.full((tile.height, tile.width), 0 if nodata is None else nodata, dtype=dtype)
        elif nodata is not None and not (valid.all() and layer.is_copied):
            pixels = marked(pixels.astype(dtype, copy=False), valid, nodata)
        window = Window(tile.x0 - grid.x0, tile.y0 - grid.y0, tile.width, tile.height)
        dataset.write(pixels.astype(dtype, copy=False), index, window=window)


def _tile_of(layer: Layer, tile: Tile, settings: WriteSettings) -> tuple[Pixels | None, Mask]:
    """A layer's pixels on a tile and their mask; no pixels for a gap."""
    if layer.is_gap:
        return None, np.zeros((tile.height, tile.width), dtype=bool)
    radiometry = None if settings.radiometry == "off" else layer.band.radiometry
    if layer.mapping is not None:
        return resample_tile(layer.band, layer.mapping, tile, settings.interpolation, radiometry)
    with open_raster(layer.band.path) as source:
        pixels, valid = read_window(source, layer.band, tile.x0, tile.y0, tile.width, tile.height)
    return pixels if radiometry is None else calibrated(pixels, radiometry, tile.x0, tile.y0), valid


def marked(pixels: Pixels, valid: Mask, nodata: float) -> Pixels:
    """Nodata where pixels are not valid; valid ones that happen to equal it are moved by the smallest step."""
    if not math.isnan(nodata):
        step = 1 if pixels.dtype.kind != "f" else np.spacing(np.abs(pixels.dtype.type(nodata)) + 1)
        beside = (
            nodata + step if pixels.dtype.kind == "f" or nodata < np.iinfo(str(pixels.dtype)).max else nodata - step
        )
        pixels = np.where(valid & (pixels == nodata), pixels.dtype.type(beside), pixels)
    return np.where(valid, pixels, pixels.dtype.type(nodata))


def _nodata(
    capture: Capture, layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any], settings: WriteSettings
) -> float | None:
    """The value to declare; None where every pixel has a value."""
    if settings.radiometry != "off":
        return math.nan
    declared = capture.reference.nodata
    if declared is not None and _fits(declared, dtype):
        return declared
    if dtype.kind == "f":
        return math.nan  # nan needs no declaration in a source
    gaps = any(layer.is_gap for layer in layers)
    masked = any(layer.band.nodata is not None or layer.band.has_mask for layer in layers)
    return _unused_value(layers, grid, dtype) if gaps or masked or grid.has_gaps else None


def _unused_value(layers: Sequence[Layer], grid: OutputGrid, dtype: np.dtype[Any]) -> float:
    """0, or where bands that are copied hold zeros the largest value, or else the first that they do not hold.

    Copied pixels are never changed, but for a type all of whose values they hold: then 0.
    """
    copied = [layer.band for layer in layers if layer.mapping is None and not layer.is_gap]
    held = [_values_in(band, grid.tile) for band in copied]
    limits = np.iinfo(str(dtype))
    wanted = itertools.chain([0, limits.max], range(1, min(limits.max, _MAX_VALUES_TRIED)))
    return float(next((v for v in wanted if not any((values == v).any() for values in held)), 0))


def _values_in(band: Band, tile: Tile) -> Pixels:
    """All different values of a band on a rectangle."""
    with open_raster(band.path) as source:
        result = [np.unique(read_window(source, band, t.x0, t.y0, t.width, t.height)[0]) for t in tiles(tile, _TILE_PX)]
    return np.unique(np.concatenate(result))


def _fits(value: float, dtype: np.dtype[Any]) -> bool:
    if dtype.kind == "f":
        return True
    limits = np.iinfo(str(dtype))
    return float(value).is_integer() and limits.min <= value <= limits.max


# ---- what the file says of itself


def _profile(
    reference: Band,
    count: int,
    grid: OutputGrid,
    dtype: np.dtype[Any],
    nodata: float | None,
    compression: str,
    tile_px: int,
) -> dict[str, Any]:
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": count,
        "dtype": dtype.name,
        "interleave": "band",
        "photometric": "minisblack",
        "bigtiff": "if_safer",
        "tiled": True,
        "blockxsize": tile_px,
        "blockysize": tile_px,
    }
    if nodata is not None:
        profile["nodata"] = nodata
    if compression != "none":
        profile |= {"compress": compression, "predictor": 3 if dtype.kind == "f" else 2}
        profile |= {"zstd_level": 1} if compression == "zstd" else {"zlevel": 6}
    if reference.georeference is not None:
        profile |= georeferenced(reference.georeference, grid)
    return profile


def _compression(settings: WriteSettings, *, whole: bool) -> str:
    """Files of single bands go on to programs that seldom know Zstandard."""
    if settings.compression != "auto":
        return settings.compression
    return "zstd" if whole else "deflate"


def georeferenced(georeference: Georeference, grid: OutputGrid) -> dict[str, Any]:
    """What rasterio needs to know of where an output grid lies."""
    # Only where the source has one: an identity transform would be an invented georeference.
    # Geotransforms count from corners, where a change of resolution is a mere factor.
    shrunk = np.diag([1 / grid.scale_xy[0], 1 / grid.scale_xy[1], 1.0])
    written = georeference.transform @ shrunk @ geometry.translation(grid.x0, grid.y0)
    return {"transform": Affine(*written[:2].ravel()), "crs": rasterio.CRS.from_wkt(georeference.crs_wkt)}


def _describe(dataset: Any, capture: Capture, layers: Sequence[Layer], settings: WriteSettings) -> None:
    facts = {
        "TIFFTAG_SOFTWARE": "agalign",
        "TIFFTAG_DATETIME": capture.captured_at[:19].replace("-", ":").replace("T", " "),
        "CAPTURE_ID": capture.capture_id,
        "CAMERA": f"{capture.camera.make} {capture.camera.model}".strip(),
        "REFERENCE_BAND": capture.reference.name,
    }
    raw = settings.radiometry == "off"
    quantities = [None if raw or layer.band.radiometry is None else layer.band.radiometry.quantity for layer in layers]
    facts["RADIOMETRY"] = " and ".join(dict.fromkeys(q for q in quantities if q is not None))
    sources = [] if raw else [b.radiometry.source for layer in layers if (b := layer.band).radiometry is not None]
    facts["RADIOMETRY_SOURCE"] = " and ".join(dict.fromkeys(sources))
    dataset.update_tags(**{k: v for k, v in facts.items() if v})
    if any(quantities):
        dataset.units = [UNITS[q] if q is not None else "" for q in quantities]
        for index, quantity in enumerate(quantities, start=1):
            dataset.update_tags(index, **({} if quantity is None else {"QUANTITY": quantity}))
    if raw and any(layer.band.scale_offset != (1.0, 0.0) for layer in layers):
        dataset.scales, dataset.offsets = zip(*(layer.band.scale_offset for layer in layers), strict=True)
    for index, layer in enumerate(layers, start=1):
        dataset.set_band_description(index, layer.band.name)
        if layer.band.wavelength_nm is not None:
            width = {} if layer.band.bandwidth_nm is None else {"fwhm": f"{layer.band.bandwidth_nm:g}"}
            dataset.update_tags(index, wavelength=f"{layer.band.wavelength_nm:g}", wavelength_units="nm", **width)
            micrometres = f"{layer.band.wavelength_nm / 1000:g}"
            dataset.update_tags(index, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=micrometres)


def verify(path: Path) -> None:
    """Raises OSError for a raster that is not whole.

    GDAL flushes when a file is closed, and what fails then (a full disk) is not raised: look at the result.
    """
    size = path.stat().st_size
    with tifffile.TiffFile(path) as tiff:
        segments = [s for page in tiff.pages for s in zip(page.dataoffsets, page.databytecounts, strict=True)]
    if not segments or any(count == 0 or offset + count > size for offset, count in segments):
        raise OSError(errno.EIO, "the file came out incomplete; is the disk full?")


def _to_cog(path: Path, compression: str) -> None:
    cog = path.with_name(f"{path.name}.cog")
    options = {} if compression == "none" else {"compress": compression, "predictor": "yes"}
    try:
        copy_dataset(path, cog, driver="COG", blocksize=512, bigtiff="if_safer", **options)
        cog.replace(path)
    finally:
        cog.unlink(missing_ok=True)
