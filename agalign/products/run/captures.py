"""The captures of a run, for products of several captures: their bands, with files, units and values, and the captures
that differ from most.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.errors import RasterioError
from rasterio.windows import Window

from agalign.errors import InputError, SidecarError
from agalign.pixels.raster import OpenRaster, innermost_cause, open_raster
from agalign.products.run.record import counted_sidecars
from agalign.products.sidecar.file import label_of, read_without_tables, run_sidecars
from agalign.products.sidecar.schema import Sidecar
from agalign.values.choices import UNUSABLE_QUALITY
from agalign.values.image import FloatImage, Tile, reduced_size_px
from agalign.values.text import shortened

RAW = "raw numbers"
"""Unit of bands that are neither reflectance nor radiance."""
_MAX_REFLECTANCE = 2.0
"""Sun glint and specular leaves exceed 1; raw numbers of any sensor exceed this."""
_SAMPLE_PX = 512
"""Longer side of the reduced band from which the unit is inferred if no tag states it."""
LeftOut = list[tuple[str, str]]
"""(label of a capture, reason why it is left out)."""


@dataclass(frozen=True)
class AlignedBand:
    """An aligned band: the file and index of its pixels, or the reason why it cannot be used."""

    name: str
    wavelength_nm: float | None
    file: Path
    band_index: int
    sha256: str = ""
    """Checksum of the file, if it is known."""
    problem: str = ""
    quality: tuple[Path, int, str] | None = None
    """Quality raster whose flagged pixels become nan: file, index of the band's layer, checksum of the file."""


def bands_of(sidecar: Sidecar, folder: Path, *, mask_qa: bool = False) -> list[AlignedBand]:
    """Return the bands of a capture, given the folder of its sidecar; with `mask_qa` with their quality flags.

    Raises InputError with `mask_qa` if the run wrote no quality raster.
    """
    flags = next((part for part in sidecar.products if part.kind == "qa"), None)
    if mask_qa and flags is None:
        raise InputError(f"{sidecar.capture}: has no quality raster, which --mask-qa needs; align with --qa")
    checksums = {part.file: part.sha256 for part in sidecar.products}
    result, names = [], [part.band for part in sidecar.bands]
    if sidecar.output is not None:
        names = sidecar.output.bands or names
    layers = {name: number for number, name in enumerate(names, start=2)}  # layer 1 is that of all bands together
    for part in sidecar.bands:
        file, index = ("", 1) if part.place is None else (part.place.file, part.place.band_index)
        quality = (folder / flags.file, layers[part.band], flags.sha256) if mask_qa and flags is not None else None
        checksum = checksums.get(file, "")
        problem = ""
        if part.place is None and part.is_usable(sidecar.max_predicted_px):
            problem = f"the pixels of {part.band} were not written; run again"
        elif part.place is None or not part.is_usable(sidecar.max_predicted_px):
            limit_px, prediction = sidecar.max_predicted_px, part.prediction
            error = "" if prediction is None else f" to {prediction.std_px:.1f} px, not {limit_px:g}"
            problem = f"{part.band} is {part.status}{error} ({part.reason})"
        result.append(AlignedBand(part.band, part.wavelength_nm, folder / file, index, checksum, problem, quality))
    return result


