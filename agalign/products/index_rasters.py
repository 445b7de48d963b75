"""Spectral indices of a capture: a float32 raster and a picture of each, with their statistics; as the product of
`agalign align --index`, and for `agalign indices`.
"""

import glob
import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign._version import __version__
from agalign.config import WriteSettings
from agalign.errors import AgalignError, ConfigurationError, InputError
from agalign.pixels.raster import OpenRaster, open_raster
from agalign.products.checked_raster import (
    FLOAT_OPTIONS,
    WORK_TILE_PX,
    LayerDescription,
    check_complete,
    checked_raster,
    tiled_profile,
)
from agalign.products.drawing import with_text, write_png
from agalign.products.index_bands import RAW, BandReader, IndexBand
from agalign.products.index_table import STATISTICS_TAG, IndexReport, IndexStatistics, read_statistics, statistics_in
from agalign.products.indices import Index, bands_for, compute, index_named
from agalign.products.product import GEOTIFF, CapturePaths, Product, ProductContext, StacAsset, WrittenFile
from agalign.products.raster_file import to_cog
from agalign.values.capture import Band, Capture
from agalign.values.image import Tile, reduced_size_px
from agalign.values.interpolation import tiles

_COLOURS = np.array([(38, 70, 148), (120, 74, 40), (214, 190, 120), (250, 245, 170), (90, 180, 80), (0, 90, 40)], float)
"""Red, green, blue from the low to the high end of the scale: water, soil, sparse to dense vegetation."""
_NEUTRAL = np.array([(20, 20, 20), (245, 245, 245)], float)
"""Greys for raw numbers, whose values do not distinguish soil and vegetation."""


class IndexRasters(Product):
    """A raster and a picture of each requested index whose bands are aligned."""

    kind = "index"
    is_required = False
    option = "indices"

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return <capture>_<index>.tif and .png."""
        names = [name.strip().lower() for name in settings.indices]
        return [paths.file(f"_{name}{suffix}") for name in names for suffix in (".tif", ".png")]

    def write(self, context: ProductContext) -> Iterator[WrittenFile]:
        """Write the indices of which the capture has all bands, usable.

        Raises InputError if bands are in the wrong unit, OutputError.
        """
        bands = _bands(context)
        indices = [index_named(name) for name in context.write_settings.indices]
        problems = []
        for report in write_rasters(bands, indices, context.paths.file(""), context.capture.label):
            if report.path is not None:
                yield WrittenFile(self.kind, report.path, StacAsset(report.index, GEOTIFF, ("data",)))
                yield WrittenFile(self.kind, report.path.with_suffix(".png"))
            elif all(not b.problem for b in bands) and _has_bands(context.capture.bands, report.index):
                problems.append(report.problem)
        if problems:
            raise InputError("; ".join(problems))


def check_indices(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError for an unknown index, and for an index that no capture has the bands or unit for."""
    for name in settings.indices:
        index = index_named(name)
        suitable = [c for c in captures if _has_bands(c.bands, name)]
        if captures and not suitable:
            names = ", ".join(dict.fromkeys(b.name for c in captures for b in c.bands))
            raise ConfigurationError(
                f"--index {name}: needs bands {', '.join(index.roles)}, and no capture has them all; there are {names}"
            )
        are_integers = all(np.dtype(b.dtype).kind in "ui" for c in suitable for b in c.bands)
        if suitable and settings.radiometry == "off" and are_integers and not index.any_unit:
            raise ConfigurationError(f"--index {name}: needs reflectance; add --radiometry")


def _has_bands(bands: Sequence[Band], name: str) -> bool:
    narrow = [b for b in bands if not b.companion]
    try:
        return bool(bands_for(index_named(name), [b.name for b in narrow], [b.wavelength_nm for b in narrow]))
    except InputError:
        return False


def _bands(context: ProductContext) -> list[IndexBand]:
    places, usable, result = context.places, {context.capture.reference.name, *context.usable}, []
    for band in context.capture.bands:
        if band.name in usable and band.name in places:
            file, index = places[band.name]
            result.append(IndexBand(band.name, band.wavelength_nm, file.path, index, file.sha256))
        else:
            result.append(IndexBand(band.name, band.wavelength_nm, Path(), 1, problem="not usable"))
    return result


def write_rasters(
    bands: Sequence[IndexBand], indices: Sequence[Index], base: Path, label: str, *, overwrite: bool = True
) -> Iterator[IndexReport]:
    """Write `base`_<index>.tif and .png of a capture's bands, each atomically.

    Without `overwrite`, rasters that an earlier command wrote from the same bands with the same formula are kept. If a
    band of an index is missing, not usable or not in the unit that the index needs, the report has the problem.
    Raises OutputError, or InputError for a file that cannot be read.
    """
    with BandReader() as reader:
        for index in indices:
            target = base.with_name(f"{base.name}_{index.name}.tif")
            try:
                chosen = _bands_of_index(bands, index)
                source = _fingerprint(index, chosen)
                earlier = None if overwrite else _finished_before(target, source)
                if earlier is None and target.resolve() in {band.file.resolve() for band in bands}:
                    raise InputError(f"{target}: is the file of a band; give the formula '{index.name}' another name")
                unit = earlier.unit if earlier is not None else _common_unit(index, chosen, reader)
            except InputError as error:
                yield IndexReport(label, index.name, problem=str(error))
                continue
            statistics = earlier or _write(index, chosen, target, unit, source, reader)
            yield IndexReport(label, index.name, target, statistics, kept=earlier is not None)


