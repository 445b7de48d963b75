"""Reading rasters: what a file holds, its pixels at any resolution, and its validity."""

import math
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio import warp
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from agalign.errors import GeometryError, UnreadableFileError
from agalign.pixels.masks import data_mask, learnable, undeclared_fill
from agalign.values import lens
from agalign.values.capture import Band, Georeference
from agalign.values.choices import MAX_PIXELS
from agalign.values.image import Mask, Raster, Tile, reduced_size_px
from agalign.values.pixel_units import PixelScale

TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
_READ_WHOLE_PX = 1 << 26
"""Images up to this are decoded as a whole before they are averaged: 128 MB in 16 bits."""
JPEG_SUFFIXES = frozenset({".jpg", ".jpeg"})
PNG_SUFFIXES = frozenset({".png"})
PICTURE_SUFFIXES = JPEG_SUFFIXES | PNG_SUFFIXES
"""Photographs, or bands that a program has exported, most often in 8 bits."""
_BLOCK_CACHE_BYTES = 256 * 2**20
"""rasterio takes an integer as bytes. GDAL's default is 5 % of the machine's memory, which every worker would take."""
GDAL_ENVIRONMENT = {
    "GDAL_PAM_ENABLED": "NO", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_NUM_THREADS": "ALL_CPUS",
    "GDAL_CACHEMAX": _BLOCK_CACHE_BYTES,
}  # fmt: skip
"""GDAL neither writes files next to the user's nor reads any as part of an image: x.tif.ovr may hold anything, such as
a description of other files or of a server.
"""
_DRIVERS = {
    b"II*\0": "GTiff", b"MM\0*": "GTiff", b"II+\0": "GTiff", b"MM\0+": "GTiff", b"\xff\xd8\xff": "JPEG",
    b"\x89PNG": "PNG",
}  # fmt: skip
"""By the first bytes of a file: of GDAL's other drivers some execute code or contact servers, whatever the file's name.
"""
_MAX_BANDS = 512
"""More than any imager has; a damaged file may declare 65,535."""
_PREVIEW_SIDE_PX = 2048
"""Default for the longest side of a preview: more than a page shows."""
_MAX_MICROMETRES = 20.0
"""Wavelengths below this without a unit are in micrometres: thermal bands end at 14 um, and none is below 100 nm."""


@dataclass(frozen=True)
class RasterInfo:
    """The shape and the metadata of a raster file."""

    width_px: int
    height_px: int
    dtypes: tuple[str, ...]
    nodata: tuple[float | None, ...]
    descriptions: tuple[str | None, ...]
    wavelengths_nm: tuple[float | None, ...]
    alpha_index: int | None
    """Index from 1 of an alpha band, which does not show the scene."""
    georeference: Georeference | None
    has_mask: bool = False
    scales_offsets: tuple[tuple[float, float], ...] = ()
    """A pair per band, or empty."""
    overviews: tuple[int, ...] = ()

    @property
    def band_indexes(self) -> tuple[int, ...]:
        """Indexes from 1 of the bands that show the scene: all but the alpha band."""
        return tuple(i for i in range(1, len(self.dtypes) + 1) if i != self.alpha_index)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Silence rasterio's warning about images without a georeference: drone images have none.

    Warning filters belong to the process. Code that reads in several threads needs one more of these around all of
    them, so that no thread restores a filter that another still needs.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


OpenRaster = rasterio.DatasetReader
"""A file as `open_raster` gives it."""


@contextmanager
def open_raster(path: Path) -> Iterator[rasterio.DatasetReader]:
    """A rasterio dataset of a TIFF, JPEG or PNG for reading; rows of a south-up map are reversed, as is its transform.

    Raises UnreadableFileError, naming the file, where it is neither or GDAL cannot read it.
    """
    driver = _driver_of(path)
    try:
        with without_warnings(), rasterio.Env(**GDAL_ENVIRONMENT), rasterio.open(path, driver=driver) as dataset:
            if not _is_south_up(dataset):
                yield dataset
                return
            with WarpedVRT(
                dataset, transform=dataset.transform * Affine(1, 0, 0, 0, -1, dataset.height),
                width=dataset.width, height=dataset.height, resampling=Resampling.nearest,
            ) as north_up:  # fmt: skip
                yield north_up
    except UnicodeEncodeError:
        raise UnreadableFileError(f"{path}: its name is not in this system's letters; set LC_ALL=C.UTF-8") from None
    except Exception as error:
        # rasterio raises some of GDAL's errors as classes that are not public.
        if not isinstance(error, UnicodeDecodeError) and not type(error).__module__.startswith("rasterio."):
            raise
        text = why(error).replace(str(path), "").strip(" :'")
        raise UnreadableFileError(f"{path}: cannot be read ({text}); copy it from the card again") from None


