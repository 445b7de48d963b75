"""Vegetation indices of the captures below an output folder: a float32 raster and a picture each."""

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window

from agalign.errors import AgalignError, InputError, OutputError
from agalign.pixels.raster import GDAL_ENVIRONMENT, open_raster, why, without_warnings
from agalign.products.drawing import with_text, write_png
from agalign.products.fill_sidecar import is_delivered
from agalign.products.indices import Index, bands_for, compute
from agalign.products.raster_file import PixelChecksums, check_complete
from agalign.products.sidecar import BandPart, Sidecar, find_sidecars, read_sidecar
from agalign.values.files import complete_file
from agalign.values.image import FloatImage

_TILE_PX = 256
_WORK_PX = 2048
_BINS, _BARS = 1200, 120
"""Of the values, and of the picture's histogram."""
_PICTURE_PX = 720
_COLOURS = np.array([(38, 70, 148), (120, 74, 40), (214, 190, 120), (250, 245, 170), (90, 180, 80), (0, 90, 40)], float)
"""Water, soil, and the greens, red green blue, over an index's span."""
_NODATA_COLOUR = (225, 225, 225)
_RAW = "raw numbers"
_OLD_ACCEPT_PREDICTED_PX = 1.0
"""For sidecars that do not state the limit of their run: the default of `--accept-predicted`."""
_MAX_REFLECTANCE = 2.0
"""Glints and specular leaves exceed 1; raw numbers of any sensor exceed this."""
_SAMPLE_PX = 512
"""Longer side of the sample by which unnamed numbers are told apart."""

Source = tuple[rasterio.DatasetReader, int]
"""A file and the index of a band in it."""


@dataclass(frozen=True)
class IndexReport:
    """What became of one index of one capture."""

    capture: str
    index: str
    path: Path | None
    median: float
    raw_numbers: bool
    """The bands hold neither reflectance nor radiance."""
    problem: str = ""


def write_indices(out: Path, indices: Sequence[Index]) -> Iterator[IndexReport]:
    """Write OUT/<folder>/<capture>_<index>.tif and .png for every capture of a run.

    A capture that lacks a band, or whose band is not aligned, is reported and stops no other. Raises InputError where
    there is no run.
    """
    sidecars = find_sidecars(out) if out.is_dir() else []
    if not sidecars:
        raise InputError(f"{out}: no sidecars there; give the output folder of a run")
    for path in sidecars:
        label = (path.parent.relative_to(out) / path.stem).as_posix()
        for index in indices:
            try:
                sidecar = read_sidecar(path)
                yield write_index(sidecar, path, index, label)
            except AgalignError as error:
                yield IndexReport(label, index.name, None, math.nan, False, str(error))


def write_index(sidecar: Sidecar, path: Path, index: Index, label: str = "") -> IndexReport:
    """Write one index of the capture whose sidecar is at `path`.

    Raises InputError where a band is missing, not aligned, or not in the unit that the index needs; OutputError.
    """
    parts = sidecar.bands
    chosen = [parts[i] for i in bands_for(index, [p.band for p in parts], [p.wavelength_nm for p in parts])]
    _need_delivered(chosen, index, sidecar.accept_predicted_px)
    target = path.with_name(f"{path.stem}_{index.name}.tif")
    counts, edges = np.zeros(_BINS, np.int64), np.linspace(*index.span, _BINS + 1)
    with ExitStack() as stack:
        sources = [_open(stack, path, part) for part in chosen]
        unit = _unit(index, sources)
        with complete_file(target) as partial:
            _write_values(partial, target, index, sources, unit, counts, edges)
    _write_picture(target, index, counts, raw=unit == _RAW)
    middle = np.searchsorted(np.cumsum(counts), counts.sum() / 2)
    median = float(edges[middle : middle + 2].mean()) if counts.any() else math.nan
    return IndexReport(label, index.name, target, median, unit == _RAW)


def _need_delivered(parts: Sequence[BandPart], index: Index, accept_predicted_px: float | None) -> None:
    """Raise InputError for a band that the run did not count as delivered, or that has no pixels."""
    limit_px = _OLD_ACCEPT_PREDICTED_PX if accept_predicted_px is None else accept_predicted_px
    for part in parts:
        if not is_delivered(part, limit_px) or part.place is None:
            known = "" if part.prediction is None else f" to {part.prediction.std_px:.1f} px, not {limit_px:g}"
            raise InputError(f"{index.name} is left out: {part.band} is {part.status}{known} ({part.reason})")


def _open(stack: ExitStack, sidecar: Path, part: BandPart) -> Source:
    assert part.place is not None
    path, index = sidecar.parent / part.place.file, part.place.band_index
    source = stack.enter_context(open_raster(path))
    if index > source.count:
        raise InputError(f"{path}: has no band {index}, as its sidecar says; run again")
    return source, index


def _unit(index: Index, sources: Sequence[Source]) -> str:
    """What the bands' numbers are. Raises InputError where the index needs something else."""
    units = {unit for source, i in sources for unit in _units_of(source, i)}
    if len(units) > 1:
        raise InputError(f"{index.name} is left out: its bands are in different units ({', '.join(sorted(units))})")
    (unit,) = units
    if not index.any_unit and unit != "reflectance":
        raise InputError(f"{index.name} needs reflectance, and the bands are {unit}; align with --radiometry")
    return unit


