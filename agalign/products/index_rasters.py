"""Spectral indices of a capture: a float32 raster and a picture of each, with their statistics."""

import glob
import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from agalign._version import __version__
from agalign.errors import AgalignError, InputError
from agalign.pixels.raster import OpenRaster, open_raster
from agalign.products.checked_raster import (
    FLOAT_OPTIONS,
    WORK_TILE_PX,
    CheckedRaster,
    LayerDescription,
    check_complete,
    checked_raster,
    tiled_profile,
)
from agalign.products.drawing import with_text, write_png
from agalign.products.index_bands import RAW, BandReader, IndexBand
from agalign.products.index_table import STATISTICS_TAG, IndexReport, IndexStatistics, read_statistics, statistics_in
from agalign.products.indices import Index, bands_for, compute
from agalign.values.image import FloatImage, Tile
from agalign.values.resample import tiles

_MAX_STATISTICS_PX = 4_000_000
"""Percentiles of larger rasters are calculated from every second, third … row and column."""
_MIN_SPAN = 1e-3
"""Smallest difference between the ends of the colour scale of a picture."""
_SOURCE_TAG = "INDEX_MADE_FROM"
_COPIED_TAGS = "CAPTURE_ID", "CAMERA", "TIFFTAG_DATETIME", "RADIOMETRY", "GEOREFERENCE", "GEOREFERENCE_ACCURACY_M"
_BARS = 120
_PICTURE_PX = 720
"""Longer side of the image at the top left of the picture; the report overlays it on the composite."""
_COLOURS = np.array([(38, 70, 148), (120, 74, 40), (214, 190, 120), (250, 245, 170), (90, 180, 80), (0, 90, 40)], float)
"""Red, green, blue from the low to the high end of the scale: water, soil, sparse to dense vegetation."""
_NEUTRAL = np.array([(20, 20, 20), (245, 245, 245)], float)
"""Greys for raw numbers, whose values do not distinguish soil and vegetation."""
_NODATA_COLOUR = (225, 190, 215)


@dataclass
class _Raster:
    """An index raster that is being written."""

    index: Index
    bands: Sequence[IndexBand]
    target: Path
    unit: str
    source: str
    """Fingerprint of the bands and the formula."""
    file: CheckedRaster = field(init=False)
    samples: list[NDArray[np.float32]] = field(default_factory=list)
    valid_px: int = 0


def write_rasters(
    bands: Sequence[IndexBand], indices: Sequence[Index], base: Path, label: str, *, overwrite: bool = True
) -> list[IndexReport]:
    """Write `base`_<index>.tif and .png of a capture's bands, each atomically.

    Without `overwrite`, rasters that an earlier command wrote from the same bands with the same formula are kept. If a
    band of an index is missing, not delivered or not in the unit that the index needs, the report has the problem.
    Raises OutputError, or InputError for a file that cannot be read.
    """
    reports: dict[str, IndexReport] = {}
    rasters: list[_Raster] = []
    with BandReader() as reader:
        for index in indices:
            target = base.with_name(f"{base.name}_{index.name}.tif")
            try:
                chosen = _chosen(bands, index)
                source = _fingerprint(index, chosen)
                earlier = None if overwrite else _finished_before(target, source)
                if earlier is not None:
                    reports[index.name] = IndexReport(label, index.name, target, earlier, kept=True)
                    continue
                unit = _unit(index, chosen, reader)
                for band in chosen:
                    if band.quality is not None:
                        reader.file(*band.quality[:2])
            except InputError as error:
                reports[index.name] = IndexReport(label, index.name, problem=str(error))
                continue
            rasters.append(_Raster(index, chosen, target, unit, source))
        statistics = _write(rasters, reader) if rasters else []
    for raster, one in zip(rasters, statistics, strict=True):
        _draw(raster, one)
        reports[raster.index.name] = IndexReport(label, raster.index.name, raster.target, one)
    return [reports[index.name] for index in indices]


def outdated_rasters(base: Path) -> Iterator[Path]:
    """Yield the index rasters of a capture, `base`_<index>.tif, and their pictures."""
    for path in base.parent.glob(f"{glob.escape(base.name)}_*.tif"):
        # A file with a sidecar is the stack of another capture.
        if not path.with_suffix(".json").exists() and read_statistics(path) is not None:
            yield from (path, path.with_suffix(".png"))


