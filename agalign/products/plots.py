"""Statistics of spectral indices in the plots of a field trial: a row for each plot, index, and raster or capture."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agalign.errors import AgalignError, ConfigurationError, InputError
from agalign.pixels.raster import innermost_cause, probe
from agalign.products.index_bands import BandReader, IndexBand, bands_of
from agalign.products.index_rasters import chosen_bands, common_unit
from agalign.products.indices import Index, compute, index_named
from agalign.products.sidecar_file import read_result, run_sidecars
from agalign.products.text_files import write_csv
from agalign.values.files import complete_file
from agalign.values.image import FloatImage, Tile

if TYPE_CHECKING:
    from geopandas import GeoDataFrame, GeoSeries

_OPERATIONS = ["mean", "median", "stdev", "quantile(q=0.05)", "quantile(q=0.95)", "count"]
"""Of exactextract. Pixels have the weight of their share in the plot."""
_RENAMED = {"stdev": "std", "quantile_5": "p5", "quantile_95": "p95"}
"""Columns by result of exactextract."""
_IDS = "plot", "plot_id", "id", "name"
"""Attributes that name the plots, in order of preference."""
_SUFFIXES = ".csv", ".geojson", ".parquet"


@dataclass(frozen=True)
class _Source:
    """A mosaic, or a capture of a run."""

    label: str
    date: str
    bands: Sequence[IndexBand]
    error_map: Path

    def facts(self, tags: Mapping[str, str]) -> dict[str, Any]:
        """The columns that all rows of the source have in common, by the tags of its raster."""
        date = self.date or tags.get("TIFFTAG_DATETIME", "").replace(":", "-", 2).replace(" ", "T")
        accuracy_m = float(tags.get("GEOREFERENCE_ACCURACY_M", "nan"))
        return {"date": date, "capture": self.label, "georeference_accuracy_m": accuracy_m}


@dataclass(frozen=True)
class PlotReport:
    """The result of `plot_statistics`."""

    table: "GeoDataFrame"
    """Columns date, capture, plot, index, mean, median, std, p5, p95, valid_share, expected_error_px (largest of the
    bands), georeference_accuracy_m, unit and geometry.
    """
    problems: Sequence[tuple[str, str]]
    """(raster or capture, reason why it or one of its indices is left out)."""


def plot_statistics(
    rasters: Sequence[str | Path],
    plots: str | Path,
    indices: Sequence[str] = ("ndvi",),
    *,
    id_column: str | None = None,
) -> PlotReport:
    """Calculate indices in plots: polygons in any vector file that GDAL reads.

    `rasters` are georeferenced rasters, in which bands have names or wavelengths, and output folders of runs; their
    captures have a georeference. Rotated rasters are not resampled: the plots are transformed to their pixels.
    `id_column` is the attribute that names the plots, by default plot, plot_id, id or name, else their number from 1.
    Raises InputError for files that cannot be used, or if no plot is in any raster, ConfigurationError without
    exactextract and geopandas, or for an unknown index or attribute.
    """
    geopandas = _libraries()
    chosen = [index_named(name) for name in indices]
    polygons = _polygons(geopandas, Path(plots), id_column)
    rows: list[dict[str, Any]] = []
    problems: list[tuple[str, str]] = []
    for source in [source for raster in rasters for source in _sources(Path(raster), problems)]:
        try:
            rows += _rows(source, polygons, chosen, problems)
        except AgalignError as error:
            problems.append((source.label, str(error)))
    if not rows:
        reason = f"; {problems[0][0]}: {problems[0][1]}" if problems else ""
        raise InputError(f"{plots}: none of its plots has pixels in the rasters{reason}")
    rows.sort(key=lambda row: (row["date"], row["capture"]))
    return PlotReport(geopandas.GeoDataFrame(rows, crs=polygons[0].crs), problems)


def write_plots(table: "GeoDataFrame", path: Path) -> None:
    """Write the table of `plot_statistics` as CSV, GeoJSON (WGS 84) or GeoParquet, by the suffix of `path`.

    Raises ConfigurationError for another suffix, OutputError.
    """
    check_table(path)
    if path.suffix == ".csv":
        columns = [name for name in table.columns if name != "geometry"]
        cells = (["" if v is None or v != v else v for v in row] for row in table[columns].values)
        write_csv(path, columns, cells)
        return
    with complete_file(path) as partial:
        if path.suffix == ".parquet":
            table.to_parquet(partial)
        else:
            table.to_crs("EPSG:4326").to_file(partial, driver="GeoJSON")


def check_table(path: Path, inputs: Sequence[Path] = ()) -> None:
    """Raise ConfigurationError if `write_plots` cannot write a file of this name, or if it is one of the inputs."""
    if path.suffix not in _SUFFIXES or path.resolve() in {one.resolve() for one in inputs}:
        raise ConfigurationError(f"{path}: give a new file that ends in {', '.join(_SUFFIXES)}")


def _libraries() -> Any:
    try:
        geopandas, *_ = map(import_module, ("geopandas", "exactextract", "pyarrow"))
    except ImportError as error:
        raise ConfigurationError(f"{error.name} is not installed; in a checkout: pip install '.[plots]'") from None
    return geopandas


def _polygons(geopandas: Any, path: Path, id_column: str | None) -> "tuple[GeoSeries, list[str]]":
    """(polygons, their names)."""
    frame = _read_vectors(geopandas, path)
    is_area = frame.geometry.notna() & frame.geometry.geom_type.isin(("Polygon", "MultiPolygon"))
    if not is_area.any():
        raise InputError(f"{path}: has no polygons; give a file with the outlines of the plots")
    columns = {str(name).lower(): name for name in frame.columns if name != "geometry"}
    if id_column is not None and id_column.lower() not in columns:
        raise ConfigurationError(f"{path}: has no attribute '{id_column}'; choose from {', '.join(columns.values())}")
    wanted = _IDS if id_column is None else (id_column.lower(),)
    names = next((frame[columns[name]] for name in wanted if name in columns), range(1, len(frame) + 1))
    return frame.geometry[is_area], [str(name) for name, keep in zip(names, is_area, strict=True) if keep]


def _read_vectors(geopandas: Any, path: Path) -> Any:
    """The data frame of a vector file with a coordinate reference system. Raises InputError."""
    try:
        frame = geopandas.read_file(path)
    except Exception as error:  # pyogrio's errors have no common public class
        raise InputError(f"{path}: cannot be read as a vector file ({innermost_cause(error)})") from None
    if frame.crs is None:
        raise InputError(f"{path}: has no coordinate reference system; give a file with the outlines of the plots")
    return frame


def _sources(path: Path, problems: list[tuple[str, str]]) -> Iterator[_Source]:
    """The captures of a run, or a raster. Captures without aligned bands are added to the problems.

    Raises InputError.
    """
    if not path.is_dir():
        bands = [IndexBand(b.name or f"band {b.band_index}", b.wavelength_nm, path, b.band_index) for b in probe(path)]
        yield _Source(path.stem, "", bands, path.with_suffix(".error.tif"))
        return
    for sidecar_path in run_sidecars(path):
        sidecar, label = read_result(sidecar_path), sidecar_path.relative_to(path).with_suffix("").as_posix()
        if sidecar.output is None:
            problems.append((label, "it has no aligned bands"))
        else:
            bands = bands_of(sidecar, sidecar_path.parent)
            yield _Source(label, sidecar.captured_at, bands, sidecar_path.with_suffix(".error.tif"))


def _rows(
    source: _Source, plots: "tuple[GeoSeries, list[str]]", indices: Sequence[Index], problems: list[tuple[str, str]]
) -> Iterator[dict[str, Any]]:
    """The rows of a raster; indices that cannot be calculated from its bands are added to the problems."""
    polygons, ids = plots
    with BandReader() as reader:
        like = reader.file(next((b for b in source.bands if not b.problem), source.bands[0]).file, 1)
        if like.crs is None or like.transform.is_identity:
            raise InputError("has no georeference; align with --georeference, or use 'agalign mosaic'")
        of_source = source.facts(like.tags())
        # exactextract counts y upwards. Rounding: a pixel that a plot only touches would change its percentiles.
        a, b, c, d, e, f = (~like.transform)[:6]
        step_px = 1e-6
        in_pixels = polygons.to_crs(like.crs).affine_transform([a, b, -d, -e, c, -f]).set_precision(step_px)
        errors = _error_layers(source.error_map, reader)
        for index in indices:
            try:
                bands = chosen_bands(source.bands, index)
                unit = common_unit(index, bands, reader)
            except InputError as error:
                problems.append((source.label, str(error)))
                continue
            of_bands = [errors[band.name] for band in bands if band.name in errors]
            for name, polygon, shape in zip(ids, polygons, in_pixels, strict=True):
                tile = _tile(shape.bounds, like.width, like.height)
                values = {} if tile is None else _of_plot(index, bands, of_bands, reader, tile, shape)
                if values:
                    yield of_source | {"plot": name, "index": index.name, **values, "unit": unit, "geometry": polygon}


def _of_plot(
    index: Index, bands: Sequence[IndexBand], errors: Sequence[IndexBand], reader: BandReader, tile: Tile, shape: Any
) -> dict[str, float]:
    """The statistics of an index in a polygon inside a tile, and the largest mean of the bands' expected errors; empty
    without a pixel.
    """
    values = _statistics(compute(index, [reader.values(band, tile) for band in bands]), tile, shape)
    if not values.pop("count"):
        return {}
    means_px = [_statistics(reader.values(error, tile), tile, shape)["mean"] for error in errors]
    return values | {"expected_error_px": max(means_px, default=math.nan)}


def _error_layers(path: Path, reader: BandReader) -> dict[str, IndexBand]:
    """The layers of an error map by band; empty without one."""
    if not path.is_file():
        return {}
    names = reader.file(path, 1).descriptions
    return {str(name): IndexBand(str(name), None, path, k) for k, name in enumerate(names, start=1)}


def _tile(bounds: tuple[float, float, float, float], width: int, height: int) -> Tile | None:
    """The pixels of a raster that a polygon with these bounds (y upwards) touches; None for none."""
    left, bottom, right, top = bounds
    x0, x1 = max(0, math.floor(left)), min(width, math.ceil(right))
    y0, y1 = max(0, math.floor(-top)), min(height, math.ceil(-bottom))
    return Tile(x0, y0, x1 - x0, y1 - y0) if x1 > x0 and y1 > y0 else None


def _statistics(values: FloatImage, tile: Tile, polygon: Any) -> dict[str, float]:
    """Statistics of the pixels (height, width) of a tile in a polygon, and their number."""
    from exactextract import exact_extract
    from exactextract.raster import NumPyRasterSource

    edges = tile.x0, -(tile.y0 + tile.height), tile.x0 + tile.width, -tile.y0
    feature = {"type": "Feature", "properties": {}, "geometry": polygon.__geo_interface__}
    (result,) = exact_extract(NumPyRasterSource(values, *edges), feature, _OPERATIONS)
    named = {_RENAMED.get(name, name): value for name, value in result["properties"].items()}
    named["valid_share"] = min(1.0, named["count"] / polygon.area)
    return {k: math.nan if v is None else float(v) for k, v in named.items()}
