"""Reads bands of aligned captures in their units, and compares what the captures of a run contain."""

from collections import defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.errors import RasterioError
from rasterio.windows import Window

from agalign.errors import InputError, UnreadableFileError
from agalign.host.text import shortened
from agalign.pixels.gdal import innermost_cause
from agalign.pixels.raster import OpenRaster, open_raster
from agalign.records.captures import AlignedBand, LeftOut, RunCapture, differing_from_most
from agalign.records.listed_files import ListedFiles
from agalign.values.choices import UNUSABLE_QUALITY
from agalign.values.image import FloatImage, Tile, reduced_size_px
from agalign.values.radiometry import MAX_REFLECTANCE, are_raw_numbers
from agalign.values.spectrum import with_wavelength

RAW = "raw numbers"
"""Unit of bands that are neither reflectance nor radiance."""
UNSTATED = "unstated, in the range of reflectance"
"""Unit of bands that may be reflectance or radiance: no tag states it."""
_SAMPLE_PX = 512
"""Longer side of the reduced band from which the unit is inferred if no tag states it."""


class BandReader(ExitStack):
    """Reads bands; compares each file with its sidecar, if it is `listed` there, opens it once, and closes all of them
    at the end of the `with` block.
    """

    def __init__(self, listed: ListedFiles | None = None) -> None:
        super().__init__()
        self.listed = listed or ListedFiles()
        self._files: dict[Path, OpenRaster] = {}

    def file(self, path: Path, index: int) -> OpenRaster:
        """Return the open file.

        Raises InputError if it is not as it was written, cannot be read, or has no band `index`, counted from 1.
        """
        if path not in self._files:
            self.listed.check(path)
            try:
                self._files[path] = self.enter_context(open_raster(path))
            except UnreadableFileError as error:  # whose remedy is that of an image of the camera
                raise InputError(f"{error.reason.what}; delete it and run again") from None
        if index > self._files[path].count:
            raise InputError(f"{path}: has no band {index}, as its sidecar says; run again")
        return self._files[path]

    def quantity(self, band: AlignedBand) -> str:
        """Return the quantity of a band's numbers by the tags of its file; empty without any. Raises InputError."""
        source = self.file(band.file, band.band_index)
        return shortened(source.tags(band.band_index).get("QUANTITY") or source.tags().get("RADIOMETRY") or "")

    def units(self, band: AlignedBand) -> list[str]:
        """Return the units of a band's numbers: one, unless the tag of a stack lists several.

        Without radiometry tags, it is RAW or UNSTATED. Raises InputError.
        """
        source = self.file(band.file, band.band_index)
        if quantity := self.quantity(band):
            return quantity.split(" and ")
        if are_raw_numbers(source.dtypes[band.band_index - 1], source.scales[band.band_index - 1]):
            return [RAW]
        size_px = source.width, source.height
        sample_px = reduced_size_px(size_px, max(1.0, max(size_px) / _SAMPLE_PX))
        values = _scaled(source, band.band_index, Window(0, 0, *size_px), sample_px[::-1])
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
        return [UNSTATED] if low >= -MAX_REFLECTANCE and high <= MAX_REFLECTANCE else [RAW]

    def values(self, band: AlignedBand, tile: Tile) -> FloatImage:
        """Return (height, width) of a tile, scaled as the file states; nan where nodata or flagged as unusable.

        Raises InputError.
        """
        window = Window(tile.x0, tile.y0, tile.width, tile.height)
        result = _scaled(self.file(band.file, band.band_index), band.band_index, window)
        if band.quality is not None:
            path, layer, _ = band.quality
            flags = _read(self.file(path, layer), layer, window).data.astype(np.uint16)
            result[flags & np.uint16(UNUSABLE_QUALITY.value) != 0] = np.nan
        return result


def _scaled(source: OpenRaster, index: int, window: Window, shape: tuple[int, int] | None = None) -> FloatImage:
    """A window in the unit of the file's scale and offset, nan for nodata, resampled to `shape` (height, width)."""
    scale, offset = source.scales[index - 1], source.offsets[index - 1]
    pixels = _read(source, index, window, shape).astype(np.float32)
    if scale != 1.0 or offset != 0.0:
        pixels = pixels * np.float32(scale) + np.float32(offset)
    return np.asarray(pixels.filled(np.nan))


def _read(source: OpenRaster, index: int, window: Window, shape: tuple[int, int] | None = None) -> Any:
    """The pixels of a window as a masked array: nodata is masked. Raises InputError."""
    try:
        return source.read(index, window=window, out_shape=shape, masked=True)
    except RasterioError as error:
        raise InputError(f"{source.name}: cannot be read ({innermost_cause(error)}); run again") from None


def contents_of(capture: RunCapture) -> tuple[str, str]:
    """Return what the files of a capture contain, in words: (bands with pixels, quantities). Raises InputError."""
    pairs = zip(capture.bands, capture.result.bands, strict=True)
    bands = [band for band, part in pairs if part.place is not None]
    names: dict[str, list[str]] = defaultdict(list)
    with BandReader(capture.listed) as reader:
        for band in bands:
            names[reader.quantity(band) or RAW].append(band.name)
    quantities = [q if len(names) == 1 else f"{q} in {', '.join(names[q])}" for q in names]
    named = [with_wavelength(band.name, band.wavelength_nm) for band in bands]
    return f"bands {', '.join(named)}", " and ".join(quantities)


def like_most(captures: Sequence[RunCapture]) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures with the same contents as most of them, and the others, or those that cannot be read."""
    contents: dict[str, tuple[str, ...]] = {}
    left_out = []
    for capture in captures:
        try:
            contents[capture.label] = contents_of(capture)
        except InputError as error:
            left_out.append((capture.label, str(error)))
    left_out += differing_from_most(contents)
    labels = {label for label, _ in left_out}
    return [c for c in captures if c.label not in labels], left_out