def _chosen(bands: Sequence[IndexBand], index: Index) -> list[IndexBand]:
    """The bands of an index. Raises InputError if one is missing or not delivered."""
    chosen = [bands[i] for i in bands_for(index, [b.name for b in bands], [b.wavelength_nm for b in bands])]
    for band in chosen:
        if band.problem:
            raise InputError(f"{index.name} is left out: {band.problem}")
    return chosen


def _fingerprint(index: Index, bands: Sequence[IndexBand]) -> str:
    """Sixteen hexadecimal digits of everything that an index raster depends on."""
    sources = [(b.sha256 or _size_and_time(b.file), b.band_index) for b in bands]
    masks = [(b.quality[2], b.quality[1]) for b in bands if b.quality is not None]
    facts = json.dumps([__version__, index.formula, index.constants, index.span, sources, *([masks] if masks else [])])
    return hashlib.sha256(facts.encode()).hexdigest()[:16]


def _size_and_time(path: Path) -> list[int]:
    try:
        state = path.stat()
    except OSError:
        return []
    return [state.st_size, state.st_mtime_ns]


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
    return statistics_in(tags) if tags.get(_SOURCE_TAG) == source else None


def _unit(index: Index, bands: Sequence[IndexBand], reader: BandReader) -> str:
    """The unit of the bands. Raises InputError if they differ or if the index needs another one."""
    units = {unit for band in bands for unit in reader.units(band)}
    if len(units) > 1:
        raise InputError(f"{index.name} is left out: its bands are in different units ({', '.join(sorted(units))})")
    (unit,) = units
    if not index.any_unit and unit != "reflectance":
        raise InputError(f"{index.name} needs reflectance, and the bands are {unit}; align with --radiometry")
    return unit


def _write(rasters: Sequence[_Raster], reader: BandReader) -> list[IndexStatistics]:
    """Write rasters tile by tile, reading each band once. Raises OutputError, InputError for a band."""
    first = rasters[0].bands[0]
    like = reader.file(first.file, first.band_index)
    profile = tiled_profile(like.width, like.height, 1, "float32", **FLOAT_OPTIONS)
    if like.crs is not None and not like.transform.is_identity:
        profile |= {"crs": like.crs, "transform": like.transform}
    step = max(1, math.ceil(math.sqrt(like.width * like.height / _MAX_STATISTICS_PX)))
    with ExitStack() as stack:
        for raster in rasters:
            raster.file = stack.enter_context(checked_raster(raster.target, profile))
            _describe(raster, like)
        for tile in tiles(Tile(0, 0, like.width, like.height), WORK_TILE_PX):
            _write_tile(rasters, reader, tile, step)
        statistics = [_statistics(raster, like.width * like.height) for raster in rasters]
        for raster, one in zip(rasters, statistics, strict=True):
            raster.file.dataset.update_tags(**{STATISTICS_TAG: json.dumps(one.as_json())})
    return statistics


def _describe(raster: _Raster, like: OpenRaster) -> None:
    index = raster.index
    tags = {k: v for k, v in like.tags().items() if k in _COPIED_TAGS}
    tags |= {"TIFFTAG_SOFTWARE": "agalign", "INDEX": index.name, "INDEX_SOURCE": index.source}
    tags |= {"INDEX_FORMULA": _formula_text(index), _SOURCE_TAG: raster.source}
    tags["INPUT"] = "raw numbers, not reflectance" if raster.unit == RAW else ""
    raster.file.describe([LayerDescription(index.name)], tags)


def _write_tile(rasters: Sequence[_Raster], reader: BandReader, tile: Tile, step: int) -> None:
    values: dict[IndexBand, FloatImage] = {}
    for raster in rasters:
        for band in raster.bands:
            if band not in values:
                values[band] = reader.values(band, tile)
        result = compute(raster.index, [values[band] for band in raster.bands])
        raster.file.write(result, 1, tile.x0, tile.y0)
        valid = np.isfinite(result)
        raster.valid_px += int(np.count_nonzero(valid))
        raster.samples.append(result[::step, ::step][valid[::step, ::step]])


