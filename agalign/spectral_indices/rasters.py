"""Spectral indices of a capture: a float32 raster and a picture of each, with their statistics; as the product of
`agalign align --index`, and for `agalign indices`.
"""

import glob
import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from agalign._version import __version__
from agalign.config import WriteSettings
from agalign.errors import ConfigurationError, InputError, OutputError
from agalign.flight.fingerprint import hashed
from agalign.host.held_sizes import WORK_TILE_PX
from agalign.host.own_files import SOFTWARE, foreign, is_own_file
from agalign.host.text import shortened
from agalign.pixels.raster import OpenRaster
from agalign.rasters import geotiff
from agalign.rasters.aligned_files import tags_of
from agalign.rasters.band_reader import RAW, UNSTATED, BandReader
from agalign.rasters.product import CapturePaths, LostFile, Product, ProductContext, WrittenFile
from agalign.records.captures import AlignedBand, bands_of, quality_layers
from agalign.records.listed_files import ListedFiles
from agalign.records.sidecar import Sidecar
from agalign.spectral_indices.before_alignment import index_before
from agalign.spectral_indices.formulas import Index, bands_for, chosen_indices, compute, index_named, index_of_formula
from agalign.spectral_indices.picture import write_picture
from agalign.values.capture import Band, CameraIdentity, Capture
from agalign.values.fields import equal
from agalign.values.image import Tile
from agalign.values.radiometry import are_raw_numbers
from agalign.values.resampling import tiles
from agalign.values.spectrum import role_of_band

_OF_CAPTURE = "CAPTURE_ID", "CAMERA", "TIFFTAG_DATETIME"
_SAMPLES_TAG = "INPUT_SAMPLES"
"""Tags of a raster that tell of which capture it is."""
_STATISTICS_TAG = "INDEX_STATISTICS"


@dataclass(frozen=True)
class IndexStatistics:
    """The values of an index raster; nan if no pixel is valid.

    Examples
    --------
    >>> statistics = agalign.indices("aligned", ["ndvi"])[0].statistics
    >>> statistics.p5 < statistics.median < statistics.p95, statistics.valid_share
    (True, 1.0)
    >>> statistics.unit, statistics.masked_share
    ('raw numbers', 0.0)
    """

    median: float = math.nan
    """Median of the valid pixels."""
    p5: float = math.nan
    """5th percentile of the valid pixels."""
    p95: float = math.nan
    """95th percentile of the valid pixels."""
    valid_share: float = 0.0
    """Share of the pixels that are valid, 0 to 1."""
    unit: str = ""
    """Unit of the bands: a `Quantity`, or that it is raw numbers or unstated."""
    low: float = math.nan
    """Value at the lower end of the colour scale of the picture."""
    high: float = math.nan
    """Value at the upper end of the colour scale."""
    masked_share: float = 0.0
    """Share of the pixels that only the quality flags mask."""

    def as_json(self) -> dict[str, float | str | None]:
        """Return the fields by name, with null for nan, which JSON does not have."""
        return {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in vars(self).items()}


@dataclass(frozen=True)
class IndexReport:
    """One index of one capture.

    Examples
    --------
    >>> report = agalign.indices("aligned", ["ndvi"])[0]
    >>> report.capture, report.index, report.path.as_posix()
    ('0000SET/000/IMG_0001', 'ndvi', 'aligned/0000SET/000/IMG_0001_ndvi.tif')
    >>> report.raw_numbers, -1 < report.median < 1  # the run converted no bands to reflectance
    (True, True)
    """

    __eq__ = equal

    capture: str
    """Label of the capture: its folder, relative to the output folder of the run, and its name."""
    index: str
    """Name of the index."""
    path: Path | None = None
    """The raster; None if it could not be written."""
    statistics: IndexStatistics = field(default_factory=IndexStatistics)
    """Median, percentiles and unit of the raster, and its share of valid pixels."""
    problem: str = ""
    """Why it could not be written; for a written raster, what to check in its bands."""
    kept: bool = field(default=False, compare=False)
    """True if an earlier command wrote the raster from the same bands with the same formula."""
    is_masked: bool = field(default=False, compare=False)
    """True if quality flags mask its bands."""
    captured_at: str = ""
    """Time of the capture, ISO 8601; empty if it is unknown."""
    latitude: float | None = None
    """Degrees, WGS 84; None if it is unknown."""
    longitude: float | None = None
    """Degrees, WGS 84; None if it is unknown."""

    @property
    def median(self) -> float:
        """Median of the valid pixels."""
        return self.statistics.median

    @property
    def raw_numbers(self) -> bool:
        """True if the bands are neither reflectance nor radiance."""
        return self.statistics.unit == RAW

    @property
    def key(self) -> tuple[str, str, str]:
        """Identify the row in the table: (folder, capture, index)."""
        label = PurePosixPath(self.capture)
        return label.parent.as_posix(), label.name, self.index

    def of(self, sidecar: Sidecar) -> "IndexReport":
        """Return the report with the time and the position of its capture."""
        place = sidecar.position
        latitude, longitude = (None, None) if place is None else (place.latitude, place.longitude)
        return replace(self, captured_at=sidecar.captured_at, latitude=latitude, longitude=longitude)