def outdated_rasters(base: Path) -> Iterator[Path]:
    """Yield the index rasters of a capture, `base`_<index>.tif, and their pictures."""
    for path in base.parent.glob(f"{glob.escape(base.name)}_*.tif"):
        # A file with a sidecar is the stack of another capture.
        if not path.with_suffix(".json").exists() and read_statistics(path) is not None:
            yield from (path, path.with_suffix(".png"))


def _bands_of_index(bands: Sequence[IndexBand], index: Index) -> list[IndexBand]:
    """Return the bands of an index. Raises InputError if one is missing or not usable."""
    chosen = [bands[i] for i in bands_for(index, [b.name for b in bands], [b.wavelength_nm for b in bands])]
    for band in chosen:
        if band.problem:
            raise InputError(f"{index.name} is left out: {band.problem}")
    return chosen


def _fingerprint(index: Index, bands: Sequence[IndexBand]) -> str:
    """Sixteen hexadecimal digits of everything that an index raster depends on."""
    sources = [(b.sha256, b.band_index) for b in bands]
    masks = [(b.quality[2], b.quality[1]) for b in bands if b.quality is not None]
    facts = json.dumps([__version__, index.formula, index.constants, index.span, sources, *([masks] if masks else [])])
    return hashlib.sha256(facts.encode()).hexdigest()[:16]


def _finished_before(target: Path, source: str) -> IndexStatistics | None:
    """The statistics of a complete raster with its picture and this fingerprint; None if there is none."""
    if not target.is_file() or not target.with_suffix(".png").is_file():
        return None
    try:
        check_complete(target)
        with open_raster(target) as dataset:
            tags = dataset.tags()
    except (AgalignError, OSError, tifffile.TiffFileError):
        return None
    return statistics_in(tags) if tags.get("INDEX_MADE_FROM") == source else None


def _common_unit(index: Index, bands: Sequence[IndexBand], reader: BandReader) -> str:
    """Return the unit of the bands of an index.

    Raises InputError if units or sizes differ, also of quality flags, or if the index needs another unit.
    """
    files = [(band.file, band.band_index) for band in bands]
    files += [band.quality[:2] for band in bands if band.quality is not None]
    expected = reader.file(*files[0]).shape
    for path, layer in files:
        if reader.file(path, layer).shape != expected:
            raise InputError(f"{path}: differs in size from {files[0][0].name}; run again")
    units = {unit for band in bands for unit in reader.units(band)}
    if len(units) > 1:
        raise InputError(f"{index.name} is left out: its bands are in different units ({', '.join(sorted(units))})")
    (unit,) = units
    if not index.any_unit and unit != "reflectance":
        raise InputError(f"{index.name} needs reflectance, and the bands are {unit}; align with --radiometry")
    return unit


def _write(
    index: Index, bands: Sequence[IndexBand], target: Path, unit: str, source: str, reader: BandReader
) -> IndexStatistics:
    """Write the raster tile by tile, and its picture. Raises OutputError, InputError for a band."""
    like = reader.file(bands[0].file, bands[0].band_index)
    profile = tiled_profile(like.width, like.height, 1, "float32", **FLOAT_OPTIONS)
    if like.crs is not None and not like.transform.is_identity:
        profile |= {"crs": like.crs, "transform": like.transform}
    # Percentiles of larger rasters are calculated from every second, third … row and column.
    max_statistics_px = 4_000_000
    step = max(1, math.ceil(math.sqrt(like.width * like.height / max_statistics_px)))
    samples, valid_px, masked_px = [], 0, 0
    unmasked = [replace(band, quality=None) for band in bands]
    is_cog = like.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG"
    with checked_raster(target, profile, to_cog if is_cog else None) as raster:
        raster.describe([LayerDescription(index.name)], _tags(index, like, unit, source))
        for tile in tiles(Tile(0, 0, like.width, like.height), WORK_TILE_PX):
            values = compute(index, [reader.values(band, tile) for band in bands])
            raster.write(values, 1, tile.x0, tile.y0)
            valid = np.isfinite(values)
            valid_px += int(np.count_nonzero(valid))
            if list(bands) != unmasked:
                all_values = compute(index, [reader.values(band, tile) for band in unmasked])
                masked_px += int(np.count_nonzero(np.isfinite(all_values) & ~valid))
            samples.append(values[::step, ::step][valid[::step, ::step]])
        sample = np.concatenate(samples)
        shares = (pixels / (like.width * like.height) for pixels in (valid_px, masked_px))
        statistics = _statistics(index, unit, sample, *shares)
        raster.dataset.update_tags(**{STATISTICS_TAG: json.dumps(statistics.as_json())})
    _draw(index, target, sample, statistics)
    return statistics