def _statistics(raster: _Raster, pixels: int) -> IndexStatistics:
    values = np.concatenate(raster.samples)
    raster.samples = [values]
    if not values.size:
        return IndexStatistics(unit=raster.unit, low=0.0, high=1.0)
    low, p5, median, p95, high = (round(float(v), 6) for v in np.percentile(values, (2, 5, 50, 95, 98)))
    if raster.index.span is not None and raster.unit != RAW:
        low, high = raster.index.span
    valid_share = round(raster.valid_px / pixels, 6)
    return IndexStatistics(median, p5, p95, valid_share, raster.unit, low, max(high, low + _MIN_SPAN))


def _formula_text(index: Index) -> str:
    constants = ", ".join(f"{name} = {value:g}" for name, value in index.constants)
    return f"{index.formula} with {constants}" if constants else index.formula


def _draw(raster: _Raster, statistics: IndexStatistics) -> None:
    with open_raster(raster.target) as dataset:
        width, height = picture_size(dataset.width, dataset.height)
        values = dataset.read(1, out_shape=(height, width))
    capture = raster.target.stem.removesuffix(f"_{raster.index.name}")
    note = ": raw numbers, not reflectance" if raster.unit == RAW else ""
    title = f"{raster.index.name.upper()} of {capture}{note}"
    write_picture(values, raster.samples[0], statistics, title, raster.target.with_suffix(".png"))


def picture_size(width: int, height: int) -> tuple[int, int]:
    """Return (width, height) px of the image in the picture of a raster of this size."""
    scale = min(1.0, _PICTURE_PX / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def write_picture(
    values: NDArray[np.float32], sample: NDArray[np.float32], statistics: IndexStatistics, title: str, path: Path
) -> None:
    """Write an image (height, width) of an index and the histogram of a sample of its values in the same colours.

    Raw numbers are drawn in greys. Raises OutputError.
    """
    span, neutral = (statistics.low, statistics.high), statistics.unit == RAW
    shape = values.shape
    width, margin, bars = max(shape[1], 360), 24, 90
    # In float64: a value clipped in float32 may be just outside the span.
    counts = np.histogram(sample.astype(float).clip(*span), _BARS, span)[0]
    sheet = np.full((shape[0] + bars + 2 * margin + 8, width, 3), 255, np.uint8)
    sheet[: shape[0], : shape[1]] = _coloured(values, span, neutral=neutral)
    base = shape[0] + margin + bars
    edges = np.linspace(margin, width - margin, _BARS + 1).round().astype(int)
    centres = np.linspace(*span, 2 * _BARS + 1, dtype=np.float32)[1::2]
    colours = _coloured(centres[None], span, neutral=neutral)[0]
    # The first and last bins also contain the values beyond the span.
    heights = (bars * counts / max(int(counts[1:-1].max(initial=1)), 1)).clip(0, bars).round().astype(int)
    for left, right, height, colour in zip(edges, edges[1:], heights.tolist(), colours.tolist(), strict=False):
        cv2.rectangle(sheet, (int(left), base - height), (int(right) - 1, base), colour, -1)
    for value in np.linspace(*span, 5):
        at = round(margin + (value - span[0]) / (span[1] - span[0]) * (width - 2 * margin))
        sheet = with_text(sheet, f"{value:.3g}" if abs(value) >= 100 else f"{value:.2f}", (at, base + 18), anchor="ms")
    write_png(with_text(sheet, title, (margin, shape[0] + 18), 16), path)


def _coloured(values: NDArray[Any], span: tuple[float, float], *, neutral: bool) -> NDArray[np.uint8]:
    """Values (height, width) as colours (height, width, 3)."""
    ramp = _NEUTRAL if neutral else _COLOURS
    share = np.nan_to_num(np.clip((values - span[0]) / (span[1] - span[0]), 0, 1))
    stops = np.linspace(0, 1, len(ramp))
    result = np.stack([np.interp(share, stops, channel) for channel in ramp.T], axis=-1)
    result[~np.isfinite(values)] = _NODATA_COLOUR
    return np.asarray(result.round(), np.uint8)
