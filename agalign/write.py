"""Aligned stacks: tiled GeoTIFF or COG on the reference's pixel grid."""

import errno
import math
import os
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.shutil import copy as copy_dataset
from rasterio.transform import Affine
from rasterio.windows import Window

from agalign import geometry
from agalign.config import WriteSettings
from agalign.errors import OutputError
from agalign.mapping import Mapping
from agalign.raster import open_raster, read_window
from agalign.records import Band, Capture, Georeference, Tile
from agalign.warp import resample_tile, tiles


@dataclass(frozen=True)
class Layer:
    """One band of the stack: the reference (no mapping), a moving band, or a gap (nothing to write)."""

    band: Band
    mapping: Mapping | None
    is_reference: bool = False


@dataclass(frozen=True)
class Stack:
    """What was written."""

    path: Path
    crop: Tile
    nodata: float | None


def write_stack(capture: Capture, layers: list[Layer], crop: Tile, path: Path, settings: WriteSettings) -> Stack:
    """Write all layers to `path`, complete or not at all. Raises OutputError, or UnreadableFileError for an input.

    The type is the reference's where all bands share it, else the smallest that holds them all. A nodata value is
    declared only where some pixel needs it; valid moving pixels that happen to equal it are moved by the smallest step.
    """
    dtype = np.result_type(*(layer.band.dtype for layer in layers))
    nodata = _nodata(capture, layers, crop, dtype, settings)
    profile = _profile(capture.reference, len(layers), crop, dtype, nodata, settings)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings(), rasterio.Env(GDAL_PAM_ENABLED="NO", GDAL_NUM_THREADS="ALL_CPUS"):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(partial, "w", **profile) as dataset:
                _describe(dataset, capture, layers)
                for index, layer in enumerate(layers, start=1):
                    _write_layer(dataset, index, layer, crop, nodata, settings)
            if settings.format == "cog":
                _to_cog(partial, settings)
        _verify(partial)
        partial.replace(path)
    except (OSError, RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{path}: cannot be written ({error})") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    return Stack(path, crop, nodata)


def _write_layer(
    dataset: Any, index: int, layer: Layer, crop: Tile, nodata: float | None, settings: WriteSettings
) -> None:
    for tile in tiles(crop, settings.work_tile_px):
        window = Window(tile.x0 - crop.x0, tile.y0 - crop.y0, tile.width, tile.height)
        if layer.is_reference and layer.mapping is None:
            with open_raster(layer.band.path) as source:
                pixels, _ = read_window(source, layer.band, tile.x0, tile.y0, tile.width, tile.height)
        elif layer.mapping is None:
            pixels = np.full((tile.height, tile.width), 0 if nodata is None else nodata, dtype=dataset.dtypes[0])
        else:
            pixels, valid = resample_tile(layer.band, layer.mapping, tile, settings.interpolation)
            if nodata is not None:
                pixels = _marked(pixels.astype(dataset.dtypes[0], copy=False), valid, nodata)
        dataset.write(pixels.astype(dataset.dtypes[0], copy=False), index, window=window)


def _marked(pixels: NDArray[np.generic], valid: NDArray[np.bool_], nodata: float) -> NDArray[np.generic]:
    if not math.isnan(nodata):
        step = 1 if pixels.dtype.kind != "f" else np.spacing(np.abs(pixels.dtype.type(nodata)) + 1)
        beside = (
            nodata + step if pixels.dtype.kind == "f" or nodata < np.iinfo(str(pixels.dtype)).max else nodata - step
        )
        pixels = np.where(valid & (pixels == nodata), pixels.dtype.type(beside), pixels)
    return np.where(valid, pixels, pixels.dtype.type(nodata))


def _nodata(
    capture: Capture, layers: list[Layer], crop: Tile, dtype: np.dtype[Any], settings: WriteSettings
) -> float | None:
    declared = capture.reference.nodata
    if declared is not None and (dtype.kind == "f" or float(declared).is_integer()):
        return declared
    gaps = any(layer.mapping is None and not layer.is_reference for layer in layers)
    whole = crop == Tile(0, 0, *capture.reference.size_px)
    moved = any(layer.mapping is not None for layer in layers)
    masked = any(layer.band.nodata is not None or layer.band.has_mask for layer in layers)
    masked |= dtype.kind == "f"  # nan needs no declaration in a source
    needed = gaps or masked or (moved and (whole or settings.crop == "none"))
    if not needed:
        return None
    return math.nan if dtype.kind == "f" else 0.0


def _profile(
    reference: Band, count: int, crop: Tile, dtype: np.dtype[Any], nodata: float | None, settings: WriteSettings
) -> dict[str, Any]:
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": crop.width,
        "height": crop.height,
        "count": count,
        "dtype": dtype.name,
        "interleave": "band",
        "photometric": "minisblack",
        "bigtiff": "if_safer",
        "tiled": True,
        "blockxsize": settings.tile_px,
        "blockysize": settings.tile_px,
    }
    if nodata is not None:
        profile["nodata"] = nodata
    if settings.compression != "none":
        profile |= {"compress": settings.compression, "predictor": 3 if dtype.kind == "f" else 2}
        profile |= {"zstd_level": 1} if settings.compression == "zstd" else {"zlevel": 6}
    if reference.georeference is not None:
        profile |= _georeference(reference.georeference, crop)
    return profile