def _is_south_up(dataset: rasterio.DatasetReader) -> bool:
    """True where rows run the other way than in images: a mirror image, which no homography between images is."""
    transform = dataset.transform
    return dataset.crs is not None and not transform.is_identity and transform.determinant > 0


def why(error: BaseException) -> str:
    """The first line of GDAL's message, which is the innermost cause; rasterio's own message is generic."""
    while error.__cause__ is not None:
        error = error.__cause__
    return next(iter(str(error).splitlines()), type(error).__name__)


def _driver_of(path: Path) -> str:
    """The GDAL driver of a file by its first bytes. Raises UnreadableFileError where the path is not a file, cannot be
    read, or is not a TIFF, JPEG or PNG.
    """
    try:
        # Opening something else, such as a pipe, would wait forever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise UnreadableFileError(f"{path}: is not a regular file; remove it from the folder")
        with path.open("rb") as file:
            head = file.read(4)
    except FileNotFoundError:
        raise UnreadableFileError(f"{path}: does not exist") from None
    except (OSError, ValueError) as error:
        text = getattr(error, "strerror", None) or error
        raise UnreadableFileError(f"{path}: cannot be read ({text}); copy it from the card again") from None
    for magic, driver in _DRIVERS.items():
        if head.startswith(magic):
            return driver
    what = "is empty" if not head else "is not a TIFF, JPEG or PNG"
    raise UnreadableFileError(f"{path}: {what}; copy it from the card again")


def probe(path: Path, max_pixels: int = MAX_PIXELS) -> RasterInfo:
    """What a raster file holds, without reading its pixels. Raises UnreadableFileError, also where it declares more
    than `max_pixels` per band.
    """
    try:
        return _probe(path, max_pixels)
    except UnreadableFileError:
        raise
    except Exception as error:  # a damaged file makes a reader fail in any way
        text = next(iter(str(error).splitlines()), type(error).__name__)
        raise UnreadableFileError(f"{path}: cannot be read ({text}); copy it from the card again") from None


def _probe(path: Path, max_pixels: int) -> RasterInfo:
    with open_raster(path) as dataset:
        width, height, count = dataset.width, dataset.height, dataset.count
        if width * height > max_pixels:
            raise UnreadableFileError(
                f"{path}: declares {width} x {height} pixels, more than the {max_pixels:,} that --max-pixels allows"
            )
        if count > _MAX_BANDS:
            raise UnreadableFileError(f"{path}: declares {count} bands; at most {_MAX_BANDS} can take part")
        wavelengths = tuple(_wavelength_nm(dataset.tags(index)) for index in dataset.indexes)
        alpha = [i for i, c in enumerate(dataset.colorinterp, start=1) if c == ColorInterp.alpha]
        if not all(np.dtype(t).kind in "uif" for t in dataset.dtypes):
            raise UnreadableFileError(f"{path}: holds {dataset.dtypes[0]} pixels; bands must be integers or floats")
        return RasterInfo(
            width, height, tuple(dataset.dtypes), tuple(dataset.nodatavals),
            tuple(dataset.descriptions), wavelengths, alpha[0] if alpha else None, _georeference(dataset),
            MaskFlags.per_dataset in dataset.mask_flag_enums[0],
            tuple(zip(dataset.scales, dataset.offsets, strict=True)), tuple(dataset.overviews(1)),
        )  # fmt: skip


def read_for_alignment(band: Band, longest_side_px: int) -> Raster:
    """A band as float32, averaged down where it is larger than `longest_side_px`, with its learnable pixels.

    Invalid are nodata, masked and saturated pixels and constant fill that runs in from the border.
    """
    reduction = max(1.0, max(band.size_px) / longest_side_px)
    shape = reduced_size_px(band.size_px, reduction)[::-1]
    with open_raster(band.path) as dataset:
        pixels = _reduced(dataset, band, shape) if reduction > 1 else dataset.read(band.band_index)
        valid = data_mask(pixels, band.nodata) & _dataset_mask(dataset, band.band_index, shape)
    if band.nodata is None:
        valid &= ~undeclared_fill(pixels)
    valid = learnable(valid, pixels, band.saturation_value)
    scale = PixelScale.between(band.size_px, (shape[1], shape[0]))
    result = pixels.astype(np.float32)
    result[~valid] = 0
    return Raster(result, valid, lens.rescaled(band.lens, scale))


def _reduced(dataset: rasterio.DatasetReader, band: Band, shape: tuple[int, int]) -> NDArray[np.generic]:
    """A band averaged down to (height, width)."""
    plain = band.nodata is None and not band.has_mask and np.dtype(band.dtype).kind == "u"
    if plain and band.width_px * band.height_px <= _READ_WHOLE_PX:
        # GDAL's own averaging decodes a photograph many times: seconds per band.
        return np.asarray(cv2.resize(dataset.read(band.band_index), shape[::-1], interpolation=cv2.INTER_AREA))
    return np.asarray(dataset.read(band.band_index, out_shape=shape, resampling=Resampling.average))