def _tags(index: Index, like: OpenRaster, unit: str, source: str) -> dict[str, str]:
    """The tags of a raster, some of which are those of the file of its first band."""
    copied = "CAPTURE_ID", "CAMERA", "TIFFTAG_DATETIME", "RADIOMETRY", "GEOREFERENCE", "GEOREFERENCE_ACCURACY_M"
    constants = ", ".join(f"{name} = {value:g}" for name, value in index.constants)
    return {k: v for k, v in like.tags().items() if k in copied} | {
        "TIFFTAG_SOFTWARE": "agalign",
        "INDEX": index.name,
        "INDEX_SOURCE": index.source,
        "INDEX_FORMULA": f"{index.formula} with {constants}" if constants else index.formula,
        "INDEX_MADE_FROM": source,
        "INPUT": "raw numbers, not reflectance" if unit == RAW else "",
    }


def _statistics(
    index: Index, unit: str, sample: NDArray[np.float32], valid_share: float, masked_share: float
) -> IndexStatistics:
    masked_share = round(masked_share, 6)
    if not sample.size:
        return IndexStatistics(unit=unit, low=0.0, high=1.0, masked_share=masked_share)
    low, p5, median, p95, high = (round(float(v), 6) for v in np.percentile(sample, (2, 5, 50, 95, 98)))
    if index.span is not None and unit != RAW:
        low, high = index.span
    # The ends of the colour scale must differ.
    return IndexStatistics(median, p5, p95, round(valid_share, 6), unit, low, max(high, low + 1e-3), masked_share)


def _draw(index: Index, raster: Path, sample: NDArray[np.float32], statistics: IndexStatistics) -> None:
    """Write the picture of a raster, and the histogram of a sample of its values in the same colours.

    Raw numbers are drawn in greys. Raises OutputError.
    """
    with open_raster(raster) as dataset:
        size_px = dataset.width, dataset.height
        # Longer side of the image at the top left of the picture; the report overlays it on the composite.
        picture_px = 720
        values = dataset.read(1, out_shape=reduced_size_px(size_px, max(1.0, max(size_px) / picture_px))[::-1])
    span, neutral = (statistics.low, statistics.high), statistics.unit == RAW
    shape = values.shape
    width, margin, bars, bins = max(shape[1], 360), 24, 90, 120
    # In float64: a value clipped in float32 may be just outside the span.
    counts = np.histogram(sample.astype(float).clip(*span), bins, span)[0]
    sheet = np.full((shape[0] + bars + 2 * margin + 8, width, 3), 255, np.uint8)
    sheet[: shape[0], : shape[1]] = _coloured(values, span, neutral=neutral)
    base = shape[0] + margin + bars
    edges = np.linspace(margin, width - margin, bins + 1).round().astype(int)
    centres = np.linspace(*span, 2 * bins + 1, dtype=np.float32)[1::2]
    colours = _coloured(centres[None], span, neutral=neutral)[0]
    # The first and last bins also contain the values beyond the span.
    heights = (bars * counts / max(int(counts[1:-1].max(initial=1)), 1)).clip(0, bars).round().astype(int)
    for left, right, height, colour in zip(edges, edges[1:], heights.tolist(), colours.tolist(), strict=False):
        cv2.rectangle(sheet, (int(left), base - height), (int(right) - 1, base), colour, -1)
    for value in np.linspace(*span, 5):
        at = round(margin + (value - span[0]) / (span[1] - span[0]) * (width - 2 * margin))
        sheet = with_text(sheet, f"{value:.3g}" if abs(value) >= 100 else f"{value:.2f}", (at, base + 18), anchor="ms")
    note = ": raw numbers, not reflectance" if neutral else ""
    title = f"{index.name.upper()} of {raster.stem.removesuffix(f'_{index.name}')}{note}"
    write_png(with_text(sheet, title, (margin, shape[0] + 18), 16), raster.with_suffix(".png"))


def _coloured(values: NDArray[Any], span: tuple[float, float], *, neutral: bool) -> NDArray[np.uint8]:
    """Values (height, width) as colours (height, width, 3)."""
    ramp = _NEUTRAL if neutral else _COLOURS
    share = np.nan_to_num(np.clip((values - span[0]) / (span[1] - span[0]), 0, 1))
    stops = np.linspace(0, 1, len(ramp))
    result = np.stack([np.interp(share, stops, channel) for channel in ramp.T], axis=-1)
    result[~np.isfinite(values)] = (225, 190, 215)
    return np.asarray(result.round(), np.uint8)