def _statistics_in(tags: Mapping[str, str]) -> IndexStatistics | None:
    """Return the statistics in the tags of a raster; None if there are none."""
    try:
        fields: dict[str, Any] = json.loads(tags[_STATISTICS_TAG])
        unit = shortened(str(fields.pop("unit")))
        return IndexStatistics(unit=unit, **{k: math.nan if v is None else float(v) for k, v in fields.items()})
    except (KeyError, ValueError, TypeError):
        return None


class IndexRasters(Product):
    """A raster and a picture of each requested index whose bands are aligned."""

    kind = "index"
    is_required = False

    def paths(self, capture: Capture, paths: CapturePaths, settings: WriteSettings) -> list[Path]:  # noqa: ARG002
        """Return <capture>_<index>.tif and .png."""
        return [paths.file(f"_{name}{suffix}") for name in settings.indices for suffix in (".tif", ".png")]

    def is_enabled(self, settings: WriteSettings) -> bool:  # noqa: ARG002
        """Return True: rasters that an earlier command wrote are written again."""
        return True

    def write(self, context: ProductContext) -> Iterator[WrittenFile | LostFile]:
        """Write the indices that were requested and of which the capture has all bands, usable, and those that an
        earlier command wrote. One that a command has masked by quality flags stays masked if there are flags.

        Raises InputError if the raster of a requested index cannot be written, other than by `impossible_indices`.
        """
        base, label = context.paths.file(""), context.capture.label
        requested, rasters = chosen_indices(context.settings.write.indices), index_rasters(base)
        names, samples = {index.name for index in requested}, context.sidecar.own_samples
        bands, problems = list(_bands(context)), []
        masked = list(_masked(bands, context))
        stay_masked = {raster.name for raster in rasters if raster.is_masked and any(b.quality for b in masked)}
        wanted = [(index, None) for index in requested] + [(r.index, r) for r in rasters if r.name not in names]
        with BandReader() as reader:
            for index, raster in wanted:
                if index is None:
                    assert raster is not None
                    yield LostFile(raster.path, "its formula is unknown")
                    continue
                is_masked = index.name in stay_masked if raster is None else raster.is_masked
                report = write_index(reader, masked if is_masked else bands, index, base, label, samples=samples)
                if report.path is not None:
                    before = index_before(context, index, (report.statistics.low, report.statistics.high))
                    named = None if before is None else (index.name, before)
                    yield WrittenFile(self.kind, report.path, index_before=named)
                    yield WrittenFile(self.kind, report.path.with_suffix(".png"))
                elif raster is not None:
                    yield LostFile(raster.path, report.problem)
                elif (
                    report.problem not in {b.problem for b in bands}
                    and not isinstance(_obstacle(index, bands, reader), _UnsuitableUnitError)
                    and _has_bands(context.capture.bands, index)
                ):
                    problems.append(f"{index.name}: {report.problem}")
        if problems:
            raise InputError("; ".join(problems))


def check_indices(captures: Sequence[Capture], settings: WriteSettings) -> None:
    """Raise ConfigurationError for an unknown or repeated index, or one that no camera has the bands for, or no capture
    the unit.
    """
    of_cameras = defaultdict[CameraIdentity, list[Band]](list)  # single captures may lack files
    for capture in captures:
        of_cameras[capture.camera] += capture.bands
    for index in chosen_indices(settings.indices):
        suitable = [c for c in captures if _has_bands(c.bands, index)]
        if captures and not any(_has_bands(bands, index) for bands in of_cameras.values()):
            names = ", ".join(dict.fromkeys(b.name for c in captures for b in c.bands))
            raise ConfigurationError(
                f"--index {index.name}: needs bands {', '.join(index.roles)}, and no capture has them all; "
                f"there are {names}"
            )
        are_raw = all(is_of_raw_numbers(index, c, settings) for c in suitable)
        if suitable and are_raw and not index.any_unit:
            raise ConfigurationError(f"--index {index.name}: needs reflectance; add --radiometry")