def read_window(
    dataset: rasterio.DatasetReader, band: Band, x0: int, y0: int, width: int, height: int
) -> tuple[NDArray[np.generic], Mask]:
    """Pixels of the file's own type and their data mask, both (height, width), of a window inside the image."""
    window = Window(x0, y0, width, height)
    pixels = dataset.read(band.band_index, window=window)
    valid = data_mask(pixels, band.nodata)
    if MaskFlags.per_dataset in dataset.mask_flag_enums[band.band_index - 1]:
        valid = valid & (dataset.read_masks(band.band_index, window=window) > 0)
    return pixels, valid


def read_tile(band: Band, tile: Tile) -> tuple[NDArray[np.generic], Mask]:
    """Pixels of the file's own type and their data mask, both (height, width), of a tile of a band's own pixels.

    Raises UnreadableFileError.
    """
    with open_raster(band.path) as dataset:
        return read_window(dataset, band, tile.x0, tile.y0, tile.width, tile.height)


def read_preview(
    path: Path, index: int, window_px: tuple[int, int, int, int], size_px: tuple[int, int] | None = None
) -> NDArray[np.float32]:
    """A window (x0, y0, width, height) of a band as (height, width) float32, perhaps resized; nodata as nan."""
    x0, y0, width, height = window_px
    reduction = max(1.0, max(width, height) / _PREVIEW_SIDE_PX)
    out = size_px or reduced_size_px((width, height), reduction)
    with open_raster(path) as dataset:
        window = Window(x0, y0, width, height)
        resampling = Resampling.average if out[0] < width else Resampling.bilinear
        pixels = dataset.read(index, window=window, out_shape=(out[1], out[0]), resampling=resampling, boundless=False)
        nodata = dataset.nodata
    values = pixels.astype(np.float32)
    return values if nodata is None else np.where(data_mask(pixels, nodata), values, np.float32(np.nan))


def gdal_version() -> str:
    """Of the GDAL that rasterio brings."""
    return str(rasterio.__gdal_version__)


def crs_code(crs_wkt: str) -> str | None:
    """Authority and number of a coordinate reference system, such as EPSG:32613; None where it has none."""
    authority = rasterio.CRS.from_wkt(crs_wkt).to_authority()
    return None if authority is None else ":".join(authority)


def crs_wkt(code: str) -> str:
    """WKT of a coordinate reference system such as EPSG:32613."""
    return str(rasterio.CRS.from_user_input(code).to_wkt())


def transformed(points: NDArray[np.float64], from_crs: str, to_crs: str) -> NDArray[np.float64]:
    """(n, 2) map positions, x or longitude first, in another coordinate reference system (WKT or EPSG:number).

    Raises GeometryError where GDAL cannot transform them.
    """
    try:
        x, y = warp.transform(
            rasterio.CRS.from_user_input(from_crs), rasterio.CRS.from_user_input(to_crs), points[:, 0], points[:, 1]
        )
    except Exception as error:  # GDAL's own errors have no public class
        raise GeometryError(f"coordinates cannot be transformed ({error})") from None
    return np.stack([x, y], axis=-1)


def _dataset_mask(dataset: rasterio.DatasetReader, index: int, shape: tuple[int, int]) -> Mask:
    if MaskFlags.per_dataset not in dataset.mask_flag_enums[index - 1]:
        return np.ones(shape, dtype=bool)
    mask = dataset.read_masks(index, out_shape=shape, resampling=Resampling.nearest)
    return np.asarray(mask > 0)


def _georeference(dataset: rasterio.DatasetReader) -> Georeference | None:
    """None also where the transform is the identity, which files without a georeference have, or is singular."""
    if dataset.crs is None or dataset.transform.is_identity:
        return None
    transform = np.array(dataset.transform, float).reshape(3, 3)
    if not np.isfinite(transform).all() or np.linalg.det(transform[:2, :2]) == 0:
        return None
    return Georeference(transform, dataset.crs.to_wkt())


def _wavelength_nm(tags: dict[str, str]) -> float | None:
    """A band's wavelength from the tag names in use: ENVI's, GDAL's imagery domain, and ours."""
    for name in ("wavelength", "WAVELENGTH", "CENTRAL_WAVELENGTH_NM", "central_wavelength_nm"):
        try:
            value = float(tags[name])
        except (KeyError, ValueError):
            continue
        if not 0 < value < math.inf:
            continue
        micrometres = value < _MAX_MICROMETRES or "micro" in tags.get("wavelength_units", "").lower()
        return value * 1000 if micrometres else value
    return None
