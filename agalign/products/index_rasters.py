"""Spectral indices of a capture: a float32 raster and a picture of each, with their statistics."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.enums import MaskFlags
from rasterio.errors import RasterioError
from rasterio.windows import Window

from agalign._version import __version__
from agalign.errors import AgalignError, InputError, OutputError
from agalign.pixels.raster import GDAL_ENVIRONMENT, open_raster, why, without_warnings
from agalign.products.fill_sidecar import is_delivered
from agalign.products.index_picture import picture_size, write_picture
from agalign.products.indices import Index, bands_for, compute
from agalign.products.raster_file import PixelChecksums, check_complete
from agalign.products.sidecar import CaptureResult, find_sidecars, read_result
from agalign.values.files import complete_file
from agalign.values.image import FloatImage
from agalign.values.quality import UNUSABLE

RAW = "raw numbers"
_TILE_PX = 256
_WORK_PX = 2048
_OLD_ACCEPT_PREDICTED_PX = 1.0
"""For sidecars that do not state the limit of their run: the default of `--accept-predicted`."""
_MAX_REFLECTANCE = 2.0
"""Glints and specular leaves exceed 1; raw numbers of any sensor exceed this."""
_SAMPLE_PX = 512
"""Longer side of the sample by which unnamed numbers are distinguished."""
_MAX_STATISTICS_PX = 4_000_000
"""Percentiles of larger rasters are those of every second, third … pixel."""
_MIN_SPAN = 1e-3
_STATISTICS = "INDEX_STATISTICS"
_KEPT_TAGS = (
    "CAPTURE_ID", "CAMERA", "TIFFTAG_DATETIME", "RADIOMETRY", "GEOREFERENCE", "GEOREFERENCE_ACCURACY_M",
)  # fmt: skip

Source = tuple[rasterio.DatasetReader, int]
"""A file and the index of a band in it."""


@dataclass(frozen=True)
class IndexStatistics:
    """The values of an index raster; nan where no pixel is valid."""

    median: float = math.nan
    p5: float = math.nan
    p95: float = math.nan
    valid_share: float = 0.0
    unit: str = ""
    """Of the bands: reflectance, radiance, or raw numbers."""
    low: float = math.nan
    """The span of values that the picture shows,"""
    high: float = math.nan


@dataclass(frozen=True)
class IndexReport:
    """What became of one index of one capture."""

    capture: str
    index: str
    path: Path | None = None
    """None where it could not be written."""
    statistics: IndexStatistics = IndexStatistics()
    problem: str = ""
    kept: bool = False
    """An earlier command wrote it, of the same bands by the same formula."""

    @property
    def median(self) -> float:
        """Of the valid pixels."""
        return self.statistics.median

    @property
    def raw_numbers(self) -> bool:
        """True where the bands are neither reflectance nor radiance."""
        return self.statistics.unit == RAW


@dataclass(frozen=True)
class IndexBand:
    """An aligned band: where its pixels are, or why there are none to be used."""

    name: str
    wavelength_nm: float | None
    file: Path
    band_index: int
    sha256: str = ""
    """Of the file, where it is known."""
    problem: str = ""
    quality: tuple[Path, int, str] | None = None
    """The quality raster with flagged pixels to leave out, the index of the band's layer, and the file's checksum."""


@dataclass
class _Raster:
    """An index that is being written."""

    index: Index
    bands: Sequence[IndexBand]
    target: Path
    unit: str
    made_from: str
    checksums: PixelChecksums = field(default_factory=PixelChecksums)
    samples: list[NDArray[np.float32]] = field(default_factory=list)
    valid_px: int = 0
    dataset: Any = None


def write_indices(out: Path, indices: Sequence[Index]) -> Iterator[IndexReport]:
    """Write OUT/<folder>/<capture>_<index>.tif and .png for every capture of a run, one after another.

    A capture that lacks a band, or has a band that is not aligned, is reported and stops no other. Raises InputError
    where there is no run.
    """
    for path in run_sidecars(out):
        label = path.relative_to(out).with_suffix("").as_posix()
        yield from write_capture_indices(path, indices, path.with_suffix(""), label)


def run_sidecars(out: Path) -> list[Path]:
    """Return the sidecars below the output folder of a run. Raises InputError where there are none."""
    sidecars = find_sidecars(out) if out.is_dir() else []
    if not sidecars:
        raise InputError(f"{out}: no sidecars there; give the output folder of a run")
    return sidecars


def write_capture_indices(
    sidecar: Path, indices: Sequence[Index], base: Path, label: str, *, overwrite: bool = True
) -> list[IndexReport]:
    """Write indices of the capture with this sidecar as `base`_<index>.tif; every problem is in the reports.

    Without `overwrite`, rasters that an earlier command wrote of the same bands by the same formula are kept.
    """
    try:
        return write_rasters(bands_of(read_result(sidecar), sidecar.parent), indices, base, label, overwrite=overwrite)
    except AgalignError as error:
        return [IndexReport(label, index.name, problem=str(error)) for index in indices]


def bands_of(sidecar: CaptureResult, folder: Path, *, mask_qa: bool = False) -> list[IndexBand]:
    """Return the bands of a capture with the files in the folder of its sidecar, and with `mask_qa` those of their
    quality flags. Raises InputError where they were not written.
    """
    flags = next((part for part in sidecar.products if part.kind == "qa"), None)
    if mask_qa and flags is None:
        raise InputError(f"{sidecar.capture}: has no quality raster, which --mask-qa needs; align with --qa")
    given = sidecar.accept_predicted_px
    limit_px = _OLD_ACCEPT_PREDICTED_PX if given is None else given
    sums = {part.file: part.sha256 for part in sidecar.products}
    result = []
    # Layers of the quality raster: all bands together, then each band.
    for layer, part in enumerate(sidecar.bands, start=2):
        problem = ""
        if not is_delivered(part, limit_px) or part.place is None:
            known = "" if part.prediction is None else f" to {part.prediction.std_px:.1f} px, not {limit_px:g}"
            problem = f"{part.band} is {part.status}{known} ({part.reason})"
        file, number = ("", 1) if part.place is None else (part.place.file, part.place.band_index)
        quality = (folder / flags.file, layer, flags.sha256) if mask_qa and flags is not None else None
        result.append(
            IndexBand(part.band, part.wavelength_nm, folder / file, number, sums.get(file, ""), problem, quality)
        )
    return result


def write_rasters(
    bands: Sequence[IndexBand], indices: Sequence[Index], base: Path, label: str, *, overwrite: bool = True
) -> list[IndexReport]:
    """Write `base`_<index>.tif and .png of a capture's bands, each atomically.

    An index with bands that are missing, not aligned, or not in the unit that it needs has a report with the problem.
    Raises OutputError, or InputError for a file that cannot be read.
    """
    reports: dict[str, IndexReport] = {}
    rasters: list[_Raster] = []
    with ExitStack() as stack:
        files: dict[Path, rasterio.DatasetReader] = {}
        for index in indices:
            target = base.with_name(f"{base.name}_{index.name}.tif")
            try:
                chosen = _chosen(bands, index)
                made_from = _made_from(index, chosen)
                known = None if overwrite else _finished_before(target, made_from)
                if known is not None:
                    reports[index.name] = IndexReport(label, index.name, target, known, kept=True)
                    continue
                unit = _unit(index, [_source(stack, files, band) for band in chosen])
                for band in chosen:
                    if band.quality is not None:
                        _open(stack, files, *band.quality[:2])
            except InputError as error:
                reports[index.name] = IndexReport(label, index.name, problem=str(error))
                continue
            rasters.append(_Raster(index, chosen, target, unit, made_from))
        if rasters:
            statistics = _write(rasters, files)
            for raster, one in zip(rasters, statistics, strict=True):
                reports[raster.index.name] = IndexReport(label, raster.index.name, raster.target, one)
    return [reports[index.name] for index in indices]


def unit_of(bands: Sequence[IndexBand]) -> str:
    """Return what the numbers of the first band with pixels are; empty where there is none. Raises InputError."""
    for band in bands:
        if not band.problem:
            with ExitStack() as stack:
                source, number = _source(stack, {}, band)
                return _units_of(source, number)[0]
    return ""


def is_index_raster(path: Path) -> bool:
    """True for a file that `write_rasters` wrote."""
    try:
        with open_raster(path) as source:
            return _STATISTICS in source.tags()
    except AgalignError:
        return False


def read_statistics(path: Path) -> IndexStatistics | None:
    """Return the statistics of an index raster by its tags; None where it is none, or cannot be read."""
    try:
        with open_raster(path) as source:
            return _statistics_in(source.tags())
    except AgalignError:
        return None


def _chosen(bands: Sequence[IndexBand], index: Index) -> list[IndexBand]:
    """The bands of an index. Raises InputError for one that is missing or not delivered."""
    chosen = [bands[i] for i in bands_for(index, [b.name for b in bands], [b.wavelength_nm for b in bands])]
    for band in chosen:
        if band.problem:
            raise InputError(f"{index.name} is left out: {band.problem}")
    return chosen


def _made_from(index: Index, bands: Sequence[IndexBand]) -> str:
    """Sixteen digits of all that an index raster depends on."""
    sources = [(b.sha256 or _state(b.file), b.band_index) for b in bands]
    masks = [(b.quality[2], b.quality[1]) for b in bands if b.quality is not None]
    facts = json.dumps([__version__, index.formula, index.constants, index.span, sources, *([masks] if masks else [])])
    return hashlib.sha256(facts.encode()).hexdigest()[:16]


def _state(path: Path) -> list[int]:
    try:
        state = path.stat()
    except OSError:
        return []
    return [state.st_size, state.st_mtime_ns]


def _finished_before(target: Path, made_from: str) -> IndexStatistics | None:
    """The statistics of a complete raster with its picture that an earlier command made of the same; else None."""
    if not target.is_file() or not target.with_suffix(".png").is_file():
        return None
    try:
        check_complete(target)
        with open_raster(target) as source:
            tags = source.tags()
    except (AgalignError, OSError, tifffile.TiffFileError):
        return None
    return _statistics_in(tags) if tags.get("INDEX_MADE_FROM") == made_from else None


def _statistics_in(tags: Mapping[str, str]) -> IndexStatistics | None:
    try:
        known: dict[str, Any] = json.loads(tags[_STATISTICS])
        unit = str(known.pop("unit"))
        return IndexStatistics(unit=unit, **{k: math.nan if v is None else float(v) for k, v in known.items()})
    except (KeyError, ValueError, TypeError):
        return None


def _source(stack: ExitStack, files: dict[Path, rasterio.DatasetReader], band: IndexBand) -> Source:
    return _open(stack, files, band.file, band.band_index)


def _open(stack: ExitStack, files: dict[Path, rasterio.DatasetReader], path: Path, number: int) -> Source:
    if path not in files:
        files[path] = stack.enter_context(open_raster(path))
    if number > files[path].count:
        raise InputError(f"{path}: has no band {number}, as its sidecar says; run again")
    return files[path], number


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
    """Without radiometry tags, numbers are reflectance where most of them, scaled as the file says, can be."""
    said = source.tags(index).get("QUANTITY") or source.tags().get("RADIOMETRY")
    if said:
        return str(said).split(" and ")
    whole = np.dtype(source.dtypes[index - 1]).kind in "ui"
    if whole and source.scales[index - 1] == 1.0:
        return [RAW]
    reduction = max(1.0, max(source.width, source.height) / _SAMPLE_PX)
    some = Window(0, 0, source.width, source.height)
    shape = max(1, round(source.height / reduction)), max(1, round(source.width / reduction))
    values = _physical(source, index, some, shape)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
    return ["reflectance"] if low >= -_MAX_REFLECTANCE and high <= _MAX_REFLECTANCE else [RAW]


def _write(rasters: Sequence[_Raster], files: Mapping[Path, rasterio.DatasetReader]) -> list[IndexStatistics]:
    """Write rasters and pictures; each band is read once. Raises OutputError, InputError for a band."""
    first = rasters[0]
    like = files[first.bands[0].file]
    step = max(1, math.ceil(math.sqrt(like.width * like.height / _MAX_STATISTICS_PX)))
    try:
        with ExitStack() as done:
            partials = [done.enter_context(complete_file(raster.target)) for raster in rasters]
            with ExitStack() as stack:
                for raster, partial in zip(rasters, partials, strict=True):
                    raster.dataset = _create(stack, partial, like, raster)
                for window in _windows(like.width, like.height):
                    _write_window(rasters, files, window, step)
                statistics = [_statistics(raster, like.width * like.height) for raster in rasters]
                for raster, one in zip(rasters, statistics, strict=True):
                    known = {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in vars(one).items()}
                    raster.dataset.update_tags(**{_STATISTICS: json.dumps(known)})
            for raster, partial in zip(rasters, partials, strict=True):
                check_complete(partial)
                raster.checksums.check(partial)
    except (OSError, RasterioError, tifffile.TiffFileError) as error:
        raise OutputError(f"{first.target}: cannot be written ({why(error)})") from None
    for raster, one in zip(rasters, statistics, strict=True):
        _draw(raster, one)
    return statistics


def _write_window(
    rasters: Sequence[_Raster], files: Mapping[Path, rasterio.DatasetReader], window: Window, step: int
) -> None:
    read: dict[tuple[Path, int], FloatImage] = {}
    for raster in rasters:
        for band in raster.bands:
            key = band.file, band.band_index
            if key not in read:
                read[key] = _physical(files[band.file], band.band_index, window)
                if band.quality is not None:
                    flags = _flags(files[band.quality[0]], band.quality[1], window)
                    read[key][flags & np.uint16(UNUSABLE.value) != 0] = np.nan
        value = compute(raster.index, [read[b.file, b.band_index] for b in raster.bands])
        raster.checksums.write(raster.dataset, value, 1, window)
        valid = np.isfinite(value)
        raster.valid_px += int(np.count_nonzero(valid))
        raster.samples.append(value[::step, ::step][valid[::step, ::step]])


def _statistics(raster: _Raster, pixels: int) -> IndexStatistics:
    values = np.concatenate(raster.samples)
    raster.samples = [values]
    if not values.size:
        return IndexStatistics(unit=raster.unit, low=0.0, high=1.0)
    low, p5, median, p95, high = (round(float(v), 6) for v in np.percentile(values, (2, 5, 50, 95, 98)))
    if raster.index.span is not None and raster.unit != RAW:
        low, high = raster.index.span
    return IndexStatistics(
        median, p5, p95, round(raster.valid_px / pixels, 6), raster.unit, low, max(high, low + _MIN_SPAN)
    )


def _physical(
    source: rasterio.DatasetReader, index: int, window: Window, shape: tuple[int, int] | None = None
) -> FloatImage:
    """Scaled as the file says, nan where it says nothing is known; of (height, width) `shape` where one is given.

    Raises InputError where it cannot be read.
    """
    scale, offset, nodata = source.scales[index - 1], source.offsets[index - 1], source.nodatavals[index - 1]
    try:
        pixels = source.read(index, window=window, out_shape=shape).astype(np.float32)
        known_by_nan = nodata is not None and math.isnan(nodata)
        masked = MaskFlags.all_valid not in source.mask_flag_enums[index - 1] and not known_by_nan
        valid = source.read_masks(index, window=window, out_shape=shape) > 0 if masked else None
    except RasterioError as error:
        raise InputError(f"{source.name}: cannot be read ({why(error)}); run again") from None
    if scale != 1.0 or offset != 0.0:
        pixels = pixels * np.float32(scale) + np.float32(offset)
    return pixels if valid is None else np.where(valid, pixels, np.float32(np.nan))


def _flags(source: rasterio.DatasetReader, index: int, window: Window) -> NDArray[np.uint16]:
    """Raises InputError where they cannot be read."""
    try:
        return np.asarray(source.read(index, window=window), np.uint16)
    except RasterioError as error:
        raise InputError(f"{source.name}: cannot be read ({why(error)}); run again") from None


def _windows(width: int, height: int) -> Iterator[Window]:
    for y in range(0, height, _WORK_PX):
        for x in range(0, width, _WORK_PX):
            yield Window(x, y, min(_WORK_PX, width - x), min(_WORK_PX, height - y))


def _create(stack: ExitStack, path: Path, like: rasterio.DatasetReader, raster: _Raster) -> Any:
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
    index = raster.index
    dataset.set_band_description(1, index.name)
    kept = {k: v for k, v in like.tags().items() if k in _KEPT_TAGS}
    kept |= {"TIFFTAG_SOFTWARE": "agalign", "INDEX": index.name, "INDEX_SOURCE": index.source}
    kept |= {"INDEX_FORMULA": _written_out(index), "INDEX_MADE_FROM": raster.made_from}
    dataset.update_tags(**kept, **({"INPUT": "raw numbers, not reflectance"} if raster.unit == RAW else {}))
    return dataset


def _written_out(index: Index) -> str:
    constants = ", ".join(f"{name} = {value:g}" for name, value in index.constants)
    return f"{index.formula} with {constants}" if constants else index.formula


def _draw(raster: _Raster, statistics: IndexStatistics) -> None:
    with open_raster(raster.target) as source:
        width, height = picture_size(source.width, source.height)
        values = source.read(1, out_shape=(height, width))
    is_raw = raster.unit == RAW
    name = raster.target.stem.removesuffix(f"_{raster.index.name}")
    title = f"{raster.index.name.upper()} of {name}" + (": raw numbers, not reflectance" if is_raw else "")
    span = statistics.low, statistics.high
    write_picture(values, raster.samples[0], span, title, raster.target.with_suffix(".png"), neutral=is_raw)


def outdated_rasters(base: Path) -> Iterator[Path]:
    """Yield the index rasters of a capture, `base`_<index>.tif, and their pictures."""
    for path in base.parent.glob(f"{_escaped(base.name)}_*.tif"):
        # Another capture may have such a name.
        if not path.with_suffix(".json").exists() and is_index_raster(path):
            yield from (path, path.with_suffix(".png"))


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)