def _units_of(source: rasterio.DatasetReader, index: int) -> list[str]:
    """Without a word of radiometry numbers are reflectance where most of them, scaled as the file says, can be."""
    said = source.tags(index).get("QUANTITY") or source.tags().get("RADIOMETRY")
    if said:
        return str(said).split(" and ")
    whole = np.dtype(source.dtypes[index - 1]).kind in "ui"
    if whole and source.scales[index - 1] == 1.0:
        return [_RAW]
    reduction = max(1.0, max(source.width, source.height) / _SAMPLE_PX)
    some = Window(0, 0, source.width, source.height)
    shape = max(1, round(source.height / reduction)), max(1, round(source.width / reduction))
    values = _physical(source, index, some, shape)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
    return ["reflectance"] if low >= -_MAX_REFLECTANCE and high <= _MAX_REFLECTANCE else [_RAW]


def _write_values(
    partial: Path, target: Path, index: Index, sources: Sequence[Source], unit: str, counts: NDArray[np.int64],
    edges: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write the raster and add its values to the histogram's counts. Raises OutputError."""
    checksums = PixelChecksums()
    try:
        with ExitStack() as stack:
            dataset = _create(stack, partial, sources[0][0], index, raw=unit == _RAW)
            for window in _windows(dataset.width, dataset.height):
                value = compute(index, [_physical(source, i, window) for source, i in sources])
                counts += np.histogram(value[np.isfinite(value)].clip(*index.span), edges)[0]
                checksums.write(dataset, value, 1, window)
        check_complete(partial)
        checksums.check(partial)
    except (OSError, RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{target}: cannot be written ({why(error)})") from None


def _physical(
    source: rasterio.DatasetReader, index: int, window: Window, shape: tuple[int, int] | None = None
) -> FloatImage:
    """Scaled as the file says, nan where it says nothing is known; of (height, width) `shape` where one is given."""
    pixels = source.read(index, window=window, out_shape=shape).astype(np.float32)
    valid = source.read_masks(index, window=window, out_shape=shape) > 0
    scaled = pixels * np.float32(source.scales[index - 1]) + np.float32(source.offsets[index - 1])
    return np.where(valid, scaled, np.float32(np.nan))


def _windows(width: int, height: int) -> Iterator[Window]:
    for y in range(0, height, _WORK_PX):
        for x in range(0, width, _WORK_PX):
            yield Window(x, y, min(_WORK_PX, width - x), min(_WORK_PX, height - y))


def _create(stack: ExitStack, path: Path, like: rasterio.DatasetReader, index: Index, *, raw: bool) -> Any:
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": like.width, "height": like.height, "count": 1, "dtype": "float32",
        "nodata": math.nan, "tiled": True, "blockxsize": _TILE_PX, "blockysize": _TILE_PX, "compress": "deflate",
        "predictor": 3, "bigtiff": "if_safer",
    }  # fmt: skip
    if like.crs is not None and not like.transform.is_identity:
        profile |= {"crs": like.crs, "transform": like.transform}
    stack.enter_context(rasterio.Env(**GDAL_ENVIRONMENT))
    stack.enter_context(without_warnings())
    dataset = stack.enter_context(rasterio.open(path, "w", **profile))
    dataset.set_band_description(1, index.name)
    kept = {k: v for k, v in like.tags().items() if k in ("CAPTURE_ID", "CAMERA", "TIFFTAG_DATETIME", "RADIOMETRY")}
    kept |= {"TIFFTAG_SOFTWARE": "agalign", "INDEX": index.name, "INDEX_SOURCE": index.source}
    dataset.update_tags(**kept, **({"INPUT": "raw numbers, not reflectance"} if raw else {}))
    return dataset


# ---- the picture


def _write_picture(raster: Path, index: Index, counts: NDArray[np.int64], *, raw: bool) -> None:
    """The index in colours over its histogram, whose bars are coloured alike."""
    with open_raster(raster) as source:
        scale = min(1.0, _PICTURE_PX / max(source.width, source.height))
        shape = max(1, round(source.height * scale)), max(1, round(source.width * scale))
        values = source.read(1, out_shape=shape)
    width, margin, bars = max(shape[1], 360), 24, 90
    counts = counts.reshape(_BARS, -1).sum(axis=1)
    sheet = np.full((shape[0] + bars + 2 * margin + 8, width, 3), 255, np.uint8)
    sheet[: shape[0], : shape[1]] = _coloured(values, index)
    base = shape[0] + margin + bars
    edges = np.linspace(margin, width - margin, len(counts) + 1).round().astype(int)
    centres = np.linspace(*index.span, 2 * len(counts) + 1)[1::2]
    colours = _coloured(centres[None], index)[0]
    # The outermost bins also hold what lies beyond the span.
    heights = (bars * counts / max(int(counts[1:-1].max(initial=1)), 1)).clip(0, bars).round().astype(int)
    for left, right, height, colour in zip(edges, edges[1:], heights.tolist(), colours.tolist(), strict=False):
        cv2.rectangle(sheet, (int(left), base - height), (int(right) - 1, base), colour, -1)
    for value in np.linspace(*index.span, 5):
        at = round(margin + (value - index.span[0]) / (index.span[1] - index.span[0]) * (width - 2 * margin))
        sheet = with_text(sheet, f"{value:.2f}", (at, base + 18), anchor="ms")
    title = f"{index.name.upper()} of {raster.stem.removesuffix(f'_{index.name}')}"
    sheet = with_text(sheet, f"{title}, of raw numbers" if raw else title, (margin, shape[0] + 18), 16)
    write_png(sheet, raster.with_suffix(".png"))


def _coloured(values: NDArray[np.floating[Any]], index: Index) -> NDArray[np.uint8]:
    """(H, W) values as (H, W, 3) red, green, blue."""
    share = np.clip((values - index.span[0]) / (index.span[1] - index.span[0]), 0, 1)
    stops = np.linspace(0, 1, len(_COLOURS))
    result = np.stack([np.interp(np.nan_to_num(share), stops, channel) for channel in _COLOURS.T], axis=-1)
    result[~np.isfinite(values)] = _NODATA_COLOUR
    return np.asarray(result.round(), np.uint8)