def _georeference(georeference: Georeference, crop: Tile) -> dict[str, Any]:
    # Only where the source has one: an identity transform would be an invented georeference.
    # Whole pixels, so that corner and centre conventions move alike.
    cropped = georeference.transform @ geometry.translation(crop.x0, crop.y0)
    return {"transform": Affine(*cropped[:2].ravel()), "crs": rasterio.CRS.from_wkt(georeference.crs_wkt)}


def _describe(dataset: Any, capture: Capture, layers: list[Layer]) -> None:
    facts = {
        "TIFFTAG_SOFTWARE": "agalign",
        "TIFFTAG_DATETIME": capture.captured_at[:19].replace("-", ":").replace("T", " "),
        "CAPTURE_ID": capture.capture_id,
        "CAMERA": f"{capture.camera.make} {capture.camera.model}".strip(),
        "REFERENCE_BAND": capture.reference.name,
    }
    dataset.update_tags(**{k: v for k, v in facts.items() if v})
    for index, layer in enumerate(layers, start=1):
        dataset.set_band_description(index, layer.band.name)
        if layer.band.wavelength_nm is not None:
            width = {} if layer.band.bandwidth_nm is None else {"fwhm": f"{layer.band.bandwidth_nm:g}"}
            dataset.update_tags(index, wavelength=f"{layer.band.wavelength_nm:g}", wavelength_units="nm", **width)
            micrometres = f"{layer.band.wavelength_nm / 1000:g}"
            dataset.update_tags(index, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=micrometres)


def _verify(path: Path) -> None:
    """GDAL flushes when a file is closed, and what fails then (a full disk) is not raised: look at the result."""
    size = path.stat().st_size
    with tifffile.TiffFile(path) as tiff:
        segments = [s for page in tiff.pages for s in zip(page.dataoffsets, page.databytecounts, strict=True)]
    if not segments or any(count == 0 or offset + count > size for offset, count in segments):
        raise OSError(errno.EIO, "the file came out incomplete; is the disk full?")


def _to_cog(path: Path, settings: WriteSettings) -> None:
    cog = path.with_name(f"{path.name}.cog")
    options = {} if settings.compression == "none" else {"compress": settings.compression, "predictor": "yes"}
    try:
        copy_dataset(path, cog, driver="COG", blocksize=512, bigtiff="if_safer", **options)
        cog.replace(path)
    finally:
        cog.unlink(missing_ok=True)
