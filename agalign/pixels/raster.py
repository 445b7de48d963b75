"""Reading of rasters: metadata, pixels at any resolution, and validity masks."""

import math
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from agalign.errors import UnreadableFileError
from agalign.host.held_sizes import MAX_DECODED_PX
from agalign.host.text import name_problem
from agalign.pixels.coordinates import ensure_proj_data
from agalign.pixels.gdal import gdal_name, innermost_cause, is_gdal_error, open_local
from agalign.pixels.masks import data_mask, learnable, missing_end, undeclared_fill, without_parts
from agalign.values import lens
from agalign.values.capture import Band, Capture, Georeference
from agalign.values.choices import MAX_PIXELS
from agalign.values.image import Mask, Raster, Tile, reduced_size_px
from agalign.values.pixel_units import PixelScale
from agalign.values.spectrum import is_spectral

_MAXIMA = {"uint8": 255.0, "uint16": 65535.0, "int16": 32767.0}
"""Of the types that sensors deliver."""
_MAX_BANDS = 512
"""More than any imager has; a damaged file may declare 65,535."""
_COPY_AGAIN, _CONVERT = "copy it from the card again", "convert it to TIFF (gdal_translate)"
"""Remedies."""


Format = Literal["TIFF", "JPEG", "PNG", "JPEG 2000"]
_FORMATS: dict[str, Format] = {".tif": "TIFF", ".tiff": "TIFF", ".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}
"""JPEG and PNG are photographs, or bands exported by other software, mostly in 8 bits."""
_REFUSED: dict[str, Format] = {".jp2": "JPEG 2000", ".j2k": "JPEG 2000"}
_STARTS = {"GTiff": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "JPEG": (b"\xff\xd8\xff",), "PNG": (b"\x89PNG",)}
"""First bytes of a file, by the GDAL driver that reads it. Some of GDAL's other drivers execute code or contact
servers."""
*_suffixes, _last_suffix = _FORMATS
IMAGE_KINDS = f"{', '.join(_suffixes)} or {_last_suffix}"
"""The files that are read, in words."""


def suffix_format(path: Path) -> Format | None:
    """Return the format of a file by its suffix, also if it is refused; None for other files."""
    return (_FORMATS | _REFUSED).get(path.suffix.lower())


ReadTile = Callable[[Band, Tile], tuple[NDArray[np.generic], Mask]]
"""Reads a tile inside a band, as `read_tile`; the arrays must not be changed."""
OpenRaster = rasterio.DatasetReader
"""A file that `open_raster` has opened."""


@contextmanager
def open_raster(path: Path, page: int = 0) -> Iterator[rasterio.DatasetReader]:
    """Open a TIFF, JPEG or PNG, or a page of a TIFF (from 1), for reading; south-up maps are flipped to north-up.

    Raises UnreadableFileError for other files and those that GDAL cannot read, and ConfigurationError without the data
    of PROJ.
    """
    ensure_proj_data()
    driver = _driver_of(path)
    try:
        with open_local(path, page=page, driver=driver) as dataset:
            if not _is_south_up(dataset):
                yield dataset
                return
            flipped = dataset.transform * Affine(1, 0, 0, 0, -1, dataset.height)
            with WarpedVRT(dataset, transform=flipped, width=dataset.width, height=dataset.height) as north_up:
                yield north_up
    except UnicodeEncodeError:
        raise UnreadableFileError(name_problem(path)) from None
    except Exception as error:
        if not isinstance(error, UnicodeDecodeError) and not is_gdal_error(error):
            raise
        text = innermost_cause(error).replace(gdal_name(path), "").strip(" :'")
        raise UnreadableFileError(f"{path}: cannot be read ({text})", _COPY_AGAIN) from None


def _is_south_up(dataset: rasterio.DatasetReader) -> bool:
    """Return True if rows of a map run from south to north: a mirror image, which cannot be aligned as it is."""
    transform = dataset.transform
    return dataset.crs is not None and not transform.is_identity and transform.determinant > 0


def _driver_of(path: Path) -> str:
    """Return the GDAL driver of a file from its first bytes.

    Raises UnreadableFileError if it is not a regular file, cannot be read, or is not a TIFF, JPEG or PNG.
    """
    try:
        # Opening a pipe would block.
        if not stat.S_ISREG(path.stat().st_mode):
            raise UnreadableFileError(f"{path}: is not a regular file", "remove it from the folder")
        with path.open("rb") as file:
            magic = file.read(4)
    except FileNotFoundError:
        raise UnreadableFileError(f"{path}: does not exist") from None
    except (OSError, ValueError) as error:
        text = getattr(error, "strerror", None) or error
        raise UnreadableFileError(f"{path}: cannot be read ({text})", _COPY_AGAIN) from None
    for driver, starts in _STARTS.items():
        if magic.startswith(starts):
            return driver
    if refused := _REFUSED.get(path.suffix.lower()):
        raise UnreadableFileError(f"{path}: {refused} is not supported", _CONVERT)
    problem = "is empty" if not magic else "is not a TIFF, JPEG or PNG"
    raise UnreadableFileError(f"{path}: {problem}", _COPY_AGAIN)


def probe(path: Path, max_pixels: int = MAX_PIXELS, page: int = 0) -> tuple[Band, ...]:
    """Read the metadata of a raster file, or of a page of a TIFF (from 1): its bands, without an alpha band.

    They have the names in the file or empty ones. Equal channels of a TIFF are one band.
    Raises UnreadableFileError, also for more than `max_pixels` per band.
    """
    try:
        with open_raster(path, page) as dataset:
            return tuple(replace(band, page=page) for band in _bands(path, dataset, max_pixels))
    except UnreadableFileError:
        raise
    except Exception as error:  # damaged files raise errors of many classes
        what = f"cannot be read ({innermost_cause(error)})"
        raise UnreadableFileError(f"{path}: {what}", _COPY_AGAIN) from None


def _bands(path: Path, dataset: rasterio.DatasetReader, max_pixels: int) -> tuple[Band, ...]:
    width, height, count = dataset.width, dataset.height, dataset.count
    if width * height > max_pixels:
        what = f"declares {width} x {height} pixels, more than the {max_pixels:,} that --max-pixels allows"
        raise UnreadableFileError(f"{path}: {what}")
    if dataset.driver == "PNG" and width * height > MAX_DECODED_PX:
        what = f"declares {width} x {height} pixels, and a PNG of more than {MAX_DECODED_PX:,} is not decoded"
        raise UnreadableFileError(f"{path}: {what}", _CONVERT)
    if count > _MAX_BANDS:
        raise UnreadableFileError(f"{path}: declares {count} bands", f"at most {_MAX_BANDS} can take part")
    if not all(np.dtype(t).kind in "uif" for t in dataset.dtypes):
        raise UnreadableFileError(f"{path}: holds {dataset.dtypes[0]} pixels", "bands must be integers or floats")
    if dataset.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES":
        remedy = "export it with 0 as black (photometric interpretation MinIsBlack)"
        raise UnreadableFileError(f"{path}: is stored inverted (photometric interpretation MinIsWhite)", remedy)
    alpha = _alpha_index(dataset)
    indices = [i for i in dataset.indexes if i != alpha]
    colours = [dataset.colorinterp[i - 1].name.capitalize() for i in indices]
    is_colour = sorted(colours) == ["Blue", "Green", "Red"]
    if is_colour and suffix_format(path) == "TIFF" and _is_grey(dataset, indices):
        indices, is_colour = indices[:1], False
    has_mask = alpha is not None or _has_mask(dataset, 1)
    georeference, overviews = _georeference(dataset), tuple(dataset.overviews(1))
    return tuple(
        Band(
            name=dataset.descriptions[i - 1] or "",
            colour=colour if is_colour else "",
            path=path,
            band_index=i,
            width_px=width,
            height_px=height,
            dtype=dataset.dtypes[i - 1],
            nodata=dataset.nodatavals[i - 1],
            has_mask=has_mask,
            wavelength_nm=_wavelength_nm(dataset, i),
            saturation_value=_full_scale(dataset, i),
            georeference=georeference,
            scale_offset=(dataset.scales[i - 1], dataset.offsets[i - 1]),
            overviews=overviews,
        )
        for i, colour in zip(indices, colours, strict=False)
    )


def _is_grey(dataset: rasterio.DatasetReader, indices: Sequence[int]) -> bool:
    """Return True if all channels of an image are equal in some rows, and these are not constant."""
    rows = [
        dataset.read(indices, window=Window(0, (k * dataset.height) // 6, min(dataset.width, 2048), 1))
        for k in range(1, 6)
    ]
    return all((row == row[0]).all() for row in rows) and max(np.ptp(row[0]) for row in rows) > 0


def _full_scale(dataset: rasterio.DatasetReader, index: int) -> float | None:
    """Return the largest number with the bits of a band, 12 in 16 for example; None for types of no sensor."""
    bits = dataset.tags(index, ns="IMAGE_STRUCTURE").get("NBITS", "")
    maximum = _MAXIMA.get(dataset.dtypes[index - 1])
    return 2.0 ** int(bits) - 1 if maximum and bits.isdecimal() else maximum


def with_facts_of_pixels(capture: Capture, read: ReadTile) -> Capture:
    """Return the capture with what its pixels show: the parts that its files lack, and the saturation values.

    Bands that cannot be read are unchanged. `read` reads the pixels of the files.
    """
    bands_of = Counter((b.path, b.page) for b in capture.bands)
    bands = []
    for band in capture.bands:
        known, is_single = band, bands_of[band.path, band.page] == band.index_in_page == 1
        with suppress(UnreadableFileError):
            known = replace(band, missing=_missing_parts(band, read) if is_single else ())
            known = replace(known, saturation_value=_saturation_value(known, read))
        bands.append(known)
    return replace(capture, bands=tuple(bands))


def _saturation_value(band: Band, read: ReadTile) -> float | None:
    """The saturation value of a band: many cameras store 10 or 12 bits in 16. That by its tags or of 8 bits is known.

    Raises UnreadableFileError.
    """
    if band.saturation_value not in (_MAXIMA["uint16"], _MAXIMA["int16"]):
        return band.saturation_value
    side_px = 2048  # of the middle of the image, which limits the memory
    width, height = (min(side_px, n) for n in band.size_px)
    pixels, valid = read(band, Tile((band.width_px - width) // 2, (band.height_px - height) // 2, width, height))
    values = pixels[valid]
    top = values.max(initial=0)
    at_top = np.count_nonzero(values == top)
    _, below = np.unique(values[(values > 0.9 * top) & (values < top)], return_counts=True)
    # Bright objects have many values; those of a saturated sensor are equal.
    min_share, min_ratio = 0.002, 10
    is_saturated = top > 0 and at_top >= max(min_share * values.size, min_ratio * (below.mean() if below.size else 0))
    return float(top) if is_saturated and at_top < values.size else band.saturation_value


def _missing_parts(band: Band, read: ReadTile) -> tuple[Tile, ...]:
    """The parts that the file of a single band lacks at its end (`masks.missing_end`).

    Maps and floating-point images, which programs fill at their borders, and files with a mask or a nodata value lack
    none. Raises UnreadableFileError.
    """
    is_raw = band.nodata is None and not band.has_mask and band.georeference is None
    if not is_raw or np.dtype(band.dtype).kind not in "ui":
        return ()
    corner_px = min(16, band.width_px)  # rows of images have several values
    last, _ = read(band, Tile(band.width_px - corner_px, band.height_px - 1, corner_px, 1))
    if (last != last[0, 0]).any():
        return ()
    pixels, _ = read(band, Tile(0, 0, *band.size_px))
    with open_raster(band.path, band.page) as dataset:
        block_height, block_width = dataset.block_shapes[band.index_in_page - 1]
    return tuple(missing_end(pixels, (block_width, block_height), band.saturation_value))


def value_step(band: Band) -> int:
    """Return the greatest common divisor of all pixels of a band, such as 16 if 12 bits are stored as the upper bits of
    16, of a band of integers. Raises UnreadableFileError.
    """
    pixels, valid = read_tile(band, Tile(0, 0, *band.size_px))
    return max(1, int(np.gcd.reduce(np.unique(pixels[valid]).astype(np.int64), initial=0)))


def read_for_alignment(band: Band, longest_side_px: int, read: ReadTile | None = None) -> Raster:
    """Read a band as float32, reduced by averaging to at most `longest_side_px`, and its mask.

    Nodata, masked and saturated pixels and constant areas at the border are invalid. `read` reads the pixels of a file
    that GDAL does not reduce, by default `read_tile`. Raises UnreadableFileError.
    """
    reduction = max(1.0, max(band.size_px) / longest_side_px)
    shape = reduced_size_px(band.size_px, reduction)[::-1]
    # OpenCV resizes no integers of 32 or 64 bits.
    all_valid = band.nodata is None and not band.has_mask and band.dtype in ("uint8", "uint16")
    if reduction == 1 or (all_valid and band.width_px * band.height_px <= MAX_DECODED_PX):
        pixels, mask = (read or read_tile)(band, Tile(0, 0, *band.size_px))
        valid = mask.copy()
        if reduction > 1:  # GDAL's averaging decodes a JPEG repeatedly, which takes seconds per band
            pixels, valid = cv2.resize(pixels, shape[::-1], interpolation=cv2.INTER_AREA), np.ones(shape, bool)
    else:
        with open_raster(band.path, band.page) as dataset:
            pixels = dataset.read(band.index_in_page, out_shape=shape, resampling=Resampling.average)
            valid = data_mask(pixels, band.nodata)
            valid &= _dataset_mask(dataset, band.index_in_page, out_shape=shape, resampling=Resampling.nearest)
    if band.nodata is None:
        valid &= ~undeclared_fill(pixels)
    valid = without_parts(valid, band.missing, Tile(0, 0, *band.size_px))
    valid = learnable(valid, pixels, band.saturation_value)
    scale = PixelScale.between(band.size_px, (shape[1], shape[0]))
    result = pixels.astype(np.float32)
    result[~valid] = 0
    return Raster(result, valid, lens.rescaled(band.lens, scale))


def read_tile(
    band: Band, tile: Tile, dataset: rasterio.DatasetReader | None = None
) -> tuple[NDArray[np.generic], Mask]:
    """Read a tile inside a band: pixels in the type of the file and their mask, each (height, width).

    `dataset` is the open file, if it is open. Raises UnreadableFileError.
    """
    if dataset is None:
        with open_raster(band.path, band.page) as opened:
            return read_tile(band, tile, opened)
    window = Window(tile.x0, tile.y0, tile.width, tile.height)
    pixels = dataset.read(band.index_in_page, window=window)
    valid = data_mask(pixels, band.nodata) & _dataset_mask(dataset, band.index_in_page, window=window)
    return pixels, without_parts(valid, band.missing, tile)


def read_preview(
    path: Path, index: int, window_px: tuple[int, int, int, int], size_px: tuple[int, int], page: int = 0
) -> NDArray[np.float32]:
    """Read a window (x0, y0, width, height) of a band, of a page, as (height, width) float32 with NaN for nodata.

    It is resampled to `size_px` (width, height). Raises UnreadableFileError.
    """
    x0, y0, width, height = window_px
    resampling = Resampling.average if size_px[0] < width else Resampling.bilinear
    with open_raster(path, page) as dataset:
        window = Window(x0, y0, width, height)
        pixels = dataset.read(index, window=window, out_shape=size_px[::-1], resampling=resampling)
        nodata = dataset.nodata
    return with_nan(pixels, nodata)


def with_nan(pixels: NDArray[np.generic], nodata: float | None) -> NDArray[np.float32]:
    """Return pixels (height, width) as float32 with NaN for nodata."""
    values = pixels.astype(np.float32)
    return values if nodata is None else np.where(data_mask(pixels, nodata), values, np.float32(np.nan))


def _dataset_mask(dataset: rasterio.DatasetReader, index: int, **reading: Any) -> Mask | np.bool_:
    """Return the mask of a file, read with these options of `read_masks`; True for a file without a mask."""
    if _has_mask(dataset, index):
        return np.asarray(dataset.read_masks(index, **reading) > 0)
    # GDAL reports the alpha band as a mask only for files of 2 or 4 bands.
    alpha = _alpha_index(dataset)
    return np.True_ if alpha is None else np.asarray(dataset.read(alpha, **reading) > 0)


def _has_mask(dataset: rasterio.DatasetReader, index: int) -> bool:
    """Return True for a mask of the file, which is not an alpha band."""
    flags = dataset.mask_flag_enums[index - 1]
    return MaskFlags.per_dataset in flags and MaskFlags.alpha not in flags


def _alpha_index(dataset: rasterio.DatasetReader) -> int | None:
    """Return the index of the alpha band of a file of several bands, from 1; None without one.

    Programs mark the fourth band of an image as alpha also if it is a spectral one.
    """
    colours = dataset.colorinterp
    if len(colours) < 2 or ColorInterp.alpha not in colours:
        return None
    index = colours.index(ColorInterp.alpha) + 1
    return None if is_spectral(dataset.descriptions[index - 1] or "", _wavelength_nm(dataset, index)) else index


def _georeference(dataset: rasterio.DatasetReader) -> Georeference | None:
    """Return the georeference; None without one and for an identity or singular transform."""
    if dataset.crs is None or dataset.transform.is_identity:
        return None
    transform = np.array(dataset.transform, float).reshape(3, 3)
    if not np.isfinite(transform).all() or np.linalg.det(transform[:2, :2]) == 0:
        return None
    return Georeference(transform, dataset.crs.to_wkt())


def _wavelength_nm(dataset: rasterio.DatasetReader, index: int) -> float | None:
    """Return the wavelength of a band, from 1, from the tags of ENVI, GDAL's IMAGERY domain or agalign."""
    tags = dataset.tags(index) | dataset.tags(index, ns="IMAGERY")
    # Wavelengths without a unit are in micrometres below this: thermal bands end at 14 um, and none is below 100
    # nm.
    max_micrometres = 20.0
    names = "wavelength", "WAVELENGTH", "CENTRAL_WAVELENGTH_NM", "central_wavelength_nm", "CENTRAL_WAVELENGTH_UM"
    for name in names:
        try:
            value = float(tags[name])
        except (KeyError, ValueError):
            continue
        if not 0 < value < math.inf:
            continue
        micrometres = value < max_micrometres or "micro" in tags.get("wavelength_units", "").lower()
        return value * 1000 if micrometres else value
    return None