def is_of_raw_numbers(index: Index, capture: Capture, settings: WriteSettings) -> bool:
    """Return True if a capture has the bands of an index, and the files will have raw numbers of one of them."""
    used = [band for band in capture.bands if role_of_band(band) in index.roles]
    are_raw = any(are_raw_numbers(band.dtype, band.scale_offset[0]) for band in used)
    return are_raw and settings.radiometry == "off" and _has_bands(used, index)


def _has_bands(bands: Sequence[Band], index: Index) -> bool:
    return {role_of_band(band) for band in bands} >= set(index.roles)


def _bands(context: ProductContext) -> Iterator[AlignedBand]:
    places, usable = context.places, {context.capture.reference.name, *context.usable}
    for band in context.capture.bands:
        if band.name in usable and band.name in places:
            file, index = places[band.name]
            yield AlignedBand(band.name, band.wavelength_nm, file.path, index, file.sha256)
        else:
            yield AlignedBand(band.name, band.wavelength_nm, Path(), 1, problem="not usable")


def _masked(bands: Sequence[AlignedBand], context: ProductContext) -> Iterator[AlignedBand]:
    """Yield bands with the quality raster that this rendering has written."""
    raster = next((file for file in context.written if file.kind == "qa"), None)
    layers = quality_layers(layer.band.name for layer in context.layers)
    for band in bands:
        if raster is None:
            yield replace(band, problem="its quality raster does not exist")
        else:
            yield replace(band, quality=(raster.path, layers[band.name], raster.sha256))


def write_index(
    reader: BandReader,
    bands: Sequence[AlignedBand],
    index: Index,
    base: Path,
    label: str,
    *,
    overwrite: bool = True,
    samples: Collection[str] = (),
) -> IndexReport:
    """Write `base`_<index>.tif and .png of a capture's bands, each atomically; `samples` are `Sidecar.own_samples` of
    the capture, for `IndexRaster.is_of_other`.

    Without `overwrite`, a raster that an earlier command wrote from the same bands with the same formula is kept. If a
    band of the index is missing, not usable, not in the unit that the index needs, not as the sidecar has listed its
    file, or if a file cannot be read or written, the report has the problem.
    """
    target = base.with_name(f"{base.name}_{index.name}.tif")
    try:
        chosen = _bands_of_index(bands, index)
        source = _fingerprint(index, chosen)
        may_be_kept = not overwrite and all(band.sha256 for band in chosen)
        earlier = _finished_before(target, source, reader.listed) if may_be_kept else None
        if earlier is None:
            _refuse_to_replace(target, index, bands)
        if not overwrite and (change := reader.listed.problem(target)) and IndexRaster.complete(target) is not None:
            raise InputError(f"{change}; --overwrite replaces it")
        statistics = earlier or _write(index, chosen, target, source, reader, samples)
    except (InputError, OutputError) as error:
        return IndexReport(label, index.name, problem=str(error))
    is_masked = any(band.quality is not None for band in chosen)
    return IndexReport(label, index.name, target, statistics, kept=earlier is not None, is_masked=is_masked)


def _refuse_to_replace(target: Path, index: Index, bands: Sequence[AlignedBand]) -> None:
    """Raise InputError for a file that an index may not replace."""
    remedy = f"give the formula '{index.name}' another name"
    if target.resolve() in {band.file.resolve() for band in bands}:
        raise InputError(f"{target}: is the file of a band; {remedy}")
    if file := _foreign_file(target):
        raise InputError(foreign(file, "choose another folder with -o"))
    if (other := tags_of(target).get("INDEX", index.name)) != index.name:
        raise InputError(f"{target}: is the index '{other}', not '{index.name}'; {remedy}")


def _foreign_file(raster: Path) -> Path | None:
    """Return the file in the place of an index raster, or of its picture, that no command has written; None if there is
    none. A damaged raster is written again.
    """
    picture = raster.with_suffix(".png")
    is_foreign = raster.exists() and not is_own_file(raster)
    with suppress(OSError):
        geotiff.check_complete(raster)
        is_foreign = IndexRaster.read(raster) is None
    if is_foreign:
        return raster
    return picture if picture.exists() and not is_own_file(picture) else None