class BandReader(ExitStack):
    """Reads bands; opens each file once, and closes all of them at the end of the `with` block."""

    def __init__(self) -> None:
        super().__init__()
        self._files: dict[Path, OpenRaster] = {}

    def file(self, path: Path, index: int) -> OpenRaster:
        """Return the open file. Raises InputError if it cannot be read or has no band `index`, counted from 1."""
        if path not in self._files:
            try:
                self._files[path] = self.enter_context(open_raster(path))
            except InputError as error:  # whose remedy is that of an image of the camera
                raise InputError(f"{str(error).partition(';')[0]}; delete it and run again") from None
        if index > self._files[path].count:
            raise InputError(f"{path}: has no band {index}, as its sidecar says; run again")
        return self._files[path]

    def quantity(self, band: AlignedBand) -> str:
        """Return the quantity of a band's numbers by the tags of its file; empty without any. Raises InputError."""
        source = self.file(band.file, band.band_index)
        return shortened(source.tags(band.band_index).get("QUANTITY") or source.tags().get("RADIOMETRY") or "")

    def units(self, band: AlignedBand) -> list[str]:
        """Return the units of a band's numbers: one, unless the tag of a stack lists several.

        Without radiometry tags, numbers that the file's scale brings into the range of reflectance are reflectance.
        Raises InputError.
        """
        source = self.file(band.file, band.band_index)
        if quantity := self.quantity(band):
            return quantity.split(" and ")
        is_integer = np.dtype(source.dtypes[band.band_index - 1]).kind in "ui"
        if is_integer and source.scales[band.band_index - 1] == 1.0:
            return [RAW]
        size_px = source.width, source.height
        sample_px = reduced_size_px(size_px, max(1.0, max(size_px) / _SAMPLE_PX))
        values = _scaled(source, band.band_index, Window(0, 0, *size_px), sample_px[::-1])
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
        return ["reflectance"] if low >= -_MAX_REFLECTANCE and high <= _MAX_REFLECTANCE else [RAW]

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


@dataclass(frozen=True)
class RunCapture:
    """A capture of a run."""

    label: str
    """Its name below the output folder of the run."""
    path: Path
    """Path of the sidecar."""
    result: Sidecar
    """The sidecar without its long tables: all of them, of a long flight, would not fit in memory."""

    @cached_property
    def bands(self) -> list[AlignedBand]:
        """The bands in the order of the sidecar."""
        return bands_of(self.result, self.path.parent)

    def contents(self) -> tuple[str, str]:
        """Return what the files contain, in words: (bands with pixels, their quantities). Raises InputError."""
        pairs = zip(self.bands, self.result.bands, strict=True)
        bands = [band for band, part in pairs if part.place is not None]
        names: dict[str, list[str]] = defaultdict(list)
        with BandReader() as reader:
            for band in bands:
                names[reader.quantity(band) or RAW].append(band.name)
        quantities = [q if len(names) == 1 else f"{q} in {', '.join(names[q])}" for q in names]
        return f"bands {', '.join(_named(band) for band in bands)}", " and ".join(quantities)


def _named(band: AlignedBand) -> str:
    return band.name if band.wavelength_nm is None else f"{band.name} ({band.wavelength_nm:g} nm)"


def captures_of_run(out: Path) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures of a run in the order of their labels, and those with an unreadable sidecar.

    Raises InputError if `out` has no sidecars.
    """
    captures, left_out = [], []
    for path in counted_sidecars(run_sidecars(out), out):
        label = label_of(path, out)
        try:
            captures.append(RunCapture(label, path, read_without_tables(path)))
        except SidecarError as error:
            left_out.append((label, str(error)))
    return captures, left_out


def like_most(captures: Sequence[RunCapture]) -> tuple[list[RunCapture], LeftOut]:
    """Return the captures with the same contents as most of them, and the others, or those that cannot be read."""
    contents: dict[str, tuple[str, ...]] = {}
    left_out = []
    for capture in captures:
        try:
            contents[capture.label] = capture.contents()
        except InputError as error:
            left_out.append((capture.label, str(error)))
    left_out += exceptions(contents)
    labels = {label for label, _ in left_out}
    return [c for c in captures if c.label not in labels], left_out


def exceptions(facts: Mapping[str, tuple[str, ...]]) -> LeftOut:
    """Return the captures that differ from most, given the facts about each by label, and how they differ."""
    usual, count = max(Counter(facts.values()).items(), key=lambda item: item[1], default=((), 0))
    most = f"{count} of {len(facts)} captures have"
    pairs = {label: zip(own, usual, strict=True) for label, own in facts.items() if own != usual}
    return [(k, next(f"it has {a}, and {most} {b}" for a, b in pair if a != b)) for k, pair in pairs.items()]