@dataclass(frozen=True)
class IndexRaster:
    """An index raster that an earlier command wrote."""

    path: Path
    statistics: IndexStatistics
    tags: Mapping[str, str]

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Return the index raster in a file; None for any other file."""
        tags = tags_of(path)
        statistics = _statistics_in(tags)
        return None if statistics is None else cls(path, statistics, tags)

    @classmethod
    def complete(cls, path: Path) -> Self | None:
        """Return the index raster in a file that is not damaged; None for any other file."""
        with suppress(OSError):
            geotiff.check_complete(path)
            return cls.read(path)
        return None

    @property
    def name(self) -> str:
        """Name of the index."""
        return self.tags.get("INDEX", "")

    @property
    def index(self) -> Index | None:
        """The index with the name and the formula in its tags; None if the formula cannot be evaluated."""
        formula = self.tags.get("INDEX_FORMULA", "")
        with suppress(ConfigurationError):
            known = index_named(self.name)
            if _formula_text(known) == formula:
                return known
        with suppress(ConfigurationError):
            return index_of_formula(f"{self.name}={formula}")
        return None

    def is_of_other(self, bands: Path, samples: Collection[str]) -> bool:
        """Return True if this raster and a file of bands are of different captures: by the ids in their tags; if one of
        them has no id, by the `samples` of the input of the bands, or by camera and time if one has no samples.
        """
        own, others = self.tags, tags_of(bands)
        known = [name for name in _OF_CAPTURE if own.get(name) and others.get(name)]
        own_samples = own.get(_SAMPLES_TAG, "").split()
        if "CAPTURE_ID" not in known and own_samples and samples:
            return set(own_samples).isdisjoint(samples)
        decisive = known[:1] if "CAPTURE_ID" in known else known
        return any(own[name] != others[name] for name in decisive)

    @property
    def is_masked(self) -> bool:
        """True if its bands were masked by quality flags."""
        return bool(self.tags.get("MASKED_BY"))


def index_rasters(base: Path) -> list[IndexRaster]:
    """Return the index rasters of a capture, `base`_<index>.tif."""
    paths = sorted(base.parent.glob(f"{glob.escape(base.name)}_*.tif"))
    # A file with a sidecar is the stack of another capture.
    found = (IndexRaster.read(path) for path in paths if not path.with_suffix(".json").exists())
    return [raster for raster in found if raster is not None and raster.path.name == f"{base.name}_{raster.name}.tif"]


def _bands_of_index(bands: Sequence[AlignedBand], index: Index) -> list[AlignedBand]:
    """Return the bands of an index. Raises InputError if one is missing or not usable."""
    by_name = {band.name: band for band in bands}
    chosen = [by_name[name] for name in bands_for(index, {b.name: b.wavelength_nm for b in bands})]
    for band in chosen:
        if band.problem:
            raise InputError(band.problem)
    return chosen


def reason_not_written(index: Index, sidecar: Sidecar, folder: Path) -> str:
    """Return why an index of a capture cannot be calculated from its aligned bands, given the folder of the sidecar;
    empty if it can.
    """
    with BandReader() as reader:
        return str(_obstacle(index, bands_of(sidecar, folder), reader) or "")


class _UnsuitableUnitError(InputError):
    """The bands of an index are in units from which it cannot be calculated."""


def impossible_indices(names: Sequence[str], sidecar: Sidecar, folder: Path) -> tuple[str, ...]:
    """Return which of these indices of a capture no run can calculate because of the units of its aligned bands, and
    why, given the folder of the sidecar.
    """
    files = {part.file for part in sidecar.products}
    missing = [name for name in names if f"{Path(sidecar.capture).name}_{name}.tif" not in files]
    if not missing:
        return ()
    bands = bands_of(sidecar, folder)
    with BandReader() as reader:
        obstacles = {index.name: _obstacle(index, bands, reader) for index in chosen_indices(missing)}
    return tuple(f"{name}: {error}" for name, error in obstacles.items() if isinstance(error, _UnsuitableUnitError))


def _obstacle(index: Index, bands: Sequence[AlignedBand], reader: BandReader) -> InputError | None:
    """Return why an index cannot be calculated from the bands of a capture; None if it can."""
    try:
        _common_unit(index, _bands_of_index(bands, index), reader)
    except InputError as error:
        return error
    return None


def _fingerprint(index: Index, bands: Sequence[AlignedBand]) -> str:
    """Sixteen hexadecimal digits of everything that an index raster depends on."""
    sources = [(b.sha256, b.band_index) for b in bands]
    masks = [(b.quality[2], b.quality[1]) for b in bands if b.quality is not None]
    facts = __version__, index.formula, index.constants, index.span, sources
    return hashed(*facts, masks) if masks else hashed(*facts)


def _finished_before(target: Path, source: str, listed: ListedFiles) -> IndexStatistics | None:
    """The statistics of a complete raster with its picture and this fingerprint; None if there is none, or if one is
    not as the sidecar has listed it.
    """
    picture = target.with_suffix(".png")
    if not picture.is_file() or any(map(listed.problem, (target, picture))):
        return None
    raster = IndexRaster.complete(target)
    return raster.statistics if raster is not None and raster.tags.get("INDEX_MADE_FROM") == source else None


def _common_unit(index: Index, bands: Sequence[AlignedBand], reader: BandReader) -> str:
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
        raise _UnsuitableUnitError(f"its bands are in different units ({', '.join(sorted(units))})")
    (unit,) = units
    if not (index.any_unit or index.is_of_user) and unit not in ("reflectance", UNSTATED):
        remedy = "a calibration panel gives it" if unit == "relative reflectance" else "align with --radiometry"
        raise _UnsuitableUnitError(f"needs reflectance, and the bands are {unit}; {remedy}")
    return unit


def _write(
    index: Index, bands: Sequence[AlignedBand], target: Path, source: str, reader: BandReader, samples: Collection[str]
) -> IndexStatistics:
    """Write the raster tile by tile, and its picture. Raises OutputError, InputError for a band."""
    unit = _common_unit(index, bands, reader)
    like = reader.file(bands[0].file, bands[0].band_index)
    profile = geotiff.tiled_profile(like.width, like.height, 1, "float32", **geotiff.FLOAT_OPTIONS)
    if like.crs is not None and not like.transform.is_identity:
        profile |= {"crs": like.crs, "transform": like.transform}
    # Percentiles of larger rasters are calculated from every second, third … row and column.
    max_statistics_px = 4_000_000
    step = max(1, math.ceil(math.sqrt(like.width * like.height / max_statistics_px)))
    shown, valid_px, masked_px = [], 0, 0
    unmasked = [replace(band, quality=None) for band in bands]
    is_cog = like.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG"
    is_masked = list(bands) != unmasked
    layers, tags = [geotiff.LayerDescription(index.name)], _tags(index, like, unit, source, is_masked=is_masked)
    tags[_SAMPLES_TAG] = " ".join(sorted(samples))
    with geotiff.checked_raster(target, profile, layers, tags, geotiff.to_cog if is_cog else None) as (dataset, write):
        for tile in tiles(Tile(0, 0, like.width, like.height), WORK_TILE_PX):
            values = compute(index, [reader.values(band, tile) for band in bands])
            write(values, 1, tile.x0, tile.y0)
            valid = np.isfinite(values)
            valid_px += int(np.count_nonzero(valid))
            if is_masked:
                all_values = compute(index, [reader.values(band, tile) for band in unmasked])
                masked_px += int(np.count_nonzero(np.isfinite(all_values) & ~valid))
            shown.append(values[::step, ::step][valid[::step, ::step]])
        sample = np.concatenate(shown)
        shares = (pixels / (like.width * like.height) for pixels in (valid_px, masked_px))
        statistics = _statistics(index, unit, sample, *shares)
        dataset.update_tags(**{_STATISTICS_TAG: json.dumps(statistics.as_json())})
    write_picture(index.name, target, sample, (statistics.low, statistics.high), is_raw=statistics.unit == RAW)
    return statistics


def _formula_text(index: Index) -> str:
    constants = ", ".join(f"{name} = {value:g}" for name, value in index.constants)
    return f"{index.formula} with {constants}" if constants else index.formula


def _tags(index: Index, like: OpenRaster, unit: str, source: str, *, is_masked: bool) -> dict[str, str]:
    """The tags of a raster, some of which are those of the file of its first band."""
    copied = *_OF_CAPTURE, "RADIOMETRY", "GEOREFERENCE", "GEOREFERENCE_ACCURACY_M"
    return {k: v for k, v in like.tags().items() if k in copied} | {
        "TIFFTAG_SOFTWARE": SOFTWARE,
        "INDEX": index.name,
        "INDEX_SOURCE": index.source,
        "INDEX_FORMULA": _formula_text(index),
        "INDEX_MADE_FROM": source,
        "MASKED_BY": "qa" if is_masked else "",
        "INPUT": "raw numbers, not reflectance" if unit == RAW else "",
    }


def _statistics(
    index: Index, unit: str, sample: NDArray[np.float32], valid_share: float, masked_share: float
) -> IndexStatistics:
    valid_share, masked_share = round(valid_share, 6), round(masked_share, 6)
    if not sample.size:
        return IndexStatistics(valid_share=valid_share, unit=unit, low=0.0, high=1.0, masked_share=masked_share)
    low, p5, median, p95, high = (round(float(v), 6) for v in np.percentile(sample, (2, 5, 50, 95, 98)))
    if index.span is not None and unit != RAW:
        low, high = index.span
    # The ends of the colour scale must differ.
    return IndexStatistics(median, p5, p95, valid_share, unit, low, max(high, low + 1e-3), masked_share)
